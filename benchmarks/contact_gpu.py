"""Milliseconds of a step with contact between bodies on a GPU: 64 iterations, float32, in a CUDA graph.

apart   two bodies of 128 vertices that touch nothing, in every environment
edge    one on the rim of the other: about 50 pairs
half    with a part of it on the other: about 300 pairs
stack   one on the other: about 1400 pairs
sphere  a cloth of 40 x 40 vertices over a rigid sphere
fold    one cloth that lies on itself

python benchmarks/contact_gpu.py --out contact-gpu.json
python benchmarks/contact_gpu.py --gradients --batch 512    a step and its backward pass, without a graph
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from body_contact import level
from machine import describe_run, write_result

import torchpd as pd

GPU = torch.device("cuda", 0)
SETTLES = 10  # steps before the clock starts
Row = dict[str, Any]


def bar(height: float, x: float = 0.0) -> pd.Solid:
    """A bar of .07 x .03 x .03 m, of 128 vertices."""
    mesh = pd.shapes.box((0.07, 0.03, 0.03), (7, 3, 3)).translated((x, height, 0.0))
    return pd.Solid(mesh, youngs=1e5, density=1000.0)


def two(x: float) -> list[Any]:
    return [bar(0.0), bar(0.0305 if x < 0.5 else 0.0, x), pd.Ground(friction=0.5), pd.Contact(thickness=5e-4)]


def over_sphere() -> list[Any]:
    sheet = pd.Cloth(level(0.4, 39, 0.105), youngs=1e5, thickness=1e-3, area_density=0.2, bending=1e-5)
    box = pd.shapes.box((2.0,) * 3, (8,) * 3)
    p = box.vertices - box.vertices.mean(axis=0)
    far = np.maximum(np.linalg.norm(p, axis=1, keepdims=True), 1e-300)
    ball = pd.TetMesh(0.1 * p * np.abs(p).max(axis=1, keepdims=True) / far, box.tets)
    return [sheet, pd.Collider(ball, friction=0.3), pd.Contact(thickness=1e-3)]


def fold(cells: int) -> list[Any]:
    """A sheet of 1 m that turns back on itself, 5 mm above, over a ground."""
    mesh, radius = level(1.0, cells, 0.0), 0.0025
    along, across = mesh.vertices[:, 0], mesh.vertices[:, 2]
    angle = np.clip(along / radius, 0.0, math.pi)
    beyond = np.maximum(along - math.pi * radius, 0.0)
    x = np.minimum(along, 0.0) + radius * np.sin(angle) - beyond
    places = np.stack([x, radius * (1.0 - np.cos(angle)) + 0.002, across], axis=1)
    sheet = pd.Cloth(pd.TriMesh(places, mesh.triangles), youngs=1e5, thickness=1e-3, area_density=0.2, bending=1e-6)
    return [sheet, pd.Ground(friction=0.5), pd.Contact(thickness=min(1e-3, 0.1 / cells), friction=0.3)]


SCENES: dict[str, tuple[Callable[[], list[Any]], tuple[int, ...]]] = {
    "apart": (lambda: two(1.0), (1000, 8192)),
    "edge": (lambda: two(0.055), (1000, 8192)),
    "half": (lambda: two(0.025), (1000, 8192)),
    "stack": (lambda: two(0.0), (1000, 8192)),
    "sphere": (over_sphere, (1024,)),
    "fold": (lambda: fold(315), (1,)),
}


def measure(name: str, batch: int, steps: int, iterations: int, profile: bool) -> Row:
    scene = pd.Scene(*SCENES[name][0](), pd.Gravity())
    sim = pd.Simulator(scene, iterations=iterations, progress=False, device=GPU, batch=batch)
    state: Any = sim.rest_state(batch)
    for _ in range(SETTLES):
        state, info = sim(state, return_info=True)
    captured = sim.capture(state.clone(), return_info=True)
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    captured.replay()
    begin.record()
    for _ in range(steps):
        captured.replay()
    end.record()
    torch.cuda.synchronize()
    assert sim.body_contact is not None
    milliseconds = begin.elapsed_time(end) / steps
    numbers = counts(sim, state)
    row: Row = {
        "scene": name,
        "batch": batch,
        "vertices": sim.vertices,
        "triangles": len(sim.body_contact.plan.triangles),
        "pairs": float(numbers[:, 4].mean()),
        "searches": float(numbers[:, 5].mean()),
        "forces": float((state.history.keys >= 0).sum()) / batch,
        "milliseconds": milliseconds,
        "environment_steps_per_second": batch / milliseconds * 1e3,
        "gap": float(info.contact_gap.min()),
        "gibibytes": torch.cuda.max_memory_allocated() / 2**30,
    }
    print(
        f"{name:<7}{batch:6} x{row['vertices']:7} vertices, {row['pairs']:9.0f} pairs, {row['searches']:5.1f} searches,"
        f" {row['forces']:8.0f} forces: {milliseconds:8.3f} ms, {row['environment_steps_per_second'] / 1e3:8.1f} k/s, "
        f"{row['gibibytes']:.1f} GiB, gap {row['gap']:.2f}",
        flush=True,
    )
    if profile:
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as trace:
            sim(state)
            torch.cuda.synchronize()
        print(trace.key_averages().table(sort_by="cuda_time_total", row_limit=8, max_name_column_width=70))
    torch.cuda.reset_peak_memory_stats()
    return row


def measure_gradients(name: str, batch: int, steps: int, iterations: int) -> Row:
    """A training step: one step of all environments, and the gradient of a loss by state, stiffness and friction."""
    scene = pd.Scene(*SCENES[name][0](), pd.Gravity())
    sim = pd.Simulator(scene, iterations=iterations, progress=False, device=GPU, batch=batch)
    state: Any = sim.rest_state(batch)
    with torch.no_grad():
        for _ in range(SETTLES):
            state = sim(state)
    sim.contact_friction = torch.full((), 0.4, device=GPU, requires_grad=True)
    sim.stiffness.requires_grad_()
    torch.cuda.reset_peak_memory_stats()
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(3)]
    spent = torch.zeros(2)
    for number in range(steps + 1):
        x, v = state.positions.clone().requires_grad_(), state.velocities.clone().requires_grad_()
        marks[0].record()
        after = sim(pd.HistoryState(x, v, state.history))
        loss = after.positions.square().sum()
        marks[1].record()
        loss.backward()
        marks[2].record()
        torch.cuda.synchronize()
        if number:  # the first one loads kernels
            spent += torch.tensor([marks[n].elapsed_time(marks[n + 1]) for n in range(2)])
        assert x.grad is not None
        assert bool(x.grad.isfinite().all())
    forward, backward = (spent / steps).tolist()
    row: Row = {
        "scene": name,
        "batch": batch,
        "vertices": sim.vertices,
        "forces": float((state.history.forces[..., 0] > 0).sum()) / batch,
        "forward_milliseconds": forward,
        "backward_milliseconds": backward,
        "environment_steps_per_second": batch / (forward + backward) * 1e3,
        "gibibytes": torch.cuda.max_memory_allocated() / 2**30,
    }
    print(
        f"{name:<7}{batch:6} x{row['vertices']:7} vertices, {row['forces']:8.0f} forces: forward {forward:8.2f} ms, "
        f"backward {backward:8.2f} ms, {row['environment_steps_per_second']:8.0f} /s, {row['gibibytes']:.2f} GiB",
        flush=True,
    )
    return row


def counts(sim: pd.Simulator, state: Any) -> torch.Tensor:
    """Numbers of the contact of one more step [B, 8], columns in csrc/contact/views.h."""
    assert sim.body_contact is not None
    history = [state.history.poses, state.history.keys, state.history.forces]
    settings = sim.step_settings(inertial=False, report=False)
    of = sim.body_contact.arrays
    found = torch.ops.torchpd.contact_step(
        state[0], state[1], None, history[0], history, sim.material(), list(sim.plan.arrays), of, **settings
    )
    numbers: torch.Tensor = found[3]
    return numbers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--steps", type=int, default=10, help="that are timed")
    parser.add_argument("--iterations", type=int, default=64)
    parser.add_argument("--batch", type=int, nargs="+", help="environments, instead of those of the scenes")
    parser.add_argument("--gradients", action="store_true", help="steps and their backward passes")
    parser.add_argument("--profile", action="store_true", help="print the kernels that take longest")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    rows = [
        measure_gradients(name, batch, options.steps, options.iterations)
        if options.gradients
        else measure(name, batch, options.steps, options.iterations, options.profile)
        for name in options.scenes
        for batch in options.batch or SCENES[name][1]
    ]
    if options.out:
        write_result(options.out, {**describe_run(GPU, torch.get_num_threads()), "rows": rows})


if __name__ == "__main__":
    main()
