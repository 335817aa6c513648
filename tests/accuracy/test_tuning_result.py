"""A result of `Simulator.tune`: when its error bound is valid, and how `verify` measures the error of a step."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import pytest
import torch
from tuning_cases import bar, swinging, worst_error

import torchpd as pd
from torchpd.accuracy import tuning
from torchpd.accuracy.error import exact_steps
from torchpd.accuracy.tuning import TuningWarning
from torchpd.accuracy.tuning_result import Trial, TuningResult
from torchpd.common.synonyms import Renamed


@pytest.fixture(scope="module")
def tuned() -> tuple[pd.Simulator, TuningResult]:
    sim = bar()
    return sim, sim.tune(swinging(sim), error=1e-2)


def test_the_result_is_printed_and_goes_stale(tuned: tuple[pd.Simulator, TuningResult]) -> None:
    sim, result = tuned
    assert result.matches(sim)
    assert "tuned: error 1.0e-02" in repr(sim)
    assert "no longer valid" not in repr(sim)
    sim.iterations += 1
    assert not result.matches(sim)
    assert "no longer valid" in repr(sim)
    sim.iterations -= 1


def test_residuals_are_watched(tuned: tuple[pd.Simulator, TuningResult]) -> None:
    sim, result = tuned
    _, info = sim(swinging(sim, batch=2), return_info=True)
    assert result.is_valid(info).tolist() == [True, True]
    # the estimate is proportional, and no studied state has more error than it says: of the chosen iterations, and of
    # the most iterations that exceed the bound
    chosen = result.trials[-1]
    assert max(chosen.errors) == chosen.error
    breaking = min((trial for trial in result.trials if trial.error > result.error), key=lambda trial: trial.error)
    pairs = [pair for trial in (chosen, breaking) for pair in zip(trial.errors, trial.residuals, strict=True)]
    excess = [e - max(result.error_per_residual * r, result.error_at_zero_residual) for e, r in pairs]
    assert max(excess) == pytest.approx(0.0, abs=1e-12)
    # where rounding hides the forces
    assert result.error_at_zero_residual == max(e for e, r in pairs if r == 0.0)
    assert result.estimate(info._replace(residual=torch.zeros(1))).item() == pytest.approx(
        result.error_at_zero_residual
    )
    assert result.residual_limit <= max(breaking.residuals) * result.error / breaking.error
    assert result.estimate(info)[0] == pytest.approx(result.error_per_residual * float(info.residual[0]))
    doubted = info._replace(residual=torch.tensor([2.0 * result.residual_limit, math.nan]))
    assert result.is_valid(doubted).tolist() == [False, False]


def test_an_audit_finds_the_error() -> None:
    """Three times as many iterations later hardly any error is left, so the way there is the error that was."""
    sim = bar(dtype=torch.float64)
    result = sim.tune(swinging(sim), error=1e-2)
    state = swinging(sim, batch=2)
    after = sim(state)
    found = result.verify(sim, state, after)
    true = worst_error(sim, state)
    assert found.shape == (2,)
    assert float(found.max()) == pytest.approx(true, rel=0.3)
    assert sim.iterations == result.iterations


def test_what_is_not_doubted_is_not_audited(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = bar(dtype=torch.float64)
    result = sim.tune(swinging(sim), error=1e-2)
    state = swinging(sim, batch=3)
    after, info = sim(state, return_info=True)
    full = result.verify(sim, state, after)
    # residuals at which half and twice the error bound are expected, and none
    edge = result.error / result.error_per_residual
    told = info._replace(residual=torch.tensor([0.5 * edge, 2.0 * edge, math.nan], dtype=torch.float64))
    found = result.verify(sim, state, after, info=told)
    assert float(found[0]) == pytest.approx(0.5 * result.error)
    assert torch.equal(found[1:], full[1:])
    result.invalidate(True)
    assert torch.equal(result.verify(sim, state, after, info=told), full)
    result.invalidate(False)
    calls: list[object] = []
    monkeypatch.setattr(pd.Simulator, "forward", lambda *given, **more: calls.append(given))
    calm = info._replace(residual=torch.full((3,), 0.5 * edge, dtype=torch.float64))
    assert result.verify(sim, state, after, info=calm).tolist() == result.estimate(calm).tolist()
    assert calls == []


@pytest.mark.parametrize("error", [1e-5, 1e-7])
def test_rounding_is_told_apart_from_error(error: float) -> None:
    """Rounding of a float32 step, 10 eps |x|, is more than these bounds, which hold beyond it."""
    sim = bar()
    state = swinging(sim)
    with pytest.warns(TuningWarning, match=r"rounding exceeds the error in every studied state.*dtype=torch.float64"):
        result = sim.tune(state, error=error)
    assert result.attained
    (exact,) = exact_steps(sim, state)
    share = 10.0 * 2.0**-23 * float(state.positions.norm()) / exact.scale
    assert share > 10.0 * error
    assert result.rounding >= 0.999 * share
    assert str(result).startswith(f"error {error:.1e} plus rounding of up to {result.rounding:.1e}, ")
    assert result.verify(sim, state, sim(state)).tolist() == [0.0]
    sim.iterations //= 4
    found = float(result.verify(sim, state, sim(state)))
    assert found == pytest.approx(worst_error(sim, state), rel=0.3)
    assert found > error


def test_a_body_at_rest_has_no_error() -> None:
    sim = bar()
    result = sim.tune(swinging(sim), error=1e-2)
    still = pd.Scene(pd.Solid(pd.shapes.single_tet(), youngs=1e4))
    other = pd.Simulator(still, sim.time_step, progress=False)
    state = other.rest_state(2)
    assert result.verify(other, state, other(state)).tolist() == [0.0, 0.0]


def test_what_few_iterations_more_than_solve_is_watched_too() -> None:
    """The chosen iterations err by rounding alone; the most that exceed the bound calibrate the residual."""
    sim = bar(youngs=1e2)
    state = swinging(sim)
    result = sim.tune(state, error=1e-2, candidates=[pd.Multilevel()])
    assert result.studied_error < 1e-6
    assert bool(result.is_valid(sim(state, return_info=True)[1]))
    sim.iterations = 1
    after, info = sim(state, return_info=True)
    (exact,) = exact_steps(sim, state)
    assert exact.errors_of(after.velocities[0].double().numpy() * sim.time_step).position > 2.0 * result.error
    assert not bool(result.is_valid(info))
    assert float(result.estimate(info)) > result.error


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_result_for_a_time_is_watched_as_well(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Far more iterations are paid for than are needed: trials of fewer say what a residual means."""
    monkeypatch.setattr(tuning, "_milliseconds", lambda sim, start, trial: 0.01 * trial.iterations)
    sim = bar(dtype=dtype)
    result = sim.tune(swinging(sim), milliseconds=1.0, candidates=[pd.Chebyshev()])
    assert result.iterations <= 95
    assert result.error <= result.rounding  # so many iterations leave nothing else
    chosen = result.trials[-1]
    assert result.residual_limit >= 1.5 * max(chosen.residuals)
    broken = min((trial for trial in result.trials if trial.error > result.error), key=lambda trial: trial.error)
    assert 0 < broken.iterations < result.iterations
    state = swinging(sim, speed=-2.0)
    for _ in range(30):
        state, info = sim(state, return_info=True)
        assert bool(result.is_valid(info))
        # of such a residual rounding is the larger part, or it is 0 and says no more than in the study
        assert float(result.estimate(info)) <= max(result.error + result.rounding, result.error_at_zero_residual)
        assert result.error_at_zero_residual <= broken.error
    sim.iterations = broken.iterations // 2
    info = sim(state, return_info=True)[1]
    assert not bool(result.is_valid(info))
    assert float(result.estimate(info)) > result.error


