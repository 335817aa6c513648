"""The multilevel solver on a GPU does what it does on the CPU, however many blocks share an environment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import Case, beam, contact_block, on_sphere, slivers
from devices import require_gpu
from multilevel_cases import build_levels, irregular, landing, many_bodies, precondition, swing
from on_gpu import GPU, device_work, host_waits, moved, relative, rounding_of
from runs import arguments_of, noise, same_bits, simulator, small, state_of
from scipy.sparse import csr_array

import torchpd as pd
from torchpd.common.tables import MULTILEVEL_TABLE
from torchpd.plan import preconditioner as multilevel
from torchpd.plan.preconditioner import precondition_plan, stored_reference

require_gpu()

pytestmark = pytest.mark.usefixtures("poisoned")

SOLVERS = {outer: pd.Multilevel(outer) for outer in ("lbfgs", "momentum")}
# one block; several; a middle level; pieces; contacts of every kind; Poisson's ratio
CASES: dict[str, Callable[[], Case]] = {
    "slivers": slivers,
    "beam": lambda: beam(1e6),
    "box": lambda: swing(13, 1e6),
    "octopus": irregular,
    "bodies": many_bodies,
    "ground": lambda: contact_block(pd.Ground(), velocity=(0.0, -1.0, 0.0), youngs=1e6, cells=4),
    "sphere": lambda: on_sphere(0.3),
    "sliding": lambda: contact_block(pd.Ground(friction=0.5), velocity=(1.0, -1.0, 0.0), youngs=1e6, cells=4),
    "landing": lambda: landing(1e6),
    "rough landing": lambda: landing(1e5, friction=0.5),
    "rubber": lambda: swing(5, 1e6, poisson=0.4, averaging=4),
}


@pytest.fixture(params=[1024, 0], ids=["direct", "levels"])
def most_direct(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small meshes as they are solved on a GPU, and by the levels that larger ones have."""
    monkeypatch.setattr(multilevel, "MOST_DIRECT", request.param)


