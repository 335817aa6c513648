"""Scripts of the repository, run without a process of their own."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from programs import ROOT


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Does what `python FILE WORDS` does, and returns what is printed; another process would import torch again."""

    def run(file: str, *words: str) -> str:
        monkeypatch.chdir(ROOT)
        monkeypatch.syspath_prepend(str(ROOT / Path(file).parent))
        monkeypatch.setattr(sys, "argv", [file, *words])
        threads = torch.get_num_threads()
        capsys.readouterr()
        try:
            runpy.run_path(str(ROOT / file), run_name="__main__")
        finally:
            torch.set_num_threads(threads)
        return capsys.readouterr().out

    return run


@pytest.fixture
def on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """The benchmarks are scripts, which find each other in their folder."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
