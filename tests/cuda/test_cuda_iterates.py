"""Every kernel computes the iterates of the reference and of the CPU: any mesh, effect, solver and precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pytest
import torch
from cases import Array, Case, box, cone_mesh, slivers
from device_plans import delaunay_mesh
from devices import require_gpu
from environments import different_environments
from environments import scene as scene_of_all_effects
from iterate_cases import CASES as SAME_CASES
from iterate_cases import RESTARTS, SOLVERS, in_a_corner, restarting, stirred
from numpy.typing import NDArray
from on_gpu import DTYPES, GPU, KERNELS, bar, crowd, full_on_gpu, moved, on_gpu, relative, rounding_of
from runs import (
    ULP,
    arguments_of,
    displacement,
    ended_by_rounding,
    first_of,
    moving,
    reference_run,
    residual_error,
    rounded_problem,
    simulate,
    simulator,
    state_of,
    taken_off,
)

import torchpd as pd
from torchpd.plan import kernel_choice as regimes
from torchpd.reference import StepProblem
from torchpd.reference.solvers import Iterates
from torchpd.scene.pins import hold_exactly

require_gpu()
pytestmark = pytest.mark.usefixtures("poisoned")

# Of an iterate, relative to its largest displacement; in float32 up to MOST, see `tolerance_of`, where rounding alone
# comes near: in bodies that move by a hundredth of their distance, in a thin strip, at a vertex of 3200 tetrahedra.
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
MOST = {torch.float64: 1e-12, torch.float32: 2e-5}
COUNTS = (1, 2, 5, 6, 9, 20)


def graded() -> Case:
    """Cells that grow by 1.4 from one end to the other, 20 times in all: weights of very different sizes."""
    vertices, tets = box((9.0, 0.2, 0.2), (9, 3, 3))
    vertices[:, 0] = 0.02 * (1.4 ** vertices[:, 0] - 1.0) / 0.4
    body = pd.Solid(pd.TetMesh(vertices, tets), 10.0 ** np.linspace(4.0, 6.0, len(tets)))
    scene = pd.Scene(body, pd.Pin(body, vertices[:, 0] == 0.0), pd.Gravity())
    # moving on the scale of the bar: float32 rounds its positions of 1 m whatever the size of a cell
    velocities = np.outer(-6.0 * vertices[:, 0] ** 2, [0.0, 1.0, 0.0])
    return stirred(Case(scene, vertices, velocities, 1.0 / 60.0), size=0.001)


def on_ground(case: Case, height: float) -> Case:
    """The same with a ground."""
    return replace(case, scene=pd.Scene(*case.scene.parts, pd.Ground(height, friction=0.5)))


def irregular(mesh: pd.TetMesh) -> Case:
    """Of random stiffness, held at x = 0; every vertex is moved by a twentieth of its shortest edge.

    Without elements of less than 0.003 of a regular one's volume: an ulp of x turns those by 1e-4 and more.
    """
    ends = mesh.tets[:, list(combinations(range(4), 2))]
    lengths = np.linalg.norm(mesh.vertices[ends[..., 1]] - mesh.vertices[ends[..., 0]], axis=2)
    edges = mesh.vertices[mesh.tets[:, 1:]] - mesh.vertices[mesh.tets[:, :1]]
    sound = np.linalg.det(edges) > 0.003 * lengths.max(axis=1) ** 3 / 2.0**0.5
    shortest = np.full(len(mesh.vertices), np.inf)
    np.minimum.at(shortest, ends[sound], lengths[sound, :, None])
    rng = np.random.default_rng(0)
    body = pd.Solid(pd.TetMesh(mesh.vertices, mesh.tets[sound]), 10.0 ** rng.uniform(4.0, 6.0, int(sound.sum())))
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] < 0.02), pd.Gravity())
    shift = 0.05 * shortest[:, None] * rng.standard_normal(mesh.vertices.shape)
    velocities = np.outer(mesh.vertices[:, 0] ** 2, [0.0, -3.0, 0.0]) + 30.0 * shift
    return Case(scene, mesh.vertices + shift, velocities, 1.0 / 60.0)


def deformed(scales: tuple[float, float, float], noise: tuple[float, float, float]) -> Case:
    """A free bar whose elements all have nearly the singular values `scales`."""
    case = bar((5, 2, 2), pd.Gravity(), pinned=False, youngs=2e4)
    shift = np.random.default_rng(3).standard_normal(case.positions.shape) * noise
    return Case(case.scene, case.positions * scales + shift, 0.0 * case.positions, case.time_step)


def one_tetrahedron() -> Case:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    body = pd.Solid(pd.TetMesh(vertices, [[0, 1, 2, 3]]), 1e4)
    return stirred(Case(pd.Scene(body, pd.Gravity()), vertices, 0.0 * vertices, 1.0 / 60.0), size=0.03)


def cones(points: int = 1602) -> Case:
    """A ball whose tetrahedra, 3200 unless told otherwise, all share its centre, and so do all patches."""
    mesh = cone_mesh(points)
    body = pd.Solid(mesh, 1e5)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] < -0.15), pd.Gravity())
    velocities = np.outer(mesh.vertices[:, 0], [0.0, -3.0, 0.0])
    return stirred(Case(scene, mesh.vertices, velocities, 1.0 / 60.0), size=0.001)


def strip() -> Case:
    """1100 tetrahedra in a row, coiled up, each has a side of the next: as many slots in one patch of a stream."""
    turn, rise, radius = np.arccos(-2.0 / 3.0), 1e-2 / np.sqrt(10.0), 0.08  # Boerdijk's helix, edges of 1 cm
    number = np.arange(1103)
    out, up = 3e-3 * np.sqrt(3.0) * np.array([np.cos(turn * number), -np.sin(turn * number)])
    along = rise * number / radius
    vertices = np.stack([(radius + out) * np.cos(along), (radius + out) * np.sin(along), up + 0.004 * along], 1)
    body = pd.Solid(pd.TetMesh(vertices, number[:-3, None] + np.arange(4)), 1e4)
    scene = pd.Scene(body, pd.Pin(body, number < 3), pd.Gravity())
    return stirred(Case(scene, vertices, 0.0 * vertices, 1.0 / 60.0), size=0.001)


# more than a block or a cluster holds, in float64
LARGE = ("several patches, ground and pieces", "cones")
CASES: dict[str, Callable[[], Case]] = {
    **SAME_CASES,
    "exact beam, shortened": lambda: bar((12, 3, 3), pd.Gravity(), youngs=1e6),
    "slivers": slivers,
    "slivers, ground": lambda: on_ground(slivers(), -0.1),
    "Delaunay": lambda: irregular(delaunay_mesh()),
    "Delaunay, ground": lambda: on_ground(irregular(delaunay_mesh()), 0.01),
    "strip": strip,
    "graded": graded,
    "inverted": lambda: deformed((1.0, -0.5, 0.9), (0.004, 0.004, 0.004)),
    "flat": lambda: deformed((1.0, 0.0, 0.9), (0.004, 0.0, 0.004)),
    "one tetrahedron": one_tetrahedron,
    "crowd": crowd,
    "cones": cones,
    "few cones": lambda: cones(200),
    "few cones, ground": lambda: on_ground(cones(200), -0.19),
    "small patches, ground and pieces": lambda: stirred(
        bar((8, 5, 5), pd.Ground(-0.01, friction=0.5), pd.Gravity(), pinned=False), size=0.002
    ),
    "several patches, ground and pieces": lambda: stirred(
        bar((24, 5, 5), pd.Ground(-0.01, friction=0.5), pd.Gravity(), pinned=False), size=0.002
    ),
}


# of RESTARTS; the second for the kernel "far"
RESTARTING = {"restarting": restarting, "restarting, large": lambda: restarting((25, 4, 4), 20.0, 0.015)}
ALL_SOLVERS: dict[str, pd.Jacobi | pd.Chebyshev] = {**SOLVERS, "restarting": RESTARTS}


@cache
def problem_of(name: str, dtype: torch.dtype) -> tuple[Case, StepProblem]:
    case = {**CASES, **RESTARTING}[name]()
    return case, rounded_problem(case, dtype)


@cache
def first_iterate(name: str, dtype: torch.dtype, solver: str) -> Array:
    case, problem = problem_of(name, dtype)
    return first_of(problem, case, ALL_SOLVERS[solver])


@cache
def reference(name: str, dtype: torch.dtype, solver: str, iterations: int) -> Iterates:
    _, problem = problem_of(name, dtype)
    return reference_run(problem, first_iterate(name, dtype, solver), ALL_SOLVERS[solver], iterations)


@dataclass(frozen=True, kw_only=True)
class Rounded(StepProblem):
    """The problem with what float32 has to round in an iteration: x + u, as seen from a vertex, forces and their sums.

    The errors of the CPU are of this size in every case: they are the case's own, no kernel's.
    """

    origin: int  # vertex
    order: NDArray[np.int64]  # in which tetrahedra add their forces

    def evaluate(self, displacement: Array) -> tuple[float, Array]:
        from_origin = self.positions - self.positions[self.origin]
        seen = (from_origin + displacement).astype(np.float32) - from_origin
        (tets,) = self.groups
        stress = tets.law.evaluate(tets.deformation(seen))[1]
        forces = np.einsum("eij,eaj->eai", stress, tets.stencils.gradients).astype(np.float32)
        sums = np.zeros(displacement.shape, np.float32)
        np.add.at(sums, self.values.tets[self.order], forces[self.order])
        pull = self.weight[:, None] * (displacement - self.target)
        return self.energy(displacement), np.where(self.free[:, None], pull + sums, 0.0)

    def energy(self, displacement: Array) -> float:
        return super().evaluate(displacement)[0]


@cache
def rounded_ways(name: str) -> list[Rounded]:
    """With three vertices and orders."""
    _, problem = problem_of(name, torch.float32)
    rng = np.random.default_rng(0)
    own = {field.name: getattr(problem, field.name) for field in fields(problem)}
    vertices, tets = len(problem.positions), len(problem.values.tets)
    return [Rounded(**own, origin=int(rng.integers(vertices)), order=rng.permutation(tets)) for _ in range(3)]


@cache
def tolerance_of(name: str, dtype: torch.dtype, solver: str, iterations: int) -> float:
    """Twice what rounding alone does to an iterate, but neither less than TOLERANCE nor more than MOST."""
    if TOLERANCE[dtype] == MOST[dtype]:
        return TOLERANCE[dtype]
    expected = reference(name, dtype, solver, iterations).displacement
    first = first_iterate(name, dtype, solver)
    found = [reference_run(way, first, ALL_SOLVERS[solver], iterations).displacement for way in rounded_ways(name)]
    rounded = 2.0 * float(np.abs(np.subtract(found, expected)).max() / np.abs(expected).max())
    return min(max(TOLERANCE[dtype], rounded), MOST[dtype])


class Errors(NamedTuple):
    """Of what a step gives, relative to what it is to give."""

    displacement: float
    energy: float
    residual: float
    position: float  # of the sum x + u [ulp]
    counted: bool  # as many iterations and restarts


def errors_of(sim: pd.Simulator, name: str, solver: str, batch: int) -> Errors:
    """The last of some equal environments."""
    case, problem = problem_of(name, sim.dtype)
    expected = reference(name, sim.dtype, solver, sim.iterations)
    after, info = sim(state_of(case, sim, batch), **arguments_of(case, sim, batch), return_info=True)
    u, item = displacement(sim, after, batch - 1), batch - 1
    x = after.positions[item].double().cpu().numpy()
    energy = problem.energy(expected.displacement)
    counted = int(info.iterations[item]) == sim.iterations and int(info.restarts[item]) == len(expected.restarts)
    return Errors(
        float(np.abs(u - expected.displacement).max() / np.abs(expected.displacement).max()),
        abs(float(info.energy[item]) / energy - 1.0),
        residual_error(problem, expected, float(info.residual[item]), sim.dtype),
        float(np.abs(x - problem.positions - u).max() / (ULP[sim.dtype] * np.abs(x).max())),
        counted,
    )


def check(sim: pd.Simulator, name: str, solver: str, counts: Sequence[int] = COUNTS) -> None:
    for sim.iterations in counts:
        # the lanes of a cluster add up in an order that Rounded does not try
        clustered = sim.plan.kernel == "cluster"
        tolerance = MOST[sim.dtype] if clustered else tolerance_of(name, sim.dtype, solver, sim.iterations)
        expected = reference(name, sim.dtype, solver, sim.iterations).displacement
        ended = ended_by_rounding(problem_of(name, sim.dtype)[1], expected)
        tolerance = max(tolerance, ended)
        for batch in (1, 5):
            errors = errors_of(sim, name, solver, batch)
            assert errors.displacement <= tolerance, (sim.iterations, batch)
            assert errors.position <= 4.0  # one more rounding
            assert errors.counted
            # sums of squares, which the iterate moves by its own relative error; |r| is 1e-3 of its start or more
            assert errors.energy <= 4 * tolerance
            assert errors.residual <= 1e3 * max(MOST[sim.dtype], ended)


def why_not(name: str, kernel: str, precision: str) -> str:
    """Why a kernel does not run a case; empty where it does."""
    if name in LARGE and kernel in ("block", "cluster"):
        return "for kernels with any number of patches: more than a block or a cluster holds"
    if name == "strip" and kernel != "stream" and (kernel, precision) != ("cluster", "float32"):
        return "for patches with more slots than a pipeline counts, and with four lanes of a cluster for many vertices"
    if kernel == "far" and (name not in LARGE or (name, precision) == ("cones", "float64")):
        return "for patches with several tetrahedra a thread that fit the shared memory of a block"
    return ""


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_iterates_are_those_of_the_reference(name: str, kernel: str, precision: str) -> None:
    if reason := why_not(name, kernel, precision):
        pytest.skip(reason)
    case, _ = problem_of(name, DTYPES[precision])
    sim = on_gpu(case, DTYPES[precision], kernel)
    assert sim.plan.size("most_slots") > 1024 or (name, kernel, precision) != ("strip", "stream", "float32")
    assert sim.plan.patches > 1 or not name.startswith("several patches")
    if name == "cones" and kernel == "grid":
        assert int(sim.plan.slot_sender[:, 7].max()) > 0  # more patches have a vertex than a row of senders holds
    check(sim, name, "guarded")


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("name", LARGE)
@pytest.mark.parametrize("solver", SOLVERS)
def test_iterates_of_large_patches(name: str, solver: str, precision: str) -> None:
    """A thread has several of their elements; forces that others wait for go out before the last of them."""
    if reason := why_not(name, "far", precision):
        pytest.skip(reason)
    case, _ = problem_of(name, DTYPES[precision])
    sim = on_gpu(case, DTYPES[precision], "far", solver=SOLVERS[solver])
    assert (sim.plan.patch_pairs > 512).all()
    if name != "cones":
        assert (sim.plan.patch_outer < 300).any()  # less than what threads there are have in one round
    check(sim, name, solver)


def test_iterates_of_patches_with_many_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread has five pairs of tetrahedra and more; in float64 no such patch fits the shared memory of a block."""
    monkeypatch.setattr(regimes, "_MIN_GRID_TETS", 4000)
    case = bar((30, 10, 10), pd.Gravity())
    sim = simulator(case, torch.float32, GPU, kernel="grid", iterations=12)
    assert (sim.plan.patch_pairs > 5 * 384).all()
    plain = simulator(case, torch.float64, iterations=12)
    state = state_of(case, sim, 3)
    after, info = sim(state, return_info=True)
    expected, facts = plain(moved(state, "cpu", torch.float64), return_info=True)
    assert relative(after.velocities, expected.velocities) <= 2 * TOLERANCE[torch.float32]
    rounding = taken_off(case.problem(), displacement(plain, expected), torch.float32)
    assert info.residual.cpu() == pytest.approx(facts.residual, rel=1e3 * TOLERANCE[torch.float32], abs=rounding)


