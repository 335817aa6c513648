"""The figures of README.md: `python benchmarks/figures.py` draws docs/error_against_time.png from a finished study.

`python benchmarks/figures.py --film out/animation.mp4` makes docs/film.gif of the film that `make demo` writes.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np

from torchpd.viewing.animation import write_film

ROOT = Path(__file__).resolve().parents[1]
STUDY = ROOT / "benchmarks" / "results" / "study-beam" / "study.csv"
STIFFNESS = 1e6  # Pa
LOWEST, MOST = 1e-6, 60.0  # smallest error and largest milliseconds drawn
# method of the study and its precision: colour, width and style of its line, its label
CURVES = {
    ("Jacobi", "float32"): ("#3e4046", 2.0, "solid", "Jacobi"),
    ("guarded Chebyshev", "float32"): ("#d55e00", 2.8, "solid", "Chebyshev (star: the default)"),
    ("Multilevel", "float32"): ("#0072b2", 2.8, "solid", "Multilevel"),
    ("direct global step + Chebyshev", "float64"): ("#8a8e96", 1.4, "solid", "factorised global step + Chebyshev"),
    ("L-BFGS with A^-1", "float64"): ("#8a8e96", 1.4, "dashed", "L-BFGS from the factorisation"),
    ("Newton-PCG with M", "float64"): ("#8a8e96", 1.4, "dotted", "Newton by conjugate gradients"),
}


def curves(study: Path = STUDY) -> dict[tuple[str, str], list[tuple[float, float, bool]]]:
    """Milliseconds, error and default flag of every drawn method, by iterations."""
    found: dict[tuple[str, str], list[tuple[float, float, bool]]] = {key: [] for key in CURVES}
    with study.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            key = (row["method"], row["precision"])
            same_step = row["axis"] == "solver" and float(row["youngs"]) == STIFFNESS and row["status"] == "ok"
            if key in found and same_step and float(row["milliseconds"]) <= MOST:
                found[key].append((float(row["milliseconds"]), float(row["error"]), row["default"] == "True"))
    return {key: sorted(points) for key, points in found.items()}


def draw(out: Path, study: Path = STUDY) -> None:
    """Draw the error of a step against its time, one curve per method."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.0), dpi=100, layout="constrained")
    axis: Any = figure.subplots()
    for key, points in curves(study).items():
        color, width, style, name = CURVES[key]
        shown = [point[:2] for point in points if point[1] >= LOWEST]
        axis.loglog(*zip(*shown, strict=True), color=color, linewidth=width, linestyle=style, label=name)
        for time, error, default in points:
            if default:
                axis.plot(time, error, "*", markersize=15, color=color)
    axis.legend(loc="lower left", frameon=False, fontsize=9)
    axis.set(xlim=(0.06, MOST), ylim=(LOWEST, 3.0), xlabel="milliseconds of a step, one CPU core")
    axis.set_ylabel("relative error of the step")
    axis.set_title("One step of 1/30 s: 3,750 tetrahedra, 1 MPa", fontsize=10, loc="left")
    axis.grid(which="major", color="#e4e5e8", linewidth=0.8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(out)


def film(source: Path, out: Path, *, width: int = 360, every: int = 3) -> None:
    """Write a small repeating film: every third picture of 30 per second."""
    import imageio_ffmpeg
    from PIL import Image

    reader = imageio_ffmpeg.read_frames(str(source))
    size = next(reader)["size"]
    pictures = [Image.frombytes("RGB", size, data) for data in reader][::every]
    small = [
        np.asarray(picture.resize((width, width * size[1] // size[0]), Image.Resampling.LANCZOS))
        for picture in pictures
    ]
    write_film(out, small, frames_per_second=30 / every)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--film", type=Path, metavar="FILE", help="film of `make demo`")
    options = parser.parse_args()
    if options.film is not None:
        film(options.film, ROOT / "docs" / "film.gif")
    else:
        draw(ROOT / "docs" / "error_against_time.png")


if __name__ == "__main__":
    main()
