"""The tiny scenes of tools/sanitize.py, and the settings that make each kernel run with them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
import trimesh

import torchpd as pd
from torchpd.plan import kernel_choice as regimes

DTYPES = (torch.float32, torch.float64)


def bar(*cells: int) -> pd.TetMesh:
    """A bar with cells of 10 cm."""
    return pd.shapes.box(0.1 * np.array(cells), cells)


def cones(subdivisions: int) -> pd.TetMesh:
    """A ball whose tetrahedra share its centre: the owning patch has all of them, and few other vertices."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    corners = np.column_stack([np.zeros(len(sphere.faces), dtype=np.int64), sphere.faces + 1])
    return pd.TetMesh(0.1 + 0.1 * np.concatenate([np.zeros((1, 3)), sphere.vertices]), corners)


def crumbs(count: int) -> pd.TetMesh:
    """Tetrahedra without common vertices: many slots for little work."""
    corners = 0.01 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    place = 0.02 * np.column_stack(np.unravel_index(np.arange(count), (9, 9, 9)))
    return pd.TetMesh((place[:, None] + corners).reshape(-1, 3), np.arange(4 * count).reshape(-1, 4))


class KernelCase(NamedTuple):
    """A mesh, and constants of `kernel_choice` that determine the number of patches."""

    mesh: pd.TetMesh
    constants: dict[str, Any]


BAR = bar(6, 2, 2)
SMALL, LARGE = dict.fromkeys(DTYPES, 24), {torch.float32: 2304, torch.float64: 960}
# The smallest scenes found for all instantiations. "far" is a grid whose patches have several tetrahedra and vertices
# per thread. "large" is a stream of such patches, and of one with more slots than a pipeline counts. "several" is
# "block" in float32 for meshes so small that many environments share blocks.
KERNEL_CASES = {
    # of several small ones per block: each with few registers, two with two rounds, two with one
    "several": (KernelCase(bar(4, 2, 2), {}), KernelCase(BAR, {}), KernelCase(bar(2, 2, 2), {})),
    # all vertex arrays in shared memory; not all: in float32, in float64
    "block": (KernelCase(bar(9, 2, 2), {}), KernelCase(bar(40, 1, 1), {}), KernelCase(bar(4, 2, 2), {})),
    # four lanes per vertex, with few threads and many; eight, with few and many
    "cluster": (
        KernelCase(bar(4, 2, 2), {"_CLUSTER_EACH": 60}),
        KernelCase(bar(4, 4, 2), {"_CLUSTER_EACH": 150}),
        KernelCase(cones(1), {"_CLUSTER_EACH": 10}),
        KernelCase(cones(2), {"_CLUSTER_EACH": 40}),
    ),
    "grid": (KernelCase(BAR, {"_MIN_GRID_TETS": 8}),),
    "far": (KernelCase(bar(99, 1, 1), {"_MIN_GRID_TETS": 594}),),
    "stream": (
        KernelCase(BAR, {"_STREAM_TETS": SMALL}),
        KernelCase(crumbs(9), {"_STREAM_TETS": SMALL}),  # more parts of pieces than a block has warps that move them
    ),
    "large": (KernelCase(bar(19, 20, 1), {"_STREAM_TETS": LARGE}), KernelCase(crumbs(129), {"_STREAM_TETS": LARGE})),
}
KERNELS = tuple(KERNEL_CASES)


def known_as(kernel: str) -> str:
    """The simulator's name of a kernel of KERNELS."""
    return {"far": "grid", "large": "stream", "several": "block"}.get(kernel, kernel)


@contextmanager
def compiled_for(kernel: str, case: KernelCase) -> Iterator[str]:
    """The simulator's name of a kernel of KERNELS, while the patches are those of `case`."""
    with mock.patch.dict(vars(regimes), case.constants):
        yield known_as(kernel)


def scene(mesh: pd.TetMesh, *, contacts: bool, pieces: bool, pins: bool) -> pd.Scene:
    """Two bodies; with `pieces` the second is free and tips on the ground."""
    tilt = np.array([[0.96, 0.28, 0.0], [-0.28, 0.96, 0.0], [0.0, 0.0, 1.0]])
    places = (mesh.vertices, mesh.vertices @ tilt + [0.0, 0.0, 1.5])
    bodies = [pd.Solid(pd.TetMesh(vertices, mesh.tets), 1e5) for vertices in places]
    held = bodies[:1] if pieces else bodies
    parts: list[pd.scene.Part] = [*bodies, pd.Gravity(), pd.Damping(0.5)]
    if pins:
        for body in held:
            parts += [pd.Pin(body, np.arange(9)), pd.Pin(body, len(mesh.vertices) - np.arange(1, 3), 1e3)]
    if contacts:
        parts += [pd.Ground(-0.001, friction=0.5), pd.Sphere((0.3, -0.1, 0.1), 0.1, friction=0.2)]
    return pd.Scene(*parts)


def ball_of_patches(**options: Any) -> pd.FreeFormPatches:
    """Free-form patches in float64."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    centres = torch.tensor(ball.vertices[::2])
    amplitudes = torch.tensor(0.02 * np.random.default_rng(0).choice([-1.0, 1.0], len(centres)))
    quadrics = pd.Quadrics.from_radii(amplitudes, centres, torch.full((len(centres),), 0.4, dtype=torch.float64))
    mesh = pd.TriMesh.from_trimesh(ball)
    return pd.FreeFormPatches.from_mesh(mesh, quadrics, dtype=torch.float64, **options)


def samples_everywhere(patches: pd.FreeFormPatches) -> pd.PatchSamples:
    """Samples on the edges of the patches and inside each, including the last."""
    return patches.tessellate(3).samples
