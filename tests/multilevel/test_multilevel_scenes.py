"""The multilevel solver in any scene: pins and stiffness that it was not prepared for, gradients, files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cases import Case, beam, box, contact_block, on_sphere, slivers
from environments import assert_same_bits, different_environments
from environments import run as outputs
from environments import scene as everything
from multilevel_cases import IDS, SOLVERS, swing
from runs import displacement, moving, same_bits, simulate, simulator, state_of

import torchpd as pd
from torchpd.accuracy.error import problem_of
from torchpd.plan import placement as placing
from torchpd.reference.solvers import relative_error

pytestmark = pytest.mark.usefixtures("poisoned")


# ---- what it was not prepared for


def pinned_beam(stiffness: float | None) -> Case:
    case = beam(1e6)
    body = case.scene.solids[0]
    scene = pd.Scene(body, pd.Pin(body, np.arange(36), stiffness=stiffness), pd.Gravity((0.0, -9.8, 0.0)))
    return Case(scene, case.positions, case.velocities, case.time_step, start="inertial")


@pytest.mark.parametrize("solver", SOLVERS, ids=IDS)
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_stiffness_scaled_since(solver: pd.Multilevel, factor: float) -> None:
    case = beam(1e5)
    fresh = beam(1e5 * factor)
    ready = simulator(fresh, torch.float64, solver=pd.Multilevel(), iterations=400)
    solution = displacement(ready, ready(state_of(fresh, ready), start="inertial"))
    sim = simulator(case, torch.float64, solver=solver, iterations=80)
    sim.set_material(stiffness=factor * sim.stiffness)
    after, info = sim(state_of(case, sim), start="inertial", return_info=True)
    assert relative_error(displacement(sim, after), solution, case.problem().first_iterate("inertial")) <= 1e-2
    # inertia stays as it was, so 1 - q / s is 0.9 either way
    assert float(info.rho) == pytest.approx(0.9, rel=1e-9)
    sim.prepare_solver()
    after, info = sim(state_of(case, sim), start="inertial", return_info=True)
    assert float(info.rho) == 0.0
    assert relative_error(displacement(sim, after), solution, case.problem().first_iterate("inertial")) <= 1e-3


def test_material_scaled_as_a_whole_loses_nothing() -> None:
    """s A_0 everywhere: M / s, and the iterates of a scaled energy."""
    case = beam(1e6)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=20)
    plain = sim(state_of(case, sim), start="inertial")
    sim.set_material(stiffness=4.0 * sim.stiffness, masses=4.0 * sim.masses)
    after, info = sim(state_of(case, sim), start="inertial", return_info=True)
    assert float(info.rho) == 0.0
    # factors of two round nothing
    assert torch.equal(after.positions, plain.positions)


@pytest.mark.parametrize("stiffness", [float("inf"), 1e6], ids=["hard", "stiff"])
@pytest.mark.parametrize("solver", SOLVERS, ids=IDS)
def test_pins_that_came_since_do_not_stall_it(solver: pd.Multilevel, stiffness: float) -> None:
    """The preconditioner knows of springs of 1 N/m; info says that it does not fit, and a new one does."""
    case = pinned_beam(1.0)
    sim = simulator(case, torch.float64, solver=solver)
    with torch.no_grad():
        sim.pin_stiffness.fill_(stiffness)  # behind its back, as an optimiser would
    held = pinned_beam(None if stiffness == float("inf") else stiffness)
    ready = simulator(held, torch.float64, solver=pd.Multilevel(), iterations=400)
    solution, first = displacement(ready, ready(state_of(held, ready))), held.problem().first_iterate()

    def look(iterations: int) -> tuple[float, float]:
        sim.iterations = iterations
        after, info = sim(state_of(case, sim), return_info=True)
        return relative_error(displacement(sim, after), solution, first), float(info.rho)

    late, rho = look(300)
    assert rho > 0.99
    assert late <= 1e-2
    sim.prepare_solver()
    assert look(60)[0] <= 1e-3
    assert look(60)[1] == 0.0


def test_springs_that_it_does_not_know_leave_it_positive() -> None:
    """Where they hold a vertex Hc is above Ac: the small problem has to go around M, else 28 trials fail here.

    Its neighbours in a batch, in one of which M fits while the other has softer springs, do not notice.
    """
    case = swing(5, 1e7)
    body, held = case.scene.solids[0], np.arange(5, len(case.positions), 97)

    def scene(stiffness: float) -> Case:
        parts = pd.Pin(body, held, stiffness=stiffness), pd.Gravity((0.0, -9.8, 0.0))
        return Case(pd.Scene(body, *parts), case.positions, case.velocities, case.time_step)

    stiff = scene(1e8)
    ready = simulator(stiff, torch.float64, solver=pd.Multilevel(), iterations=600)
    solution, first = displacement(ready, ready(state_of(stiff, ready))), stiff.problem().unsolved()
    sim = simulator(scene(1.0), torch.float64, solver=pd.Multilevel(), iterations=80)
    springs = torch.ones(9, len(sim.pin_stiffness), dtype=torch.float64)
    springs[4], springs[7] = 1e8, 1e-3
    sim.pin_stiffness = torch.nn.Parameter(springs, requires_grad=False)  # behind its back
    after, info = sim(state_of(case, sim, 9), return_info=True)
    assert relative_error(displacement(sim, after, 4), solution, first) <= 2e-3
    assert int(info.restarts[4]) <= 4
    for environment in (4, 5, 7):
        sim.pin_stiffness = torch.nn.Parameter(springs[environment].clone(), requires_grad=False)
        alone = sim(state_of(case, sim))
        assert torch.equal(alone.positions[0], after.positions[environment])


def test_hard_pins_by_set_material_prepare_it_anew() -> None:
    case = pinned_beam(1.0)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=4)
    before = sim.plan
    sim.set_material(stiffness=2.0 * sim.stiffness)
    assert sim.plan is before
    sim.set_material(pin_stiffness=torch.full_like(sim.pin_stiffness, float("inf")))
    assert sim.plan is not before
    _, info = sim(state_of(case, sim), return_info=True)
    assert float(info.rho) == 0.0


def test_springs_that_grow_much_stiffer_prepare_it_anew() -> None:
    """A hand that takes hold: M of springs of 1 N/m leaves all of the error then, whatever the iterations."""
    case = pinned_beam(1.0)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=16)
    before = sim.plan
    sim.set_material(pin_stiffness=torch.full_like(sim.pin_stiffness, 0.5))
    assert sim.plan is before
    sim.set_material(pin_stiffness=torch.full_like(sim.pin_stiffness, 1e6))
    assert sim.plan is not before
    anew = sim.plan
    sim.set_material(pin_stiffness=torch.full_like(sim.pin_stiffness, 2e6))
    assert sim.plan is anew  # within what M puts up with
    # as a whole M serves it
    grown = {name: 10.0 * getattr(sim, name).detach() for name in ("stiffness", "masses", "pin_stiffness")}
    sim.set_material(**grown)
    assert sim.plan is anew
    _, info = sim(state_of(case, sim), return_info=True)
    assert float(info.rho) < 0.6


@pytest.mark.parametrize("how", ["set_material", "load_state_dict"])
def test_a_preparation_that_fails_changes_nothing(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The arrays that come before and after the pins included; and once it works, the same call does."""
    case = pinned_beam(1.0)
    sim, ready = (simulator(case, torch.float64, solver=pd.Multilevel(), iterations=4) for _ in range(2))
    hard = torch.full_like(sim.pin_stiffness, float("inf"))
    wanted = {
        "masses": 3.0 * sim.masses, "stiffness": torch.stack([sim.stiffness, 2.0 * sim.stiffness]),
        "pin_stiffness": hard, "damping": torch.tensor(0.5, dtype=torch.float64),
    }  # fmt: skip
    ready.set_material(**wanted)

    def change() -> None:
        if how == "set_material":
            sim.set_material(**wanted)
        else:
            sim.load_state_dict(ready.state_dict())

    def refuse(*_: Any, **__: Any) -> Any:
        raise MemoryError("no room")

    plan, parameters = sim.plan, sim.material()
    before = [array.clone() for array in parameters]
    with monkeypatch.context() as broken:
        broken.setattr(placing, "precondition_plan", refuse)
        with pytest.raises(MemoryError, match="no room"):
            change()
    assert sim.plan is plan
    assert all(one is other for one, other in zip(sim.material(), parameters, strict=True))
    assert all(torch.equal(one, other) for one, other in zip(before, sim.material(), strict=True))
    change()
    state = state_of(case, sim, 2)
    assert same_bits(sim(state), ready(state))


