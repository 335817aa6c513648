"""Builds the extension `torchpd._C`; everything that is not code lives in pyproject.toml."""

from __future__ import annotations

import os
import platform
import re
import runpy
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).resolve().parent
MINIMUM_PYTHON = (3, 10)
MINIMUM_TORCH = (2, 11)
PROBE = "#include <concepts>\nstatic_assert(std::integral<int>);\nint main() {}\n"
# -ffp-contract=off: the code says itself where to fuse, so that every path gives the same bits.
# Neither -ffast-math nor -march=native: results must be the same bits on every machine of one instruction set.
# -g0: python's own flags often ask for debug information, which doubles the time and the size of the build.
OPTIMISATION = ["-O3", "-g0", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"]
# GCC 12 puts a vzeroupper before the return of functions that hand back a vector in a register, and loses half of it,
# where the instruction set comes from a pragma. The kernels clean up themselves, at their end.
X86 = ["-mno-vzeroupper"] if platform.machine() in ("x86_64", "AMD64") else []
WARNINGS = ["-Wall", "-Wextra", "-Wno-psabi"]


def fail(sentence: str) -> None:
    sys.exit(f"torchpd cannot be built: {sentence}")


def check_python() -> None:
    if sys.version_info < MINIMUM_PYTHON:
        fail(f"python >= 3.10 is needed, but {sys.executable} is {platform.python_version()}; install a newer python.")


def check_torch() -> None:
    try:
        import torch
    except ImportError as error:
        fail(
            f"torch cannot be imported by {sys.executable} ({error}); install torch >= 2.11 into that environment "
            "and run `pip install --no-build-isolation .`, so that the build sees the torch that it will run with."
        )
    if tuple(int(part) for part in re.findall(r"\d+", torch.__version__)[:2]) < MINIMUM_TORCH:
        fail(f"torch >= 2.11 is needed, but {torch.__version__} is installed; run `pip install -U 'torch>=2.11'`.")


def compiler() -> list[str]:
    """The C++ compiler that torch's build runs."""
    return shlex.split(os.environ.get("CXX", "c++"))


def compiles(flags: list[str]) -> bool:
    """Whether the C++ compiler turns a three-line program into an executable with these flags."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "probe.cpp"
        source.write_text(PROBE)
        command = [*compiler(), *flags, str(source), "-o", str(source.with_suffix(""))]
        try:
            return subprocess.run(command, capture_output=True, check=False).returncode == 0
        except OSError:
            return False


def check_compiler() -> None:
    if not compiles(["-std=c++20"]):
        fail(
            f"`{shlex.join(compiler())}` does not compile C++20; install g++ >= 11 (Debian and Ubuntu: "
            "`apt install g++`) or clang++ >= 14, or name another compiler in CXX."
        )
    headers = Path(sysconfig.get_path("include"))
    if not (headers / "Python.h").exists():
        fail(f"Python.h is missing in {headers}; install it (Debian and Ubuntu: `apt install python3-dev`).")


check_python()
check_torch()

import torch  # noqa: E402
from torch.utils import cpp_extension  # noqa: E402

# The ninja that pip installed lies beside python, which is not on the PATH of an environment that is not activated.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
TOOLKIT = runpy.run_path(str(ROOT / "torchpd" / "common" / "toolkit.py"))
LINKING = runpy.run_path(str(ROOT / "torchpd" / "common" / "linking.py"))


def relative(pattern: str) -> list[str]:
    return sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "csrc").glob(pattern))


# What the kernels of the CPU are compiled for, and the flags of /proc/cpuinfo that it takes.
INSTRUCTION_SETS = {
    "avx512": {"avx512f", "avx512vl", "avx512bw", "avx512dq"},
    "avx2": {"avx2", "fma"},
    "portable": set(),
}


def left_out() -> set[str]:
    """Instruction sets that are not compiled: with TORCHPD_BUILD=native those that this processor does not run."""
    wanted = os.environ.get("TORCHPD_BUILD", "all")
    if wanted not in ("all", "native"):
        fail(f"TORCHPD_BUILD must be all or native, got {wanted!r}; unset it to compile every instruction set.")
    try:
        flags = set(re.findall(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.M)[0].split())
    except (OSError, IndexError):  # another system or processor: the sources leave out what it lacks
        return set()
    return {name for name, needed in INSTRUCTION_SETS.items() if wanted == "native" and not needed <= flags}


def longest_first(paths: list[str]) -> list[str]:
    """The order of the build, so that the units that take minutes leave no core without work at its end."""
    return sorted(paths, key=lambda path: "/cpu/isa_" not in path)


def make_extension():
    """`torchpd._C`: CPU always, CUDA when a toolkit of torch's major version is there."""
    # a build without CUDA sources is a CPU build, whatever toolkit there is
    cuda = TOOLKIT["find_toolkit"]().home is not None and bool(relative("**/*.cu"))
    kind = cpp_extension.CUDAExtension if cuda else cpp_extension.CppExtension
    # torch's headers do not pass -Wextra; as system headers they keep quiet, and -I of the same folder is ignored.
    system = [word for path in cpp_extension.include_paths() for word in ("-isystem", path)]
    # Apple's clang has no -fopenmp: the code runs on one thread there.
    threads = ["-fopenmp"] if compiles(["-std=c++20", "-fopenmp"]) else []
    cxx = ["-std=c++20", *OPTIMISATION, *X86, *threads, *WARNINGS, *system]
    without = left_out()
    units = [path for path in relative("**/*.cpp") if Path(path).stem.rpartition("_")[2] not in without]
    return kind(
        name="torchpd._C",
        sources=longest_first([path for path in units if cuda or "/cuda/" not in path])
        + (relative("**/*.cu") if cuda else []),
        depends=[path for suffix in ("h", "cuh", "inl", "def") for path in relative(f"**/*.{suffix}")],
        include_dirs=[str(ROOT / "csrc")],
        define_macros=[(f"TORCHPD_WITHOUT_{name.upper()}", None) for name in sorted(without)]
        + ([("TORCHPD_CUDA", None)] if cuda else []),
        extra_compile_args={"cxx": cxx, "nvcc": [*TOOLKIT["NVCC_FLAGS"], *TOOLKIT["NVCC_PACKING"]]},
        extra_link_args=[*threads, *LINKING["shared_runtime"](compiler())],
    )


class BuildExtension(cpp_extension.BuildExtension):
    """torch's build, with a check of the compiler first and with object files that outlive one call of pip."""

    def finalize_options(self) -> None:
        super().finalize_options()
        # pip builds in a throw-away folder; here ninja finds its objects again and compiles only what changed.
        # Headers of torch are not tracked as dependencies, so each torch and python has a folder of its own.
        tag = f"{sys.implementation.cache_tag}-torch-{torch.__version__}"
        self.build_temp = str(ROOT / "build" / f"{sysconfig.get_platform()}-{tag}")

    def build_extensions(self) -> None:
        check_compiler()
        os.environ.setdefault("TORCH_CUDA_ARCH_LIST", TOOLKIT["CUDA_ARCHITECTURES"])
        reason = TOOLKIT["find_toolkit"]().reason
        print(f"torchpd: building for the CPU{' only: ' + reason if reason else ' and CUDA'}", flush=True)
        super().build_extensions()
        if sys.platform == "linux":
            self.check_runtime()

    def check_runtime(self) -> None:
        """Remove and refuse an extension whose errors would crash."""
        for extension in self.extensions:
            built = Path(self.get_ext_fullpath(extension.name))
            libraries = LINKING["libraries_in"](built)
            if libraries is not None and (fault := LINKING["runtime_fault"](libraries, shlex.join(compiler()))):
                built.unlink()
                fail(fault)


# An editable install is then a path, which type checkers follow; they do not see through the usual import hook.
EDITABLE = {"editable_wheel": {"mode": "compat"}}

setup(ext_modules=[make_extension()], cmdclass={"build_ext": BuildExtension}, options=EDITABLE)
