"""A build that cannot work says why in one sentence that names the remedy."""

from __future__ import annotations

import importlib.metadata
import os
import runpy
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from programs import ROOT

from torchpd.__main__ import main
from torchpd.common.linking import libraries_in, library_names, runtime_fault, shared_runtime


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


def test_missing_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """That fails, asked by a build, and that is not there."""
    sentence = failure("build_ext", "--build-lib", str(tmp_path), CXX="false")
    assert "`false` does not compile C++20; install g++" in sentence
    monkeypatch.setattr(sys, "argv", ["setup.py", "--name"])
    monkeypatch.chdir(ROOT)
    check = runpy.run_path(str(ROOT / "setup.py"))["check_compiler"]
    monkeypatch.setenv("CXX", "/nowhere/c++")
    with pytest.raises(SystemExit, match=r"^torchpd cannot be built: `/nowhere/c\+\+` does not compile"):
        check()


DYNAMIC_SECTION = """
 0x0000000000000001 (NEEDED)             Shared library: [libc10.so]
 0x0000000000000001 (NEEDED)             Shared library: [%s]
 0x000000000000001d (RUNPATH)            Library runpath: [libstdc++.so.6]
"""


def test_an_extension_without_the_shared_runtime_is_refused() -> None:
    assert library_names(DYNAMIC_SECTION % "libstdc++.so.6") == ["libc10.so", "libstdc++.so.6"]
    assert runtime_fault(["libc10.so", "libstdc++.so.6"], "c++") == ""
    fault = runtime_fault(library_names(DYNAMIC_SECTION % "libc.so.6"), "c++ -static-libstdc++")
    for said in (
        "`c++ -static-libstdc++` must link libstdc++ as a shared library",
        "got libc10.so, libc.so.6",
        "LDFLAGS",
    ):
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


def tracked() -> set[str]:
    """The files of this repository; none where it came without its history."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    return set(listed.stdout.split("\n")) - {""}


@pytest.mark.skipif(not tracked(), reason="not a checkout of git")
def test_source_distribution_has_every_file(tmp_path: Path) -> None:
    words = ["--quiet", "egg_info", "--egg-base", str(tmp_path), "sdist", "--dist-dir", str(tmp_path)]
    subprocess.run([sys.executable, "setup.py", *words], cwd=ROOT, check=True, capture_output=True)
    (file,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(file) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert tracked() - packed == {".gitignore"}


def test_editable_install_is_a_path_that_type_checkers_follow() -> None:
    files = importlib.metadata.files("torchpd") or []
    lines = [Path(str(file.locate())).read_text().strip() for file in files if file.suffix == ".pth"]
    assert all(Path(line).is_dir() for line in lines), "installed with an import hook: run pip install -e . again"


def test_console_script_is_the_command_line() -> None:
    (script,) = importlib.metadata.entry_points(group="console_scripts", name="torchpd")
    assert script.load() is main
