"""The converged step of Newton's SolverStyle3D, in float64.

Its membrane (Baraff and Witkin 1998) has springs along two axes and between them. The force of the latter leaves out
the derivatives of the unit vectors, so there is no energy to minimise: Newton's method finds where the forces balance.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array, kron
from scipy.sparse.linalg import splu
from torch import Tensor

from .problem import Sheet

Array = NDArray[np.float64]

_ITERATIONS, _HALVINGS = 100, 20
_SOLVED = 1e-10  # |force| over that of u_0


def forces(corners: Tensor, gradients: Tensor, youngs: float) -> Tensor:
    """Forces per area [3, 3] N/m^2 on the corners [3, 3] m of a triangle, by the gradients [3, 2] of its corners."""
    along, across = (corners.mT @ gradients).unbind(1)
    u, v = along / along.norm(), across / across.norm()
    stretch = (along.norm() - 1.0) * torch.outer(gradients[:, 0], u) + (across.norm() - 1.0) * torch.outer(
        gradients[:, 1], v
    )
    shear = u.dot(v) * (torch.outer(gradients[:, 1], u) + torch.outer(gradients[:, 0], v))
    return -youngs * (stretch + 0.5 * shear)


def balance(problem: Sheet, first: Array) -> tuple[Array, float]:
    """The displacement [V, 3] m near `first` where the forces balance, and what is left of the force over that of u_0.

    Newton's method with the exact derivatives of the forces; a step is halved until the force falls.
    """
    values = problem.scene().values()
    membrane, hinge = values.stencils
    panel = torch.from_numpy(problem.mesh.vertices[:, [2, 0]])[torch.from_numpy(membrane.corners)]
    inverse = torch.linalg.inv((panel[:, 1:] - panel[:, :1]).mT)
    gradients = torch.cat([-inverse.sum(1, keepdim=True), inverse], dim=1)
    areas = torch.from_numpy(membrane.measure)
    weight = values.masses / problem.time_step**2
    bending = problem.bending * np.einsum("n,na,nb->nab", hinge.measure, *2 * [hinge.gradients[:, :, 0]])
    linear = kron(diags_array(weight) + _assemble(hinge.corners, bending), np.eye(3))
    target = problem.start + problem.first + problem.time_step**2 * np.array(problem.gravity)
    constant = (weight[:, None] * target).reshape(-1)
    dofs = 3 * membrane.corners[:, :, None] + np.arange(3)
    free = np.setdiff1d(np.arange(constant.size), 3 * problem.held[:, None] + np.arange(3))
    pull = torch.func.vmap(lambda x, g, area: area * forces(x, g, problem.youngs))
    slope = torch.func.vmap(torch.func.jacfwd(lambda x, g, area: area * forces(x, g, problem.youngs)))

    def force(x: Array) -> Array:
        out = constant - linear @ x
        np.add.at(out, dofs, pull(torch.from_numpy(x[dofs]), gradients, areas).numpy())
        return np.asarray(out[free])

    x = (problem.start + problem.first).reshape(-1)
    scale = float(np.linalg.norm(force(x)))
    x[free] = (problem.start + first).reshape(-1)[free]
    found = force(x)
    for _ in range(_ITERATIONS):
        if np.linalg.norm(found) <= _SOLVED * scale:
            break
        changed = slope(torch.from_numpy(x[dofs]), gradients, areas).numpy().reshape(-1, 9, 9)
        matrix = csc_array(linear - _assemble(dofs.reshape(-1, 9), changed))
        step, length = splu(matrix[free][:, free]).solve(found), 1.0
        for _ in range(_HALVINGS):
            there = x.copy()
            there[free] += length * step
            reached = force(there)
            if np.linalg.norm(reached) < np.linalg.norm(found):
                break
            length *= 0.5
        else:
            break
        x, found = there, reached
    return x.reshape(-1, 3) - problem.start, float(np.linalg.norm(found)) / scale


def _assemble(corners: NDArray[np.int64], blocks: Array) -> csc_array:
    """The sum of blocks [N, n, n] at rows and columns `corners` [N, n]."""
    rows, columns = np.broadcast_to(corners[:, :, None], blocks.shape), np.broadcast_to(corners[:, None], blocks.shape)
    return csc_array(coo_array((blocks.reshape(-1), (rows.reshape(-1), columns.reshape(-1)))))
