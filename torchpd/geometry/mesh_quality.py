"""Quality of a tetrahedral mesh: volumes, dihedral angles and the element bound l_e of the solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .mesh_faces import count_components

__all__ = ["MeshQuality", "element_bounds", "measure_quality", "shape_gradients", "smallest_dihedral"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class MeshQuality:
    """Shape measures, one value per tet; `print` gives a summary."""

    volumes: Array  # volume [E] m^3
    min_dihedral: Array  # smallest dihedral angle [E] rad, 70.5 degrees in the regular tet
    max_dihedral: Array  # largest dihedral angle [E] rad
    element_bounds: Array  # l_e [E], from 4/3 (regular) to 4 (sliver): the factor of a stable diagonal
    fill: Array | None  # material fraction of each tet [E], see `TetMesh`
    pieces: int  # components connected by faces, edges or vertices

    def __repr__(self) -> str:
        rows = (
            ("volume [m^3]", self.volumes, ".3e"),
            ("smallest dihedral angle [deg]", np.degrees(self.min_dihedral), ".2f"),
            ("largest dihedral angle [deg]", np.degrees(self.max_dihedral), ".2f"),
            ("element bound l_e (4/3 .. 4)", self.element_bounds, ".4f"),
        )
        pieces = "1 piece" if self.pieces == 1 else f"{self.pieces} separate pieces"
        filled = "" if self.fill is None else f", of which {float((self.fill * self.volumes).sum()):.6g} m^3 are filled"
        lines = [
            f"{len(self.volumes)} tets in {pieces}, volume {self.volumes.sum():.6g} m^3{filled}",
            f"{'':30}{'min':>12}{'median':>12}{'max':>12}",
        ]
        for name, values, form in rows:
            low, middle, high = (format(v, form) for v in (values.min(), np.median(values), values.max()))
            lines.append(f"{name:30}{low:>12}{middle:>12}{high:>12}")
        return "\n".join(lines)


def shape_gradients(vertices: Array, tets: Index) -> tuple[Array, Array]:
    """Gradients of the linear shape functions N_a [E, 4, 3] in 1/m, and volumes [E] in m^3.

    grad N_1 = (e2 x e3) / det and cyclic with e_k = x_k - x_0; grad N_0 is minus their sum.
    """
    origin = vertices[tets[:, 0]]
    e1, e2, e3 = (vertices[tets[:, k]] - origin for k in (1, 2, 3))
    gradients = np.empty((len(tets), 4, 3))
    gradients[:, 1] = np.cross(e2, e3)
    gradients[:, 2] = np.cross(e3, e1)
    gradients[:, 3] = np.cross(e1, e2)
    determinants = np.einsum("ij,ij->i", e1, gradients[:, 1])
    gradients[:, 1:] /= determinants[:, None, None]
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    return gradients, determinants / 6.0


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))


def _unit(gradients: Array) -> Array:
    return np.asarray(gradients / _lengths(gradients)[..., None])


def element_bounds(normals: Array) -> Array:
    """Element bound l_e from unit normals n_a = grad N_a / |grad N_a| [E, 4, 3].

    l_e is the largest eigenvalue of diag(K)^-1/2 K diag(K)^-1/2, K = grad N grad N^T. That matrix is n n^T (4x4), which
    has the nonzero eigenvalues of n^T n (3x3). They are three and add up to 4: l_e lies in [4/3, 4].
    """
    return np.asarray(np.linalg.eigvalsh(np.einsum("eai,eaj->eij", normals, normals))[:, 2])


def _dihedral_angles(normals: Array) -> Array:
    """Six dihedral angles [E, 6]: pi minus the angle between normals, by Kahan's formula, exact near 0 and pi."""
    angles = np.empty((len(normals), 6))
    for column, (a, b) in enumerate(((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))):
        apart = _lengths(normals[:, a] - normals[:, b])
        together = _lengths(normals[:, a] + normals[:, b])
        angles[:, column] = 2.0 * np.arctan2(together, apart)
    return angles


def smallest_dihedral(vertices: Array, tets: Index) -> float:
    """Smallest dihedral angle of a valid mesh [rad]."""
    gradients, _ = shape_gradients(vertices, tets)
    return float(_dihedral_angles(_unit(gradients)).min())


def measure_quality(vertices: Array, tets: Index, fill: Array | None = None) -> MeshQuality:
    """Measure every tet of a valid mesh."""
    gradients, volumes = shape_gradients(vertices, tets)
    normals = _unit(gradients)
    angles = _dihedral_angles(normals)
    return MeshQuality(
        volumes=volumes,
        min_dihedral=angles.min(axis=1),
        max_dihedral=angles.max(axis=1),
        element_bounds=element_bounds(normals),
        fill=fill,
        pieces=count_components(tets),
    )
