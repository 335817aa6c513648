"""What a gradient costs beside the step that it goes through: milliseconds forward, and backward.

A held bar swings, float32, time step 1/60 s, 64 guarded iterations, from 1e6 Pa on 256; the loss is the sum of squares
of the new positions, and the velocities before are asked for their gradients. Times are medians, as Python calls it,
device awaited. On a GPU also both ways with kernel "block", and these in a CUDA graph, which it alone allows.

    python benchmarks/gradients.py --threads 1
    python benchmarks/gradients.py --device cuda --threads 16
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from gpu_scenes import GpuScene
from gpu_timing import graph_times
from machine import describe_run, measure
from tqdm import tqdm

import torchpd as pd

Row = dict[str, Any]

# cells, batch
SCENES = (((3, 3, 3), 1), ((3, 3, 3), 64), ((15, 3, 3), 1), ((15, 3, 3), 64), ((15, 3, 3), 1024), ((9, 9, 9), 64))
YOUNGS = (1e4, 1e5, 1e6)
TIMES = {
    "forward": "forward ms",
    "backward": "backward ms",
    "block": "both, `block`",
    "recorded": "in a CUDA graph",
}


def measure_scene(cells: tuple[int, int, int], batch: int, youngs: float, device: torch.device, seconds: float) -> Row:
    """One row of the result."""
    scene = GpuScene("bar", cells, batch)

    def simulator(kernel: str) -> tuple[pd.Simulator, pd.State]:
        sim = pd.Simulator(
            scene.build(), 1 / 60, 64 if youngs < 1e6 else 256, solver=pd.Chebyshev(), progress=False, kernel=kernel,
            batch=batch,
        ).to(device)  # fmt: skip
        sim.set_material(stiffness=sim.stiffness * (youngs / float(sim.stiffness.max())))
        state = scene.start(sim)
        state.velocities.requires_grad_()
        return sim, state

    def forward(sim: pd.Simulator, state: pd.State) -> torch.Tensor:
        return sim(state).positions.square().sum()

    def both(sim: pd.Simulator, state: pd.State) -> None:
        torch.autograd.grad(forward(sim, state), state.velocities)

    def median(work: Callable[..., object], *given: Any) -> float:
        return 1e3 * statistics.median(measure(lambda: work(*given), device, repetitions=3, seconds=seconds))

    sim, state = simulator("auto")
    once, all_of_it = median(forward, sim, state), median(both, sim, state)
    row = {
        "vertices": sim.vertices, "batch": batch, "youngs": youngs, "iterations": sim.iterations,
        "kernel": sim.plan.kernel, "forward": once, "backward": all_of_it - once, "block": None, "recorded": None,
    }  # fmt: skip
    if device.type == "cuda":
        own = simulator("block")
        row["block"] = median(both, *own)
        times = graph_times(lambda: both(*own), repetitions=3, seconds=seconds)
        row["recorded"] = 1e3 * statistics.median(times)
    return row


def line_of(row: Row) -> str:
    """For a reader."""
    names = [name for name in TIMES if row[name] is not None]
    times = " | ".join(f"{row[name]:.3g}" for name in names)
    share = row["backward"] / row["forward"]
    return f"| {row['batch']} x {row['vertices']} | {row['youngs']:.0e} Pa | {times} | {share:.2g} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="of the CPU (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.5, help="of timing a scene (%(default)g)")
    parser.add_argument("--out", type=Path, help="file for the result (JSON)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    jobs = [(cells, batch, youngs) for cells, batch in SCENES for youngs in YOUNGS]
    rows = [
        measure_scene(cells, batch, youngs, device, options.seconds)
        for cells, batch, youngs in tqdm(jobs, desc="measuring", unit="scene", leave=False)
    ]
    heads = [head for name, head in TIMES.items() if rows[0][name] is not None]
    print("| " + " | ".join(["batch x vertices", "Young's modulus", *heads, "backward / forward"]) + " |")
    print("|---|---|" + "---|" * (len(heads) + 1))
    for row in rows:
        print(line_of(row))
    if options.out:
        result = {"schema": 1, **describe_run(device, options.threads), "rows": rows}
        options.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
