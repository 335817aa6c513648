"""torch.compile and torch.export see whole graphs and the same numbers."""

from __future__ import annotations

from typing import Literal, cast

import pytest
import torch
from runs import ULP, noise, small
from torch import Tensor

import torchpd as pd
from torchpd.solvers import Solver

ops = torch.ops.torchpd
BATCH = 3


@pytest.mark.parametrize("dynamic", [False, True])
def test_compiled_step_is_the_step(dynamic: bool) -> None:
    sim, state = small(torch.float32)
    forces = noise(state.positions)

    def advance(x: Tensor, v: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
        after = sim(pd.State(2.0 * x - x, v), 1.0 * f)
        return after.positions, after.velocities + 1.0

    compiled = torch.compile(advance, fullgraph=True, backend="aot_eager", dynamic=dynamic)
    x, v = compiled(*state, forces)
    expected = sim(state, forces)
    assert torch.equal(x, expected.positions)
    assert torch.equal(v, expected.velocities + 1.0)


@pytest.mark.parametrize("outer", ["lbfgs", "momentum"])
def test_compiled_multilevel_step_has_its_gradient(outer: Literal["lbfgs", "momentum"]) -> None:
    sim, state = small(torch.float64, solver=pd.Multilevel(outer), iterations=60)
    sim.stiffness.requires_grad_()

    def loss(v: Tensor) -> Tensor:
        after = sim(pd.State(state.positions, 1.0 * v))
        return after.positions.square().sum() + after.velocities.sum()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    (expected,) = torch.autograd.grad(loss(state.velocities), sim.stiffness)
    (found,) = torch.autograd.grad(compiled(state.velocities), sim.stiffness)
    assert float((found - expected).abs().max()) <= 64 * ULP[torch.float64] * float(expected.abs().max())


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
def test_compiled_rollout_is_the_rollout(solver: Solver) -> None:
    sim, state = small(torch.float32, solver=solver)

    def play(x: Tensor, v: Tensor) -> Tensor:
        return sim.rollout(pd.State(x, v), 6, every=2).positions.mean(dim=2)

    assert torch.equal(torch.compile(play, fullgraph=True, backend="aot_eager")(*state), play(*state))


def test_compiled_energy_has_its_gradient() -> None:
    sim, state = small(torch.float64)

    def energy(x: Tensor) -> Tensor:
        return sim.energy(x).sum()

    x = state.positions.clone().requires_grad_()
    (expected,) = torch.autograd.grad(energy(x), x)
    compiled = torch.compile(energy, fullgraph=True, backend="aot_eager")
    (found,) = torch.autograd.grad(compiled(x), x)
    # the decomposed backward may add up in another order
    assert float((found - expected).abs().max()) <= 64 * ULP[torch.float64] * float(expected.abs().max())


def test_export_keeps_the_ops() -> None:
    sim, state = small(torch.float32)

    class Model(torch.nn.Module):
        def forward(self, matrices: Tensor) -> Tensor:
            return cast(Tensor, ops.nearest_rotation(matrices))

    given = noise(torch.empty(4, 3, 3))
    program = torch.export.export(Model(), (given,))
    assert any(node.target is ops.nearest_rotation.default for node in program.graph.nodes)
    assert torch.equal(program.module()(given), pd.nearest_rotation(given))
    assert sim.vertices == state.positions.shape[1]