@pytest.mark.parametrize("precision", DTYPES)
def test_large_patches_stop_as_the_cpu_does(precision: str) -> None:
    dtype = DTYPES[precision]
    case = CASES["several patches, ground and pieces"]()
    sim = on_gpu(case, dtype, "far", iterations=40, tolerance=0.1)
    plain = simulator(case, torch.float64, iterations=40, tolerance=0.1)
    state = state_of(case, sim, 3)
    after, info = sim(state, return_info=True)
    expected, facts = plain(moved(state, "cpu", torch.float64), return_info=True)
    assert 1 < int(info.iterations[0]) < 40
    assert torch.equal(info.iterations.cpu(), facts.iterations)
    assert relative(after.velocities, expected.velocities) <= 2 * TOLERANCE[dtype]


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("contacts", [False, True], ids=["free", "contacts"])
@pytest.mark.parametrize("cells", [(3, 3, 3), (15, 3, 3), (7, 5, 5), (9, 9, 9)], ids=["64", "256", "288", "1000"])
def test_blocks_with_room_for_none_all_or_some_of_their_arrays(
    cells: tuple[int, int, int], contacts: bool, precision: str
) -> None:
    """Of what iterations ask for besides u, in shared memory; from a warp to all threads of a multiprocessor."""
    dtype = DTYPES[precision]
    if cells == (9, 9, 9) and precision == "float64":
        pytest.skip("more than the shared memory of a block")
    case = bar(cells, pd.Gravity(), *([pd.Ground(-0.05)] if contacts else []))
    sim = on_gpu(case, dtype, "block", iterations=12)
    plain = simulator(case, torch.float64, iterations=12)
    state = state_of(case, sim, 3)
    after, info = sim(state, return_info=True)
    expected, facts = plain(moved(state, "cpu", torch.float64), return_info=True)
    assert relative(after.velocities, expected.velocities) <= 2 * TOLERANCE[dtype]
    rounding = taken_off(case.problem(), displacement(plain, expected), dtype)
    assert info.residual.cpu() == pytest.approx(facts.residual, rel=1e3 * TOLERANCE[dtype], abs=rounding)
    alone = sim(pd.State(*(part[:1] for part in state)))
    assert torch.equal(alone.positions, after.positions[:1])


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("solver", sorted(set(SOLVERS) - {"guarded"}))
@pytest.mark.parametrize("name", ["pins, inertial start", "given start", "corner"])
def test_every_schedule_and_start(name: str, solver: str, kernel: str, precision: str) -> None:
    case, _ = problem_of(name, DTYPES[precision])
    check(on_gpu(case, DTYPES[precision], kernel, solver=SOLVERS[solver]), name, solver)


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", [*KERNELS, "far"])
def test_a_restart_counts_from_the_second_next_iteration(kernel: str, precision: str) -> None:
    """However early or late blocks tell each other of their energies: with a tolerance they do it otherwise."""
    dtype, name = DTYPES[precision], "restarting, large" if kernel == "far" else "restarting"
    case, *_ = problem_of(name, dtype)
    for tolerance in (0.0, 1e-30):
        sim = on_gpu(case, dtype, kernel, solver=RESTARTS, tolerance=tolerance)
        check(sim, name, "restarting", range(16, 21))
    assert reference(name, dtype, "restarting", 20).restarts == [16]


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("start", ["velocity", "inertial", "given"])
def test_any_number_of_iterations_is_that_of_the_cpu(start: str, kernel: str, precision: str) -> None:
    dtype = DTYPES[precision]
    case = in_a_corner()
    sim, plain = on_gpu(case, dtype, kernel), simulator(case, torch.float64)
    state = state_of(case, sim, 2)
    exact = moved(state, "cpu", torch.float64)

    def start_of(state: pd.State) -> torch.Tensor | str:
        return state.positions + 0.01 if start == "given" else start

    for count in range(10):
        sim.iterations = plain.iterations = count
        after, info = sim(state, start=start_of(state), return_info=True)
        expected, facts = plain(exact, start=start_of(exact), return_info=True)
        rounding = rounding_of(lambda state: plain(state, start=start_of(state)).velocities, state_of(case, plain))
        assert relative(after.velocities, expected.velocities) <= max(2 * MOST[dtype], 2 * rounding), count
        assert torch.equal(info.iterations.cpu(), facts.iterations)
        assert torch.equal(info.restarts.cpu(), facts.restarts)
        # twice the error of the iterate, for E is quadratic
        rounding = rounding_of(
            lambda state: plain(state, start=start_of(state), return_info=True)[1].energy, state_of(case, plain)
        )
        assert relative(info.energy, facts.energy) <= max(8 * TOLERANCE[dtype], 2 * rounding), count
        assert relative(info.rho, facts.rho) <= 16 * torch.finfo(dtype).eps


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", KERNELS)
def test_material_of_each_environment(kernel: str, precision: str) -> None:
    dtype, batch = DTYPES[precision], 5
    case = scene_of_all_effects()
    sim, plain = on_gpu(case, dtype, kernel, iterations=12), simulator(case, torch.float64, iterations=12)
    factor = torch.linspace(0.5, 2.0, batch, dtype=dtype)
    shift = torch.arange(3 * batch, dtype=dtype).reshape(batch, 3) * 0.01
    own = {name: getattr(sim, name).detach().cpu() for name in sim.state_dict()}
    varied = {
        "stiffness": own["stiffness"] * factor[:, None],
        "masses": own["masses"] * factor.flip(0)[:, None],
        "gravity": own["gravity"] + shift,
        "damping": own["damping"] * factor,
        "pin_stiffness": hold_exactly(own["pin_stiffness"] * factor[:, None], own["pin_hard"]),
        "pin_targets": own["pin_targets"] + shift[:, None],
        "planes": own["planes"] + factor[:, None, None] * torch.tensor([0, 0, 0, 0.01, 0.1]).to(dtype),
        "spheres": own["spheres"] + factor[:, None, None] * torch.tensor([0.01, 0, 0, 0.02, 0.1, 0.5, 0, 0]).to(dtype),
    }
    state, forces = different_environments(sim, batch)
    exact = moved(state, "cpu", torch.float64), forces.cpu().double()
    alike = plain(*exact).velocities
    for chosen in (*([name] for name in varied), list(varied)):  # one at a time, then all together
        for one in (sim, plain):
            one.set_material(**own)
            one.set_material(**{name: varied[name] for name in chosen})
        expected = plain(*exact).velocities
        assert relative(sim(state, forces).velocities, expected) <= 2 * TOLERANCE[dtype], chosen
        # control: every environment but that of shift 0 feels it, by more than float32 may be wrong
        assert felt(expected, alike).sum() >= batch - 1, chosen


