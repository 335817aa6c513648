"""Report of this installation and its problems: `python -m torchpd doctor`.

It works without the compiled extension, since a missing extension is the first problem to report.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from ..common.extension import BUILD_COMMAND, load_extension
from ..common.gpu import DOCTOR, MIN_CAPABILITY, unavailable_reason
from ..common.packages import OPTIONAL, REQUIRED, Package, is_installed, missing_packages
from ..common.toolkit import Toolkit, find_toolkit
from ..version import __version__

__all__ = ["notes", "problems", "report"]


# an op with a wrong argument must raise ValueError with the value in the message
_WRONG_CALL = """
import torch, torchpd
try:
    torch.ops.torchpd.nearest_rotation(torch.zeros(2))
except ValueError as error:
    print(error)
"""
_END_OF_ERROR = "[2] on cpu"


def _load_build() -> tuple[Mapping[str, Any] | None, str]:
    """Build facts of torchpd._C, or None and the reason."""
    extension, reason = load_extension()
    return (None, reason) if extension is None else (extension.build_info(), "")


def _version(package: Package) -> str:
    # of this process: torch's metadata do not say for which CUDA it was built
    loaded = getattr(sys.modules.get(package.module), "__version__", None)
    if isinstance(loaded, str):
        return loaded
    try:
        return importlib.metadata.version(package.pip_name)
    except importlib.metadata.PackageNotFoundError:
        return "present, version unknown" if is_installed(package) else "missing"


def _devices() -> list[tuple[str, str]]:
    """Every device visible to torch."""
    rows = [("cpu", f"{os.cpu_count()} logical cores, {torch.get_num_threads()} threads in use")]
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        old = "" if (device.major, device.minor) >= MIN_CAPABILITY else ": too old, the kernels need 8.0"
        facts = f"compute capability {device.major}.{device.minor}{old}, {device.total_memory / 2**30:.0f} GiB"
        rows.append((f"cuda:{index}", f"{device.name}, {facts}"))
    return [*rows, ("NVIDIA driver", _driver())]


def _driver() -> str:
    """Version of the NVIDIA driver, from nvidia-smi."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20).stdout.split()
    except (OSError, subprocess.SubprocessError):
        return "none found (nvidia-smi does not answer)"
    return said[0] if said else "unknown"


def _cuda_state(build: Mapping[str, Any] | None, toolkit: Toolkit) -> str:
    """CUDA state of the extension, and of a build now if that differs."""
    built = build is not None and bool(build["cuda"])
    if built and toolkit.home is not None:
        return f"built; toolkit {toolkit.release} in {toolkit.home}"
    if built:
        return f"built, but a build now would leave it out: {toolkit.reason}"
    if toolkit.home is not None:
        return f"not built, although toolkit {toolkit.release} in {toolkit.home} matches: rebuild with {BUILD_COMMAND}"
    return f"not built: {toolkit.reason}"


def _run_wrong_call() -> subprocess.CompletedProcess[str]:
    """Run a process that calls an op with a wrong argument."""
    paths = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    command = [sys.executable, "-c", _WRONG_CALL]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def _problem_of_errors() -> str:
    """The reason why an op's error does not arrive as a Python exception; empty if it does."""
    run = _run_wrong_call()
    said = run.stdout.strip()
    if run.returncode == 0 and said.endswith(_END_OF_ERROR):
        return ""
    if run.returncode > 0 or (run.returncode == 0 and not said):
        last = " ".join(run.stderr.split())[-300:] or "nothing was raised"
        return f"an op must raise ValueError for a wrong argument, got: {last}"
    names = {int(one): one.name for one in signal.Signals}
    crash = f"end the process by {names.get(-run.returncode, -run.returncode)} where they should raise an exception"
    return (
        f"errors of ops {crash if run.returncode else f'are cut short ({said!r})'}: the extension has its own C++ "
        "runtime beside torch's. Remove -static-libstdc++ from CXX, CXXFLAGS and LDFLAGS, or name another compiler in "
        f"CXX, and build it again with {BUILD_COMMAND}"
    )


def problems() -> list[str]:
    """Problems that keep torchpd from working, each with its fix; empty if there are none."""
    found = [f"{package.pip_name} is missing: pip install {package.pip_name}" for package in missing_packages(REQUIRED)]
    build, reason = _load_build()
    if build is None:
        found.append(f"the extension torchpd._C cannot be loaded ({reason}): build it with {BUILD_COMMAND}")
    elif torch.cuda.is_available() and not build["cuda"]:
        found.append(f"a GPU is present, but CUDA is {_cuda_state(build, find_toolkit())}")
    if build is not None and (problem := _problem_of_errors()):
        found.append(problem)
    return found


def notes() -> list[str]:
    """Features that are built but unusable here: CUDA without a GPU."""
    build, _ = _load_build()
    if build is None or not build["cuda"]:
        return []
    count = torch.cuda.device_count()
    best = max((torch.cuda.get_device_capability(index) for index in range(count)), default=None)
    reason = unavailable_reason(True, torch.version.cuda, count, best).removesuffix(f"; {DOCTOR}")
    return [f"CUDA is built, but no GPU is usable: {reason}"] if reason else []


def _section(title: str, rows: Iterable[tuple[str, str]]) -> list[str]:
    return [title, *(f"  {name:<16} {value}" for name, value in rows), ""]


def _build_rows() -> list[tuple[str, str]]:
    build, reason = _load_build()
    cuda = ("CUDA", _cuda_state(build, find_toolkit()))
    if build is None:
        return [("torchpd._C", f"not built ({reason})"), cuda]
    return [
        ("torchpd._C", "built"),
        ("compiler", f"{build['compiler']}, {build['cxx']}"),
        ("SIMD in use", str(build["simd"])),
        ("SIMD available", ", ".join(build["simd_available"])),
        ("OpenMP", str(build["openmp"] or "none: one thread")),
        cuda,
    ]


def _optional_row(package: Package) -> tuple[str, str]:
    if is_installed(package):
        return package.pip_name, f"{_version(package)} ({package.purpose})"
    return package.pip_name, f"missing; for {package.purpose}: pip install {package.pip_name}"


def report() -> str:
    """The whole report as text, problems last."""
    system = [
        ("torchpd", __version__),
        ("python", platform.python_version()),
        ("platform", f"{platform.platform()}, {platform.machine()}"),
        ("torch CUDA", torch.version.cuda or "none (a CPU build)"),
    ]
    lines = _section("Versions", [*system, *((package.pip_name, _version(package)) for package in REQUIRED)])
    lines += _section("Devices", _devices())
    lines += _section("Build", _build_rows())
    lines += _section("Optional packages", map(_optional_row, OPTIONAL))
    lines += [f"Note: {note}" for note in notes()]
    found = problems()
    lines += [f"Problem: {problem}" for problem in found] or ["No problem found."]
    return "\n".join(lines)
