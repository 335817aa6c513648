"""Stress and strain of every tetrahedron.

The energy of a tetrahedron is w V / 2 |F - R|^2 without a Poisson's ratio (see `Solid`). w is Young's modulus, F the
deformation gradient and R the nearest rotation. With one it is V (mu |F - R|^2 + lambda t^2 / 2), where t is the mean
of R : (F - R) over the tetrahedron's group. So the first Piola-Kirchhoff stress P = dE/dF / V is w (F - R) or
2 mu (F - R) + p R, with p = lambda t, at most 2 mu. Cauchy's is

    sigma = P F^T / det F.

A plastic tetrahedron has the stress of the elastic part F Fp^-1 of F, and the strain of F.

All are constant in a tetrahedron. In a partly full tetrahedron (`mesh.fill`) the stress is that of its average
material.
"""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.reprs import by_sizes
from ..common.small_matrices import dot, inverse, product, root
from ..ops.registration import nearest_rotation
from ..scene.effects import Solid
from ..scene.scene import Scene

__all__ = ["STRESS_ROWS", "Stress", "has_stress", "plastic_strain", "stress", "vertex_average"]

# arrays of the material that `stress` takes, those that a scene has
STRESS_ROWS = ("stiffness", "poisson", "plastic_youngs", "plastic_poisson", "flow")


class Stress(NamedTuple):
    """Stress and strain of every tetrahedron, see `Simulator.stress`. Stresses are NaN where `inverted`."""

    cauchy: Tensor  # [B, E, 3, 3] Pa, symmetric
    von_mises: Tensor  # [B, E] Pa, sqrt(3 / 2 s : s), s the deviator of `cauchy`
    strain: Tensor  # [B, E, 3, 3], Green's, (F^T F - 1) / 2
    inverted: Tensor  # [B, E] bool, true unless det F > 0

    def __repr__(self) -> str:
        return by_sizes(self, self.cauchy, "batch", "tets", trailing=2)


class _Groups(NamedTuple):
    """Groups of tetrahedra that share the mean of t."""

    of: Tensor  # [E] group of each tetrahedron
    order: Tensor  # [E] tetrahedra, group after group
    counts: Tensor  # [G] number of them
    volumes: Tensor  # [E] m^3 at rest

    def sums(self, values: Tensor, how: str = "sum") -> Tensor:
        """Sum, or minimum, of values [E] or [B, E] over the members of each group, in order."""
        rows = values[..., self.order].movedim(-1, 0)
        flat = rows.flatten(1) if rows.dim() > 1 else rows[:, None]
        found = torch.segment_reduce(flat, how, lengths=self.counts, axis=0, unsafe=True)
        return found.unflatten(1, rows.shape[1:]).movedim(0, -1) if rows.dim() > 1 else found[:, 0]


class _Rest(NamedTuple):
    """Arrays of the rest shape for read-outs."""

    tets: Tensor  # [E, 4]
    inverse_edges: Tensor  # [E, 3, 3] 1/m
    order: Tensor  # [4 E] tetrahedra of each vertex, vertex after vertex
    counts: Tensor  # [V] number of them
    shares: Tensor  # [4 E] share of each in the volume around its vertex
    groups: _Groups | None  # of a scene with Poisson's ratios


# kept, because scenes do not change and a copy to a GPU would wait for it
_REST: WeakKeyDictionary[Scene, dict[tuple[torch.device, torch.dtype], _Rest]] = WeakKeyDictionary()


def _rest(scene: Scene, device: torch.device, dtype: torch.dtype) -> _Rest:
    kept = _REST.setdefault(scene, {})
    if (device, dtype) not in kept:
        tets, positions = scene.tets, scene.rest_positions
        corners = positions[tets]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        order = np.argsort(tets.reshape(-1), kind="stable")
        vertex, tet = tets.reshape(-1)[order], order // 4
        volumes = np.linalg.det(edges)[tet]
        shares = volumes / np.bincount(vertex, weights=volumes, minlength=len(positions))[vertex]
        counts = np.bincount(vertex, minlength=len(positions))
        whole = (torch.from_numpy(array).to(device) for array in (tets, tet, counts))
        real = (torch.from_numpy(array).to(device, dtype) for array in (np.linalg.inv(edges), shares))
        (corner, tet_of, count), (inverse_edges, share) = whole, real
        groups = _groups(_averaging_groups(scene), np.linalg.det(edges) / 6.0, device, dtype)
        kept[device, dtype] = _Rest(corner, inverse_edges, tet_of, count, share, groups)
    return kept[device, dtype]


