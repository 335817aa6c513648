"""The tables that C++ declares, as Python sees them."""

from __future__ import annotations

from typing import NamedTuple

from . import _C

__all__ = [
    "DEVICE_PLAN_TABLE",
    "DEVICE_SIZES",
    "MATERIAL_TABLE",
    "MULTILEVEL_TABLE",
    "PLAN_TABLE",
    "MaterialRow",
    "PlanRow",
]


class PlanRow(NamedTuple):
    """One line of csrc/plan/plan.def, of multilevel.def, or of device.def: a constant array."""

    name: str
    type: str
    width: int
    rows: str
    meaning: str


class MaterialRow(NamedTuple):
    """One line of csrc/plan/material.def: an array that training may change."""

    name: str
    width: int
    rows: str
    meaning: str

    @property
    def dims(self) -> int:
        """Dimensions without a batch."""
        return (self.rows != "one") + (self.width > 1)


PLAN_TABLE = tuple(PlanRow(*row) for row in _C.plan_table())
MULTILEVEL_TABLE = tuple(PlanRow(*row) for row in _C.multilevel_table())
DEVICE_PLAN_TABLE = tuple(PlanRow(*row) for row in _C.device_plan_table())
MATERIAL_TABLE = tuple(MaterialRow(*row) for row in _C.material_table())
# numbers of a GPU plan's `sizes`: csrc/plan/device_sizes.def
DEVICE_SIZES = tuple(_C.device_sizes())
