"""Which quadrics a patch lists: every one that it can measure, and none that it cannot."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from patch_cases import F64, KIND_NAMES, KINDS, ball, patches_on, quadrics_on, sheet, triangle

import torchpd as pd
from torchpd.freeform.adjacency import triangle_distances
from torchpd.freeform.reference import PatchReference


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["any", "needle", "line", "point", "far"]))
def test_distance_of_the_origin_from_a_triangle(seed: int, kind: str) -> None:
    """No point of a grid on it is nearer, and the nearest of the grid is at most a cell's diameter farther away."""
    rng = np.random.default_rng(seed)
    corners = rng.standard_normal((3, 3))
    if kind == "needle":
        corners[2] = corners[1] + 1e-9 * corners[2]
    if kind == "line":
        corners[2] = 0.3 * corners[0] + 0.7 * corners[1]
    if kind == "point":
        corners[:] = corners[0]
    if kind == "far":
        corners += 100.0
    level = 60
    i, j = (a.ravel() for a in np.meshgrid(np.arange(level + 1), np.arange(level + 1)))
    b = np.stack([i, j, level - i - j], axis=1)[i + j <= level] / level
    brute = np.linalg.norm(b @ corners, axis=1).min()
    found = float(triangle_distances(corners))
    size = max(np.linalg.norm(corners[k] - corners[k - 1]) for k in range(3))
    rounding = 1e-14 * np.abs(corners).max()
    assert brute - size / level - rounding <= found <= brute + rounding


def listed(patches: pd.FreeFormPatches) -> set[tuple[int, int]]:
    """Pairs (patch, quadric)."""
    return set(zip(patches.lists[3].tolist(), patches.lists[2].tolist(), strict=True))


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
@pytest.mark.parametrize("mesh", [ball(), sheet()], ids=["ball", "sheet"])
def test_no_quadric_is_missed(mesh: pd.TriMesh, kind: tuple[str, str]) -> None:
    """A quadric that raises a point of a patch, found with all quadrics on every patch, is in its list."""
    patches = patches_on(mesh, kind, count=30, height=0.02)
    pairs = listed(patches)
    brute = PatchReference(patches)
    grid = patches.tessellate(6)
    b, patch = grid.samples.barycentrics, grid.samples.patch
    measured = patches if kind[1] == "surface" else patches.with_quadrics(pd.Quadrics.none(F64))
    values = patches.quadrics.values(measured.surface(grid.samples).points)
    touched = {(int(patch[s]), int(q)) for s, q in (values != 0.0).nonzero().tolist()}
    assert len(touched) > 100
    assert touched <= pairs
    # and the heights are those that all quadrics together give
    chosen = range(0, len(b), 5)
    expected = [brute.height(int(patch[s]), b[s].numpy()) for s in chosen]
    torch.testing.assert_close(
        patches.heights(grid.samples)[0][chosen], torch.tensor(expected, dtype=F64), rtol=1e-12, atol=1e-15
    )


def test_no_quadric_too_many_on_a_flat_base() -> None:
    """Each listed ellipsoid holds a point of the triangle, to the fineness of a grid on it."""
    patches = patches_on(count=60)
    m, c = patches.quadrics.triangular().numpy(), patches.quadrics.centres.numpy()
    level = 200
    i, j = (a.ravel() for a in np.meshgrid(np.arange(level + 1), np.arange(level + 1)))
    b = np.stack([i, j, level - i - j], axis=1)[i + j <= level] / level
    for p, q in listed(patches):
        corners = (patches.vertices[patches.triangles[p].long()].numpy() - c[q]) @ m[q].T
        size = max(np.linalg.norm(corners[k] - corners[k - 1]) for k in range(3))
        assert np.linalg.norm(b @ corners, axis=1).min() < 1.0 + size / level


def test_lists_are_transposes_of_each_other() -> None:
    patches = patches_on(count=30)
    triangles, starts, quadric, patch, quadric_start, quadric_entry, corner_start, corner = (
        t.numpy() for t in patches.lists
    )
    assert np.array_equal(np.repeat(np.arange(len(triangles)), np.diff(starts)), patch)
    assert np.all(np.diff(patch * 1000 + quadric) > 0)  # ascending, each pair once
    assert np.array_equal(np.repeat(np.arange(30), np.diff(quadric_start)), quadric[quadric_entry])
    assert np.array_equal(np.repeat(np.arange(len(patches.vertices)), np.diff(corner_start)), triangles.ravel()[corner])
    for rows, of in ((quadric_entry, quadric[quadric_entry]), (corner, triangles.ravel()[corner])):
        assert np.all(np.diff(rows)[np.diff(of) == 0] > 0)  # in a fixed order


@pytest.mark.parametrize(
    ("nearest", "way"),
    [((0.3, 0.3, 0.0), (0.0, 0.0, 1.0)), ((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), ((0.5, 0.0, 0.0), (0.0, -1.0, 0.0))],
    ids=["inside", "corner", "edge"],
)
def test_touching_only_just_counts(nearest: tuple[float, ...], way: tuple[float, ...]) -> None:
    """A ball that reaches 1e-3 of its radius beyond the nearest point of the triangle, one that stops as far off."""
    for offset, count in ((-1e-3, 1), (1e-3, 0)):
        centre = torch.tensor([nearest], dtype=F64) + 0.05 * (1.0 + offset) * torch.tensor([way], dtype=F64)
        quadric = pd.Quadrics.from_radii(torch.ones(1, dtype=F64), centre, torch.tensor([0.05], dtype=F64))
        assert len(listed(pd.FreeFormPatches.from_mesh(triangle(), quadric, dtype=F64))) == count


@pytest.mark.parametrize("measured_at", ["base", "surface"])
def test_small_quadrics_on_a_curved_base(measured_at: str) -> None:
    """Over the middle of each patch of an icosahedron the curved base is 0.12 above the triangle: out of its reach."""
    base = pd.FreeFormPatches.from_mesh(ball(0), dtype=F64, base="phong")
    count = len(base.triangles)
    middle = base.samples(torch.arange(count), torch.full((count, 3), 1.0 / 3.0, dtype=F64))
    points = base.surface(middle).points
    flat = base.vertices[base.triangles.long()].mean(1)
    assert float((points - flat).norm(dim=1).min()) > 0.12
    small = pd.Quadrics.from_radii(torch.full((count,), 0.01, dtype=F64), points, torch.full((count,), 0.05, dtype=F64))
    patches = pd.FreeFormPatches.from_mesh(
        ball(0),
        small,
        dtype=F64,
        base="phong",
        measured_at=measured_at,  # type: ignore[arg-type]
    )
    assert {(k, k) for k in range(count)} <= listed(patches)
    assert float(patches.heights(middle)[0].min()) > 0.009
    assert not listed(pd.FreeFormPatches.from_mesh(ball(0), small, dtype=F64))


def test_new_quadrics_have_new_lists() -> None:
    patches = patches_on()
    other = quadrics_on(ball(), 12, seed=5)
    assert listed(patches.with_quadrics(other)) != listed(patches)
    assert listed(patches.with_quadrics(other, keep_lists=True)) == listed(patches)
    assert patches.with_quadrics(other, keep_lists=True).quadrics is other
    with pytest.raises(ValueError, match=r"keep_lists .*got 3"):
        patches.with_quadrics(quadrics_on(ball(), 3), keep_lists=True)
