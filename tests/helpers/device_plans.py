"""Plans of a GPU as NumPy arrays, read as its kernels read them; the meshes to compile; both as fixtures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cases import box, cone_mesh, oriented, sliver_mesh
from numpy.typing import NDArray
from runs import ULP
from scipy.spatial import Delaunay

import torchpd as pd
from torchpd.common.tables import DEVICE_PLAN_TABLE
from torchpd.plan.gpu_plan import compile_device_plan
from torchpd.scene import SceneValues

LANES, SLICE, NONE, SENDERS = 32, 8, 65535, 7
SLOT_STEP = 8  # slots in pair_corner
KERNELS = BLOCK, CLUSTER, GRID, STREAM = range(4)
MOST_CLUSTER = 16  # patches
BOTH = [[0, 1, 2, 3], [0, 1, 2, 4]]  # the corners of both tetrahedra of a pair
SIZES = ["kernel", "vertices", "tets", "pins", "pieces", "blocks", "patches", "slots", "shared", "parts", "sums"]
SIZES += ["sum_levels", "senders", "most_slots", "most_pairs", "most_entries", "most_interior", "members"]
SIZES += ["environments", "solid_pieces"]


def delaunay_mesh() -> pd.TetMesh:
    """Random points, denser at one corner: tetrahedra of all sizes, slivers among them."""
    points = np.random.default_rng(1).uniform(size=(300, 3)) ** 2
    tets = oriented(points, Delaunay(points).simplices.astype(np.int64))
    volumes = np.linalg.det(points[tets][:, 1:] - points[tets][:, :1]) / 6.0
    tets = tets[volumes > 1e-9]
    used, tets = np.unique(tets, return_inverse=True)
    return pd.TetMesh(points[used], tets.reshape(-1, 4))


@cache
def values_of(name: str) -> SceneValues:
    if name == "one tet":
        mesh = pd.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
        return pd.Scene(pd.Solid(mesh, 1e5)).values()
    vertices, tets = box((0.5, 0.4, 0.3), (5, 4, 3))
    body = pd.Solid(pd.TetMesh(vertices, tets), 1e5)
    if name == "full patch":  # almost as many entries as 16 bits count
        return pd.Scene(pd.Solid(pd.TetMesh(*box((1.0, 1.0, 1.0), (16, 16, 17))), 1e5)).values()
    if name == "held box":
        return pd.Scene(body, pd.Pin(body, [7, 0, 33])).values()
    if name == "held and free":
        other = pd.Solid(pd.TetMesh(vertices + [0.0, 1.0, 0.0], tets), 1e5)
        return pd.Scene(body, other, pd.Pin(body, np.arange(20))).values()
    if name == "pieces":
        far = [pd.Solid(pd.TetMesh(vertices + [0.0, y, 0.0], tets), 1e5) for y in (1.0, 2.0)]
        return pd.Scene(body, *far).values()
    if name == "cones":
        return pd.Scene(pd.Solid(cone_mesh(60), 1e5)).values()
    return pd.Scene(pd.Solid({"slivers": sliver_mesh, "delaunay": delaunay_mesh}[name](), 1e5)).values()


CASES = (
    ("one tet", 1),
    ("held box", 1),
    ("held box", 4),
    ("held box", 360),
    ("full patch", 1),
    ("held and free", 1),
    ("held and free", 7),
    ("pieces", 5),
    ("slivers", 1),
    ("slivers", 20),
    ("delaunay", 1),
    ("delaunay", 13),
    ("cones", 20),  # all share a vertex
)


class Arrays(SimpleNamespace):
    """The arrays of a plan by name."""

    @classmethod
    def of(cls, values: SceneValues, patches: int, kernel: int = GRID, dtype: torch.dtype = torch.float64) -> Arrays:
        tensors = compile_device_plan(values, patches, kernel, dtype)
        return cls(**{row.name: t.numpy() for row, t in zip(DEVICE_PLAN_TABLE, tensors, strict=True)})


def patches_of(case: tuple[str, int], kernel: int) -> int:
    """As many as the case wants, or as a cluster has."""
    return min(case[1], MOST_CLUSTER) if kernel == CLUSTER else case[1]


@cache
def arrays_of(case: tuple[str, int], kernel: int, dtype: torch.dtype = torch.float64) -> Arrays:
    """One of CASES."""
    return Arrays.of(values_of(case[0]), patches_of(case, kernel), kernel, dtype)


@dataclass(frozen=True)
class Lanes:
    """Pairs lane by lane, padding included."""

    live: NDArray[np.bool_]  # [lanes]
    patch: NDArray[np.int64]  # [lanes]
    slot: NDArray[np.int64]  # [lanes, 5] in the patch
    entry: NDArray[np.int64]  # [lanes, 5] in the patch
    vertex: NDArray[np.int64]  # [lanes, 5] user's
    tet: NDArray[np.int32]  # [lanes, 2] user's
    counted: NDArray[np.bool_]  # [lanes, 2] whether there is one that no other patch counts
    bound: NDArray[np.float64]  # [lanes, 2]

    @classmethod
    def of(cls, plan: Arrays) -> Lanes:
        blocks = np.diff(plan.patch_block)
        patch = np.repeat(np.arange(len(blocks)), blocks * LANES)
        number = np.arange(len(patch)) - plan.patch_block[patch] * LANES
        packed = plan.pair_corner.view(np.uint32).reshape(-1, 5, LANES).transpose(0, 2, 1).reshape(-1, 5)
        slot, entry = (packed & 65535).astype(np.int64) // SLOT_STEP, (packed >> 16).astype(np.int64)
        tet = plan.pair_tet.reshape(-1, 2, LANES).transpose(0, 2, 1).reshape(-1, 2)
        return cls(
            number < plan.patch_pairs[patch],
            patch,
            slot,
            entry,
            plan.vertex_order[plan.slot_vertex[plan.patch_slot[patch][:, None] + slot]].astype(np.int64),
            np.where(tet < -1, -2 - tet, tet),
            tet >= 0,
            plan.pair_bound.reshape(-1, 2, LANES).transpose(0, 2, 1).reshape(-1, 2),
        )

    @property
    def real(self) -> NDArray[np.bool_]:
        """Where there is a tetrahedron [lanes, 2]."""
        return self.live[:, None] & (self.tet >= 0)

    @property
    def tet_vertices(self) -> NDArray[np.int64]:
        """User's corners of both tetrahedra [lanes, 2, 4]."""
        return self.vertex[:, BOTH]


