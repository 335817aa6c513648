"""Free-form patches as users have them: patches that fit themselves to targets and are written, and rays that draw."""

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

    With barycentric coordinates b, P(b) = sum_k b_k V_k and D(b) = sum_k b_k N_k, the surface is P + h D, of height
    h = sum_i a_i [1 - |M_i (x - c_i)|^2]_+^3 over the quadrics whose ellipsoid touches the patch. `base="phong"` curves
    P as Phong tessellation does (weight 3/4). `measured_at="base"` takes x = P; `"surface"` takes x = P + h D, the
    published reading, an equation for h, of one solution while its right side rises with h by less than 1
    (`steepness`).

    Everything floating may require a gradient. Patches do not change: `with_quadrics` and `to` make others.

    Args:
        vertices: V [V, 3] at rest [m].
        triangles: vertex numbers [P, 3], counter-clockwise seen from outside; each edge in at most two triangles.
        quadrics: owned by the whole surface, in the same frame as the vertices; none when left out.
        directors: N [V, 3] of unit length, the directions in which heights are measured; angle-weighted vertex normals
            when left out.
        base: "flat" triangles, or "phong".
        measured_at: "base" or "surface".
        thickness: tau, half the thickness of the solid that `field` describes [m].

    Raises:
        ValueError: triangles without area, edges with more than two triangles or two of the same direction, vertices
            without a triangle, quadrics that are not finite, or patches on which heights on the surface may not be
            unique.
    """

    @classmethod
    def fit(cls, target: Any, quadrics: int = 60, **options: Any) -> PatchFit:
        """Patches fitted to a surface, and how far they are from it; `options` are those of `torchpd.fit_patches`."""
        return fit_patches(target, quadrics, **options)

    def tessellate(self, level: int) -> Tessellation:
        """A triangle mesh with `level` segments along every edge, to be evaluated in any pose."""
        return tessellate(self, level)

    def mesh(self, level: int, pose: PatchPose | None = None) -> TriMesh:
        """The surface as triangles, at rest or in a pose of one environment, welded: as closed as the base."""
        return self.tessellate(level).mesh(pose)

    def save(self, path: str | Path) -> None:
        """Write to one safetensors file; `load` reads it."""
        save_patches(self, path)

    @staticmethod
    def load(path: str | Path) -> FreeFormPatches:
        """Read what `save` wrote, on the CPU."""
        return load_patches(path, FreeFormPatches)


class PatchFit(NamedTuple):
    """What `FreeFormPatches.fit` gives."""

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
    """Patches fitted to a surface, and how far they are from it. The same bits on every run.

    The base lies with its vertices on the target and has the target's normals for directors; it does not move. Quadrics
    then make up the difference, measured along the directors at samples inside of patches and on their edges.

    "lm": half of the quadrics begin as balls where the difference is large, and Levenberg-Marquardt moves all their
    numbers; the other half begins on what is left; those that contribute nothing begin again elsewhere or are left out.
    "adam": all begin at once, and normals and creases between patches count beside distances (`PatchLoss`); its errors
    in distance are larger.

    Args:
        target: a TriMesh or trimesh.Trimesh, oriented; points [N, 3] of a closed surface [m]; or a function that turns
            points [N, 3] (float64) into values [N], differentiable by torch, negative inside: a signed distance.
        quadrics: at most so many.
        patches: at most so many triangles for the base, found by simplifying the target, or the base itself.
        base: "flat" or "phong", as for `FreeFormPatches`.
        optimizer: "lm" or "adam".
        iterations: of each stage, at most 60 when left out; of Adam in all, 500 when left out.
        radius_cap: the largest half axis of a quadric, in mean edges of the patch where it begins. Small ones touch
            fewer patches.
        normals: of the points [N, 3], outwards; estimated from neighbours when left out.
        bounds: for a function, a box [2, 3] around its surface [m]; not needed with a base of your own.
        dtype: of the patches. The fit itself is in float64 on the CPU.
        progress: show a progress bar.

    Raises:
        ValueError: a target that is not an oriented surface, that encloses nothing, or that folds over the base.
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
    """Finds where rays hit free-form patches.

    Every patch is cut into `level` x `level` cells, which a tree of boxes holds; the boxes follow each pose. A cell
    that a ray may meet is searched by Newton's method, from several places where the cell is seen edge-on. Both sides
    of the surface are hit, and patches leave no gap along their edges. A ray within the plane of a flat patch may pass.

    How far the surface bulges over a cell is measured at 12 points in it. That is an estimate, good where a cell is
    smaller than the quadrics on it, which the default level sees to up to 32. With cells as long as the radii, one of
    100,000 rays over a bumpy plane, half of them grazing, missed two crossings close to each other; of rays aimed at
    bumps that are narrower than that and many times as high, one in two hundred passes.

    Args:
        patches: the surface. Others of the same triangles may be passed to each call, for instance in an optimisation.
        level: cells along every edge; when left out, at least 4, and so many that no edge of a cell is longer than
            half the radii of the quadrics.
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
        """Pictures of the surface: see `torchpd.freeform.image.render_patches`, which takes the options."""
        return render_patches(self, camera, size, pose, patches=patches, **options)
