"""What a step says about itself: energy, residual, iterations, stops."""

from __future__ import annotations

import itertools
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import pytest
import torch
from cases import beam
from runs import displacement, moving, simulate, simulator, state_of, tensor_of

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.solvers import newton, relative_error

pytestmark = pytest.mark.usefixtures("poisoned")


def test_energy_of_a_state(dtype: torch.dtype, device: torch.device) -> None:
    """Weight, motion and springs as they are written down; a translation does not strain."""
    sim = simulate(dtype, device)
    values = sim.scene.values()
    state = sim.rest_state(2)
    lifted = pd.State(state.positions + 0.5, state.velocities + 2.0)
    mass = 1000.0 * 0.4 * 0.2 * 0.2
    weight = mass * 9.81 * (0.1 + 0.5)
    springs = 2 * 0.5 * 1e3 * 3 * 0.5**2
    motion = 0.5 * mass * 12.0
    # 75 terms; strains are a few ulp of 1 m over cells of 0.1 m, squared
    close = {"rel": 200 * torch.finfo(dtype).eps}
    assert sim.energy(lifted.positions).tolist() == pytest.approx([weight + springs] * 2, **close)
    assert sim.energy(lifted).tolist() == pytest.approx([weight + springs + motion] * 2, **close)
    pulled = {sim.scene.pins[1]: tensor_of(values.pin_targets[values.pin_stiffness < np.inf], sim) + 0.5}
    assert sim.energy(lifted, pulled).tolist() == pytest.approx([weight + motion] * 2, **close)


def test_info_has_no_gradient(dtype: torch.dtype, device: torch.device) -> None:
    """The energy of the state that it is of has one."""
    sim = simulate(dtype, device)
    sim.stiffness.requires_grad_()
    after, info = sim(moving(sim), return_info=True)
    assert not any(column.requires_grad for column in info)
    assert bool(torch.autograd.grad(sim.energy(after).sum(), sim.stiffness)[0].any())


def test_info_is_blank_unless_asked_for(dtype: torch.dtype, device: torch.device) -> None:
    sim = simulate(dtype, device)
    state = moving(sim)
    _, info = sim(state, return_info=True)
    assert all(column.shape == (3,) for column in info)
    assert info.iterations.dtype == info.restarts.dtype == torch.int64
    assert info.converged.dtype == torch.bool
    assert bool((info.residual > 0).all() & (info.residual < 1).all())
    quiet = sim.rollout(state, 2).info
    assert bool(quiet.residual.isnan().all() & quiet.energy.isnan().all())
    assert torch.equal(quiet.iterations, torch.full((2, 3), 12, device=device))
    assert torch.equal(quiet.rho, info.rho.expand(2, 3))


@pytest.mark.parametrize(
    "solver", [pd.Chebyshev(), pd.Jacobi(), pd.Multilevel()], ids=["chebyshev", "jacobi", "levels"]
)
def test_what_is_no_number_is_not_solved(dtype: torch.dtype, device: torch.device, solver: pd.Solver) -> None:
    """Neither by its residual nor by its stop; and other environments do not notice."""
    case = beam(1e4)
    sim = simulator(case, dtype, device, iterations=500, tolerance=0.3)
    sim.solver = solver
    rest, vertex = sim.rest_state(3), sim.vertices - 1
    state = pd.State(rest.positions, moving(sim, 3).velocities)
    _, expected = sim(state, return_info=True)
    assert bool(expected.converged.all())
    push = torch.zeros_like(rest.positions)
    push[0, vertex] = torch.nan
    state.positions[1, vertex] = torch.nan
    after, info = sim(state, push, return_info=True)
    assert info.residual.isnan().tolist() == [True, True, False]
    assert after.positions.isfinite().flatten(1).all(1).tolist() == [False, False, True]
    assert not bool(info.converged[:2].any())
    assert torch.equal(info.residual[2], expected.residual[2])
    # squares that overflow are no change of a thousandth
    state.positions[1, vertex] = torch.finfo(dtype).max ** 0.75
    _, info = sim(state, return_info=True)
    assert not bool(info.converged[1])
    assert bool(info.residual[1].isnan())


