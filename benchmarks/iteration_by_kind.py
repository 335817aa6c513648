"""Microseconds of an iteration on a GPU, of cloth and of solids with a Poisson ratio, in each kernel that takes them.

Sheets and bars are held at one side. Times are medians of steps in a CUDA graph, divided by their iterations. Of a
sheet, the least bytes of an iteration are those that the kernel stream reads and writes once; the share is that of the
copy bandwidth. Of a bar, the ratio is that to the bar with Poisson's ratio 0 in the same kernel.

    python benchmarks/iteration_by_kind.py --out benchmarks/results/iteration-by-kind-h200.json
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gpu_timing import copy_bandwidth, graph_times
from machine import aligned, cell, describe_run, write_result
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.plan.cpu_plan import Plan

TIME_STEP = 1 / 60
BAR_ITERATIONS = 64
# u, the previous iterate and the target are read, one of them is written; each slot reads u and origin
_VERTEX_VECTORS, _SLOT_VECTORS = 4, 2


class ClothScene(NamedTuple):
    """A sheet of square cells, copies of it, iterations of a step and the kernel."""

    cells: tuple[int, int]
    batch: int
    iterations: int
    kernel: str


class BarScene(NamedTuple):
    """A bar of cubes of six tetrahedra with Poisson's ratio and groups of tetrahedra that share a volume."""

    cells: tuple[int, int, int]
    batch: int
    kernel: str
    poisson: float
    averaging: int


def _bars() -> dict[str, BarScene]:
    """Each size in its kernel: 0, then 0.3 by the group."""
    sizes = {
        "256x8192": ((15, 3, 3), 8192, "block"), "10k": ((39, 15, 15), 1, "grid"), "1M": ((255, 63, 63), 1, "stream"),
    }  # fmt: skip
    materials = {"0": (0.0, 1), "0.3-1": (0.3, 1), "0.3-2": (0.3, 2), "0.3-4": (0.3, 4)}
    return {
        f"bar-{size}-{name}": BarScene(*row, *material)
        for size, row in sizes.items()
        for name, material in materials.items()
    }


BAR_SCENES = _bars()
CLOTH_SCENES = {
    "one-1M": ClothScene((1000, 1000), 1, 64, "stream"),
    "one-100k": ClothScene((316, 316), 1, 64, "stream"),
    "many-400": ClothScene((19, 19), 8192, 64, "block"),
    "many-400-stream": ClothScene((19, 19), 8192, 64, "stream"),
    "one-400": ClothScene((19, 19), 1, 64, "block"),
}
SCENES = (*CLOTH_SCENES, *BAR_SCENES)


def sheet(cells: tuple[int, int]) -> pd.TriMesh:
    """A unit square of cells, each cut along one of its diagonals in turn."""
    x, z = (np.linspace(0.0, 1.0, count + 1) for count in cells)
    vertices = np.stack([np.repeat(x, len(z)), np.zeros(len(x) * len(z)), np.tile(z, len(x))], axis=1)
    i, j = (index.ravel() for index in np.meshgrid(*(np.arange(count) for count in cells), indexing="ij"))
    a = i * (cells[1] + 1) + j
    b, c, d = a + cells[1] + 1, a + cells[1] + 2, a + 1
    even = np.stack([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)], axis=1)
    odd = np.stack([np.stack([a, d, b], axis=1), np.stack([b, d, c], axis=1)], axis=1)
    return pd.TriMesh(vertices, np.where(((i + j) % 2 == 1)[:, None, None], odd, even).reshape(-1, 3))


def stream_bytes(plan: Plan, batch: int) -> int:
    """Bytes that an iteration of kernel stream reads and writes at least."""
    real = torch.finfo(plan.dtype).bits // 8
    # rows of 32 corners, stored numbers and numbers of a step, of each block of stencils that are elements
    first = plan.stencil_block[:, 1:].cpu()
    rows = torch.diff(torch.cat([first, plan.stencil_sizes[None, 1:4]]), dim=0)
    if len(plan.patch_element):
        block = torch.arange(len(rows))
        patch = torch.searchsorted(plan.patch_stencil.cpu(), block, right=True) - 1
        rows = rows[block < plan.patch_element.cpu()[patch]]
    elements = 32 * int((rows.sum(dim=0) * torch.tensor([4, real, real])).sum())
    # then the rows of quadratic ones: two neighbours and their numbers
    elements += plan.row_corner.nbytes + plan.row_neighbour.nbytes + 2 * real * plan.row_neighbour.numel()
    state = 4 * real * (_VERTEX_VECTORS * plan.vertices + _SLOT_VECTORS * plan.size("slots"))
    return batch * (elements + state)


