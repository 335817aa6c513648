"""`Simulator.tune` reaches the requested error, and reports what it cannot reach."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
import torch
from newton_cases import thrown_rod
from runs import simulator, state_of
from tuning_cases import CANDIDATES, bar, swinging, worst_error

import torchpd as pd
from torchpd.accuracy import tuning, tuning_study
from torchpd.accuracy.candidates import safe_candidates
from torchpd.accuracy.error import ExactStep, exact_steps, settled_steps
from torchpd.accuracy.tuning import TuningWarning
from torchpd.accuracy.tuning_result import Trial
from torchpd.study.scenes import study_scene


@pytest.mark.parametrize("error", [1e-1, 1e-3])
@pytest.mark.parametrize("youngs", [1e3, 1e6])
def test_the_error_bound_holds_in_another_motion(error: float, youngs: float) -> None:
    sim = bar(youngs)
    result = sim.tune(swinging(sim), error=error)
    assert result.attained
    assert result.error == error
    assert (sim.solver, sim.iterations, sim.tuning_result) == (result.solver, result.iterations, result)
    other = swinging(sim, speed=-2.0)
    other.velocities[..., 2] = other.positions[..., 0]
    for _ in range(8):
        other = sim(other)
    assert worst_error(sim, other) <= error
    # a solver that is hardly more than accurate enough: an eighth of the iterations cannot be
    sim.iterations //= 8
    assert worst_error(sim, swinging(sim)) > error


# Each alone: which of them is chosen is for the clock to say, and another one may need fewer iterations for less error.
@pytest.mark.parametrize("name", CANDIDATES)
def test_less_error_costs_more_iterations(name: str) -> None:
    sim = bar(time_step=1 / 30)
    solver = safe_candidates(sim, swinging(sim))[name]
    counts = [sim.tune(swinging(sim), error=error, candidates=[solver]).iterations for error in (1e-1, 1e-2, 1e-3)]
    assert counts == sorted(set(counts))


@pytest.mark.parametrize("favoured", CANDIDATES)
def test_less_error_takes_longer(favoured: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With all candidates, one of which has iterations a tenth as long: the measured time grows too."""
    sim = bar(time_step=1 / 30)
    candidates = safe_candidates(sim, swinging(sim))
    assert list(candidates) == CANDIDATES
    cheap = candidates[favoured]
    monkeypatch.setattr(
        tuning, "_milliseconds", lambda sim, start, trial: trial.iterations * (0.1 if trial.solver == cheap else 1.0)
    )
    results = [sim.tune(swinging(sim), error=error) for error in (1e-1, 1e-2, 1e-3)]
    assert all(result.attained for result in results)
    costs = [result.milliseconds for result in results]
    assert costs == sorted(set(costs))


def test_stiff_bodies_almost_at_rest_in_float64() -> None:
    """The converged steps are as certain as Newton's method makes them, not as |grad E| over inertia bounds them."""
    sim = bar(youngs=1e8, dtype=torch.float64, iterations=20)
    with warnings.catch_warnings():
        warnings.simplefilter("error", TuningWarning)
        result = sim.tune(error=1e-2)
    assert result.attained
    assert result.studied_error <= 1e-2


def test_out_of_reach_is_said_with_the_best_there_is() -> None:
    sim = bar(youngs=1e8, time_step=1 / 30)
    with pytest.warns(TuningWarning, match=r"\(error 0.001 cannot be reached\)"):
        result = sim.tune(swinging(sim), error=1e-3, most=5)
    assert not result.attained
    assert result.iterations <= 5
    assert result.error > 1e-3
    assert worst_error(sim, swinging(sim)) <= result.error
    assert "cannot be reached" in repr(sim)