def reordered(levels: dict[str, np.ndarray], place: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays of a preconditioner whose vertex i is to stand at place[i]."""
    out = dict(levels)
    for name in ("reference_inertia", "fine_inverse", "piece_of", "piece_weight"):
        out[name] = np.empty_like(levels[name])
        out[name][place] = levels[name]

    def moved_rows(start: np.ndarray, column: np.ndarray, count: int, columns: np.ndarray) -> csr_array:
        """Where each entry stood, by its new row and column."""
        rows = np.repeat(place, np.diff(start))
        return csr_array((np.arange(len(column)), (rows, columns[column])), shape=(len(place), count))

    matrix = moved_rows(levels["fine_start"], levels["fine_column"], len(place), place)
    out["fine_start"], out["fine_column"] = matrix.indptr, matrix.indices
    out["fine_value"] = levels["fine_value"][matrix.data]
    nodes = int(levels["level_sizes"][2])
    lift = moved_rows(levels["fine_prolongation_start"], levels["fine_prolongation_node"], nodes, np.arange(nodes))
    lift.sort_indices()
    out["fine_prolongation_start"], out["fine_prolongation_node"] = lift.indptr, lift.indices
    out["fine_prolongation_weight"] = levels["fine_prolongation_weight"][lift.data]
    by_node = csr_array((np.arange(lift.nnz), lift.indices, lift.indptr), shape=lift.shape).tocsc()
    out["fine_node_row"], out["fine_node_prolongation"] = by_node.indices, by_node.data
    return out


def pair(case: Case, dtype: torch.dtype, solver: pd.Multilevel, **options: object) -> tuple[pd.Simulator, pd.Simulator]:
    """On the CPU and on a GPU, with the same M: where vertices stand decides which of several equals are taken."""
    cpu, gpu = (simulator(case, dtype, device, solver=solver, **options) for device in ("cpu", GPU))
    if isinstance(solver, pd.Multilevel):
        share(gpu, cpu)
    return cpu, gpu


def share(gpu: pd.Simulator, cpu: pd.Simulator) -> None:
    """Gives a simulator on the CPU the preconditioner of one on a GPU; rows of a direct one are its own."""
    place = np.argsort(cpu.plan.vertex_order.numpy())[gpu.plan.vertex_order.cpu().numpy()]
    if gpu.plan.level_sizes[6]:
        reference = (array.cpu() for array in stored_reference(gpu.plan.arrays))
        cpu.plan = precondition_plan(cpu.plan, cpu.scene.values(), *reference, most_direct=multilevel.MOST_DIRECT)
        arrays = {"level_sizes": cpu.plan.level_sizes.numpy().copy()}
        arrays["level_sizes"][multilevel._PIECES] = gpu.plan.level_sizes[multilevel._PIECES]
        for name in ("piece_of", "piece_weight"):
            found = getattr(gpu.plan, name).cpu().numpy()
            arrays[name] = np.empty_like(found)
            arrays[name][place] = found
    else:
        arrays = reordered(build_levels(gpu, folded=False), place)
    arrays |= multilevel._pack_tets(cpu.plan, arrays)
    kept = cpu.plan.arrays[: -len(MULTILEVEL_TABLE)]
    own = cpu.plan.arrays[-len(MULTILEVEL_TABLE) :]
    new = (torch.as_tensor(arrays.get(row.name, t)).to(t.dtype) for row, t in zip(MULTILEVEL_TABLE, own, strict=True))
    cpu.plan = replace(cpu.plan, arrays=(*kept, *new))


def displacements(sim: pd.Simulator, case: Case, state: pd.State) -> torch.Tensor:
    return sim(state, **arguments_of(case, sim, len(state.positions))).positions - sim.rest_positions


@pytest.mark.usefixtures("most_direct")
@pytest.mark.parametrize("name", ["slivers", "beam", "box", "bodies"])
def test_preconditioner_is_that_of_the_cpu(name: str, dtype: torch.dtype) -> None:
    cpu, gpu = pair(CASES[name](), dtype, pd.Multilevel())
    field = noise(cpu.rest_positions).double().numpy()
    given = torch.tensor(np.stack([field, -2.0 * field]), dtype=dtype, device=GPU)
    found = torch.ops.torchpd.precondition(given, list(gpu.plan.arrays))
    # as in test_multilevel.py, but for the sums' order
    assert relative(found[0], torch.tensor(precondition(cpu, field))) <= (1e-9 if dtype == torch.float64 else 1e-2)
    assert torch.equal(-2.0 * found[0], found[1])


@pytest.mark.usefixtures("most_direct")
@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize("name", CASES)
def test_iterates_are_those_of_the_cpu(name: str, outer: str) -> None:
    case = CASES[name]()
    sims = pair(case, torch.float64, SOLVERS[outer], iterations=20 if "landing" in name else 8)
    after = [sim(state_of(case, sim, 2), return_info=True, **arguments_of(case, sim, 2)) for sim in sims]
    (cpu, expected), (gpu, info) = after
    # rounding grows with every iteration
    bound = max(1e-8, 2 * rounding_of(partial(displacements, sims[0], case), state_of(case, sims[0])))
    assert relative(gpu.positions - sims[1].rest_positions, cpu.positions - sims[0].rest_positions) <= bound
    for field in ("iterations", "restarts", "converged"):
        assert torch.equal(getattr(info, field).cpu(), getattr(expected, field)), field
    assert relative(info.energy, expected.energy) <= bound
    assert relative(info.rho, expected.rho) <= 1e-9


@pytest.mark.usefixtures("most_direct")
@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize("name", ["beam", "octopus", "ground", "rubber"])
def test_float32_comes_as_near_as_on_the_cpu(name: str, outer: str) -> None:
    """Its floor is that of the scene: 4e-4 on the octopus, whose stiffness is random over two decades.

    In 600 iterations of momentum rubber comes to 4e-4 in float64, with a restart that float32 does not need: both are
    on their way. In 1200 it comes to 1e-6, below the floor.
    """
    case = CASES[name]()
    iterations = 1200 if outer == "momentum" else 120
    exact = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=120)  # to 1e-10 everywhere
    end = exact(state_of(case, exact), **arguments_of(case, exact)).velocities
    errors = [
        relative(sim(state_of(case, sim), **arguments_of(case, sim)).velocities, end)
        for sim in pair(case, torch.float32, SOLVERS[outer], iterations=iterations)
    ]
    assert errors[1] <= max(4 * errors[0], 1e-4)
    assert errors[0] <= 1e-3


@pytest.mark.usefixtures("most_direct")
@pytest.mark.parametrize("outer", SOLVERS)
def test_material_that_it_was_not_made_for(outer: str) -> None:
    """Stiffness of each environment, springs that it takes for strangers, and pins that came since."""
    case = beam(1e6)
    body = case.scene.solids[0]
    scene = pd.Scene(body, pd.Pin(body, np.arange(36), stiffness=1.0), pd.Gravity((0.0, -9.8, 0.0)))
    case = Case(scene, case.positions, case.velocities, case.time_step, start="inertial")
    ends, rho = [], []
    for sim in pair(case, torch.float64, SOLVERS[outer], iterations=8):
        factor = torch.tensor([[1.0], [0.1], [3.0]], dtype=torch.float64, device=sim.device)
        springs = torch.tensor([[1.0], [1e6], [float("inf")]], dtype=torch.float64, device=sim.device)
        springs = springs.expand(3, len(sim.pin_stiffness)).contiguous()
        arrays = {"stiffness": factor * sim.stiffness, "masses": (1.0 + factor) * sim.masses, "pin_stiffness": springs}
        for name, value in arrays.items():  # behind its back: set_material would make M anew
            setattr(sim, name, torch.nn.Parameter(value, requires_grad=False))
        after, info = sim(state_of(case, sim, 3), start="inertial", return_info=True)
        ends.append(after.velocities)
        rho.append(info.rho)
    assert relative(ends[1], ends[0]) <= 1e-7
    assert relative(rho[1], rho[0]) <= 1e-9


@pytest.mark.usefixtures("most_direct")
@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize(
    "name", ["slivers", "beam", "ground", "sphere", "sliding", "landing", "rough landing", "rubber"]
)
def test_an_environment_does_not_know_of_the_others(name: str, outer: str, dtype: torch.dtype) -> None:
    """Alone by many blocks, in a batch by fewer, and among more than run at once."""
    case = CASES[name]()
    sim = simulator(case, dtype, GPU, solver=SOLVERS[outer], iterations=48 if "landing" in name else 6)
    factor = torch.linspace(0.5, 1.5, 4096, dtype=dtype, device=GPU)[:, None, None]
    state = state_of(case, sim, 4096)
    state = pd.State(state.positions, factor * state.velocities)
    together = sim(state)
    assert same_bits(together, sim(state))
    for first, last in ((0, 1), (7, 12), (299, 300), (2047, 2048), (4095, 4096)):
        few = sim(pd.State(state.positions[first:last], state.velocities[first:last]))
        assert same_bits(few, pd.State(together.positions[first:last], together.velocities[first:last]))
    assert not torch.equal(together.velocities[0], together.velocities[1])


def test_landings_that_a_tolerance_ends_have_the_same_bits_alone_and_in_a_batch() -> None:
    case = landing(1e6)
    sim = simulator(case, torch.float32, GPU, solver=pd.Multilevel(), iterations=96, tolerance=1e-3)
    factor = torch.linspace(0.5, 1.5, 64, device=GPU)[:, None, None]
    state = state_of(case, sim, 64)
    state = pd.State(state.positions, factor * state.velocities)
    together, info = sim(state, return_info=True)
    assert len(set(info.iterations.tolist())) > 4
    for i in (0, 13, 63):
        alone = sim(pd.State(state.positions[i : i + 1], state.velocities[i : i + 1]))
        assert same_bits(alone, pd.State(together.positions[i : i + 1], together.velocities[i : i + 1]))


@pytest.mark.parametrize("cells", [13, 17])
def test_large_meshes_have_the_same_bits_alone_and_in_a_batch(cells: int) -> None:
    """With a middle level; 17 cells have so many vertices that warps add up theirs together."""
    case = swing(cells, 1e6)
    sim = simulator(case, torch.float32, GPU, solver=pd.Multilevel(), iterations=4)
    assert int(sim.plan.level_sizes[5]) > 0
    assert (sim.vertices > 640 * 32) == (cells == 17)
    state = state_of(case, sim, 3)
    together = sim(state)
    assert same_bits(together, sim(state))
    alone = sim(pd.State(state.positions[1:2], state.velocities[1:2]))
    assert same_bits(alone, pd.State(together.positions[1:2], together.velocities[1:2]))


def test_contacts_of_a_large_mesh_have_the_same_bits_alone_and_in_a_batch() -> None:
    """Chunks of more than 64 vertices, several of them held."""
    case = contact_block(pd.Ground(friction=0.5), velocity=(1.0, -1.0, 0.0), youngs=1e6, cells=20)
    sim = simulator(case, torch.float32, GPU, solver=pd.Multilevel(), iterations=8)
    assert sim.vertices > 64 * 128
    state = state_of(case, sim, 3)
    together = sim(state)
    assert same_bits(together, sim(state))
    alone = sim(pd.State(state.positions[1:2], state.velocities[1:2]))
    assert same_bits(alone, pd.State(together.positions[1:2], together.velocities[1:2]))


def test_rollout_is_its_steps_and_a_recording_too() -> None:
    sim, start = small(torch.float32, GPU, solver=pd.Multilevel(), tolerance=1e-3, iterations=20)
    track = sim.rollout(start, 3)
    own = pd.State(*(t.clone() for t in start))
    step = sim.capture(own)
    state = start
    for number in range(3):
        state = sim(state)
        step.replay()
        assert same_bits(own, state)
        assert torch.equal(track.positions[number], state.positions)
    assert not host_waits(lambda: sim(start))
    assert not host_waits(step.replay)
    # one launch for all iterations
    names = device_work(lambda: sim(start))
    assert sum("multilevel_kernel" in name for name in names) == 1


@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize(("batch", "cells", "patches", "direct"), [(1024, 7, 2, 0), (1, 5, 2, 1)])
def test_plans_for_many_and_for_few_environments(outer: str, batch: int, cells: int, patches: int, direct: int) -> None:
    """Other patches, for many levels in place of a direct solve: iterates of the CPU, the same bits in any batch."""
    case = contact_block(pd.Ground(), velocity=(0.0, -1.0, 0.0), youngs=1e6, cells=cells)
    usual = simulator(case, torch.float64, GPU, solver=SOLVERS[outer])
    cpu, gpu = pair(case, torch.float64, SOLVERS[outer], iterations=8, batch=batch)
    assert usual.plan.patches != gpu.plan.patches == patches
    assert int(gpu.plan.level_sizes[6]) == direct
    assert gpu.plan.many == (batch == 1024)
    state = state_of(case, gpu, 5)
    factor = torch.linspace(0.5, 1.5, 5, dtype=torch.float64, device=GPU)[:, None, None]
    state = pd.State(state.positions, factor * state.velocities)
    together = gpu(state)
    state, run = moved(state, "cpu"), partial(displacements, cpu, case)
    bound = max(1e-8, 2 * rounding_of(run, state))
    assert relative(together.positions - gpu.rest_positions, run(state)) <= bound
    state = moved(state, GPU)
    one = gpu(pd.State(state.positions[3:4], state.velocities[3:4]))
    assert same_bits(one, pd.State(together.positions[3:4], together.velocities[3:4]))
    # another solver and back
    gpu.solver = pd.Chebyshev()
    assert not gpu.plan.many
    gpu.solver = SOLVERS[outer]
    assert same_bits(gpu(state), together)
    # and another batch and back
    gpu.batch = None
    assert gpu.plan.patches == usual.plan.patches
    gpu.batch = batch
    assert same_bits(gpu(state), together)


def test_solvers_can_be_exchanged() -> None:
    sim, start = small(torch.float64, GPU)
    plain = sim(start)
    sim.solver = pd.Multilevel()
    assert sim.plan.for_multilevel
    text = str(sim)
    assert "preconditioner: " in text
    assert "all iterations in one launch" in text
    first = sim(start)
    assert not same_bits(first, plain)
    sim.set_material(stiffness=2.0 * sim.stiffness)
    sim.prepare_solver()
    sim.set_material(stiffness=0.5 * sim.stiffness)
    sim.prepare_solver()
    assert same_bits(sim(start), first)
    sim.solver = pd.Chebyshev()
    assert not sim.plan.for_multilevel
    assert same_bits(sim(start), plain)
    sim_with_levels, _ = small(torch.float64, GPU, solver=pd.Multilevel())
    block, _ = small(torch.float64, GPU, kernel="block")
    with pytest.raises(ValueError, match=r"kernel .*'block'"):
        block.solver = pd.Multilevel()
    assert block.solver == pd.Chebyshev()
    levels = sim_with_levels.plan.arrays[-len(MULTILEVEL_TABLE) :]
    numbers = {**block.step_settings(inertial=False, report=False), **pd.Multilevel().settings()}
    with pytest.raises(ValueError, match="plan must be one for kernel 3"):
        torch.ops.torchpd.step(*start, None, None, block.material(), [*block.plan.arrays, *levels], **numbers)


def test_newton_is_refused() -> None:
    """By the simulator, and by the op."""
    sim, start = small(torch.float64, GPU, solver=pd.Multilevel())
    with pytest.raises(RuntimeError, match=r"device must be the CPU for Newton.*cuda"):
        sim.solver = pd.Newton()
    numbers = {**sim.step_settings(inertial=False, report=False), **pd.Newton().settings()}
    with pytest.raises(ValueError, match=r"schedule must be 0 .* on a GPU, got 5 \(newton\)"):
        torch.ops.torchpd.step(*start, None, None, sim.material(), list(sim.plan.arrays), **numbers)


@pytest.mark.usefixtures("most_direct")
def test_gradients_are_those_of_the_cpu() -> None:
    case = contact_block(pd.Ground(), velocity=(0.3, -1.0, 0.0))
    found = []
    for sim in pair(case, torch.float64, pd.Multilevel(), iterations=200):
        sim.stiffness.requires_grad_()
        state = state_of(case, sim, 2)
        state.velocities.requires_grad_()
        sim(state).positions.square().sum().backward()
        found.append((state.velocities.grad, sim.stiffness.grad))
    for cpu, gpu in zip(*found, strict=True):
        assert relative(gpu, cpu) <= 1e-7


@pytest.mark.usefixtures("most_direct")
@pytest.mark.parametrize("name", ["sliding", "box", "rubber"])
def test_gradients_of_any_solver_may_have_the_preconditioner(name: str) -> None:
    """Those of the CPU without it; the same bits alone and in a batch; the step's bits stay."""
    case = CASES[name]()
    options = {"iterations": 60 if name == "box" else 1000, "solver": pd.Chebyshev()}
    cpu = simulator(case, torch.float64, "cpu", **options)
    sim, plain = (
        simulator(case, torch.float64, GPU, kernel="stream", adjoint=adjoint, **options)
        for adjoint in ("multilevel", "solver")
    )
    start = state_of(case, sim, 3)
    factor = torch.linspace(0.5, 1.5, 3, dtype=torch.float64, device=GPU)[:, None, None]
    state = pd.State(start.positions, factor * start.velocities)
    assert same_bits(sim(state), plain(state))

    def gradient(sim: pd.Simulator, state: pd.State) -> torch.Tensor:
        velocities = state.velocities.clone().requires_grad_()
        after = sim(pd.State(state.positions, velocities)).positions
        return torch.autograd.grad((after - sim.rest_positions).square().sum(), velocities)[0]

    found = gradient(sim, state)
    assert relative(found, gradient(plain, state)) <= 1e-7
    assert relative(found, gradient(cpu, pd.State(*(part.cpu() for part in state)))) <= 1e-7
    for e in range(3):
        assert torch.equal(gradient(sim, pd.State(*(part[e : e + 1] for part in state)))[0], found[e])


def test_there_and_back_and_through_a_file(tmp_path: Path) -> None:
    """Inertia and stiffness that it was made of go along, in the order of the user's vertices."""
    cpu, start = small(torch.float64, solver=pd.Multilevel("momentum"))
    cpu.set_material(stiffness=3.0 * cpu.stiffness)
    cpu.prepare_solver()
    expected = cpu(start)
    gpu = pd.Simulator.load(_saved(cpu, tmp_path / "cpu")).to(GPU)
    twin = pd.Simulator.load(tmp_path / "cpu")
    share(gpu, twin)

    def run(state: pd.State) -> torch.Tensor:
        return twin(state).velocities

    assert relative(gpu(moved(start, GPU)).velocities, run(start)) <= max(1e-9, 2 * rounding_of(run, start))
    back = pd.Simulator.load(_saved(gpu, tmp_path / "gpu"))
    assert same_bits(back(start), expected)
    assert same_bits(gpu.to("cpu")(start), expected)
    text = str(gpu.float().to(GPU))
    assert "float32" in text


def _saved(sim: pd.Simulator, path: Path) -> Path:
    sim.save(path)
    return path
