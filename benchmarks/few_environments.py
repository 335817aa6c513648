"""Up to how many environments of a small mesh the kernel "cluster" is faster than "block".

Bars that are held at one end and thrown downwards, float32, 64 guarded iterations. A time is that of a CUDA graph of
one step, so the start of the graph is in it; medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import GpuScene
from gpu_timing import event_times, recorded
from machine import describe_run
from scenes import TIME_STEP

import torchpd as pd

MESHES = ((15, 3, 3), (8, 5, 5), (25, 5, 5))  # cells
BATCHES = (1, 8, 16, 32, 48, 64, 96, 132, 264, 1024)
REPETITIONS = 5


def microseconds(cells: tuple[int, int, int], kernel: str, batch: int) -> float:
    """A step of so many environments."""
    scene = GpuScene("few", cells, batch, kernel)
    sim = pd.Simulator(scene.build(), TIME_STEP, scene.iterations, progress=False, kernel=kernel).to("cuda")
    state = scene.start(sim)
    graph = recorded(lambda: sim(state), 1)
    return 1e6 * statistics.median(event_times(graph.replay, repetitions=REPETITIONS, seconds=0.0))


def measure_mesh(cells: tuple[int, int, int]) -> dict[str, Any]:
    """One row of the result: times by kernel, in the order of BATCHES."""
    mesh = GpuScene("few", cells).build().solids[0].mesh
    times = {kernel: [microseconds(cells, kernel, batch) for batch in BATCHES] for kernel in ("block", "cluster")}
    return {"vertices": len(mesh.vertices), "tets": len(mesh.tets), "batches": BATCHES, "microseconds": times}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="file for the result (JSON)")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("torch finds no CUDA device")
    with torch.no_grad():
        rows = [measure_mesh(cells) for cells in MESHES]
    for row in rows:
        print(f"{row['vertices']} vertices, {row['tets']} tets; environments: {row['batches']}")
        for kernel, times in row["microseconds"].items():
            print(f"  {kernel:7} us a step: " + " ".join(f"{time:.0f}" for time in times))
    if options.out:
        result = {**describe_run(torch.device("cuda"), torch.get_num_threads()), "rows": rows}
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
