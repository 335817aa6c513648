"""Abaqus' .inp: nodes, elements and element sets of all parts, at the places of their instances.

Format: Abaqus Keywords Reference, *NODE, *ELEMENT, *ELSET, *PART, *INSTANCE. CalculiX writes the same without parts.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from ..content import MeshContent
from ..numbers import text_of
from . import avs
from .abaqus_parts import Part, Place, content_of, fields_of, read_elements, read_nodes, read_set

__all__ = ["read"]

# keywords that generate or place nodes and elements in ways that are not read
_REFUSED = ("INCLUDE", "MANIFEST", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SUBSTRUCTURE GENERATE")


class Keyword(NamedTuple):
    """A keyword with its options, both in upper case, and the data lines after it."""

    name: str
    options: dict[str, str]
    lines: list[str]


def read(path: Path) -> MeshContent:
    """Read a file of Abaqus, or of AVS, which uses the same suffix."""
    text = text_of(path)
    if not any(line.startswith("*") for line in text.split("\n")):
        return avs.read(path)
    parts: dict[str, Part] = {"": Part("")}
    places: list[Place] = []
    part, notes = parts[""], list[str]()
    open_blocks = list[str]()
    joins = False  # in the assembly, outside of its instances
    for keyword in _keywords(text):
        name, options = keyword.name, keyword.options
        _refuse(keyword)
        if name in ("PART", "ASSEMBLY", "INSTANCE"):
            open_blocks.append(name)
        elif name.startswith("END ") and open_blocks[-1:] == [name[4:]]:
            open_blocks.pop()
        if name == "PART":
            part = parts.setdefault(options.get("NAME", "").upper(), Part(options.get("NAME", "")))
        elif name == "END PART":
            part = parts[""]
        elif name in ("ASSEMBLY", "END INSTANCE", "END ASSEMBLY"):
            part, joins = parts[""], name != "END ASSEMBLY"
        elif name == "INSTANCE":
            key = options.get("PART", "").upper()
            if key not in parts:
                raise ValueError(f"*INSTANCE names part {options.get('PART', '')!r}, which is not defined before it")
            places.append(Place.of(options.get("NAME", ""), parts[key], keyword.lines))
            part, joins = places[-1].part, False
        elif joins:
            notes += _of_assembly(keyword)
        elif name == "NODE":
            read_nodes(part, keyword.lines)
        elif name == "ELEMENT":
            read_elements(part, keyword.lines, options)
        elif name == "ELSET":
            read_set(part, keyword.lines, options)
        elif name == "SOLID SECTION":
            part.sections.append(options.get("ELSET", "").upper())
    if open_blocks:
        raise ValueError(f"*{open_blocks[-1]} has no *END {open_blocks[-1]}: the file was cut off")
    return content_of(list(parts.values()), places, notes)


def _of_assembly(keyword: Keyword) -> list[str]:
    """Notes on an omitted keyword of the assembly: its nodes are reference points of no body."""
    if keyword.name == "ELEMENT":
        kind = keyword.options.get("TYPE", "?")
        return [f"{len(keyword.lines)} lines of elements of type {kind}, which join instances, left out"]
    if keyword.name == "ELSET" and "INTERNAL" not in keyword.options:
        return [f"set {keyword.options.get('ELSET', '')!r} of the assembly left out"]
    return []


def _keywords(text: str) -> list[Keyword]:
    """Parse all keywords; a keyword line that ends with a comma continues in the next line."""
    found: list[Keyword] = []
    open_line = ""
    for raw in text.split("\n"):
        line = raw.strip()
        if not line or line.startswith("**"):
            continue
        if open_line or line.startswith("*"):
            open_line += line
            if open_line.endswith(","):
                continue
            head, *rest = fields_of(open_line)
            options = {}
            for field in rest:
                key, _, value = field.partition("=")
                options[" ".join(key.upper().split())] = value.strip().strip('"')
            found.append(Keyword(" ".join(head[1:].upper().split()), options, []))
            open_line = ""
        elif found:
            found[-1].lines.append(line)
        else:
            raise ValueError(f"it must begin with a keyword, got {line[:40]!r}")
    return found


def _refuse(keyword: Keyword) -> None:
    name, options = keyword.name, keyword.options
    if name in _REFUSED:
        listed = "".join(f", {key}={value}" for key, value in options.items())
        raise ValueError(f"*{name}{listed} is not read; write nodes and elements out in the file itself")
    if name in ("NODE", "ELEMENT") and "INPUT" in options:
        raise ValueError(f"*{name}, INPUT={options['INPUT']} names another file, which is not read; put it in")
    if name == "NODE" and options.get("SYSTEM", "R").upper() not in ("R", ""):
        raise ValueError(f"*NODE, SYSTEM={options['SYSTEM']} is not read; write Cartesian coordinates")
    if name == "SYSTEM" and any(line.strip(", ") for line in keyword.lines):
        raise ValueError("*SYSTEM, coordinates in a system of their own, is not read; write global coordinates")
    if name == "INSTANCE" and ("LIBRARY" in options or "INSTANCE" in options):
        raise ValueError("*INSTANCE from a library of results is not read; write its part out")
