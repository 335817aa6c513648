"""Choice of the cell array that holds the regions of a file."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

__all__ = ["can_hold_regions", "choose_regions"]

# usual names of region arrays, in lower case, the best first
_KNOWN = [
    *("gmsh:physical", "medit:ref", "materialids", "material_ids", "materialid", "material", "region", "regions"),
    *("regionid", "region_id", "physicalids", "physical", "cellentityids", "elementblockids", "label", "labels"),
    *("part_id", "partid", "domain", "subdomain", "attribute", "attributes", "cell_tags", "gmsh:geometrical"),
]


def can_hold_regions(name: str, values: Any) -> bool:
    """Whether an array holds a whole number per cell: integers, or reals under a usual name."""
    array = np.asarray(values)
    if array.size != len(array) or array.dtype.kind not in "iuf":
        return False
    real = array.dtype.kind == "f"
    return not real or (name.lower() in _KNOWN and bool(((array == np.rint(array)) & (np.abs(array) < 2.0**53)).all()))


def choose_regions(names: Iterable[str], notes: list[str]) -> str | None:
    """Name of the region array among the candidates: one with a usual name, or else the only one; None otherwise.

    A choice without a usual name, or no choice, is added to the notes.
    """
    found = sorted(names)
    known = [name for wanted in _KNOWN for name in found if name.lower() == wanted]
    if known:
        return known[0]
    if len(found) == 1:
        notes.append(f"regions are the array {found[0]!r}, the only integer array of the cells")
        return found[0]
    if found:
        notes.append(f"no regions: several cell arrays hold integers ({', '.join(found)})")
    return None
