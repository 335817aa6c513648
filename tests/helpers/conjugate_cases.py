"""Systems of the adjoint for the op that solves them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from conjugate_reference import System
from torch import Tensor

import torchpd as pd

ops = torch.ops.torchpd
BATCH = 3
CELLS = (3, 2, 2)
# on a GPU of several patches
MANY: dict[str, dict[str, Any]] = {
    "cluster": {"kernel": "cluster", "cells": (12, 4, 4)},
    "grid": {"kernel": "grid", "cells": (22, 9, 9)},
    "stream": {"kernel": "stream", "cells": (22, 9, 9)},
}


def noise(shape: torch.Size, dtype: torch.dtype, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def system(
    dtype: torch.dtype,
    device: torch.device,
    *,
    cells: tuple[int, int, int] = CELLS,
    contacts: bool = False,
    kernel: str = "auto",
    levels: bool = False,
) -> tuple[System, Tensor, Tensor]:
    """A bar whose environments differ, three of its vertices held; positions, and a right side of what may move.

    With levels of a solver these know of one that it is held, and take another one for held that moves.
    """
    mesh = pd.shapes.box((1.0, 0.4, 0.3), cells)
    solid = pd.Solid(mesh, youngs=2e4, density=1000.0)
    options: dict[str, Any] = {"kernel": kernel} if device.type == "cuda" else {}
    parts: list[pd.scene.Part] = []
    if levels:
        parts, options = [pd.Pin(solid, [0, 5])], {**options, "solver": pd.Multilevel()}
    sim = pd.Simulator(pd.Scene(solid, *parts), 1 / 60, dtype=dtype, progress=False, **options).to(device)
    x = sim.rest_state(BATCH).positions.cpu()
    spread = torch.tensor([1.0, 0.3, 2.5], dtype=dtype)[:, None]
    moves = torch.ones(BATCH, sim.vertices, dtype=dtype)
    moves[:, :3] = 0.0
    inertia = 0.5 * sim.masses.cpu() / sim.time_step**2 * (1 + 0.1 * noise((BATCH, sim.vertices), dtype))
    normal = torch.nn.functional.normalize(noise((*x.shape[:2], 3), dtype, 1), dim=-1)
    projector = (
        torch.eye(3, dtype=dtype)
        - normal[..., None] * normal[..., None, :] * (torch.arange(sim.vertices) % 2)[:, None, None]
    )
    material = [(spread * sim.stiffness.cpu()).to(device), *sim.material()[1:]]
    diagonal = inertia + ops.elastic_diagonal(material, list(sim.plan.arrays), weighted=True).cpu()
    found = System(
        inertia.to(device), (moves / diagonal).to(device), projector.to(device) if contacts else None,
        material, list(sim.plan.arrays),
    )  # fmt: skip
    # little enough for elements of any size to leave the Hessian positive
    smallest = min(length / count for length, count in zip((1.0, 0.4, 0.3), cells, strict=True))
    positions = (x + smallest / 15.0 * noise(x.shape, dtype, 2)).to(device)
    return found, positions, found.allowed(noise(x.shape, dtype, 3).to(device))


def environment(s: System, e: int) -> System:
    """One of them, alone."""
    return environments(s, slice(e, e + 1))


def environments(s: System, index: slice | Tensor) -> System:
    """Some of them."""
    stiffness, *rest = s.material
    return replace(
        s, inertia=s.inertia[index], inverse=s.inverse[index], material=[stiffness[index], *rest],
        projector=None if s.projector is None else s.projector[index],
    )  # fmt: skip


def sliding_on(s: System, right: Tensor, push: float = 0.1) -> Tensor:
    """Every third vertex slides, on a surface that curves; in the last environment nothing does."""
    vectors = noise((*right.shape[:2], 5, 3), right.dtype, 7).to(right)
    root = (1.0 / s.inverse.clamp(min=1e-30)).sqrt()[..., None, None]
    scale = (
        torch.tensor([push, 1.0, 0.0, 0.0, 0.0]).to(right)[:, None]
        + root * torch.tensor([0.0, 0.0, 0.5, 0.1, 0.05]).to(right)[:, None]
    )
    sliding = torch.where((s.inverse != 0)[..., None, None], scale * vectors, 0.0)
    # a direction off the surface has no part in anything
    for number in (0, 2, 3, 4):
        sliding[:, :, number] = s.off_normals(sliding[:, :, number])
    sliding[:, 1::3], sliding[:, 2::3], sliding[-1] = 0.0, 0.0, 0.0
    return sliding


def given_of(s: System, positions: Tensor, right: Tensor) -> tuple[Any, ...]:
    return positions, right, s.inertia, s.inverse, s.projector, s.material, s.plan
