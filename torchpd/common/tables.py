"""Python view of the tables that C++ declares."""

from __future__ import annotations

from typing import Any, NamedTuple

from .. import _C

__all__ = [
    "DEVICE_PLAN_TABLE",
    "DEVICE_SIZES",
    "DEVICE_STENCIL_TABLE",
    "EFFECT_ROWS",
    "HISTORY_ROWS",
    "KINDS",
    "MATERIAL_TABLE",
    "MULTILEVEL_TABLE",
    "PLANES",
    "PLAN_TABLE",
    "ROW_SIZES",
    "SETTINGS_TABLE",
    "SPHERES",
    "STENCIL_TABLE",
    "Kind",
    "MaterialRow",
    "PlanRow",
    "SettingRow",
]


class PlanRow(NamedTuple):
    """A row of csrc/views/cpu_plan.def, gpu_plan.def, their stencils, or multilevel.def: a constant array."""

    name: str
    type: str
    width: int
    rows: str
    meaning: str


class MaterialRow(NamedTuple):
    """A row of csrc/views/material.def: a trainable array."""

    name: str
    width: int
    rows: str
    meaning: str
    effect: bool  # whether only some scenes have it
    history: bool = False  # whether a step leaves it for the next one, as a part of the state

    @property
    def dims(self) -> int:
        """Number of dimensions without a batch."""
        return (self.rows != "one") + (self.width > 1)


class Kind(NamedTuple):
    """A row of csrc/elements/kinds.def: a kind of stencils."""

    name: str
    corners: int  # n
    columns: int  # d, columns of F
    constants: int  # further constants of a stencil
    rows: tuple[str, ...]  # names of its arrays in the material
    meaning: str
    quadratic: int  # its first arrays that make a quadratic energy where a scene lacks the others; 0: none do
    on_gpu: bool  # whether a GPU has kernels for it

    @property
    def of_tets(self) -> bool:
        """Whether these arrays have a row for every tetrahedron, so that the kind has none of its own."""
        return any(row.name == self.rows[0] and row.rows == "tet" for row in MATERIAL_TABLE)

    @property
    def own_rows(self) -> tuple[str, ...]:
        """Names of the arrays that have a row for each of its stencils."""
        return () if self.of_tets else self.rows


class SettingRow(NamedTuple):
    """A row of csrc/views/settings.def: a setting of a step."""

    name: str
    type: str  # schema type: "int", "float" or "bool"
    usual: float
    contract: str  # contract, for the error of an op
    meaning: str


def _columns(array: str) -> dict[str, Any]:
    """Place of each column in a row: a number, or a slice for several."""
    rows = [row for row in _C.material_columns() if row[0] == array]
    return {name: first if width == 1 else slice(first, first + width) for _, name, first, width, _ in rows}


PLAN_TABLE = tuple(PlanRow(*row) for row in _C.plan_table())
MULTILEVEL_TABLE = tuple(PlanRow(*row) for row in _C.multilevel_table())
STENCIL_TABLE = tuple(PlanRow(*row) for row in _C.stencil_table())
DEVICE_PLAN_TABLE = tuple(PlanRow(*row) for row in _C.device_plan_table())
DEVICE_STENCIL_TABLE = tuple(PlanRow(*row) for row in _C.device_stencil_table())
MATERIAL_TABLE = tuple(MaterialRow(*row) for row in _C.material_table())
# arrays of the material that only some scenes have; they follow the others
EFFECT_ROWS = tuple(row for row in MATERIAL_TABLE if row.effect)
# those of them that are a part of the state
HISTORY_ROWS = tuple(row for row in MATERIAL_TABLE if row.history)
KINDS = {row.name: row for row in (Kind(*row) for row in _C.kind_table())}
SETTINGS_TABLE = tuple(SettingRow(*row) for row in _C.settings_table())
# columns of the material arrays
PLANES, SPHERES = (_columns(array) for array in ("planes", "spheres"))
# names of the `sizes` of a GPU plan: csrc/views/gpu_sizes.def
DEVICE_SIZES = tuple(_C.device_sizes())
# places of some counts in its `row_sizes`
ROW_SIZES = _C.row_sizes()
