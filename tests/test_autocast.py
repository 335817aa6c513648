"""Autocast: what a network made less precise is taken, and nothing here is worked out in less than its precision."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from patch_cases import central, patches_on, towards_ball, tumbled
from torch import Tensor

import torchpd as pd


def lesser(device: torch.device, *, enabled: bool = True) -> torch.autocast:
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


class Scene:
    """A bar that is held and a ball beside it, with a network that says what pulls at it and where they are."""

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        mesh = pd.shapes.box((0.4, 0.1, 0.1), (4, 1, 1))
        bar = pd.Solid(mesh, 1e5, 1000.0)
        self.pin = pd.Pin(bar, mesh.vertices[:, 0] == 0.0)
        self.ball = pd.Sphere((0.4, -0.1, 0.05), 0.08)
        scene = pd.Scene(bar, self.pin, self.ball, pd.Gravity())
        self.sim = pd.Simulator(scene, 1 / 60, dtype=dtype, progress=False).to(device)
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(1, 3 * (self.sim.vertices + 5)).to(device)

    def controls(self) -> tuple[Tensor, dict[pd.Pin | pd.Sphere, Tensor]]:
        """Forces [V, 3], and targets of the pin [4, 3] and the ball [3]."""
        made = self.layer(torch.ones(1, 1, device=self.layer.weight.device)).view(-1, 3)
        pins, ball = self.sim.pin_targets, self.sim.spheres[0, :3]
        pins, ball = (0.01 * made[-5:-1]).to(made) + pins.to(made), 0.01 * made[-1] + ball.to(made)
        return 0.1 * made[:-5], {self.pin: pins, self.ball: ball}


@pytest.mark.parametrize("way", ["step", "step_", "rollout", "function"])
def test_what_a_network_made_is_taken(way: str, dtype: torch.dtype, device: torch.device) -> None:
    """As if it had been brought to the simulator's precision before, which changes no number."""
    scene = Scene(dtype, device)
    sim = scene.sim

    def run(make: Callable[[], tuple[Tensor, dict[pd.Pin | pd.Sphere, Tensor]]]) -> Tensor:
        forces, targets = make()
        state = sim.rest_state(2)
        if way == "step":
            return sim(state, forces, targets).positions
        if way == "step_":
            sim.step_(state, forces, targets)
            return state.positions
        if way == "rollout":
            return sim.rollout(state, 3, forces=forces, targets=targets).positions
        return sim.rollout(state, 3, forces=lambda step: make()[0], targets=lambda step: make()[1]).positions

    def brought_up() -> tuple[Tensor, dict[pd.Pin | pd.Sphere, Tensor]]:
        forces, targets = scene.controls()
        return forces.to(dtype), {part: value.to(dtype) for part, value in targets.items()}

    with lesser(device):
        assert scene.controls()[0].dtype == torch.bfloat16
        found, expected = run(scene.controls), run(brought_up)
        assert found.dtype == dtype
        assert torch.equal(found, expected)
        if way != "step_":
            gradients = [
                torch.autograd.grad(run(make).sum(), scene.layer.weight)[0] for make in (scene.controls, brought_up)
            ]
            assert torch.equal(*gradients)
            assert float(gradients[0].abs().max()) > 0.0
    forces, targets = (made.detach() if isinstance(made, Tensor) else made for made in scene.controls())
    with pytest.raises(TypeError, match=rf"forces must be {dtype} .*, got torch\.bfloat16"):
        sim(sim.rest_state(), forces.bfloat16())
    with pytest.raises(TypeError, match=rf"targets of a Pin must be {dtype} .*, got torch\.bfloat16"):
        sim(sim.rest_state(), targets={scene.pin: targets[scene.pin].bfloat16()})


def test_a_compiled_step_takes_it(device: torch.device) -> None:
    scene = Scene(torch.float32, device)

    def step(state: pd.State) -> Tensor:
        forces, targets = scene.controls()
        return scene.sim(state, forces, targets).positions

    state = scene.sim.rest_state(2)
    with lesser(device):
        compiled = torch.compile(step, fullgraph=True, backend="aot_eager")(state)
        assert torch.equal(compiled, step(state))


def test_patches_keep_their_precision(device: torch.device) -> None:
    """Their fields and transports are products of small matrices, which autocast would round."""

    def work() -> list[Tensor]:
        patches = patches_on(device=device, dtype=torch.float32)
        transport = central(patches)
        positions = tumbled(transport)
        matrices = pd.QuadricTransport(transport, patches)(positions)
        o, d = (rays.to(patches.vertices) for rays in towards_ball(100))
        depth, patch = pd.PatchRays(patches).cast_field(o, d, far=6.0)
        points = patches.vertices * 1.01
        return [matrices, depth, patch, patches.quadrics.values(points), patches.quadrics.matrices()[0]]

    expected = work()
    with lesser(device):
        found = work()
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    assert bool(expected[1].isfinite().any())
