"""Where files of former versions find `State`, `Info` and `Track`."""

from .simulation.state import Info, State, Track

__all__ = ["Info", "State", "Track"]
