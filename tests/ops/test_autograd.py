"""What torch does around a step: modes of differentiation, what is saved, compiled, cast."""

from __future__ import annotations

import gc
import warnings
import weakref
from collections.abc import Callable

import pytest
import torch
import torch._dynamo.compiled_autograd
from adjoint_cases import body
from runs import same_bits

import torchpd as pd
from torchpd.ops.diagonal import step_diagonal


def test_forward_mode_is_refused() -> None:
    sim, state = body(iterations=10)
    for function in (
        lambda x: sim(pd.State(x, state.velocities)).positions,
        lambda x: sim.rollout(pd.State(x, state.velocities), 2).positions,
        lambda x: sim.energy(x),
    ):
        with pytest.raises(RuntimeError, match="forward-mode"):
            torch.func.jvp(function, (state.positions,), (torch.ones_like(state.positions),))
    F = torch.eye(3, dtype=torch.float64)
    with pytest.raises(RuntimeError, match="forward-mode"):
        torch.func.jvp(pd.nearest_rotation, (F,), (F,))


@pytest.mark.parametrize("steps", [0, 2])
def test_functional_gradients_are_refused(steps: int) -> None:
    sim, state = body(iterations=10)

    def loss(x: torch.Tensor) -> torch.Tensor:
        start = pd.State(x, state.velocities)
        return (sim.rollout(start, steps) if steps else sim(start)).positions.sum()

    for function in (torch.func.grad(loss), torch.func.jacrev(loss)):
        with pytest.raises(RuntimeError, match=r"within torch.func.grad, .*use torch.autograd.grad"):
            function(state.positions)


def test_info_is_no_function_to_differentiate() -> None:
    sim, state = body(iterations=10)
    _, info = sim(pd.State(state.positions.clone().requires_grad_(), state.velocities), return_info=True)
    assert not info.energy.requires_grad


@pytest.mark.parametrize("steps", [0, 2])
def test_compiled_autograd(steps: int) -> None:
    """Which traces what backward does, and knows of C++ only what it can pack."""
    sim, state = body(iterations=100)
    x, stiffness = state.positions.clone().requires_grad_(), sim.stiffness.requires_grad_()

    def loss() -> torch.Tensor:
        start = pd.State(x, state.velocities)
        return (sim.rollout(start, steps) if steps else sim(start)).positions.square().sum()

    wanted = torch.autograd.grad(loss(), [x, stiffness])
    with torch._dynamo.compiled_autograd._enable(torch.compile(backend="eager")):
        loss().backward()
    assert x.grad is not None
    assert stiffness.grad is not None
    assert torch.equal(x.grad, wanted[0])
    assert torch.equal(stiffness.grad, wanted[1])


def test_what_was_saved_goes_with_backward() -> None:
    """A loss that somebody keeps does not keep the plan."""
    sim, state = body(iterations=10)
    loss = sim(pd.State(state.positions.requires_grad_(), state.velocities)).positions.sum()
    loss.backward()
    alive = [weakref.ref(array) for array in sim.plan.arrays]
    del sim
    gc.collect()
    assert not any(array() is not None for array in alive)


def test_a_state_that_changed_since_is_noticed() -> None:
    sim, state = body(iterations=10)
    velocities = state.velocities.clone()
    after = sim(pd.State(state.positions.clone().requires_grad_(), velocities)).positions.sum()
    velocities += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        after.backward()


def test_material_that_is_copied_loses_its_history_aloud() -> None:
    sim, state = body(iterations=50)
    factor = torch.ones((), dtype=torch.float64, requires_grad=True)
    with pytest.warns(UserWarning, match=r'torch\.func\.functional_call\(sim, \{"stiffness": \.\.\.\}, \(state,\)\)'):
        sim.set_material(stiffness=factor * sim.stiffness)
    assert not sim.stiffness.requires_grad
    after = torch.func.functional_call(sim, {"stiffness": factor * sim.stiffness}, (state,))
    (slope,) = torch.autograd.grad(after[0].square().sum(), factor)
    sim.stiffness.requires_grad_()
    (gradient,) = torch.autograd.grad(sim(state).positions.square().sum(), sim.stiffness)
    assert float(slope) == pytest.approx(float((gradient * sim.stiffness.detach()).sum()), rel=1e-12)
    with torch.no_grad():
        sim.set_material(stiffness=factor * sim.stiffness)  # there is no history to lose


