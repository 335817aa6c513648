"""Fill a surface with tetrahedra, drop it on the ground, and write the motion of the original surface."""

from __future__ import annotations

import argparse
from pathlib import Path

import torchpd as tpd
from torchpd.viewing.animation import write_surface

TIME_STEP = 1 / 60  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("surface", type=Path, nargs="?", help="surface file; default: an octopus")
    parser.add_argument("--cells", type=int, default=16, help="lattice cells along the longest side")
    parser.add_argument("--steps", type=int, default=90, help="of 1/60 s")
    parser.add_argument("--youngs", type=float, default=2e4, help="Young's modulus [Pa]")
    parser.add_argument("--out", type=Path, default=Path("dropped.glb"), help="motion (.glb, .usdc) or final mesh")
    options = parser.parse_args()

    surface = tpd.TriMesh.from_file(options.surface) if options.surface else tpd.shapes.octopus()
    low, high = surface.bounds
    surface = surface.scaled(1.0 / float((high - low).max()))
    mesh = tpd.tetrahedralize(surface, cells=options.cells)
    mesh = mesh.translated((0.0, 0.3 - mesh.bounds[0, 1], 0.0))
    print(mesh)

    scene = tpd.Scene(tpd.Solid(mesh, youngs=options.youngs, density=1000.0), tpd.Gravity(), tpd.Ground(friction=0.5))
    sim = tpd.Simulator(scene, TIME_STEP, iterations=64)
    track = sim.rollout(sim.rest_state(), options.steps, return_info=True, progress=True)

    # the simulator moves the tetrahedra; every surface vertex is a fixed combination of the corners of one
    frames = mesh.embedding.apply(track.positions[:, 0])
    triangles = mesh.embedding.surface.triangles
    if options.out.suffix in (".glb", ".usdc"):
        write_surface(options.out, frames, triangles, frames_per_second=1.0 / TIME_STEP)
    else:
        tpd.TriMesh(frames[-1], triangles, uvs=surface.uvs).to_file(options.out)
    print(f"lowest point {float(frames[-1, :, 1].min()):.3f} m, residual {float(track.info.residual[-1]):.1e}")
    print(f"written: {options.out}")


if __name__ == "__main__":
    main()
