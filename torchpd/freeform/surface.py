"""Free-form patches: triangles that quadrics raise to a curved surface, watertight in every pose.

Vyatkin and Dolgovesov (2023), joined by shell coordinates. Neighbours share vertices, directors and quadrics, hence
the same surface at their edge. It is continuous everywhere and C2 inside each patch; across edges it may crease.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..common.checks import check_scalar
from ..common.reprs import by_sizes
from ..geometry.mesh_checks import set_frozen
from ..geometry.tri_mesh import TriMesh
from . import ops as patch_ops  # noqa: F401  (registers the ops)
from .adjacency import TouchingPairs, find_touching_pairs, gather_lists
from .checks import angle_weighted_normals, check_surface
from .quadrics import Quadrics, check_real_tensor, dimensions, matrix_sets

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["PatchPose", "PatchSamples", "PatchSurface", "SurfacePoints", "check_pose"]

_ops = torch.ops.torchpd

BaseKind: TypeAlias = Literal["flat", "phong"]
MeasuredAt: TypeAlias = Literal["base", "surface"]
Reading: TypeAlias = Literal["clip", "literal"]


class PatchPose(NamedTuple):
    """Positions of the vertices, and frames that rotate and stretch their surroundings; see `PatchTransport.pose`."""

    positions: Tensor  # [B, V, 3] m
    frames: Tensor  # [B, V, 3, 3]

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "batch", "vertices")


class SurfacePoints(NamedTuple):
    """The surface at samples; without the batch dimension at rest."""

    points: Tensor  # [B, S, 3] m
    normals: Tensor  # [B, S, 3] unit, outwards
    tangents: Tensor  # [B, S, 2, 3] m, derivatives by the first two barycentric coordinates (the third compensates)

    def __repr__(self) -> str:
        return by_sizes(self, self.points, "batch", "samples")


@dataclass(frozen=True, eq=False)
class PatchSamples:
    """Points on patches, in any order; made by `FreeFormPatches.samples`."""

    patch: Tensor  # int32 [S]
    barycentrics: Tensor  # [S, 3]
    lists: tuple[Tensor, ...]  # the last three arrays of csrc/freeform/lists.def

    def __len__(self) -> int:
        return len(self.patch)

    def at(self, barycentrics: Tensor) -> PatchSamples:
        """The same patches at other barycentric coordinates [S, 3]."""
        return PatchSamples(self.patch, barycentrics, self.lists)

    def __repr__(self) -> str:
        return by_sizes(self, self.barycentrics, "samples")


@dataclass(frozen=True, eq=False, repr=False, init=False)
class PatchSurface:
    """Points, normals, heights and field of a surface of free-form patches; `FreeFormPatches` documents it."""

    vertices: Tensor
    triangles: Tensor  # int32 [P, 3]
    quadrics: Quadrics
    directors: Tensor
    base: BaseKind
    measured_at: MeasuredAt
    thickness: float
    lists: tuple[Tensor, ...]  # the first eight arrays of csrc/freeform/lists.def
    reach: Tensor  # [P] bound of |h| if measured on the surface, else 0 [m]
    steepness: Tensor  # [P] bound of d/dh sum_i R_i(P + h D) there, else 0

    def __init__(
        self,
        vertices: Tensor,
        triangles: Tensor,
        quadrics: Quadrics | None = None,
        *,
        directors: Tensor | None = None,
        base: BaseKind = "flat",
        measured_at: MeasuredAt = "base",
        thickness: float = 0.0,
    ) -> None:
        _choose("base", base, ("flat", "phong"))
        _choose("measured_at", measured_at, ("base", "surface"))
        check_real_tensor("FreeFormPatches.vertices", vertices, (None, 3), "positions at rest [m]")
        elements = check_surface(vertices, triangles)
        if directors is None:
            directors = angle_weighted_normals(vertices, elements)
        if quadrics is None:
            quadrics = Quadrics.none(vertices.dtype, vertices.device)
        _check_directors(directors, vertices)
        set_frozen(
            self,
            vertices=vertices,
            triangles=torch.as_tensor(elements, dtype=torch.int32, device=vertices.device),
            directors=directors,
            base=base,
            measured_at=measured_at,
            thickness=check_scalar("FreeFormPatches.thickness", thickness, minimum=0.0),
        )
        self._own(quadrics)

    def _own(self, quadrics: Quadrics) -> None:
        """Store the quadrics and find the patches that they touch."""
        _check_quadrics(quadrics, self.vertices)
        pairs = self._touching_pairs(quadrics)
        if self.measured_at == "surface":
            _check_unique(pairs)
        elements = self.triangles.cpu().numpy().astype(np.int64)
        arrays = gather_lists(elements, len(self.vertices), pairs, len(quadrics))
        device, dtype = self.vertices.device, self.vertices.dtype
        set_frozen(
            self,
            quadrics=quadrics,
            lists=tuple(torch.as_tensor(a, dtype=torch.int32, device=device).contiguous() for a in arrays),
            reach=torch.as_tensor(pairs.reach, dtype=dtype, device=device),
            steepness=torch.as_tensor(pairs.steepness, dtype=dtype, device=device),
        )

    def _touching_pairs(self, quadrics: Quadrics) -> TouchingPairs:
        arrays = [
            t.detach().cpu().double().numpy()
            for t in (self.vertices, self.directors, quadrics.amplitudes, quadrics.centres, quadrics.triangular())
        ]
        vertices, directors, amplitudes, centres, m = arrays
        elements = self.triangles.cpu().numpy().astype(np.int64)
        return find_touching_pairs(
            vertices, elements, directors, amplitudes, centres, m,
            curved=self.base == "phong", on_surface=self.measured_at == "surface",
        )  # fmt: skip

    @classmethod
    def from_mesh(
        cls, mesh: TriMesh, quadrics: Quadrics | None = None, *, dtype: torch.dtype = torch.float32, **options: Any
    ) -> Self:
        """Patches over the triangles of a mesh; `options` are those of the constructor."""
        if not isinstance(mesh, TriMesh):
            raise TypeError(f"FreeFormPatches.from_mesh: mesh must be a TriMesh, got {type(mesh).__name__}")
        return cls(torch.tensor(mesh.vertices, dtype=dtype), torch.tensor(mesh.triangles), quadrics, **options)

    def with_quadrics(self, quadrics: Quadrics, *, keep_lists: bool = False) -> Self:
        """The same base with other quadrics.

        Args:
            quadrics: of the same precision and device.
            keep_lists: reuse the lists of touched patches. The quadrics must be as many and in the same order. Nothing
                is checked and nothing waits for the device: use it in the inner loop of an optimisation, between calls
                without it.
        """
        other = self._copy()
        if not keep_lists:
            other._own(quadrics)
            return other
        if len(quadrics) != len(self.quadrics):
            raise ValueError(
                f"with_quadrics: keep_lists needs {len(self.quadrics)} quadrics as before, got {len(quadrics)}"
            )
        set_frozen(other, quadrics=quadrics)
        return other

    def with_shape(self, vertices: Tensor, directors: Tensor) -> Self:
        """The same triangles, quadrics and lists over other rest vertices and directors, which are not checked.

        Use it for gradients by the base; make new patches once the shape has moved.
        """
        check_real_tensor("with_shape: vertices", vertices, tuple(self.vertices.shape), "positions at rest [m]")
        check_real_tensor("with_shape: directors", directors, tuple(self.directors.shape), "unit vectors")
        other = self._copy()
        set_frozen(other, vertices=vertices, directors=directors)
        return other

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """The same on another device or in another precision, as `Tensor.to`."""
        other = self._copy()
        real = {
            name: getattr(self, name).to(*args, **kwargs) for name in ("vertices", "directors", "reach", "steepness")
        }
        device = real["vertices"].device
        set_frozen(
            other,
            **real,
            quadrics=self.quadrics.to(*args, **kwargs),
            triangles=self.triangles.to(device),
            lists=tuple(t.to(device) for t in self.lists),
        )
        return other

    def _copy(self) -> Self:
        other = object.__new__(type(self))
        # by name: some versions of torch.compile cannot trace the object's dictionary
        for name in _FIELDS:
            object.__setattr__(other, name, getattr(self, name))
        return other

    # ---- evaluation

    def samples(self, patch: Tensor, barycentrics: Tensor) -> PatchSamples:
        """Sample points for evaluation.

        Args:
            patch: of each sample, integers [S].
            barycentrics: coordinates of each sample [S, 3], with sum 1.
        """
        check_real_tensor("samples: barycentrics", barycentrics, (None, 3), "barycentric coordinates")
        if not isinstance(patch, Tensor):
            raise TypeError(f"samples: patch must be a tensor of integers, got {type(patch).__name__}")
        counts = not (patch.dtype.is_floating_point or patch.dtype.is_complex or patch.dtype == torch.bool)
        if patch.dim() != 1 or not counts or len(patch) != len(barycentrics):
            raise ValueError(
                f"samples: patch must be integers [{len(barycentrics)}] like barycentrics, "
                f"got {patch.dtype} {list(patch.shape)}"
            )
        count = len(self.triangles)
        # checked before the conversion to 32 bits
        if len(patch) and not (int(patch.min()) >= 0 and int(patch.max()) < count):
            raise IndexError(f"samples: patch must lie in 0..{count - 1}, got {int(patch.min())} to {int(patch.max())}")
        number = patch.detach().to(device=self.vertices.device, dtype=torch.int32)
        ordered, order = torch.sort(number, stable=True)
        starts = torch.searchsorted(ordered, torch.arange(count + 1, dtype=torch.int32, device=number.device))
        return PatchSamples(number, barycentrics, (number, starts.to(torch.int32), order.to(torch.int32)))

    def heights(self, samples: PatchSamples) -> tuple[Tensor, Tensor]:
        """Heights h [S] over the base [m], and their derivatives [S, 2] by b_1 and b_2 (b_3 compensates)."""
        _check_kind("samples", samples, PatchSamples, "FreeFormPatches.samples makes them")
        q = self.quadrics
        h, slopes = _ops.patch_height(
            self.vertices, self.directors, q.amplitudes, q.centres, q.entries(), samples.barycentrics,
            self._lists(samples), on_surface=self.measured_at == "surface", phong=self.base == "phong",
        )  # fmt: skip
        return h, slopes

    def surface(
        self, samples: PatchSamples, pose: PatchPose | None = None, *, heights: tuple[Tensor, Tensor] | None = None
    ) -> SurfacePoints:
        """Points, normals and tangents, at rest or in poses.

        Heights are fixed in the material: they are equal in every pose.

        Args:
            samples: points to evaluate.
            pose: of B environments; default at rest.
            heights: the result of `heights(samples)`, if known.
        """
        _check_kind("samples", samples, PatchSamples, "FreeFormPatches.samples makes them")
        h, slopes = self.heights(samples) if heights is None else heights
        if pose is not None:
            check_pose(pose)
        if pose is None:
            eye = torch.eye(3, dtype=self.vertices.dtype, device=self.vertices.device)
            rest = PatchPose(self.vertices[None], eye.expand(1, len(self.vertices), 3, 3))
            return SurfacePoints(*(t[0] for t in self.surface(samples, rest, heights=(h, slopes))))
        points, tangents = _ops.patch_surface(
            *pose, self.vertices, self.directors, h, slopes, samples.barycentrics, self._lists(samples),
            phong=self.base == "phong",
        )  # fmt: skip
        normal = torch.linalg.cross(tangents[..., 0, :], tangents[..., 1, :])
        return SurfacePoints(points, torch.nn.functional.normalize(normal, dim=-1, eps=0.0), tangents)

    def field(
        self,
        points: Tensor,
        patch: Tensor,
        *,
        positions: Tensor | None = None,
        reading: Reading = "clip",
        matrices: Tensor | None = None,
    ) -> Tensor:
        """The published field F' of single patches: positive inside, 0 on the boundary.

        F is the minimum of five planes: three through the edges, perpendicular to the triangle, and two at `thickness`
        on either side of it. "literal" adds the quadrics to F, "clip" only to the outer plane. Patches of this field do
        not join: see `surface`.

        Args:
            points: x [S, 3], or [B, S, 3] in B poses [m].
            patch: of each point, integers [S].
            positions: vertices [B, V, 3] [m]; default at rest.
            reading: "clip" or "literal".
            matrices: quadrics W [Q, 4, 4], or [B, Q, 4, 4] that follow the poses, in place of those of the patches:
                R_i = a_i [(x, 1)^T W_i (x, 1)]_+^3. They need not be ellipsoids.

        Returns:
            F' [S] or [B, S] in m.
        """
        _choose("reading", reading, ("clip", "literal"))
        batched = dimensions(points) == 3
        check_real_tensor("field: points", points, (None, None, 3) if batched else (None, 3), "x [m]")
        x = points if batched else points[None]
        v = self.vertices.expand(len(x), -1, -1) if positions is None else positions
        W = self.quadrics.normalized_matrices() if matrices is None else matrices
        where = self.samples(patch, torch.zeros_like(x[0]))
        F: Tensor = _ops.patch_field(
            x, v, self.quadrics.amplitudes, matrix_sets(W), self._lists(where),
            thickness=self.thickness, clip=reading == "clip",
        )  # fmt: skip
        return F if batched else F[0]

    def _lists(self, samples: PatchSamples) -> list[Tensor]:
        return [*self.lists, *samples.lists]

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({len(self.triangles)} patches, {len(self.vertices)} vertices, {len(self.quadrics)} "
            f"quadrics, base={self.base!r}, measured_at={self.measured_at!r})"
        )


_FIELDS = tuple(field.name for field in fields(PatchSurface))


def _choose(name: str, value: object, among: tuple[str, ...]) -> None:
    if value not in among:
        raise ValueError(f"{name} must be one of {', '.join(among)}, got {value!r}")


def _check_directors(directors: Tensor, vertices: Tensor) -> None:
    check_real_tensor("FreeFormPatches.directors", directors, tuple(vertices.shape), "a unit vector for each vertex")
    if directors.dtype != vertices.dtype or directors.device != vertices.device:
        raise ValueError(
            f"FreeFormPatches.directors must be {vertices.dtype} on {vertices.device} like vertices, "
            f"got {directors.dtype} on {directors.device}"
        )
    bad = (~((directors.detach().norm(dim=1) - 1.0).abs() <= 1e-3)).nonzero()[:, 0].tolist()
    if bad:
        raise ValueError(
            f"FreeFormPatches.directors must be of unit length, got {directors[bad[0]].tolist()} at {bad[0]} "
            f"({len(bad)} in all)"
        )


def _check_kind(name: str, value: Any, kind: type, source: str) -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {kind.__name__}, got {type(value).__name__}; {source}")


def check_pose(pose: Any) -> None:
    """Refuse anything but a pose, such as a state or its positions."""
    _check_kind("pose", pose, PatchPose, "PatchBody.pose makes one of the positions of a state")


def _check_quadrics(quadrics: Quadrics, vertices: Tensor) -> None:
    _check_kind("FreeFormPatches.quadrics", quadrics, Quadrics, "Quadrics.none(...) for none")
    if quadrics.amplitudes.dtype != vertices.dtype or quadrics.amplitudes.device != vertices.device:
        raise ValueError(
            f"FreeFormPatches.quadrics must be {vertices.dtype} on {vertices.device} like vertices, "
            f"got {quadrics.amplitudes.dtype} on {quadrics.amplitudes.device}"
        )
    M = quadrics.triangular().detach().flatten(1)
    numbers = torch.cat([quadrics.amplitudes.detach()[:, None], quadrics.centres.detach(), M], dim=1)
    flat = (quadrics.triangular().detach().diagonal(dim1=1, dim2=2) <= 0).any(1)
    bad = (~numbers.isfinite().all(1) | flat).nonzero()[:, 0].tolist()
    if bad:
        raise ValueError(
            "FreeFormPatches.quadrics must be finite ellipsoids, got amplitude "
            f"{float(quadrics.amplitudes[bad[0]])}, centre {quadrics.centres[bad[0]].tolist()} and factor "
            f"{quadrics.factors[bad[0]].tolist()} at {bad[0]} ({len(bad)} in all)"
        )


def _check_unique(pairs: TouchingPairs) -> None:
    bad = np.flatnonzero(~(pairs.steepness < 1.0))
    if len(bad):
        raise ValueError(
            "FreeFormPatches.quadrics must rise along the directors by less than 1 m per m with measured_at='surface', "
            f"got up to {pairs.steepness[bad[0]]:.3g} on patch {bad[0]} ({len(bad)} in all). The patch may fold over: "
            "lower or widen its quadrics, move their centres towards the base, or pass measured_at='base'"
        )
