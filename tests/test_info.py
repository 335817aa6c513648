"""What a step says about itself: energy, residual, iterations, stops."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from cases import beam
from runs import displacement, moving, simulate, simulator, state_of, tensor_of

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference_solvers import newton, relative_error

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
