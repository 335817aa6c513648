"""A body of free-form patches: a `Solid` whose tetrahedra are the constraints of the patches, and its patch pose."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.checks import as_array, check_finite, check_positive, check_scalar, check_shape
from ..geometry.mesh_checks import set_frozen
from ..geometry.tet_mesh import without_face_checks
from ..scene.effects import Solid
from ..scene.part import ArrayLike
from .constraints import Constraints, prisms, skeleton
from .surface import PatchPose, PatchSurface
from .transport import FrameMode, PatchTransport

__all__ = ["PatchBody"]

Index = NDArray[np.int64]

ApexKind: TypeAlias = Literal["skeleton", "prism"]


class PatchBody(Solid):
    """An elastic body bounded by free-form patches; a part of a `Scene` like any other `Solid`.

    The energy of a constraint of four vertices is st v |G - R|^2, with G = Ds Dm^-1, R its nearest rotation and v its
    rest volume (Vyatkin and Dolgovesov 2023; st = w / 2 of `Solid`). The body's vertices are those of the patches, in
    their order, then the apexes. So pins, forces and targets of vertices 0..V-1 apply to the patches. Contacts act on
    these vertices. `Contact` acts on the triangles of the patches, of prisms on the whole boundary of the layer, not on
    the heights over them: see `rise`.

    "skeleton", for closed bodies: every patch has an apex inside. Patches that see an apex share it, and tetrahedra
    fill the space between, so that the constraints resist bending and change of volume.

    "prism", for open sheets or shells: a second layer under the patches, with three constraints per patch. It takes
    part in contacts and in the mass. The layer is one element thick: it stretches like a plate of its thickness, but
    resists bending 3.1 + 1.24 (c / thickness)^2 times more, with c the leg of right-angled patches. Dividing the
    stiffness by that factor gives the right bending and too much stretch. A thinner layer does not help: at equal
    stretching it still resists bending 1.24 times as much as a plate of thickness c.

    `Simulator.save` writes the `Solid`; `patches.save` keeps the surface, from which you make the same body again.

    Args:
        patches: at rest. Shape and quadrics are constants of the body. `pose` works on their device and in their
            precision, which must be the simulator's.
        stiffness: st [Pa], half of Young's modulus, a scalar or one value per patch, positive. Constraints between
            apexes take the mean.
        density: [kg/m^3], positive. The mass is that of the enclosed volume, or of the layer.
        apex: "skeleton" or "prism".
        thickness: of the layer of prisms along the directors [m], positive; default half the mean edge.
        mode, stretch: of the frames, see `PatchTransport`.

    Raises:
        ValueError: a skeleton for an open or inside-out surface, or flat or inverted constraints (less than 1e-3 of
            the mean volume, or of their longest edge high).
    """

    patches: PatchSurface
    apex: ApexKind
    apexes: int  # K
    patch_of: Index  # [E] patch of each constraint, -1 between apexes
    transport: PatchTransport
    _layer: _Layer | None

    def __init__(
        self,
        patches: PatchSurface,
        stiffness: ArrayLike,
        density: float = 1000.0,
        *,
        apex: ApexKind = "skeleton",
        thickness: float | None = None,
        mode: FrameMode = "transport",
        stretch: tuple[float, float] = (0.3, 3.0),
    ) -> None:
        if not isinstance(patches, PatchSurface):
            raise TypeError(
                f"PatchBody: patches must be FreeFormPatches, got {type(patches).__name__}; "
                "make them with torchpd.FreeFormPatches.from_mesh(surface, quadrics)"
            )
        count = len(patches.triangles)
        constants = _per_patch(stiffness, count)
        mass = check_scalar("PatchBody.density", density)
        check_positive("PatchBody.density", np.array([mass]), unit="kg/m^3")
        made = _constraints(patches, apex, thickness)
        own = made.patch >= 0
        st = np.where(own, constants[np.where(own, made.patch, 0)], constants.mean())
        # constraints of a skeleton may overlap or leave gaps, which must not change the mass
        super().__init__(without_face_checks(made.points, made.tets), 2.0 * st, mass / made.share)
        rest = torch.as_tensor(made.points, dtype=patches.vertices.dtype, device=patches.vertices.device)
        set_frozen(
            self, patches=patches, apex=apex, apexes=len(made.points) - len(patches.vertices), patch_of=made.patch
        )
        chosen = None if apex == "prism" else torch.as_tensor(made.tets[:count, 3] - len(patches.vertices))
        layer = _Layer(patches.triangles, self.apexes) if apex == "prism" else None
        set_frozen(self, _layer=layer)
        transport = PatchTransport(patches, self._apexes(rest[None])[0], chosen, mode=mode, stretch=stretch)
        set_frozen(self, transport=transport)

    def pose(self, positions: Tensor, fallback: Tensor | None = None) -> PatchPose:
        """The pose of the patches on the body, for `patches.surface` and `patches.mesh`. Differentiable.

        Args:
            positions: vertices of this body [B, V + K, 3] [m]: those of a state, or with several bodies in the scene
                `state.positions[:, scene.vertex_range(body)]`.
            fallback: see `PatchTransport.gradients`.
        """
        pose: PatchPose = self.transport(self.points(positions), fallback)
        return pose

    def contact_triangles(self) -> Index | None:
        """Those of the patches: constraints of a skeleton leave gaps, whose sides would count. A layer has none."""
        if self.apex == "prism":
            return None
        return self.patches.triangles.cpu().numpy().astype(np.int64)

    def rise(self) -> float:
        """The largest distance of the patches from their triangles at 15 points of each, at rest [m]."""
        steps = torch.arange(5, dtype=self.patches.vertices.dtype, device=self.patches.vertices.device) / 4.0
        first, second = (line.reshape(-1) for line in torch.meshgrid(steps, steps, indexing="ij"))
        inside = first + second <= 1.0
        at = torch.stack([first, second, 1.0 - first - second], dim=1)[inside]
        count = len(self.patches.triangles)
        number = torch.arange(count, device=at.device).repeat_interleave(len(at))
        samples = self.patches.samples(number, at.repeat(count, 1))
        points, corners = self.patches.surface(samples).points, self.patches.vertices[self.patches.triangles.long()]
        flat = (samples.barycentrics[:, :, None] * corners[number]).sum(dim=1)
        return float((points - flat).norm(dim=1).max())

    def points(self, positions: Tensor) -> Tensor:
        """Patch vertices and apexes in the order of `transport`, from positions as for `pose`."""
        want = self.patches.vertices
        count = len(self.mesh.vertices)
        if not isinstance(positions, Tensor):
            raise TypeError(
                f"PatchBody.pose: positions must be a tensor [B, {count}, 3], got {type(positions).__name__}; take "
                "state.positions"
            )
        if positions.dim() != 3 or tuple(positions.shape[1:]) != (count, 3):
            raise ValueError(
                f"PatchBody.pose: positions must be [B, {count}, 3], the vertices of this body alone, got "
                f"{list(positions.shape)}; take positions[:, scene.vertex_range(body)], and flatten(0, 1) a track"
            )
        if positions.dtype != want.dtype or positions.device != want.device:
            raise TypeError(
                f"PatchBody.pose: positions must be {want.dtype} on {want.device} like the patches, got "
                f"{positions.dtype} on {positions.device}; make the body of patches.to(...)"
            )
        return torch.cat([positions[:, : len(want)], self._apexes(positions)], dim=1)

    def _apexes(self, positions: Tensor) -> Tensor:
        """The apexes of the frames: those of the skeleton, or the centroid of the layer under each patch."""
        rest = positions[:, len(self.patches.vertices) :]
        return rest if self._layer is None else self._layer(rest)

    def __repr__(self) -> str:
        return (
            f"PatchBody({self.patches}, {len(self.mesh.tets)} constraints with {self.apexes} apexes, "
            f"apex={self.apex!r})"
        )


class _Layer:
    """Centroids of the triangles of a layer; the adjoint gathers in a fixed order, for equal bits."""

    def __init__(self, triangles: Tensor, vertices: int) -> None:
        corners = triangles.cpu().numpy().reshape(-1)
        order = np.argsort(corners, kind="stable")
        times = np.bincount(corners, minlength=vertices)
        rank = np.arange(len(order)) - np.repeat(np.cumsum(times) - times, times)
        around = np.full((vertices, int(times.max())), len(triangles), dtype=np.int64)  # default: an appended zero row
        around[corners[order], rank] = order // 3
        self.triangles = triangles.long()
        self.around = torch.as_tensor(around, device=triangles.device)

    def __call__(self, positions: Tensor) -> Tensor:
        centroids: Tensor = _Centroids.apply(positions, self.triangles, self.around)  # type: ignore[no-untyped-call]
        return centroids


class _Centroids(torch.autograd.Function):
    """Means over the corners of triangles: [B, V, 3] to [B, P, 3]."""

    generate_vmap_rule = True

    @staticmethod
    def forward(positions: Tensor, triangles: Tensor, around: Tensor) -> Tensor:
        return positions[:, triangles].mean(2)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(inputs[2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (around,) = ctx.saved_tensors
        padded = torch.cat([gradient, torch.zeros_like(gradient[:, :1])], dim=1)
        return padded[:, around].sum(2) / 3.0, None, None


def _per_patch(stiffness: ArrayLike, count: int) -> NDArray[np.float64]:
    name = "PatchBody.stiffness"
    array = as_array(name, stiffness, np.float64)
    array = np.full(count, float(array)) if array.ndim == 0 else array
    check_shape(name, array, (count,), "one value per patch or a scalar [Pa]")
    check_finite(name, array)
    check_positive(name, array, unit="Pa")
    return array


def _constraints(patches: PatchSurface, apex: Any, thickness: float | None) -> Constraints:
    vertices, directors = (t.detach().cpu().double().numpy() for t in (patches.vertices, patches.directors))
    triangles = patches.triangles.cpu().numpy().astype(np.int64)
    if not isinstance(apex, str) or apex not in ("skeleton", "prism"):
        raise ValueError(f"PatchBody.apex must be skeleton or prism, got {apex!r}")
    if apex == "skeleton":
        if thickness is not None:
            raise ValueError(f"PatchBody.thickness is for apex='prism', a skeleton has none, got {thickness}")
        return skeleton(vertices, triangles)
    if thickness is None:
        sides = vertices[triangles] - vertices[np.roll(triangles, -1, axis=1)]
        thickness = 0.5 * float(np.linalg.norm(sides, axis=2).mean())
    height = check_scalar("PatchBody.thickness", thickness)
    check_positive("PatchBody.thickness", np.array([height]), unit="m")
    return prisms(vertices, triangles, directors, height)