def test_some_environments_held_and_others_not() -> None:
    case = pinned_beam(1e3)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=300)
    springs = sim.pin_stiffness.detach().repeat(2, 1)
    springs[1] = float("inf")
    sim.set_material(pin_stiffness=springs)
    after = sim(state_of(case, sim, 2))
    for item, stiffness in enumerate((1e3, None)):
        alone = pinned_beam(stiffness)
        ready = simulator(alone, torch.float64, solver=pd.Multilevel(), iterations=300)
        solution = displacement(ready, ready(state_of(alone, ready)))
        error = relative_error(displacement(sim, after, item), solution, alone.problem().first_iterate())
        assert error <= 1e-3, item


# ---- the same bits


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(("iterations", "tolerance"), [(14, 0.0), (1000, 0.9)], ids=["all iterations", "soft stop"])
@pytest.mark.parametrize("solver", SOLVERS, ids=IDS)
def test_batch_and_threads_do_not_matter(
    solver: pd.Multilevel, iterations: int, tolerance: float, dtype: torch.dtype
) -> None:
    sim = simulator(everything(), dtype, solver=solver, iterations=iterations, tolerance=tolerance)
    state, forces = different_environments(sim, 19)
    together = outputs(sim, state, forces)
    for items in (slice(0, 1), slice(3, 5), slice(9, 18)):
        assert_same_bits([t[items] for t in together], outputs(sim, state, forces, items))
    torch.set_num_threads(1)
    for items in (slice(0, 19), slice(3, 4)):
        assert_same_bits([t[items] for t in together], outputs(sim, state, forces, items))
    if tolerance:
        assert len(sim(state, forces, return_info=True)[1].iterations.unique()) > 1


