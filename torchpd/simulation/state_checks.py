"""Checks of a simulator's settings and states."""

from __future__ import annotations

import math
from functools import reduce
from itertools import combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.checks import check_like, check_whole, expand_shared, to_full_precision
from ..common.memory import chunks
from ..common.warn import warn_user
from ..scene.scene import Scene
from .state import ContactHistory, History, HistoryState, State, history_of

__all__ = [
    "ADJOINTS",
    "check_adjoint",
    "check_batch",
    "check_info",
    "check_overwritten",
    "check_positive_number",
    "check_state",
    "check_time_step",
    "check_tolerance",
    "positions_of",
    "report_resolution",
]


Array = NDArray[np.float64]
Index = NDArray[np.int64]

ADJOINTS = ("solver", "multilevel")  # preconditioners of the adjoint of a step
_COARSEST = 1e-4  # largest spacing of float32 positions, in shortest edges, without a warning
_LONGEST_STEP = {torch.float32: 1e12, torch.float64: 1e100}  # s


def check_adjoint(adjoint: str) -> str:
    """Check the preconditioner of gradients, one of `ADJOINTS`."""
    if adjoint not in ADJOINTS:
        names = " or ".join(f'"{name}"' for name in ADJOINTS)
        raise ValueError(f"Simulator: adjoint must be {names}, got {adjoint!r}")
    return adjoint


def check_batch(batch: int | None) -> int | None:
    """Check the expected environments of a step."""
    return None if batch is None else check_whole("batch", batch, minimum=1)


def report_resolution(scene: Scene, dtype: torch.dtype) -> None:
    """Warn of elements so far from the origin that float32 spacing exceeds 1e-4 of their shortest edge.

    Rest shapes are compiled in float64, so rounded positions have strains of that size, which push a body at rest.
    """
    if dtype != torch.float32:
        return
    coarse = np.concatenate([_coarse_elements(body.mesh.vertices, body.elements) for body in scene.bodies])
    if len(coarse):
        step, shortest, farthest = coarse[coarse[:, 0].argmax()]
        element, elements = ("a tet", "tets") if len(scene.solids) == len(scene.bodies) else ("an element", "elements")
        count = sum(len(body.elements) for body in scene.bodies)
        warn_user(
            f"Simulator: {farthest:.4g} m from the origin float32 resolves positions to {step * shortest:.2g} m, "
            f"{step:.2g} of the shortest edge of {element} there ({len(coarse)} of {count} {elements} have more than "
            f"{_COARSEST:g}), so bodies at rest will move. Move the scene to the origin with mesh.translated(...), or "
            "pass dtype=torch.float64"
        )


def _coarse_elements(points: Array, elements: Index) -> Array:
    """Rows [n, 3] of the elements with a float32 spacing above _COARSEST.

    The spacing in shortest edges, the shortest edge, and the largest coordinate [m].
    """
    reach, found = np.abs(points).max(axis=1), []
    for some in chunks(len(elements)):
        columns = elements[some].T
        edges = (one - other for one, other in combinations([points[column] for column in columns], 2))
        shortest = np.sqrt(reduce(np.minimum, (np.einsum("ij,ij->i", edge, edge) for edge in edges)))
        farthest = reduce(np.maximum, (reach[column] for column in columns))
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows has no resolution
            step = np.nan_to_num(np.spacing(farthest.astype(np.float32)) / shortest, nan=np.inf)
        is_coarse = step > _COARSEST
        found.append(np.stack([step, shortest, farthest], axis=1)[is_coarse])
    return np.concatenate(found)


def check_positive_number(name: str, value: float, unit: str) -> float:
    """Check a number of any numeric type, and return a float."""
    number = _number_or_nan(value)
    if not 0.0 < number < float("inf"):
        raise ValueError(f"{name} must be positive and finite [{unit}], got {value!r}")
    return number


def check_time_step(time_step: float, dtype: torch.dtype) -> float:
    """Check h [s]: h^2 and 1 / h^2 times masses must be finite in that precision, too."""
    number = check_positive_number("time_step", time_step, "s")
    longest = _LONGEST_STEP[torch.float64 if dtype == torch.float64 else torch.float32]
    if not 1.0 / longest <= number <= longest:
        raise ValueError(
            f"time_step must lie within {1.0 / longest:g} and {longest:g} [s] in {dtype}, got {time_step!r}"
        )
    return number


def check_tolerance(tolerance: float) -> float:
    """Check a tolerance of any numeric type, and return a float."""
    number = _number_or_nan(tolerance)
    if not 0.0 <= number < 1.0:
        raise ValueError(f"Simulator: tolerance must lie in [0, 1), got {tolerance!r}")
    return number


def _number_or_nan(value: Any) -> float:
    try:
        no_number = isinstance(value, (str, bool, np.bool_)) or getattr(value, "dtype", None) == torch.bool
        return math.nan if no_number else float(value)
    except (TypeError, ValueError):
        return math.nan