def test_rho_of_the_guarded_schedule_is_the_bound(dtype: torch.dtype, device: torch.device) -> None:
    case = beam(1e5)
    sim = simulator(case, dtype, device, iterations=1)
    _, info = sim(state_of(case, sim), return_info=True)
    # mu itself rounds, and 1 - theta mu is of order one
    expected = 1.0 - 1.9 * case.problem().smallest_ratio
    assert float(info.rho) == pytest.approx(expected, abs=16 * torch.finfo(dtype).eps)
    sim.solver = pd.Chebyshev(rho=0.5)
    _, info = sim(state_of(case, sim), return_info=True)
    assert float(info.rho) == 0.5


def test_tolerance_stops_each_environment_by_itself(dtype: torch.dtype, device: torch.device) -> None:
    """|u_{k+1} - u_k| <= tolerance theta mu |u_k - s| at the stop, not one iteration before it.

    An iteration of Jacobi leaves at most 1 - theta mu of an error, and changes the rest.
    """
    sim = simulate(dtype, device, iterations=300, tolerance=1e-3, solver=pd.Jacobi(relaxation=1.5))
    state = moving(sim)
    after, info = sim(state, return_info=True)
    assert bool(info.converged.all())
    assert len(info.iterations.unique()) > 1
    sim.tolerance = 0.0
    for item in range(3):
        x, v = (part[item].double().cpu().numpy() for part in state)
        problem = step_problem(sim.scene.values(), x, v, sim.time_step)
        most = 1e-3 * 1.5 * problem.smallest_ratio
        iterates = []
        for sim.iterations in range(int(info.iterations[item]) - 2, int(info.iterations[item]) + 1):
            iterates.append(displacement(sim, sim(state), item))
        fall = sim.time_step**2 * 9.81 * len(x) ** 0.5
        ways = [max(np.linalg.norm(u - problem.target), fall) for u in iterates[:2]]
        changes = [np.linalg.norm(b - a) for a, b in itertools.pairwise(iterates)]
        # of 225 numbers, of which the change is some 1e-4
        slack = 1e4 * torch.finfo(dtype).eps
        assert changes[1] <= most * ways[1] * (1 + slack)
        assert changes[0] > most * ways[0] * (1 - slack)
        assert np.array_equal(iterates[-1], displacement(sim, after, item))


@pytest.mark.parametrize("name", ["stiffness", "masses"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -2e4, -1.0])
@pytest.mark.parametrize(
    "solver", [pd.Chebyshev(), pd.Jacobi(), pd.Multilevel()], ids=["chebyshev", "jacobi", "levels"]
)
def test_wrong_material_is_not_solved(
    dtype: torch.dtype, device: torch.device, solver: pd.Solver, value: float, name: str
) -> None:
    """That an optimiser wrote in place, which no check sees."""
    case = beam(1e4)
    sim = simulator(case, dtype, device, iterations=500, tolerance=0.3)
    sim.solver = solver
    state = moving(sim, 3)
    _, expected = sim(state, return_info=True)
    assert bool(expected.converged.all())
    own = getattr(sim, name).expand(3, -1).clone()
    sim.set_material(**{name: own})
    getattr(sim, name)[1] = value
    _, info = sim(state, return_info=True)
    assert info.residual.isnan().tolist() == [False, True, False]
    assert not bool(info.converged[1])
    assert torch.equal(info.residual[::2], expected.residual[::2])


@pytest.mark.parametrize("name", ["stiffness", "masses", "pin_stiffness"])
@pytest.mark.parametrize("value", [np.nan, -1e5])
@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["chebyshev", "levels"])
def test_one_wrong_number_is_enough(
    dtype: torch.dtype, device: torch.device, solver: pd.Solver, value: float, name: str
) -> None:
    """Of one tetrahedron, vertex or spring, whose neighbours make up for it."""
    sim = simulate(dtype, device, iterations=40, tolerance=1e-2, solver=solver)
    state = moving(sim)
    sim.set_material(pin_stiffness=torch.full_like(sim.pin_stiffness, 1e7))
    assert bool(sim(state, return_info=True)[1].residual.isfinite().all())
    getattr(sim, name)[..., 3] = value
    after, info = sim(state, return_info=True)
    # what is no number shows in positions too, for those who look there
    assert not (np.isnan(value) and bool(after.positions.isfinite().flatten(1).all(1).any()))
    assert bool(info.residual.isnan().all())
    assert not bool(info.converged.any())


