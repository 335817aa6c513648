"""A build that cannot work says why in one sentence that names the remedy."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from programs import ROOT

from torchpd.linking import libraries_in, library_names, runtime_fault, shared_runtime


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


DYNAMIC_SECTION = """
 0x0000000000000001 (NEEDED)             Shared library: [libc10.so]
 0x0000000000000001 (NEEDED)             Shared library: [%s]
 0x000000000000001d (RUNPATH)            Library runpath: [libstdc++.so.6]
"""


def test_an_extension_without_the_shared_runtime_is_refused() -> None:
    assert library_names(DYNAMIC_SECTION % "libstdc++.so.6") == ["libc10.so", "libstdc++.so.6"]
    assert runtime_fault(["libc10.so", "libstdc++.so.6"], "c++") == ""
    fault = runtime_fault(library_names(DYNAMIC_SECTION % "libc.so.6"), "c++ -static-libstdc++")
    for said in ("`c++ -static-libstdc++` links libstdc++ statically", "needs libc10.so, libc.so.6", "LDFLAGS"):
        assert said in fault


@pytest.mark.skipif(sys.platform != "linux", reason="libraries of Linux")
def test_the_shared_runtime_comes_before_a_static_one(tmp_path: Path) -> None:
    """With a compiler that links libstdc++ statically where it can."""
    source, wrapper = tmp_path / "thrower.cpp", tmp_path / "c++"
    source.write_text('#include <stdexcept>\nvoid thrower() { throw std::runtime_error(""); }\n')
    own = os.environ.get("CXX", "c++")
    wrapper.write_text(f'#!/bin/sh\nexec {own} -static-libstdc++ -static-libgcc "$@"\n')
    wrapper.chmod(0o755)
    for named in (False, True):
        built = tmp_path / f"{named}.so"
        runtime = shared_runtime([str(wrapper)]) if named else []
        subprocess.run([wrapper, "-shared", "-fPIC", source, *runtime, "-o", built], check=True)
        libraries = libraries_in(built)
        assert libraries is not None
        assert (runtime_fault(libraries, "c++") == "") == named
