"""Coarse corrections of bodies in contact: momentum and motion after few iterations, and converged steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, Course, block, crossed, each, folded_sheet, gravity, simulator
from numpy.typing import NDArray

import torchpd as pd

Array = NDArray[np.float64]


def cube(youngs: float, *center: float) -> pd.Solid:
    return pd.Solid(block(0.1, 2, tuple(center)).mesh, youngs=youngs, density=1000.0)  # type: ignore[arg-type]


def flying(youngs: float, friction: float) -> Course:
    """Two free cubes of 1 kg that meet off their middles."""
    bodies = cube(youngs, 0.0, 0.0, 0.0), cube(youngs, 0.12, 0.02, 0.013)
    contact = pd.Contact(friction=friction, thickness=THICKNESS)
    scene = pd.Scene(*bodies, contact, pd.Gravity((0.0, 0.0, 0.0)))
    return Course(scene, each(scene, (1.0, 0.2, 0.0), (-1.0, 0.0, 0.0)))


def tower(youngs: float, count: int) -> Course:
    """Cubes of 10 cm, each a little beside the one below, 1.1 mm apart."""
    bodies = [cube(youngs, 0.004 * (k * 7 % 3 - 1), 0.0505 + 0.1011 * k, 0.004 * (k * 5 % 3 - 1)) for k in range(count)]
    parts = pd.Ground(0.0, friction=0.5), gravity(), pd.Contact(friction=0.5, thickness=THICKNESS)
    return Course(pd.Scene(*bodies, *parts))


@pytest.mark.parametrize("friction", [0.0, 0.5])
@pytest.mark.parametrize("youngs", [1e5, 1e7])
@pytest.mark.parametrize("iterations", [4, 16, 64])
def test_bodies_that_meet_keep_their_momentum(iterations: int, youngs: float, friction: float) -> None:
    """sum m (v' - v) = 0 to rounding, however few the iterations.

    sum m x' x (v' - v) = 0 to what forces at both ends of a gap of 1 mm turn, and to the square of the turn of the last
    correction, at most .05 with 16 iterations and more. Iterations alone lose 5 % of both with 16 iterations.
    """
    course = flying(youngs, friction)
    sim = simulator(course.scene, iterations)
    masses = sim.masses.numpy()[:, None]
    before = course.velocities
    assert before is not None
    scale = float((masses * np.abs(before)).sum())
    met = before
    for state, info in course.steps(sim, 4):
        x, v = state.positions[0].numpy(), state.velocities[0].numpy()
        assert np.abs((masses * (v - before)).sum(axis=0)).max() <= 1e-13 * scale
        if iterations >= 16:
            assert np.abs((masses * np.cross(x, v - before)).sum(axis=0)).max() <= 6e-3 * scale * 0.1
        assert float(info.contact_gap) > 0.099
        before = v
    half = len(before) // 2
    assert np.abs((masses * (before - met))[:half, 0].sum()) > 0.1 * scale  # they did meet


@pytest.mark.parametrize("youngs", [1e5, 1e6])
def test_many_iterations_still_converge(youngs: float) -> None:
    """Corrections leave forces alone that no motion changes: else they would swing, with a residual of .02 to .4."""
    course = tower(youngs, 2)
    sim = simulator(course.scene, 3000)
    for _, info in course.steps(sim, 2):
        assert float(info.residual) < 1e-6
        assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-6)


def test_a_tower_of_stiff_cubes_settles() -> None:
    """With 16 iterations no middle is further than .5 mm from where 1000 lead; without corrections 2.5 mm."""
    course = tower(1e7, 5)
    runs = []
    for iterations in (16, 1000):
        sim = simulator(course.scene, iterations)
        runs.append(torch.stack([state.positions[0] for state, _ in course.steps(sim, 20)]))
    middles = [run.reshape(20, 5, -1, 3).mean(dim=2) for run in runs]
    assert float((middles[0] - middles[1]).norm(dim=2).max()) < 5e-4


def test_corrections_do_not_swing() -> None:
    """A light cloth falls over a ball: a correction every eighth iteration would throw it back for ever, residual 1."""
    mesh = pd.shapes.sheet((0.4, 0.4), (16, 16)).translated((0.0, 0.13, 0.0))
    sheet = pd.Cloth(mesh, 1e5, 1e-3, 0.2, bending=1e-5)
    contact = pd.Contact(friction=0.3, thickness=2e-3)
    sim = simulator(pd.Scene(sheet, pd.Collider(pd.shapes.sphere(0.1)), contact, gravity()), 512, dtype=torch.float32)
    course = Course(sim.scene)
    *_, (_, info) = course.steps(sim, 13)
    assert float(info.residual) < 1e-2
    assert float(info.contact_gap) == pytest.approx(1.0, abs=1e-3)


def test_a_held_body_stays_where_pins_let_go_elsewhere() -> None:
    """A cube lies on one whose pins hold; in another environment they let go. The held one moves as if alone."""
    low, top = cube(1e5, 0.0, 0.05, 0.0), cube(1e5, 0.03, 0.1511, 0.02)
    pin = pd.Pin(low, low.mesh.vertices[:, 1] < 1e-9)
    scene = pd.Scene(low, top, pin, pd.Contact(friction=0.5, thickness=THICKNESS), gravity())
    ends = []
    for batch in (1, 2):
        sim = simulator(scene, 64)
        if batch > 1:
            sim.set_material(pin_hard=torch.tensor([[True], [False]]).expand(2, len(sim.pin_hard)))
        state = sim.rest_state(batch)
        for _ in range(12):
            state, info = sim(state, return_info=True)
        ends.append(state.positions)
        assert float(info.residual[0]) < 5e-3
    alone, beside = ends
    assert float((beside[0] - alone[0]).norm(dim=1).max()) < 1e-5
    assert float((beside[1] - alone[0]).norm(dim=1).max()) > 0.05  # it fell


@pytest.mark.parametrize("iterations", [4, 16])
def test_a_body_that_meets_itself_alone_keeps_its_momentum(iterations: int) -> None:
    """A cloth folds on itself in free flight: sum m (v' - v) = 0 to rounding; iterations alone lose 2 % in a step."""
    at_rest = folded_sheet(self_contact=True, cells=8)
    (sheet,) = at_rest.scene.bodies
    course = Course(pd.Scene(sheet, pd.Contact(thickness=THICKNESS)), at_rest.velocities)
    sim = simulator(course.scene, iterations)
    masses = sim.masses.numpy()[:, None]
    before = course.velocities
    assert before is not None
    scale, most = float((masses * np.abs(before)).sum()), 0.0
    for state, _ in course.steps(sim, 14):
        assert crossed(sim, state) == 0
        v = state.velocities[0].numpy()
        assert np.abs((masses * (v - before)).sum(axis=0)).max() <= 1e-13 * scale
        most = max(most, float(state.history.forces[0, :, 0].sum()))
        before = v
    assert most > 0.0  # it did meet itself
