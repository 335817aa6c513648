"""Milliseconds of a step with contact between bodies, beside the same step without: 64 iterations, float32, one thread.

    rest     a cube of 1 kg rests on a rigid mesh
    stack    two cubes, one on the other, on the ground
    sheet    a cloth of .3 m falls over a cube and folds
    apart    two cubes that fall side by side and touch nothing
    octopus  the body of `make demo` with 24 lattice cells (--cells 4) lands and bends; its arms may meet

Without `Contact` bodies pass through each other, so only the rows of `apart` compare the same motion.

    OMP_NUM_THREADS=1 python benchmarks/body_contact.py --out body-contact.json
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from machine import describe_run, write_result
from scipy.spatial.transform import Rotation

import torchpd as pd

THICKNESS = 1e-3  # m
SETTLES = 20  # steps before the clock starts
Row = dict[str, Any]


def cube(cells: int, height: float, x: float = 0.0) -> pd.Solid:
    mesh = pd.shapes.box((0.1,) * 3, (cells,) * 3).translated((x - 0.05, height, -0.05))
    return pd.Solid(mesh, youngs=1e5, density=1000.0)


def level(size: float, cells: int, height: float) -> pd.TriMesh:
    """A level grid of triangles."""
    along = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    x, z = np.meshgrid(along, along, indexing="ij")
    vertices = np.stack([x, np.full_like(x, height), z], axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    corners = np.concatenate([np.stack(of, axis=-1).reshape(-1, 3) for of in ((a, c, b), (a, d, c))])
    return pd.TriMesh(vertices, corners)


def sheet(cells: int) -> pd.Cloth:
    return pd.Cloth(level(0.3, 6 * cells, 0.11), youngs=1e5, thickness=1e-3, area_density=0.2, bending=1e-5)


def octopus(cells: int) -> pd.Solid:
    """1 m large, tilted, 0.25 m above the ground."""
    shape = pd.shapes.octopus()
    low, high = shape.bounds
    tilt = Rotation.from_euler("zxy", [25.0, 20.0, 25.0], degrees=True).as_matrix()
    placed = shape.translated(-(low + high) / 2.0).scaled(1.0 / float((high - low).max())).transformed(tilt)
    mesh = pd.tetrahedralize(placed, cells=6 * cells).merged()
    return pd.Solid(mesh.translated((0.0, 0.25 - float(mesh.bounds[0, 1]), 0.0)), youngs=3e4, density=1000.0)


SCENES: dict[str, Callable[[int], list[Any]]] = {
    "rest": lambda cells: [cube(cells, THICKNESS), pd.Collider(level(0.6, 6, 0.0))],
    "stack": lambda cells: [cube(cells, 0.0), cube(cells, 0.1 + THICKNESS, 0.01), pd.Ground(friction=0.5)],
    "sheet": lambda cells: [cube(cells, 0.0), sheet(cells), pd.Ground(friction=0.5)],
    "apart": lambda cells: [cube(cells, 0.0), cube(cells, 0.0, 1.0)],
    "octopus": lambda cells: [octopus(cells), pd.Ground(friction=0.5)],
}


def milliseconds(parts: list[Any], steps: int) -> tuple[float, pd.Simulator]:
    """Time of a step after the bodies have met."""
    sim = pd.Simulator(pd.Scene(*parts, pd.Gravity()), iterations=64, progress=False)
    state = sim.rollout(sim.rest_state(), SETTLES, every=SETTLES).state()
    begin = time.perf_counter()
    sim.rollout(state, steps, every=steps)
    return (time.perf_counter() - begin) / steps * 1e3, sim


def backward_milliseconds(sim: pd.Simulator, steps: int) -> float:
    """Time of the gradient of a step by its state, on the way of `milliseconds`."""
    state: Any = sim.rollout(sim.rest_state(), SETTLES, every=SETTLES).state()
    spent = 0.0
    for _ in range(steps):
        x, v = state.positions.requires_grad_(), state.velocities.requires_grad_()
        after: Any = sim(state)
        begin = time.perf_counter()
        torch.autograd.grad(after.positions.square().sum() + after.velocities.sum(), (x, v))
        spent += time.perf_counter() - begin
        state = pd.HistoryState(after.positions.detach(), after.velocities.detach(), after.history)
    return spent / steps * 1e3


def measure(name: str, cells: int, steps: int, *, gradients: bool) -> Row:
    parts = SCENES[name](cells)
    without, _ = milliseconds([part for part in parts if not isinstance(part, pd.Collider)], steps)
    contact = pd.Contact(friction=0.4, thickness=min(THICKNESS, 0.02 / cells))
    with_contact, sim = milliseconds([*parts, contact], steps)
    assert sim.body_contact is not None
    row: Row = {
        "scene": name,
        "cells": cells,
        "vertices": sim.vertices,
        "triangles": len(sim.body_contact.plan.triangles),
        "milliseconds": with_contact,
        "milliseconds_without": without,
    }
    if gradients:
        row["milliseconds_backward"] = backward_milliseconds(sim, steps)
        print(f"{row['milliseconds_backward']:8.2f} ms backward ", end="")
    print(
        f"{name:<8}{row['vertices']:8} vertices{row['triangles']:8} triangles{with_contact:10.2f} ms, {without:.2f} ms "
        "without",
        flush=True,
    )
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[4, 8], help="of a cube along an edge")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--steps", type=int, default=40, help="that are timed, after 20 others")
    parser.add_argument("--gradients", action="store_true", help="also of a step by its state")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    rows = [
        measure(name, cells, options.steps, gradients=options.gradients)
        for name in options.scenes
        for cells in options.cells
    ]
    if options.out:
        write_result(options.out, {**describe_run(torch.device("cpu"), torch.get_num_threads()), "rows": rows})


if __name__ == "__main__":
    main()
