"""torch.compile and torch.export see whole graphs and the same numbers."""

from __future__ import annotations

from typing import Any, Literal, cast

import pytest
import torch
from functorch.compile import make_boxed_func
from runs import ULP, noise, same_bits, small
from torch import Tensor
from torch._dynamo.backends.common import aot_autograd

import torchpd as pd
from torchpd.scene.solvers import Solver

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


def test_compiled_rollouts_of_any_length_are_two_graphs() -> None:
    """Of the length that came first, and of all others; forward and backward are one op, however many the steps.

    Lengths of 0 and 1 are graphs of their own, which is torch's rule for numbers.
    """
    sim, state = small(torch.float64, iterations=200)
    inputs = (sim.stiffness.requires_grad_(), state.velocities.requires_grad_())
    graphs: dict[str, list[str]] = {"rollout": [], "rollout_vjp": []}

    def compiler(name: str) -> Any:
        def compile_graph(graph: torch.fx.GraphModule, _: Any) -> Any:
            calls = [str(node.target) for node in graph.graph.nodes if node.op == "call_function"]
            graphs[name].append(" ".join(call for call in calls if call.startswith("torchpd")))
            return make_boxed_func(graph.forward)

        return compile_graph

    def loss(v: Tensor, steps: int, every: int) -> Tensor:
        return sim.rollout(pd.State(state.positions, v), steps, every).positions.square().sum()

    backend = aot_autograd(fw_compiler=compiler("rollout"), bw_compiler=compiler("rollout_vjp"))
    compiled = torch.compile(loss, fullgraph=True, backend=backend)
    for lengths, every, most in (((2, 3, 12, 5, 2), 1, 2), ((4, 8, 7), 2, 4), ((9, 12), 3, 5), ((1, 0), 1, 7)):
        for steps in lengths:
            found, expected = (torch.autograd.grad(play(inputs[1], steps, every), inputs) for play in (compiled, loss))
            for one, other in zip(found, expected, strict=True):
                assert float((one - other).abs().max()) <= 64 * ULP[torch.float64] * float(other.abs().max())
        assert len(graphs["rollout"]) <= most
    for name, calls in graphs.items():
        assert set(calls) == {f"torchpd.{name}.default"}


def test_compiled_rollouts_that_go_one_by_one() -> None:
    """Functions of the step number."""
    sim, state = small(torch.float64, iterations=200)
    (ball,) = sim.scene.spheres
    place = sim.spheres[0, :3].clone()
    sim.stiffness.requires_grad_()

    def functions(x: Tensor, v: Tensor) -> Tensor:
        track = sim.rollout(
            pd.State(x, v), 4, forces=lambda k: 0.1 * k * v, targets=lambda k: {ball: place + 1e-3 * (k + 1)}, first=2
        )
        return track.positions.mean(dim=2)

    def sparse(x: Tensor, v: Tensor) -> Tensor:
        return sim.rollout(pd.State(x, v), 4, every=2).positions.mean(dim=2)

    for play in (functions, sparse):
        means = torch.compile(play, fullgraph=True, backend="aot_eager")(*state), play(*state)
        assert torch.equal(*means)
        found, expected = (torch.autograd.grad(mean.square().sum(), sim.stiffness)[0] for mean in means)
        assert float((found - expected).abs().max()) <= 64 * ULP[torch.float64] * float(expected.abs().max())


def test_compiled_step_takes_pins_and_spheres_as_keys() -> None:
    """Named in the function, given to it, and in a mapping; another part is no other step by mistake."""
    body = pd.Solid(pd.shapes.box((1.0, 0.2, 0.2), (5, 1, 1)), youngs=1e5)
    first, second = pd.Pin(body, [0, 1]), pd.Pin(body, [5, 6])
    ball, other = pd.Sphere((0.5, -0.5, 0.1), 0.52, friction=0.5), pd.Sphere((2.0, 0.0, 0.0), 0.1)
    sim = pd.Simulator(pd.Scene(body, first, second, ball, other, pd.Gravity()), iterations=4)
    state, goal = sim.rest_state(), torch.zeros(2, 3)
    row = torch.tensor([0.5, -0.49, 0.1, 0.6, 0.0, 0.0])

    def named(s: pd.State, t: Tensor, r: Tensor) -> pd.State:
        return cast(pd.State, sim(s, targets={first: t, ball: r}))

    def given(s: pd.State, part: pd.Pin | pd.Sphere, t: Tensor) -> pd.State:
        return cast(pd.State, sim(s, targets={part: t}))

    def mapped(s: pd.State, targets: dict[pd.Pin | pd.Sphere, Tensor]) -> pd.State:
        return cast(pd.State, sim(s, targets=targets))

    for function, calls in (
        (named, [(goal, row), (goal + 0.1, row - 0.01)]),
        (given, [(first, goal), (second, goal), (ball, row), (other, row[:3])]),
        (mapped, [({first: goal, ball: row},), ({second: goal},), ({other: row},)]),
    ):
        compiled = torch.compile(function, fullgraph=True, backend="aot_eager")
        for arguments in calls:
            assert same_bits(compiled(state, *arguments), function(state, *arguments))


def test_compiled_gradients_are_the_gradients() -> None:
    sim, state = small(torch.float64)

    def both(s: pd.State, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return sim.gradient(s), sim.step_gradient(s, x), sim.energy(s)

    found = torch.compile(both, fullgraph=True, backend="aot_eager")(state, 1.1 * state.positions)
    for one, other in zip(found, both(state, 1.1 * state.positions), strict=True):
        assert float((one - other).abs().max()) <= 64 * ULP[torch.float64] * float(other.abs().max())


def test_compiled_states_move_and_copy() -> None:
    sim, state = small(torch.float32)

    def wide(s: pd.State) -> tuple[pd.State, Tensor]:
        return s.clone().detach().to(torch.float64), sim(s.clone()).positions

    moved, after = torch.compile(wide, fullgraph=True, backend="aot_eager")(state)
    assert same_bits(moved, pd.State(*(t.double() for t in state)))
    assert torch.equal(after, sim(state).positions)


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
