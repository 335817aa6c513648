"""Throughput of free-form patches: heights, surface points and rays per second beside lower bounds; and fits.

A ball has 20 x 4^n patches and as many quadrics as vertices, float32. A lower bound on the CPU is the larger of two
times. The first is that of the fewest additions and multiplications in the formulas, at the scalar rate of all
threads: the rate of the extension's SIMD multiply-adds over the lanes. The second is that of the bytes read and
written, at the rate of a large copy. A ray counts the boxes on one path of the tree and, if it hits, two surface
points: one to correct, one to verify.

"search" is the op, "hits" adds points and normals, "picture" shades. "field" intersects the published field, with a
tree and with every patch tried for every ray. "fit" is `FreeFormPatches.fit` of a bumpy blob, on the CPU for any
device. "fit, one step" is `PatchLoss` over the same patches and its gradients by the quadrics, on the device.

    python benchmarks/patches.py --device cpu --out benchmarks/results/NAME.json
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from compactness import BLOB_BOX, blob, spheres
from machine import describe_run, measure, multiply_adds_per_second, write_result

import torchpd as pd
from torchpd import _C
from torchpd.viewing.render import Camera

LANES = {"avx512": 16, "avx2": 8}
CAMERA = Camera((0.0, 0.0, 4.2), (0.0, 0.0, 0.0), 32.0)
# numbers of additions and multiplications
POINT, ENTRY, ACTIVE, SLOPES = 15, 18, 30, 16  # P; Q; R and its gradient where Q > 0; dh along the chart
POSED = 3 * (15 + 3 + 3 * 5 + 3) + 15 + 2 * (3 * (6 + 15) + 15 + 6)  # sum_k b_k (v_k + A_k u_k), and two tangents
SHEET = 15 + 3 * (7 + 8) + 2 * (3 + 16 + 3 * 8 + 12)  # the same, with the frames multiplied out once per patch
BOX = 12


def ball(subdivisions: int, device: torch.device) -> pd.FreeFormPatches:
    """A ball with bumps at the vertices, about as wide as the patches."""
    mesh = pd.TriMesh.from_trimesh(trimesh.creation.icosphere(subdivisions=subdivisions))
    rng = np.random.default_rng(0)
    count = len(mesh.vertices)
    radius = 1.2 / 2**subdivisions
    amplitudes = torch.tensor(0.15 * radius * rng.uniform(-1, 1, count), dtype=torch.float32)
    quadrics = pd.Quadrics.from_radii(
        amplitudes, torch.tensor(mesh.vertices, dtype=torch.float32), torch.full((count,), radius)
    )
    return pd.FreeFormPatches.from_mesh(mesh, quadrics).to(device)


def places(patches: pd.FreeFormPatches, count: int) -> pd.PatchSamples:
    generator = torch.Generator().manual_seed(0)
    number = torch.arange(count) * len(patches.triangles) // count
    b = torch.rand(count, 3, generator=generator)
    return patches.samples(number.to(patches.vertices.device), (b / b.sum(1, keepdim=True)).to(patches.vertices))


def floors(
    patches: pd.FreeFormPatches, where: pd.PatchSamples, cells: int, hits: float
) -> dict[str, tuple[float, float]]:
    """Arithmetic operations and bytes of one height, surface point (with its height) and ray."""
    entries = len(patches.lists[2]) / len(patches.triangles)
    rest = (where.barycentrics[:, :, None] * patches.vertices[patches.triangles.long()[where.patch.long()]]).sum(1)
    some = rest[:: max(1, len(rest) // 2000)]
    active = float((patches.quadrics.values(some) != 0).sum(1).double().mean())
    height = POINT + entries * ENTRY + active * ACTIVE + SLOPES
    surface = height + POSED
    ray = 2 * BOX * math.log2(cells / 2) + hits * 2 * (height + SHEET)
    return {
        "heights": (height, 4.0 * (4 + 3)),
        "surface points": (surface, 4.0 * (4 + 3 + 3 + 9)),
        "rays": (ray, 4.0 * (6 + 5)),
    }


def copied_bytes_per_second(device: torch.device) -> float:
    a = torch.ones(2**25, device=device)
    b = torch.empty_like(a)
    return 2 * 4 * len(a) / min(measure(lambda: b.copy_(a), device, repetitions=3, seconds=0.2))


def measure_patches(subdivisions: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    device = torch.device(options.device)
    patches = ball(subdivisions, device)
    rays, where = pd.PatchRays(patches), places(patches, options.samples)
    size = (options.pixels, options.pixels)
    directions = torch.as_tensor(CAMERA.rays(size)).to(patches.vertices).reshape(-1, 3)
    origins = patches.vertices.new_tensor(CAMERA.origin).expand_as(directions)
    hits = float(rays.cast(origins, directions).hit.double().mean())
    some, along = (t[:: max(1, len(t) * len(patches.triangles) // 10**7)] for t in (origins, directions))
    per_item = floors(patches, where, len(patches.triangles) * rays.level**2, hits)
    pixels = options.pixels**2
    work: dict[str, tuple[Callable[[], object], int, str]] = {
        "heights": (lambda: patches.heights(where), options.samples, "heights"),
        "surface points": (lambda: patches.surface(where), options.samples, "surface points"),
        "rays, search": (lambda: rays.search(origins, directions), pixels, "rays"),
        "rays, hits": (lambda: rays.cast(origins, directions), pixels, "rays"),
        "field": (lambda: rays.cast_field(origins, directions, far=9.0), pixels, ""),
        "field, exhaustive": (lambda: rays.cast_field(some, along, far=9.0, exhaustive=True), len(some), ""),
        "picture": (lambda: rays.render(CAMERA, size), pixels, "rays"),
    }
    rows = []
    for name, (run, count, floor) in work.items():
        rate = multiply_adds_per_second() / LANES.get(_C.build_info()["simd"], 4) * torch.get_num_threads()
        with torch.no_grad():
            seconds = min(measure(run, device, repetitions=options.repetitions, seconds=options.seconds))
        row: dict[str, Any] = {"patches": len(patches.triangles), "what": name, "per_second": count / seconds}
        if device.type == "cpu" and floor:
            arithmetic, moved = per_item[floor]
            row["floor_per_second"] = min(rate / arithmetic, copied_bytes_per_second(device) / moved)
            row["times_floor"] = row["floor_per_second"] / row["per_second"]
        rows.append(row)
        beside = f"{row['times_floor']:8.1f} x the floor" if "times_floor" in row else ""
        print(f"{row['patches']:6d} patches  {name:<16} {row['per_second'] / 1e6:10.3f} M/s {beside}", flush=True)
    return rows


def measure_fit(options: argparse.Namespace) -> list[dict[str, Any]]:
    device = torch.device(options.device)
    patches, quadrics = options.fit
    begin = time.perf_counter()
    fit = pd.FreeFormPatches.fit(blob, quadrics, patches=spheres(patches), bounds=BLOB_BOX)
    seconds = time.perf_counter() - begin
    fitted = fit.patches.to(device)
    loss = pd.PatchLoss(fitted, blob, bounds=BLOB_BOX)
    q = fitted.quadrics
    leaves = [t.detach().clone().requires_grad_() for t in (q.amplitudes, q.centres, q.factors)]

    def step() -> object:
        return torch.autograd.grad(loss(fitted.with_quadrics(pd.Quadrics(*leaves), keep_lists=True)), leaves)

    one = min(measure(step, device, repetitions=options.repetitions, seconds=options.seconds))
    size = {"patches": len(fitted.triangles), "quadrics": len(q)}
    rows = [
        size | {"what": "fit", "seconds": seconds, "rms": fit.report.rms, "size": fit.report.size},
        size | {"what": "fit, one step", "seconds": one, "samples": len(loss.targets)},
    ]
    print(f"{size['patches']:6d} patches  fit              {seconds:10.2f} s   {fit.report}")
    print(
        f"{size['patches']:6d} patches  fit, one step    {1e3 * one:10.2f} ms  {len(loss.targets)} samples", flush=True
    )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument(
        "--subdivisions", type=int, nargs="+", default=[1, 4], help="subdivisions of the icosahedron: 20 x 4^n patches"
    )
    parser.add_argument(
        "--fit",
        type=int,
        nargs=2,
        default=(20, 20),
        metavar=("PATCHES", "QUADRICS"),
        help="subdivisions of the blob, 20 x 4^n patches",
    )
    parser.add_argument("--samples", type=int, default=1_000_000, help="sample points for heights and surface points")
    parser.add_argument("--pixels", type=int, default=1024, help="pixels per side of the picture")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=0.5, help="least duration of every measurement")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    options = parser.parse_args()
    rows = [row for n in options.subdivisions for row in measure_patches(n, options)] + measure_fit(options)
    if options.out:
        run = describe_run(torch.device(options.device), torch.get_num_threads())
        write_result(options.out, {**run, "rows": rows})


if __name__ == "__main__":
    main()