@pytest.mark.parametrize(
    ("name", "column"), [("planes", 1), ("planes", 3), ("planes", 4), ("spheres", 0), ("spheres", 3), ("spheres", 4)]
)
@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["chebyshev", "levels"])
def test_contact_that_is_no_number_shows(
    dtype: torch.dtype, device: torch.device, solver: pd.Solver, name: str, column: int
) -> None:
    """Normal, height, centre or radius of one that nothing touches, or friction of one that a body lies on."""
    body = pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2)), youngs=1e4)
    ball = pd.Sphere((0.1, -0.3 if (name, column) == ("spheres", 4) else -2.0, 0.1), 0.3, friction=0.5)
    ground = pd.Ground(height=0.0 if column == 4 and name == "planes" else -1.0, friction=0.5)
    scene = pd.Scene(body, pd.Gravity(), ground, ball)
    sim = pd.Simulator(scene, 1 / 60, 20, solver=solver, dtype=dtype, progress=False).to(device)
    state = sim.rest_state(9)
    _, expected = sim(state, return_info=True)
    assert bool(expected.residual.isfinite().all())
    sim.set_material(**{name: getattr(sim, name).expand(9, -1, -1).clone()})
    getattr(sim, name)[4, 0, column] = torch.nan
    _, info = sim(state, return_info=True)
    assert info.residual.isnan().nonzero().tolist() == [[4]]
    others = [e for e in range(9) if e != 4]
    assert torch.equal(info.residual[others], expected.residual[others])


def test_what_overflows_is_not_still(device: torch.device) -> None:
    """|u - s|^2 beyond the numbers says nothing of a change."""
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.single_tet(), youngs=1e4)), 1.0, 20, dtype=torch.float64)
    sim.tolerance = 1e-3
    state = sim.to(device).rest_state(2)
    state.velocities[0], state.velocities[1, 0] = 1.0, 1e160
    info = sim(state, return_info=True)[1]
    assert int(info.iterations[0]) < 20
    assert int(info.iterations[1]) == 20


def test_tolerance_that_is_not_met_says_so(device: torch.device) -> None:
    sim = simulate(torch.float64, device, iterations=5, tolerance=1e-12)
    _, info = sim(moving(sim), return_info=True)
    assert not bool(info.converged.any())
    assert info.iterations.tolist() == [5, 5, 5]


def test_residual_tells_the_error(device: torch.device) -> None:
    """Both fall together, and at the solution both are rounding."""
    case = beam(1e4)
    problem = case.problem()
    solution, course = newton(problem), problem.first_iterate()
    sim = simulator(case, torch.float64, device)
    seen = []
    for sim.iterations in (5, 20, 60, 400):
        after, info = sim(state_of(case, sim), return_info=True)
        seen.append((float(info.residual), relative_error(displacement(sim, after), solution, course)))
    for (residual, error), (later_residual, later_error) in itertools.pairwise(seen):
        assert later_residual < 0.3 * residual
        assert later_error < 0.3 * error
    assert max(seen[-1]) <= 1e-11
    assert float(info.energy) == pytest.approx(problem.energy(solution), rel=1e-12)


def cube(youngs: float, *parts: pd.scene.Part) -> pd.Scene:
    body = pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (4, 4, 4)), youngs, 1000.0)
    return pd.Scene(body, *parts)


def settled(sim: pd.Simulator, steps: int = 30) -> pd.State:
    """After steps of which every second forgets the velocities."""
    state = sim.rest_state()
    for _ in range(steps):
        state = sim(state)
        state = sim(pd.State(state.positions, torch.zeros_like(state.velocities)))
    return state


SQUEEZE = (pd.Sphere((-0.08, 0.1, 0.1), 0.1, friction=1.0), pd.Sphere((0.28, 0.1, 0.1), 0.1, friction=1.0))


