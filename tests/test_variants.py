"""tools/variants.py, as far as it goes without a GPU."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
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