def _averaging_groups(scene: Scene) -> NDArray[np.int64] | None:
    """Group of each tetrahedron [E], of a plastic one alone; None without Poisson's ratios."""
    if all(isinstance(solid.poisson, float) and solid.plastic is None for solid in scene.solids):
        return None
    groups, count = [], 0
    for solid in scene.solids:
        own = solid.averaging_groups if solid.plastic is None else np.arange(len(solid.mesh.tets))
        groups.append(own + count)
        count = int(groups[-1].max()) + 1
    return np.concatenate(groups)


def _groups(
    numbers: NDArray[np.int64] | None, volumes: NDArray[np.float64], device: torch.device, dtype: torch.dtype
) -> _Groups | None:
    if numbers is None:
        return None
    whole = (numbers, np.argsort(numbers, kind="stable"), np.bincount(numbers))
    of, order, counts = (torch.from_numpy(array).to(device) for array in whole)
    return _Groups(of, order, counts, torch.from_numpy(volumes).to(device, dtype))


def _pressure(groups: _Groups, F: Tensor, R: Tensor, double_shear: Tensor, bulk: Tensor) -> Tensor:
    """p [B, E] Pa: lambda times the mean of t over the group, weighted by V lambda, at most 2 mu of every member."""
    trace = (R * (F - R)).flatten(2).unbind(-1)
    weights = groups.volumes * bulk
    total = groups.sums(weights)
    mean = groups.sums(weights * sum(trace[1:], trace[0])) / torch.where(total != 0.0, total, 1.0)
    cap = torch.where(bulk > 0.0, double_shear / torch.where(bulk > 0.0, bulk, 1.0), torch.inf)
    return bulk * torch.minimum(mean, groups.sums(cap, "min"))[..., groups.of]


def has_stress(scene: Scene) -> bool:
    """Whether the formulas of `stress` have the whole energy of all solids."""
    return all(solid.law == "corotated" and solid.strain_limit is None for solid in scene.solids)


def _with_plastic(scene: Scene, elastic: Tensor, plastic: Tensor, dims: int) -> Tensor:
    """Rows [B, E, ...] of all tetrahedra, solid by solid, from those of elastic and of plastic solids.

    `dims`: dimensions without a batch.
    """
    batched = [rows if rows.dim() > dims else rows[None] for rows in (elastic, plastic)]
    batch = max(map(len, batched))
    of, starts, parts = [rows.expand(batch, *rows.shape[1:]) for rows in batched], [0, 0], []
    for solid in scene.solids:
        which, count = int(solid.plastic is not None), len(solid.mesh.tets)
        parts.append(of[which][:, starts[which] : starts[which] + count])
        starts[which] += count
    return torch.cat(parts, dim=1)


def plastic_strain(scene: Scene, flow: Tensor) -> dict[Solid, Tensor]:
    """Implementation of `Simulator.plastic_strain` for checked flow [B, P, 10]."""
    found: dict[Solid, Tensor] = {}
    first = 0
    for solid in scene.solids:
        if solid.plastic is not None:
            count = len(solid.mesh.tets)
            found[solid] = flow[:, first : first + count, 9]
            first += count
    return found


