"""What goes into a step and what comes out: named tuples of tensors, so they are pytrees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, overload

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from .reprs import by_sizes

if TYPE_CHECKING:
    from .targets import Targets

__all__ = ["Info", "State", "StepCall", "Track"]


class State(NamedTuple):
    """Where everything is and how fast it moves, vertices in the user's order, bodies one after another.

    `torch.save` takes it, alone or in a checkpoint, and `torch.load` gives it back where torchpd is imported.
    """

    positions: Tensor  # [B, V, 3] m
    velocities: Tensor  # [B, V, 3] m/s

    def to(self, *args: Any, **kwargs: Any) -> State:
        """The same on another device or in another precision, as `Tensor.to`."""
        return State(self.positions.to(*args, **kwargs), self.velocities.to(*args, **kwargs))

    def clone(self) -> State:
        """A copy that `step_` may overwrite, as `Tensor.clone`, but contiguous."""
        dense = torch.contiguous_format
        return State(self.positions.clone(memory_format=dense), self.velocities.clone(memory_format=dense))

    def where(self, condition: Tensor, other: State) -> State:
        """Environments of this state where `condition` [B] holds, of another one elsewhere: resets of some.

        The other state has as many environments, or one for all.
        """
        if not isinstance(condition, Tensor):
            raise TypeError(f"State.where: condition must be a bool tensor, got {type(condition).__name__}")
        if condition.dtype != torch.bool or condition.shape != self.positions.shape[:1]:
            raise ValueError(
                f"State.where: condition must be bool [{len(self.positions)}], one for each environment, got "
                f"{condition.dtype} {list(condition.shape)}"
            )
        self._check_other(other)
        chosen = condition[:, None, None]
        pairs = zip(self, other, strict=True)
        return State(*(torch.where(chosen, mine, theirs) for mine, theirs in pairs))

    def _check_other(self, other: Any) -> None:
        if not isinstance(other, (tuple, list)) or len(other) != 2:
            raise TypeError(f"State.where: other must be a State, got {type(other).__name__}")
        for name, mine, theirs in zip(self._fields, self, other, strict=True):
            if theirs.dtype != mine.dtype or theirs.device != mine.device:
                raise TypeError(
                    f"State.where: other must have {name} {mine.dtype} on {mine.device}, got {theirs.dtype} on "
                    f"{theirs.device}"
                )
            if theirs.shape not in (mine.shape, (1, *mine.shape[1:])):
                raise ValueError(
                    f"State.where: other must have {name} {list(mine.shape)}, or those of one environment, got "
                    f"{list(theirs.shape)}"
                )

    def detach(self) -> State:
        """The same numbers without their history, as `Tensor.detach`."""
        return State(self.positions.detach(), self.velocities.detach())

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "batch", "vertices")


class Info(NamedTuple):
    """How the solve of a step went, per environment [B] (of a rollout [T, B]). Reading it on a GPU waits for it.

    Nothing here has a gradient: for one of an energy there is `Simulator.energy`, of the state that the step reached.

    Attributes:
        residual: the share of the step's forces that nothing balances, from 0 (solved, to rounding) to 1. It is
            (|r| - 4 eps |S x|)+ / max(|r|, sqrt(sum |f_i|^2 + |e_i|^2)): r is the part of grad E [N] that neither pins
            nor contacts balance, f_i = a_i (u_i - s_i) the force of inertia, weight and springs on vertex i, and e_i
            that of its elements. S x is every stiffness times position (csrc/solver/report.h), so that 4 eps |S x|
            bounds the rounding that no iterations remove. Where all forces are smaller than that, the residual is 0
            and tells nothing: in float32 a bar of 0.5 m and 100 MPa that starts to sag reads 0 at any number of
            iterations. Take float64 there. Residuals weigh short waves, so the error of positions may be larger or
            smaller. NaN unless it was asked for (`return_info`), and where state or material that the step uses are
            not finite or negative. A contact that nothing touches is not used; a negative mass that a spring outweighs
            does not show.
        energy: the objective E at the last iterate [J], elastic energy and m / (2 h^2) |x - y|^2: what a solve lowers.
            Not the mechanical energy, which `Simulator.energy` gives. NaN unless asked for.
        iterations: that were used.
        restarts: of the acceleration, because the energy rose. Of `Multilevel` trials that were taken back.
        converged: whether the error was judged to be within `Simulator.tolerance` before the iterations ran out; False
            without a tolerance. It is an error of positions, relative to the way that elasticity and contacts take
            them, so it may be there while the residual is large.
        rho: spectral radius that the schedule used. Of `Multilevel` 1 - q / s, where q A_0 <= A <= s A_0 and M was made
            of A_0: 0 where M fits, near 1 where it does not (`Simulator.prepare_solver` makes it anew).
        inverted: tetrahedra with det F <= 0 at the end of the step, turned inside out or flat. A body may come to rest
            with some, converged, in a folded minimum of its energy. -1 unless asked for.
    """

    residual: Tensor
    energy: Tensor
    iterations: Tensor
    restarts: Tensor
    converged: Tensor
    rho: Tensor
    inverted: Tensor = torch.tensor(-1)  # of files from before it was counted

    @classmethod
    def from_rows(cls, rows: Tensor) -> Info:
        """From the rows [..., 7] that the ops return, or those of 6 columns from before `inverted`."""
        residual, energy, iterations, restarts, converged, rho, *counted = rows.unbind(-1)
        inverted = counted[0] if counted else torch.full_like(rho, -1.0)
        return cls(residual, energy, iterations.long(), restarts.long(), converged.bool(), rho, inverted.long())

    def __repr__(self) -> str:
        try:
            worst = f"residual<={float(self.residual.max()):.2g}, iterations<={int(self.iterations.max())}"
        except RuntimeError:  # no values: an empty batch, a traced step, "meta"
            worst = ""
        return by_sizes(self, self.residual, "records", "batch", trailing=0, more=worst)


class StepCall(Protocol):
    """The types of a call of a simulator, which `torch.nn.Module` does not know; `Simulator.forward` documents it."""

    @overload
    def __call__(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: Literal[False] = False,
    ) -> State: ...

    @overload
    def __call__(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        *,
        return_info: Literal[True],
    ) -> tuple[State, Info]: ...

    @overload
    def __call__(
        self,
        state: State,
        forces: Tensor | None = None,
        targets: Targets | None = None,
        start: str | Tensor = "velocity",
        return_info: bool = False,
    ) -> State | tuple[State, Info]: ...


class Track(NamedTuple):
    """States along a rollout; the start is not among them."""

    positions: Tensor  # [T, B, V, 3] m
    velocities: Tensor  # [T, B, V, 3] m/s
    info: Info  # [T, B], of the last step before each record

    def state(self, record: int = -1) -> State:
        """One record as a state to go on from."""
        try:
            return State(self.positions[record], self.velocities[record])
        except IndexError:
            count = len(self.positions)
            there = (
                f"record must lie in {-count}..{count - 1}" if count else "the track has no record, steps // every is 0"
            )
            raise IndexError(f"Track.state: {there}, got {record}") from None

    def __repr__(self) -> str:
        return by_sizes(self, self.positions, "records", "batch", "vertices")


for _kind in (Info, State, Track):
    # files name a class by its module: the package, and in files of before torchpd.state
    _kind.__module__ = "torchpd"
    # torch.load refuses other classes, and torch.export.save wants names of them; these hold tensors and run nothing
    torch.serialization.add_safe_globals([_kind, (_kind, f"torchpd.state.{_kind.__name__}")])
    pytree._register_namedtuple(_kind, serialized_type_name=f"torchpd.{_kind.__name__}")