def test_parts_of_a_scene_lose_their_history_aloud() -> None:
    solid = pd.Solid(pd.shapes.box((1.0, 1.0, 1.0), (1, 1, 1)), 1e4)
    one, three = torch.ones((), requires_grad=True), torch.ones(3, requires_grad=True)
    makers: dict[str, Callable[[], object]] = {
        "Solid.youngs": lambda: pd.Solid(solid.mesh, youngs=1e4 * one),
        "Solid.density": lambda: pd.Solid(solid.mesh, 1e4, density=1e3 * one),
        "Gravity.vector": lambda: pd.Gravity(three),
        "Pin.stiffness": lambda: pd.Pin(solid, [0], stiffness=one),
        "Damping.rate": lambda: pd.Damping(one),
        "Ground.height": lambda: pd.Ground(one),
        "Sphere.center": lambda: pd.Sphere(three, 1.0),
        "TetMesh.vertices": lambda: pd.TetMesh(torch.tensor(solid.mesh.vertices).requires_grad_(), solid.mesh.tets),
    }
    for name, make in makers.items():
        with pytest.warns(UserWarning, match=rf"^{name} is copied, so no gradient reaches .* detach"):
            make()
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("error")
            make()


def test_material_in_any_layout_is_material() -> None:
    """As functional_call brings it, with targets and without, and as a parametrization makes it."""
    sim, _ = body(iterations=10)
    state = sim.rest_state(2)
    wide = {name: array.detach().expand(2, *array.shape) for name, array in sim.named_parameters()}
    expected = sim(state)
    for targets in (None, sim.pin_targets.detach()):
        assert same_bits(torch.func.functional_call(sim, wide, (state,), {"targets": targets}), expected)
    gradient, diagonal = sim.gradient(expected), step_diagonal(sim.plan.arrays, sim.material(), sim.time_step)
    for name, array in wide.items():
        setattr(sim, name, torch.nn.Parameter(array, requires_grad=False))
    assert same_bits(sim(state), expected)
    assert same_bits(sim.rollout(state, 1).state(), expected)
    assert torch.equal(sim.gradient(expected), gradient)
    for one, other in zip(step_diagonal(sim.plan.arrays, sim.material(), sim.time_step), diagonal, strict=True):
        assert torch.equal(one, other.expand_as(one))


def test_what_has_no_derivative_says_so() -> None:
    sim, state = body(pd.Ground(-10.0))
    start = state.positions.clone().requires_grad_()
    settings = sim.step_settings(inertial=False, report=False)
    positions, *_ = torch.ops.torchpd.step(*state, None, start, sim.material(), list(sim.plan.arrays), **settings)
    with pytest.raises(RuntimeError, match="first iterate"):
        positions.sum().backward()


def test_second_derivatives_are_refused() -> None:
    """Of the op and of a rollout; first ones that could have been differentiated again are the same."""
    sim, state = body(iterations=50)
    v = state.velocities.clone().requires_grad_()
    (once,) = torch.autograd.grad(sim(pd.State(state.positions, v)).positions.square().sum(), v)
    for step in (sim, lambda state: sim.rollout(state, 1).state(0)):
        loss = step(pd.State(state.positions, v)).positions.square().sum()
        (again,) = torch.autograd.grad(loss, v, create_graph=True)
        assert torch.equal(again, once)
        with pytest.raises(RuntimeError, match="torchpd: a step has first derivatives only"):
            again.square().sum().backward()
    with pytest.raises(RuntimeError, match="torchpd: a step has first derivatives only"):
        torch.autograd.gradgradcheck(lambda v: sim(pd.State(state.positions, v)).positions, v)


