"""What free-form patches refuse, and how they say it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from patch_cases import F64, ball, central, lump, patches_on, quadrics_on, triangle

import torchpd as pd
from torchpd.viewing.render import Camera

CORNERS = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]


def made(vertices: Any, triangles: Any, *args: Any, **options: Any) -> pd.FreeFormPatches:
    return pd.FreeFormPatches(torch.tensor(vertices, dtype=F64), torch.tensor(triangles), *args, **options)


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (CORNERS, [[0, 1, 2], [1, 0, 3], [0, 1, 4]], r"must belong to at most two triangles, got edge \[0, 1\] with 3"),
        (CORNERS[:4], [[0, 1, 2], [0, 1, 3]], r"must have the same orientation, got edge \[0, 1\] in the same"),
        ([*CORNERS[:3], [0.5, 0.0, 0.0]], [[0, 1, 2], [1, 0, 3]], r"areas .*got \[1, 0, 3\] at 1"),
        (CORNERS[:3], [[0, 1, 1]], r"corners .*got \[0, 1, 1\]"),
        (CORNERS, [[0, 1, 2]], r"every .*got 2 of 5 that do not"),
        (CORNERS[:3], np.empty((0, 3), dtype=np.int64), "triangles .*got none"),
        ([[math.nan, 0, 0], *CORNERS[1:3]], [[0, 1, 2]], "vertices .*got nan"),
    ],
)  # fmt: skip
def test_surfaces(vertices: Any, triangles: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        made(vertices, triangles)


def test_vertex_numbers() -> None:
    with pytest.raises(IndexError, match=r"triangles .*got \[0, 1, 3\] at 0"):
        made(CORNERS[:3], [[0, 1, 3]])


def test_normals_do_not_depend_on_how_faces_are_cut() -> None:
    """At the corners of a cube, whichever diagonals its faces are cut along: (+-1, +-1, +-1) / sqrt 3."""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    patches = pd.FreeFormPatches.from_mesh(pd.TriMesh.from_trimesh(box), dtype=F64)
    torch.testing.assert_close(patches.directors, patches.vertices / math.sqrt(3.0), rtol=0, atol=1e-15)


def test_normals_that_cancel() -> None:
    """Two triangles back to back have no normal."""
    with pytest.raises(ValueError, match=r"triangles .*got vertex 0"):
        made(CORNERS[:3], [[0, 1, 2], [0, 2, 1]])
    up = torch.tensor([[0.0, 0.0, 1.0]] * 3, dtype=F64)
    assert len(made(CORNERS[:3], [[0, 1, 2], [0, 2, 1]], directors=up).triangles) == 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"base": "round"}, ValueError, "base .*got 'round'"),
        ({"measured_at": "top"}, ValueError, "measured_at .*got 'top'"),
        ({"thickness": -1.0}, ValueError, "thickness .*got -1"),
        ({"directors": torch.zeros(3, 3, dtype=F64)}, ValueError, r"directors .*got .* at 0 \(3 in all\)"),
        ({"directors": torch.ones(2, 3, dtype=F64)}, ValueError, r"directors .*got \[2, 3\]"),
        ({"directors": torch.zeros(3, 3)}, ValueError, r"directors .*got torch\.float32"),
        ({"quadrics": lump(dtype=torch.float32)}, ValueError, r"quadrics .*got torch\.float32"),
    ],
)  # fmt: skip
def test_options(options: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        made(CORNERS[:3], [[0, 1, 2]], **options)


@pytest.mark.parametrize(
    "change",
    [
        lambda a, c, m: (a * math.nan, c, m),
        lambda a, c, m: (a, c + math.inf, m),
        lambda a, c, m: (a, c, m + 1e4),  # exp overflows: a radius of 0
        lambda a, c, m: (a, c, m - 1e4),  # exp underflows: no ellipsoid any more
    ],
)
def test_quadrics_that_are_not_finite(change: Any) -> None:
    q = lump()
    with pytest.raises(ValueError, match=r"quadrics .*got amplitude .* at 0"):
        made(CORNERS[:3], [[0, 1, 2]], pd.Quadrics(*change(q.amplitudes, q.centres, q.factors)))


def test_patches_that_may_fold() -> None:
    """A bump of height 1 and radius 1/4 whose centre hovers over the triangle rises by up to 6.87 along the normal."""
    centre = torch.tensor([[0.25, 0.25, 0.2]], dtype=F64)
    steep = pd.Quadrics.from_radii(torch.ones(1, dtype=F64), centre, torch.tensor([0.25], dtype=F64))
    with pytest.raises(ValueError, match=r"quadrics must.* got up to 6.87 on patch 0 \(1 in all\)"):
        made(CORNERS[:3], [[0, 1, 2]], steep, measured_at="surface")
    assert float(made(CORNERS[:3], [[0, 1, 2]], steep).steepness) == 0.0
    # from below it can rise as high as it likes: on its far side it falls
    low = pd.Quadrics(steep.amplitudes, centre * centre.new_tensor([1.0, 1.0, -1.0]), steep.factors)
    assert float(made(CORNERS[:3], [[0, 1, 2]], low, measured_at="surface").steepness) == 0.0


def test_bound_of_the_steepness_holds() -> None:
    """d/dh sum R(P + h D) at heights within reach, of quadrics around and beside the base."""
    patches = patches_on(kind=("phong", "surface"), count=30, height=0.02)
    grid = patches.tessellate(5).samples
    bare = patches.with_quadrics(pd.Quadrics.none(F64))
    base = bare.surface(grid).points
    director = (patches.directors[patches.triangles.long()[grid.patch.long()]] * grid.barycentrics[..., None]).sum(1)
    reach, bound = patches.reach[grid.patch.long()], patches.steepness[grid.patch.long()]
    h = torch.linspace(-1.0, 1.0, 41, dtype=F64)[:, None] * reach
    h.requires_grad_()
    value = patches.quadrics.values(base + h[..., None] * director).sum()
    (slope,) = torch.autograd.grad(value, h)
    assert bool((slope <= bound + 1e-12).all())
    assert float((slope / bound.clamp_min(1e-9)).max()) > 0.2  # and it is no idle bound
    found = patches.heights(grid)[0].abs()
    assert bool((found <= reach).all())
    assert float((found / reach.clamp_min(1e-9)).max()) > 0.5


def test_samples() -> None:
    patches = made(CORNERS[:3], [[0, 1, 2]])
    b = torch.tensor([[0.2, 0.3, 0.5]], dtype=F64)
    with pytest.raises(IndexError, match=r"patch .*got 1 to 1"):
        patches.samples(torch.tensor([1]), b)
    with pytest.raises(ValueError, match=r"patch .*got torch.int64 \[2\]"):
        patches.samples(torch.tensor([0, 0]), b)
    with pytest.raises(ValueError, match=r"barycentrics .*got \[1, 2\]"):
        patches.samples(torch.tensor([0]), b[:, :2])
    with pytest.raises(ValueError, match=r"reading .*got 'both'"):
        patches.field(b, torch.tensor([0]), reading="both")  # type: ignore[arg-type]


def test_from_mesh_takes_meshes() -> None:
    with pytest.raises(TypeError, match=r"mesh .*got TetMesh"):
        pd.FreeFormPatches.from_mesh(pd.shapes.single_tet())  # type: ignore[arg-type]


def test_transport() -> None:
    patches = made(CORNERS[:3], [[0, 1, 2]])
    flat = torch.tensor([[0.3, 0.3, 1e-5]], dtype=F64)
    with pytest.raises(ValueError, match=r"apexes .*, got 1e-05 m for patch 0"):
        pd.PatchTransport(patches, flat)
    below = torch.tensor([[0.3, 0.3, -1.0]], dtype=F64)
    with pytest.raises(ValueError, match=r"apex .*got 1 to 1"):
        pd.PatchTransport(patches, below, torch.tensor([1]))
    with pytest.raises(ValueError, match=r"apex .*got \[2\]"):
        pd.PatchTransport(patches, below, torch.tensor([0, 0]))
    with pytest.raises(ValueError, match=r"mode .*got 'none'"):
        pd.PatchTransport(patches, below, mode="none")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"stretch .*got \(0\.0, 2\.0\)"):
        pd.PatchTransport(patches, below, stretch=(0.0, 2.0))
    with pytest.raises(ValueError, match=r"positions .*got Double \[2, 5, 3\]"):
        pd.PatchTransport(patches, below)(torch.zeros(2, 5, 3, dtype=F64))


def test_transport_moves_with_its_module(dtype: torch.dtype, device: torch.device) -> None:
    patches = patches_on()
    transport = central(patches).to(device=device, dtype=dtype)
    pose = transport(transport.rest_positions[None])
    assert pose.frames.dtype == dtype
    assert pose.frames.device.type == device.type
    assert pose.positions.shape == (1, len(patches.vertices), 3)
    assert "list_0" not in transport.state_dict()


def test_printed() -> None:
    patches = pd.FreeFormPatches.from_mesh(triangle(), lump(), dtype=F64)
    assert repr(patches) == "FreeFormPatches(1 patches, 3 vertices, 1 quadrics, base='flat', measured_at='base')"
    assert len(quadrics_on(ball())) == 12


SURFACE = patches_on(ball(0), count=5)
PLACE = SURFACE.samples(torch.tensor([3]), torch.tensor([[0.2, 0.3, 0.5]], dtype=F64))
BODY = pd.PatchBody(SURFACE, stiffness=1e4)
RAYS = pd.PatchRays(SURFACE)
APEX = torch.zeros(20, dtype=torch.int64)
RAY = torch.tensor([[0.0, 0.0, 3.0]], dtype=F64)
CAMERA = Camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), 40.0)
STATE = pd.State(*(torch.zeros(1, 13, 3, dtype=F64) for _ in range(2)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: made(CORNERS[:3], [[0, 1, 2]], 3), "quadrics .*got int"),
        (lambda: SURFACE.with_quadrics(None), "quadrics .*got NoneType"),
        (
            lambda: pd.Quadrics.from_radii(RAY[:, 0], RAY, 0.1),
            "radii .*got float",
        ),
        (lambda: lump().values([[0.0, 0.0, 0.0]]), r"points must be torch.float64 \[..., 3\] \(m\), got list"),
        (
            lambda: lump().values(RAY.float()),
            r"points .*got torch.float32 \[1, 3\]",
        ),
        (lambda: SURFACE.samples([0], RAY), "patch .*got list"),
        (lambda: SURFACE.heights(RAY), "samples .*got Tensor.*FreeFormPatches.samples"),
        (lambda: SURFACE.surface(None), "samples .*got NoneType"),
        (lambda: SURFACE.surface(PLACE, STATE), "pose .*got State.*PatchBody.pose"),
        (
            lambda: SURFACE.field([[0.0, 0.0, 0.0]], torch.tensor([0])),
            r"points .* float32 or .*, got list",
        ),
        (
            lambda: SURFACE.field(RAY, APEX[:1], matrices=[1.0]),
            "matrices .*got list",
        ),
        (lambda: RAYS.cast_field(RAY, RAY, far=1.0, matrices=RAY), r"matrices .*got \[1, 3\]"),
        (lambda: RAYS.cast(RAY, RAY, STATE), "pose .*got State.*PatchBody.pose"),
        (lambda: RAYS.cast(RAY, RAY, STATE.positions), "pose .*got Tensor"),
        (
            lambda: RAYS.cast(RAY.tolist(), RAY),
            "origins .*got list",
        ),
        (lambda: RAYS.cast(RAY, RAY, patches=3), "patches .*got int"),
        (lambda: RAYS.render(None, (8, 6)), "camera .*got NoneType"),
        (lambda: RAYS.render(CAMERA, (8, 6.5)), r"size .*got \(8, 6.5\)"),
        (lambda: RAYS.render(CAMERA, 8), "size .*got 8"),
        (lambda: BODY.pose(STATE), "positions .*got State; take state.positions"),
        (lambda: pd.PatchLoss(ball(0), ball(2)), "patches .*got TriMesh"),
        (lambda: pd.PatchLoss(SURFACE, ball(2))(SURFACE.to(dtype=torch.float32)), r"patches .*got torch\.float32"),
        (lambda: pd.PatchTransport(None, RAY), "PatchTransport: patches .*got NoneType"),
        (lambda: pd.PatchTransport(SURFACE, RAY, APEX, stretch="ab"), "stretch .*got <U2"),
        (lambda: pd.PatchLoss(SURFACE, ball(2))(ball(0)), "patches .*got TriMesh"),
    ],
)
def test_other_kinds_of_things(call: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SURFACE.samples(torch.tensor([2**40]), RAY), "patch .*got 1099511627776 to"),
        (lambda: SURFACE.samples(torch.tensor([True]), RAY), "patch .*got torch.bool"),
        (lambda: SURFACE.field(RAY[0], torch.tensor([0])), r"field: points .*got \[3\]"),
        (lambda: pd.PatchTransport(SURFACE, RAY, APEX, stretch=3), "stretch .*got 3"),
        (lambda: pd.PatchTransport(SURFACE, RAY, APEX + 0.5), r"apex .*got \[20\]"),
        (lambda: RAYS.cast(RAY[0], RAY), r"origins .*got \[3\]"),
        (lambda: pd.PatchBody(SURFACE, stiffness=1e4, apex=RAY.numpy()), "apex .*got array"),
        (lambda: pd.fit_patches(ball(1), 1.5), "quadrics .*got 1.5"),
        (lambda: pd.fit_patches(ball(1), 2, patches=20.5), "patches .*got 20.5"),
        (
            lambda: pd.fit_patches(ball(1), 2, patches="x"),
            "patches .*got 'x'",
        ),
        (lambda: pd.PatchLoss(SURFACE, ball(2), level=2.5), "level .*got 2.5"),
        (lambda: pd.PatchLoss(SURFACE, ball(2))(patches_on(ball(1))), "must have the 20 triangles that the loss was"),
        (lambda: Camera((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 40.0), "origin and target must differ horizontally"),
        (lambda: Camera((0.0, 3.0, 1.0), (0.0, 0.0, 1.0), 40.0), "origin and target must differ horizontally"),
        (lambda: Camera((math.nan, 3.0, 1.0), (0.0, 0.0, 1.0), 40.0), "Camera.origin .*got nan"),
        (lambda: Camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), 180.0), "fov .*got 180"),
        (lambda: Camera((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), 0.0), "fov .*got 0"),
    ],
)
def test_values_out_of_range(call: Any, message: str) -> None:
    with pytest.raises((ValueError, IndexError), match=message):
        call()
