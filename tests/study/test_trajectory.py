"""What unfinished solves do to a motion is measured as it is defined, on swings with known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchpd.study.bench import Bench, Setting
from torchpd.study.results_log import Trajectory
from torchpd.study.scenes import STUDY_SCENES
from torchpd.study.trajectory import compare_trajectories, first_turn, tolerance_rows, trajectory_rows

TIME_STEP = 0.01  # s


def swing(period: float, reach: float, *, decay: float = 0.0) -> Trajectory:
    """Two probes that swing in y around 0, half as far the one; energy 1 J that decays."""
    t = np.arange(101) * TIME_STEP
    y = reach * (1.0 - np.cos(2.0 * np.pi * t / period))
    probes = np.zeros((101, 2, 3))
    probes[:, 0, 1], probes[:, 1, 1] = 0.5 * y, y
    return Trajectory(TIME_STEP, probes, np.exp(-decay * t), 1.0, 1.0)


def test_a_turning_point_is_half_a_period() -> None:
    """The parabola through three samples misses the extremum of a cosine by a share (pi h / T)^2 of the step h."""
    y = swing(0.73, 1.0).probes[:, 1, 1]
    assert first_turn(y, TIME_STEP) == pytest.approx(0.365, abs=TIME_STEP * (np.pi * TIME_STEP / 0.73) ** 2)
    assert np.isnan(first_turn(np.arange(5.0), TIME_STEP))


def test_every_measure_is_what_it_says() -> None:
    exact = swing(0.8, 1.0)
    same = compare_trajectories(exact, exact)
    assert same == pytest.approx({"path": 0.0, "turn": 0.0, "softness": 0.0, "energy": 0.0, "growth": 0.0})
    soft = compare_trajectories(swing(0.8, 1.1), exact)
    # the same swing, a tenth larger everywhere: also at its farthest
    assert soft == pytest.approx({"path": 0.1, "turn": 0.0, "softness": 0.1, "energy": 0.0, "growth": 0.0})
    slow = compare_trajectories(swing(0.88, 1.0), exact)
    assert slow["turn"] == pytest.approx(0.1, abs=1e-4)
    damped = compare_trajectories(swing(0.8, 1.0, decay=0.2), exact)
    assert damped["energy"] == pytest.approx(np.exp(-0.2) - 1.0)
    assert damped["growth"] == 0.0
    gaining = compare_trajectories(swing(0.8, 1.0, decay=-0.2), exact)
    assert gaining["growth"] == pytest.approx(np.exp(0.2) - 1.0)


def test_more_iterations_come_nearer_to_the_converged_motion() -> None:
    """And few are false softness: a solve that ends early has not yet felt the stiffness."""
    bench = Bench(STUDY_SCENES["beam"](), torch.device("cpu"))
    setting = Setting(1e5, 1 / 30, 2)
    few, more, most = trajectory_rows(bench, setting, [4, 16, 256], seconds=0.3)
    assert few.error > more.error > most.error
    assert few.more["softness"] > 0.05
    # float32 of a converged motion of ten steps
    assert most.error < 1e-4
    assert [row.default for row in (few, more, most)] == [False, False, False]
    # the converged motion is recorded once for all solvers
    (kept,) = bench.motions.values()
    (stiff,) = trajectory_rows(bench, setting, [16], seconds=0.3, name="Multilevel")
    assert [motion is kept for motion in bench.motions.values()] == [True]
    assert stiff.method == "Multilevel"
    assert stiff.error < 1e-4 < more.error
    # and a tolerance asks for few iterations where few are enough
    loose, tight = tolerance_rows(bench, setting, [1e-2, 1e-4], 64, seconds=0.3, name="Multilevel")
    assert loose.method == "Multilevel, tolerance"
    assert loose.more["tolerance"] == 1e-2
    assert 1 < loose.iterations < tight.iterations < 16
    assert loose.error > tight.error
    assert tight.error < 1e-3
