"""Read-outs of stencils: stress of cloth, tensions of rods, springs and fibres, forces of ties.

A stencil has the deformation F = sum_a x_a g_a^T. In a triangle F = R U, with R of two orthonormal columns. The energy
per rest area is mu |F - R|^2 + lambda t^2 / 2 with t = tr(R^T F) - 2 (see `Cloth`), and w / 2 (|F f| - 1)^2 for each
thread along f. Forces per length, in axes that turn with the triangle from its rest plane, are those of Cauchy:

    sigma = (T U + sum w (1 - 1 / |F f|) (U f) (U f)^T) / det U,   T = 2 mu (U - 1) + min(lambda t, 2 mu) 1
"""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from ..common.reprs import by_sizes
from ..common.small_matrices import dot, length, product, root
from ..scene.cloth import Cloth
from ..scene.fibres import Fibres
from ..scene.rod import Rod
from ..scene.scene import Scene
from ..scene.springs import Springs
from ..scene.tie import Tie

__all__ = ["MembraneStress", "Tension", "forces_of_ties", "has_membrane_stress", "membrane_stress", "tensions"]


class MembraneStress(NamedTuple):
    """Stress and strain of the triangles of a cloth, see `Simulator.membrane_stress`. NaN where `collapsed`."""

    cauchy: Tensor  # [B, F, 2, 2] N/m, symmetric, in axes that turn with the triangle from its rest plane
    principal: Tensor  # [B, F, 2] N/m, the larger one first
    strain: Tensor  # [B, F, 2, 2], Green's, (F^T F - 1) / 2, in the rest plane
    collapsed: Tensor  # [B, F] bool, true unless the triangle has an area

    def __repr__(self) -> str:
        return by_sizes(self, self.cauchy, "batch", "triangles", trailing=2)


class Tension(NamedTuple):
    """Tension and strain of the segments of a rod, of springs or of fibres, see `Simulator.tensions`."""

    tension: Tensor  # [B, N] N, of fibres Pa of rest area; negative in compression
    strain: Tensor  # [B, N] length over rest length, less 1

    def __repr__(self) -> str:
        return by_sizes(self, self.tension, "batch", "elements", trailing=0)


class _Rest(NamedTuple):
    """Constant arrays of one kind of stencils."""

    corners: Tensor  # [N, n]
    gradients: Tensor  # [N, n, d]
    constants: Tensor  # [N, c]


# kept, because scenes do not change and a copy to a GPU would wait for it
_REST: WeakKeyDictionary[Scene, dict[tuple[torch.device, torch.dtype], dict[str, _Rest]]] = WeakKeyDictionary()


def _rest(scene: Scene, like: Tensor) -> dict[str, _Rest]:
    kept = _REST.setdefault(scene, {})
    key = like.device, like.dtype
    if key not in kept:
        kept[key] = {
            group.kind: _Rest(
                torch.tensor(group.corners, device=like.device),
                torch.tensor(group.gradients, dtype=like.dtype, device=like.device),
                torch.tensor(group.constants, dtype=like.dtype, device=like.device),
            )
            for group in scene.values().stencils
        }
    return kept[key]


def _columns(rest: _Rest, positions: Tensor, rows: slice) -> list[Tensor]:
    """Columns of F [B, N, 3] of some stencils, summed over the corners in order."""
    corners, gradients = rest.corners[rows], rest.gradients[rows]
    columns = []
    for d in range(gradients.shape[2]):
        terms = [positions[:, corners[:, a]] * gradients[:, a, d, None] for a in range(corners.shape[1])]
        columns.append(sum(terms[1:], terms[0]))
    return columns


# ---- cloth


def has_membrane_stress(scene: Scene) -> bool:
    """Whether the formulas of `membrane_stress` have the whole energy in the plane of all cloth."""
    return all(body.strain_limit is None for body in scene.bodies if isinstance(body, Cloth))


def membrane_stress(scene: Scene, positions: Tensor, material: dict[str, Tensor]) -> dict[Cloth, MembraneStress]:
    """Implementation of `Simulator.membrane_stress` for checked positions [B, V, 3] and material by name."""
    if not has_membrane_stress(scene):
        raise ValueError(
            "membrane_stress: every cloth must have no strain_limit, whose stress is not provided, got one with it; "
            "sim.gradient(state) has the elastic forces of all"
        )
    found: dict[Cloth, MembraneStress] = {}
    for body in scene.bodies:
        if isinstance(body, Cloth):
            found[body] = _of_cloth(_rest(scene, positions), positions, scene.stencil_ranges(body), material)
    return found


