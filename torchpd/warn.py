"""Warnings that point at the user's line."""

from __future__ import annotations

import sys
import traceback
import warnings
from types import FrameType

__all__ = ["SceneWarning", "TuningWarning", "warn_user"]

_NOT_USERS = (__package__, "torch", "")  # code that torch generates has no name


class SceneWarning(UserWarning):
    """A scene or a state that a step takes as it is, though it is hardly meant: overlaps, inverted elements."""


class TuningWarning(UserWarning):
    """The target of `Simulator.tune` cannot be reached, and the promise says what can; or rounding hides it."""


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn, naming the nearest line outside of torchpd and torch, or the caller's: autograd's threads have no other."""
    frames = enumerate(traceback.walk_stack(sys._getframe(1)), start=2)
    level = next((level for level, (frame, _) in frames if _is_users(frame)), 2)
    warnings.warn(message, category, stacklevel=level)


def _is_users(frame: FrameType) -> bool:
    name: str = frame.f_globals.get("__name__", "")
    return name.partition(".")[0] not in _NOT_USERS