@torch.no_grad()
def measure_cloth(
    name: str, dtype: torch.dtype, device: torch.device, repetitions: int, seconds: float
) -> dict[str, Any]:
    """A row: sizes, microseconds of an iteration and the share of the bandwidth."""
    scene = CLOTH_SCENES[name]
    mesh = sheet(scene.cells)
    body = pd.Cloth(mesh, youngs=1e5, thickness=1e-3, area_density=0.2, bending=1e-5)
    parts = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(
        parts, TIME_STEP, scene.iterations, dtype=dtype, progress=False, kernel=scene.kernel, batch=scene.batch
    ).to(device)
    state = sim.rest_state(scene.batch)
    state.velocities[..., 1] = state.positions[..., 0]
    times = graph_times(lambda: sim(state), repetitions=repetitions, seconds=seconds)
    iteration = statistics.median(times) / scene.iterations
    least = stream_bytes(sim.plan, scene.batch)
    return {
        "scene": name, "dtype": str(dtype).removeprefix("torch."), "kernel": sim.plan.kernel,
        "patches": sim.plan.patches, "vertices": sim.vertices, "batch": scene.batch, "iterations": scene.iterations,
        "triangles": len(mesh.triangles), "iteration_microseconds": 1e6 * iteration, "least_bytes": least,
        "bandwidth_share": least / copy_bandwidth(device) / iteration if scene.kernel == "stream" else None,
    }  # fmt: skip


@torch.no_grad()
def measure_bar(
    name: str, dtype: torch.dtype, device: torch.device, repetitions: int, seconds: float
) -> dict[str, Any]:
    """A row: sizes and microseconds of an iteration."""
    scene = BAR_SCENES[name]
    mesh = pd.shapes.box((1.0, 0.2, 0.2), scene.cells)
    body = pd.Solid(mesh, 1e5, 1000.0, poisson=scene.poisson, averaging=scene.averaging)
    parts = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(
        parts, TIME_STEP, BAR_ITERATIONS, dtype=dtype, progress=False, kernel=scene.kernel, batch=scene.batch
    ).to(device)
    state = sim.rest_state(scene.batch)
    state.velocities[..., 1] = -3.0 * state.positions[..., 0] ** 2
    times = graph_times(lambda: sim(state), repetitions=repetitions, seconds=seconds)
    return {
        "scene": name, "dtype": str(dtype).removeprefix("torch."), "kernel": sim.plan.kernel,
        "patches": sim.plan.patches, "vertices": sim.vertices, "batch": scene.batch, "iterations": BAR_ITERATIONS,
        "tetrahedra": len(mesh.tets), "iteration_microseconds": 1e6 * statistics.median(times) / BAR_ITERATIONS,
        "bandwidth_share": None,
    }  # fmt: skip


def with_ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of bars with the time over that of Poisson's ratio 0 of the same size, kernel and precision."""
    base = {(row["scene"], row["dtype"]): row["iteration_microseconds"] for row in rows}

    def ratio(row: dict[str, Any]) -> float | None:
        first = base.get((f"{row['scene'].rsplit('-0', 1)[0]}-0", row["dtype"])) if row["scene"] in BAR_SCENES else None
        return row["iteration_microseconds"] / first if first else None

    return [{**row, "over_poisson_0": ratio(row)} for row in rows]


def table(rows: list[dict[str, Any]]) -> str:
    """Table of the rows."""
    head = [
        "scene",
        "dtype",
        "kernel",
        "patches",
        "vertices",
        "batch",
        "us/iteration",
        "share of bandwidth",
        "/ nu = 0",
    ]
    lines = [
        [
            row["scene"], row["dtype"], row["kernel"], str(row["patches"]), str(row["vertices"]), str(row["batch"]),
            cell(row["iteration_microseconds"], 2), cell(row["bandwidth_share"], 2),
            cell(row["over_poisson_0"], 2),
        ]
        for row in rows
    ]  # fmt: skip
    return aligned([head, *lines])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--dtype", nargs="+", choices=("float32", "float64"), default=["float32"])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--repetitions", type=int, default=5, help="timed steps (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.3, help="least duration of timing a scene (%(default)s)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args()
    device = torch.device(options.device)
    cases = [(name, getattr(torch, dtype)) for dtype in options.dtype for name in options.scenes]
    rows = with_ratios(
        [
            (measure_bar if case[0] in BAR_SCENES else measure_cloth)(
                *case, device, options.repetitions, options.seconds
            )
            for case in tqdm(cases, desc="iterations", unit="scene")
        ]
    )
    print(table(rows))
    if options.out:
        write_result(options.out, {"schema": 1, **describe_run(device, torch.get_num_threads()), "rows": rows})


if __name__ == "__main__":
    main()
