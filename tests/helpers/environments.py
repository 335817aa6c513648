"""A scene with every effect in environments of which no two are alike, and the bits that come of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from cases import Case, sliver_mesh
from runs import noise

import torchpd as pd

ITEMS = 33


def scene() -> Case:
    """Slivers with hard and soft pins, drag, a ground and a ball with friction, and a free block in the air."""
    mesh, block = sliver_mesh((6, 3, 3)), pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
    body = pd.Solid(mesh, youngs=10.0 ** np.random.default_rng(0).uniform(4.0, 6.0, len(mesh.tets)))
    free = pd.Solid(pd.TetMesh(block.vertices + [0.0, 3.0, 0.0], block.tets), 1e5)
    parts = pd.Scene(
        body, free, pd.Pin(body, mesh.vertices[:, 0] < 0.05), pd.Pin(body, [60, 70], 1e4), pd.Gravity(),
        pd.Damping(1.0), pd.Ground(-0.01, friction=0.5), pd.Sphere((0.5, -0.1, 0.1), 0.1, friction=0.3),
    )  # fmt: skip
    rest = parts.values().rest_positions
    return Case(parts, rest, 0.0 * rest, 1.0 / 60.0)


def different_environments(sim: pd.Simulator, count: int = ITEMS) -> tuple[pd.State, torch.Tensor]:
    """Deformed, moving states and forces, no two alike; the generator makes item i the same for any count."""
    rest = sim.rest_state(count)
    noise = torch.from_numpy(np.random.default_rng(1).standard_normal((ITEMS, 3, sim.vertices, 3)))[:count]
    noise = noise.to(rest.positions)
    state = pd.State(rest.positions + 0.01 * noise[:, 0], noise[:, 1] - torch.tensor([0.0, 1.0, 0.0]).to(noise))
    return state, 0.1 * noise[:, 2]


def run(sim: pd.Simulator, state: pd.State, forces: torch.Tensor, items: Any = slice(None)) -> list[torch.Tensor]:
    """Everything that a step returns for some of the environments, as bits can be compared."""
    after, info = sim(pd.State(*(t[items] for t in state)), forces[items], return_info=True)
    return [*after, *info]


def assert_same_bits(found: list[torch.Tensor], expected: list[torch.Tensor]) -> None:
    for number, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert torch.equal(one, other), f"output {number}"
        assert not one.isnan().any(), f"output {number}"


def gradients(sim: pd.Simulator, state: pd.State, forces: torch.Tensor, items: slice) -> list[torch.Tensor]:
    """Of a loss of each environment: for what it starts from, and for material of its own."""
    names = ("gravity", "damping", "planes", "spheres")
    starts = [t[items].detach().clone().requires_grad_() for t in (*state, forces)]
    # as many rows as environments, the same ones
    own = [getattr(sim, name).detach().expand(len(starts[0]), *getattr(sim, name).shape).clone() for name in names]
    own = [t.requires_grad_() for t in own]
    given = pd.State(starts[0], starts[1]), starts[2]
    after = torch.func.functional_call(sim, dict(zip(names, own, strict=True)), given)
    weight = noise(state.positions, 5)[items]
    loss = (weight * after.positions).sum() + 0.01 * (weight * after.velocities).sum()
    return list(torch.autograd.grad(loss, starts + own))


def count_sliding(sim: pd.Simulator, state: pd.State, forces: torch.Tensor) -> torch.Tensor:
    """Vertices of each environment that slide against friction."""
    after = sim(state, forces).positions.detach()
    material = [array.detach() for array in sim.material()]
    *_, sliding = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, forces, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    return (sliding[..., 0, :] != 0.0).any(-1).sum(-1)
