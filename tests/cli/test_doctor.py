"""The doctor tells what is there, and what is wrong with the remedy, also when the extension cannot be loaded."""

from __future__ import annotations

import importlib.util
import platform
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchpd.cli import doctor
from torchpd.common.toolkit import Toolkit, choose_toolkit
from torchpd.version import __version__

BUILD = {
    "simd": "avx2",
    "simd_available": ["avx2", "portable"],
    "openmp": 201511,
    "cuda": False,
    "compiler": "g++ 13.2.0",
    "cxx": 202002,
}


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_load_build", lambda: (BUILD, ""))
    monkeypatch.setattr(doctor, "_problem_of_errors", lambda: "")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def test_versions_are_those_of_the_process(built: None) -> None:
    lines = [line.split() for line in doctor.report().splitlines()]
    for name, version in {
        "torchpd": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }.items():
        assert [name, version] in lines


def test_build_facts_are_shown(built: None) -> None:
    text = doctor.report()
    for fact in ("avx2, portable", "g++ 13.2.0", "No problem found."):
        assert fact in text
    assert doctor.problems() == []


def test_missing_extension_is_a_problem_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchpd._C", None)
    (problem,) = doctor.problems()
    assert "torchpd._C" in problem
    assert "make setup" in problem
    assert f"Problem: {problem}" in doctor.report()


def test_gpu_without_cuda_build_is_a_problem(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(doctor, "find_toolkit", lambda: Toolkit(None, "12.4", "nvcc is CUDA 12.4 but ..."))
    (problem,) = doctor.problems()
    assert "not built: nvcc is CUDA 12.4" in problem


@pytest.mark.parametrize(
    ("capabilities", "said"),
    [
        ([], "torch sees no CUDA device: check the driver (nvidia-smi) and CUDA_VISIBLE_DEVICES"),
        ([(7, 5)], "compute capability 7.5 and the kernels need 8.0 or newer"),
        ([(7, 5), (9, 0)], ""),
    ],
)
def test_a_cuda_build_without_a_gpu_for_it_is_told(
    built: None, capabilities: list[tuple[int, int]], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that `.to("cuda")` refuses, and sends here: on the CPU all is well."""
    monkeypatch.setattr(doctor, "_load_build", lambda: ({**BUILD, "cuda": "13.0"}, ""))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: bool(capabilities))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(capabilities))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: capabilities[index])
    monkeypatch.setattr(doctor, "_devices", list)
    assert doctor.problems() == []
    found = doctor.notes()
    assert len(found) == bool(said)
    for note in found:
        assert said in note
        assert "doctor" not in note
        assert f"Note: {note}\nNo problem found." in doctor.report()


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("print('matrices must be [..., 3, 3], got Float [2] on cpu')", ""),
        ("print('matrices must be [..., 3, 3], got Float [')", r"are cut short .*got Float \['\): .* C\+\+ runtime"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", r"by SIGSEGV .* -static-libstdc\+\+ .*make setup"),
        ("import os; os.abort()", "by SIGABRT where they should raise"),
        ("raise OSError('no library')", r"must raise ValueError .*OSError: no library$"),
        ("pass", r"must raise ValueError .*nothing was raised$"),
    ],
)
def test_errors_that_do_not_come_back_are_a_problem(program: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_WRONG_CALL", program)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor, "_load_build", lambda: (BUILD, ""))
    assert len(doctor.problems()) == bool(said)
    for problem in doctor.problems():
        assert re.search(said, problem)


def test_errors_of_this_build_come_back() -> None:
    assert doctor._problem_of_errors() == ""


def test_devices_and_driver_are_shown(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = [
        SimpleNamespace(name="Old", major=7, minor=5, total_memory=16 * 2**30),
        SimpleNamespace(name="New", major=9, minor=0, total_memory=80 * 2**30),
    ]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(kinds))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: kinds[index])
    monkeypatch.setattr(doctor, "_driver", lambda: "580.65")
    text = doctor.report()
    assert "Old, compute capability 7.5: too old, the kernels need 8.0, 16 GiB" in text
    assert "New, compute capability 9.0, 80 GiB" in text
    assert ["NVIDIA", "driver", "580.65"] in [line.split() for line in text.splitlines()]


def test_no_driver_is_no_error(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert "none found (nvidia-smi does not answer)" in doctor.report()


def test_missing_packages_are_named_as_pip_names_them(built: None, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name in {"pxr", "scipy"} else find(name))
    text = doctor.report()
    assert "pip install usd-core" in text
    assert doctor.problems() == ["scipy is missing: pip install scipy"]


@pytest.mark.parametrize(
    ("home", "release", "torch_cuda", "reason"),
    [
        ("/usr/local/cuda", "13.0", None, "CPU build"),
        (None, "", "13.0", "set CUDA_HOME"),
        ("/usr/local/cuda", "", "13.0", "no working nvcc in /usr/local/cuda/bin"),
        ("/usr/local/cuda", "12.8", "13.0", "nvcc is CUDA 12.8 but torch is built for CUDA 13.0"),
        ("/usr/local/cuda", "12.2", "12.8", "nvcc is CUDA 12.2 and the kernels need 12.3 or newer: install a newer"),
    ],
)
def test_cuda_is_left_out_for_a_stated_reason(
    home: str | None, release: str, torch_cuda: str | None, reason: str
) -> None:
    toolkit = choose_toolkit(home, release, torch_cuda)
    assert toolkit.home is None
    assert reason in toolkit.reason


def test_cuda_is_used_when_the_major_versions_agree() -> None:
    for release, torch_cuda in (("13.2", "13.0"), ("12.10", "12.8"), ("12.3", "12.8")):
        assert choose_toolkit("/opt/cuda", release, torch_cuda) == Toolkit("/opt/cuda", release, "")


def test_command_works_without_the_extension() -> None:
    program = (
        "import runpy, sys; sys.modules['torchpd._C'] = None; sys.argv = ['torchpd', 'doctor']; "
        "runpy.run_module('torchpd', run_name='__main__')"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 1, result.stderr
    assert "Problem: the extension torchpd._C cannot be loaded" in result.stdout
    assert "Traceback" not in result.stderr
