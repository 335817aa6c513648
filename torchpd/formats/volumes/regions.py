"""Which array of the cells of a file holds their regions."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["choose"]

# Names that are known to be those of regions, in lower case, the best first.
_KNOWN = [
    *("gmsh:physical", "medit:ref", "materialids", "material_ids", "materialid", "material", "region", "regions"),
    *("regionid", "region_id", "physicalids", "physical", "cellentityids", "elementblockids", "label", "labels"),
    *("part_id", "partid", "domain", "subdomain", "attribute", "attributes", "cell_tags", "gmsh:geometrical"),
]


def choose(names: Iterable[str], notes: list[str]) -> str | None:
    """Choose among the arrays of integers: one whose name is known, or else the only one; None where neither is.

    What was chosen by another name, or not chosen, is added to the notes.
    """
    found = sorted(names)
    known = [name for wanted in _KNOWN for name in found if name.lower() == wanted]
    if known:
        return known[0]
    if len(found) == 1:
        notes.append(f"regions are the array {found[0]!r}, the only one of the cells that holds integers")
        return found[0]
    if found:
        notes.append(f"no regions: several arrays of cells hold integers ({', '.join(found)})")
    return None
