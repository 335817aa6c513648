"""One step against solutions that another method found, its balances, and what it does without contact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from contact_scenes import ContactCase, H, block, each, falling, free_hit, slope, two_cubes
from programs import ROOT

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.contact import ContactScene, contact_scene, contact_step
from torchpd.reference.solvers import guarded_chebyshev


def known(name: str) -> tuple[ContactScene, dict[str, Any]]:
    """Two bodies of 48 tetrahedra that meet, and the solution of the same step in the metric of A."""
    with np.load(ROOT / "tests" / "fixtures" / f"{name}.npz") as data:
        given = dict(data)
    body, tets, bodies = given["body"], given["tets"], []
    for number in (0, 1):
        own = body[tets[:, 0]] == number
        mesh = pd.TetMesh(given["rest"][body == number], tets[own] - np.flatnonzero(body == number)[0])
        bodies.append(pd.Solid(mesh, youngs=given["youngs"][own], density=1000.0))
    scene = pd.Scene(*bodies, pd.Gravity((0.0, 0.0, 0.0)))
    assert np.allclose(scene.values().masses, given["masses"], rtol=1e-12)
    return contact_scene(scene, thickness=float(given["thickness"])), given


def test_the_solution_of_another_method() -> None:
    """The fixed point is that of the problem alone: places to 1e-9 m, forces to 1e-6 N of those in the metric of A.

    Forces are pairwise equal and opposite. So momentum stays; and angular momentum does, as implicit Euler has it:
    sum m x' x (v' - v) = 0.
    """
    scene, given = known("hit_28_contacts")
    total = 31.2749565
    x, v = torch.tensor(given["positions"]), torch.tensor(given["velocities"])
    step = contact_step(scene, x, v, float(given["time_step"]), iterations=1500)
    scale = np.abs(given["contact_forces"]).max()
    assert np.abs(step.positions.numpy() - given["solution"]).max() <= 1e-9
    assert np.abs(step.forces.numpy() - given["contact_forces"]).max() <= 1e-6 * scale
    assert float(step.contacts.held.normal.sum()) == pytest.approx(total, abs=5e-6)
    assert float(step.forces.sum(dim=0).abs().max()) <= 1e-14 * total
    assert step.frozen == 0
    masses = torch.tensor(given["masses"])[:, None]
    gained = masses * (step.velocities - v)
    size = float((masses * v).norm(dim=1).sum())
    assert float(gained.sum(dim=0).abs().max()) <= 1e-9 * size
    turned = torch.linalg.cross(step.positions, gained).sum(dim=0)
    arm = float((step.positions - step.positions.mean(dim=0)).norm(dim=1).max())
    assert float(turned.abs().max()) <= 1e-9 * size * arm


def far_apart(**options: Any) -> ContactCase:
    """Two cubes that fall side by side, .1 m apart, and quiver."""
    scene = falling(block(0.1, 3), block(0.1, 3, center=(0.2, 0.0, 0.0)))
    velocities = each(scene, (0.0, -30.0, 0.0), (0.0, -30.0, 0.0))
    velocities = velocities + 0.1 * np.random.default_rng(0).standard_normal(velocities.shape)
    return ContactCase(contact_scene(scene, thickness=1e-3, **options), velocities)


@pytest.mark.parametrize("iterations", [3, 40])
def test_bodies_that_meet_nothing(iterations: int) -> None:
    """One search a step, no pairs of two bodies, and the iterates of the scene without contact to rounding."""
    case = far_apart()
    x = torch.tensor(case.scene.values.rest_positions)
    step = contact_step(case.scene, x, torch.tensor(case.velocities), H, iterations=iterations)
    problem = step_problem(case.scene.values, x.numpy(), case.velocities, H)
    alone = guarded_chebyshev(problem, problem.unsolved(), iterations=iterations, tolerance=0.0)
    assert step.searches <= 1 + iterations // 5
    assert step.pairs == 0
    assert np.abs(step.positions.numpy() - x.numpy() - alone.displacement).max() <= 1e-14
    assert alone.iterations == iterations


def test_the_first_iterate_reaches_the_inertial_guess() -> None:
    """A pinned sheet that falls at 3 m/s over cells of 25 mm: balls of a quarter of a cell are no limit of speed."""
    from contact_scenes import sheet_body

    cloth = sheet_body((0.2, 0.2), (8, 8), lambda p: p)
    scene = falling(cloth, pd.Pin(cloth, [0]))
    velocities = each(scene, (0.0, -3.0, 0.0)) * (cloth.mesh.vertices[:, :1] * 5.0)
    case = ContactCase(contact_scene(scene, thickness=1e-3), velocities)
    first = []
    next(case.steps(1, 0, observe=lambda k, x: first.append(x)))
    expected = case.scene.surfaces.rest + H * torch.tensor(velocities)
    expected[0] = case.scene.surfaces.rest[0]
    assert float((first[0] - expected).abs().max()) <= 1e-15


def test_bodies_in_contact_that_fall_together_keep_their_speed() -> None:
    """Two cubes r apart, one above the other, at 10 m/s: nothing hinders them, whatever the iterations."""
    scene = falling(block(0.1, 2), block(0.1, 2, center=(0.0, 0.101, 0.0)), g=0.0)
    case = ContactCase(contact_scene(scene, thickness=1e-3), each(scene, *[(1.0, -10.0, 0.0)] * 2))
    for step in case.steps(3, 2):
        assert torch.allclose(step.velocities, torch.tensor(case.velocities), atol=1e-9)


def test_a_step_depends_on_its_state_alone() -> None:
    """5 steps, then 4 from the history are 9; a cold start is another state."""
    case = slope(20.0, 0.5)
    whole = list(case.steps(9, 16))
    fifth = whole[4]
    x, v, history = fifth.positions, fifth.velocities, fifth.history
    for expected in whole[5:]:
        step = contact_step(case.scene, x, v, H, history=history, iterations=16)
        x, v, history = step.positions, step.velocities, step.history
        assert torch.equal(x, expected.positions)
        assert torch.equal(v, expected.velocities)
    cold = contact_step(case.scene, fifth.positions, fifth.velocities, H, iterations=16)
    assert not torch.equal(cold.positions, whole[5].positions)


def test_the_hit_of_two_cubes_keeps_momentum_pairwise() -> None:
    """Contact forces add up to zero in every unfinished step, too."""
    for step in free_hit(2).steps(4, 8):
        assert float(step.forces.sum(dim=0).abs().max()) <= 1e-13 * float(step.forces.abs().max().clamp(min=1e-9))


def test_the_state_is_not_changed_in_place() -> None:
    case = two_cubes(2)
    x = torch.tensor(case.scene.values.rest_positions)
    kept = x.clone()
    step = contact_step(case.scene, x, torch.tensor(case.velocities), H, iterations=8)
    again = contact_step(case.scene, x, torch.tensor(case.velocities), H, iterations=8)
    assert torch.equal(x, kept)
    assert torch.equal(step.positions, again.positions)