def check_state(
    rest: Tensor,
    state: State | HistoryState,
    history: History | ContactHistory | None,
    *,
    forces: Tensor | None,
    fix: str,
    grows: bool,
) -> Tensor | None:
    """Implementation of `Model.check_state`, by the rest positions [V, 3] and history [n, ...] of a simulator.

    A history may have room for fewer pairs than the simulator. `grows`: also for more.
    """
    if not _is_state(state, history):
        raise TypeError(
            f"state must be {_wanted(history)}, positions and velocities [B, {len(rest)}, 3], got "
            f"{_kind_of(state)}; rest_state() makes one"
        )
    _check_kind(rest, "state", state[0])
    if state[0].dim() == 0:  # the batch is read before an op checks the shape
        raise ValueError(f"positions must be [B, {len(rest)}, 3], got []")
    check_like("velocities", state[1], state[0], "m/s")
    _check_history(state, history, grows)
    if forces is None:
        return None
    forces = expand_shared(to_full_precision(forces, state[0]), state[0].shape)
    check_like("forces", forces, state[0], "N", fix=fix)
    return forces


def check_info(info: Tensor, shape: tuple[int, int]) -> None:
    """Check rows for the report of a step with `Contact`, which Python fills in."""
    if info.shape != shape or info.dtype != torch.float64:
        raise ValueError(
            f"step_: info must be float64 {list(shape)} in a scene with Contact, got {info.dtype} {list(info.shape)}"
        )


def check_overwritten(keys: Tensor, capacity: int) -> None:
    """Check that the history of a state to overwrite has room for the pairs of a step."""
    if keys.shape[-1] < capacity:
        raise ValueError(
            f"step_: history.keys must have room for {capacity} pairs, the capacity of Contact, got "
            f"{list(keys.shape)}; call the simulator, whose next state has that room"
        )


def positions_of(
    rest: Tensor, state: State | HistoryState | Tensor, history: History | ContactHistory | None, name: str, grows: bool
) -> Tensor:
    """Implementation of `Model.positions_of`, by the rest positions [V, 3] and history [n, ...] of a simulator."""
    alone = isinstance(state, Tensor)
    if not (alone or _is_state(state, history)):
        raise TypeError(
            f"{name} must be {_wanted(history)}, positions and velocities [B, {len(rest)}, 3], or positions alone, got "
            f"{_kind_of(state)}"
        )
    positions = state if isinstance(state, Tensor) else state[0]
    _check_kind(rest, name, positions)
    if positions.dim() != 3 or positions.shape[1:] != rest.shape:
        raise ValueError(f"{name} must be [B, {len(rest)}, 3], got {list(positions.shape)}")
    if not isinstance(state, Tensor):
        check_like("velocities", state[1], positions, "m/s")
        _check_history(state, history, grows)
    return positions


def _check_history(state: State | HistoryState, history: History | ContactHistory | None, grows: bool) -> None:
    if history is None:
        return
    given = history_of(state[2])  # type: ignore[misc]
    if isinstance(history, ContactHistory) and isinstance(given, ContactHistory) and given.keys.dim() == 2:
        width, room = given.keys.shape[1], history.keys.shape[-1]
        if width > room and not grows:
            raise ValueError(
                f"history.keys must have room for at most {room} pairs, the capacity of Contact, got "
                f"{list(given.keys.shape)}; make the scene with Contact(capacity={width}), or take the history of "
                "rest_state()"
            )
        history = history._replace(keys=history.keys[:1].expand(width), forces=history.forces[:1].expand(width, 4))
    for name, own, array in zip(history._fields, history, given, strict=True):
        _check_kind(own, f"history.{name}", array)
        shape = (len(state[0]), *own.shape[-(1 if name == "keys" else 2) :])
        if array.shape != shape:
            raise ValueError(f"history.{name} must be {list(shape)}, as rest_state() has it, got {list(array.shape)}")


def _check_kind(own: Tensor, name: str, positions: Tensor) -> None:
    if positions.dtype != own.dtype or positions.device != own.device:
        raise TypeError(
            f"{name} must be {own.dtype} on {own.device} like the simulator, got {positions.dtype} on "
            f"{positions.device}; sim.to(...) changes the simulator"
        )


def _wanted(history: History | ContactHistory | None) -> str:
    if history is None:
        return "a State"
    return f"a HistoryState, in a scene with {'plastic solids' if isinstance(history, History) else 'Contact'}"


def _is_state(state: Any, history: History | ContactHistory | None) -> bool:
    count = 2 if history is None else 3
    if not (isinstance(state, (tuple, list)) and len(state) == count):
        return False
    own = history is None or (
        isinstance(state[2], (tuple, list))
        and len(state[2]) == len(history)
        and all(isinstance(array, Tensor) for array in state[2])
    )
    return own and isinstance(state[0], Tensor) and isinstance(state[1], Tensor)


def _kind_of(value: object) -> str:
    """Name of a type; for a tuple also the types of its parts."""
    name = type(value).__name__
    return f"{name} of {' and '.join(type(part).__name__ for part in value)}" if isinstance(value, tuple) else name
