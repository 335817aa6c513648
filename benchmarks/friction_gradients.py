"""Cost of a training step for a body that slides with friction, and for one that rests on the ground.

A cube of 125 or 1000 vertices, float32, 1e5 Pa, time step 1/60 s, 64 iterations; friction 0.4. The loss is the sum of
squares of the new positions, with gradients by forces, velocities and stiffness. Milliseconds are medians, with the
device awaited: forward, and forward plus backward, from Python and in a CUDA graph. Kernel launches are counted for
both. The last row compares the memory of a rollout of ten steps with that of a loop.

    python benchmarks/friction_gradients.py --device cuda --out benchmarks/results/friction-gradients-cuda.json
    python benchmarks/friction_gradients.py --device cuda --adjoint multilevel     # uses kernel "stream"
    PYTHONPATH=../other-checkout python benchmarks/friction_gradients.py --device cuda
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import torch
from gpu_timing import event_times, graph_times
from machine import describe_run, measure, write_result

import torchpd as pd

STEPS = 10  # of a rollout
Row = dict[str, Any]


def cube(
    cells: int, batch: int, speed: float, device: torch.device, adjoint: str = "solver"
) -> tuple[pd.Simulator, pd.State]:
    """A cube on the ground, after a few steps of sliding at this speed."""
    body = pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (cells, cells, cells)), 1e5, density=1000.0)
    scene = pd.Scene(body, pd.Gravity(), pd.Damping(0.5), pd.Ground(0.0, friction=0.4))
    kernel = "stream" if adjoint == "multilevel" else "auto"
    sim = pd.Simulator(scene, 1 / 60, 64, progress=False, batch=batch, adjoint=adjoint, kernel=kernel).to(device)
    state = sim.rest_state(batch)
    state.velocities[..., 0] = speed * torch.linspace(1.0, 1.2, batch, device=device)[:, None]
    with torch.no_grad():
        for _ in range(4 if speed else 30):
            state = sim(state)
    return sim, state


def sliding_vertices(sim: pd.Simulator, state: pd.State) -> float:
    """Mean number of sliding vertices per environment."""
    after = sim(state).positions.detach()
    material, still = [array.detach() for array in sim.material()], torch.zeros_like(after)
    *_, sliding = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, still, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    return float((sliding[..., 0, :] != 0.0).any(-1).sum(-1).double().mean())


def launches(work: Any) -> int:
    """Kernels, copies and fills of one run."""
    work()
    torch.cuda.synchronize()
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds) as profile:
        work()
        torch.cuda.synchronize()
    return sum(e.device_type == torch.autograd.DeviceType.CUDA for e in profile.events())


def training_row(
    cells: int, batch: int, speed: float, device: torch.device, seconds: float, adjoint: str = "solver"
) -> Row:
    sim, state = cube(cells, batch, speed, device, adjoint)
    row: Row = {"vertices": sim.vertices, "batch": batch, "slide": sliding_vertices(sim, state)}
    forces, v = torch.zeros_like(state.positions).requires_grad_(), state.velocities.clone().requires_grad_()
    start, inputs = type(state)(state.positions, v), [forces, v, sim.stiffness.requires_grad_()]

    def forward() -> torch.Tensor:
        return sim(start, forces).positions.square().sum()

    def both() -> None:
        torch.autograd.grad(forward(), inputs)

    def median(work: Any) -> float:
        if device.type == "cuda":
            return 1e3 * statistics.median(event_times(work, repetitions=5, seconds=seconds))
        return 1e3 * statistics.median(measure(work, device, repetitions=3, seconds=seconds))

    row["forward"] = median(forward)
    row["both"] = median(both)
    if device.type == "cuda":
        row["launches"] = launches(both)
        row["recorded forward"] = 1e3 * statistics.median(graph_times(forward, repetitions=5, seconds=seconds))
        row["recorded both"] = 1e3 * statistics.median(graph_times(both, repetitions=5, seconds=seconds))
    return row


def memory_row(batch: int, device: torch.device) -> Row:
    """Peak bytes of ten steps forward and backward, above the bytes before."""
    sim, state = cube(4, batch, 3.0, device)
    v = state.velocities.clone().requires_grad_()
    start = type(state)(state.positions, v)

    def rolled() -> None:
        torch.autograd.grad(sim.rollout(start, STEPS).positions[-1].square().sum(), v)

    def looped() -> None:
        now = start
        for _ in range(STEPS):
            now = sim(now)
        torch.autograd.grad(now.positions.square().sum(), v)

    row: Row = {"vertices": sim.vertices, "batch": batch, "one state": 2 * v.numel() * v.element_size()}
    for name, work in (("rollout", rolled), ("loop", looped)):
        work()
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        torch.cuda.synchronize()
        row[name] = torch.cuda.max_memory_allocated() - before
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--cells", type=int, nargs="+", default=[4, 9], help="cells per edge of the cube (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.3, help="duration of each timing (%(default)g)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    parser.add_argument("--adjoint", choices=("solver", "multilevel"), default="solver", help="(%(default)s)")
    options = parser.parse_args()
    print(f"torchpd of {Path(pd.__file__).parent}, on {options.device}")
    device = torch.device(options.device)
    if device.type == "cuda":
        print(torch.cuda.get_device_name(device))
    rows: list[Row] = []
    for speed in (3.0, 0.0):
        for cells in options.cells:
            for batch in options.batches:
                row = training_row(cells, batch, speed, device, options.seconds, options.adjoint)
                ratio = {"both / forward": row["both"] / row["forward"]}
                if "recorded both" in row:
                    ratio["recorded"] = row["recorded both"] / row["recorded forward"]
                rows.append({**row, **ratio})
                print(", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    if device.type == "cuda":
        rows.append(memory_row(4096, device))
        print(", ".join(f"{name} {value:,}" for name, value in rows[-1].items()))
    if options.out:
        settings = {"adjoint": options.adjoint, **describe_run(device, torch.get_num_threads())}
        write_result(options.out, {"schema": 1, **settings, "rows": rows})


if __name__ == "__main__":
    main()
