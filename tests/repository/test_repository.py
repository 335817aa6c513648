"""What the repository promises: one version, a documented public API, pins that match the declared dependencies."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from programs import ROOT
from setuptools import find_packages

import torchpd
from torchpd.common.packages import OPTIONAL, REQUIRED

PACKAGE_FILES = sorted((ROOT / "torchpd").rglob("*.py"))
PLACEHOLDERS = re.compile(r"\b(" + "|".join(["TO" + "DO", "FIX" + "ME", "raise NotImplemented" + "Error"]) + r")\b")
MOST_WORDS = 35  # of a sentence; 25 is the aim
TEXT_SUFFIXES = {".py", ".pyi", ".h", ".cuh", ".cpp", ".cu", ".inl", ".def", ".md", ".toml"}
TEXT_FOLDERS = ("torchpd", "csrc", "tests", "examples", "benchmarks", "tools")


def requirement_names(lines: list[str]) -> set[str]:
    """Distribution names of requirement lines, in the normal form of package indexes."""
    names = (re.match(r"[A-Za-z0-9._-]+", line) for line in lines)
    return {name.group().lower().replace("_", "-") for name in names if name}


def pinned(file: str) -> list[str]:
    lines = (ROOT / "requirements" / file).read_text(encoding="utf-8").splitlines()
    others = [line.removeprefix("-r ") for line in lines if line.startswith("-r ")]
    own = [line for line in lines if line and not line.startswith(("#", "-r "))]
    return [*own, *(line for other in others for line in pinned(other))]


def test_version_is_stated_once() -> None:
    assert torchpd.__version__ == importlib.metadata.version("torchpd")
    stated = re.compile(rf"(?<![\d.]){re.escape(torchpd.__version__)}(?![\d.])")
    sources = [*PACKAGE_FILES, ROOT / "setup.py", ROOT / "pyproject.toml", ROOT / "CITATION.cff"]
    assert [path.name for path in sources if stated.search(path.read_text(encoding="utf-8"))] == ["version.py"]


def test_public_names_exist_and_are_documented() -> None:
    for name in torchpd.__all__:
        value = getattr(torchpd, name)
        if inspect.isclass(value) or inspect.isroutine(value) or inspect.ismodule(value):
            assert value.__doc__, f"torchpd.{name} has no docstring"


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=lambda path: path.relative_to(ROOT / "torchpd").as_posix())
def test_module_is_documented_and_lists_its_names(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), f"{path.name} has no docstring"
    if path.stem == "__main__":
        return
    parts = path.relative_to(ROOT).with_suffix("").parts
    module = importlib.import_module(".".join(parts[: len(parts) - (path.stem == "__init__")]))
    assert [name for name in module.__all__ if not hasattr(module, name)] == []


def prose_of(source: str) -> Iterator[tuple[int, str]]:
    """Docstrings and comments with their lines; comments on lines below one another are one."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
            yield getattr(node, "lineno", 1), text
    for block in re.finditer(r"(?:^ *# .*\n)+|(?<=  )# .*$", source, re.MULTILINE):
        yield source.count("\n", 0, block.start()) + 1, re.sub(r"^ *# ", "", block.group(), flags=re.MULTILINE)


def sentences(text: str) -> Iterator[str]:
    """Sentences without numbers and signs. Code in backquotes is a word; an argument or a row of a table ends one."""
    text = re.sub(r"`[^`]*`", "code", text)
    text = re.sub(r"\n(?= {4}\S| {9,}\S|[A-Z]\w+:$)", "\n\n", text, flags=re.MULTILINE)
    for sentence in re.split(r"\n\n|(?<=[.!?])(?<!et al\.)\s", text):
        yield " ".join(word for word in sentence.split() if re.search("[A-Za-z]", word))


@pytest.mark.parametrize("path", PACKAGE_FILES, ids=lambda path: path.relative_to(ROOT / "torchpd").as_posix())
def test_docstrings_and_comments_have_short_sentences(path: Path) -> None:
    found = prose_of(path.read_text(encoding="utf-8"))
    long = [(line, one) for line, text in found for one in sentences(text) if len(one.split()) > MOST_WORDS]
    assert long == []


