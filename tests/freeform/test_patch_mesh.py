"""Triangle meshes of free-form patches: watertight at every level, the Euler number of the base, files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from patch_cases import F64, KIND_NAMES, KINDS, ball, central, patches_on, sheet, torus, triangle, tumbled

import torchpd as pd
from torchpd.freeform.tessellation import grid

LEVELS = [1, 2, 3, 4, 7]


def euler(triangles: np.ndarray) -> int:
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return len(np.unique(triangles)) - len(edges) + len(triangles)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize(
    ("mesh", "characteristic"), [(ball(), 2), (torus(), 0), (sheet(), 1)], ids=["ball", "torus", "sheet"]
)
def test_topology_is_that_of_the_base(mesh: pd.TriMesh, characteristic: int, level: int) -> None:
    patches = patches_on(mesh)
    made = patches.mesh(level)
    assert len(made.triangles) == len(mesh.triangles) * level**2
    assert euler(made.triangles) == euler(mesh.triangles) == characteristic
    assert np.array_equal(np.unique(made.triangles), np.arange(len(made.vertices)))
    assert made.to_trimesh().is_watertight == (characteristic != 1)
    assert made.to_trimesh().is_winding_consistent


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_watertight_by_position(kind: tuple[str, str], device: torch.device, dtype: torch.dtype) -> None:
    """Every patch evaluated for itself and welded by position alone: closed, as if nothing were known of edges.

    By the very bits where heights are explicit; else to 1e-5, far above the rounding of roots and below any edge.
    """
    level = 4
    patches = patches_on(kind=kind, device=device, dtype=dtype)
    steps, triangles = grid(level)
    count = len(patches.triangles)
    b = torch.tensor(np.tile(steps, (count, 1)), dtype=dtype, device=device) / level
    where = patches.samples(torch.arange(count, device=device).repeat_interleave(len(steps)), b)
    transport = central(patches)
    for pose in (None, transport(tumbled(transport, 1))):
        points = patches.surface(where, pose).points.reshape(-1, 3).cpu().numpy()
        key = points + 0.0 if kind[1] == "base" else np.round(points, 5) + 0.0  # -0 is 0
        welded = np.unique(key, axis=0, return_inverse=True)[1].reshape(count, -1)[:, triangles].reshape(-1, 3)
        assert len(np.unique(welded)) == len(patches.tessellate(level).samples)
        assert euler(welded) == 2
        assert trimesh.Trimesh(np.zeros((welded.max() + 1, 3)), welded, process=False).is_watertight


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_numbering_of_corners_does_not_matter(seed: int, level: int) -> None:
    """Vertices and triangles renumbered, corners turned: as many vertices, the same Euler number, still closed."""
    rng = np.random.default_rng(seed)
    mesh = ball(0)
    order = rng.permutation(len(mesh.vertices))
    triangles = np.argsort(order)[mesh.triangles][rng.permutation(len(mesh.triangles))]
    triangles = np.stack([np.roll(row, rng.integers(3)) for row in triangles])
    made = pd.FreeFormPatches.from_mesh(pd.TriMesh(mesh.vertices[order], triangles)).mesh(level)
    assert len(made.vertices) == 10 * level**2 + 2  # V - E + F = 2 with 3 F = 2 E, F = 20 m^2
    assert euler(made.triangles) == 2
    assert made.to_trimesh().is_watertight


def test_orientation_and_volume() -> None:
    """Triangles keep the direction of their patch; without quadrics the flat mesh is the base, whatever the level."""
    base = ball()
    for level in LEVELS:
        made = pd.FreeFormPatches.from_mesh(base, dtype=F64).mesh(level)
        assert made.volume() == pytest.approx(base.volume(), rel=1e-13)


def test_phong_base_lies_nearer_to_a_sphere() -> None:
    base = ball()
    flat, phong = (pd.FreeFormPatches.from_mesh(base, dtype=F64, base=kind).mesh(8) for kind in ("flat", "phong"))
    error = [abs(made.volume() / (4.0 / 3.0 * np.pi) - 1.0) for made in (flat, phong)]
    assert error[1] < 0.5 * error[0]


def test_vertices_come_first_and_stay(device: torch.device) -> None:
    patches = pd.FreeFormPatches.from_mesh(ball(), base="phong").to(device)
    made = patches.tessellate(5)
    points = patches.surface(made.samples).points
    assert torch.equal(points[: len(patches.vertices)], patches.vertices)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_files(suffix: str, tmp_path: Path) -> None:
    made = patches_on().mesh(3)
    made.to_file(tmp_path / f"patches{suffix}")
    back = pd.TriMesh.from_file(tmp_path / f"patches{suffix}")
    assert len(back.triangles) == len(made.triangles)
    # files hold float32 or eight digits
    assert back.volume() == pytest.approx(made.volume(), rel=1e-5)


def test_one_patch() -> None:
    made = pd.FreeFormPatches.from_mesh(triangle(), dtype=F64).mesh(2)
    expected = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0, 0.5, 0], [0.5, 0.5, 0]]
    assert sorted(made.vertices.tolist()) == sorted(expected)


def test_refusals() -> None:
    patches = patches_on()
    for level in (0, -1, 2.0, True, "3"):
        with pytest.raises(ValueError, match=r"level .*segments >= 1"):
            patches.mesh(level)  # type: ignore[arg-type]
    transport = central(patches)
    with pytest.raises(ValueError, match=r"pose .*got 3"):
        patches.mesh(2, transport(tumbled(transport)))
