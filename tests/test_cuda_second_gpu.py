"""On the second GPU of a host, which is not the current one, everything gives the bits that it gives on the first."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from devices import require_gpu
from on_gpu import bar
from runs import same_bits, simulator, state_of

import torchpd as pd
from torchpd.gpu import properties_of

require_gpu()

FIRST, SECOND = torch.device("cuda", 0), torch.device("cuda", 1)
pytestmark = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
KERNELS = ("block", "cluster", "grid", "stream")
SOLVERS = (pd.Chebyshev(), pd.Multilevel())


def on(device: torch.device, kernel: str, solver: pd.Chebyshev | pd.Multilevel) -> tuple[pd.Simulator, pd.State]:
    """A scene of several effects, and a batch of states that move."""
    case = bar((8, 4, 4), pd.Gravity(), pd.Ground(-0.02, friction=0.4), pd.Damping(0.5))
    sim = simulator(case, torch.float32, device, kernel=kernel, solver=solver, iterations=12)
    return sim, state_of(case, sim, 5)


def kernels_of(solver: pd.Chebyshev | pd.Multilevel) -> tuple[str, ...]:
    if isinstance(solver, pd.Multilevel):
        return ("stream",)
    return tuple(name for name in KERNELS if name != "cluster" or properties_of(SECOND).cluster > 1)


@pytest.fixture(autouse=True)
def current_stays_the_first() -> None:
    assert torch.cuda.current_device() == 0


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_steps_rollouts_and_graphs(solver: pd.Chebyshev | pd.Multilevel) -> None:
    same = properties_of(FIRST) == properties_of(SECOND)
    for kernel in kernels_of(solver):
        sim, state = on(SECOND, kernel, solver)
        after, info = sim(state, return_info=True)
        assert after.positions.device == info.residual.device == SECOND
        assert torch.cuda.current_device() == 0
        if same:
            first, begin = on(FIRST, kernel, solver)
            assert same_bits(after.to("cpu"), first(begin).to("cpu"))
        track = sim.rollout(state, 3)
        stepped = state
        for _ in range(3):
            stepped = sim(stepped)
        assert torch.equal(track.positions[-1], stepped.positions)
        moved = pd.State(*(t.clone() for t in state))
        step = sim.capture(moved)
        step.replay()
        torch.cuda.synchronize(SECOND)
        assert same_bits(moved, after)
        assert torch.cuda.current_device() == 0


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_gradients(solver: pd.Chebyshev | pd.Multilevel) -> None:
    found = []
    for device in (FIRST, SECOND):
        sim, state = on(device, "auto", solver)
        x = state.positions.requires_grad_()
        sim.stiffness.requires_grad_()
        sim(pd.State(x, state.velocities)).positions.square().sum().backward()
        assert x.grad is not None
        assert sim.stiffness.grad is not None
        assert x.grad.device == sim.stiffness.grad.device == device
        found.append((x.grad.cpu(), sim.stiffness.grad.cpu()))
    for first, second in zip(*found, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-6 * float(first.abs().max()))


def test_a_simulator_moves_between_them(tmp_path: Path) -> None:
    sim, state = on(FIRST, "auto", pd.Chebyshev())
    expected = sim(state).to("cpu")
    assert same_bits(sim.to(SECOND)(state.to(SECOND)).to("cpu"), expected)
    sim.save(tmp_path / "bar.safetensors")
    assert same_bits(pd.Simulator.load(tmp_path / "bar.safetensors").to(SECOND)(state.to(SECOND)).to("cpu"), expected)


def test_a_state_on_the_other_one_is_refused() -> None:
    sim, state = on(SECOND, "auto", pd.Chebyshev())
    with pytest.raises(ValueError, match=r"positions must be on cuda:1, got cuda:0"):
        sim(state.to(FIRST))
    assert bool(sim(state).positions.isfinite().all())
