"""Bytes against error: free-form patches beside plain triangles and PN triangles over the same coarse triangles.

The three shapes are a bumpy blob (a function), the octopus of `torchpd.shapes`, and your own mesh. Bytes count float32
numbers and 16-bit indices (32-bit above 65536 vertices). A vertex takes 3 floats in a triangle mesh, and 5 in patches
and PN triangles (position and normal); a quadric takes 10. The error is the distance of the surface from the shape,
root mean square over the area, relative to the longest side of the shape.

PN triangles: Vlachos et al. (2001), with the shape's own normals at their vertices.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from machine import describe_run, write_result
from numpy.typing import NDArray
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.freeform.fit_samples import inner_points
from torchpd.freeform.targets import FitTarget, base_triangles, target_of
from torchpd.geometry.decimate import simplify

Array = NDArray[np.float64]
Row = dict[str, Any]

BLOB_BOX = [[-1.5] * 3, [1.5] * 3]  # m
STYLES = {
    "triangles, vertices on the shape": ("#a9adb5", "s"),
    "triangles, least quadric error": ("#6f737b", "D"),
    "PN triangles": ("#0072b2", "^"),
    "patches, flat base": ("#e69f00", "o"),
    "patches, phong base": ("#d55e00", "o"),
}
# sizes of the fits: patches and quadrics
FITS = {
    "blob": ((20, (20, 40, 60)), (80, (60, 120))),
    "other": ((200, (60,)), (300, (90,)), (600, (120,))),
}
QUICK = {"blob": ((20, (8,)),), "other": ((100, (8,)),)}


def blob(points: torch.Tensor) -> torch.Tensor:
    """A ball of radius 1 with fourteen bumps and dents; negative inside."""
    rng = np.random.default_rng(3)
    ways = points / points.norm(dim=1, keepdim=True).clamp_min(1e-9)
    radius = torch.ones_like(points[:, 0])
    for _ in range(14):
        axis = rng.standard_normal(3)
        height, rate = rng.uniform(0.08, 0.2) * rng.choice([-1.0, 1.0]), rng.uniform(3.0, 8.0)
        radius = radius + height * torch.exp(rate * (ways @ torch.tensor(axis / np.linalg.norm(axis)) - 1.0))
    return points.norm(dim=1) - radius


def spheres(patches: int) -> pd.TriMesh:
    """A sphere of 20, 80, 320, ... triangles, connected."""
    return pd.TriMesh.from_trimesh(trimesh.creation.icosphere(subdivisions=round(np.log(patches / 20) / np.log(4))))


def distances(target: FitTarget, points: Array, triangle_shares: Array) -> tuple[float, float]:
    """Root mean square and largest distance of points, weighted by their shares of the area."""
    distance = target.near(points)[0]
    weights = triangle_shares / triangle_shares.sum()
    return float(np.sqrt((weights * distance**2).sum())), float(np.abs(distance).max())


def flat_points(corners: Array, normals: Array, b: Array) -> Array:
    """Points [P, n, 3] of plain triangles [P, 3, 3]."""
    return np.asarray(np.einsum("nk,pkx->pnx", b, corners))


def pn_points(corners: Array, normals: Array, b: Array) -> Array:
    """Points [P, n, 3] of PN triangles: the cubic whose edges leave the corners at right angles to their normals."""
    powers = [b[:, k, None] for k in range(3)]
    out = sum(powers[k] ** 3 * corners[:, None, k] for k in range(3))
    edges = []
    for i in range(3):
        for j in range(3):
            if i == j:
                continue
            drop = ((corners[:, j] - corners[:, i]) * normals[:, i]).sum(axis=1, keepdims=True)
            edge = (2.0 * corners[:, i] + corners[:, j] - drop * normals[:, i]) / 3.0
            edges.append(edge)
            out = out + 3.0 * powers[i] ** 2 * powers[j] * edge[:, None]
    middle = sum(edges) / 6.0
    middle = middle + (middle - corners.mean(axis=1)) / 2.0
    return np.asarray(out + 6.0 * powers[0] * powers[1] * powers[2] * middle[:, None])


def triangle_row(
    name: str, target: FitTarget, mesh: pd.TriMesh, points_of: Callable[[Array, Array, Array], Array], floats: int
) -> Row:
    """Errors at points inside every triangle, weighted by the area of the flat triangle."""
    corners = mesh.vertices[mesh.triangles]
    normals = target.near(mesh.vertices)[2][mesh.triangles]
    level = int(np.clip(np.sqrt(12000 / len(corners)), 2, 12))
    points = points_of(corners, normals, inner_points(level))
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rms, largest = distances(target, points.reshape(-1, 3), np.repeat(area, points.shape[1]))
    index = 2 if len(mesh.vertices) <= 65536 else 4
    size = 4 * floats * len(mesh.vertices) + 3 * index * len(corners)
    return {"method": name, "patches": len(corners), "quadrics": 0, "bytes": size, "rms": rms, "largest": largest}


def study(name: str, shape: Any, *, quick: bool) -> tuple[float, list[Row]]:
    """Size of a shape [m] and its rows, with errors in m."""
    is_blob = name == "blob"
    options = {"bounds": BLOB_BOX} if is_blob else {}
    target = target_of(shape, **options)
    # from the vertices of a base, which needs no bounds of a function
    size = float(np.ptp(base_triangles(target, spheres(1280))[0].bounds, axis=0).max()) if is_blob else target.size
    fits = (QUICK if quick else FITS)["blob" if is_blob else "other"]
    counts = (80,) if quick else (80, 320, 1280) if is_blob else (100, 200, 400, 800, 1600, 3200)
    fine = target.mesh() if quick or not is_blob else base_triangles(target, spheres(5120))[0]
    rows = []
    for count in tqdm(counts, desc=f"{name}: triangles", leave=False):
        coarse = simplify(fine, count)
        mesh = base_triangles(target, spheres(count) if is_blob else coarse)[0]
        rows.append(triangle_row("triangles, vertices on the shape", target, mesh, flat_points, 3))
        rows.append(triangle_row("triangles, least quadric error", target, coarse, flat_points, 3))
        rows.append(triangle_row("PN triangles", target, mesh, pn_points, 5))
    effort: dict[str, Any] = {"iterations": 5} if quick else {}
    settings = [(patches, count, base) for patches, some in fits for count in some for base in ("flat", "phong")]
    for patches, count, base in tqdm(settings, desc=f"{name}: fits", leave=False):
        over = spheres(patches) if is_blob else patches
        try:
            report = pd.FreeFormPatches.fit(shape, count, patches=over, base=base, **options, **effort).report
        except ValueError as error:  # the base is too coarse for the shape: nothing to compare
            tqdm.write(f"{name}, {patches} patches, {count} quadrics, {base} base: {error}")
            continue
        chosen = {k: v for k, v in asdict(report).items() if k != "size"}
        rows.append({"method": f"patches, {base} base", **chosen})
    return size, rows


def table(rows: list[Row]) -> str:
    lines = [f"{'shape':<10} {'method':<34}{'patches':>8}{'quadrics':>9}{'bytes':>9}{'rms/size':>10}{'max/size':>10}"]
    lines += [
        f"{r['shape']:<10} {r['method']:<34}{r['patches']:>8}{r['quadrics']:>9}{r['bytes']:>9,}"
        f"{r['rms'] / r['size']:>10.1e}{r['largest'] / r['size']:>10.1e}"
        for r in rows
    ]
    return "\n".join(lines)


def lower_hull(rows: list[Row]) -> list[Row]:
    """Rows that no row of the same or fewer bytes beats, by bytes."""
    kept: list[Row] = []
    for row in sorted(rows, key=lambda r: (r["bytes"], r["rms"])):
        if not kept or row["rms"] < kept[-1]["rms"]:
            kept.append(row)
    return kept


def draw(rows: list[Row], path: Path) -> None:
    """Draw one panel per shape: all rows as points, the best of each method connected."""
    from matplotlib.figure import Figure

    shapes = list(dict.fromkeys(row["shape"] for row in rows))
    figure = Figure(figsize=(4.6 * len(shapes), 4.6), layout="constrained")
    axes = figure.subplots(1, len(shapes), sharey=True, squeeze=False)[0]
    for axis, shape in zip(axes, shapes, strict=True):
        for method, (colour, marker) in STYLES.items():
            own = [row for row in rows if row["shape"] == shape and row["method"] == method]
            best = lower_hull(own)
            axis.plot(
                [r["bytes"] for r in own], [r["rms"] / r["size"] for r in own], marker, color=colour, alpha=0.35, ms=4
            )
            axis.plot(
                [r["bytes"] for r in best],
                [r["rms"] / r["size"] for r in best],
                marker + "-",
                color=colour,
                label=method,
            )
        axis.set(title=shape, xscale="log", yscale="log", xlabel="bytes")
        axis.set_xticks([1000, 3000, 10000, 30000], ["1 k", "3 k", "10 k", "30 k"])
        axis.tick_params(axis="x", which="minor", labelbottom=False)
        axis.grid(which="both", color="#e4e5e8", lw=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("distance, rms / size of the shape")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path, help="surfaces or tetrahedral meshes to study too")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    parser.add_argument("--picture", type=Path, help="picture file (PNG)")
    parser.add_argument("--quick", action="store_true", help="few and short fits, only to check that it runs")
    options = parser.parse_args()
    shapes: dict[str, Any] = {"blob": blob, "octopus": pd.shapes.octopus(cells=16 if options.quick else 24)}
    shapes |= {path.stem: pd.TriMesh.from_file(path) for path in options.meshes}
    rows: list[Row] = []
    for name, shape in shapes.items():
        size, found = study(name, shape, quick=options.quick)
        rows += [{"shape": name, "size": size, **row} for row in found]
    print(table(rows))
    if options.out:
        run = describe_run(torch.device("cpu"), torch.get_num_threads())
        write_result(options.out, {"schema": 1, **run, "rows": rows})
    if options.picture:
        draw(rows, options.picture)


if __name__ == "__main__":
    main()
