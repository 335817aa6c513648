"""Elasticity of small strains, in float64."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array

import torchpd as pd
from torchpd.geometry.mesh_quality import shape_gradients


def elastic_matrix(solid: pd.Solid) -> csr_array:
    """Hessian [3V, 3V] of a body's elastic energy at rest [N/m].

    w V / 2 |F - R|^2 is w V / 2 |sym grad u|^2 to second order: K_aibj = w V / 2 (delta_ij g_a . g_b + g_aj g_bi).
    """
    mesh, stiffness = solid.mesh, pd.Scene(solid).values().stiffness
    gradients, volumes = shape_gradients(mesh.vertices, mesh.tets)
    blocks = np.einsum("eak,ebk,ij->eaibj", gradients, gradients, np.eye(3))
    blocks += np.einsum("eaj,ebi->eaibj", gradients, gradients)
    blocks *= (0.5 * stiffness * volumes)[:, None, None, None, None]
    place = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows, columns = np.repeat(place, 12, axis=1).reshape(-1), np.tile(place, (1, 12)).reshape(-1)
    count = 3 * len(mesh.vertices)
    return coo_array((blocks.reshape(-1), (rows, columns)), shape=(count, count)).tocsr()