@dataclass(frozen=True)
class Rest:
    """Rest shapes lane by lane."""

    inverse: NDArray[np.float64]  # [lanes, 2, 3, 3]
    volume: NDArray[np.float64]  # [lanes, 2]
    rounding: NDArray[np.float64]  # [lanes] how far positions may be from the user's [m]

    @classmethod
    def of(cls, plan: Arrays, lanes: Lanes) -> Rest:
        """As StoredRest of pairs_per_thread.h reads them; or of the positions that ComputedRest has, but for a turn."""
        if plan.sizes[SIZES.index("kernel")] != STREAM:
            quads = plan.pair_rest.astype(np.float64).reshape(-1, 3, LANES, 4).transpose(0, 2, 1, 3).reshape(-1, 3, 4)
            inverse = np.zeros((len(quads), 2, 3, 3))
            inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1] = quads[:, :1, :3].transpose(2, 0, 1)
            inverse[..., :, 2] = quads[:, 1:, :3]
            return cls(inverse, quads[:, 1:, 3], np.zeros(len(quads)))
        slot, unit = plan.patch_slot[lanes.patch][:, None] + lanes.slot, plan.patch_unit[lanes.patch].astype(np.float64)
        if len(plan.slot_fixed):
            x, rounding = plan.slot_fixed[slot, :3].astype(np.float64), 0.75**0.5 * unit  # half a unit along each axis
        else:
            x = plan.slot_rest[slot, :3]
            rounding = ULP[torch.float64] * np.linalg.norm(x, axis=-1).max(axis=-1)
        factor = plan.pair_factor.reshape(-1, 2, LANES).transpose(0, 2, 1).reshape(-1, 2).astype(np.float64)
        a, b, c = (x[:, BOTH][:, :, corner] - x[:, BOTH][:, :, 0] for corner in (1, 2, 3))
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
        return cls(factor[..., None, None] * cofactors, (unit**2 / (6.0 * np.abs(factor.T))).T, rounding)


def face_frames(Dm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turns [n, 3, 3] into frames of the faces of corners 0, 1 and 2: x along the first edge, z normal."""
    x, z = Dm[..., 0], np.cross(Dm[..., 0], Dm[..., 1])
    x, z = (axis / np.linalg.norm(axis, axis=-1, keepdims=True) for axis in (x, z))
    return np.stack([x, np.cross(z, x), z], axis=-2)


def rows_of(plan: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Patch, first entry and number of entries of every slot."""
    packed = plan.slot_row.view(np.uint32)
    patch = np.repeat(np.arange(len(plan.patch_pairs)), np.diff(plan.patch_slot))
    return patch, (packed & 65535).astype(np.int64), (packed >> 16 & 32767).astype(np.int64)


def slices_of(plan: Arrays) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Of each patch the first entry of every slice of eight slots, and its rows: as many as the busiest slot needs."""
    _, first, forces = rows_of(plan)
    slices = []
    for a, b in zip(plan.patch_slot[:-1], plan.patch_slot[1:], strict=True):
        starts = np.arange(a, b, SLICE)
        slices.append((first[starts], np.maximum.reduceat(forces[:b], starts)))
    return slices


def entries_of(plan: Arrays) -> NDArray[np.int64]:
    """Entries of each patch, padding included: up to the end of its last slice."""
    return np.array([start[-1] + SLICE * rows[-1] for start, rows in slices_of(plan)])


# for every test that imports them: one of CASES, its scene, its plan for GRID, the pairs of that


@pytest.fixture(name="case", scope="module", params=CASES, ids=lambda case: f"{case[0]}, {case[1]}")
def fixture_case(request: pytest.FixtureRequest) -> tuple[str, int]:
    chosen: tuple[str, int] = request.param
    return chosen


@pytest.fixture(name="values", scope="module")
def fixture_values(case: tuple[str, int]) -> SceneValues:
    return values_of(case[0])


@pytest.fixture(name="plan", scope="module")
def fixture_plan(case: tuple[str, int]) -> Arrays:
    return arrays_of(case, GRID)


@pytest.fixture(name="lanes", scope="module")
def fixture_lanes(plan: Arrays) -> Lanes:
    return Lanes.of(plan)


def box_values(cells: tuple[int, int, int], *parts: pd.Ground | pd.Sphere) -> SceneValues:
    return pd.Scene(pd.Solid(pd.TetMesh(*box((1.0, 1.0, 1.0), cells)), 1e5), *parts).values()


def cut_by_centres(centres: NDArray[np.float64], tets: NDArray[np.int64], patches: int) -> list[NDArray[np.int64]]:
    """Recursive bisection by one coordinate of the centres."""
    if patches == 1:
        return [tets]
    axis = int(np.ptp(centres[tets], axis=0).argmax())
    tets = tets[np.lexsort((tets, centres[tets, axis]))]
    left = patches // 2
    middle = len(tets) * left // patches
    return [*cut_by_centres(centres, tets[:middle], left), *cut_by_centres(centres, tets[middle:], patches - left)]
