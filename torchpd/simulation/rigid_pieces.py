"""Steps of bodies with stiff pieces in soft surroundings: rigid motions of the pieces between the iterations.

Every solver here uses the constant matrix A of projective dynamics. In A, rotating a stiff piece costs as much as
straining it. In the Hessian H it costs almost nothing. For each piece, three eigenvalues of A^-1 H are about the
contrast of the stiffnesses, and those directions converge slowly however good M is.

So the pieces are moved as rigid bodies between rounds, by Newton's method on their rigid motions. Z has four functions
for each piece, see `stiff_pieces`. f_k is the present direction of axis k of X - c in the piece. Its velocity is Z (v,
w x f_k), and the matrix of these motions follows from Z^T A Z. The step is Z (v, (R - 1) f_k), with R the rotation of
w. It is linear in Z, and does not strain the piece.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..common.checks import check_has_values, check_scalar, check_whole
from ..ops.diagonal import step_diagonal
from ..plan.preconditioner import reference_material
from ..scene.effects import Damping, Gravity, Pin, Solid
from ..scene.loads import Pressure, Wind
from .state import Info, State
from .stepper import Stepper
from .stiff_pieces import find_pieces

if TYPE_CHECKING:
    from ..scene.targets import Targets

__all__ = ["RigidPieces"]

_NOISE = {
    torch.float32: 1e-5,
    torch.float64: 1e-12,
}  # relative rounding of an energy, as in csrc/solver/multilevel/line_search.h
_KNOWN = Solid | Pin | Gravity | Damping | Pressure | Wind
# arrays on which the pieces and their functions depend
_MADE_OF = ("stiffness", "masses", "damping", "pin_stiffness", "pin_hard")


class RigidPieces:
    """Stiff pieces of a scene, and steps that move them as rigid bodies between iterations of the simulator.

    A piece is a connected set of elements that are stiffer than the rest. Pieces that hard pins hold are left to the
    solver. It pays from contrasts of about a thousand, with `Multilevel("lbfgs")`: rounds are too short for
    "corotated". `Simulator.rollout`, `capture`, `tune`, `save` and `load` ignore it and take the simulator's own steps.

    It is made for the present material, time step, precision and device. After a change of these, steps are refused
    until `prepare`; writes through `.data` are not noticed. Results may depend on the batch by rounding.
    docs/solvers.md is a guide.

    It holds four numbers for each vertex and piece, in the precision of the simulator. Making it factorises the sparse
    matrix of the surroundings and solves for each of these columns, on the CPU in float64.

    Args:
        sim: the simulator; it keeps its settings.
        stiffer_than: stiffness [Pa] above which an element belongs to a piece. None: the geometric mean of the lowest
            and the highest, which must differ by a factor of 100.

    Raises:
        ValueError: contacts, cloth, rods, plastic solids or a Poisson's ratio in the scene, no free piece, more than
            256 pieces, or too little memory.
    """

    def __init__(self, sim: Stepper, *, stiffer_than: float | None = None) -> None:
        if not isinstance(sim, Stepper):
            raise TypeError(f"RigidPieces: sim must be a Simulator, got {type(sim).__name__}")
        if sim.planes.shape[-2] or sim.spheres.shape[-2]:
            raise ValueError(
                "RigidPieces: the scene must have no contacts, which rigid motions do not model; use sim alone"
            )
        unknown = sorted({type(part).__name__ for part in sim.scene.parts if not isinstance(part, _KNOWN)})
        if any(not isinstance(solid.poisson, float) for solid in sim.scene.solids):
            unknown.append("a Poisson's ratio")
        if sim.keeps_history:
            unknown.append("plastic flow")
        if unknown:
            raise ValueError(
                "RigidPieces: the scene must have nothing but solids without a Poisson's ratio, got "
                f"{' and '.join(unknown)}, which rigid motions of its pieces do not model; use sim alone"
            )
        self.sim = sim
        self.stiffer_than = (
            None if stiffer_than is None else check_scalar("RigidPieces.stiffer_than", stiffer_than, minimum=0.0)
        )
        self.prepare()

    def prepare(self) -> None:
        """Make it again for the present material, time step, precision and device of the simulator.

        Needed after a change of these; takes as long as making it. A refusal changes nothing.
        """
        sim = self.sim
        check_has_values("RigidPieces", sim.device)
        reference = tuple(array.clone() for array in reference_material(sim.plan, sim.material(), sim.time_step))
        stiffness, inertia = (array.cpu().double().numpy() for array in reference)
        found = find_pieces(sim.scene.values(), stiffness, inertia, self.stiffer_than, sim.dtype, sim.device)
        functions, fits = (
            torch.from_numpy(array).to(sim.device, sim.dtype).contiguous() for array in (found.functions, found.fits)
        )
        rows, owners, coarse = (
            torch.from_numpy(array).to(sim.device) for array in (found.rows, found.owners, found.coarse)
        )
        self.pieces, self.threshold = found.vertices, found.threshold
        self._functions, self._fits, self._rows, self._owners, self._coarse = functions, fits, rows, owners, coarse
        self._reference, self._time_step, self._seen = reference, sim.time_step, _look(sim)

    def __repr__(self) -> str:
        count = len(self.pieces)
        return f"RigidPieces({count} piece{'s' * (count != 1)} stiffer than {self.threshold:g} Pa)"

    def step(
        self,
        state: State,
        rounds: int,
        *,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: bool = False,
    ) -> State | tuple[State, Info]:
        """Take one time step of `rounds` times the simulator's iterations, with a rigid motion between rounds.

        Four iterations a round work well. Gradients are those of the simulator's step.

        Args:
            state: as in `Simulator.forward`, like the following arguments.
            rounds: a whole number >= 1.
            forces: on the vertices [B, V, 3] [N].
            targets: of pins.
            start: first iterate.
            return_info: also return a report of the last round.
        """
        self._check_made_of()
        self._check_state(state)
        for _ in range(check_whole("rounds", rounds, minimum=1) - 1):
            with torch.no_grad():
                after: State = self.sim(state, forces, targets, start)
                start = self._moved(state, after.positions, forces, targets)
        result: State | tuple[State, Info] = self.sim(state, forces, targets, start, return_info)
        return result

    @torch.no_grad()
    def move(
        self, state: State, positions: Tensor, *, forces: Tensor | None = None, targets: Targets | None = None
    ) -> Tensor:
        """Move every piece rigidly, with its surroundings, to lower the objective of a step [B, V, 3] m.

        Args:
            state: start of the step.
            positions: present positions [B, V, 3] m; environments whose energy would rise keep them.
            forces: as in `step`.
            targets: as in `step`.
        """
        self._check_made_of()
        self._check_state(state)
        self._check_field("positions", positions, state[0].shape)
        if forces is not None:
            self._check_field("forces", forces, state[0].shape)
        return self._moved(state, positions, forces, targets)

    def _check_made_of(self) -> None:
        """Refuse a simulator that has changed since `prepare`. Waits for a device only after a write."""
        sim, (stiffness, inertia) = self.sim, self._reference
        if (sim.dtype, sim.device) != (stiffness.dtype, stiffness.device):
            raise RuntimeError(
                f"RigidPieces was made for {stiffness.dtype} on {stiffness.device}, but its simulator is "
                f"{sim.dtype} on {sim.device} now; call prepare() to make it anew"
            )
        seen = _look(sim)
        if all(one[0] is other[0] and one[1:] == other[1:] for one, other in zip(seen, self._seen, strict=True)):
            return
        now = reference_material(sim.plan, sim.material(), sim.time_step)
        faults = [
            f"time_step was {self._time_step:g} s and is {sim.time_step:g} s" * (sim.time_step != self._time_step),
            "stiffness has changed" * (not torch.equal(now[0], stiffness)),
            "masses, damping or pin_stiffness have changed"
            * (sim.time_step == self._time_step and not torch.equal(now[1], inertia)),
        ]
        if any(faults):
            raise RuntimeError(
                f"RigidPieces was made for another simulation: {', '.join(filter(None, faults))}; "
                "call prepare() to make it anew"
            )
        self._seen = seen  # the same values were written again

    def _check_state(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 2 or not all(isinstance(part, Tensor) for part in state):
            raise TypeError(
                f"state must be a State, positions and velocities [B, {self.sim.vertices}, 3], got "
                f"{type(state).__name__}"
            )
        batch = state[0].shape[:1] if state[0].dim() == 3 else (1,)
        for name, part in zip(State._fields, state, strict=True):
            self._check_field(f"state.{name}", part, (*batch, self.sim.vertices, 3))

    def _check_field(self, name: str, field: Any, shape: tuple[int, ...]) -> None:
        wanted = f"{name} must be {list(shape)}, {self.sim.dtype} on {self.sim.device} like state and simulator"
        if not isinstance(field, Tensor):
            raise TypeError(f"{wanted}, got {type(field).__name__}")
        if (field.dtype, field.device) != (self.sim.dtype, self.sim.device):
            raise TypeError(f"{wanted}, got {field.dtype} on {field.device}")
        if field.shape != shape:
            raise ValueError(f"{wanted}, got {list(field.shape)}")

    def _moved(self, state: State, positions: Tensor, forces: Tensor | None, targets: Targets | None) -> Tensor:
        """`move`, for checked arguments."""
        # in the precision of the step, even within autocast
        with torch.autocast(positions.device.type, enabled=False):
            gradient = self.sim.step_gradient(state, positions, forces, targets)
            batch, nodes = len(positions), len(self.pieces)
            pull = (self._functions.T @ gradient).double().view(batch, nodes, 4, 3)
            fitted = torch.einsum("cas,bcsx->bcax", self._fits, positions[:, self._rows]).double()
            shape = (self._owners @ fitted.flatten(2)).view(batch, nodes, 4, 3)[:, :, 1:]
            motion = _newton(pull, shape, self._coarse)
            turned = shape @ _rotation(motion[..., 3:]).mT - shape
            change = torch.cat([motion[..., None, :3], turned], dim=2).view(batch, 4 * nodes, 3)
            inertia, _ = step_diagonal(self.sim.plan.arrays, self.sim.material(), self.sim.time_step)
            inertia = inertia.unsqueeze(-1)
            moved = torch.where(inertia.isfinite(), self._functions @ change.to(positions.dtype), 0.0)
            falls = self._falls(positions, moved, gradient, inertia)
            return torch.where(falls[:, None, None], positions + moved, positions)

    def _falls(self, positions: Tensor, moved: Tensor, gradient: Tensor, inertia: Tensor) -> Tensor:
        """Whether the objective of each environment does not rise [B], except by rounding.

        It is half a |x - y|^2 plus the elastic energy; a (x - y) is the gradient minus its elastic part.
        """
        sim, free = self.sim, inertia.isfinite()
        pull = torch.where(free, gradient - sim.gradient(positions), 0.0)
        change = (moved * torch.where(free, pull + 0.5 * inertia * moved, 0.0)).double().sum((-2, -1))
        size = (0.5 * pull.square() / inertia).double().sum((-2, -1))
        before, after = (
            torch.ops.torchpd.element_energy(x, sim.material(), list(sim.plan.arrays)).double().sum(-1)
            for x in (positions, positions + moved)
        )
        falls: Tensor = change + after - before <= _NOISE[positions.dtype] * (size + before)
        return falls


def _look(sim: Stepper) -> list[tuple[Any, ...]]:
    """Evidence of writes that needs no values: the objects, their versions and addresses."""
    arrays = [getattr(sim, name) for name in _MADE_OF]
    # inference tensors count no versions
    versions = [0 if array.is_inference() else array._version for array in arrays]
    seen = [(array, version, array.data_ptr()) for array, version in zip(arrays, versions, strict=True)]
    return [(None, sim.time_step), *seen]


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
    """Velocity and rotation vector of every piece [B, P, 6] that balance the gradient [B, P, 4, 3] N.

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
    # no check, which would wait for a device: a non-finite motion does not lower the energy
    solved, _ = torch.linalg.solve_ex(scale[:, :, None] * matrix * scale[:, None, :], scale * right)
    found: Tensor = -(scale * solved).view(batch, nodes, 6)
    return found
