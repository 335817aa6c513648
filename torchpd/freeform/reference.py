"""Free-form patches in float64 with plain NumPy, directly from the formulas: the slow reference of the ops."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

if TYPE_CHECKING:
    from .surface import PatchSurface

__all__ = ["PatchReference", "clamped_gradient", "literal_field", "vertex_frames"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def _numbers(tensor: Any) -> Array:
    return np.asarray(tensor.detach().cpu().double().numpy())


class PatchReference:
    """The surface of some patches; every quadric counts, whether it touches a patch or not.

    S = sum_k b_k (v_k + A_k ((X - V_k) / 2 + H_k N_k)), H_k = h + 3/4 w_k for a base of Phong tessellation, else h,
    with X = sum_k b_k V_k and w_k = sum_j b_j (V_k - V_j) . N_k.
    """

    def __init__(self, patches: PatchSurface) -> None:
        self.vertices = _numbers(patches.vertices)
        self.directors = _numbers(patches.directors)
        self.triangles = patches.triangles.cpu().numpy().astype(np.int64)
        self.amplitudes = _numbers(patches.quadrics.amplitudes)
        self.centres = _numbers(patches.quadrics.centres)
        self.matrices = _numbers(patches.quadrics.triangular())
        self.on_surface = patches.measured_at == "surface"
        self.weight = 0.75 if patches.base == "phong" else 0.0
        self._heights: dict[tuple[int, bytes], float] = {}  # equal in every pose

    def bumps(self, x: Array) -> Array:
        """sum_i R_i at x [..., 3]."""
        y = np.einsum("qij,...qj->...qi", self.matrices, x[..., None, :] - self.centres)
        q = np.maximum(1.0 - (y**2).sum(-1), 0.0)
        return np.asarray((self.amplitudes * q**3).sum(-1))

    def _lifts(self, patch: int, b: Array) -> Array:
        v, n = self.vertices[self.triangles[patch]], self.directors[self.triangles[patch]]
        return self.weight * np.array([sum(b[j] * (v[k] - v[j]) @ n[k] for j in range(3)) for k in range(3)])

    def height(self, patch: int, b: Array) -> float:
        """h [m], the outermost root if it is measured on the surface."""
        place = patch, b.tobytes()
        if place not in self._heights:
            self._heights[place] = self._height(patch, b)
        return self._heights[place]

    def _height(self, patch: int, b: Array) -> float:
        corners = self.triangles[patch]
        base = b @ self.vertices[corners] + (b * self._lifts(patch, b)) @ self.directors[corners]
        if not self.on_surface:
            return float(self.bumps(base))
        director = b @ self.directors[corners]

        def excess(h: Array) -> Array:
            return h - self.bumps(base + h[..., None] * director)

        low, high = np.minimum(self.amplitudes, 0.0).sum(), np.maximum(self.amplitudes, 0.0).sum()
        steps = np.linspace(high, low, 400)
        first = int(np.flatnonzero(excess(steps) <= 0.0)[0])
        if first == 0:
            return float(steps[0])
        nearest = brentq(lambda h: float(excess(np.array(h))), steps[first], steps[first - 1], xtol=1e-15, rtol=1e-15)
        return float(nearest)

    def point(self, patch: int, b: Array, positions: Array | None = None, frames: Array | None = None) -> Array:
        """S [3], at rest or with positions [V, 3] and frames [V, 3, 3]."""
        v = self.vertices if positions is None else positions
        A = np.broadcast_to(np.eye(3), (len(v), 3, 3)) if frames is None else frames
        lifts, h = self._lifts(patch, b), self.height(patch, b)
        X = b @ self.vertices[self.triangles[patch]]
        out = np.zeros(3)
        for k, corner in enumerate(self.triangles[patch]):
            arm = 0.5 * (X - self.vertices[corner]) + (h + lifts[k]) * self.directors[corner]
            out += b[k] * (v[corner] + A[corner] @ arm)
        return out


def literal_field(
    x: Array, corners: Array, amplitudes: Array, matrices: Array, *, thickness: float, clip: bool
) -> float:
    """F' of one patch at one point x [3], over a triangle [3, 3] and quadrics [Q], [Q, 4, 4]."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    planes = []
    for k in range(3):
        first, second = corners[(k + 1) % 3], corners[(k + 2) % 3]
        inward = np.cross(normal, second - first)
        planes.append(inward @ (x - first) / np.linalg.norm(inward))
    h = normal @ (x - corners[0])
    planes += [thickness + h, thickness - h]
    one = np.append(x, 1.0)
    r = sum(a * max(one @ W @ one, 0.0) ** 3 for a, W in zip(amplitudes, matrices, strict=True))
    if clip:
        planes[4] += r
        r = 0.0
    return float(min(planes) + r)


def clamped_gradient(G: Array, lower: float, upper: float) -> Array:
    """G [3, 3] with singular values clamped between two bounds and a positive determinant."""
    U, s, Vt = np.linalg.svd(G)
    return np.asarray(U * np.clip(s, lower, upper) * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))] @ Vt)


def vertex_frames(gradients: Array, triangles: Index, vertices: Array) -> Array:
    """The mean of gradients [P, 3, 3] around each vertex, weighted by the triangle areas at rest."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total, weight = np.zeros((len(vertices), 3, 3)), np.zeros(len(vertices))
    for k in range(3):
        np.add.at(total, triangles[:, k], areas[:, None, None] * gradients)
        np.add.at(weight, triangles[:, k], areas)
    return np.asarray(total / weight[:, None, None])