def test_compiles_with_its_backward() -> None:
    sim, state = body(iterations=100)
    x = state.positions.clone().requires_grad_()

    def step(x: torch.Tensor) -> torch.Tensor:
        return sim(pd.State(x, state.velocities)).positions.square().sum()

    (expected,) = torch.autograd.grad(step(x), x)
    (compiled,) = torch.autograd.grad(torch.compile(step, fullgraph=True, backend="aot_eager")(x), x)
    assert torch.equal(compiled, expected)


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["plain", "levels"])
def test_autocast_does_not_touch_the_adjoint(solver: pd.scene.solvers.Solver) -> None:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (8, 2, 2))
    bar = pd.Solid(mesh, 5e4)
    scene = pd.Scene(bar, pd.Pin(bar, mesh.vertices[:, 0] == 0.0), pd.Gravity(), pd.Sphere((0.5, -0.3, 0.13), 0.3, 0.3))
    sim = pd.Simulator(scene, 1 / 60, 200, solver=solver)
    sim.stiffness.requires_grad_()

    def gradient(lower: bool) -> torch.Tensor:
        state = sim.rest_state(2)
        with torch.autocast("cpu", torch.bfloat16, enabled=lower):
            for _ in range(6):
                state = sim(state)
            (result,) = torch.autograd.grad(state.positions.square().sum(), sim.stiffness)
        return result

    torch.testing.assert_close(gradient(True), gradient(False), rtol=0, atol=0)


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["plain", "levels"])
@pytest.mark.parametrize("factor", [1e-25, 1e20])
def test_a_loss_may_be_of_any_size(factor: float, solver: pd.scene.solvers.Solver, device: torch.device) -> None:
    """In float32, where the squares of its gradients would be zero, or infinite; nobody warns."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (8, 2, 2))
    bar = pd.Solid(mesh, 5e4)
    scene = pd.Scene(bar, pd.Pin(bar, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, 1 / 60, 200, solver=solver).to(device)
    sim.stiffness.requires_grad_()
    state = sim.rest_state(2)
    velocities = state.velocities.clone().requires_grad_()
    inputs = [velocities, sim.stiffness]
    usual, scaled = (
        torch.autograd.grad(size * sim(pd.State(state.positions, velocities)).positions.sum(), inputs)
        for size in (1.0, factor)
    )
    for one, other in zip(usual, scaled, strict=True):
        torch.testing.assert_close(other.double() / factor, one.double(), rtol=1e-3, atol=1e-4 * float(one.abs().max()))


@pytest.mark.parametrize("parts", [(), (pd.Ground(-0.02, friction=0.3),)], ids=["free", "rough ground"])
def test_a_loss_may_leave_out_an_environment_of_no_number(
    parts: tuple[pd.scene.Part, ...], device: torch.device
) -> None:
    """Then what environments share has the gradient of the others, by the bits."""
    solid = pd.Solid(pd.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)), youngs=1e4)
    pin = pd.Pin(solid, solid.mesh.vertices[:, 1] > 0.09, stiffness=100.0)
    scene = pd.Scene(solid, pin, pd.Gravity(), pd.Damping(0.1), *parts)
    sim = pd.Simulator(scene, 1 / 60, 40, dtype=torch.float64, progress=False).to(device)
    shared = [getattr(sim, name) for name in ("stiffness", "masses", "gravity", "damping", "pin_stiffness")]
    state = sim.rest_state(3)
    state.velocities[:] = torch.tensor([[0.3, -1.0, 0.1], [0.0, -2.0, 0.0], [0.5, -0.5, 0.0]])[:, None]
    state.velocities[1, 3] = torch.nan
    push = torch.zeros_like(state.positions).requires_grad_()

    def gradients(kept: torch.Tensor) -> list[torch.Tensor]:
        for array in shared:
            array.requires_grad_()
        track = sim.rollout(state, 2, forces=push)
        ends = track.state().where(kept, sim.rest_state(3))
        loss = (ends.positions.square().sum((1, 2)) + ends.velocities[..., 0].sum(1))[kept].sum()
        return list(torch.autograd.grad(loss, [push, *shared]))

    kept = torch.tensor([True, False, True], device=device)
    found = gradients(kept)
    assert all(bool(gradient.isfinite().all()) for gradient in found)
    assert not bool(found[0][1].any())
    state.velocities[1, 3] = 0.0
    for gradient, expected in zip(found, gradients(kept), strict=True):
        assert torch.equal(gradient, expected)