def _of_cloth(
    rest: dict[str, _Rest], positions: Tensor, places: dict[str, slice], material: dict[str, Tensor]
) -> MembraneStress:
    own = places["triangle"]
    a, b = _columns(rest["triangle"], positions, own)
    normal = torch.linalg.cross(a, b)
    collapsed = ~(length(normal.detach()) > torch.finfo(a.dtype).eps * (dot(a, a) + dot(b, b)).detach())
    # so that no NaN reaches the derivatives of the others
    lost = collapsed[..., None]
    flat = torch.eye(3, dtype=a.dtype, device=a.device)
    x, y, up = (torch.where(lost, axis, column) for axis, column in zip(flat, (a, b, normal), strict=True))
    area = length(up)
    n = up / area[..., None]
    first, second = x + torch.linalg.cross(y, n), y - torch.linalg.cross(x, n)
    size = length(first)[..., None]
    r, s = first / size, second / size
    identity = torch.eye(2, dtype=a.dtype, device=a.device)
    along, across = x - r, y - s
    biot = _matrix(dot(r, along), dot(r, across), dot(s, along), dot(s, across))  # U - 1
    youngs, poisson, thickness = (
        material[name][..., own] for name in ("membrane_youngs", "membrane_poisson", "thickness")
    )
    shear = youngs * thickness / (1.0 + poisson)  # 2 mu
    volume = shear * poisson / (1.0 - poisson)  # lambda
    trace = biot[..., 0, 0] + biot[..., 1, 1]
    pressure = torch.minimum(volume * trace, shear.expand_as(trace))
    nominal = shear[..., None, None] * biot + pressure[..., None, None] * identity
    kirchhoff = product(nominal, biot + identity)
    if "thread" in places:
        kirchhoff = kirchhoff + _of_threads(rest["thread"], positions, places["thread"], material, (r, s), lost)
    cauchy = kirchhoff / area[..., None, None]
    cauchy = torch.where(lost[..., None], torch.nan, 0.5 * (cauchy + cauchy.mT))  # symmetric except for rounding
    strain = 0.5 * (_matrix(dot(a, a), dot(a, b), dot(a, b), dot(b, b)) - identity)
    return MembraneStress(cauchy, _principal(cauchy), strain, collapsed)


def _matrix(xx: Tensor, xy: Tensor, yx: Tensor, yy: Tensor) -> Tensor:
    return torch.stack([torch.stack([xx, xy], dim=-1), torch.stack([yx, yy], dim=-1)], dim=-2)


def _of_threads(
    rest: _Rest,
    positions: Tensor,
    rows: slice,
    material: dict[str, Tensor],
    frame: tuple[Tensor, Tensor],
    lost: Tensor,
) -> Tensor:
    """Sum over warp and weft of w (1 - 1 / |F f|) (U f) (U f)^T [B, F, 2, 2]; the threads of a cloth lie in order."""
    count = frame[0].shape[1]
    total = torch.zeros((), dtype=positions.dtype, device=positions.device)
    for start in range(rows.start, rows.stop, count):
        place = slice(start, start + count)
        (along,) = _columns(rest, positions, place)
        along = torch.where(lost, torch.ones_like(along), along)
        long = length(along)
        inside = torch.stack([dot(axis, along) for axis in frame], dim=-1)
        pull = material["thread_stiffness"][..., place] * (1.0 - 1.0 / torch.where(long > 0.0, long, 1.0))
        total = total + pull[..., None, None] * inside[..., :, None] * inside[..., None, :]
    return total


def _principal(matrix: Tensor) -> Tensor:
    """Eigenvalues of symmetric matrices [..., 2, 2], the larger one first."""
    xx, yy, xy = matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 0, 1]
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = root(half * half + xy * xy)
    return torch.stack([mean + radius, mean - radius], dim=-1)


# ---- rods, springs and fibres


def tensions(scene: Scene, positions: Tensor, material: dict[str, Tensor]) -> dict[Rod | Springs | Fibres, Tension]:
    """Implementation of `Simulator.tensions` for checked positions [B, V, 3] and material by name."""
    found: dict[Rod | Springs | Fibres, Tension] = {}
    for part in scene.parts:
        if isinstance(part, Rod | Springs | Fibres):
            kind = "fibre" if isinstance(part, Fibres) else "spring"
            found[part] = _tension(
                kind, _rest(scene, positions)[kind], positions, scene.stencil_ranges(part)[kind], material
            )
    return found


def _tension(kind: str, rest: _Rest, positions: Tensor, rows: slice, material: dict[str, Tensor]) -> Tension:
    names = ("fibre_stiffness", "fibre_length") if kind == "fibre" else ("spring_stiffness", "rest_length")
    stiffness, relaxed = (material[name][..., rows] for name in names)
    (along,) = _columns(rest, positions, rows)
    long = length(along)
    tension = stiffness * (long - relaxed)
    if kind == "spring":
        return Tension(tension, long / relaxed - 1.0)
    slack = (rest.constants[rows, 0] > 0.0) & (long < relaxed)
    return Tension(torch.where(slack, 0.0, tension), long - 1.0)


# ---- ties


def forces_of_ties(scene: Scene, positions: Tensor, material: dict[str, Tensor]) -> dict[Tie, Tensor]:
    """Forces of ties on their vertices [B, N, 3] N, towards the points that hold them."""
    found: dict[Tie, Tensor] = {}
    for part in scene.parts:
        if isinstance(part, Tie):
            rows = scene.stencil_ranges(part)["tie"]
            (apart,) = _columns(_rest(scene, positions)["tie"], positions, rows)
            found[part] = -material["tie_stiffness"][..., rows, None] * apart
    return found


def forces_on_tied(scene: Scene, positions: Tensor, material: dict[str, Tensor]) -> Tensor | None:
    """Forces of all ties on the vertices of both bodies [B, V, 3] N; None without ties. Adds them up on the CPU."""
    rest = _rest(scene, positions).get("tie")
    if rest is None:
        return None
    (apart,) = _columns(rest, positions, slice(None))
    pull = -material["tie_stiffness"].to(positions.device)[..., None] * apart
    total = torch.zeros_like(positions)
    for corner in range(rest.corners.shape[1]):
        total = total.index_add(1, rest.corners[:, corner], rest.gradients[:, corner, :] * pull)
    return total
