"""What the tests of free-form patches share: surfaces with quadrics on them, poses, samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

import torchpd as pd

F64 = torch.float64
KINDS = [(base, measured_at) for base in ("flat", "phong") for measured_at in ("base", "surface")]
KIND_NAMES = [f"{base}-{measured_at}" for base, measured_at in KINDS]


def triangle() -> pd.TriMesh:
    """The unit right triangle in the plane z = 0."""
    return pd.TriMesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0, 1, 2]])


def lump(radius: Any = 0.25, dtype: torch.dtype = F64) -> pd.Quadrics:
    """One quadric of height 0.2 over (1/4, 1/4, 0)."""
    centre = torch.tensor([[0.25, 0.25, 0.0]], dtype=dtype)
    return pd.Quadrics.from_radii(torch.tensor([0.2], dtype=dtype), centre, torch.tensor([radius], dtype=dtype))


def ball(subdivisions: int = 1) -> pd.TriMesh:
    return pd.TriMesh.from_trimesh(trimesh.creation.icosphere(subdivisions=subdivisions))


def sheet(cells: int = 3) -> pd.TriMesh:
    """An open, wavy square."""
    n = cells + 1
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij"))
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    lower, upper = np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)
    return pd.TriMesh(
        np.stack([x, y, 0.2 * np.sin(2 * x + y)], axis=1), np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])
    )


def level_sheet(cells: int = 3) -> pd.TriMesh:
    """A square in the plane z = 0: over it a surface of patches is the graph of a function."""
    n = cells + 1
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij"))
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    return pd.TriMesh(np.stack([x, y, 0 * x], axis=1), np.concatenate([np.stack(t, 1) for t in ((a, b, c), (a, c, d))]))


def towards_ball(count: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Origins 3 m from a ball of 1 m, and directions to places in it and past it."""
    rng = np.random.default_rng(seed)
    o, target = rng.standard_normal((2, count, 3))
    o *= 3.0 / np.linalg.norm(o, axis=1, keepdims=True)
    target *= rng.uniform(0, 1.3, (count, 1)) / np.linalg.norm(target, axis=1, keepdims=True)
    return torch.tensor(o), torch.tensor(target - o)


def torus() -> pd.TriMesh:
    return pd.TriMesh.from_trimesh(trimesh.creation.torus(1.0, 0.4, major_sections=8, minor_sections=6))


def quadrics_on(mesh: pd.TriMesh, count: int = 12, *, height: float = 0.03, seed: int = 0) -> pd.Quadrics:
    """Bumps and dents on the vertices of a mesh and near them, tilted and stretched."""
    rng = np.random.default_rng(seed)
    centres = mesh.vertices[rng.integers(0, len(mesh.vertices), count)] + 0.05 * rng.standard_normal((count, 3))
    rates = -np.log(rng.uniform(0.3, 0.6, (count, 3)))
    factors = np.concatenate([rates, 0.5 * rng.standard_normal((count, 3))], axis=1)
    amplitudes = height * rng.uniform(0.3, 1.0, count) * rng.choice([-1.0, 1.0], count)
    return pd.Quadrics(*(torch.tensor(a) for a in (amplitudes, centres, factors)))


def patches_on(
    mesh: pd.TriMesh | None = None,
    kind: tuple[str, str] = ("flat", "base"),
    *,
    dtype: torch.dtype = F64,
    device: torch.device | str = "cpu",
    **options: Any,
) -> pd.FreeFormPatches:
    """Patches with a dozen quadrics."""
    surface = ball() if mesh is None else mesh
    made = pd.FreeFormPatches.from_mesh(
        surface, quadrics_on(surface, **options), dtype=F64, base=kind[0], measured_at=kind[1]
    )
    return made.to(device=device, dtype=dtype)


def samples_on(patches: pd.FreeFormPatches, count: int = 40, seed: int = 0) -> pd.PatchSamples:
    """Places at random, several on some patches and none on others, in no order."""
    rng = np.random.default_rng(seed)
    patch = rng.integers(0, len(patches.triangles), count)
    b = torch.tensor(rng.dirichlet((1.0, 1.0, 1.0), count)).to(patches.vertices)
    return patches.samples(torch.tensor(patch, device=b.device), b)


def central(patches: pd.FreeFormPatches, **options: Any) -> pd.PatchTransport:
    """All patches share an apex at the middle."""
    middle = patches.vertices.mean(0, keepdim=True)
    if float(patches.vertices[:, 2].abs().max()) < 0.5:  # a sheet: below it
        middle = middle - middle.new_tensor([[0.0, 0.0, 1.0]])
    shared = torch.zeros(len(patches.triangles), dtype=torch.int64)
    return pd.PatchTransport(patches, middle, shared, **options)


def tumbled(transport: pd.PatchTransport, batch: int = 3, noise: float = 0.1, seed: int = 0) -> Tensor:
    """Positions [batch, points, 3]: turned, sheared and disturbed, another way in each environment."""
    rng = np.random.default_rng(seed)
    motion = np.eye(3) + 0.4 * rng.standard_normal((batch, 3, 3))
    rest = transport.rest_positions.detach().double().cpu().numpy()
    moved = rest @ np.swapaxes(motion, 1, 2) + rng.standard_normal((batch, 1, 3))
    return torch.tensor(moved + noise * rng.standard_normal(moved.shape)).to(transport.rest_positions)


def unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1)
