"""Rigid motions of stiff pieces: closed forms, and what they are for, steps with strong contrast of stiffness."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from runs import same_bits

import torchpd as pd
from torchpd.reference import step_problem
from torchpd.reference_solvers import newton, relative_error

STEP = 1.0 / 30.0


def blocks(kind: str, contrast: float = 1e4, cells: int = 4, **options: Any) -> tuple[pd.Simulator, pd.State]:
    """A beam of 5r x r x r cells held at x = 0, thrown down: soft (1e4 Pa) with stiff slabs, or cubes of one cell."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    cell = np.floor(mesh.vertices[mesh.tets].mean(axis=1) * 5 * cells).astype(int)
    stiff = {
        "slabs": cell[:, 0] // (cells // 2) % 2 == 1,
        "cubes": (cell % 2 == 1).all(axis=1) & (cell[:, 0] % 4 == 1),
        "held slabs": cell[:, 0] // (cells // 2) % 2 == 0,
        "none": np.zeros(len(cell), dtype=bool),
    }[kind]
    body = pd.Solid(mesh, youngs=np.where(stiff, 1e4 * contrast, 1e4), density=1000.0)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(
        scene,
        STEP,
        **{"iterations": 4, "solver": pd.Multilevel(), "dtype": torch.float64, "progress": False, **options},
    )
    state = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    return sim, state


def error_of(sim: pd.Simulator, state: pd.State) -> Any:
    """Error of an answer in a function: |x - x*| / |x_0 - x*|, x* by Newton's method in the reference."""
    x, v = (part[0].double().cpu().numpy() for part in state)
    problem = step_problem(sim.scene.values(), x, v, sim.time_step)
    first = problem.first_iterate("velocity")
    solution = newton(problem, first, tolerance=1e-8)  # of forces; rounding of the stiff elements' leaves up to 1e-9
    return lambda after: relative_error(after.velocities[0].double().cpu().numpy() * sim.time_step, solution, first)


@pytest.mark.parametrize("contrast", [1e4, 1e6])
@pytest.mark.parametrize("kind", ["slabs", "cubes", "held slabs"])
def test_contrast_takes_a_fraction_of_the_iterations(kind: str, contrast: float) -> None:
    """Eight rounds of four iterations, where three times as many alone leave more than twice the error."""
    sim, state = blocks(kind, contrast)
    error = error_of(sim, state)
    left = error(pd.RigidPieces(sim).step(state, 8))
    sim.iterations = 3 * 8 * 4
    assert left <= 2e-3
    assert left < 0.5 * error(sim(state))


@pytest.mark.parametrize("kind", ["slabs", "cubes"])
def test_float32_goes_as_far_as_its_rounding(kind: str, device: torch.device) -> None:
    """Forces of 1e8 Pa times eps |x| / (cell of 5 cm) = 1e-6 are 1e-2 of those of 1e4 Pa at a strain of 1."""
    sim, state = blocks(kind, dtype=torch.float32)
    sim, state = sim.to(device), pd.State(*(part.to(device) for part in state))
    assert error_of(sim, state)(pd.RigidPieces(sim).step(state, 12)) <= 2e-4


def test_a_free_rigid_body_goes_where_its_motion_leads() -> None:
    """y = x + h v is a rotation by 1 rad and a shift: the objective is zero there, and Newton's method finds it."""
    mesh = pd.shapes.box((0.3, 0.2, 0.2), (3, 2, 2))
    sim = pd.Simulator(pd.Scene(pd.Solid(mesh, 1e6, 1000.0)), STEP, 4, dtype=torch.float64, progress=False)
    x = sim.rest_state().positions
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.8, 0.0], [0.8, 0.0, -0.6], [0.0, 0.6, 0.0]]).double())
    goal = x @ turn.mT + torch.tensor([0.1, 0.2, 0.3]).double()
    state, pieces = pd.State(x, (goal - x) / STEP), pd.RigidPieces(sim, stiffer_than=0.0)
    guess, left = x, []
    for _ in range(12):
        guess = pieces.move(state, guess)
        left.append(float((guess - goal).norm()))
    assert left[-1] <= 1e-12
    # no strain on the way
    assert float(sim.energy(guess)) <= 1e-12