def felt(velocities: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Which environments move in another way [B]."""
    difference = (velocities - others).abs().amax(dim=(-2, -1))
    return difference > 4 * TOLERANCE[torch.float32] * others.abs().max()


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("solver", [pd.Jacobi(), pd.Chebyshev(), pd.Chebyshev("classic", rho=0.97, delay=3)])
def test_tolerance_stops_where_the_cpu_stops(solver: pd.Jacobi | pd.Chebyshev, kernel: str) -> None:
    options = {"iterations": 300, "tolerance": 1e-3, "solver": solver}
    sim, plain = full_on_gpu(torch.float64, kernel, **options), simulate(torch.float64, **options)
    state = moving(plain, 9)
    after, info = sim(moved(state, GPU), return_info=True)
    expected, facts = plain(state, return_info=True)
    if isinstance(solver, pd.Jacobi):
        assert len(facts.iterations.unique()) > 1
    for name in ("iterations", "restarts", "converged"):
        assert torch.equal(getattr(info, name).cpu(), getattr(facts, name)), name
    assert relative(after.velocities, expected.velocities) <= TOLERANCE[torch.float64] * 10  # 100 iterations and more


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", KERNELS)
def test_moving_sphere_of_a_rollout(kernel: str, precision: str) -> None:
    """The sphere goes on by itself within a launch, and as on the CPU."""
    dtype = DTYPES[precision]
    sim, plain = full_on_gpu(dtype, kernel), simulate(torch.float64)
    (ball,), (twin,) = sim.scene.spheres, plain.scene.spheres
    row = torch.tensor([0.4, -0.24, 0.1, 0.3, 0.2, 0.0], dtype=dtype)
    state = moving(sim, 3)
    track = sim.rollout(state, 4, targets={ball: row.to(GPU)})
    expected = plain.rollout(moved(state, "cpu", torch.float64), 4, targets={twin: row.double()})
    # four steps, each of which passes on what the one before has rounded
    assert relative(track.velocities, expected.velocities) <= 8 * TOLERANCE[dtype]
    still = plain.rollout(moved(state, "cpu", torch.float64), 4)
    assert relative(still.velocities, expected.velocities) > 1e-3
