"""Linear elasticity with quadratic tetrahedra: the converged value beside which linear tetrahedra lock.

Straight edges, ten nodes, four quadrature points (Hughes, The Finite Element Method, section 3.I), float64.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

import torchpd as tpd

from .equilibrium import Array

__all__ = ["sag"]

_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
_INNER, _OUTER = (5.0 + 3.0 * 5.0**0.5) / 20.0, (5.0 - 5.0**0.5) / 20.0
_POINTS = np.full((4, 4), _OUTER) + (_INNER - _OUTER) * np.eye(4)  # barycentric coordinates [4, 4]


def sag(mesh: tpd.TetMesh, youngs: float, poisson: float, load: float) -> float:
    """Sag of the face of largest x under a load [N/m^3] along -y, with the face of least x held."""
    ends = np.sort(mesh.tets[:, _EDGES], axis=2).reshape(-1, 2)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    nodes = np.concatenate([mesh.tets, len(mesh.vertices) + number.reshape(-1, 6)], axis=1)
    places = np.concatenate([mesh.vertices, mesh.vertices[edges].mean(axis=1)])
    corners = mesh.vertices[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    barycentric = np.concatenate([-inverse.sum(axis=2)[:, None], np.swapaxes(inverse, 1, 2)], axis=1)  # [E, 4, 3]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    mu, lame = youngs / (2.0 * (1.0 + poisson)), youngs * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    stiffness = np.zeros((len(nodes), 10, 3, 10, 3))
    for point in _POINTS:
        at_corners = (4.0 * point - 1.0)[:, None] * barycentric
        first, second = _EDGES.T
        at_edges = 4.0 * (point[first, None] * barycentric[:, second] + point[second, None] * barycentric[:, first])
        g = np.concatenate([at_corners, at_edges], axis=1)
        own = lame * np.einsum("eai,ebj->eaibj", g, g) + mu * np.einsum("eaj,ebi->eaibj", g, g)
        own += mu * np.einsum("eak,ebk,ij->eaibj", g, g, np.eye(3))
        stiffness += volumes[:, None, None, None, None] / 4.0 * own
    place = (3 * nodes[:, :, None] + np.arange(3)).reshape(-1, 30)
    rows, columns = np.repeat(place, 30, axis=1).reshape(-1), np.tile(place, (1, 30)).reshape(-1)
    matrix = coo_array((stiffness.reshape(-1), (rows, columns))).tocsr()
    share = np.array([-0.05] * 4 + [0.2] * 6)  # integrals of the shape functions over the volume
    weight = np.bincount(nodes.reshape(-1), weights=(volumes[:, None] * share * load).reshape(-1))
    force, free = np.zeros(places.size), np.repeat(places[:, 0] > places[:, 0].min() + 1e-9, 3)
    force[1::3] = -weight
    moved = np.zeros(places.size)
    moved[free] = splu(matrix[free][:, free].tocsc()).solve(force[free])
    return -_face_mean(moved[1::3], places)


def _face_mean(values: Array, places: Array) -> float:
    return float(values[places[:, 0] > places[:, 0].max() - 1e-9].mean())