def test_doubt_about_the_converged_step_counts_as_error(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = bar()
    unsure = [dataclasses.replace(step, uncertainty=0.2) for step in exact_steps(sim, swinging(sim))]
    monkeypatch.setattr(tuning_study, "exact_steps", lambda *_, **__: unsure * 7)
    assert sim.tune(swinging(sim), error=0.5).studied_error >= 0.2


@pytest.mark.parametrize("request_", [{"error": 0.3}, {"milliseconds": 1.0}])
def test_without_a_converged_step_there_is_no_result(
    request_: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what the user has set stays."""
    sim = bar(solver=pd.Multilevel(), iterations=9)
    unsure = [dataclasses.replace(step, uncertainty=14.0) for step in exact_steps(sim, swinging(sim))]
    monkeypatch.setattr(tuning_study, "exact_steps", lambda *_, **__: unsure * 7)
    with pytest.raises(RuntimeError, match=r"converged .*1\.4e\+01"):
        sim.tune(swinging(sim), **request_)  # type: ignore[arg-type]
    assert (sim.solver, sim.iterations, sim.tuning_result) == (pd.Multilevel(), 9, None)


def test_stiff_beams_are_tuned() -> None:
    """3,321 vertices at 1e7 Pa: Multilevel by a dozen iterations, within the rounding of float32."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (40, 8, 8))
    body = pd.Solid(mesh, youngs=1e7, density=1000.0)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, 1 / 30, 16, progress=False)
    result = sim.tune(swinging(sim, speed=10.0), error=1e-2)
    assert result.attained
    assert isinstance(result.solver, pd.Multilevel)
    assert result.iterations < 40
    assert worst_error(sim, swinging(sim, speed=-10.0)) <= 1e-2


def test_rods_are_tuned_with_newton(monkeypatch: pytest.MonkeyPatch) -> None:
    """On them it is tried; an iteration as long as five of the others."""
    case = thrown_rod()
    sim = simulator(case, torch.float32)
    state = state_of(case, sim)
    assert list(safe_candidates(sim, state)) == [*CANDIDATES, "inexact Newton"]
    monkeypatch.setattr(
        tuning,
        "_milliseconds",
        lambda sim, start, trial: trial.iterations * (5.0 if trial.solver == pd.Newton() else 1.0),
    )
    result = sim.tune(state, error=1e-2)
    assert result.attained
    assert result.solver == pd.Newton()


def test_a_kernel_without_multilevel_is_tuned_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU's "block", for one: the study moves by Chebyshev then."""
    for module in ("candidates", "tuning"):
        monkeypatch.setattr(f"torchpd.accuracy.{module}.runs", lambda solver, _: not isinstance(solver, pd.Multilevel))
    sim = bar()
    result = sim.tune(swinging(sim), error=1e-2)
    assert result.attained
    assert not any(isinstance(trial.solver, pd.Multilevel) for trial in result.trials)


def test_every_environment_counts() -> None:
    """The stiffest one of a batch decides."""
    soft, mixed = bar(1e4), bar(1e4)
    # not the first, the middle or the last of the batch
    mixed.set_material(stiffness=mixed.stiffness * torch.tensor([1.0, 100.0, 1.0, 1.0, 1.0, 1.0, 1.0])[:, None])
    few, many = (
        sim.tune(swinging(sim, batch=batch), error=1e-2, candidates=[pd.Chebyshev()]).iterations
        for sim, batch in ((soft, 1), (mixed, 7))
    )
    assert many > 2 * few
    assert mixed.stiffness.shape[0] == 7


@pytest.mark.parametrize("count", [1, 3])
def test_material_of_environments(count: int) -> None:
    """A set of one serves any number of states; without a state every environment is studied."""
    sim = bar()
    sim.set_material(stiffness=sim.stiffness * torch.linspace(1.0, 0.5, count)[:, None])
    result = sim.tune(swinging(sim, 3), error=1e-2)
    assert result.attained
    assert worst_error(sim, swinging(sim, 3)) <= result.error
    assert sim.tune(error=1e-2).batch == count
    if count == 3:
        with pytest.raises(ValueError, match=r"state .*got 2"):
            sim.tune(swinging(sim, 2), error=1e-2)


@pytest.mark.parametrize("by", ["forces", "targets"])
def test_motion_by_forces_or_targets(by: str) -> None:
    """Of a body that would rest without: each environment has its own, which the result is about."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (6, 2, 2))
    body = pd.Solid(mesh, youngs=1e5)
    pin = pd.Pin(body, mesh.vertices[:, 0] == 0.0)
    sim = pd.Simulator(pd.Scene(body, pin), 1 / 60, progress=False)
    state = sim.rest_state(2)
    with pytest.raises(ValueError, match="no motion"):
        sim.tune(state, error=1e-3)
    forces = targets = None
    if by == "forces":
        forces = torch.tensor([0.0, 1.0])[:, None, None] * state.positions
    else:
        shift = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.1, 0.05]])[:, None]
        targets = {pin: state.positions[:, pin.vertices] + shift}
    result = sim.tune(state, error=1e-3, forces=forces, targets=targets)
    assert result.attained
    after = sim(state, forces, targets).velocities.double().numpy() * sim.time_step
    exact = exact_steps(sim, state, forces=forces, targets=targets)
    assert exact[1].error_beyond_rounding(after[1], sim.dtype) <= 1e-3
    sim.iterations //= 8
    after = sim(state, forces, targets).velocities.double().numpy() * sim.time_step
    assert exact[1].error_beyond_rounding(after[1], sim.dtype) > 1e-3
    assert torch.equal(sim.pin_targets, pd.Simulator(pd.Scene(body, pin), 1 / 60, progress=False).pin_targets)
    with pytest.raises(ValueError, match=r"forces"):
        sim.tune(state, error=1e-3, forces=torch.zeros(3, sim.vertices, 3))


def test_without_a_state_the_motion_starts_at_rest() -> None:
    sim = bar()
    assert sim.tune(error=1e-1).attained


# A step that takes 0.1 ms and 10 us an iteration: (0.95 budget - 0.1) / 0.01 iterations.
@pytest.mark.parametrize(
    ("budget", "iterations", "attained"), [(1.005, 85, True), (0.505, 37, True), (0.09, 1, False), (1e3, 200, True)]
)
def test_a_budget_is_spent(budget: float, iterations: int, attained: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tuning, "_milliseconds", lambda sim, start, trial: 0.1 + 0.01 * trial.iterations)
    sim = bar(1e8)  # which needs thousands
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = sim.tune(swinging(sim), milliseconds=budget, most=200, candidates=[pd.Chebyshev()])
    assert (result.iterations, result.attained) == (iterations, attained)
    assert [entry.category for entry in said] == [] if attained else [TuningWarning]
    assert worst_error(sim, swinging(sim)) <= result.error


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_more_than_rounding_is_paid_for(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """With all the time that there is: of each candidate as many iterations as leave rounding, and the fastest wins."""
    cost = {"Chebyshev": 0.1, "Jacobi": 0.1, "Multilevel": 10.0}
    monkeypatch.setattr(
        tuning, "_milliseconds", lambda sim, start, trial: cost[type(trial.solver).__name__] * trial.iterations
    )
    sim = bar(dtype=dtype)
    result = sim.tune(swinging(sim), milliseconds=1e6)
    assert result.attained
    assert result.solver == pd.Chebyshev()
    assert result.error <= result.rounding
    assert worst_error(sim, swinging(sim)) <= result.error
    sim.iterations = 2 * result.iterations // 3
    assert worst_error(sim, swinging(sim)) > 0.5 * result.error


def test_a_state_almost_at_rest_does_not_excuse_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding hides all of its error after few iterations, and nothing of what a livelier one has left."""
    monkeypatch.setattr(tuning, "_milliseconds", lambda sim, start, trial: 0.01 * trial.iterations)
    sim = bar(1e6)
    sim.set_material(gravity=torch.zeros(3))
    state = swinging(sim, 2)
    state.velocities[1] *= 1e-3
    together = sim.tune(state, milliseconds=20.0, candidates=[pd.Chebyshev()])
    alone = sim.tune(swinging(sim), milliseconds=20.0, candidates=[pd.Chebyshev()])
    assert together.rounding > 30.0 * alone.rounding
    assert together.iterations >= 0.9 * alone.iterations
    assert together.error <= 2.0 * alone.rounding
    assert worst_error(sim, state) <= together.error


def test_a_real_budget_is_near() -> None:
    """As a ratio in one run: four times what 64 iterations and a call cost buys about four times the iterations."""
    sim = bar(1e8)
    trial = Trial(pd.Chebyshev(), 64, 0.0, ())
    budget = tuning._milliseconds(sim, swinging(sim), trial)
    found = sim.tune(swinging(sim), milliseconds=4.0 * budget, candidates=[pd.Chebyshev()]).iterations
    assert 96 < found < 1024


def test_what_friction_leaves_out_is_said() -> None:
    """Where Multilevel was not tried, nobody knows that the error cannot be reached."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (6, 2, 2))
    scene = pd.Scene(pd.Solid(mesh, youngs=1e7), pd.Gravity(), pd.Ground(0.0, friction=0.5))
    sim = pd.Simulator(scene, 1 / 30, progress=False, iterations=16)
    state = sim.rest_state()
    state.velocities[..., 1] = -2.0
    with pytest.warns(TuningWarning, match=r"\(error 0\.001 .*Multilevel, .*friction"):
        sim.tune(state, error=1e-3, most=8)
    with pytest.warns(TuningWarning, match="cannot be reached"):
        sim.tune(state, error=1e-3, most=1, candidates=[pd.Chebyshev(), pd.Multilevel()])


def sliding(youngs: float, *, friction: float = 0.8) -> tuple[pd.Simulator, pd.State]:
    """A block that falls a centimetre onto rough ground and is pushed along it, and its start."""
    solid = pd.Solid(pd.shapes.box((0.4, 0.2, 0.2), (6, 3, 3)), youngs)
    scene = pd.Scene(solid, pd.Gravity((3.0, -9.81, 0.0)), pd.Ground(-0.01, friction=friction))
    sim = pd.Simulator(scene, 1 / 60, dtype=torch.float64, progress=False, iterations=64)
    state = sim.rest_state()
    state.velocities[..., 0] = 1.0
    return sim, state


def errors_of_a_slide(sim: pd.Simulator, state: pd.State, steps: int = 25) -> list[float]:
    """Of its steps, with their friction."""
    errors = []
    for _ in range(steps):
        after, (exact,) = sim(state), settled_steps(sim, state)
        if exact.scale > 1e-9:  # else it lies, to rounding
            assert exact.uncertainty < 1e-4
            errors.append(exact.position_error(after.velocities[0].numpy() * sim.time_step))
        state = after
    return errors


def test_friction_is_part_of_the_error_bound() -> None:
    """The 49 iterations that reach 1e-2 on smooth ground leave 0.2."""
    sim, state = sliding(1e6)
    result = sim.tune(state, error=1e-2)
    assert result.attained
    # another way, at the same speed
    state.velocities[..., 0], state.velocities[..., 2] = 0.8, 0.6
    assert max(errors_of_a_slide(sim, state)) <= 1e-2
    sim.iterations //= 3
    assert max(errors_of_a_slide(sim, state)) > 1e-2
    assert sim.planes[0, 4] == 0.8


def test_steps_without_an_end_attain_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a body sticks and slips by turns: no error is smaller than what is not known of the step."""

    def unsettled(*given: object, **named: object) -> list[ExactStep]:
        steps = settled_steps(*given, **named)  # type: ignore[arg-type]
        return [dataclasses.replace(step, uncertainty=0.2) for step in steps]

    monkeypatch.setattr(tuning_study, "settled_steps", unsettled)
    sim, state = sliding(1e5)
    with pytest.warns(TuningWarning, match="error 0.01 not reached"):
        result = sim.tune(state, error=1e-2, most=128)
    assert not result.attained
    assert result.error >= 0.2
    assert sim.tune(state, error=0.5).attained


def test_the_hardest_states_of_the_motion_are_studied() -> None:
    """A beam of 100 kPa goes through a few states where the energy is not convex, which take four times as long."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (25, 5, 5))
    body = pd.Solid(mesh, youngs=1e5, density=1000.0)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, 1 / 30, 64, progress=False)
    result = sim.tune(error=1e-2)
    state, worst = sim.rest_state(), 0.0
    for _ in range(30):
        after = sim(state)
        worst = max(worst, float(result.verify(sim, state, after)))
        state = after
    # 0.46 from the states of five fixed steps
    assert worst <= result.error


def test_hanging_cloth_is_tuned() -> None:
    """The motion is that of the default solver, and its steps reach the error."""
    studied = study_scene("cloth", poisson=0.3)
    mesh = studied.mesh(8)
    sim = pd.Simulator(studied.scene(mesh, 1e6), 1 / 60, dtype=torch.float64, iterations=64, progress=False)
    start = studied.start(sim)
    result = sim.tune(start, error=1e-2)
    assert result.attained
    state = sim.rollout(start, 3, every=3).state()
    exact = exact_steps(sim, state)[0]
    assert exact.position_error((sim(state).velocities[0] * sim.time_step).numpy()) <= 1e-2
