"""The public class of free-form patches: surface, fit, tessellation and files; and the rays that render them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from ..common.checks import check_scalar, check_whole
from ..freeform.fit import FitReport, fit_quadrics
from ..freeform.image import PatchImage, render_patches
from ..freeform.io import load_patches, save_patches
from ..freeform.rays import SurfaceRays
from ..freeform.surface import PatchPose, PatchSurface
from ..freeform.targets import base_triangles, target_of
from ..freeform.tessellation import Tessellation, tessellate
from ..geometry.tri_mesh import TriMesh
from ..viewing.render import Camera

__all__ = ["FreeFormPatches", "PatchFit", "PatchRays", "fit_patches"]


@dataclass(frozen=True, eq=False, repr=False, init=False)
class FreeFormPatches(PatchSurface):
    """A surface of free-form patches at rest.

    With barycentric coordinates b, P(b) = sum_k b_k V_k and D(b) = sum_k b_k N_k, the surface is P + h D. Its height is
    h = sum_i a_i [1 - |M_i (x - c_i)|^2]_+^3 over the quadrics whose ellipsoid touches the patch. `base="phong"` curves
    P as Phong tessellation does (weight 3/4). `measured_at="base"` takes x = P. `"surface"` takes x = P + h D, the
    published definition: an equation for h with one solution while its right side rises with h by less than 1
    (`steepness`).

    All floating-point inputs may require a gradient. Patches are immutable: `with_quadrics` and `to` make new ones.

    Args:
        vertices: V [V, 3] at rest [m].
        triangles: vertex numbers [P, 3], counter-clockwise seen from outside; each edge in at most two triangles.
        quadrics: in the frame of the vertices, shared by the whole surface; default none.
        directors: N [V, 3] of unit length, along which heights are measured; default angle-weighted vertex normals.
        base: "flat" triangles, or "phong".
        measured_at: "base" or "surface".
        thickness: tau, half the thickness of the solid that `field` describes [m].

    Raises:
        ValueError: triangles without area; edges with more than two triangles, or two of the same direction; vertices
            without a triangle. Also quadrics that are not finite, and patches on which heights may not be unique.
    """

    @classmethod
    def fit(cls, target: Any, quadrics: int = 60, **options: Any) -> PatchFit:
        """Fit patches to a surface, and report their error; `options` are those of `torchpd.fit_patches`."""
        return fit_patches(target, quadrics, **options)

    def tessellate(self, level: int) -> Tessellation:
        """A triangle mesh with `level` segments along every edge, for evaluation in any pose."""
        return tessellate(self, level)

    def mesh(self, level: int, pose: PatchPose | None = None) -> TriMesh:
        """The surface as triangles, at rest or in a pose of one environment, welded: closed wherever the base is."""
        return self.tessellate(level).mesh(pose)

    def save(self, path: str | Path) -> None:
        """Write to one safetensors file, for `load`."""
        save_patches(self, path)

    @staticmethod
    def load(path: str | Path) -> FreeFormPatches:
        """Read a file written by `save`, on the CPU."""
        return load_patches(path, FreeFormPatches)


class PatchFit(NamedTuple):
    """Result of `FreeFormPatches.fit`: the patches and their error."""

    patches: FreeFormPatches
    report: FitReport


def fit_patches(
    target: Any,
    quadrics: int = 60,
    *,
    patches: int | TriMesh = 80,
    base: Literal["flat", "phong"] = "phong",
    optimizer: Literal["lm", "adam"] = "lm",
    iterations: int | None = None,
    radius_cap: float = 1.1,
    normals: Any = None,
    bounds: Any = None,
    dtype: torch.dtype = torch.float32,
    progress: bool = False,
) -> PatchFit:
    """Fit patches to a surface, and report their error. The same bits on every run.

    The base has its vertices on the target and takes the target's normals as directors; it stays fixed. Quadrics
    represent the remaining height, measured along the directors at samples inside the patches and on their edges.

    "lm": half of the quadrics start as spheres where the residual is large, and Levenberg-Marquardt moves all their
    parameters. The other half starts on the new residual. Quadrics without effect restart elsewhere or are removed.
    "adam": all start at once, and normals and creases between patches count besides distances (`PatchLoss`). Its
    distances are larger.

    Args:
        target: a TriMesh or trimesh.Trimesh, oriented; or points [N, 3] of a closed surface [m]; or a function from
            points [N, 3] (float64) to signed distances [N], negative inside, differentiable by torch.
        quadrics: most quadrics.
        patches: most triangles of the base, found by simplifying the target; or the base itself.
        base: "flat" or "phong", as for `FreeFormPatches`.
        optimizer: "lm" or "adam".
        iterations: most iterations of each stage (default 60); with Adam the total (default 500).
        radius_cap: largest half axis of a quadric, in mean edges of the patch where it starts. Small quadrics touch
            fewer patches.
        normals: outward normals of the points [N, 3]; default: estimated from neighbours.
        bounds: for a function, a box [2, 3] around its surface [m]; not needed if you pass a base.
        dtype: of the patches. The fit itself runs in float64 on the CPU.
        progress: show a progress bar.

    Raises:
        ValueError: the target is not an oriented surface, encloses nothing, or folds over the base.
        ImportError: distances from a mesh need the package rtree.
    """
    count = check_whole("FreeFormPatches.fit: quadrics", quadrics, minimum=1)
    cap = check_scalar("FreeFormPatches.fit: radius_cap", radius_cap, minimum=0.1)
    if optimizer not in ("lm", "adam"):
        raise ValueError(f"FreeFormPatches.fit: optimizer must be lm or adam, got {optimizer!r}")
    rounds = check_whole(
        "FreeFormPatches.fit: iterations", (60 if optimizer == "lm" else 500) if iterations is None else iterations,
        minimum=1,
    )  # fmt: skip
    if not isinstance(patches, TriMesh):
        patches = check_whole("FreeFormPatches.fit: patches", patches, minimum=4)
    surface = target_of(target, normals, bounds, patches if isinstance(patches, TriMesh) else None)
    mesh, directors = base_triangles(surface, patches)
    empty = FreeFormPatches(
        torch.tensor(mesh.vertices), torch.tensor(mesh.triangles), directors=torch.tensor(directors), base=base
    )
    return PatchFit(
        *fit_quadrics(
            empty,
            surface,
            count,
            optimizer=optimizer,
            iterations=rounds,
            radius_cap=cap,
            dtype=dtype,
            progress=progress,
        )
    )


class PatchRays(SurfaceRays):
    """Finds the first hits of rays on free-form patches.

    Every patch is cut into `level` x `level` cells, kept in a tree of boxes that follows each pose. Newton's method
    searches every cell that a ray may hit, from several starts if the cell is seen edge-on. Both sides of the surface
    are hit, and there is no gap between patches. A ray within the plane of a flat patch may miss it.

    The bulge of the surface over a cell is estimated at 12 points. The estimate is good where cells are smaller than
    the quadrics on them, as the default level ensures up to 32. With cells as long as the radii, one of 100,000 rays
    over a bumpy plane (half of them grazing) missed two crossings close to each other. Of rays aimed at bumps narrower
    than that and many times as high, one in two hundred missed.

    Args:
        patches: the surface. Each call may take another one with the same triangles, for example in an optimisation.
        level: cells along every edge. Default: at least 4, and enough that no edge of a cell is longer than half the
            radii of the quadrics.
    """

    def render(
        self,
        camera: Camera,
        size: tuple[int, int],
        pose: PatchPose | None = None,
        *,
        patches: PatchSurface | None = None,
        **options: Any,
    ) -> PatchImage:
        """Render the surface; `torchpd.freeform.image.render_patches` documents the options."""
        return render_patches(self, camera, size, pose, patches=patches, **options)
