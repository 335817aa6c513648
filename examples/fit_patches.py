"""Fit free-form patches to a surface, print their error, and save them as patches and as a mesh."""

from __future__ import annotations

import argparse
from pathlib import Path

import torchpd as tpd


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", nargs="?", type=Path, help="an oriented surface; default: the octopus")
    parser.add_argument("--patches", type=int, default=400, help="most triangles of the base")
    parser.add_argument("--quadrics", type=int, default=100, help="at most")
    parser.add_argument("--iterations", type=int, default=40, help="most iterations of each stage of the fit")
    parser.add_argument("--level", type=int, default=6, help="segments per patch edge in the written mesh")
    parser.add_argument("--out", type=Path, default=Path("patches.glb"), help="mesh file")
    options = parser.parse_args()

    target = tpd.TriMesh.from_file(options.mesh) if options.mesh else tpd.shapes.octopus()
    index = 2 if len(target.vertices) <= 65536 else 4
    size = 12 * len(target.vertices) + 3 * index * len(target.triangles)
    print(f"{target}, {size:,} bytes")

    for base in ("flat", "phong"):
        fit = tpd.FreeFormPatches.fit(
            target, options.quadrics, patches=options.patches, base=base, iterations=options.iterations, progress=True
        )
        print(f"{base:>6}: {fit.report}")

    surface = fit.patches.mesh(options.level)
    surface.to_file(options.out)
    fit.patches.save(options.out.with_suffix(".safetensors"))
    closed = surface.to_trimesh().is_watertight
    print(f"{options.out}: {surface}, {'closed' if closed else 'open'}")


if __name__ == "__main__":
    main()
