"""tools/variants.py, as far as it goes without a GPU."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from programs import ROOT

CHANGE = """diff --git a/{file} b/{file}
--- a/{file}
+++ b/{file}
@@ -1,1 +1,1 @@
-{old}
+{new}
"""


@pytest.fixture(name="tool", scope="module")
def fixture_tool() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / "variants.py"))


def test_a_patch_changes_the_copy_alone(tool: dict[str, Any], tmp_path: Path) -> None:
    folder, patch = tmp_path / "copy", tmp_path / "a.patch"
    (folder / "csrc").mkdir(parents=True)
    (folder / "csrc" / "one.h").write_text("a\n")
    (folder / "two.py").write_text("a\n")
    patch.write_text(
        CHANGE.format(file="csrc/one.h", old="a", new="b") + CHANGE.format(file="two.py", old="other", new="b")
    )
    tool["apply"](patch, folder)
    assert (folder / "csrc" / "one.h").read_text() == "b\n"
    assert (folder / "two.py").read_text() == "a\n"


def test_a_patch_that_does_not_fit_is_refused(tool: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "csrc").mkdir()
    (tmp_path / "csrc" / "one.h").write_text("a\n")
    patch = tmp_path / "a.patch"
    patch.write_text(CHANGE.format(file="csrc/one.h", old="other", new="b"))
    with pytest.raises(SystemExit, match=r"git apply .*one\.h"):
        tool["apply"](patch, tmp_path)
    assert (tmp_path / "csrc" / "one.h").read_text() == "a\n"


def test_a_patch_that_changes_no_kernel_is_refused(tool: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "csrc").mkdir()
    patch = tmp_path / "a.patch"
    patch.write_text(CHANGE.format(file="two.py", old="a", new="b"))
    with pytest.raises(SystemExit, match=r"a\.patch changes nothing in csrc/"):
        tool["apply"](patch, tmp_path)


def test_objects_of_another_source_are_refused(
    tool: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where one of two was compiled after the change of both, as by a build that failed half-way."""
    objects = tool["objects"]
    monkeypatch.setitem(objects.__globals__, "ROOT", tmp_path)
    tag = f"{sysconfig.get_platform()}-{sys.implementation.cache_tag}-torch-{torch.__version__}"
    (tmp_path / "csrc").mkdir()
    built = tmp_path / "build" / tag
    (built / "csrc").mkdir(parents=True)
    rules = ["rule copy", "  command = cp $in $out"]
    for name in ("one", "two"):
        (tmp_path / "csrc" / f"{name}.cpp").write_text("a\n")
        rules.append(f"build {built}/csrc/{name}.o: copy {tmp_path}/csrc/{name}.cpp")
    (built / "build.ninja").write_text("\n".join([*rules, ""]))
    with pytest.raises(SystemExit, match=r"is not of this csrc/: run `python setup\.py build_ext --inplace` first"):
        objects()
    ninja = [shutil.which("ninja", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"), "-C", built]
    subprocess.run(ninja, check=True, capture_output=True)
    assert [path.name for path in objects()] == ["one.o", "two.o"]
    later = time.time() + 10.0
    for name in ("one", "two"):
        os.utime(tmp_path / "csrc" / f"{name}.cpp", (later, later))
    subprocess.run([*ninja, built / "csrc" / "one.o"], check=True, capture_output=True)
    os.utime(built / "csrc" / "one.o", (later + 10.0, later + 10.0))
    with pytest.raises(SystemExit, match="is not of this csrc/"):
        objects()
