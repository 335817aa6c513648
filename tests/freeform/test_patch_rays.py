"""Rays on free-form patches: against a triangle mesh, closed forms, gradients, refusals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from patch_cases import (
    F64,
    KIND_NAMES,
    KINDS,
    ball,
    central,
    lump,
    patches_on,
    quadrics_on,
    samples_on,
    towards_ball,
    triangle,
    tumbled,
    unit,
)
from torch import Tensor

import torchpd as pd
from torchpd.freeform.tessellation import grid


@pytest.mark.parametrize("reading", ["clip", "literal"])
@pytest.mark.parametrize("cones", [False, True])
def test_field_is_the_same_with_every_patch_tried(
    reading: str, cones: bool, dtype: torch.dtype, device: torch.device
) -> None:
    """4,000 rays, half of them grazing a ball of bumps, from outside and from within it, in two poses."""
    mesh = ball()
    made = pd.FreeFormPatches.from_mesh(mesh, quadrics_on(mesh, 30), dtype=F64, thickness=0.02)
    patches = made.to(device=device, dtype=dtype)
    o, d = towards_ball(4_000)
    rng = np.random.default_rng(4)
    closest = torch.tensor(rng.uniform(0.9, 1.15, (2000, 1)))
    across = unit(torch.linalg.cross(o[:2000], d[:2000]))
    d[:2000] = closest * unit(torch.linalg.cross(across, o[:2000])) - o[:2000]
    o[3600:] *= 0.3
    positions = torch.stack([patches.vertices, 1.1 * patches.vertices + 0.01 * patches.vertices.roll(1, 0)])
    W = patches.quadrics.normalized_matrices()
    if cones:  # unbounded: [x^2 + y^2 - z^2]_+ around each centre
        W = W.clone()
        W[:3] += torch.diag(torch.tensor([0.0, 0.0, 60.0, 0.0])).to(W)
    rays = pd.PatchRays(patches)
    options = {"far": 6.0, "positions": positions, "reading": reading, "matrices": W}
    o, d = o.to(patches.vertices), d.to(patches.vertices)
    depth, patch = rays.cast_field(o, d, **options)
    every_depth, every_patch = rays.cast_field(o, d, exhaustive=True, **options)
    assert 0.3 < float(depth.isfinite().double().mean()) < 0.995
    assert torch.equal(depth, every_depth)
    assert torch.equal(patch, every_patch)


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[3]], ids=[KIND_NAMES[0], KIND_NAMES[3]])
def test_against_trimesh_on_the_tessellation(kind: tuple[str, str], device: torch.device) -> None:
    """A posed ball against its mesh of level 8, on rays that meet the mesh alike when shifted by 5e-3, its error."""
    patches = patches_on(kind=kind, device=device, count=20)
    transport = central(patches)
    pose = transport(tumbled(transport, 1, 0.02))
    middle = pose.positions.mean(1)[0].cpu().double()
    o, d = towards_ball(300)
    o = o + middle
    hits = pd.PatchRays(patches).cast(o.to(patches.vertices), d.to(patches.vertices), pose)
    along = unit(d)
    across = unit(torch.linalg.cross(along, torch.tensor([[0.3, 0.5, 0.8]], dtype=F64)))
    both = (across, torch.linalg.cross(along, across))
    mesh = patches.mesh(8, pose).to_trimesh()
    found = []
    for shift in (0 * along, *(sign * 5e-3 * axis for axis in both for sign in (-1, 1))):
        place, ray, _ = mesh.ray.intersects_location((o + shift).numpy(), d.numpy(), multiple_hits=True)
        depth = np.full(len(o), np.inf)
        np.minimum.at(depth, ray, ((place - (o + shift).numpy()[ray]) * along.numpy()[ray]).sum(1))
        found.append(torch.tensor(depth))
    depths = torch.stack(found)
    same = depths.isfinite() == depths[:1].isfinite()
    jump = (depths - depths[:1]).abs().nan_to_num(0.0).amax(0)
    clear = same.all(0) & (jump < 0.05)
    assert float(clear.double().mean()) > 0.9
    assert torch.equal(hits.hit[0].cpu()[clear], depths[0].isfinite()[clear])
    compare = clear & depths[0].isfinite()
    assert int(compare.sum()) > 100
    apart = (hits.depth[0].cpu().double() - depths[0])[compare].abs()
    steep = (hits.normals[0].cpu().double() * along).sum(-1)[compare].abs()
    assert float((apart * steep).max()) < 5e-3


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_hits_lie_on_rays_and_on_the_surface(kind: tuple[str, str], device: torch.device, dtype: torch.dtype) -> None:
    patches = patches_on(kind=kind, dtype=dtype, device=device)
    transport = central(patches)
    pose = transport(tumbled(transport, 3))
    o, d = (t.to(patches.vertices) for t in towards_ball(400))
    o = o + pose.positions.mean(1, keepdim=True)
    hits = pd.PatchRays(patches).cast(o, d, pose)
    small = 1e-12 if dtype == F64 else 2e-5
    assert float(hits.barycentrics[hits.hit].min()) >= -512 * torch.finfo(dtype).eps
    assert float((hits.normals[hits.hit].norm(dim=-1) - 1).abs().max()) < small
    for n in range(3):
        hit = hits.hit[n]
        assert 100 < int(hit.sum()) < 400
        on = patches.surface(patches.samples(hits.patch[n][hit], hits.barycentrics[n][hit]), pose)
        assert float((on.points[n] - hits.points[n][hit]).abs().max()) < small
        assert float((on.normals[n] - hits.normals[n][hit]).abs().max()) < small
        ray = o[n] + torch.where(hit, hits.depth[n], 0)[:, None] * unit(d)
        assert float((ray - hits.points[n])[hit].abs().max()) < small
        assert (hits.patch[n][~hit] == -1).all()
        assert hits.depth[n][~hit].isinf().all()
        alone = pd.PatchRays(patches).cast(o[n], d, pd.PatchPose(*(t[n : n + 1] for t in pose)))
        assert torch.equal(alone.depth[0], hits.depth[n])


def test_closed_forms(device: torch.device) -> None:
    """Down onto the lump, level through it at half its height, from inside, past it, before `near`, beyond `far`."""
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(3, 3)
    patches = pd.FreeFormPatches.from_mesh(triangle(), lump(), dtype=F64, directors=up).to(device)
    rays = pd.PatchRays(patches)

    def depth(o: list[float], d: list[float], **options: float) -> float:
        return float(rays.cast(*(torch.tensor([x], dtype=F64, device=device) for x in (o, d)), **options).depth)

    half = 0.25 * math.sqrt(1.0 - 0.5 ** (1 / 3))
    assert depth([0.25, 0.25, 1.0], [0, 0, -2]) == pytest.approx(0.8, abs=1e-14)
    assert depth([0.25, 0.25, 0.0], [0, 0, 1]) == pytest.approx(0.2, abs=1e-14)
    assert depth([-1.0, 0.25, 0.1], [1, 0, 0]) == pytest.approx(1.25 - half, abs=1e-13)
    assert depth([0.25, 0.25, 0.1], [1, 0, 0]) == pytest.approx(half, abs=1e-13)
    assert depth([-1.0, 0.25, 0.1], [1, 0, 0], near=1.25) == pytest.approx(1.25 + half, abs=1e-13)
    assert depth([-1.0, 0.25, 0.1], [1, 0, 0], far=1.1) == math.inf
    assert depth([-1.0, 0.25, 0.2 + 1e-6], [1, 0, 0]) == math.inf
    assert depth([-1.0, 0.25, 0.2 - 1e-6], [1, 0, 0]) == pytest.approx(1.25, abs=1e-3)
    assert depth([0.6, 0.6, 1.0], [0, 0, -1]) == math.inf
    assert depth([0.25, 0.25, 1.0], [0, 0, 1]) == math.inf
    assert depth([math.nan, 0.25, 1.0], [0, 0, -1]) == math.inf
    assert depth([0.25, 0.25, 1.0], [0, 0, 0]) == math.inf


def test_rays_in_the_plane_of_a_patch(device: torch.device) -> None:
    """A convex body of flat patches: just below the plane of a face a ray hits, just above it misses, in it either."""
    patches = pd.FreeFormPatches.from_mesh(ball(), dtype=F64).to(device)
    corners = patches.vertices[patches.triangles.long()]
    middle = corners.mean(1)
    normal = unit(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    along = unit(corners[:, 1] - 0.7 * corners[:, 0] - 0.3 * corners[:, 2])
    rays = pd.PatchRays(patches)
    for offset, expected in ((-1e-7, True), (1e-7, False), (0.0, None)):
        hits = rays.cast(middle + offset * normal - 3 * along, along)
        if expected is None:
            assert not hits.depth.isnan().any()
            assert not hits.normals.isnan().any()
        else:
            assert bool((hits.hit == expected).all())


def test_no_gaps_between_patches(dtype: torch.dtype, device: torch.device) -> None:
    """From the middle outwards every ray hits, those through vertices and edges too."""
    patches = patches_on(dtype=dtype, device=device)
    corners = patches.vertices[patches.triangles.long()]
    steps = torch.linspace(0, 1, 9, dtype=dtype, device=device)[:, None, None, None]
    targets = (steps * corners + (1 - steps) * corners.roll(1, dims=1)).reshape(-1, 3)
    hits = pd.PatchRays(patches).cast(torch.zeros_like(targets), targets)
    assert bool(hits.hit.all())


def gradient_case(device: torch.device) -> tuple[pd.FreeFormPatches, pd.PatchRays, pd.PatchPose, Tensor, Tensor]:
    patches = patches_on(ball(0), ("phong", "surface"), device=device, count=6)
    transport = central(patches)
    pose = transport(tumbled(transport, 2, 0.05))
    where = samples_on(patches, 5)
    on = patches.surface(where, pose)
    target = on.points
    o = target + 0.5 * on.normals + 0.1
    return patches, pd.PatchRays(patches), pose, o, target - o


def test_gradients(device: torch.device) -> None:
    """Of depth, points, normals and coordinates for quadrics, pose, base and rays, against central differences."""
    patches, rays, pose, o, d = gradient_case(device)
    q = patches.quadrics

    def run(*leaves: Tensor) -> tuple[Tensor, ...]:
        a, c, m, x, A, v, n, o, d = leaves
        shaped = patches.with_shape(v, n).with_quadrics(pd.Quadrics(a, c, m), keep_lists=True)
        hits = rays.cast(o, d, pd.PatchPose(x, A), patches=shaped)
        assert bool(hits.hit.all())
        return hits.depth, hits.points, hits.normals, hits.barycentrics

    leaves = [q.amplitudes, q.centres, q.factors, *pose, patches.vertices, patches.directors, o, d]
    assert torch.autograd.gradcheck(run, [t.detach().clone().requires_grad_() for t in leaves])


def test_gradients_do_not_move_the_values(device: torch.device) -> None:
    _, rays, pose, o, d = gradient_case(device)
    plain = rays.cast(o, d, pose)
    wanted = pd.PatchPose(*(t.detach().clone().requires_grad_() for t in pose))
    traced = rays.cast(o, d, wanted)
    for name in ("depth", "points", "normals", "barycentrics"):
        assert torch.equal(getattr(plain, name), getattr(traced, name))
        assert getattr(traced, name).requires_grad
    assert not plain.depth.requires_grad


def op_arguments(name: str, dtype: torch.dtype, device: torch.device) -> tuple[list[Any], dict[str, Any]]:
    patches = patches_on(ball(0), dtype=dtype, device=device, count=5)
    rays = pd.PatchRays(patches)
    o, d = (t[:7].to(patches.vertices)[None] for t in towards_ball(7))
    nowhere = patches.samples(torch.empty(0, dtype=torch.int32), patches.vertices[:0])
    v, q = patches.vertices, patches.quadrics
    span = {"near": 0.0, "far": 9.0}
    if name == "field":
        lists = [*patches.lists, *nowhere.lists]
        options = {"thickness": 0.1, "clip": True, "exhaustive": False, **span}
        return [o, unit(d), v[None], q.amplitudes, q.normalized_matrices()[None], rays._order, lists], options
    eye = torch.eye(3, dtype=dtype, device=device).expand(1, len(v), 3, 3)
    quadrics = [q.amplitudes, q.centres, q.entries()]
    grid = [rays._samples.barycentrics, rays._cells, rays._weights, rays._places]
    options = {"level": rays.level, "on_surface": False, "phong": False, "shape": name == "shape", **span}
    arrays = [v[None], eye, v, patches.directors, *quadrics]
    return [o, d, *grid, *arrays, [*patches.lists, *rays._samples.lists]], options


@pytest.mark.parametrize("name", ["surface", "shape", "field"])
def test_ops(name: str, dtype: torch.dtype, device: torch.device, poisoned: None) -> None:
    """opcheck; the same bits again; vmap over origins; no derivative of their own."""
    op = torch.ops.torchpd.patch_field_rays if name == "field" else torch.ops.torchpd.patch_surface_rays
    args, options = op_arguments(name, dtype, device)
    assert set(torch.library.opcheck(op.default, tuple(args), options).values()) == {"SUCCESS"}
    once, again = op(*args, **options), op(*args, **options)
    assert all(torch.equal(a, b) for a, b in zip(once, again, strict=True))
    moved = torch.stack([args[0], args[0] + 0.1])
    mapped = torch.vmap(lambda o: op(o, *args[1:], **options))(moved)
    for n in range(2):
        single = op(moved[n], *args[1:], **options)
        assert all(torch.equal(a[n], b) for a, b in zip(mapped, single, strict=True))
    with pytest.raises(RuntimeError, match="no derivative"):
        op(args[0].requires_grad_(), *args[1:], **options)[0].sum().backward()


def test_no_rays(dtype: torch.dtype, device: torch.device) -> None:
    patches = patches_on(dtype=dtype, device=device)
    none = patches.vertices[:0]
    hits = pd.PatchRays(patches).cast(none, none)
    assert hits.depth.shape == (1, 0)
    assert hits.normals.shape == (1, 0, 3)
    depth, patch = pd.PatchRays(patches).cast_field(none, none, far=1.0)
    assert depth.shape == patch.shape == (1, 0)


@pytest.mark.parametrize("level", [1, 2, 3, 4, 5, 6, 9])
def test_trees_of_any_depth(level: int, dtype: torch.dtype, device: torch.device) -> None:
    """One flat patch of 1, 4, 9, ... cells, trees of 0, 1, 2, ... levels: straight down, and level above it."""
    patches = pd.FreeFormPatches.from_mesh(triangle(), dtype=dtype).to(device)
    steps, _ = grid(12)
    b = torch.tensor(steps / 12.0).to(patches.vertices)
    targets = b @ patches.vertices[patches.triangles[0].long()]
    up = torch.tensor([0.0, 0.0, 2.0]).to(targets).expand_as(targets)
    rays = pd.PatchRays(patches, level)
    hits = rays.cast(targets + up, -up)
    assert bool(hits.hit.all())
    assert float((hits.depth - 2).abs().max()) < 8 * torch.finfo(dtype).eps
    assert float((hits.barycentrics[0] - b).abs().max()) < 64 * torch.finfo(dtype).eps
    sideways = torch.tensor([1.0, 0.0, 0.0]).to(targets).expand_as(targets)
    assert not bool(rays.cast(targets + 0.01 * up - sideways, sideways).hit.any())


def test_level_follows_the_quadrics() -> None:
    mesh = triangle()
    assert pd.PatchRays(pd.FreeFormPatches.from_mesh(mesh)).level == 4
    # the longest edge is sqrt 2
    assert pd.PatchRays(pd.FreeFormPatches.from_mesh(mesh, lump(0.1), dtype=F64)).level == 29
    assert pd.PatchRays(pd.FreeFormPatches.from_mesh(mesh, lump(0.01), dtype=F64)).level == 32


def test_refusals() -> None:
    patches = patches_on()
    rays = pd.PatchRays(patches)
    o, d = towards_ball(4)
    with pytest.raises(TypeError, match=r"patches .*got TriMesh"):
        pd.PatchRays(ball())  # type: ignore[arg-type]
    for level in (0, 33, 2.0, True):
        with pytest.raises(ValueError, match=r"level .*1\.\.32"):
            pd.PatchRays(patches, level)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"origins .*got torch\.float32"):
        rays.cast(o.float(), d)
    with pytest.raises(ValueError, match="near and far"):
        rays.cast(o, d, near=2.0, far=1.0)
    with pytest.raises(ValueError, match="triangles of those given at the start"):
        rays.cast(o, d, patches=patches_on(ball(0)))
    with pytest.raises(ValueError, match="of 1 or of all 1 poses"):
        rays.cast(o.expand(2, -1, -1), d)
    with pytest.raises(ValueError, match=r"far .*got inf"):
        rays.cast_field(o, d, far=math.inf)
    with pytest.raises(ValueError, match=r"reading .*got 'other'"):
        rays.cast_field(o, d, far=1.0, reading="other")  # type: ignore[arg-type]


# of patch_surface_rays and patch_field_rays: an argument, a place in it, how many there are, the words
OUTSIDE = {
    "corner": ("surface", 3, (4, 1), 7842, r"cells .* 0\.\.7841, .*got \[.*\] at 4"),
    "check": ("surface", 3, (4, 14), 7842, r"cells .* 0\.\.7841, .*got \[.*\] at 4"),
    "patch": ("surface", 3, (4, 15), 20, r"patches in 0\.\.19 .*got \[.*\] at 4; PatchRays makes it"),
    "place": ("surface", 3, (4, 16), 49, r"places in 0\.\.48, got \[.*\] at 4; PatchRays makes it"),
    "order": ("field", 5, (4,), 20, r"order .* 0\.\.19 once, got -?\d+ at 4; PatchRays makes it"),
}


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("value", [-1, 0, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("which", OUTSIDE)
def test_indices_out_of_range(which: str, value: int, device: torch.device) -> None:
    """Refused on the CPU. On a GPU, where nothing may wait for values, what has such an index is not there."""
    name, number, place, count, message = OUTSIDE[which]
    op = getattr(torch.ops.torchpd, f"patch_{name}_rays")
    args, options = op_arguments(name, F64, device)
    fitting = args[number]
    args[number] = fitting.clone()
    args[number][place] = value if value else count
    if device.type == "cpu":
        with pytest.raises(IndexError, match=message):
            op(*args, **options)
        return
    missing = int(fitting[4, 15] if name == "surface" else fitting[4])
    for change in ({}, {"exhaustive": True}) if name == "field" else ({},):
        depth, patch = op(*args, **{**options, **change})[:2]
        whole, owner = op(*args[:number], fitting, *args[number + 1 :], **{**options, **change})[:2]
        assert torch.equal(depth[owner != missing], whole[owner != missing])
        assert bool((depth >= whole).all())
        assert bool(((patch >= -1) & (patch < 20)).all())


def test_every_patch_has_a_place_in_the_order() -> None:
    """One that were left out would never be hit."""
    args, options = op_arguments("field", F64, torch.device("cpu"))
    args[5] = args[5].clone()
    args[5][7] = args[5][3]
    with pytest.raises(IndexError, match=r"order .*got \d+ at 7"):
        torch.ops.torchpd.patch_field_rays(*args, **options)


@pytest.mark.parametrize(
    ("name", "number", "message"),
    [
        ("surface", 3, r"cells .*got Int \[980, 5\]"),
        ("field", 5, r"order .*got Int \[5\]"),
    ],
)
def test_the_way_out_is_not_that_of_a_plan(name: str, number: int, message: str) -> None:
    args, options = op_arguments(name, F64, torch.device("cpu"))
    args[number] = args[number][..., :5].contiguous()
    with pytest.raises(ValueError, match=message):
        getattr(torch.ops.torchpd, f"patch_{name}_rays")(*args, **options)