@pytest.mark.usefixtures("two_threads")
def test_contacts_of_several_chunks_are_held_in_the_same_order(dtype: torch.dtype) -> None:
    """Of a face of 81 vertices of 729, alone by two threads, in a batch by one each."""
    case = contact_block(pd.Ground(friction=0.5), velocity=(1.0, -1.0, 0.2), youngs=1e6, cells=8)
    sim = simulator(case, dtype, solver=pd.Multilevel(), iterations=10)
    state = state_of(case, sim, 3)
    state = pd.State(state.positions, state.velocities * torch.tensor([1.0, 0.5, 2.0], dtype=dtype)[:, None, None])
    together = sim(state)
    for count in (2, 1):
        torch.set_num_threads(count)
        alone = [sim(pd.State(state.positions[i : i + 1], state.velocities[i : i + 1])) for i in range(3)]
        assert same_bits(together, pd.State(*(torch.cat(parts) for parts in zip(*alone, strict=True))))


def test_one_that_is_no_number_leaves_the_others_alone() -> None:
    """A ball has no normal there; the next environment of a thread begins with its own directions."""
    case = on_sphere(0.3)
    sim = simulator(case, torch.float64, solver=pd.Multilevel(), iterations=12)
    torch.set_num_threads(1)
    state = state_of(case, sim, 24)
    state.positions[:20] = torch.nan
    together = sim(state)
    alone = sim(pd.State(state.positions[20:21], state.velocities[20:21]))
    assert together.positions[:20].isnan().all()
    for number in range(20, 24):
        own = pd.State(together.positions[number : number + 1], together.velocities[number : number + 1])
        assert same_bits(own, alone)