def stress(scene: Scene, positions: Tensor, material: dict[str, Tensor]) -> Stress:
    """Implementation of `Simulator.stress` for checked positions [B, V, 3] and arrays of `STRESS_ROWS`."""
    if not has_stress(scene):
        raise ValueError(
            'stress: every solid must have law="corotated" and no strain_limit, whose stress is not provided, got '
            "another one; sim.gradient(state) has the elastic forces of all"
        )
    rest = _rest(scene, positions.device, positions.dtype)
    corners = positions[:, rest.tets]
    F = product((corners[:, :, 1:] - corners[:, :, :1]).mT, rest.inverse_edges)
    identity = torch.eye(3, dtype=F.dtype, device=F.device)
    strain = 0.5 * (product(F.mT, F) - identity)
    a, b, c = F.unbind(-1)
    determinant = dot(a, torch.linalg.cross(b, c))
    inverted = ~(determinant.detach() > 0.0)
    # so that no NaN reaches the derivatives of the others
    lost = inverted[..., None, None]
    stiffness, poisson = material["stiffness"], material.get("poisson")
    if "flow" in material:
        whole = identity.expand(len(stiffness.movedim(-1, 0)), 3, 3)
        plastic = material["flow"][..., :9].unflatten(-1, (3, 3))
        F = product(F, inverse(_with_plastic(scene, whole, plastic, 3)))
        poisson = torch.zeros_like(stiffness) if poisson is None else poisson
        stiffness = _with_plastic(scene, stiffness, material["plastic_youngs"], 1)
        poisson = _with_plastic(scene, poisson, material["plastic_poisson"], 1)
    actual, F = F, torch.where(lost, identity, F)
    R = nearest_rotation(F)
    volume = torch.where(inverted, 1.0, determinant)
    if poisson is None or rest.groups is None:
        cauchy = (stiffness / volume)[..., None, None] * product(F - R, F.mT)
    else:
        double_shear = stiffness / (1.0 + poisson)
        bulk = double_shear * poisson / (1.0 - 2.0 * poisson)  # Lame's lambda
        # a group has the mean of its members as they are; the derivative of R : (F - R) is R
        nearest = torch.where(lost, nearest_rotation(actual.detach()), R)
        pressure = _pressure(rest.groups, actual, nearest, double_shear, bulk)[..., None, None]
        piola = double_shear[..., None, None] * (F - R) + pressure * R
        cauchy = product(piola, F.mT) / volume[..., None, None]
    cauchy = 0.5 * (cauchy + cauchy.mT)  # symmetric except for rounding
    xx, yy, zz = cauchy.diagonal(dim1=-2, dim2=-1).unbind(-1)
    shear = torch.stack((cauchy[..., 0, 1], cauchy[..., 1, 2], cauchy[..., 2, 0]), dim=-1)
    squared = 0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2) + 3.0 * dot(shear, shear)
    return Stress(
        torch.where(lost, torch.nan, cauchy), torch.where(inverted, torch.nan, root(squared)), strain, inverted
    )


def vertex_average(scene: Scene, values: Tensor, like: Tensor) -> Tensor:
    """Implementation of `Simulator.vertex_average`, in the precision and on the device of `like`."""
    if not isinstance(values, Tensor):
        raise TypeError(f"vertex_average: values must be a tensor [B, E, ...], got {type(values).__name__}")
    if values.dtype != like.dtype or values.device != like.device:
        raise TypeError(
            f"vertex_average: values must be {like.dtype} on {like.device} like the simulator, got {values.dtype} on "
            f"{values.device}"
        )
    rest = _rest(scene, like.device, like.dtype)
    if values.dim() < 2 or values.shape[1] != len(rest.tets):
        raise ValueError(f"vertex_average: values must be [B, {len(rest.tets)}, ...], got {list(values.shape)}")
    rows = values.flatten(2) if values.dim() > 2 else values.unsqueeze(-1)
    # a segment is summed in order, so bits do not depend on the batch
    terms = (rows[:, rest.order] * rest.shares[:, None]).movedim(0, 1)
    total = torch.segment_reduce(terms.flatten(1), "sum", lengths=rest.counts, axis=0, unsafe=True)
    means: Tensor = total.unflatten(1, terms.shape[1:]).movedim(0, 1)
    return means.reshape(len(values), len(rest.counts), *values.shape[2:])
