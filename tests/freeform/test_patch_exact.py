"""Free-form patches against numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from patch_cases import F64, KIND_NAMES, KINDS, ball, central, lump, patches_on, sheet, triangle, tumbled

import torchpd as pd

ROOT2 = math.sqrt(0.5)


def one(
    device: torch.device, dtype: torch.dtype, quadrics: pd.Quadrics | None = None, **options: str
) -> pd.FreeFormPatches:
    made = pd.FreeFormPatches.from_mesh(triangle(), lump() if quadrics is None else quadrics, dtype=F64, **options)
    return made.to(device=device, dtype=dtype)


def test_published_field(device: torch.device, dtype: torch.dtype) -> None:
    """Planes (.353553, .25, .25, .1, -.1) at (.25, .25, .1), where Q = 1 - .16; a bump of .2 .84^3 = .1185408."""
    patches = one(device, dtype)
    x = torch.tensor([[0.25, 0.25, 0.1], [0.25, 0.25, -0.1]], dtype=dtype, device=device)
    number = torch.zeros(2, dtype=torch.int64)
    plain = patches.with_quadrics(pd.Quadrics.none(dtype, device))
    rounding = 20 * torch.finfo(dtype).eps

    def check(found: torch.Tensor, expected: list[float]) -> None:
        torch.testing.assert_close(found.cpu(), torch.tensor(expected, dtype=dtype), rtol=rounding, atol=rounding)

    check(plain.field(x, number), [-0.1, -0.1])
    check(patches.field(x, number, reading="clip"), [0.0185408, -0.1])
    check(patches.field(x, number, reading="literal"), [0.0185408, 0.0185408])


@pytest.mark.parametrize(
    ("place", "least"), [((0.02, 0.3, 0.0), 0.02), ((0.3, 0.03, 0.0), 0.03), ((0.45, 0.5, 0.0), 0.05 * ROOT2)]
)
def test_clip_planes(place: tuple[float, ...], least: float, device: torch.device, dtype: torch.dtype) -> None:
    """Inside, near an edge, F is the distance from it."""
    bare = pd.FreeFormPatches.from_mesh(triangle(), dtype=F64, thickness=1.0).to(device=device, dtype=dtype)
    x = torch.tensor([place], dtype=dtype, device=device)
    assert float(bare.field(x, torch.zeros(1, dtype=torch.int64))) == pytest.approx(
        least, rel=20 * torch.finfo(dtype).eps
    )


def test_field_takes_quadrics_that_are_no_ellipsoids() -> None:
    """The cone Q = z^2 - x^2 - y^2 is .92 at (.2, .2, 1); thickness 2 leaves the clip planes, x = .2 the first."""
    patches = one(torch.device("cpu"), F64)
    thick = pd.FreeFormPatches(patches.vertices, patches.triangles, patches.quadrics, thickness=2.0)
    cone = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 0.0], dtype=F64))[None]
    x = torch.tensor([[0.2, 0.2, 1.0]], dtype=F64)
    number = torch.zeros(1, dtype=torch.int64)
    found = float(thick.field(x, number, matrices=cone, reading="literal"))
    assert found == pytest.approx(0.2 + 0.2 * 0.92**3, rel=1e-15)
    assert float(thick.field(x, number, matrices=cone, reading="clip")) == pytest.approx(0.2, rel=1e-15)


@pytest.mark.parametrize(("measured_at", "height"), [("base", 0.2), ("surface", 0.107840938558)])
def test_height_over_the_centre(measured_at: str, height: float, device: torch.device, dtype: torch.dtype) -> None:
    """On the surface h = .2 (1 - (4 h)^2)^3."""
    patches = one(device, dtype, measured_at=measured_at)
    b = torch.tensor([[0.5, 0.25, 0.25]], dtype=dtype, device=device)
    h, slopes = patches.heights(patches.samples(torch.tensor([0]), b))
    assert float(h) == pytest.approx(height, rel=max(1e-11, 10 * torch.finfo(dtype).eps))
    assert float(slopes.abs().max()) <= 10 * torch.finfo(dtype).eps


def test_cylinder_is_measured_alike_on_base_and_surface() -> None:
    """Without extent along the normal the height does not depend on where it is measured: .2 over the centre."""
    b = torch.tensor([[0.5, 0.25, 0.25], [0.3, 0.4, 0.3]], dtype=F64)
    heights = []
    for measured_at in ("base", "surface"):
        patches = one(torch.device("cpu"), F64, lump((0.25, 0.25, 1e9)), measured_at=measured_at)
        heights.append(patches.heights(patches.samples(torch.tensor([0, 0]), b))[0])
    assert float(heights[0][0]) == 0.2
    torch.testing.assert_close(heights[0], heights[1], rtol=1e-15, atol=0)


def test_volume_under_an_elliptic_bump() -> None:
    """a pi r1 r2 / 4 under a cylinder's bump that lies inside of the triangle.

    Midpoint sums over a C2 function of bounded support: error h^3 at most, 300 segments, times a few.
    """
    patches = one(torch.device("cpu"), F64, lump((0.25, 0.2, 1e9)))
    grid = patches.tessellate(300)
    h = patches.heights(grid.samples)[0]
    volume = float(h[grid.triangles].mean(1).sum()) * 0.5 / 300**2
    assert volume == pytest.approx(0.2 * math.pi * 0.25 * 0.2 / 4, rel=10 * 300.0**-3)


@pytest.mark.parametrize("mode", ["transport", "rotation"])
@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_rest_pose_is_the_rest_surface(
    kind: tuple[str, str], mode: str, device: torch.device, dtype: torch.dtype
) -> None:
    patches = patches_on(kind=kind, device=device, dtype=dtype)
    transport = central(patches, mode=mode)
    grid = patches.tessellate(3)
    posed = patches.surface(grid.samples, transport(transport.rest_positions[None]))
    rest = patches.surface(grid.samples)
    # G = Ds Dm^-1 is the identity to 2 eps times the condition of the tetrahedra, below 10
    limit = 20 * torch.finfo(dtype).eps
    torch.testing.assert_close(posed.points[0], rest.points, rtol=0, atol=limit)
    torch.testing.assert_close(posed.normals[0], rest.normals, rtol=0, atol=10 * limit)


@pytest.mark.parametrize("mesh", [ball(), sheet()], ids=["ball", "sheet"])
@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_affine_motion_carries_the_surface(
    kind: tuple[str, str], mesh: pd.TriMesh, device: torch.device, dtype: torch.dtype
) -> None:
    """x -> G x + t of vertices and apexes is the same map of every point, while no singular value is clamped."""
    patches = patches_on(mesh, kind, device=device, dtype=dtype)
    transport = central(patches)
    rng = np.random.default_rng(1)
    motions = np.linalg.qr(rng.standard_normal((4, 3, 3)))[0]
    motions = motions * np.sign(np.linalg.det(motions))[:, None, None] * rng.uniform(0.5, 2.0, (4, 1, 3))
    G = torch.tensor(motions).to(patches.vertices)
    t = torch.tensor(rng.standard_normal((4, 1, 3))).to(patches.vertices)
    grid = patches.tessellate(3)
    rest = patches.surface(grid.samples).points
    posed = patches.surface(grid.samples, transport(transport.rest_positions @ G.mT + t))
    # coordinates up to 5; the condition of the tetrahedra is below 10
    limit = 5 * 10 * torch.finfo(dtype).eps
    torch.testing.assert_close(posed.points, rest @ G.mT + t, rtol=0, atol=limit)


def test_rotation_mode_keeps_the_shape_of_bumps() -> None:
    """Stretched twofold along x, a flat sheet's bump is as high and, over its centre, as round as before."""
    flat = pd.TriMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    patches = pd.FreeFormPatches.from_mesh(flat, lump(), dtype=F64)
    turned = central(patches, mode="rotation")
    stretched = turned.rest_positions * torch.tensor([2.0, 1.0, 0.5], dtype=F64)
    where = patches.samples(torch.tensor([0]), torch.tensor([[0.5, 0.25, 0.25]], dtype=F64))
    assert float(patches.surface(where, turned(stretched[None])).points[0, 0, 2]) == pytest.approx(0.2, rel=1e-14)
    sheared = central(patches, mode="transport")
    assert float(patches.surface(where, sheared(stretched[None])).points[0, 0, 2]) == pytest.approx(0.1, rel=1e-14)


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
@pytest.mark.parametrize("mesh", [ball(), sheet()], ids=["ball", "sheet"])
def test_no_gap_along_shared_edges(
    mesh: pd.TriMesh, kind: tuple[str, str], device: torch.device, dtype: torch.dtype
) -> None:
    """Both patches of an edge compute the same points on it, in any pose: the same bits where h is explicit."""
    patches = patches_on(mesh, kind, device=device, dtype=dtype)
    triangles = mesh.triangles
    sides = [(p, k) for p in range(len(triangles)) for k in range(3)]
    by_edge: dict[frozenset[int], list[tuple[int, int]]] = {}
    for p, k in sides:
        by_edge.setdefault(frozenset((int(triangles[p][k]), int(triangles[p][(k + 1) % 3]))), []).append((p, k))
    shared = [pair for pair in by_edge.values() if len(pair) == 2]
    steps = np.linspace(0.0, 1.0, 9)
    first, second = np.zeros((len(shared), 9, 3)), np.zeros((len(shared), 9, 3))
    for row, ((_, k), (_, m)) in enumerate(shared):
        # the neighbour runs along the edge the other way
        first[row, :, k], first[row, :, (k + 1) % 3] = 1.0 - steps, steps
        second[row, :, m], second[row, :, (m + 1) % 3] = steps, 1.0 - steps
    numbers = np.array([[p, q] for (p, _), (q, _) in shared])
    transport = central(patches)
    pose = transport(tumbled(transport))
    sheets = []
    for column, b in enumerate((first, second)):
        where = patches.samples(
            torch.tensor(np.repeat(numbers[:, column], 9)), torch.tensor(b.reshape(-1, 3)).to(patches.vertices)
        )
        sheets.append(patches.surface(where, pose).points)
    gap = float((sheets[0] - sheets[1]).abs().max())
    if kind[1] == "base":
        assert gap == 0.0
    # the root is found to a few roundings of heights below 0.2
    assert gap <= 2 * torch.finfo(dtype).eps * float(sheets[0].abs().max())


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_normals_are_those_of_the_surface(kind: tuple[str, str]) -> None:
    """Against central differences of fourth order: error 1e-12 / step + step^4, at step 1e-3 about 1e-9."""
    patches = patches_on(kind=kind, height=0.04)
    transport = central(patches)
    pose = transport(tumbled(transport))
    rng = np.random.default_rng(4)
    # away from the edges of patches, where stencils would leave them
    b = torch.tensor(rng.dirichlet((4.0, 4.0, 4.0), 200))
    where = patches.samples(torch.tensor(rng.integers(0, len(patches.triangles), 200)), b)
    found = patches.surface(where, pose)
    tangents = []
    for d in range(2):
        way = torch.zeros(3, dtype=F64)
        way[d], way[2] = 1.0, -1.0
        step = 1e-3

        def at(times: float, way: torch.Tensor = way, step: float = step) -> torch.Tensor:
            return patches.surface(where.at(b + times * step * way), pose).points

        tangents.append((8.0 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12.0 * step))
    normals = torch.nn.functional.normalize(torch.linalg.cross(*tangents), dim=-1)
    assert float(patches.heights(where)[1].abs().max()) > 0.01
    error = (found.normals - normals).abs().amax(-1).flatten().sort().values
    # the third derivative jumps where a stencil crosses the end of a quadric: few do, and stay below 6 a step^2 / r^3
    assert float(error[int(0.8 * len(error))]) <= 1e-9
    assert float(error[-1]) <= 1e-5
    torch.testing.assert_close(found.normals.norm(dim=-1), torch.ones(3, 200, dtype=F64), rtol=0, atol=1e-15)