def test_a_residual_of_nothing_is_no_error_of_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding hides what is left there. The nearest trial beyond the bound has no residual, a further one has."""
    monkeypatch.setattr(tuning.Study, "roundings", [0.0, 0.0])
    study = object.__new__(tuning.Study)
    solver = pd.Chebyshev()
    chosen = Trial(solver, 20, 4.0, (0.0, 1.0), (3.0, 4.0))
    silent = Trial(solver, 10, 12.0, (0.0, 0.0), (12.0, 11.0))
    telling = Trial(solver, 5, 30.0, (0.0, 4.0), (6.0, 30.0))
    # twice the residual of the chosen one, which is more than 4 * 10 / 30; 30 / 4; and the error that breaks it unseen
    assert tuning._residual_limit(study, [telling, silent, chosen], 10.0) == (2.0, 7.5, 12.0)


def test_an_audit_is_told_where_pins_are() -> None:
    sim = bar(dtype=torch.float64)
    result = sim.tune(swinging(sim), error=1e-2)
    state, targets = sim.rest_state(), sim.pin_targets + torch.tensor([0.0, 0.05, 0.0], dtype=torch.float64)
    after = sim(state, targets=targets)
    assert float(result.verify(sim, state, after, targets=targets)) <= result.error
    assert float(result.verify(sim, state, after)) > 1.0  # of another step


def test_asking_about_another_simulator_changes_nothing(tuned: tuple[pd.Simulator, TuningResult]) -> None:
    sim, result = copy.deepcopy(tuned)
    sim.tuning_result = result
    other = copy.deepcopy(sim)
    other.set_material(stiffness=1e3 * other.stiffness)
    _, info = sim(swinging(sim), return_info=True)
    held = result.is_valid(info)
    assert not result.matches(other)
    assert torch.equal(result.is_valid(info), held)
    assert "another material" not in str(result)
    assert pickle.loads(pickle.dumps(result)) == result
    with pytest.raises(AttributeError):
        result.error = 1.0  # type: ignore[misc]


def material_twice(sim: pd.Simulator) -> None:
    sim.set_material(stiffness=1000.0 * sim.stiffness)


def material_from_a_checkpoint(sim: pd.Simulator) -> None:
    sim.load_state_dict({**sim.state_dict(), "stiffness": 1000.0 * sim.stiffness})


def material_in_place(sim: pd.Simulator) -> None:
    with torch.no_grad():
        sim.stiffness *= 1000.0


@pytest.mark.parametrize("change", [material_twice, material_from_a_checkpoint, material_in_place])
def test_a_result_is_for_its_material(change: Callable[[pd.Simulator], None]) -> None:
    sim = bar(1e3)
    state = swinging(sim)
    result = sim.tune(state, error=1e-2)
    sim.set_material(stiffness=sim.stiffness.clone())  # the same numbers
    assert "another material" not in repr(sim)
    assert result.matches(copy.deepcopy(sim))
    change(sim)
    assert "for another material" in repr(sim)
    assert not result.matches(sim)
    assert result.is_valid(sim(state, return_info=True)[1]).tolist() == [False]
    assert worst_error(sim, state) > result.error


def test_what_is_no_info_is_named(tuned: tuple[pd.Simulator, TuningResult]) -> None:
    sim, result = tuned
    for ask in (result.is_valid, result.estimate):
        with pytest.raises(TypeError, match=r"info .* Info, .* got tuple"):
            ask(sim(sim.rest_state(), return_info=True))  # type: ignore[arg-type]


def test_former_names_work_and_warn(tuned: tuple[pd.Simulator, TuningResult]) -> None:
    sim, result = copy.deepcopy(tuned)
    former = {name: value for name, value in vars(TuningResult).items() if isinstance(value, Renamed)}
    assert len(former) == 7
    for name, value in former.items():
        with pytest.warns(DeprecationWarning, match=rf"^TuningResult\.{name} is now called {value.now}: ") as caught:
            assert getattr(result, name) == getattr(result, value.now)
        assert [warning.filename for warning in caught] == [__file__]
    with pytest.warns(DeprecationWarning, match=r"^Simulator\.promise .*tuning_result:"):
        assert sim.promise is sim.tuning_result
    with pytest.warns(DeprecationWarning, match=r"^Simulator\.numbers .*step_settings:"):
        assert sim.numbers(inertial=False, report=False) == sim.step_settings(inertial=False, report=False)
    with pytest.warns(DeprecationWarning, match="tuning_result"):
        sim.promise = None
    assert sim.tuning_result is None
