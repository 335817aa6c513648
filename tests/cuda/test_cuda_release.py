"""On a GPU pins that are let go let go, without a wait, and a captured step sees the masks that come later."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from devices import require_gpu
from held_bar import BAR, LEFT, H, fallen, way
from on_gpu import DTYPES, GPU, KERNELS, compiled_for, host_waits
from runs import same_bits

import torchpd as pd
from torchpd.scene.solvers import Solver

require_gpu()

precisions = pytest.mark.parametrize("precision", DTYPES)
kernels = pytest.mark.parametrize("kernel", KERNELS)
CONTACTS = pd.Ground(-0.001, friction=0.4), pd.Sphere((0.15, -0.05, 0.05), 0.06, friction=0.2)


def simulator(
    precision: str, kernel: str, *parts: pd.scene.Part, iterations: int = 64, solver: Solver | None = None
) -> pd.Simulator:
    bar = pd.Solid(BAR, youngs=1e7)
    scene = pd.Scene(bar, pd.Pin(bar, LEFT), pd.Gravity(), *parts)
    with compiled_for(kernel) as name:
        sim = pd.Simulator(scene, H, iterations, solver, DTYPES[precision], kernel=name, progress=False)
        return sim.to(GPU)


def masks() -> torch.Tensor:
    """Of nine environments, which leave everything, a turn about a line or a point, or nothing."""
    line = np.isin(LEFT, np.flatnonzero(BAR.vertices[:, 1] == BAR.vertices[:, 1].min()))
    five = np.stack([line | True, line & False, line, np.arange(len(LEFT)) == 0, ~line])
    return torch.tensor(five[np.arange(9) % 5])


@kernels
@precisions
@pytest.mark.parametrize("how", ["set_material", "in place"])
@pytest.mark.parametrize("solver", [None, pd.Multilevel()], ids=["plain", "levels"])
def test_a_body_that_is_let_go_falls(how: str, kernel: str, precision: str, solver: Solver | None) -> None:
    sim = simulator(precision, "auto" if solver else kernel, solver=solver)
    sim.set_material(pin_hard=torch.tensor([[True], [True]]))
    state = sim.rest_state()
    if how == "in place":
        sim.pin_hard[1] = False
    else:
        sim.set_material(pin_hard=torch.tensor([[True], [False]]))
    for _ in range(6):
        state = sim(state)
    heights = way(sim, state.positions)
    assert float(heights[1]) == pytest.approx(fallen(6), rel=1e-4)
    assert torch.equal(state.positions[0, LEFT], sim.rest_positions[LEFT])
    sim.set_material(pin_hard=True, pin_targets=state.positions[:, LEFT])
    assert torch.equal(sim(state).positions[:, LEFT], sim.pin_targets)


@kernels
@precisions
def test_what_is_held_in_some_environments_has_the_bits_that_it_has_alone(kernel: str, precision: str) -> None:
    sim, alone = (simulator(precision, kernel, *CONTACTS, iterations=12) for _ in range(2))
    sim.set_material(pin_hard=masks())
    # of one plan: with free pieces the patches of kernel grid are others
    alone.set_material(pin_hard=masks())
    state = sim.rest_state()
    noise = torch.randn(state.positions.shape, generator=torch.Generator().manual_seed(0))
    state.velocities.copy_(noise)
    track = sim.rollout(state, 4)
    for item, mask in enumerate(masks()):
        alone.set_material(pin_hard=mask)
        single = alone.rollout(pd.State(state[0][item : item + 1], state[1][item : item + 1]), 4)
        assert torch.equal(single.positions[:, 0], track.positions[:, item]), item
        assert torch.equal(single.velocities[:, 0], track.velocities[:, item]), item


@kernels
@precisions
def test_a_captured_step_sees_later_masks(kernel: str, precision: str) -> None:
    sim = simulator(precision, kernel)
    sim.set_material(pin_hard=masks())
    start = sim.rest_state()
    own, eager = (pd.State(*(array.clone() for array in start)) for _ in range(2))
    step = sim.capture(own)
    for mask in (masks(), masks().roll(1, 0), torch.ones_like(masks()), torch.zeros_like(masks())):
        sim.set_material(pin_hard=mask)
        step.replay()
        sim.step_(eager)
        assert same_bits(own, eager)


@kernels
@precisions
def test_a_first_release_has_to_be_captured_again(kernel: str, precision: str) -> None:
    sim = simulator(precision, kernel)
    step = sim.capture(sim.rest_state())
    sim.set_material(pin_hard=False)
    with pytest.raises(RuntimeError, match="a body that pins no longer clamp"):
        step.replay()


@kernels
@precisions
@pytest.mark.parametrize("mask", ["hard", "soft", "some", "in place"])
def test_nobody_waits_for_a_mask(mask: str, kernel: str, precision: str) -> None:
    """But for the first step after somebody has written into one that clamps a body."""
    sim = simulator(precision, kernel)
    state = sim.rest_state(9)
    if mask == "in place":
        sim.set_material(pin_hard=masks())
        sim.pin_hard.logical_not_()
    else:
        sim.set_material(pin_hard={"hard": True, "soft": False, "some": masks()}[mask])
    for _ in range(2):
        after = sim(state)
    assert not host_waits(lambda: sim(state))
    assert not host_waits(lambda: sim.rollout(after, 2))
