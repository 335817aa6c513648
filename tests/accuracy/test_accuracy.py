"""Converged steps are converged, of the material that a simulator has now, and errors are what they are called."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import torch
from cases import beam, contact_block, sliver_mesh
from runs import full_scene, moving, simulate, simulator, state_of

import torchpd as pd
from torchpd.accuracy import error as accuracy
from torchpd.accuracy.error import (
    exact_steps,
    frictionless,
    problem_of,
    scene_without_friction,
    settled_steps,
)
from torchpd.baselines.contact_newton import ContactNewton
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.solvers import newton, newton_step, solve_with_contact
from torchpd.study.scenes import STUDY_SCENES


def test_the_first_iterate_has_error_one_and_the_solution_none() -> None:
    case = beam(1e5)
    sim = simulator(case, torch.float64)
    step = exact_steps(sim, state_of(case, sim), start="inertial")[0]
    assert step.errors_of(step.first) == pytest.approx(
        (1.0, 1.0, step.errors_of(step.first).residual, step.errors_of(step.first).metres)
    )
    at_end = step.errors_of(step.solution)
    assert at_end.position == at_end.metres == 0.0
    assert abs(at_end.energy) < 1e-12
    # |grad E| / min a bounds the error; Newton's method ends near rounding, here a condition of 1e5 above it
    assert step.uncertainty < 1e5 * 2.0**-52 * 100
    # halfway along the line, half the error: the definition is linear
    assert step.errors_of(0.5 * (step.first + step.solution)).position == pytest.approx(0.5, rel=1e-12)
    assert np.abs(step.solution - newton(case.problem(), case.problem().first_iterate("inertial"))).max() < 1e-10


def test_a_start_that_is_not_finite_is_infinitely_wrong() -> None:
    case = beam(1e4)
    sim = simulator(case, torch.float64)
    step = exact_steps(sim, state_of(case, sim))[0]
    assert step.errors_of(np.full_like(step.first, np.nan)) == (np.inf,) * 4


def test_uncertainty_bounds_the_error() -> None:
    """|grad E(u)| / min a >= |u - u*| where the elements are stable: for any u near u*, from the gradient alone."""
    case = beam(1e5)
    sim = simulator(case, torch.float64)
    step = exact_steps(sim, state_of(case, sim))[0]
    off = 1e-6 * np.where(step.problem.free[:, None], np.random.default_rng(0).standard_normal(step.first.shape), 0.0)
    bound = np.linalg.norm(step.problem.gradient(step.solution + off)) / step.problem.weight[step.problem.free].min()
    assert bound >= np.linalg.norm(off)


def test_newtons_next_step_is_near_a_minimum_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """There it is the way back, to second order; where the energy curves downwards it says nothing."""
    case = beam(1e5)
    sim = simulator(case, torch.float64)
    step = exact_steps(sim, state_of(case, sim))[0]
    noise = np.where(step.problem.free[:, None], np.random.default_rng(0).standard_normal(step.first.shape), 0.0)
    for size in (1e-4, 1e-5):
        way = newton_step(step.problem, step.solution + size * noise)
        assert way is not None
        assert np.linalg.norm(way + size * noise) <= 0.03 * (size / 1e-4) * np.linalg.norm(size * noise)
    downwards = -scipy.sparse.eye_array(noise.size, format="csr")
    monkeypatch.setattr(
        StepProblem, "hessian", lambda self, u, positive=False: abs(downwards) if positive else downwards
    )
    assert newton_step(step.problem, step.solution + 1e-4 * noise) is None


def test_material_of_every_environment_is_that_of_now() -> None:
    sim = simulate(torch.float64)
    stiffness = sim.stiffness * torch.tensor([[0.5], [1.0], [3.0]], dtype=torch.float64)
    sim.set_material(stiffness=stiffness, damping=2.0)
    state = moving(sim)
    for item in range(3):
        problem = problem_of(sim, state, item)
        assert np.array_equal(problem.values.stiffness, stiffness[item].numpy())
        assert problem.values.damping == 2.0
    steps = exact_steps(sim, state)
    converged = frictionless(sim)
    converged.iterations = 4000
    after = converged(state).velocities * sim.time_step
    for step, u in zip(steps, after.numpy(), strict=True):
        assert step.errors_of(u).position < 1e-9
    alone = exact_steps(sim_of_one(sim, 2), pd.State(*(part[2:3] for part in state)))[0]
    assert np.abs(alone.solution - steps[2].solution).max() < 1e-12


def sim_of_one(sim: pd.Simulator, item: int) -> pd.Simulator:
    """The simulator of one environment."""
    one = simulate(torch.float64)
    one.set_material(stiffness=sim.stiffness[item], damping=sim.damping)
    return one


def test_contacts_are_solved_without_friction() -> None:
    case = contact_block(pd.Ground(0.0, friction=0.7), velocity=(1.0, -1.0, 0.0))
    sim = simulator(case, torch.float64)
    step = exact_steps(sim, state_of(case, sim))[0]
    assert not step.problem.values.planes[:, 4].any()
    assert step.errors_of(step.solution).residual < 1e-10
    assert step.uncertainty < 1e-6
    # it slides: without friction the momentum along the ground is kept
    masses = step.problem.values.masses
    assert masses @ step.solution[:, 0] == pytest.approx(masses.sum() * sim.time_step * 1.0, rel=1e-9)


@pytest.mark.parametrize(("cells", "youngs"), [(8, 1e8), (12, 1e7)])
def test_stiff_beams_are_solved(cells: int, youngs: float) -> None:
    """3,321 and 10,309 vertices, on which 500 iterations of Chebyshev do not halve the residual."""
    studied = STUDY_SCENES["beam"]()
    scene = studied.scene(studied.mesh(cells), youngs)
    sim = pd.Simulator(scene, studied.time_step, 100, pd.Multilevel(), torch.float64, progress=False)
    state = studied.start(sim)
    step = exact_steps(sim, state)[0]
    after, info = sim(state, return_info=True)
    assert float(info.residual) < 1e-12
    # |grad E| / min m/h^2 of a residual of 1e-13 is some 1e-9 here
    assert step.errors_of(after.velocities[0].numpy() * sim.time_step).position < 1e-8
    assert step.uncertainty < 1e-8


def test_stiff_slivers_on_the_ground_are_solved() -> None:
    """Chebyshev creeps on them, and Multilevel is brought back again and again: Newton's method is at home."""
    mesh = sliver_mesh()
    scene = pd.Scene(pd.Solid(mesh, youngs=3e7, density=1000.0), pd.Gravity(), pd.Ground(float(mesh.bounds[0, 1])))
    sim = pd.Simulator(scene, 1 / 60, 1000, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[:] = torch.tensor([0.5, -2.0, 0.0])
    step = exact_steps(sim, state)[0]
    assert step.uncertainty < 1e-8
    assert step.errors_of(step.solution).residual < 1e-10
    assert (step.problem.smallest_gap(step.solution) > -1e-12).all()
    # no method finds a lower energy
    assert step.errors_of(sim(state).velocities[0].numpy() * sim.time_step).energy > 0.0


@pytest.mark.parametrize("kind", ["plane", "ball", "both"])
def test_newtons_method_knows_contacts(kind: str) -> None:
    """It ends at the fixed point of the guarded scheme, where its next step is none."""
    ground, ball = pd.Ground(0.0), pd.Sphere((0.15, -0.2, 0.15), 0.21)
    parts = {"plane": [ground], "ball": [ball], "both": [ground, ball]}[kind]
    problem = contact_block(*parts, velocity=(0.3, -1.0, 0.0)).problem()
    exact = solve_with_contact(problem)
    method = ContactNewton(problem)
    near = problem.project(exact + 1e-5 * np.random.default_rng(0).standard_normal(exact.shape))
    found = method.minimise(near)
    assert np.abs(found - exact).max() < 1e-12
    way, own = method.step(found)
    assert own
    assert np.abs(way).max() < 1e-12
    # three steps: without the curvature of the ball, or with its other sign, they converge linearly, to 3e-4 and 2e-3
    u = near
    for _ in range(3):
        u = u + method.step(u)[0]
    assert np.linalg.norm(u - exact) < 1e-6 * np.linalg.norm(near - exact)


def test_converged_steps_are_to_be_had_in_inference_mode() -> None:
    sim = pd.Simulator(full_scene(), progress=False)
    with torch.inference_mode():
        assert exact_steps(sim, sim.rest_state())[0].uncertainty < 1e-6


def test_friction_is_left_out_of_a_copy() -> None:
    sim = pd.Simulator(full_scene(), progress=False)
    assert float(frictionless(sim).planes[:, 4].sum()) == 0.0
    assert float(sim.planes[:, 4].sum()) > 0.0
    smooth = scene_without_friction(sim.scene)
    assert [ground.friction for ground in smooth.grounds] == [0.0]
    assert [sphere.friction for sphere in smooth.spheres] == [0.0]
    assert len(smooth.parts) == len(sim.scene.parts)


def test_rounding_is_told_from_motion() -> None:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (4, 1, 1))
    sim = pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e5), pd.Gravity()), progress=False)
    falling = exact_steps(sim, sim.rest_state())[0]
    assert not falling.moves(torch.float32)
    turned = sim.rest_state()
    turned.velocities[..., 0] = turned.positions[..., 1]
    step = exact_steps(sim, turned)[0]
    assert step.moves(torch.float32)
    # ten times eps |x|, from an error of one
    slack = 10.0 * 2.0**-23 * np.linalg.norm(step.problem.positions) / step.scale
    assert step.error_beyond_rounding(step.first, torch.float32) == pytest.approx(1.0 - slack, rel=1e-9)
    assert step.error_beyond_rounding(step.solution, torch.float32) == 0.0


