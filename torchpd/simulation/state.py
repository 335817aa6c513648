"""States, reports and tracks: named tuples of tensors, hence pytrees."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeVar, overload

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from ..common.reprs import by_sizes

if TYPE_CHECKING:
    from ..scene.targets import Targets

__all__ = [
    "ContactHistory",
    "History",
    "HistoryState",
    "HistoryTrack",
    "Info",
    "State",
    "StepCall",
    "Track",
    "chosen",
    "history_of",
    "joined",
    "named_state",
]


class State(NamedTuple):
    """Positions and velocities of all vertices, in the order of the meshes, bodies one after another.

    `torch.save` takes it, alone or in a checkpoint, and `torch.load` returns it where torchpd is imported. Scenes with
    plastic solids or `Contact` have a `HistoryState`.
    """

    positions: Tensor  # [B, V, 3] m
    velocities: Tensor  # [B, V, 3] m/s

    def to(self, *args: Any, **kwargs: Any) -> State:
        """The state on another device or in another precision, as `Tensor.to`."""
        return _mapped(self, lambda tensor: _moved(tensor, *args, **kwargs))

    def clone(self) -> State:
        """A contiguous copy, which `step_` may overwrite."""
        return _mapped(self, _dense_copy)

    def where(self, condition: Tensor, other: State) -> State:
        """Take environments of this state where `condition` [B] is true, and of `other` elsewhere, for resets.

        Args:
            condition: bool [B].
            other: a state with as many environments, or with one for all.
        """
        return _where(self, condition, other)

    def detach(self) -> State:
        """The state without its autograd history, as `Tensor.detach`."""
        return _mapped(self, Tensor.detach)

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "batch", "vertices")


class History(NamedTuple):
    """What a step leaves for the next one in a scene with plastic solids, besides positions and velocities."""

    flow: Tensor  # [B, P, 10] of plastic tetrahedra: Fp, row by row, and alpha (see `Plastic`)

    def __repr__(self) -> str:
        return by_sizes(self, self.flow, "records", "batch", "plastic")


class ContactHistory(NamedTuple):
    """What a step leaves for the next one in a scene with `Contact`, besides positions and velocities.

    Forces start the solve of the next step. A key names a pair of the simulator's surfaces; -1 is none.
    """

    poses: Tensor  # [B, C, 7] actual poses of the colliders: x, y, z in m, and a quaternion qw, qx, qy, qz
    keys: Tensor  # [B, M] int64 of pairs with forces, M = `Contact.capacity`; all -1: no forces, as in a new state
    forces: Tensor  # [B, M, 4] N: along the normal, and the vector of friction
    motion: Tensor  # [B, C, 6] m/s of the centre of mass, rad/s; [B, 0, 6] if no collider has a mass
    flow: Tensor  # [B, P, 10] as in `History`, of no tetrahedra without plastic solids

    def __repr__(self) -> str:
        return by_sizes(self, self.forces, "records", "batch", "pairs")


def widened(history: ContactHistory, width: int) -> ContactHistory:
    """The same history [..., M] with room for `width` pairs with forces."""
    more = width - history.keys.shape[-1]
    if more <= 0:
        return history
    pad = torch.nn.functional.pad
    return history._replace(keys=pad(history.keys, (0, more), value=-1), forces=pad(history.forces, (0, 0, 0, more)))


class HistoryState(NamedTuple):
    """The state of a scene with plastic solids or `Contact`: positions, velocities and history.

    `Simulator.rest_state` makes one; steps take and return it as scenes without history do a `State`. For a state of
    one's own: `HistoryState(x, v, sim.rest_state(len(x)).history)`.
    """

    positions: Tensor  # [B, V, 3] m
    velocities: Tensor  # [B, V, 3] m/s
    history: History | ContactHistory

    def to(self, *args: Any, **kwargs: Any) -> HistoryState:
        """The state on another device or in another precision, as `Tensor.to`."""
        return _mapped(self, lambda tensor: _moved(tensor, *args, **kwargs))

    def clone(self) -> HistoryState:
        """A contiguous copy, which `step_` may overwrite."""
        return _mapped(self, _dense_copy)

    def where(self, condition: Tensor, other: HistoryState) -> HistoryState:
        """Take environments of this state where `condition` [B] is true, of `other` elsewhere, see `State.where`."""
        return _where(self, condition, other)

    def detach(self) -> HistoryState:
        """The state without its autograd history, as `Tensor.detach`."""
        return _mapped(self, Tensor.detach)

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "batch", "vertices")


_AnyState = TypeVar("_AnyState", State, HistoryState)
_Some = TypeVar("_Some", bound=State | HistoryState)


def _mapped(state: _Some, function: Callable[[Tensor], Tensor]) -> _Some:
    """The state with a function applied to each of its tensors."""
    whole: tuple[Any, ...] = state
    kind: Callable[..., _Some] = type(state)
    return kind(*(function(part) if isinstance(part, Tensor) else history_of(map(function, part)) for part in whole))


def history_of(arrays: Iterable[Tensor]) -> History | ContactHistory:
    """A history with named parts, from its arrays in their order."""
    parts = tuple(arrays)
    return History(*parts) if len(parts) == len(History._fields) else ContactHistory(*parts)


def chosen(state: _Some, environments: Sequence[int]) -> _Some:
    """Some environments of a state, in this order."""
    return _mapped(state, lambda tensor: tensor[environments])


def joined(states: Sequence[_Some]) -> _Some:
    """The environments of several states as one."""
    others = [iter(_tensors_by_name(state).values()) for state in _equally_wide(states)]
    return _mapped(states[0], lambda _: torch.cat([next(tensors) for tensors in others]))


def _equally_wide(states: Sequence[Any]) -> list[Any]:
    """The same states, with room for as many pairs with forces in each."""
    histories = [history_of(state[2]) if len(state) > 2 else None for state in states]
    widths = [of.keys.shape[-1] for of in histories if isinstance(of, ContactHistory)]
    return [
        state._replace(history=widened(of, max(widths))) if isinstance(of, ContactHistory) else state
        for state, of in zip(states, histories, strict=True)
    ]


def _moved(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """`Tensor.to`, which leaves whole numbers whole: they are keys."""
    moved = tensor.to(*args, **kwargs)
    return moved if tensor.is_floating_point() else tensor.to(moved.device)


def _dense_copy(tensor: Tensor) -> Tensor:
    return tensor.clone(memory_format=torch.contiguous_format)


def named_state(state: Any) -> State | HistoryState:
    """A state with named parts, from any tuple or list that a step takes."""
    if len(state) == len(State._fields):
        return State(*state)
    positions, velocities, history = state
    return HistoryState(positions, velocities, history_of(history))


def _has_history(state: Any) -> bool:
    """Whether the third part, if there is one, is a history or a tuple or list of its parts."""
    return len(state) == len(State._fields) or (
        isinstance(state[2], (tuple, list)) and len(state[2]) in (len(History._fields), len(ContactHistory._fields))
    )


def _tensors_by_name(state: Any) -> dict[str, Tensor]:
    """The tensors of a state by name."""
    whole = named_state(state)
    named = {"positions": whole.positions, "velocities": whole.velocities}
    return named | whole.history._asdict() if isinstance(whole, HistoryState) else named


def _where(state: _Some, condition: Any, other: Any) -> _Some:
    """Implementation of `State.where` and `HistoryState.where`."""
    kind = type(state)
    if not isinstance(condition, Tensor):
        raise TypeError(f"{kind.__name__}.where: condition must be a bool tensor, got {type(condition).__name__}")
    if condition.dtype != torch.bool or condition.shape != state.positions.shape[:1]:
        raise ValueError(
            f"{kind.__name__}.where: condition must be bool [{len(state.positions)}], one for each environment, got "
            f"{condition.dtype} {list(condition.shape)}"
        )
    if not isinstance(other, (tuple, list)) or len(other) != len(state) or not _has_history(other):
        raise TypeError(f"{kind.__name__}.where: other must be a {kind.__name__}, got {type(other).__name__}")
    if isinstance(state, HistoryState) and len(state.history) != len(other[2]):
        wanted, came = type(state.history).__name__, type(history_of(other[2])).__name__
        raise TypeError(
            f"{kind.__name__}.where: other must be a {kind.__name__} with a {wanted}, got one with a {came}"
        )
    state, other = _equally_wide([state, named_state(other)])
    theirs_of = _tensors_by_name(other)
    for name, mine in _tensors_by_name(state).items():
        theirs = theirs_of[name]
        if theirs.dtype != mine.dtype or theirs.device != mine.device:
            raise TypeError(
                f"{kind.__name__}.where: other must have {name} {mine.dtype} on {mine.device}, got {theirs.dtype} on "
                f"{theirs.device}"
            )
        if theirs.shape not in (mine.shape, (1, *mine.shape[1:])):
            raise ValueError(
                f"{kind.__name__}.where: other must have {name} {list(mine.shape)}, or those of one environment, got "
                f"{list(theirs.shape)}"
            )
    rest = iter(theirs_of.values())
    return _mapped(state, lambda mine: torch.where(condition.view(-1, *[1] * (mine.dim() - 1)), mine, next(rest)))


class Info(NamedTuple):
    """Report of a step's solve, per environment [B] (of a rollout [T, B]). Reading it on a GPU synchronises.

    No field has a gradient; `Simulator.energy` of the next state has one.

    Attributes:
        residual: share of the step's forces that is not balanced: 0 (solved, to rounding) to 1. NaN unless requested,
            and where state or material of the step are not finite, or negative. See below.
        energy: objective E at the last iterate [J], elastic energy + m / (2 h^2) |x - y|^2, which the solve lowers. The
            mechanical energy is `Simulator.energy`. NaN unless requested.
        iterations: number that ran.
        restarts: of the acceleration, because the energy rose. For `Multilevel`: rejected trials.
        converged: whether the estimated error was within `Simulator.tolerance` before the iterations ran out; False
            without a tolerance. It is an error of positions, so it may hold while the residual is large.
        rho: spectral radius used by the schedule. For `Multilevel` the material mismatch 1 - q / s in [0, 1), where
            q A_0 <= A <= s A_0. A_0 is the matrix of `Simulator.prepare_solver`.
        inverted: tetrahedra with det F <= 0 at the end of the step. A body may rest with some, converged, in a folded
            minimum of its energy. -1 unless requested.
        contact_gap: least distance of two surfaces of `Contact` over their thickness at the end of the step, among
            pairs that are near each other; inf without any, NaN where the step was taken back. 1 where surfaces rest,
            less where the solve is unfinished.
        contact_overflow: pairs that `Contact.capacity` lacks. Where it is positive, positions, velocities and history
            stay as before the step. 0 without `Contact`.
        held_back: largest distance that a pinned vertex or a vertex of a `Collider` stays behind its target because
            bodies are in the way [m]. Of a `Collider` with a mass, how far its inertia and the forces of its pairs
            would still move it. 0 without `Contact`.
        contact_pairs: most pairs near each other that a search of the step found, for `Contact.capacity`. A step that
            is taken back makes no further search, which might find more. 0 without `Contact`.
        contact_searches: searches for pairs. 0 where the step without `Contact` was taken.
        contact_frozen: free vertices that an iteration left in place since no plane separates two surfaces beyond
            rounding, summed over the iterations: no edge crosses, but they are late. 0 is usual.
    The residual is (|r| - 4 eps |S x|)+ / max(|r|, sqrt(sum |f_i|^2 + |e_i|^2)). Here r is the part of grad E [N] that
    neither pins nor contacts balance. f_i = a_i (u_i - s_i) is the force of inertia, weight and springs on vertex i,
    and e_i that of its elements. S x is the sum of stiffness times position (csrc/solver/report.h), so 4 eps |S x|
    bounds the rounding that no iteration removes. With `Contact` r is also without the forces between bodies. Colliders
    with a mass have a share of their own, and the larger one is the residual. There r is the force and the torque that
    are not balanced, and the others are those of inertia and of contact. A torque counts by the size s, where m s^2 is
    half of the trace of the moment of inertia.

    If all forces are below that bound, the residual is 0 and says nothing: see docs/limits.md and use float64 there.
    The residual weighs short waves, so the error of positions may be larger or smaller. It ignores a contact that
    nothing touches, and a negative mass that a spring outweighs.
    """

    residual: Tensor
    energy: Tensor
    iterations: Tensor
    restarts: Tensor
    converged: Tensor
    rho: Tensor
    inverted: Tensor = torch.tensor(-1)  # for older files, which lack it and the next
    contact_gap: Tensor = torch.tensor(math.inf)
    contact_overflow: Tensor = torch.tensor(0)
    held_back: Tensor = torch.tensor(0.0)
    contact_pairs: Tensor = torch.tensor(0)
    contact_searches: Tensor = torch.tensor(0)
    contact_frozen: Tensor = torch.tensor(0)

    @classmethod
    def from_rows(cls, rows: Tensor) -> Info:
        """Build it from float64 rows of a step [..., 7], with `Contact` [..., 13]; older files have 6 or 10 columns."""
        residual, energy, _, _, converged, rho, *counted = rows.unbind(-1)
        # one pass for all columns; what it makes of those that are no whole numbers is not read
        _, _, iterations, restarts, _, _, *whole = rows.long().unbind(-1)
        inverted = whole[0] if whole else torch.full_like(iterations, -1)
        of_step = residual, energy, iterations, restarts, converged.bool(), rho, inverted
        if len(counted) >= 7:
            return cls(*of_step, counted[1], whole[2], counted[3], *whole[4:])
        none = torch.zeros_like(iterations)  # one operation for all counts
        if len(counted) >= 4:
            return cls(*of_step, counted[1], whole[2], counted[3], none, none, none)
        return cls(*of_step, torch.full_like(rho, math.inf), none, torch.zeros_like(rho), none, none, none)

    def __repr__(self) -> str:
        try:
            worst = f"residual<={float(self.residual.max()):.2g}, iterations<={int(self.iterations.max())}"
        except RuntimeError:  # no values: an empty batch, a traced step, "meta"
            worst = ""
        return by_sizes(self, self.residual, "records", "batch", trailing=0, more=worst)


class StepCall(Protocol):
    """Types of a call of a simulator, for type checkers; `Simulator.forward` documents it."""

    @overload
    def __call__(
        self,
        state: _AnyState,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: Literal[False] = False,
    ) -> _AnyState: ...

    @overload
    def __call__(
        self,
        state: _AnyState,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        *,
        return_info: Literal[True],
    ) -> tuple[_AnyState, Info]: ...

    @overload
    def __call__(
        self,
        state: _AnyState,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: bool = False,
    ) -> _AnyState | tuple[_AnyState, Info]: ...


class Track(NamedTuple):
    """Recorded states of a rollout, without its start."""

    positions: Tensor  # [T, B, V, 3] m
    velocities: Tensor  # [T, B, V, 3] m/s
    info: Info  # [T, B], of the last step before each record

    def state(self, record: int = -1) -> State:
        """One record as a state to continue from."""
        return State(*_record(self, record, self.positions, self.velocities))

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "records", "batch", "vertices")


class HistoryTrack(NamedTuple):
    """Recorded states of a rollout of a scene with plastic solids or `Contact`, without its start."""

    positions: Tensor  # [T, B, V, 3] m
    velocities: Tensor  # [T, B, V, 3] m/s
    info: Info  # [T, B], of the last step before each record
    history: History | ContactHistory  # [T, B, ...]

    def state(self, record: int = -1) -> HistoryState:
        """One record as a state to continue from."""
        positions, velocities, *history = _record(self, record, self.positions, self.velocities, *self.history)
        return HistoryState(positions, velocities, history_of(history))

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "records", "batch", "vertices")


def _record(track: Track | HistoryTrack, record: int, *arrays: Tensor) -> list[Tensor]:
    try:
        return [array[record] for array in arrays]
    except IndexError:
        count = len(arrays[0])
        there = f"record must lie in {-count}..{count - 1}" if count else "the track has no record, steps // every is 0"
        raise IndexError(f"{type(track).__name__}.state: {there}, got {record}") from None


for _kind in (Info, State, Track, History, ContactHistory, HistoryState, HistoryTrack):
    # pickles name a class by its module: now torchpd, formerly torchpd.state
    _kind.__module__ = "torchpd"
    # allow-lists of torch.load and torch.export.save; these classes hold tensors and run nothing
    torch.serialization.add_safe_globals([_kind, (_kind, f"torchpd.state.{_kind.__name__}")])
    pytree._register_namedtuple(_kind, serialized_type_name=f"torchpd.{_kind.__name__}")
