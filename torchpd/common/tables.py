"""The tables that C++ declares, as Python sees them."""

from __future__ import annotations

from typing import Any, NamedTuple

from .. import _C

__all__ = [
    "DEVICE_PLAN_TABLE",
    "DEVICE_SIZES",
    "MATERIAL_TABLE",
    "MULTILEVEL_TABLE",
    "PLANES",
    "PLAN_TABLE",
    "SETTINGS_TABLE",
    "SPHERES",
    "MaterialRow",
    "PlanRow",
    "SettingRow",
]


class PlanRow(NamedTuple):
    """One line of csrc/views/cpu_plan.def, of multilevel.def, or of gpu_plan.def: a constant array."""

    name: str
    type: str
    width: int
    rows: str
    meaning: str


class MaterialRow(NamedTuple):
    """One line of csrc/views/material.def: an array that training may change."""

    name: str
    width: int
    rows: str
    meaning: str

    @property
    def dims(self) -> int:
        """Dimensions without a batch."""
        return (self.rows != "one") + (self.width > 1)


class SettingRow(NamedTuple):
    """One line of csrc/views/settings.def: a setting of a step."""

    name: str
    type: str  # in schemas: "int", "float" or "bool"
    usual: float
    contract: str  # what the error of an op says that it must
    meaning: str


def _columns(array: str) -> dict[str, Any]:
    """The place of each column in a row: a number, or a slice of several."""
    rows = [row for row in _C.material_columns() if row[0] == array]
    return {name: first if width == 1 else slice(first, first + width) for _, name, first, width, _ in rows}


PLAN_TABLE = tuple(PlanRow(*row) for row in _C.plan_table())
MULTILEVEL_TABLE = tuple(PlanRow(*row) for row in _C.multilevel_table())
DEVICE_PLAN_TABLE = tuple(PlanRow(*row) for row in _C.device_plan_table())
MATERIAL_TABLE = tuple(MaterialRow(*row) for row in _C.material_table())
SETTINGS_TABLE = tuple(SettingRow(*row) for row in _C.settings_table())
# where the columns of the material's arrays stand in their rows
PLANES, SPHERES = (_columns(array) for array in ("planes", "spheres"))
# numbers of a GPU plan's `sizes`: csrc/views/gpu_sizes.def
DEVICE_SIZES = tuple(_C.device_sizes())