def rough_block(friction: float, youngs: float = 1e6) -> tuple[pd.Simulator, pd.State]:
    """Two blocks, on the ground and falling onto it, both pushed along."""
    solid = pd.Solid(pd.shapes.box((0.4, 0.2, 0.2), (6, 3, 3)), youngs)
    scene = pd.Scene(solid, pd.Gravity((3.0, -9.81, 0.0)), pd.Ground(0.0, friction=friction))
    sim = pd.Simulator(scene, 1 / 60, dtype=torch.float64, progress=False, iterations=64)
    state = sim.rest_state(2)
    state.positions[1, :, 1] += 0.01
    state.velocities[..., 0] = 1.0
    state.velocities[1, :, 1] = -2.0
    return sim, state


def test_settled_steps_are_the_fixed_point_of_friction() -> None:
    """By the reference, whose projection has the cone; it holds vertices back by millimetres."""
    sim, state = rough_block(0.8)
    smooth = exact_steps(sim, state)
    for item, step in enumerate(settled_steps(sim, state)):
        x, v = (part[item].numpy() for part in state)
        problem = step_problem(sim.scene.values(), x, v, sim.time_step)
        left, course = (np.linalg.norm(problem.residual(u)) for u in (step.solution, problem.unsolved()))
        assert step.uncertainty < 1e-6
        assert left < 1e-6 * course
        assert np.abs(step.solution - smooth[item].solution).max() > 1e-3


def test_settled_steps_without_friction_are_the_exact_ones() -> None:
    sim, state = rough_block(0.0)
    forces = torch.zeros_like(state.positions)
    forces[1, :, 2] = 0.5
    pairs = zip(
        settled_steps(sim, state, forces=forces, enough=1e-9), exact_steps(sim, state, forces=forces), strict=True
    )
    for settled, exact in pairs:
        assert exact.position_error(settled.solution) <= exact.uncertainty + settled.uncertainty
        assert settled.uncertainty < 1e-8


def test_steps_that_have_no_time_to_settle_are_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    """By about as much as they are wrong."""
    sim, state = rough_block(0.8, youngs=1e5)
    known = settled_steps(sim, state)
    monkeypatch.setattr(accuracy, "_LEADING", 2)
    monkeypatch.setattr(accuracy, "_SETTLING", (4, 8))
    for rough, step in zip(settled_steps(sim, state), known, strict=True):
        wrong = step.position_error(rough.solution)
        assert rough.uncertainty > wrong / 3 > 1e-3
