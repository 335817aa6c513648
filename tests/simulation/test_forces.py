"""Forces that all environments share are those forces in each of them."""

from __future__ import annotations

import pytest
import torch
from runs import noise, same_bits, small
from torch import Tensor

import torchpd as pd
from torchpd.accuracy.error import exact_steps

ONE = pytest.mark.parametrize("front", [(), (1,)], ids=["without a batch", "of one"])


def shared(state: pd.State, front: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Forces of no environment in particular, and the same of every one."""
    forces = 0.1 * noise(state.positions[0])
    return forces.reshape(*front, *forces.shape), forces.repeat(len(state.positions), 1, 1)


@ONE
def test_shared_forces_push_every_environment(front: tuple[int, ...], device: torch.device) -> None:
    sim, state = small(torch.float32)
    sim, state = sim.to(device), state.to(device)
    few, many = shared(state, front)
    for after, expected in (
        (sim(state, few), sim(state, many)),
        (sim.rollout(state, 4, 2, forces=few), sim.rollout(state, 4, 2, forces=many)),
        (sim.rollout(state, 4, forces=lambda k: k * few), sim.rollout(state, 4, forces=lambda k: k * many)),
    ):
        assert same_bits(pd.State(*after[:2]), pd.State(*expected[:2]))
    moved = [state.clone(), state.clone()]
    for mine, forces in zip(moved, (few, many), strict=True):
        sim.step_(mine, forces)
    assert same_bits(*moved)
    after = sim(state, few)
    assert torch.equal(sim.step_gradient(state, after, few), sim.step_gradient(state, after, many))
    assert not torch.equal(after.positions, sim(state).positions)


@ONE
def test_their_gradient_is_the_sum_over_environments(front: tuple[int, ...]) -> None:
    sim, state = small(torch.float64, iterations=300)
    few, many = (forces.requires_grad_() for forces in shared(state, front))

    def slope(forces: Tensor) -> Tensor:
        loss = (noise(state.positions, 1) * sim.rollout(state, 2, forces=forces).positions).sum()
        return torch.autograd.grad(loss, forces)[0]

    assert slope(few).shape == few.shape
    torch.testing.assert_close(slope(few), slope(many).sum(0).view_as(few), rtol=1e-12, atol=0.0)


@ONE
def test_shared_forces_are_compiled(front: tuple[int, ...]) -> None:
    sim, state = small(torch.float32)
    few, _ = shared(state, front)

    def advance(x: Tensor, v: Tensor, forces: Tensor) -> Tensor:
        return sim(pd.State(x, v), forces).positions

    for dynamic in (False, True):
        compiled = torch.compile(advance, fullgraph=True, backend="aot_eager", dynamic=dynamic)
        assert torch.equal(compiled(*state, few), advance(*state, few))


@ONE
def test_the_converged_step_has_them_too(front: tuple[int, ...]) -> None:
    sim, state = small(torch.float64)
    few, many = shared(state, front)
    found, expected = (exact_steps(sim, state, forces=forces) for forces in (few, many))
    for mine, theirs in zip(found, expected, strict=True):
        assert (mine.solution == theirs.solution).all()
