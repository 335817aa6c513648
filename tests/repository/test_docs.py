"""README.md and docs/: every block of Python runs as copied, what they name exists, and sentences are short."""

from __future__ import annotations

import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from devices import missing_gpu

ROOT = Path(__file__).resolve().parents[2]
FILES = [
    "README.md",
    "benchmarks/README.md",
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/*.md")),
]
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# what a block may need beside a CPU; where it is missing the block is only compiled
NEEDS = {"python": "", "python gpu": missing_gpu(), "python ranks": "several processes"}


def text_of(file: str) -> str:
    return (ROOT / file).read_text(encoding="utf-8")


def blocks(file: str) -> list[tuple[str, str]]:
    """What each block of Python needs, and the block."""
    return [(mark, block) for mark, block in FENCE.findall(text_of(file)) if mark]


def sentences(text: str) -> Iterator[str]:
    """Of paragraphs, list items, headings and cells of tables, without code."""
    text = FENCE.sub("\n\n", text)
    text = re.sub(r"`[^`]+`", "code", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"^(\s*(?:[-*] |\||#+ |\d+\. ))", r"\n\n\1", text, flags=re.MULTILINE)
    for paragraph in re.split(r"\n\s*\n|\|", text):
        yield from re.split(r"(?<=[.!?])\s+", " ".join(paragraph.split()))


@pytest.mark.parametrize("file", [file for file in FILES if blocks(file)])
def test_blocks_run(file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after another, in an empty folder; finite numbers come out."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    values: dict[str, Any] = {}
    for mark, block in blocks(file):
        code = compile(block, file, "exec")
        if not NEEDS[mark]:
            exec(code, values)
    tensors = [value for value in values.values() if isinstance(value, torch.Tensor)]
    assert all(bool(tensor.isfinite().all()) for tensor in tensors)


def test_readme_fits_its_limits() -> None:
    text = text_of("README.md")
    assert len(text.splitlines()) <= 120
    assert len(text.split()) <= 900
    ((_, block),) = blocks("README.md")
    assert len([line for line in block.splitlines() if line]) <= 20


@pytest.mark.parametrize("file", FILES)
def test_sentences_are_short(file: str) -> None:
    long = [
        sentence
        for sentence in sentences(text_of(file))
        if sum(bool(re.search(r"\w", word)) for word in sentence.split()) > 35
    ]
    assert long == []


@pytest.mark.parametrize("file", FILES)
def test_what_is_named_exists(file: str) -> None:
    """Files from the root of the repository, and names of torchpd, also under its short name."""
    text = text_of(file)
    paths = re.findall(r"(?<![\w/.])(?:torchpd|csrc|tests|examples|benchmarks|tools|docs)/[\w/.-]*\.\w+", text)
    assert [path for path in paths if not (ROOT / path).is_file()] == []
    for name in re.findall(r"(?<![\w./])(?:torchpd|tpd)((?:\.[A-Za-z_]\w*)+)", text):
        pkgutil.resolve_name("torchpd" + name)


def test_docs_import_by_the_short_name() -> None:
    files = [*FILES, *(path.relative_to(ROOT).as_posix() for path in ROOT.glob("examples/*.py"))]
    assert [file for file in files if re.search(r"torchpd as (?!tpd\b)|\bpd\.", text_of(file))] == []


def test_figure_has_every_method_and_the_default(tmp_path: Path) -> None:
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        import figures
    finally:
        sys.path.pop(0)
    drawn = figures.curves()
    assert all(len(points) > 3 for points in drawn.values())
    assert [default for points in drawn.values() for *_, default in points].count(True) == 1
    figures.draw(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000
