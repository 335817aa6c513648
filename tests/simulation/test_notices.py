"""What a simulator says once of scenes and states that are hardly meant."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from torch._dynamo.testing import CompileCounterWithBackend

import torchpd as pd
from torchpd.geometry.overlaps import find_overlaps

BOX = pd.shapes.box((0.2, 0.2, 0.2), (3, 3, 3))


def at(x: float, y: float = 0.0, size: float = 1.0) -> pd.TetMesh:
    """The box, scaled, its lower corner at (x, y, y)."""
    matrix = np.diag([size, size, size, 1.0])
    matrix[:3, 3] = x, y, y
    return BOX.transformed(matrix)


@contextmanager
def silent() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.SceneWarning)
        yield


def two(first: pd.TetMesh, second: pd.TetMesh) -> pd.Scene:
    return pd.Scene(pd.Solid(first, 1e5, 1000.0), pd.Solid(second, 1e5, 1000.0))


@pytest.mark.parametrize(
    ("other", "overlap"),
    [
        (at(0.19), True),
        (at(0.0), True),  # the same place
        (at(0.05, 0.05, 0.1), True),  # inside
        (at(-0.2, -0.2, 3.0), True),  # around
        (at(0.2), False),  # face to face
        (at(0.21), False),
    ],
)
def test_bodies_that_overlap_at_rest(other: pd.TetMesh, overlap: bool) -> None:
    assert bool(find_overlaps([BOX, other], [BOX.vertices, other.vertices])) == overlap
    if not overlap:
        with silent():
            pd.Simulator(two(BOX, other), 1 / 60, 4, progress=False)
        return
    with pytest.warns(pd.SceneWarning, match=r"bodies 0 and 1 .*overlap at rest"):
        pd.Simulator(two(BOX, other), 1 / 60, 4, progress=False)


def test_boxes_around_bodies_may_overlap() -> None:
    """Of a long bar askew and a cube beside its middle."""
    bar = pd.shapes.box((1.0, 0.05, 0.05), (20, 1, 1))
    turned = np.eye(4)
    turned[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    turned[:3, 3] = -0.4, 0.2, 0.0
    other = bar.transformed(turned)
    assert find_overlaps([BOX, other], [BOX.vertices, other.vertices]) == []


def test_bodies_that_meet() -> None:
    """Said at a step that reports, once, of the environment where it is."""
    sim = pd.Simulator(two(BOX, at(0.3)), 1 / 60, 10, progress=False)
    state = sim.rest_state(2)
    state.velocities[1, : len(BOX.vertices), 0] = 3.0
    with silent():
        for _ in range(3):
            sim.step_(state)
        pd.Simulator(sim.scene, 1 / 60, 10, progress=False).rollout(sim.rest_state(2), 3, return_info=True)
    with pytest.warns(pd.SceneWarning, match=r"overlap .*environment 1 .*end of a step"):
        state, _ = sim(state, return_info=True)
    with silent():
        sim(state, return_info=True)


GROUND = pd.Ground(height=0.05)


def on_ground(ground: pd.scene.Part = GROUND) -> pd.Simulator:
    return pd.Simulator(pd.Scene(pd.Solid(BOX, 1e5, 1000.0), pd.Gravity(), ground), 1 / 60, 20, progress=False)


def test_a_start_inside_a_contact_is_said_with_its_depth() -> None:
    """16 of 64 vertices, 0.05 m deep, which leave at 3 m/s; once, and not of copies, which studies make."""
    sim = on_ground()
    with silent():
        copy.deepcopy(sim)(sim.rest_state())
        copy.copy(sim)(sim.rest_state())
    with pytest.warns(pd.SceneWarning, match=r"16 vertices of environment 0 .* up to 0\.05 m deep.* about 3 m/s"):
        after = sim(sim.rest_state())
    # the speed that is named
    assert float(after.velocities[..., 1].max()) == pytest.approx(3.0, rel=0.1)
    with silent():
        sim(sim.rest_state())


@pytest.mark.parametrize("how", ["step_", "rollout", "report"])
def test_every_way_to_step_looks(how: str) -> None:
    sim = on_ground()
    rest, lifted = sim.rest_state(), sim.rest_state()
    lifted.positions[..., 1] += 0.05
    if how == "report":  # a later step that reports is looked at as the first one is
        sim(lifted)
    ways = {
        "step_": lambda: sim.step_(rest),
        "rollout": lambda: sim.rollout(rest, 2),
        "report": lambda: sim(rest, return_info=True),
    }
    with pytest.warns(pd.SceneWarning, match="start a step inside"):
        ways[how]()


def test_what_contacts_do_themselves_is_not_said() -> None:
    """Rest on the ground; a ball that moves into a body; a pinned vertex below the ground."""
    with silent():
        sim = on_ground(pd.Ground(0.0, friction=0.5))
        sim.rollout(sim.rest_state(3), 20, return_info=True)
        ball = pd.Sphere((0.1, 0.31, 0.1), 0.1)
        pressed = on_ground(ball)
        place = torch.tensor([0.1, 0.28, 0.1, 0.0, -1.8, 0.0])
        pressed(pressed.rest_state(), targets={ball: place}, return_info=True)
        body = pd.Solid(BOX, 1e5, 1000.0)
        low = np.flatnonzero(BOX.vertices[:, 1] < 0.01)
        held = pd.Simulator(pd.Scene(body, pd.Pin(body, low), GROUND), 1 / 60, 20, progress=False)
        held(held.rest_state(), return_info=True)


def test_what_is_said_compiles_nothing_anew() -> None:
    sim, compiled = on_ground(), CompileCounterWithBackend("eager")
    step = torch.compile(lambda state: sim(state, return_info=True)[0].positions, backend=compiled)
    step(sim.rest_state())
    with pytest.warns(pd.SceneWarning, match="start a step inside"):
        sim(sim.rest_state(), return_info=True)
    step(sim.rest_state())
    assert compiled.frame_count == 1


def test_inverted_elements_are_said_once() -> None:
    sim = pd.Simulator(pd.Scene(pd.Solid(BOX, 1e3, 1000.0)), 1 / 60, 0, progress=False)
    mirrored = sim.rest_state(2)
    mirrored.positions[1, :, 0] *= -1.0
    with silent():
        sim(mirrored)
    with pytest.warns(pd.SceneWarning, match=r"162 of 162 tetrahedra of environment 1"):
        sim(mirrored, return_info=True)
    with silent():
        sim(mirrored, return_info=True)
        pickle.loads(pickle.dumps(sim))(mirrored, return_info=True)
