"""Damaged mesh files of every format: see `fuzz_files.py`, which runs in a process of its own with bounded memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from fuzz_files import Silence, damage, try_file
from fuzz_seeds import Seed, make_seeds
from programs import HELPERS, ROOT

from torchpd import TriMesh
from torchpd.formats.registry import FORMATS

# Their packages are optional, and their sound files cannot be made without.
OPTIONAL = {".cgns", ".e", ".ex2", ".exo", ".h5m", ".hmf", ".med", ".usd", ".usda", ".usdc", ".usdz"}


def test_500_damaged_files_are_read_or_refused_in_words(tmp_path: Path) -> None:
    program = [sys.executable, str(HELPERS / "fuzz_files.py"), "500"]
    paths = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(program, cwd=tmp_path, env=paths, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("500 damaged files in")


def test_every_format_has_a_seed(tmp_path: Path) -> None:
    missing = set(FORMATS) - {seed.path.suffix for seed in make_seeds(tmp_path)}
    assert missing <= OPTIONAL


def test_the_same_number_damages_a_file_in_the_same_way(tmp_path: Path) -> None:
    results = []
    for _ in range(2):
        path = tmp_path / "a.obj"
        path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 5)
        results.append([(damage(Seed(path, TriMesh), number), path.read_bytes()) for number in range(5)])
    assert results[0] == results[1]
    assert len({data for _, data in results[0]}) > 1


def test_faults_are_seen(tmp_path: Path) -> None:
    """What the harness must not let pass, by readers that do it."""
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\n")

    class Broken(TriMesh):
        way = ""

        @classmethod
        def from_file(cls, path: object) -> TriMesh:  # type: ignore[override]
            if cls.way == "unnamed":
                raise ValueError("it is wrong")
            if cls.way == "raw":
                raise KeyError(str(path))
            return TriMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])

    seed = Seed(path, Broken)
    assert try_file(seed, path) == ("read", "")
    Broken.way = "unnamed"
    assert "does not name the file" in try_file(seed, path)[1]
    Broken.way = "raw"
    assert "KeyError" in try_file(seed, path)[1]
    silence = Silence(tmp_path / "log")
    try:
        subprocess.run([sys.executable, "-c", "print('hello')"], check=True)
        words = silence.taken()
    finally:
        silence.end()
    assert words == b"hello\n"
