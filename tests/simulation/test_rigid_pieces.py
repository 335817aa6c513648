"""Rigid motions of stiff pieces: closed forms, and what they are for, steps with strong contrast of stiffness."""

from __future__ import annotations

import copy
import tracemalloc
from typing import Any

import numpy as np
import pytest
import torch
from runs import same_bits

import torchpd as pd
from torchpd.plan.preconditioner import reference_material
from torchpd.reference import step_problem
from torchpd.reference.solvers import newton, relative_error
from torchpd.simulation import stiff_pieces

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


def test_another_material_or_time_step_is_refused_until_it_is_made_anew() -> None:
    """It would leave a larger residual than the simulator alone."""
    sim, state = blocks("slabs")
    pieces = pd.RigidPieces(sim)

    def double(name: str, *batch: int) -> None:
        sim.set_material(**{name: 2.0 * getattr(sim, name).detach().expand(*batch, -1)})

    @torch.no_grad()
    def train() -> None:
        sim.stiffness.sub_(0.5 * sim.stiffness)

    changes: list[tuple[Any, str]] = [
        (lambda: double("stiffness"), "stiffness has changed"),
        (train, "stiffness has changed"),
        (lambda: setattr(sim.stiffness, "data", 3.0 * sim.stiffness.data), "stiffness has changed"),
        (lambda: double("masses"), "masses, damping or pin_stiffness have changed"),
        (lambda: double("stiffness", 1), "stiffness has changed"),
        (lambda: sim.set_material(damping=5.0), "masses, damping or pin_stiffness have changed"),
        (lambda: setattr(sim, "time_step", 0.01), r"time_step was 0\.0333333 s and is 0\.01 s"),
        (
            lambda: setattr(sim, "masses", torch.nn.Parameter(2.0 * sim.masses)),
            "masses, damping or pin_stiffness have changed",
        ),
    ]
    for change, message in changes:
        pieces.step(state, 2)
        change()
        for call in (lambda: pieces.step(state, 1), lambda: pieces.move(state, state.positions)):
            with pytest.raises(RuntimeError, match=rf"{message}; call prepare\(\) to make it anew"):
                call()
        pieces.prepare()
        assert same_bits(pieces.step(state, 3), pd.RigidPieces(sim).step(state, 3))


def test_it_goes_on_where_the_same_values_are_written_or_others_that_do_not_matter() -> None:
    sim, state = blocks("slabs")
    pieces = pd.RigidPieces(sim)
    before = pieces.step(state, 3)
    sim.set_material(stiffness=sim.stiffness.detach().clone(), masses=sim.masses.detach().expand(1, -1))
    assert same_bits(pieces.step(state, 3), before)
    # forces on the pieces, not how they move
    sim.set_material(gravity=torch.zeros(3), pin_targets=sim.pin_targets + 0.01)
    assert not torch.equal(pieces.step(state, 3).positions, before.positions)
    twin = copy.deepcopy(pieces)
    assert same_bits(twin.step(state, 3), pieces.step(state, 3))
    twin.sim.set_material(stiffness=1e5)
    with pytest.raises(RuntimeError, match="stiffness has changed"):
        twin.step(state, 3)
    pieces.step(state, 3)


def test_a_change_of_precision_is_refused_until_it_is_made_anew() -> None:
    sim, state = blocks("slabs", dtype=torch.float32)
    pieces = pd.RigidPieces(sim)
    sim.double()
    wide = pd.State(*(part.double() for part in state))
    with pytest.raises(RuntimeError, match=r"made for torch\.float32 on cpu, .* torch\.float64 .*prepare"):
        pieces.step(wide, 2)
    pieces.prepare()
    assert same_bits(pieces.step(wide, 2), pd.RigidPieces(sim).step(wide, 2))


def test_a_preparation_that_fails_changes_nothing() -> None:
    sim, state = blocks("slabs")
    pieces, stiffness = pd.RigidPieces(sim), sim.stiffness.detach().clone()
    before = pieces.step(state, 3)
    sim.set_material(stiffness=1e5)
    with pytest.raises(ValueError, match="give stiffer_than"):
        pieces.prepare()
    assert repr(pieces) == "RigidPieces(5 pieces stiffer than 1e+06 Pa)"
    with pytest.raises(RuntimeError, match="stiffness has changed"):
        pieces.step(state, 3)
    sim.set_material(stiffness=stiffness)
    assert same_bits(pieces.step(state, 3), before)


