"""Transport of free-form patches by a pose: a frame for every vertex, from constraints of four vertices."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..common.checks import as_array
from ..ops.registration import nearest_rotation
from . import ops as patch_ops  # noqa: F401  (registers the ops)
from .adjacency import corner_lists
from .quadrics import check_real_tensor
from .surface import PatchPose, PatchSurface

__all__ = ["PatchTransport"]

_ops = torch.ops.torchpd

Index = NDArray[np.int64]

FrameMode: TypeAlias = Literal["transport", "rotation"]


class PatchTransport(nn.Module):
    """Carries patches along with their vertices and with apexes inside the body.

    Each patch has an apex, a point off its plane, which several patches may share. Corners and apex deform by
    G = Ds Dm^-1, whose singular values are clamped, a negative last one with its sign changed. The frame of a vertex is
    the mean of G over the patches around it, weighted by area. While nothing is clamped, an affine motion of vertices
    and apexes carries the surface along exactly.

    Args:
        patches: at rest. Their shape is a constant here, without gradient.
        apexes: points at rest [K, 3] [m], also constant.
        apex: the apex of each patch, integers [P]; default: one per patch, in order.
        mode: "transport" shears and stretches bumps with their surroundings, "rotation" keeps their shape.
        stretch: least and largest singular value of a frame.

    Raises:
        ValueError: an apex in the plane of its patch, or a wrong number of apexes.
    """

    tets: Tensor
    tet_start: Tensor
    point_tet: Tensor
    inverse_rest: Tensor
    areas: Tensor
    rest_positions: Tensor

    def __init__(
        self,
        patches: PatchSurface,
        apexes: Tensor,
        apex: Tensor | None = None,
        *,
        mode: FrameMode = "transport",
        stretch: tuple[float, float] = (0.3, 3.0),
    ) -> None:
        super().__init__()
        if mode not in ("transport", "rotation"):
            raise ValueError(f"PatchTransport.mode must be transport or rotation, got {mode!r}")
        if not isinstance(patches, PatchSurface):
            raise TypeError(f"PatchTransport: patches must be FreeFormPatches, got {type(patches).__name__}")
        bounds = as_array("PatchTransport.stretch", stretch, np.float64)
        if bounds.shape != (2,) or not 0.0 < bounds[0] <= 1.0 <= bounds[1]:
            raise ValueError(f"PatchTransport.stretch must be (in (0, 1], at least 1), got {stretch}")
        check_real_tensor("PatchTransport.apexes", apexes, (None, 3), "points at rest [m]")
        self.mode, self.stretch = mode, (float(bounds[0]), float(bounds[1]))
        self.vertices = len(patches.vertices)
        rest = torch.cat([patches.vertices.detach(), apexes.detach().to(patches.vertices)])
        tets = _tets(patches, apex, len(apexes))
        starts, corners = corner_lists(tets, len(rest))
        device = rest.device
        inverse, areas = _rest_shape(rest, tets)
        for name, array in (("tets", tets), ("tet_start", starts), ("point_tet", corners)):
            self.register_buffer(name, torch.as_tensor(array, dtype=torch.int32, device=device).contiguous())
        self.register_buffer("inverse_rest", inverse)
        self.register_buffer("areas", areas)
        self.register_buffer("rest_positions", rest)
        nowhere = patches.samples(torch.empty(0, dtype=torch.int32), rest[:0])  # the op needs samples: none here
        self._lists = tuple(f"list_{number}" for number in range(len(patches.lists) + len(nowhere.lists)))
        for name, gathered in zip(self._lists, (*patches.lists, *nowhere.lists), strict=True):
            self.register_buffer(name, gathered, persistent=False)

    @property
    def constraints(self) -> list[Tensor]:
        """The arrays of csrc/freeform/constraints.def, in its order."""
        return [self.tets, self.tet_start, self.point_tet]

    def gradients(self, positions: Tensor, fallback: Tensor | None = None) -> Tensor:
        """Clamped deformation gradients [B, P, 3, 3].

        Args:
            positions: vertices, then apexes, [B, V + K, 3] [m].
            fallback: [B, P, 3, 3], used for constraints that are not finite or have collapsed to a line or point
                (second singular value below 1e-4): the rotations of the local step, or the last gradients. Default:
                the nearest rotation, without gradient.
        """
        lower, upper = self.stretch
        G: Tensor = _ops.patch_deformation(
            positions, self.inverse_rest, fallback, self.constraints, lower=lower, upper=upper
        )
        return G

    def frames(self, gradients: Tensor) -> Tensor:
        """Frames of the vertices [B, V, 3, 3] from gradients of the patches [B, P, 3, 3]."""
        A: Tensor = _ops.patch_frames(gradients, self.areas, [getattr(self, name) for name in self._lists])
        return nearest_rotation(A) if self.mode == "rotation" else A

    def forward(self, positions: Tensor, fallback: Tensor | None = None) -> PatchPose:
        """The pose of the patches for positions [B, V + K, 3] m of vertices and apexes."""
        frames = self.frames(self.gradients(positions, fallback))
        return PatchPose(positions[:, : self.vertices], frames)


def _tets(patches: PatchSurface, apex: Tensor | None, apexes: int) -> Index:
    triangles = patches.triangles.cpu().numpy().astype(np.int64)
    number = np.arange(len(triangles)) if apex is None else as_array("PatchTransport.apex", apex)
    if number.shape != (len(triangles),) or number.dtype.kind not in "iu":
        raise ValueError(
            f"PatchTransport.apex must be integers [{len(triangles)}], one for each patch, got {list(number.shape)}"
        )
    if number.min() < 0 or number.max() >= apexes:
        raise ValueError(
            f"PatchTransport.apex must lie in 0..{apexes - 1} (there are {apexes} apexes), got "
            f"{number.min()} to {number.max()}"
        )
    return np.concatenate([triangles, len(patches.vertices) + number[:, None]], axis=1)


def _rest_shape(rest: Tensor, tets: Index) -> tuple[Tensor, Tensor]:
    """Dm^-1 [P, 3, 3] in 1/m and areas [P] in m^2, computed in float64."""
    corners = rest.double().cpu()[torch.as_tensor(tets)]
    edges = (corners[:, 1:] - corners[:, :1]).mT
    cross = torch.linalg.cross(edges[..., 0], edges[..., 1])
    areas = 0.5 * cross.norm(dim=1)
    height = (edges[..., 2] * cross).sum(1).abs() / cross.norm(dim=1)
    longest = edges.norm(dim=1).amax(1)
    flat = (~(height > 1e-3 * longest)).nonzero()[:, 0].tolist()
    if flat:
        raise ValueError(
            "PatchTransport.apexes must lie off the plane of their patch, by more than 1e-3 of its longest edge, got "
            f"{float(height[flat[0]]):.3g} m for patch {flat[0]} ({len(flat)} in all)"
        )
    return torch.linalg.inv(edges).to(rest), areas.to(rest)
