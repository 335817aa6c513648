"""A build that cannot work says why in one sentence that names the remedy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def failure(*command: str, modules: Path | None = None, **environment: str) -> str:
    """What setup.py says when it fails; `modules` is looked into before the installed packages."""
    paths = {"PYTHONPATH": str(modules)} if modules else {}
    result = subprocess.run(
        [sys.executable, "setup.py", *command],
        cwd=ROOT,
        env={**os.environ, **paths, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("torchpd cannot be built: ")
    return last


def fake_module(folder: Path, name: str, text: str) -> Path:
    (folder / f"{name}.py").write_text(text, encoding="utf-8")
    return folder


def test_missing_torch(tmp_path: Path) -> None:
    sentence = failure("--version", modules=fake_module(tmp_path, "torch", "raise ImportError('no torch')"))
    assert "torch >= 2.11" in sentence
    assert "--no-build-isolation" in sentence


@pytest.mark.parametrize("version", ["1.13.1", "2.9.0+cu128", "2.10.2"])
def test_old_torch(tmp_path: Path, version: str) -> None:
    sentence = failure("--version", modules=fake_module(tmp_path, "torch", f"__version__ = '{version}'"))
    assert f"torch >= 2.11 is needed, but {version} is installed" in sentence


def test_old_python(tmp_path: Path) -> None:
    # Loaded by every python that starts with this folder on its path, before setup.py.
    modules = fake_module(tmp_path, "sitecustomize", "import sys; sys.version_info = (3, 9, 18, 'final', 0)")
    assert "python >= 3.10 is needed" in failure("--version", modules=modules)


@pytest.mark.parametrize("compiler", ["/nowhere/c++", "false"])
def test_missing_compiler(compiler: str, tmp_path: Path) -> None:
    sentence = failure("build_ext", "--build-lib", str(tmp_path), CXX=compiler)
    assert f"`{compiler}` does not compile C++20; install g++" in sentence
