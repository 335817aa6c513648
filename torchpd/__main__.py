"""The commands of torchpd: `python -m torchpd demo` and `python -m torchpd doctor`."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

from .version import __version__

__all__ = ["main"]

_DEMO = """\
Drops an elastic body on the ground and writes pictures, films and a convergence plot.

MESH is a surface (.obj, .ply, .stl, .glb and whatever else trimesh reads), which is filled with a lattice of
tetrahedra, or a tetrahedral mesh (.mesh, .msh, .vtk, .vtu). It is scaled to a metre. Without MESH: an octopus."""


def _whole(text: str) -> int:
    """A whole number >= 1."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {number}")
    return number


def _positive(text: str) -> float:
    """A finite number > 0."""
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
        help="drop an elastic body, draw it and measure the error",
        description=_DEMO,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument("mesh", nargs="?", type=Path, metavar="MESH", help="file of a surface or a tetrahedral mesh")
    demo.add_argument("--cells", type=_whole, default=24, help="lattice cells along the longest side (%(default)s)")
    demo.add_argument("--steps", type=_whole, default=120, help="time steps of 1/60 s (%(default)s)")
    demo.add_argument("--youngs", type=_positive, default=3e4, help="Young's modulus in Pa (%(default)g)")
    demo.add_argument("--iterations", type=_whole, default=64, help="iterations of a time step (%(default)s)")
    demo.add_argument("--device", default="cpu", help="cpu or cuda (%(default)s)")
    demo.add_argument("--out", type=Path, default=Path("out"), help="folder for the files (%(default)s)")
    demo.add_argument("--quick", action="store_true", help="fewer and smaller pictures")
    commands.add_parser("doctor", help="print versions, devices, and what is missing")
    return parser


def _demo(arguments: argparse.Namespace) -> str:
    from .demo import DemoOptions, run_demo

    options = vars(arguments)
    return run_demo(DemoOptions(**{name: value for name, value in options.items() if name != "command"}))


def _doctor() -> int:
    from .doctor import problems, report

    print(report())
    return 1 if problems() else 0


def main(words: Sequence[str] | None = None) -> int:
    """Run one command; 0, 1 when the doctor finds a problem, 2 after a sentence on a bad request, 130 interrupted."""
    arguments = _parser().parse_args(words)
    try:
        with warnings.catch_warnings():
            # what was repaired in a mesh is news for the user, not for a developer: no file and line
            warnings.showwarning = lambda message, *_, **__: print(f"note: {message}", file=sys.stderr)
            if arguments.command == "doctor":
                return _doctor()
            print(_demo(arguments))
    except (ValueError, TypeError, OSError, ImportError, RuntimeError) as error:
        print(f"torchpd: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _one_line(error: BaseException) -> str:
    """The message in one line; what some libraries append to it (stacks, advice) is left out."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
