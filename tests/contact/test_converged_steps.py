"""Bodies that tip, land and roll: coarse corrections leave a step that the iterations have solved where it is."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from cases import Case, Still, box, leaning, rotation
from runs import simulator, state_of

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference.solvers import guarded_chebyshev

pytestmark = pytest.mark.usefixtures("poisoned")

H = 1 / 60


# of a cube of 0.1 m: turned by an angle [rad], friction, Young's modulus, cells an edge, steps
TUMBLES = [
    pytest.param(0.3, 0.1, 1e6, 2, 1, id="slides and turns"),
    pytest.param(0.3, 0.3, 1e5, 2, 6, id="turns while it slides back"),
    pytest.param(0.5, 0.3, 1e7, 2, 3, id="sticks at one end of its edge"),
    pytest.param(0.7, 0.1, 1e5, 3, 4, id="an edge of four vertices"),
    pytest.param(np.pi / 4, 0.1, 1e6, 2, 3, id="stands on its edge"),
    pytest.param(0.7, 0.0, 1e5, 2, 3, id="smooth ground"),
]


def check_that_converged_steps_stay(case: Case, steps: int, device: torch.device) -> None:
    """After a rigid motion that moves what the iterations have solved there is a residual."""
    sim = simulator(case, torch.float64, device, iterations=600, solver=pd.Multilevel())
    state = state_of(case, sim)
    for _ in range(steps):
        problem = step_problem(
            case.scene.values(), state.positions[0].cpu().numpy(), state.velocities[0].cpu().numpy(), H
        )
        state = sim(state)
        u = H * state.velocities[0].cpu().numpy()
        scale = float(np.linalg.norm(problem.residual(problem.unsolved())))
        assert np.linalg.norm(problem.residual(u)) <= 1e-8 * scale
        assert np.abs(problem.align(u) - u).max() <= 1e-12


@pytest.mark.parametrize(("angle", "friction", "youngs", "cells", "steps"), TUMBLES)
def test_landings_on_an_edge_stay(
    angle: float, friction: float, youngs: float, cells: int, steps: int, device: torch.device
) -> None:
    """A cube lands on an edge: of its steps rigid motions left up to 14 % of the residual, at any iteration count."""
    case = leaning(
        friction, turn=(0.0, 0.0, float(np.degrees(angle))), size=(0.1, 0.1, 0.1), cells=(cells,) * 3,
        velocity=(0.0, -1.0, 0.0), youngs=youngs,
    )  # fmt: skip
    check_that_converged_steps_stay(case, steps, device)


def leaning_tower() -> Case:
    """Its middle is above the base, near that edge which few of its vertices are at; it hits the ground hard."""
    vertices, tets = box((0.1, 0.4, 0.1), (4, 4, 1))
    vertices[:, 0] = 0.1 * (vertices[:, 0] / 0.1) ** 0.25
    masses = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e7)).values().masses
    middle = masses @ vertices / masses.sum()
    vertices[:, 0] -= (middle[0] - 0.01) * vertices[:, 1] / middle[1]
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e7), pd.Gravity(), pd.Ground(0.0))
    return Case(scene, vertices, 0.0 * vertices - [0.0, 10.0, 0.0], H)


def uneven_block() -> Case:
    """A box whose vertices are shaken, which slides and turns on rough ground once it has landed."""
    rng = np.random.default_rng(18)
    size = np.array([0.2, 0.1, 0.1])
    vertices, tets = box(tuple(size), (2, 2, 2))
    vertices = (vertices + rng.uniform(-0.125, 0.125, vertices.shape) * size) @ rotation(79.3, 0.4, -44.9).T
    vertices[:, 1] -= vertices[:, 1].min()
    scene = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e6), pd.Gravity(), pd.Ground(-0.005, friction=0.3))
    return Case(scene, vertices, 0.0 * vertices - [0.0, 1.0, 0.0], H)


@pytest.mark.parametrize(("case", "steps"), [(leaning_tower(), 1), (uneven_block(), 2)], ids=["smooth", "rough"])
def test_a_balance_uphill_is_none_to_go_to(case: Case, steps: int, device: torch.device) -> None:
    """About a line of two vertices torques balance a second time, with more energy: there rigid motions took them."""
    check_that_converged_steps_stay(case, steps, device)


def rolling() -> Case:
    vertices, tets = box((0.2, 0.2, 0.2), (3, 3, 3))
    vertices = vertices - vertices.mean(axis=0)
    # every layer of the cube as a sphere
    lengths = np.linalg.norm(vertices, axis=1, keepdims=True)
    vertices *= np.abs(vertices).max(axis=1, keepdims=True) / np.maximum(lengths, 1e-9)
    vertices = vertices @ rotation(5.0, 17.0, 8.0).T
    vertices[:, 1] -= vertices[:, 1].min()
    scene = pd.Scene(
        pd.Solid(pd.TetMesh(vertices, tets), 1e5), pd.Gravity((3.0, -9.8, 0.0)), pd.Ground(0.0, friction=0.5)
    )
    return Case(scene, vertices, 0.0 * vertices, H)


@pytest.mark.parametrize(
    "case",
    [
        leaning(0.8, youngs=1e5), leaning(0.0, youngs=1e5), leaning(0.1, velocity=(1.0, 0.0, 0.5), youngs=1e5),
        leaning(1.0, turn=(0.0, 0.0, 0.0), size=(0.1, 0.4, 0.1), cells=(2, 8, 2), gravity=(6.0, -9.8, 0.0), youngs=1e5),
        leaning(0.6, turn=(30.0, 10.0, 35.0), size=(0.2, 0.2, 0.2), cells=(3, 3, 3), youngs=1e5), rolling(),
    ],
    ids=["corner", "smooth", "slides", "edge", "cube", "rolls"],
)  # fmt: skip
def test_solved_without_corrections_they_stay(case: Case) -> None:
    """What rigid motions do is what converged steps do as well: they never lead away from one."""
    x, v = case.positions, case.velocities
    for _ in range(3):
        problem = step_problem(case.scene.values(), x, v, H)
        still = Still(**{name.name: getattr(problem, name.name) for name in fields(problem)})
        solved = guarded_chebyshev(still, still.unsolved(), iterations=800).displacement
        assert np.linalg.norm(problem.residual(solved)) <= 1e-9 * np.linalg.norm(problem.residual(problem.unsolved()))
        assert np.abs(problem.align(solved) - solved).max() <= 1e-9
        x, v = x + solved, solved / H
