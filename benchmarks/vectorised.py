"""The same time step in plain vectorised torch, as an experienced user would write it without the compiled kernels.

Gather and scatter are two products with sparse CSR matrices (all environments at once), and every number of a
tetrahedron is a plane [tets, batch]. Rotations come from the same quartic as in the kernels: FOAM (Markley 1993), a
fixed count of Newton steps from above and the closed form. No fallback for degenerate elements, no contacts, no
residual.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from torchpd import Scene, State

Array = NDArray[np.float64]
Index = NDArray[np.int64]

NEWTON_STEPS = {torch.float32: 3, torch.float64: 4}  # as in the kernels, for moderate strain
RELAXATION = 1.9


def _csr(matrix: csr_matrix, dtype: torch.dtype) -> Tensor:
    indices = (torch.from_numpy(matrix.indptr.astype(np.int32)), torch.from_numpy(matrix.indices.astype(np.int32)))
    with warnings.catch_warnings():  # torch warns that CSR tensors are experimental
        warnings.simplefilter("ignore", UserWarning)
        return torch.sparse_csr_tensor(*indices, torch.from_numpy(matrix.data).to(dtype), size=matrix.shape)


def _nearest_rotations(f: list[list[Tensor]], newton_steps: int) -> list[list[Tensor]]:
    """Nearest rotations of many matrices, given by their entries f[row][column]."""
    cofactor = [
        [
            f[(i + 1) % 3][(j + 1) % 3] * f[(i + 2) % 3][(j + 2) % 3]
            - f[(i + 1) % 3][(j + 2) % 3] * f[(i + 2) % 3][(j + 1) % 3]
            for j in range(3)
        ]
        for i in range(3)
    ]
    gram = [[f[i][0] * f[j][0] + f[i][1] * f[j][1] + f[i][2] * f[j][2] for j in range(i + 1)] for i in range(3)]
    norm2 = gram[0][0] + gram[1][1] + gram[2][2]
    cofactor2 = sum(entry * entry for row in cofactor for entry in row)
    det = f[0][0] * cofactor[0][0] + f[0][1] * cofactor[0][1] + f[0][2] * cofactor[0][2]
    root = (3.0 * norm2).sqrt()
    for _ in range(newton_steps):
        u = root * root - norm2
        root = root - (u * u - 8.0 * det * root - 4.0 * cofactor2) / (4.0 * root * u - 8.0 * det)
    k = 0.5 * (root * root - norm2)
    scale = 1.0 / (k * root - det)
    diagonal, twist = (k + norm2) * scale, root * scale
    rotations = []
    for i in range(3):
        row = [twist * cofactor[i][j] + diagonal * f[i][j] for j in range(3)]
        for other in range(3):
            weight = scale * gram[max(i, other)][min(i, other)]
            row = [entry - weight * f[other][j] for j, entry in enumerate(row)]
        rotations.append(row)
    return rotations


class VectorisedStep:
    """One guarded Chebyshev step of a scene of solids, hard pins and gravity.

    Args:
        scene: the scene; anything but solids, hard pins and gravity is refused.
        time_step: h [s].
        iterations: per step.
        dtype: precision.
    """

    def __init__(self, scene: Scene, time_step: float, iterations: int, dtype: torch.dtype) -> None:
        values = scene.values()
        if len(values.planes) or len(values.spheres) or values.damping or np.isfinite(values.pin_stiffness).any():
            raise ValueError("VectorisedStep: scene must have solids, hard pins and gravity only")
        self.time_step, self.iterations, self.dtype = time_step, iterations, dtype
        corners = values.rest_positions[values.tets]
        rest = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        volume = np.linalg.det(rest) / 6.0
        last = np.linalg.inv(rest)
        gradients = np.concatenate([-last.sum(axis=1, keepdims=True), last], axis=1)  # [E, 4, 3]: grad N_a
        self._tets, self._count = len(values.tets), len(values.rest_positions)
        rows = np.arange(3 * self._tets).reshape(3, self._tets, 1)
        entries = gradients.transpose(2, 0, 1)  # direction, tet, corner
        places = (np.broadcast_to(rows, entries.shape).ravel(), np.broadcast_to(values.tets, entries.shape).ravel())
        gather = csr_matrix((entries.ravel(), places), shape=(3 * self._tets, self._count))
        self._gather = _csr(gather, dtype)
        self._scatter = _csr(csr_matrix(gather.T), dtype)
        self._weight = torch.tensor(values.stiffness * volume, dtype=dtype).unsqueeze(-1)
        self._set_diagonal(values.masses, values.stiffness * volume, gradients, values.tets, values.pin_vertices)
        self._gravity = torch.tensor(values.gravity, dtype=dtype)

    def _set_diagonal(self, masses: Array, weight: Array, gradients: Array, tets: Index, pinned: Index) -> None:
        """D_i = a_i + sum over elements of l_e w V |grad N_i|^2, and rho = 1 - theta min a / D."""
        products = gradients @ gradients.transpose(0, 2, 1)
        scale = 1.0 / np.sqrt(np.einsum("eaa->ea", products))
        bound = np.linalg.eigvalsh(products * scale[:, :, None] * scale[:, None, :])[:, -1]
        share = (bound * weight)[:, None] * np.einsum("eaa->ea", products)
        inertia = masses / self.time_step**2
        diagonal = inertia + np.bincount(tets.ravel(), weights=share.ravel(), minlength=self._count)
        free = np.ones(self._count, dtype=bool)
        free[pinned] = False
        self.rho = min(0.99999, 1.0 - RELAXATION * float((inertia / diagonal)[free].min()))
        self._inertia = torch.tensor(inertia, dtype=self.dtype)[:, None, None]
        self._step_size = torch.tensor(np.where(free, RELAXATION / diagonal, 0.0), dtype=self.dtype)[:, None, None]
        self._free = torch.tensor(free)[:, None, None]

    def _forces(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Elastic energy [B] and its gradient [V, 3, B] at positions [V, 3, B]."""
        count, _, batch = x.shape
        gradients = torch.mm(self._gather, x.view(count, 3 * batch)).view(3, self._tets, 3, batch)
        planes = gradients.permute(2, 0, 1, 3).contiguous()  # row, column, tet, environment
        f = [[planes[i, j] for j in range(3)] for i in range(3)]
        r = _nearest_rotations(f, NEWTON_STEPS[self.dtype])
        stretch = planes - torch.stack([torch.stack(row) for row in r])
        stress = self._weight * stretch
        energy = 0.5 * (stress * stretch).sum(dim=(0, 1, 2))
        flat = stress.permute(1, 2, 0, 3).reshape(3 * self._tets, 3 * batch)
        return energy, torch.mm(self._scatter, flat).view(count, 3, batch)

    @torch.no_grad()
    def __call__(self, state: State) -> State:
        """The next state; arguments and result [B, V, 3] as of a `Simulator`."""
        h = self.time_step
        x = state[0].permute(1, 2, 0).contiguous()
        velocity = state[1].permute(1, 2, 0)
        target = h * velocity + h * h * self._gravity[:, None]
        u = torch.where(self._free, h * velocity, torch.zeros_like(x))
        before = u
        limit = ((1.0 - math.sqrt(1.0 - self.rho**2)) / self.rho) ** 2
        momentum = torch.zeros(x.shape[2], dtype=self.dtype)
        restart = torch.zeros_like(momentum, dtype=torch.bool)
        last = torch.full_like(momentum, float("inf"))
        for iteration in range(self.iterations):
            energy, gradient = self._forces(x + u)
            off = u - target
            gradient = gradient + self._inertia * off
            omega = 1.0 + torch.minimum(momentum / (momentum + 3.0), torch.full_like(momentum, limit))
            momentum = torch.where(restart, torch.zeros_like(momentum), momentum + 1.0)
            restart = torch.zeros_like(restart)
            if iteration % 4 == 0:
                energy = energy + 0.5 * (self._inertia * off * off).sum(dim=(0, 1))
                restart, last = energy > last * (1.0 + 1e-5), energy
            u, before = before + omega * (u - self._step_size * gradient - before), u
        return State((x + u).permute(2, 0, 1).contiguous(), (u / h).permute(2, 0, 1).contiguous())