def test_every_package_is_installed() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found = re.search(r"^\[tool\.setuptools\.packages\.find\]\ninclude = (.*)$", text, re.MULTILINE)
    assert found is not None
    there = {".".join(path.parent.relative_to(ROOT).parts) for path in PACKAGE_FILES}
    assert set(find_packages(str(ROOT), include=ast.literal_eval(found.group(1)))) == there


def test_types_of_the_extension_name_what_it_has() -> None:
    stub = ast.parse((ROOT / "torchpd" / "_C.pyi").read_text(encoding="utf-8"))
    extension = importlib.import_module("torchpd._C")
    functions = {node.name for node in stub.body if isinstance(node, ast.FunctionDef)}
    numbers = {ast.unparse(node.target) for node in stub.body if isinstance(node, ast.AnnAssign)}
    assert functions | numbers == {name for name in vars(extension) if not name.startswith("_")}


def test_every_declared_dependency_is_pinned() -> None:
    declared = importlib.metadata.requires("torchpd") or []
    wanted = [line for line in declared if "extra == 'tetwild'" not in line.replace('"', "'")]
    missing = requirement_names(wanted) - requirement_names(pinned("dev.txt")) - {"torchpd"}
    assert missing == set()


def test_the_doctor_looks_for_every_declared_dependency() -> None:
    declared = importlib.metadata.requires("torchpd") or []
    ours = {package.pip_name for package in (*REQUIRED, *OPTIONAL)}
    wanted = [line for line in declared if "extra == 'dev'" not in line.replace('"', "'")]
    assert requirement_names(wanted) == ours


@pytest.mark.parametrize("file", ["dev.txt", "lock.txt"])
def test_requirements_are_exact_and_fit_any_build_of_torch(file: str) -> None:
    for line in pinned(file):
        version = re.fullmatch(
            r"[A-Za-z0-9-]+==(\S+)( ; (python_version (<|>=) \"3\.11\"|platform_machine != \"aarch64\"))?", line
        )
        assert version, f"{file}: {line}"
        assert "+" not in version.group(1), f"{file}: {line} names one build, which other machines may not have"


def test_nothing_is_left_unfinished() -> None:
    files = [path for folder in TEXT_FOLDERS for path in (ROOT / folder).glob("**/*")]
    texts = [path for path in files if path.suffix in TEXT_SUFFIXES]
    assert texts
    found = [str(path.relative_to(ROOT)) for path in texts if PLACEHOLDERS.search(path.read_text(encoding="utf-8"))]
    assert found == []


PROSE = sorted(
    str(path.relative_to(ROOT)) for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("benchmarks/*.md"))
)


@pytest.mark.parametrize("file", PROSE)
def test_links_lead_somewhere(file: str) -> None:
    """To files that are there, and to headings of Markdown."""
    text = (ROOT / file).read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        name, _, heading = link.partition("#")
        target = (ROOT / file).parent / name if name else ROOT / file
        assert target.exists(), link
        if heading:
            titles = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", title).lower().replace(" ", "-") for title in titles}
            assert heading in anchors, link


@pytest.mark.parametrize("file", PROSE)
def test_prose_is_wrapped(file: str) -> None:
    """At 120 columns, as code is; tables, and words longer than that, cannot be."""
    prose = re.sub(r"```.*?```", "", (ROOT / file).read_text(encoding="utf-8"), flags=re.DOTALL).splitlines()
    long = [line for line in prose if len(line) > 120 and not line.startswith("|") and " " in line.strip()[:120]]
    assert [line[:60] for line in long if not re.match(r"!?\[", line)] == []


def test_execution_headers_know_no_torch_and_no_cuda() -> None:
    foreign = re.compile(r'#include\s*[<"](torch|ATen|c10|cuda|cub|pybind11)')
    headers = [
        path
        for folder in ("math", "views", "elements", "contact", "solver", "freeform")
        for path in (ROOT / "csrc" / folder).glob("**/*.h")
        if not {"binding", "cuda"} & set(path.parts)
    ]
    assert headers
    assert [path.name for path in headers if foreign.search(path.read_text(encoding="utf-8"))] == []