@pytest.mark.parametrize("youngs", [1e5, 1e7, 1e9])
@pytest.mark.parametrize("contacts", [(pd.Ground(friction=0.5),), SQUEEZE], ids=["rest", "grasp"])
def test_what_is_solved_reads_as_solved(
    dtype: torch.dtype, device: torch.device, youngs: float, contacts: tuple[pd.scene.Part, ...]
) -> None:
    """At rest on the ground, and held between two balls by friction: whatever is left is rounding of E x."""
    sim = pd.Simulator(cube(youngs, pd.Gravity(), *contacts), 1 / 60, 500, dtype=dtype, progress=False).to(device)
    state = settled(sim)
    after, info = sim(state, return_info=True)
    # it lies or hangs there: by half a second of steps it would have fallen half a metre
    assert float(after.positions[..., 1].min()) > -0.05
    assert float(after.velocities.abs().max()) < 1e-2
    assert float(info.residual) < 1e-3
    assert int(info.inverted) == 0


@pytest.mark.parametrize("parts", [(), (pd.Gravity(),)], ids=["drift", "fall"])
@pytest.mark.parametrize("youngs", [1e-3, 1e5, 1e9])
def test_what_flies_without_a_force_has_no_residual(
    dtype: torch.dtype, device: torch.device, youngs: float, parts: tuple[pd.scene.Part, ...]
) -> None:
    """However fast: all forces there are come from rounding."""
    sim = pd.Simulator(cube(youngs, *parts), 1 / 60, 20, dtype=dtype, progress=False).to(device)
    state = sim.rest_state()
    state.velocities[:] = torch.tensor([100.0, -3.0, 0.1])
    for _ in range(3):
        state, info = sim(state, return_info=True)
        assert float(info.residual) == 0.0


@pytest.mark.parametrize("youngs", [1e3, 1e5, 1e7, 1e9])
def test_what_is_not_solved_reads_as_that(dtype: torch.dtype, device: torch.device, youngs: float) -> None:
    """A stretched body that is let go, in no iteration: all of its forces are unbalanced."""
    sim = pd.Simulator(cube(youngs), 1 / 60, 0, dtype=dtype, progress=False).to(device)
    state = sim.rest_state()
    state.positions[..., 0] *= 1.1
    _, info = sim(state, return_info=True)
    # less the rounding, of 1e-6 of E x, which a tenth of it is strained
    assert float(info.residual) == pytest.approx(1.0, abs=1e-3)


def test_float32_hides_the_forces_of_something_stiff(dtype: torch.dtype, device: torch.device) -> None:
    """A bar of 100 MPa weighs less than the rounding of E x: float64 alone tells that it is unsolved."""
    mesh = pd.shapes.box((0.5, 0.1, 0.1), (10, 2, 2))
    body = pd.Solid(mesh, 1e8, 1000.0)
    held = pd.Pin(body, np.flatnonzero(mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 1e-6))
    sim = pd.Simulator(pd.Scene(body, held, pd.Gravity()), 1 / 60, 4, dtype=dtype, progress=False).to(device)
    residual = float(sim(sim.rest_state(), return_info=True)[1].residual)
    assert residual == 0.0 if dtype == torch.float32 else residual > 0.5


def test_a_report_changes_nothing_and_is_the_same_in_any_batch(dtype: torch.dtype, device: torch.device) -> None:
    """Of steps, of steps in place, and of the recorded ones of a rollout, whose sphere moves."""
    ball = pd.Sphere((0.1, 0.31, 0.1), 0.1, friction=0.3)
    sim = pd.Simulator(cube(3e4, pd.Gravity(), pd.Ground(friction=0.4), ball), 1 / 60, 12, dtype=dtype, progress=False)
    state = moving(sim.to(device), 9)
    targets = {ball: torch.tensor([0.1, 0.31, 0.1, 0.1, -0.2, 0.0], dtype=dtype, device=device)}
    after, info = sim(state, targets=targets, return_info=True)
    assert torch.equal(sim(state, targets=targets).positions, after.positions)
    alone = sim(pd.State(*(part[4:5] for part in state)), targets=targets, return_info=True)[1]
    assert all(torch.equal(column[4:5], own) for column, own in zip(info, alone, strict=True))
    rows, overwritten = torch.empty(9, 7, dtype=torch.float64, device=device), state.clone()
    sim.step_(overwritten, targets=targets, info=rows)
    assert all(torch.equal(a, b) for a, b in zip(pd.Info.from_rows(rows), info, strict=True))
    every = sim.rollout(state, 7, targets=targets, return_info=True)
    assert torch.equal(sim.rollout(state, 7, targets=targets).positions, every.positions)
    assert all(torch.equal(column[0], own) for column, own in zip(every.info, info, strict=True))
    third = sim.rollout(state, 7, 3, targets=targets, return_info=True)
    assert torch.equal(third.positions, every.positions[2::3])
    assert all(torch.equal(a, b[2::3]) for a, b in zip(third.info, every.info, strict=True))


