"""Quadrics: ellipsoidal perturbations, each with a height, that free-form patches add to their base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..common.small_matrices import product

__all__ = ["Quadrics", "check_real_tensor", "dimensions", "matrix_sets"]

_LOWER = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))  # entries of M in the order of `factors`


def check_real_tensor(name: str, value: Any, shape: tuple[int | None, ...], meaning: str) -> None:
    """Check for a float32 or float64 tensor of this shape; None stands for any length."""
    if not isinstance(value, Tensor) or value.dtype not in (torch.float32, torch.float64):
        came = str(value.dtype) if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{name} must be a float32 or float64 tensor ({meaning}), got {came}")
    matches = value.dim() == len(shape) and all(
        want is None or have == want for have, want in zip(value.shape, shape, strict=True)
    )
    if not matches:
        want = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must be [{want}] ({meaning}), got {list(value.shape)}")


def dimensions(value: Any) -> int:
    """Number of dimensions of a tensor; -1 for anything else, for a later check."""
    return value.dim() if isinstance(value, Tensor) else -1


def matrix_sets(matrices: Tensor) -> Tensor:
    """W [B or 1, Q, 4, 4] from matrices with or without a batch."""
    if dimensions(matrices) not in (3, 4):
        came = list(matrices.shape) if dimensions(matrices) >= 0 else type(matrices).__name__
        raise TypeError(f"matrices must be a tensor W [Q, 4, 4], or [B, Q, 4, 4] in B poses, got {came}")
    return matrices if matrices.dim() == 4 else matrices[None]


@dataclass(frozen=True, eq=False, repr=False)
class Quadrics:
    """Perturbations R_i(x) = a_i [1 - |M_i (x - c_i)|^2]_+^3: a_i at the centre, 0 outside of an ellipsoid, C2.

    M is lower triangular with a positive diagonal. Any values of these ten numbers give an ellipsoid, so all ten can be
    optimised. A negative amplitude makes a dent.

    Args:
        amplitudes: a [Q], height of the surface at the centre of a quadric [m].
        centres: c [Q, 3] at rest [m].
        factors: ln M00, ln M11, ln M22, M10, M20, M21 [Q, 6], M in 1/m.
    """

    amplitudes: Tensor
    centres: Tensor
    factors: Tensor

    def __post_init__(self) -> None:
        check_real_tensor("Quadrics.amplitudes", self.amplitudes, (None,), "height of each quadric [m]")
        count = len(self.amplitudes)
        check_real_tensor("Quadrics.centres", self.centres, (count, 3), "centres [m]")
        check_real_tensor("Quadrics.factors", self.factors, (count, 6), "ln M00, ln M11, ln M22, M10, M20, M21")
        for name in ("centres", "factors"):
            value = getattr(self, name)
            if value.dtype != self.amplitudes.dtype or value.device != self.amplitudes.device:
                raise ValueError(
                    f"Quadrics.{name} must be {self.amplitudes.dtype} on {self.amplitudes.device} like amplitudes, "
                    f"got {value.dtype} on {value.device}"
                )

    @classmethod
    def none(cls, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Quadrics:
        """No quadrics: the surface is its base."""
        empty = torch.empty(0, 6, dtype=dtype, device=device)
        return cls(empty[:, 0].clone(), empty[:, :3].clone(), empty)

    @classmethod
    def from_radii(cls, amplitudes: Tensor, centres: Tensor, radii: Tensor) -> Quadrics:
        """Spheres of radii [Q], or axis-aligned ellipsoids with radii [Q, 3] [m]."""
        check_real_tensor("Quadrics.from_radii: centres", centres, (None, 3), "centres [m]")
        shape = (len(centres), 3) if dimensions(radii) == 2 else (len(centres),)
        check_real_tensor("Quadrics.from_radii: radii", radii, shape, "radii [m]")
        if not bool((radii > 0).all()):
            raise ValueError(f"Quadrics.from_radii: radii must be positive [m], got {float(radii.min())}")
        rates = -torch.log(radii if radii.dim() == 2 else radii[:, None].expand(-1, 3))
        return cls(amplitudes, centres, torch.cat([rates, torch.zeros_like(rates)], dim=1))

    @classmethod
    def from_matrices(cls, matrices: Tensor, signs: Tensor | None = None) -> Quadrics:
        """Convert general quadrics Q(x) = (x, 1)^T W (x, 1), each perturbing by sign [Q]_+^3.

        Ellipsoids only: W = s [[-A, A c], [c^T A, 1 - c^T A c]] with A positive definite and s = |a|^(1/3) > 0.

        Args:
            matrices: W [Q, 4, 4], symmetric.
            signs: +1 or -1 of each [Q]; default +1.

        Raises:
            ValueError: a matrix is not finite or not symmetric, or {Q > 0} is a cone, a cylinder, a hyperboloid or
                empty. `FreeFormPatches.field` takes those.
        """
        check_real_tensor("Quadrics.from_matrices: matrices", matrices, (None, 4, 4), "symmetric W")
        count = len(matrices)
        signs = torch.ones_like(matrices[:, 0, 0]) if signs is None else signs.to(matrices)
        check_real_tensor("Quadrics.from_matrices: signs", signs, (count,), "+1 or -1")
        _refuse_rows("matrices must be finite", ~matrices.isfinite().all(-1).all(-1))
        size = matrices.abs().amax((-1, -2), keepdim=True)
        skew = ((matrices - matrices.mT).abs() > 8 * torch.finfo(matrices.dtype).eps * size).any(-1).any(-1)
        _refuse_rows("matrices must be symmetric", skew)
        _refuse_rows("signs must be +1 or -1", signs.abs() != 1)
        scaled = -matrices[:, :3, :3]
        # M^T M = A with M lower triangular: reverse rows and columns of A, factor by Cholesky, and reverse again
        reverse, failed = torch.linalg.cholesky_ex(scaled.flip(-1, -2))
        lower = reverse.flip(-1, -2).mT
        half = torch.linalg.solve_triangular(lower.mT, matrices[:, :3, 3:], upper=True)
        centres = torch.linalg.solve_triangular(lower, half, upper=False)[..., 0]
        scale = matrices[:, 3, 3] + half[..., 0].square().sum(-1)
        _refuse_rows(
            "matrices must be ellipsoids, with -W[:3, :3] positive definite and Q > 0 somewhere",
            (failed != 0) | ~(scale > 0),
        )
        m = lower / scale.sqrt()[:, None, None]
        diagonal = m.diagonal(dim1=-2, dim2=-1).log()
        factors = torch.cat([diagonal, torch.stack([m[:, r, c] for r, c in _LOWER[3:]], dim=1)], dim=1)
        return cls(signs * scale**3, centres, factors)

    def matrices(self) -> tuple[Tensor, Tensor]:
        """General form: symmetric W [Q, 4, 4] and signs [Q], with R(x) = sign [(x, 1)^T W (x, 1)]_+^3.

        The inverse of `from_matrices`, except for quadrics of amplitude 0, whose W is 0 without a gradient.
        """
        # the cube root has an infinite slope at 0
        there = self.amplitudes != 0
        scale = torch.where(there, torch.where(there, self.amplitudes, 1.0).abs().pow(1.0 / 3.0), 0.0)
        return scale[:, None, None] * self.normalized_matrices(), torch.where(self.amplitudes < 0, -1.0, 1.0).to(scale)

    def normalized_matrices(self) -> Tensor:
        """W [Q, 4, 4], scaled to the value 1 at the centre: R(x) = a [(x, 1)^T W (x, 1)]_+^3."""
        m = self.triangular()
        A = product(m.mT, m)
        Ac = product(A, self.centres[:, :, None])
        corner = 1.0 - product(self.centres[:, None, :], Ac)
        return torch.cat([torch.cat([-A, Ac], dim=2), torch.cat([Ac.mT, corner], dim=2)], dim=1)

    def entries(self) -> Tensor:
        """M00, M11, M22, M10, M20, M21 [Q, 6] in 1/m, the input of the ops."""
        return torch.cat([self.factors[:, :3].exp(), self.factors[:, 3:]], dim=1)

    def triangular(self) -> Tensor:
        """M [Q, 3, 3] in 1/m, lower triangular."""
        entries = dict(zip(_LOWER, self.entries().unbind(1), strict=True))
        zero = torch.zeros_like(self.amplitudes)
        rows = [torch.stack([entries.get((r, c), zero) for c in range(3)], dim=1) for r in range(3)]
        return torch.stack(rows, dim=1)

    def values(self, points: Tensor) -> Tensor:
        """R_i [..., Q] of each quadric at points [..., 3] m, in plain torch."""
        _check_points(points, self.centres.dtype)
        y = product(self.triangular(), (points[..., None, :] - self.centres)[..., None])
        return self.amplitudes * (1.0 - y[..., 0].square().sum(-1)).clamp_min(0.0) ** 3

    def to(self, *args: Any, **kwargs: Any) -> Quadrics:
        """The same on another device or in another precision, as `Tensor.to`."""
        return Quadrics(*(t.to(*args, **kwargs) for t in (self.amplitudes, self.centres, self.factors)))

    def __len__(self) -> int:
        return len(self.amplitudes)

    def __repr__(self) -> str:
        return f"Quadrics({len(self)}, {str(self.amplitudes.dtype).removeprefix('torch.')}, {self.amplitudes.device})"


def _check_points(points: Any, dtype: torch.dtype) -> None:
    if not isinstance(points, Tensor) or points.dtype != dtype or points.shape[-1:] != (3,):
        came = f"{points.dtype} {list(points.shape)}" if isinstance(points, Tensor) else type(points).__name__
        raise TypeError(f"Quadrics.values: points must be {dtype} [..., 3] (m), got {came}")


def _refuse_rows(contract: str, bad: Tensor) -> None:
    rows = bad.nonzero()[:, 0].tolist()
    if rows:
        raise ValueError(f"Quadrics.from_matrices: {contract}, got otherwise at {rows[0]} ({len(rows)} in all)")