def test_material_of_an_environment_is_that_of_its_own_simulator(dtype: torch.dtype) -> None:
    case = everything()
    sim = simulator(case, dtype, solver=pd.Multilevel(), iterations=14)
    single = simulator(case, dtype, solver=pd.Multilevel(), iterations=14)
    state, forces = different_environments(sim, 9)
    factor = torch.linspace(0.5, 2.0, 9, dtype=dtype)[:, None]
    varied = {
        "stiffness": sim.stiffness * factor, "masses": sim.masses * factor.flip(0),
        # beyond what M is believed for, in some
        "pin_stiffness": sim.pin_stiffness * factor**8,
    }  # fmt: skip

    def give(to: pd.Simulator, arrays: dict[str, torch.Tensor]) -> None:
        """Behind its back: set_material would make M anew."""
        for name, value in arrays.items():
            setattr(to, name, torch.nn.Parameter(value.clone(), requires_grad=False))

    give(sim, varied)
    together = outputs(sim, state, forces)
    for item in (0, 4, 8):
        give(single, {name: value[item] for name, value in varied.items()})
        items = slice(item, item + 1)
        assert_same_bits([t[items] for t in together], outputs(single, state, forces, items))


@pytest.mark.parametrize("solver", SOLVERS, ids=IDS)
def test_rollout_is_its_steps(solver: pd.Multilevel, dtype: torch.dtype) -> None:
    sim = simulate(dtype, solver=solver)
    state = moving(sim)
    track = sim.rollout(state, 4)
    for step in range(4):
        state = sim(state)
        assert same_bits(state, track.state(step))
    inplace = moving(sim)
    for _ in range(4):
        sim.step_(inplace)
    assert same_bits(inplace, state)


# ---- gradients


def test_gradients_are_those_of_any_solver() -> None:
    """At the converged step the way there does not matter; the adjoint system is solved to 1e-10."""
    found = []
    for solver, iterations in ((pd.Chebyshev(), 3000), (pd.Multilevel(), 200)):
        sim = simulator(slivers(), torch.float64, solver=solver, iterations=iterations)
        sim.stiffness.requires_grad_()
        state = state_of(slivers(), sim)
        state.velocities.requires_grad_()
        sim(state).positions.square().sum().backward()
        assert sim.stiffness.grad is not None
        found.append((sim.stiffness.grad, state.velocities.grad))
    for one, other in zip(*found, strict=True):
        assert float((one - other).norm()) <= 1e-7 * float(other.norm())


def test_gradients_with_contact() -> None:
    case = contact_block(pd.Ground(), velocity=(0.3, -1.0, 0.0))
    found = []
    for solver, iterations in ((pd.Chebyshev(), 3000), (pd.Multilevel(), 300)):
        sim = simulator(case, torch.float64, solver=solver, iterations=iterations)
        state = state_of(case, sim)
        state.velocities.requires_grad_()
        sim(state).positions.square().sum().backward()
        found.append(state.velocities.grad)
    assert float((found[0] - found[1]).norm()) <= 1e-7 * float(found[0].norm())


# ---- the rest of the library


def test_saved_and_loaded_it_takes_the_same_steps(tmp_path: Path, dtype: torch.dtype) -> None:
    sim = simulate(dtype, solver=pd.Multilevel("momentum", relaxation=1.7))
    # not what the preconditioner was made of: the file has to remember that
    sim.set_material(stiffness=3.0 * sim.stiffness)
    sim.save(tmp_path / "sim.safetensors")
    loaded = pd.Simulator.load(tmp_path / "sim.safetensors")
    assert loaded.solver == sim.solver
    assert same_bits(loaded.rollout(moving(sim), 3), sim.rollout(moving(sim), 3))


def test_precision_can_be_changed() -> None:
    wide, narrow = simulate(torch.float64, solver=pd.Multilevel()), simulate(torch.float32, solver=pd.Multilevel())
    narrow.double()
    assert narrow.plan.fine_value.dtype == torch.float64
    assert narrow.plan.level_sizes.dtype == torch.int32
    after, expected = narrow(moving(wide)), wide(moving(wide))
    # masses had been rounded to float32
    assert float((after.positions - expected.positions).abs().max()) <= 1e-4