def says(what: str, device: torch.device) -> AbstractContextManager[object]:
    """On a CPU; a GPU would have to be waited for."""
    return pytest.warns(pd.SceneWarning, match=what) if device.type == "cpu" else nullcontext()


def test_inverted_elements_are_counted(dtype: torch.dtype, device: torch.device) -> None:
    """Those of det F <= 0: none of a body that turns, all of a mirrored one, some where a vertex is pulled through."""
    sim = pd.Simulator(cube(1e3), 1e-6, 0, dtype=dtype, progress=False).to(device)
    state = sim.rest_state(3)
    state.positions[0] = state.positions[0] @ torch.tensor(
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=dtype, device=device
    )
    state.positions[1, :, 0] *= -1.0
    state.positions[2, 0] += 0.15
    with says("384 of 384 tetrahedra of environment 1", device):
        _, info = sim(state, return_info=True)
    x = state.positions[2].double().cpu().numpy()
    edges = x[sim.scene.solids[0].mesh.tets]
    folded = int((np.linalg.det(edges[:, 1:] - edges[:, :1]) <= 0.0).sum())
    assert 0 < folded < len(sim.stiffness)
    assert info.inverted.tolist() == [0, len(sim.stiffness), folded]
    assert info.inverted.dtype == torch.int64
    assert sim.rollout(state, 1).info.inverted.tolist() == [[-1, -1, -1]]


def test_a_soft_body_that_rests_folded_says_so(device: torch.device) -> None:
    """A block of 5 kPa, dropped, lies still and is `converged`: with elements inside out, as many as det F <= 0."""
    mesh = pd.shapes.box((0.3, 0.3, 0.3), (4, 4, 4))
    scene = pd.Scene(pd.Solid(mesh, 5e3, 1000.0), pd.Gravity(), pd.Ground(friction=0.5))
    sim = pd.Simulator(scene, 1 / 60, 200, tolerance=1e-3, progress=False).to(device)
    state = sim.rest_state()
    state.velocities[..., 1] = -2.0
    state = sim.rollout(state, 120, 120).state()
    with says("tetrahedra of environment 0 are inverted", device):
        after, info = sim(state, return_info=True)
    corners = after.positions[0].double().cpu().numpy()[mesh.tets]
    expected = int((np.linalg.det(corners[:, 1:] - corners[:, :1]) <= 0.0).sum())
    assert expected > 0
    assert bool(info.converged)
    assert int(info.inverted) == expected


def test_info_of_before_inversions_were_counted(dtype: torch.dtype, device: torch.device) -> None:
    """Six fields, and rows of six columns: of an unknown number."""
    sim = simulate(dtype, device)
    _, info = sim(moving(sim), return_info=True)
    assert int(pd.Info(*info[:6]).inverted) == -1
    rows = torch.stack([column.double() for column in info[:6]], dim=-1)
    old = pd.Info.from_rows(rows)
    assert all(torch.equal(a, b) for a, b in zip(old[:6], info[:6], strict=True))
    assert old.inverted.tolist() == [-1, -1, -1]
    with pytest.raises(ValueError, match=r"info .*got Double \[3, 6\]"):
        sim.step_(moving(sim), info=rows)


def test_columns_of_contact() -> None:
    """13 columns of a step with `Contact`; files of before lack the last three."""
    rows = torch.arange(13.0, dtype=torch.float64)[None] + 0.25
    info = pd.Info.from_rows(rows)
    assert float(info.residual) == 0.25
    assert [float(info.contact_gap), float(info.held_back)] == [7.25, 9.25]
    assert [int(info.inverted), int(info.contact_overflow)] == [6, 8]
    assert [int(info.contact_pairs), int(info.contact_searches), int(info.contact_frozen)] == [10, 11, 12]
    old = pd.Info.from_rows(rows[:, :10])
    assert all(torch.equal(one, other) for one, other in zip(old[:10], info[:10], strict=True))
    assert [int(count) for count in old[10:]] == [0, 0, 0]
