"""Steps of bodies that have stiff pieces in soft surroundings: rigid motions of the pieces between the iterations.

Every solver here goes by the constant matrix A of projective dynamics. Turning a stiff piece costs it as much as
straining it would, in A; in truth, by the Hessian H, next to nothing. For each piece three eigenvalues of A^-1 H are
about the contrast of the stiffnesses, and that many directions are slow however good M is.

So the pieces are moved as rigid bodies from time to time, by Newton's method on their rigid motions. Z has four
functions for each piece, 1 and X - c, extended to the rest of the mesh so that the energy of A without the pieces' own
elements is least. With f_k, where the piece has the axis k of X - c now, its velocity is Z (v, w x f_k), the matrix of
these motions follows from Z^T A Z, and the step is Z (v, (R - 1) f_k), R the rotation of w: linear in Z, and it does
not strain the piece.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from torch import Tensor

from .checks import check_scalar, check_whole
from .diagonal import step_diagonal
from .multilevel import reference_of
from .state import Info, State

if TYPE_CHECKING:
    from .scene import SceneValues
    from .simulator import Simulator
    from .targets import Targets

__all__ = ["RigidPieces"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_CONTRAST = 100.0  # of the stiffnesses, below which there are no pieces by default
_NOISE = {torch.float32: 1e-5, torch.float64: 1e-12}  # of an energy by rounding, as in csrc/solver/multilevel.h
_MOST = 256  # pieces: 1536 unknowns of a dense solve


class RigidPieces:
    """Stiff pieces of a scene, and steps that move them as rigid bodies between the iterations of the simulator.

    A piece is a connected set of elements that are stiffer than the rest; one that hard pins hold is left to the
    solver. Worth it from contrasts of about a thousand, with `Multilevel`. Made for the material, time step, precision
    and device of now. Contacts are not known to these motions: such scenes are refused. Results may depend on the batch
    by rounding. Holds eight numbers for each vertex and piece, in the precision of the simulator.

    Args:
        sim: whose steps; it keeps its settings.
        stiffer_than: stiffness [Pa] above which an element belongs to a piece. None: the geometric mean of the lowest
            and the highest, where these are a hundredfold apart.

    Raises:
        ValueError: a scene with contacts, without a free piece, or with more than 256.
    """

    def __init__(self, sim: Simulator, stiffer_than: float | None = None) -> None:
        if sim.planes.shape[-2] or sim.spheres.shape[-2]:
            raise ValueError("RigidPieces: the scene has contacts, which rigid motions do not know of; use sim alone")
        self.sim = sim
        stiffness, inertia = (
            array.detach().cpu().double().numpy() for array in reference_of(sim.plan, sim.material(), sim.time_step)
        )
        values = sim.scene.values()
        stiff = stiffness > _threshold(stiffness, stiffer_than)
        self.pieces = _free_pieces(values.tets[stiff], inertia)
        inside = np.zeros(len(inertia), dtype=bool)
        inside[[vertex for piece in self.pieces for vertex in piece]] = True
        if not 1 <= len(self.pieces) <= _MOST:
            raise ValueError(
                f"RigidPieces: there must be 1 to {_MOST} connected pieces that no hard pin holds, found "
                f"{len(self.pieces)} among {int(stiff.sum())} stiff elements; choose stiffer_than [Pa]"
            )
        strained = ~(stiff & inside[values.tets].all(axis=1))
        matrix = _matrix(values, np.where(strained, stiffness, 0.0), inertia)
        functions, fits = _functions(values.rest_positions, self.pieces, matrix, np.isfinite(inertia) & ~inside)
        nodes = len(self.pieces)
        coarse = (functions.T @ (matrix @ functions)).reshape(nodes, 4, nodes, 4)
        self._coarse = torch.from_numpy(coarse).to(sim.device)
        self._functions, self._fits = (
            torch.from_numpy(array).to(sim.device, sim.dtype).contiguous() for array in (functions, fits)
        )

    def step(
        self,
        state: State,
        rounds: int,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: bool = False,
    ) -> State | tuple[State, Info]:
        """One time step: `rounds` times the iterations of the simulator, with a rigid motion between two of them.

        Four iterations a round do well. Gradients are those of the simulator's step.

        Args:
            state: as of `Simulator.forward`, like the arguments that follow.
            rounds: a whole number >= 1.
            forces: on the vertices [B, V, 3] [N].
            targets: of pins.
            start: first iterate.
            return_info: also how the last round went.
        """
        for _ in range(check_whole("rounds", rounds, minimum=1) - 1):
            with torch.no_grad():
                after: State = self.sim(state, forces, targets, start)
            start = self.move(state, after.positions, forces, targets)
        result: State | tuple[State, Info] = self.sim(state, forces, targets, start, return_info)
        return result

    @torch.no_grad()
    def move(
        self, state: State, positions: Tensor, forces: Tensor | None = None, targets: Targets | None = None
    ) -> Tensor:
        """A rigid motion of every piece that lowers the objective of a step, and its surroundings with it [B, V, 3] m.

        Args:
            state: where the step starts.
            positions: where the pieces are [B, V, 3] m; environments whose energy would rise stay there.
            forces: as in `step`.
            targets: as in `step`.
        """
        gradient = self.sim.step_gradient(state, positions, forces, targets)
        batch, nodes = len(positions), len(self.pieces)
        pull = (self._functions.T @ gradient).double().view(batch, nodes, 4, 3)
        shape = (self._fits @ positions).double().view(batch, nodes, 4, 3)[:, :, 1:]
        motion = _newton(pull, shape, self._coarse)
        turned = shape @ _rotation(motion[..., 3:]).mT - shape
        change = torch.cat([motion[..., None, :3], turned], dim=2).view(batch, 4 * nodes, 3)
        inertia, _ = step_diagonal(self.sim.plan.arrays, self.sim.material(), self.sim.time_step)
        inertia = inertia.unsqueeze(-1)
        moved = torch.where(inertia.isfinite(), self._functions @ change.to(positions.dtype), 0.0)
        falls = self._falls(positions, moved, gradient, inertia)
        return torch.where(falls[:, None, None], positions + moved, positions)

    def _falls(self, positions: Tensor, moved: Tensor, gradient: Tensor, inertia: Tensor) -> Tensor:
        """Whether the objective of each environment does not rise [B], but for rounding.

        It is half a |x - y|^2 and the elastic energy; a (x - y) is what the elastic forces leave of the gradient.
        """
        sim, free = self.sim, inertia.isfinite()
        pull = torch.where(free, gradient - sim.gradient(positions), 0.0)
        change = (moved * torch.where(free, pull + 0.5 * inertia * moved, 0.0)).double().sum((-2, -1))
        size = (0.5 * pull.square() / inertia).double().sum((-2, -1))
        before, after = (
            torch.ops.torchpd.element_energy(x, sim.stiffness, list(sim.plan.arrays)).double().sum(-1)
            for x in (positions, positions + moved)
        )
        falls: Tensor = change + after - before <= _NOISE[positions.dtype] * (size + before)
        return falls


def _threshold(stiffness: Array, given: float | None) -> float:
    if given is not None:
        return check_scalar("RigidPieces.stiffer_than", given, minimum=0.0)
    low, high = float(stiffness.min()), float(stiffness.max())
    return float(np.sqrt(low * high)) if high >= _CONTRAST * low else np.inf


def _free_pieces(tets: Index, inertia: Array) -> list[Index]:
    """Vertices of each connected set of elements, but for those with a vertex that is held."""
    count = len(inertia)
    first, other = np.repeat(tets[:, 0], 3), tets[:, 1:].reshape(-1)
    graph = coo_array((np.ones(len(first)), (first, other)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    used = np.unique(tets)
    pieces = (used[label[used] == piece] for piece in np.unique(label[used]))
    return [piece for piece in pieces if np.isfinite(inertia[piece]).all()]


def _matrix(values: SceneValues, stiffness: Array, inertia: Array) -> csc_array:
    """A of projective dynamics [V, V] N/m, with zero for the inertia of what is held."""
    corners = values.rest_positions[values.tets]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    inner = np.linalg.inv(edges)
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    weight = stiffness * np.linalg.det(edges) / 6.0
    entries = weight[:, None, None] * (gradients @ gradients.transpose(0, 2, 1))
    rows, columns = np.repeat(values.tets, 4, axis=1).reshape(-1), np.tile(values.tets, (1, 4)).reshape(-1)
    elastic = coo_array((entries.reshape(-1), (rows, columns)), shape=(len(inertia), len(inertia)))
    return csc_array(elastic.tocsc() + diags_array(np.where(np.isfinite(inertia), inertia, 0.0)))


def _functions(rest: Array, pieces: list[Index], matrix: csc_array, around: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Z [V, 4 P], and what finds its coefficients from positions of the pieces [4 P, V]."""
    functions, fits = (np.zeros((len(rest), 4 * len(pieces))) for _ in range(2))
    for node, piece in enumerate(pieces):
        own = slice(4 * node, 4 * node + 4)
        arms = rest[piece] - rest[piece].mean(axis=0)
        functions[piece, own] = np.column_stack([np.ones(len(piece)), arms / np.abs(arms).max()])
        fits[piece, own] = np.linalg.pinv(functions[piece, own]).T
    others = np.flatnonzero(around)
    if len(others):
        rows = csc_array(matrix[others])
        functions[others] = splu(csc_array(rows[:, others])).solve(-(rows @ functions))
    return functions, np.ascontiguousarray(fits.T)