def test_what_it_was_made_of_goes_along() -> None:
    """Into another precision as into a file: stiffness that has changed since does not make another M."""
    sim = simulate(torch.float64, solver=pd.Multilevel())
    sim.set_material(stiffness=3.0 * sim.stiffness)
    before = sim(moving(sim), return_info=True)[1].rho
    sim.float()
    assert torch.equal(sim.plan.reference_stiffness, (sim.stiffness / 3.0))
    assert torch.allclose(sim(moving(sim), return_info=True)[1].rho, before, rtol=1e-5)
    assert float(before[0]) > 0.5


def test_meta_is_refused() -> None:
    there = simulate(torch.float32).to("meta")
    with pytest.raises(RuntimeError, match=r"device .*got meta"):
        there.solver = pd.Multilevel()
    assert there.solver == pd.Chebyshev()


def test_print_says_what_it_prepared() -> None:
    text = str(simulate(torch.float32, solver=pd.Multilevel()))
    for fact in (
        "Multilevel lbfgs: 12 iterations, relaxation 1.8",
        "preconditioner: 45 vertices > ",
        "solved directly",
    ):
        assert fact in text, fact
    assert "preconditioner" not in str(simulate(torch.float32))


def test_settings_are_checked() -> None:
    for keywords, message in (
        ({"outer": "newton"}, r"Multilevel\.outer .*got 'newton'"),
        ({"relaxation": 2.0}, r"Multilevel\.relaxation must lie in \(0, 2\)"),
        ({"relaxation": 0.0}, r"Multilevel\.relaxation must lie in \(0, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            pd.Multilevel(**keywords)  # type: ignore[arg-type]


def test_ops_want_the_arrays_of_the_preconditioner() -> None:
    sim = simulate(torch.float32)
    state, ops = sim.rest_state(), torch.ops.torchpd
    numbers = {**pd.Multilevel().settings(), "iterations": 2, "time_step": 0.01, "tolerance": 0.0}
    plan = list(sim.plan.arrays)
    with pytest.raises(ValueError, match=r"plan .*no .*preconditioner; .*solver=Multilevel"):
        ops.step(*state, None, None, sim.material(), plan, **numbers, inertial=False, report=False)
    with pytest.raises(ValueError, match=r"plan has no multilevel preconditioner"):
        ops.precondition(state.positions, plan)
    sim.solver = pd.Multilevel()
    plan = list(sim.plan.arrays)
    with pytest.raises(ValueError, match=r"field .*got Float \[1, 3, 3\]"):
        ops.precondition(torch.zeros(1, 3, 3), plan)
    with pytest.raises(TypeError, match=r"field .*got Long \[1, 45, 3\]"):
        ops.precondition(state.positions.long(), plan)
    with pytest.raises(ValueError, match=r"plan .*got 51"):
        ops.precondition(state.positions, plan[:-1])
    with pytest.raises(ValueError, match=r"plan\.reference_stiffness .*got Float \[95\]"):
        ops.precondition(state.positions, [*plan[:16], plan[16][:-1].contiguous(), *plan[17:]])


def test_vertices_far_from_others_in_size() -> None:
    """Two bodies of very different stiffness and size in one scene."""
    small, large = box((0.1, 0.1, 0.1), (3, 3, 3)), box((2.0, 2.0, 2.0), (4, 4, 4))
    bodies = [
        pd.Solid(pd.TetMesh(small[0] + [5.0, 0.0, 0.0], small[1]), 1e8),
        pd.Solid(pd.TetMesh(*large), 1e4),
    ]
    sim = pd.Simulator(
        pd.Scene(*bodies, pd.Pin(bodies[1], [0, 1]), pd.Gravity()), 1 / 60, 40, pd.Multilevel(), torch.float64
    )
    state = sim.rest_state()
    generator = torch.Generator().manual_seed(0)
    speed = torch.randn(state.velocities.shape, generator=generator, dtype=torch.float64)
    thrown = pd.State(state.positions, speed)
    u = sim(thrown).velocities[0].numpy() / 60
    problem = problem_of(sim, thrown)
    # of what x + h v leaves out of balance, which is far more than weighs on the bodies
    assert np.linalg.norm(problem.residual(u)) <= 1e-4 * np.linalg.norm(problem.residual(problem.unsolved()))
