"""Gradients through colliders with a mass on a GPU: those of the CPU, and the same bits in a batch."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from devices import require_gpu
from on_gpu import GPU, relative
from rigid_scenes import RIGID_CASES, RigidStep, ball, batched, pushed_plate, row

require_gpu()

NAMES = ("positions", "velocities", "forces", "poses", "motion", "wrenches", "stiffness", "gravity")


@pytest.mark.parametrize("name", RIGID_CASES)
def test_the_gradients_of_the_cpu(name: str) -> None:
    """Of a converged step, whose places differ by rounding: to 1e-6."""
    step = RIGID_CASES[name]()
    wanted, found = step.gradients(), step.on(GPU).gradients()
    most = {key: relative(found[key], wanted[key]) for key in NAMES if float(wanted[key].norm()) > 1e-12}
    assert max(most.values()) <= 1e-6, most


def test_float32() -> None:
    """To 5e-3 of the gradient in double on the CPU."""
    step = ball()
    wanted, found = step.gradients(), step.on(GPU, torch.float32).gradients()
    for key in ("positions", "velocities", "motion", "wrenches"):
        assert found[key].dtype == torch.float32
        assert relative(found[key], wanted[key]) <= 5e-3, key


@pytest.mark.parametrize("make", [ball, pushed_plate])
def test_the_same_bits_in_a_batch(make: Callable[[], RigidStep], dtype: torch.dtype) -> None:
    """40 environments, each as alone, and every time."""
    step = batched(make(), 40).on(GPU, dtype)
    together, again = step.gradients(), step.gradients()
    names = ("positions", "velocities", "poses", "motion")
    for name in names:
        assert torch.equal(together[name], again[name]), name
    assert not torch.equal(together["motion"][0], together["motion"][39])
    for number in (0, 17, 39):
        alone = row(step, number).gradients()
        for name in names:
            assert torch.equal(together[name][number], alone[name][0]), name