def test_functions_and_fits_are_those_of_a_dense_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Z = 0 beside the pieces and their pins, fits Z = 1, and Z^T A Z: in float64 to 1e5 roundings."""
    sim, _ = blocks("cubes", cells=8)
    reference = (array.double().numpy() for array in reference_material(sim.plan, sim.material(), sim.time_step))
    stiffness, inertia = reference
    values = sim.scene.values()
    monkeypatch.setattr(stiff_pieces, "_BLOCK", 24)  # does not divide the columns
    found = stiff_pieces.find_pieces(values, stiffness, inertia, None, torch.float64, torch.device("cpu"))
    inside = np.zeros(len(inertia), dtype=bool)
    inside[np.concatenate(found.vertices)] = True
    own = (stiffness > found.threshold) & inside[values.tets].all(axis=1)
    matrix = stiff_pieces._matrix(values, np.where(own, 0.0, stiffness), inertia)
    around = np.isfinite(inertia) & ~inside
    assert 1 < len(found.vertices) != 6
    assert around.any()
    size = len(found.vertices) * 4
    assert np.abs((matrix @ found.functions)[around]).max() <= 1e-11 * abs(matrix).max()
    assert not found.functions[np.isinf(inertia)].any()
    dense = found.functions.T @ (matrix @ found.functions)
    assert np.abs(found.coarse.reshape(size, size) - dense).max() <= 1e-11 * np.abs(dense).max()
    parts = np.einsum("cas,csx->cax", found.fits, found.functions[found.rows])
    one = np.tensordot(found.owners, parts, 1).reshape(size, size)
    assert np.abs(one - np.eye(size)).max() <= 1e-11
    single = stiff_pieces.find_pieces(values, stiffness, inertia, None, torch.float32, torch.device("cpu"))
    assert single.functions.dtype == np.float32
    assert np.array_equal(single.functions, found.functions.astype(np.float32))


def test_what_is_sparse_stays_sparse() -> None:
    """Functions of 192 cubes in float32, with less at any time than these and their fits, dense in float64."""
    mesh = pd.shapes.box((2.4, 0.8, 0.8), (24, 8, 8))
    cell = np.floor(mesh.vertices[mesh.tets].mean(axis=1) * 10.0 + 1e-9).astype(int)
    stiffness, inertia = np.where((cell % 2 == 1).all(axis=1), 1e8, 1e4), np.ones(len(mesh.vertices))
    values = pd.Scene(pd.Solid(mesh, youngs=stiffness)).values()
    tracemalloc.start()
    try:
        found = stiff_pieces.find_pieces(values, stiffness, inertia, None, torch.float32, torch.device("cpu"))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(found.vertices) == 12 * 4 * 4
    assert found.functions.nbytes == len(inertia) * 4 * 192 * 4
    assert peak < 2 * len(inertia) * 4 * 192 * 8


def test_pieces_are_counted_before_they_are_split(monkeypatch: pytest.MonkeyPatch) -> None:
    """2000 tetrahedra apart from each other, one of them held."""

    def refuse(*_: Any) -> Any:
        raise AssertionError("split before it was counted")

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    vertices = (corners + 2.0 * np.arange(2000)[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    mesh = pd.TetMesh(vertices, np.arange(8000).reshape(-1, 4))
    body = pd.Solid(mesh, youngs=1e5)
    sim = pd.Simulator(pd.Scene(body, pd.Pin(body, np.arange(8000) == 3)), iterations=8, progress=False)
    monkeypatch.setattr(stiff_pieces, "_split", refuse)
    with pytest.raises(ValueError, match=r"1 to 256 .*got 2000 .*1 of them"):
        pd.RigidPieces(sim, stiffer_than=0.0)


def test_what_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    sim, _ = blocks("slabs")
    needed = 4 * 5 * sim.vertices * 8
    monkeypatch.setattr(stiff_pieces, "host_memory", lambda: needed - 1)
    with pytest.raises(ValueError, match=rf"5 pieces .*{needed:,} B .*{needed - 1:,} B"):
        pd.RigidPieces(sim)
    monkeypatch.setattr(stiff_pieces, "host_memory", lambda: needed)
    pd.RigidPieces(sim)


def test_bad_arguments_are_refused_with_name_contract_and_what_came() -> None:
    sim, state = blocks("slabs")
    pieces = pd.RigidPieces(sim)
    two = pd.State(*(part.repeat(2, 1, 1) for part in state))
    single = state.positions.float()
    contract = r"must be \[1, 525, 3\], torch\.float64 on cpu like state and simulator"
    calls: list[tuple[Any, type[Exception], str]] = [
        (lambda: pieces.move(two, state.positions), ValueError, r"positions .*got \[1, 525, 3\]"),
        (lambda: pieces.move(state, two.positions), ValueError, rf"^positions {contract}, got \[2, 525, 3\]"),
        (lambda: pieces.move(state, single), TypeError, rf"^positions {contract}, got torch\.float32 on cpu"),
        (lambda: pieces.move(state, 3), TypeError, rf"^positions {contract}, got int"),
        (lambda: pieces.move(state, state.positions.to("meta")), TypeError, r"^positions .*got torch\.float64 on meta"),
        (lambda: pieces.move(state, state.positions, forces=single), TypeError, rf"^forces {contract}, got torch"),
        (lambda: pieces.move(state, state.positions, forces=two[0]), ValueError, rf"^forces {contract}, got \[2, 525"),
        *(
            (lambda call=call, bad=bad: call(bad), kind, message)
            for call in (lambda bad: pieces.step(bad, 2), lambda bad: pieces.move(bad, state.positions))
            for bad, kind, message in (
                (3, TypeError, r"state .* State, positions and velocities \[B, 525, 3\], got int"),
                (state.positions, TypeError, "state .*got Tensor"),
                (pd.State(single, single), TypeError, rf"state\.positions {contract}, got torch\.float32 on cpu"),
                (pd.State(state[0][0], state[1][0]), ValueError, rf"state\.positions {contract}, got \[525, 3\]"),
                (pd.State(state[0][:, 1:], state[1]), ValueError, rf"state\.positions {contract}, got \[1, 524, 3\]"),
                (pd.State(state[0], two[1]), ValueError, rf"state\.velocities {contract}, got \[2, 525, 3\]"),
            )
        ),
        (lambda: pieces.step(state, 0), ValueError, "rounds .*got 0"),
        (lambda: pieces.step(state, 2, state.positions), TypeError, "positional argument"),
        (lambda: pieces.move(state, state.positions, None), TypeError, "positional argument"),
        (lambda: pd.RigidPieces(sim, 1e6), TypeError, "positional argument"),
        (lambda: pd.RigidPieces(3), TypeError, "RigidPieces: sim .*got int"),
        (lambda: pd.RigidPieces(sim, stiffer_than=-1.0), ValueError, r"RigidPieces\.stiffer_than must be >= 0"),
        (lambda: pd.RigidPieces(sim, stiffer_than=np.nan), ValueError, r"RigidPieces\.stiffer_than .*got nan"),
        (
            lambda: pd.RigidPieces(copy.deepcopy(sim).to("meta")),
            RuntimeError,
            '^RigidPieces: the simulator is on "meta"',
        ),
    ]
    for call, kind, message in calls:
        with pytest.raises(kind, match=message):
            call()
    empty = pieces.step(pd.State(state[0][:0], state[1][:0]), 2)
    assert empty.positions.shape == (0, 525, 3)


def test_scenes_without_pieces_are_refused_with_the_numbers() -> None:
    for kind, span in (("none", "10000 to 10000"), ("slabs", "10000 to 500000")):
        sim, _ = blocks(kind, contrast=50.0)
        message = f"stiffer_than .*100, .*{span} Pa; give stiffer_than"
        with pytest.raises(ValueError, match=message):
            pd.RigidPieces(sim)
    pieces = pd.RigidPieces(sim, stiffer_than=2e4)
    assert len(pieces.pieces) == 5
    assert repr(pieces) == "RigidPieces(5 pieces stiffer than 20000 Pa)"
    for threshold, counted in (
        (0.0, "got 1 stiffer than 0 Pa, 1 of them with hard pins"),
        (1e7, "got 0 stiffer than 1e\\+07 Pa"),
    ):
        with pytest.raises(ValueError, match=f"{counted}.*10000 to 500000 Pa.*stiffer_than"):
            pd.RigidPieces(sim, stiffer_than=threshold)
    solid = pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2)), 1e5)
    with pytest.raises(ValueError, match=r"RigidPieces: .*contacts"):
        pd.RigidPieces(pd.Simulator(pd.Scene(solid, pd.Ground()), iterations=8), stiffer_than=0.0)
