"""Drop a torus of free-form patches on the ground; its surface follows the constraints and is written as a film."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
import trimesh

import torchpd as tpd
from torchpd.freeform.continuity import measure_continuity
from torchpd.viewing.animation import write_surface

TIME_STEP = 1 / 60  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60, help="of 1/60 s")
    parser.add_argument("--stiffness", type=float, default=1e4, help="st, half of Young's modulus [Pa]")
    parser.add_argument("--level", type=int, default=4, help="segments along an edge of a patch")
    parser.add_argument("--out", type=Path, default=Path("patches.glb"), help=".glb or .usdc")
    options = parser.parse_args()

    # a bump or a dent on every vertex of a coarse torus, the largest a quarter of its radius
    base = tpd.TriMesh.from_trimesh(trimesh.creation.torus(0.4, 0.15, major_sections=20, minor_sections=10))
    base = base.transformed(trimesh.transformations.rotation_matrix(1.0, [1, 0, 0])).translated((0.0, 0.8, 0.0))
    torch.manual_seed(0)
    radii = 0.1 * (0.8 + 0.4 * torch.rand(len(base.vertices)))
    heights = 0.25 * radii * (2.0 * torch.rand(len(radii)) - 1.0)
    quadrics = tpd.Quadrics.from_radii(heights, torch.tensor(base.vertices).float(), radii)
    patches = tpd.FreeFormPatches.from_mesh(base, quadrics, base="phong")

    body = tpd.PatchBody(patches, stiffness=options.stiffness, density=1000.0)
    print(body)
    sim = tpd.Simulator(tpd.Scene(body, tpd.Gravity(), tpd.Ground(friction=0.5)), TIME_STEP, iterations=64)
    track = sim.rollout(sim.rest_state(), options.steps, return_info=True, progress=True)

    # every frame is a pose of the same patches: heights are fixed in the material, so evaluate them once
    grid = patches.tessellate(options.level)
    pose = body.pose(track.positions.flatten(0, 1))
    frames = patches.surface(grid.samples, pose, heights=patches.heights(grid.samples)).points
    write_surface(options.out, frames, grid.triangles, frames_per_second=1.0 / TIME_STEP)

    end = measure_continuity(patches, body.pose(track.positions[-1]))
    print(f"lowest point {float(frames[-1, :, 1].min()):.3f} m, residual {float(track.info.residual[-1]):.1e}")
    angles = f"{end.mean_angle:.1f} degrees, up to {end.largest_angle:.1f}"
    print(f"between patches: gaps up to {end.gap:.1e} m, creases of {angles}")
    print(f"written: {options.out}, {len(grid.triangles)} triangles in {len(frames)} frames")


if __name__ == "__main__":
    main()
