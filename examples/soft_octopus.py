"""Two octopuses are pressed flat by balls: Poisson's ratio keeps the volume of one. Prints both volumes."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

import torchpd as tpd
from torchpd.viewing.bodies import SceneSurface
from torchpd.viewing.render import frame_camera, render

RADIUS, PRESS = 0.12, 0.11  # of the balls, and how far they go down [m]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60, help="of 1/60 s")
    parser.add_argument("--cells", type=int, default=24, help="lattice cells along the longest side")
    parser.add_argument("--out", type=Path, help="picture file (PNG) of the end")
    options = parser.parse_args()

    surface = tpd.shapes.octopus()
    low, high = surface.bounds
    mesh = tpd.tetrahedralize(surface.scaled(0.5 / float((high - low).max())), cells=options.cells)
    mesh = mesh.translated(-mesh.bounds.mean(axis=0) * (1, 0, 1) - mesh.bounds[0] * (0, 1, 0))
    solids = [
        tpd.Solid(mesh.translated((x, 0.0, 0.0)), youngs=3e4, density=1000.0, poisson=poisson)
        for x, poisson in ((-0.3, 0.0), (0.3, 0.45))
    ]
    start = np.array([(x, mesh.bounds[1, 1] + RADIUS, 0.0) for x in (-0.3, 0.3)])
    balls = [tpd.Sphere(center, RADIUS, friction=0.3) for center in start]
    scene = tpd.Scene(*solids, *balls, tpd.Gravity(), tpd.Ground(friction=0.5), tpd.Damping(2.0))
    sim = tpd.Simulator(scene, 1 / 60, iterations=150)

    def press(step: int) -> dict[tpd.Sphere, torch.Tensor]:
        down = PRESS * min(1.0, 1.5 * (step + 1) / options.steps)
        return {
            ball: torch.tensor(center - (0.0, down, 0.0), dtype=sim.dtype)
            for ball, center in zip(balls, start, strict=True)
        }

    rest = sim.rest_state()
    state = sim.rollout(rest, options.steps, targets=press, progress=True).state()
    for solid, poisson in zip(solids, (0.0, 0.45), strict=True):
        kept = float(sim.volume(state)[solid] / sim.volume(rest)[solid])
        print(f"Poisson's ratio {poisson:4.2f}: {100 * kept:.1f} % of the volume is left")
    if options.out:
        skin = SceneSurface(scene)
        bodies = trimesh.Trimesh(skin.apply(state.positions[0]), skin.triangles, process=False)
        pressed = press(options.steps - 1).values()
        spheres = [trimesh.creation.icosphere(5, RADIUS).apply_translation(center.numpy()) for center in pressed]
        whole = trimesh.util.concatenate([bodies, *spheres])
        colors = np.concatenate([skin.colors, np.full((len(whole.vertices) - len(skin.colors), 3), 0.15)])
        camera = frame_camera(whole.vertices, azimuth=0.0, elevation=14.0, aspect=2.0)
        image = render(whole.vertices, whole.faces, color=colors, camera=camera, size=(800, 400), samples=64)
        Image.fromarray(image).save(options.out)


if __name__ == "__main__":
    main()