def test_energy_never_rises_and_held_vertices_stay() -> None:
    sim, state = blocks("slabs")
    values = sim.scene.values()
    problem = step_problem(values, *(part[0].numpy() for part in state), STEP)
    pieces, held = pd.RigidPieces(sim), values.pin_vertices
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(state.positions.shape, generator=generator, dtype=torch.float64)
    noise[:, held] = 0.0
    falls = []
    for guess in (
        sim(state).positions,
        state.positions + STEP * state.velocities,
        *(state.positions + size * noise for size in (1e-4, 1e-2, 1e-1, 1.0)),
        # everything in one point, mirrored
        torch.where(noise == 0.0, state.positions, 0.0),
        torch.where(noise == 0.0, state.positions, -state.positions),
    ):
        after = pieces.move(state, guess)
        before, end = (problem.energy((x - state.positions)[0].numpy()) for x in (guess, after))
        assert end <= before * (1.0 + 1e-10)
        assert torch.equal(after[:, held], guess[:, held])
        falls.append(end < before)
    assert falls[0]
    assert falls[1]


def test_environments_are_independent_and_have_their_own_material() -> None:
    sim, state = blocks("slabs")
    stiffness = torch.stack([sim.stiffness, 0.5 * sim.stiffness])
    both = pd.State(*(torch.cat([part, 0.5 * part if number else part]) for number, part in enumerate(state)))
    sim.set_material(stiffness=stiffness)
    together = pd.RigidPieces(sim).step(both, 10)
    for item in range(2):
        alone, _ = blocks("slabs")
        alone.set_material(stiffness=stiffness[item])
        own = pd.State(*(part[item : item + 1] for part in both))
        after = pd.RigidPieces(alone).step(own, 10)
        # both are that close to where the step ends
        distance = (together.positions[item] - after.positions[0]).norm()
        assert distance <= 2e-3 * (own.velocities * STEP).norm()


def test_pieces_that_are_held_are_left_to_the_solver() -> None:
    assert [len(pd.RigidPieces(blocks(kind)[0]).pieces) for kind in ("slabs", "held slabs")] == [5, 4]


def test_one_round_is_a_step_and_gradients_are_those_of_the_simulator() -> None:
    sim, state = blocks("slabs", iterations=12)
    pieces = pd.RigidPieces(sim)
    assert same_bits(pieces.step(state, 1), sim(state))
    gradients = []
    for solve in (lambda s: pieces.step(s, 30), lambda s: sim(s)):
        velocities = state.velocities.clone().requires_grad_()
        after = solve(pd.State(state.positions, velocities))
        after.positions[..., 1].sum().backward()
        gradients.append(velocities.grad)
        sim.iterations = 3000
    assert torch.linalg.vector_norm(gradients[0] - gradients[1]) <= 1e-4 * torch.linalg.vector_norm(gradients[1])


def test_what_it_refuses() -> None:
    for kind, message in (("none", "found 0 among 0 stiff elements"), ("slabs", "found 0 among 0")):
        sim, _ = blocks(kind, contrast=50.0)
        with pytest.raises(ValueError, match=message):
            pd.RigidPieces(sim)
    sim, state = blocks("slabs", contrast=50.0)
    pieces = pd.RigidPieces(sim, stiffer_than=2e4)
    assert len(pieces.pieces) == 5
    with pytest.raises(ValueError, match="rounds must be a whole number >= 1, got 0"):
        pieces.step(state, 0)
    with pytest.raises(ValueError, match=r"RigidPieces\.stiffer_than"):
        pd.RigidPieces(sim, stiffer_than=-1.0)
    solid = pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2)), 1e5)
    with pytest.raises(ValueError, match="the scene has contacts"):
        pd.RigidPieces(pd.Simulator(pd.Scene(solid, pd.Ground()), iterations=8), stiffer_than=0.0)
