"""The preconditioner: what its levels hold, what it does to the matrix, that threads and batches change nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cases import Case, beam, box, slivers
from multilevel_cases import Tables, build_levels, many_bodies, precondition, solved_directly, spectrum_of, swing
from runs import ULP, noise, simulator
from scipy.sparse import bsr_array, csr_array

import torchpd as pd
from torchpd.common.tables import MULTILEVEL_TABLE, PLAN_TABLE
from torchpd.plan.preconditioner import has_preconditioner, stored_reference

pytestmark = pytest.mark.usefixtures("poisoned")
ops = torch.ops.torchpd


def prepared(case: Case, dtype: torch.dtype = torch.float64) -> pd.Simulator:
    return simulator(case, dtype, solver=pd.Multilevel())


# 13 cells: 12 740 free vertices, the first count of these boxes with a middle level
@pytest.mark.parametrize(("cells", "youngs"), [(5, 1e4), (5, 1e6), (5, 1e8), (13, 1e6)])
def test_eigenvalues_on_uniform_boxes(cells: int, youngs: float) -> None:
    """0 < M A <= 1 in exact arithmetic where the smoother is bounded; the lower bound is what makes it worth having."""
    case = swing(cells, youngs)
    sim = prepared(case)
    assert (int(sim.plan.level_sizes[5]) > 0) == (cells == 13)
    low, high = spectrum_of(sim, case)
    assert high <= 1.01
    assert low >= 0.3


@pytest.mark.parametrize("contrast", [1e2, 1e4, 1e6])
def test_eigenvalues_with_stiff_grains(contrast: float) -> None:
    """40 cubes of one cell, of which aggregates of 30 vertices leave most without a node of their own: 1 / contrast."""
    mesh = pd.TetMesh(*box((1.0, 0.2, 0.2), (30, 6, 6)))
    cell = np.floor(30.0 * mesh.vertices[mesh.tets].mean(axis=1)).astype(int)
    body = pd.Solid(mesh, np.where((cell % 3 == 1).all(axis=1), 1e4 * contrast, 1e4), density=1000.0)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0))
    case = Case(scene, mesh.vertices, 0.0 * mesh.vertices, 1.0 / 30.0)
    low, high = spectrum_of(prepared(case), case)
    assert high <= 1.01
    assert low >= 0.3


@pytest.mark.parametrize("name", ["beam", "slivers", "bodies", "direct"])
def test_op_is_the_cycle_of_its_tables(name: str, dtype: torch.dtype) -> None:
    case = {"beam": lambda: beam(1e6), "slivers": slivers, "bodies": many_bodies, "direct": slivers}[name]()
    sim, exact = prepared(case, dtype), prepared(case)
    if name == "direct":
        sim, exact = solved_directly(sim), solved_directly(exact)
    field = noise(sim.rest_positions).double().numpy()
    expected = Tables(exact.plan)(field)
    found = precondition(sim, field)
    # backward stable but for the condition of the coarse factor's square, at most 1e6 here, in norms
    error = np.linalg.norm(found - expected)
    assert error <= (1e-9 if dtype == torch.float64 else 1e-2) * np.linalg.norm(expected)
    held = ~case.problem().free
    assert not found[held].any()


@pytest.mark.parametrize("name", ["beam", "slivers", "bodies", "box"])
def test_prolongation_of_a_gpu_includes_smoothing(name: str) -> None:
    """(I - S A) P, by rows and by nodes; everything else is as on a CPU."""
    case = {"beam": lambda: beam(1e6), "slivers": slivers, "bodies": many_bodies, "box": lambda: swing(13, 1e6)}[name]()
    sim = prepared(case)
    found, plain = (build_levels(sim, folded=folded) for folded in (True, False))
    for row, array in zip(MULTILEVEL_TABLE, sim.plan.arrays[len(PLAN_TABLE) :], strict=True):
        if row.name == "level_sizes" or "pack" in row.name:  # of the patches of a CPU plan
            continue
        assert np.array_equal(plain[row.name], array.numpy().reshape(plain[row.name].shape)), row.name
        if "prolongation" not in row.name and "node" not in row.name and row.name != "turning_weight":
            assert np.array_equal(found[row.name], plain[row.name]), row.name
    levels = Tables(sim.plan).levels
    assert len(levels) == (2 if name in ("bodies", "box") else 1)
    for kind, height, (matrix, inverse, prolongation) in zip(("fine", "middle"), (1, 4), levels, strict=False):
        rng = np.random.default_rng(0)
        below, above = (rng.standard_normal((count, 3)) for count in prolongation.shape[::-1])
        t = {key: found[f"{kind}_{key}"] for key in ("prolongation_start", "prolongation_node", "prolongation_weight")}
        t |= {key: found[f"{kind}_{key}"] for key in ("node_start", "node_row", "node_weight", "node_prolongation")}
        rows = bsr_array(
            (t["prolongation_weight"].reshape(-1, height, 4), t["prolongation_node"], t["prolongation_start"]),
            shape=prolongation.shape,
        )
        weight = t["node_weight"].reshape(-1, height, 4).transpose(0, 2, 1)
        nodes = bsr_array((weight, t["node_row"], t["node_start"]), shape=prolongation.shape[::-1])
        image = prolongation @ below
        expected = image - Tables.smooth(matrix, inverse, matrix @ image)
        assert np.linalg.norm(rows @ below - expected) <= 1e-13 * np.linalg.norm(image)
        smoothed = prolongation.T @ (above - matrix @ Tables.smooth(matrix, inverse, above))
        assert np.linalg.norm(nodes @ above - smoothed) <= 1e-13 * np.linalg.norm(prolongation.T @ above)
        assert len(t["node_prolongation"]) == 0
        assert len(t["prolongation_node"]) == found["level_sizes"][{"fine": 1, "middle": 4}[kind]]


def test_a_direct_one_is_the_inverse(dtype: torch.dtype) -> None:
    """On the free vertices; what is held stays at zero, and a larger mesh keeps its levels."""
    case = beam(1e6)
    sim = solved_directly(prepared(case, dtype), 936)
    assert sim.vertices == 936
    assert sim.plan.level_sizes.tolist()[1:7] == [0, 0, 0, 0, 0, 1]
    assert "preconditioner: 936 vertices, solved directly;" in str(sim)
    problem = case.problem()
    field = noise(sim.rest_positions).double().numpy() * problem.free[:, None]
    image = precondition(sim, problem.matrix @ field)
    assert not image[~problem.free].any()
    # the condition of A, 3.2e3, times the rounding of the factor and what is added to the diagonal
    assert np.linalg.norm(image - field) <= 3.2e3 * (ULP[dtype] + 1e-12) * np.linalg.norm(field)
    assert int(solved_directly(prepared(case, dtype), 935).plan.level_sizes[2]) > 0


@pytest.mark.parametrize("direct", [False, True])
def test_what_is_held_has_no_part(direct: bool, dtype: torch.dtype) -> None:
    """Whatever the field says there, the other vertices do not hear of it."""
    case = slivers()
    sim = solved_directly(prepared(case, dtype)) if direct else prepared(case, dtype)
    held = ~case.problem().free
    field = noise(sim.rest_positions).double().numpy()
    expected = precondition(sim, field * ~held[:, None])
    field[held] = np.nan
    np.testing.assert_array_equal(precondition(sim, field)[~held], expected[~held])


def test_matrix_is_that_of_the_reference() -> None:
    case = slivers()
    plan = prepared(case).plan
    count = plan.vertices
    entries = (plan.fine_value.numpy(), plan.fine_column.numpy(), plan.fine_start.numpy())
    stored = csr_array(entries, shape=(count, count))
    problem, order = case.problem(), plan.vertex_order.numpy()
    free = np.flatnonzero(problem.free[order])
    expected = problem.matrix[order][:, order][free][:, free]
    assert abs(stored[free][:, free] - expected).max() <= 64 * ULP[torch.float64] * abs(expected).max()
    assert stored.nnz == stored[free][:, free].nnz
    inverse = np.where(problem.free, 1.0 / problem.weighted_diagonal, 0.0)[order]
    np.testing.assert_allclose(plan.fine_inverse.numpy(), inverse, rtol=1e-12)


def test_it_is_symmetric_and_positive(dtype: torch.dtype) -> None:
    sim = prepared(slivers(), dtype)
    x, y = (noise(sim.rest_positions, seed)[None] for seed in (0, 1))
    plan = list(sim.plan.arrays)
    mx, my = ops.precondition(x, plan), ops.precondition(y, plan)
    assert float((x * my).sum()) == pytest.approx(float((y * mx).sum()), rel=1e3 * ULP[dtype] * float(x.norm()))
    assert float((x * mx).sum()) > 0.0
    twice = ops.precondition(2.0 * x - y, plan)
    assert float((twice - (2.0 * mx - my)).norm()) <= 1e3 * ULP[dtype] * float(mx.norm() + my.norm())


def test_translation_of_a_free_body_is_exact() -> None:
    """A constant is in every coarse space; what is added to the coarse diagonal, 1e-12 of it, weakens the solve."""
    vertices, tets = box((1.0, 0.2, 0.2), (15, 3, 3))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e8)
    case = Case(pd.Scene(body), vertices, 0.0 * vertices, 1.0 / 30.0)
    problem, field = case.problem(), np.ones_like(vertices)
    image = precondition(prepared(case), problem.matrix @ field)
    stiffest = float((problem.weighted_diagonal / problem.weight).max())
    assert np.linalg.norm(image - field) <= 1e-12 * stiffest * np.linalg.norm(field)


@pytest.mark.parametrize("cells", [(1, 1, 1), (2, 1, 1)])
def test_tiny_meshes_are_solved_exactly_or_almost(cells: tuple[int, int, int]) -> None:
    vertices, tets = box((0.1, 0.1, 0.1), cells)
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e5)
    case = Case(pd.Scene(body, pd.Pin(body, [0])), vertices, 0.0 * vertices, 1.0 / 60.0)
    low, high = spectrum_of(prepared(case), case)
    assert low >= 0.3
    assert high <= 1.0 + 1e-9


def test_nothing_free_gives_zero(dtype: torch.dtype) -> None:
    tet = pd.shapes.single_tet(0.1)
    body = pd.Solid(tet, 1e5)
    sim = pd.Simulator(pd.Scene(body, pd.Pin(body, range(4))), solver=pd.Multilevel(), dtype=dtype)
    assert not ops.precondition(torch.ones(1, 4, 3, dtype=dtype), list(sim.plan.arrays)).any()
    after = sim(sim.rest_state())
    assert torch.equal(after.positions, sim.rest_state().positions)


def test_many_bodies_have_functions_of_their_own() -> None:
    """More pieces than the dense level holds: each keeps its node on the middle level."""
    case = many_bodies(300)
    sim = prepared(case)
    assert int(sim.plan.level_sizes[2]) >= 300
    assert 0 < int(sim.plan.level_sizes[5]) <= 256
    low, high = spectrum_of(sim, case)
    assert low >= 0.3
    assert high <= 1.01


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("direct", [False, True])
def test_tables_and_products_have_the_same_bits_on_any_number_of_threads(dtype: torch.dtype, direct: bool) -> None:
    case = swing(5 if direct else 6, 1e6)

    def made() -> pd.Simulator:
        sim = prepared(case, dtype)
        return solved_directly(sim) if direct else sim

    two = made()
    field = noise(two.rest_positions)[None].repeat(3, 1, 1) * torch.tensor([1.0, 2.0, -1.0]).to(dtype)[:, None, None]
    product = ops.precondition(field, list(two.plan.arrays))
    torch.set_num_threads(1)
    one = made()
    assert all(torch.equal(a, b) for a, b in zip(one.plan.arrays, two.plan.arrays, strict=True))
    assert torch.equal(ops.precondition(field, list(one.plan.arrays)), product)
    assert torch.equal(product[1], 2.0 * product[0])
    assert torch.equal(ops.precondition(field[2:], list(one.plan.arrays))[0], product[2])


def test_a_plan_without_it_is_as_before(dtype: torch.dtype) -> None:
    """Another solver costs no bytes, also after a multilevel one."""
    case = beam(1e5)
    sim = simulator(case, dtype)
    arrays = sim.plan.arrays
    assert len(arrays) == len(PLAN_TABLE)
    sim.solver = pd.Multilevel()
    assert has_preconditioner(sim.plan.arrays)
    assert [row.name for row in sim.plan.table] == [row.name for row in PLAN_TABLE + MULTILEVEL_TABLE]
    sim.solver = pd.Chebyshev()
    assert all(one is other for one, other in zip(sim.plan.arrays, arrays, strict=True))


def test_arrays_are_those_of_the_table(dtype: torch.dtype) -> None:
    kinds = {"real": dtype, "int32": torch.int32}
    for case in (swing(3, 1e6), many_bodies()):
        plan = prepared(case, dtype).plan
        for row, array in zip(MULTILEVEL_TABLE, plan.arrays[len(PLAN_TABLE) :], strict=True):
            assert getattr(plan, row.name) is array
            assert array.dtype == kinds[row.type], row.name
            assert array.is_contiguous(), row.name
            assert array.shape[1:] == ((row.width,) if row.width > 1 else ()), row.name
        sizes = plan.level_sizes.tolist()
        assert sizes[0] == len(plan.fine_column) == int(plan.fine_start[-1])
        assert sizes[1] == len(plan.fine_prolongation_node) == int(plan.fine_node_start[-1])
        assert sizes[2] == len(plan.fine_node_start) - 1
        middle = bool(sizes[5])
        assert sizes[3] == len(plan.middle_column)
        assert sizes[4] == len(plan.middle_prolongation_node)
        assert sizes[5] == (len(plan.middle_node_start) - 1 if middle else 0)
        moved = plan.to("meta")
        on_cpu = [row.name for row, array in zip(moved.table, moved.arrays, strict=True) if array.device.type == "cpu"]
        assert on_cpu == ["sizes", "level_sizes"]


def test_reference_is_what_it_was_made_of(dtype: torch.dtype) -> None:
    """The stiffest environment and the largest inertia; held only where all hold."""
    vertices, tets = box((0.3, 0.1, 0.1), (3, 1, 1))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e5)
    sim = pd.Simulator(pd.Scene(body, pd.Pin(body, [0, 1], stiffness=[10.0, 20.0])), dtype=dtype)
    springs = torch.tensor([[torch.inf, torch.inf], [5.0, torch.inf]], dtype=dtype)
    sim.set_material(stiffness=torch.stack([sim.stiffness, 3.0 * sim.stiffness]), pin_stiffness=springs)
    sim.solver = pd.Multilevel()
    assert torch.equal(sim.plan.reference_stiffness, 3.0 * torch.full_like(sim.plan.reference_stiffness, 1e5))
    _, inertia = stored_reference(sim.plan.arrays)
    expected = sim.masses.detach() / sim.time_step**2
    assert float(inertia[0]) == pytest.approx(float(expected[0]) + 5.0, rel=8 * ULP[dtype])
    assert inertia.isinf().tolist() == [number == 1 for number in range(sim.vertices)]