def _cross(vectors: Tensor) -> Tensor:
    """The matrices of w x, [..., 3, 3]."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(*x.shape, 3, 3)


def _rotation(vectors: Tensor) -> Tensor:
    """Rodrigues' formula, [..., 3, 3]: sinc(x) is sin(pi x) / (pi x)."""
    angle = torch.linalg.vector_norm(vectors, dim=-1)[..., None, None] / torch.pi
    turn = _cross(vectors)
    one = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return one + torch.sinc(angle) * turn + 0.5 * torch.sinc(0.5 * angle).square() * (turn @ turn)


def _newton(pull: Tensor, shape: Tensor, coarse: Tensor) -> Tensor:
    """Velocity and rotation vector of every piece [B, P, 6] that balance the pull [B, P, 4, 3] N.

    Args:
        pull: Z^T grad E.
        shape: f_k of every piece [B, P, 3, 3] m.
        coarse: Z^T A Z [P, 4, P, 4] N/m.
    """
    batch, nodes = pull.shape[:2]
    motions = pull.new_zeros(batch, nodes, 4, 3, 6)
    motions[:, :, 0, :, :3] = torch.eye(3, dtype=pull.dtype, device=pull.device)
    motions[:, :, 1:, :, 3:] = -_cross(shape)  # w x f = -f x w
    bent = torch.einsum("paqc,bqcxj->bpaxqj", coarse, motions)
    matrix = torch.einsum("bpaxi,bpaxqj->bpiqj", motions, bent).reshape(batch, 6 * nodes, 6 * nodes)
    right = torch.einsum("bpaxi,bpax->bpi", motions, pull).reshape(batch, 6 * nodes)
    scale = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
    # without a check, which would wait for a device: what is not finite does not lower the energy
    solved, _ = torch.linalg.solve_ex(scale[:, :, None] * matrix * scale[:, None, :], scale * right)
    found: Tensor = -(scale * solved).view(batch, nodes, 6)
    return found
