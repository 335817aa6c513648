"""A flag at a pole in gusty wind, an input of every step. Writes its motion, and prints the pull on the pole."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

import torchpd as tpd
from torchpd.viewing.animation import write_surface
from torchpd.viewing.render import CORAL, render

TIME_STEP = 1 / 60  # s
SIZE = (1.5, 1.0)  # m, along the wind and up


def sheet(cells: int) -> tpd.TriMesh:
    """A grid in the plane of x and y, `cells` high, whose diagonals alternate."""
    columns = round(cells * SIZE[0] / SIZE[1])
    x, y = np.linspace(0.0, SIZE[0], columns + 1), np.linspace(0.0, SIZE[1], cells + 1)
    vertices = np.stack([np.repeat(x, len(y)), np.tile(y, len(x)), np.zeros(len(x) * len(y))], axis=1)
    triangles = []
    for i in range(columns):
        for j in range(cells):
            a, b = i * len(y) + j, (i + 1) * len(y) + j
            even = [[a, b, b + 1], [a, b + 1, a + 1]]
            triangles += even if (i + j) % 2 == 0 else [[a, b, a + 1], [b, b + 1, a + 1]]
    return tpd.TriMesh(vertices, triangles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=240, help="of 1/60 s")
    parser.add_argument("--cells", type=int, default=12, help="cells along the pole")
    parser.add_argument("--speed", type=float, default=6.0, help="mean speed of the wind [m/s]")
    parser.add_argument("--out", type=Path, default=Path("flag.glb"), help="motion (.glb, .usdc), or end (.png)")
    options = parser.parse_args()
    surface = sheet(options.cells)
    flag = tpd.Cloth(surface, youngs=5e6, thickness=2e-4, area_density=0.15, bending=1e-5)
    pole = tpd.Pin(flag, surface.vertices[:, 0] == 0.0)
    wind = tpd.Wind((options.speed, 0.0, 0.0))
    sim = tpd.Simulator(tpd.Scene(flag, pole, wind, tpd.Gravity()), TIME_STEP, iterations=400, tolerance=1e-3)

    def gusts(step: int) -> dict[tpd.Wind, torch.Tensor]:
        """The wind of a step: it swells, and turns to and fro about the pole."""
        time = step * TIME_STEP
        speed = options.speed * (1.0 + 0.3 * math.sin(2.1 * time) + 0.1 * math.sin(7.3 * time))
        angle = 0.4 * math.sin(1.3 * time) + 0.2 * math.sin(5.1 * time + 1.0)
        return {wind: torch.tensor([speed * math.cos(angle), 0.0, speed * math.sin(angle)])}

    start = sim.rest_state()
    track = sim.rollout(start, options.steps, targets=gusts, progress=True)

    print("  time [s]   wind [m/s]   free edge at x, y, z [m]   pull on the pole [N]")
    edge = torch.from_numpy(surface.vertices[:, 0] == SIZE[0])
    every = max(options.steps // 8, 1)
    for step in range(every - 1, options.steps, every):
        before = track.state(step - 1) if step else start
        pull = float(sim.reactions(before, track.state(step), targets=gusts(step)).pins[pole].wrench.force.norm())
        place = "{:12.2f}, {:5.2f}, {:5.2f}".format(*track.positions[step, 0, edge].mean(0).tolist())
        print(f"{(step + 1) * TIME_STEP:10.2f} {float(gusts(step)[wind].norm()):12.1f} {place} {pull:22.2f}")
    if options.out.suffix == ".png":
        mast = trimesh.creation.cylinder(0.02, segment=[(-0.02, -0.8, 0.0), (-0.02, 1.1, 0.0)])
        both = trimesh.Trimesh(track.positions[-1, 0], surface.triangles, process=False) + mast
        colors = np.repeat([CORAL, (0.30, 0.31, 0.33)], [len(surface.vertices), len(mast.vertices)], axis=0)
        image = render(both.vertices, both.faces, color=colors, ground=-0.8, size=(640, 480), samples=64)
        Image.fromarray(image).save(options.out)
    else:
        write_surface(options.out, track.positions[:, 0], surface.triangles, frames_per_second=1.0 / TIME_STEP)
    print(f"written: {options.out}")


if __name__ == "__main__":
    main()
