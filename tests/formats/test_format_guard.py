"""Whatever a reader of a mesh file runs into becomes one error in words, with the name of the file."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from torchpd.formats.content import Cells, MeshContent
from torchpd.formats.guard import read
from torchpd.formats.registry import FORMATS, Format


def broken(error: BaseException) -> Callable[[Path], MeshContent]:
    def reader(path: Path) -> MeshContent:
        print("noise of a library")  # noqa: T201
        print("more noise", file=sys.stderr)  # noqa: T201
        raise error

    return reader


def attempt(folder: Path, patch: pytest.MonkeyPatch, reader: Callable[[Path], MeshContent]) -> MeshContent:
    patch.setitem(FORMATS, ".boom", Format("Boom", reader))
    (folder / "a.boom").write_text("x")
    return read("who", folder / "a.boom")


ERRORS = [
    KeyError("tetra4"),
    IndexError(),
    MemoryError("1.4 PiB"),
    RecursionError(),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    AssertionError(),
    EOFError("the file ends too early"),
    OSError("unable to open"),
    SystemExit(1),
    type("PanicException", (BaseException,), {})("a compiled library gave up"),
]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_any_error_names_the_file_and_its_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], error: BaseException
) -> None:
    with pytest.raises(ValueError, match=r"^who cannot read a\.boom \(Boom\): .+") as caught:
        attempt(tmp_path, monkeypatch, broken(error))
    assert caught.value.__cause__ is error
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), PermissionError("no")])
def test_what_is_no_fault_of_the_file_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    with pytest.raises(type(error)):
        attempt(tmp_path, monkeypatch, broken(error))


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModuleNotFoundError, match=r"a\.boom \(Boom\): .*pip install h5py") as caught:
        attempt(tmp_path, monkeypatch, broken(ModuleNotFoundError("No module named 'h5py'", name="h5py")))
    assert caught.value.name == "h5py"


@pytest.mark.parametrize(
    ("points", "corners", "words"),
    [
        (np.zeros((3, 3)), [[0, 1, 2, 3]], r".*point 3 .* holds 3 points"),
        (np.zeros((4, 3)), [[0, 1, 2, -1]], r".*point -1"),
        (np.full((4, 3), np.nan), [[0, 1, 2, 3]], "point 0 .* must be finite"),
    ],
)
def test_what_a_reader_returns_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, points: np.ndarray, corners: list[list[int]], words: str
) -> None:
    with pytest.raises(ValueError, match=rf"a\.boom \(Boom\): {words}"):
        attempt(tmp_path, monkeypatch, lambda path: MeshContent(points, [Cells("tetra", np.array(corners))]))


@pytest.mark.parametrize("suffix", sorted(FORMATS))
def test_empty_files_and_files_of_something_else_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix.upper()}"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"cannot read a\..* empty"):
        read("who", path)
    with pytest.raises(FileNotFoundError, match="no such mesh file"):
        read("who", tmp_path)
    for content in (b"\0" * 100, b"\xff\xfe hello", b"1000000000000000 1000000000000000\n" * 3, b"\n"):
        path.write_bytes(content)
        try:
            made = read("who", path)
        except (ValueError, FileNotFoundError, ModuleNotFoundError) as error:
            assert path.name in str(error)  # noqa: PT017
        else:
            assert not sum(map(len, made.cells))
