"""The commands of torchpd: `python -m torchpd demo`, `study` and `doctor`."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .version import __version__

__all__ = ["main"]

_DEMO = """\
Drops an elastic body on the ground and writes pictures, films and a convergence plot.

MESH is a surface (.obj, .ply, .stl, .glb, .usd, ...), which is filled with tetrahedra, or a tetrahedral mesh
(.mesh, .msh, .vtk, .vtu, .inp, ...). It is scaled to one metre. Default: an octopus.

--patches: simulates bodies of free-form patches instead, as large as the three scenes of the source paper. They are
twisted, bent and dropped. Writes a picture and moving surfaces, and compares the time of a frame with the paper's."""

_STUDY = """\
Measures the cost of accuracy: error of the solver against iterations, milliseconds and memory, beside published
methods. Also measures the errors of the time step, of the mesh and of float32, and the effect of unconverged steps on
a motion.

SUBJECT is beam, cloth (a hanging sheet), octopus, or a mesh file. Bodies land on the ground. Methods without contacts
(Newton, L-BFGS, Gauss-Seidel, conjugate gradients, a factorised step) are refused there; with --scene held all methods
run.

Results go to --out: study.json, study.csv, pictures and report.html. An interrupted study resumes."""


_CELLS = 24


def _whole(text: str) -> int:
    """Parse an integer >= 1."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {number}")
    return number


def _positive(text: str) -> float:
    """Parse a finite number > 0."""
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, got {text!r}") from None
    if not 0.0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive and finite, got {text}")
    return number


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="torchpd", description="Projective dynamics as PyTorch operators.")
    parser.add_argument("--version", action="version", version=f"torchpd {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser(
        "demo",
        help="drop an elastic body, render it and measure the error",
        description=_DEMO,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument("mesh", nargs="?", type=Path, metavar="MESH", help="file of a surface or a tetrahedral mesh")
    demo.add_argument("--cells", type=_whole, help=f"lattice cells along the longest side ({_CELLS})")
    demo.add_argument("--steps", type=_whole, default=120, help="time steps of 1/60 s (%(default)s)")
    demo.add_argument("--youngs", type=_positive, default=3e4, help="Young's modulus in Pa (%(default)g)")
    demo.add_argument("--iterations", type=_whole, default=64, help="iterations per time step (%(default)s)")
    demo.add_argument("--device", default="cpu", help="cpu or cuda (%(default)s)")
    demo.add_argument("--out", type=Path, default=Path("out"), help="output folder (%(default)s)")
    demo.add_argument("--quick", action="store_true", help="fewer and smaller pictures")
    demo.add_argument("--patches", action="store_true", help="simulate free-form patches; without MESH and --cells")
    _add_study(commands)
    commands.add_parser("doctor", help="print versions, devices, and missing parts with their fix")
    return parser


def _add_study(commands: Any) -> None:
    study = commands.add_parser(
        "study",
        help="measure the cost of accuracy",
        description=_STUDY,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    study.add_argument(
        "subject", nargs="?", default="beam", metavar="SUBJECT", help="beam, cloth, octopus or a mesh file"
    )
    study.add_argument("--scene", help="motion of a body: lands (default), or held at its lowest tenth, no contacts")
    study.add_argument("--youngs", type=_positive, help="Young's modulus in Pa")
    study.add_argument("--poisson", type=float, default=0.0, help="Poisson's ratio (%(default)s)")
    study.add_argument("--time-step", type=_positive, help="time step in s")
    study.add_argument(
        "--resolution", type=_whole, help="cells across the beam or cloth, or along the longest side of a body"
    )
    study.add_argument("--iterations", type=_whole, default=1024, help="most iterations per step (%(default)s)")
    study.add_argument("--axes", nargs="+", metavar="AXIS", help="only these: solver, stiffness, float, time-step, ...")
    study.add_argument("--device", default="cpu", help="cpu or cuda (%(default)s)")
    study.add_argument("--threads", type=_whole, help="CPU threads")
    study.add_argument("--out", type=Path, default=Path("out/study"), help="output folder (%(default)s)")
    study.add_argument(
        "--quick",
        action="store_true",
        help="few points and at most 8 iterations, only to check that everything runs",
    )


def _study(arguments: argparse.Namespace) -> str:
    from .study.tasks import AXES, StudyOptions, run_study

    options = {name: value for name, value in vars(arguments).items() if name != "command"}
    chosen = [axis.replace("-", " ") for axis in options.pop("axes") or AXES]
    # in the order of the study, then unknown ones, for its error message
    axes = tuple(sorted(set(chosen), key=lambda axis: AXES.index(axis) if axis in AXES else len(AXES)))
    return run_study(StudyOptions(**options, axes=axes))


def _demo(arguments: argparse.Namespace) -> str:
    from .cli.demo import DemoOptions, run_demo
    from .cli.patch_demo import run_patch_demo

    options = {name: value for name, value in vars(arguments).items() if name != "command"}
    patches, cells = options.pop("patches"), options.pop("cells")
    if patches and not (options["mesh"] is None and cells is None):
        raise ValueError("demo --patches makes its own bodies: leave out MESH and --cells")
    chosen = DemoOptions(**options, cells=cells or _CELLS)
    return run_patch_demo(chosen) if patches else run_demo(chosen)


def _check_out(out: Path) -> None:
    """Refuse a file in place of the output folder before the work, not after it."""
    there = next((place for place in (out, *out.parents) if place.exists()), None)
    if there is not None and not there.is_dir():
        raise NotADirectoryError(f"--out must be a folder or a new name, got the file {there}")


def _doctor() -> int:
    from .cli.doctor import problems, report

    print(report())
    return 1 if problems() else 0


def main(words: Sequence[str] | None = None) -> int:
    """Run one command; returns 0, 1 if the doctor found a problem, 2 after a bad request, 130 if interrupted."""
    arguments = _parser().parse_args(words)
    try:
        with warnings.catch_warnings():
            # mesh repairs are messages to the user, not to a developer: without file and line
            warnings.showwarning = lambda message, *_, **__: print(f"note: {message}", file=sys.stderr)
            if arguments.command == "doctor":
                return _doctor()
            _check_out(arguments.out)
            print(_study(arguments) if arguments.command == "study" else _demo(arguments))
    except (ValueError, TypeError, OSError, ImportError, RuntimeError) as error:
        print(f"torchpd: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _one_line(error: BaseException) -> str:
    """First line of the message; some libraries append stacks or advice, which is dropped."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
