"""The layout of the repository: packages and folders know only those below them, and none is too long to read."""

from __future__ import annotations

import ast
import re
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

from programs import ROOT

# from the bottom
PACKAGES = (
    "common",
    "formats",
    "geometry",
    "scene",
    "ops",
    "plan",
    "estimate",
    "simulation",
    "reference",
    "baselines",
    "accuracy",
    "files",
    "viewing",
    "freeform",
    "api",
    "study",
    "cli",
)
FOLDERS = (
    "math",
    "threads",
    "views",
    "elements",
    "contact",
    "solver",
    "plan",
    "cpu",
    "cuda",
    "binding",
    "freeform",
)
MOST_FILES = 25

MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in (ROOT / "torchpd").rglob("*.py")
}


def imports_of(name: str) -> set[str]:
    """Modules of torchpd that a module imports, wherever in it."""
    path = MODULES[name]
    here = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            found |= {full if (full := f"{source}.{alias.name}") in MODULES else source for alias in node.names}
    return found & set(MODULES)


def package_of(name: str) -> str:
    return name.split(".")[1] if name.count(".") > 1 or MODULES[name].name == "__init__.py" else ""


def test_every_package_has_a_place() -> None:
    there = {path.parent.name for path in (ROOT / "torchpd").glob("*/__init__.py")}
    assert there == set(PACKAGES)
    assert {path.relative_to(ROOT / "csrc").parts[0] for path in (ROOT / "csrc").rglob("*.*")} == set(FOLDERS)


def test_packages_import_only_those_below() -> None:
    """The package itself, its names and its commands are above them all; its version and the extension are below."""
    inside = [name for name in MODULES if name != "torchpd" and package_of(name)]
    wrong = [
        f"{name} imports {other}"
        for name in inside
        for other in imports_of(name) - {"torchpd", "torchpd.version"}
        if not package_of(other) or PACKAGES.index(package_of(other)) > PACKAGES.index(package_of(name))
    ]
    assert wrong == []


def test_no_two_modules_import_each_other() -> None:
    TopologicalSorter({name: imports_of(name) - {"torchpd"} for name in MODULES}).prepare()


def test_headers_include_only_those_below() -> None:
    """`freeform` lies beside the simulator: its parts include what is below binding and cuda themselves."""
    wrong, foreign = [], []
    for path in (ROOT / "csrc").rglob("*.*"):
        folder, text = path.relative_to(ROOT / "csrc").parts[0], path.read_text(encoding="utf-8")
        above = {
            target for target in re.findall(r'#include "(\w+)/', text) if FOLDERS.index(target) > FOLDERS.index(folder)
        }
        wrong += [f"{path.relative_to(ROOT)} includes {target}/" for target in sorted(above)]
        runner = {"cuda", "binding"} & set(path.parts)
        if not runner and re.search(r'#include\s*[<"](torch|ATen|c10|cuda|cub|pybind11)[/_.]', text):
            foreign.append(str(path.relative_to(ROOT)))
    assert wrong == []
    assert foreign == []


def test_no_folder_is_too_long() -> None:
    files = [path for folder in ("torchpd", "csrc", "tests") for path in (ROOT / folder).rglob("*.*") if path.is_file()]
    sources = [path for path in files if path.suffix not in {".so", ".pyc"}]
    count = Counter(str(path.parent.relative_to(ROOT)) for path in sources)
    assert {folder: number for folder, number in count.items() if number > MOST_FILES} == {}


def test_names_of_test_modules_are_unique() -> None:
    names = Counter(path.name for path in Path(ROOT / "tests").rglob("test_*.py"))
    assert [name for name, number in names.items() if number > 1] == []
