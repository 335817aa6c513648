"""Autocast: forces that a network made half as precise are taken, and nothing is worked out in less than before."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from patch_cases import central, patches_on, towards_ball, tumbled
from torch import Tensor

import torchpd as pd


def lesser(device: torch.device) -> torch.autocast:
    return torch.autocast(device.type, torch.bfloat16)


class Scene:
    """A bar that is held, with a network that says what pulls at it."""

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        mesh = pd.shapes.box((0.4, 0.1, 0.1), (4, 1, 1))
        bar = pd.Solid(mesh, 1e5, 1000.0)
        self.pin = pd.Pin(bar, mesh.vertices[:, 0] == 0.0)
        self.sim = pd.Simulator(pd.Scene(bar, self.pin, pd.Gravity()), 1 / 60, dtype=dtype, progress=False).to(device)
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(1, 3 * self.sim.vertices).to(device)

    def forces(self) -> Tensor:
        """[V, 3]"""
        return 0.1 * self.layer(torch.ones(1, 1, device=self.layer.weight.device)).view(-1, 3)


@pytest.mark.parametrize("way", ["step", "step_", "rollout", "function"])
def test_forces_that_a_network_made_are_taken(way: str, dtype: torch.dtype, device: torch.device) -> None:
    """As if they had been brought to the simulator's precision before, which changes no number."""
    scene = Scene(dtype, device)
    sim = scene.sim

    def run(forces: Callable[[], Tensor]) -> Tensor:
        state = sim.rest_state(2)
        if way == "step":
            return sim(state, forces()).positions
        if way == "step_":
            sim.step_(state, forces())
            return state.positions
        if way == "rollout":
            return sim.rollout(state, 3, forces=forces()).positions
        return sim.rollout(state, 3, forces=lambda step: forces()).positions

    with lesser(device):
        assert scene.forces().dtype == torch.bfloat16
        found, half = run(scene.forces), scene.forces().detach()
        full = run(lambda: scene.forces().to(dtype))
    assert found.dtype == dtype
    assert torch.equal(found, full)
    assert torch.equal(found, run(lambda: half.to(dtype)))  # as without autocast
    if way != "step_":
        gradients = [torch.autograd.grad(end.sum(), scene.layer.weight)[0] for end in (found, full)]
        assert torch.equal(*gradients)
        assert float(gradients[0].abs().max()) > 0.0
    with pytest.raises(TypeError, match=rf"forces must be {dtype} .*, got torch\.bfloat16"):
        run(lambda: half)


def test_places_of_half_precision_are_refused(device: torch.device) -> None:
    """A ball at a metre would move in jumps of 8 mm, and have speeds of half a metre a second."""
    scene = Scene(torch.float32, device)
    targets = scene.sim.pin_targets.detach().bfloat16()
    with lesser(device), pytest.raises(TypeError, match=r"got torch\.bfloat16 on .*; in half precision .* millimetres"):
        scene.sim(scene.sim.rest_state(), targets={scene.pin: targets})


def test_a_compiled_step_takes_forces(device: torch.device) -> None:
    scene = Scene(torch.float32, device)

    def step(state: pd.State) -> Tensor:
        return scene.sim(state, scene.forces()).positions

    state = scene.sim.rest_state(2)
    with lesser(device):
        compiled = torch.compile(step, fullgraph=True, backend="aot_eager")(state)
        assert torch.equal(compiled, step(state))


def test_patches_keep_their_precision(device: torch.device) -> None:
    """Their fields and transports are products of small matrices, which autocast would round, there and back."""
    patches = patches_on(device=device, dtype=torch.float32)
    transport = central(patches)

    def work() -> list[Tensor]:
        positions = tumbled(transport).requires_grad_()
        matrices = pd.QuadricTransport(transport, patches)(positions)
        o, d = (rays.to(patches.vertices) for rays in towards_ball(100))
        depth, patch = pd.PatchRays(patches).cast_field(o, d, far=6.0)
        centres = patches.quadrics.centres.clone().requires_grad_()
        quadrics = pd.Quadrics(patches.quadrics.amplitudes, centres, patches.quadrics.factors)
        values = quadrics.values(patches.vertices * 1.01)
        loss = values.sum() + quadrics.matrices()[0].sum() + matrices.sin().sum()
        return [matrices, depth, patch, values, *torch.autograd.grad(loss, [positions, centres])]

    expected = work()
    with lesser(device):
        found = work()
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    assert bool(expected[1].isfinite().any())


def test_cells_are_fine_enough(device: torch.device) -> None:
    """Twice the longest edge in radii is 5.004, which autocast would round to 5."""
    patches = patches_on(device=device, dtype=torch.float32)
    q, number, row = patches.quadrics, patches.lists[2].long(), patches.lists[3].long()
    corners = patches.vertices[patches.triangles.long()][row].double()
    edges = corners - corners.roll(1, dims=1)
    longest = float((edges @ q.triangular()[number].double().mT).norm(dim=2).max())
    scale = 5.004 / (2.0 * longest)
    factors = torch.cat([q.factors[:, :3] + math.log(scale), q.factors[:, 3:] * scale], dim=1)
    scaled = patches.with_quadrics(pd.Quadrics(q.amplitudes, q.centres, factors), keep_lists=True)
    with lesser(device):
        assert pd.PatchRays(scaled).level == 6


def test_second_derivatives_of_rotations_keep_their_precision(device: torch.device) -> None:
    F = torch.eye(3, device=device) + 0.3 * torch.tensor([[0.0, 1.0, -1.0], [0.5, 0.0, 0.7], [0.2, -0.4, 0.0]]).to(
        device
    )

    def second() -> Tensor:
        f = F.clone().requires_grad_()
        weights = torch.arange(9.0, device=device).view(3, 3)
        (first,) = torch.autograd.grad((pd.nearest_rotation(f) * weights).sum(), f, create_graph=True)
        return torch.autograd.grad(first.square().sum(), f)[0]

    expected = second()
    with lesser(device):
        assert torch.equal(second(), expected)
