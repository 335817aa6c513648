"""A bar is bent between two clamps and let go: an elastic one springs back, a plastic one stays bent."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

import torchpd as tpd
from torchpd.viewing.bodies import SceneSurface
from torchpd.viewing.render import render

LENGTH = 0.6  # m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=24, help="along the bar")
    parser.add_argument("--steps", type=int, default=30, help="of 1/60 s to bend it, and twice as many to let go")
    parser.add_argument("--angle", type=float, default=60.0, help="by which its end turns [degrees]")
    parser.add_argument("--yield-strain", type=float, default=0.02)
    parser.add_argument("--out", type=Path, help="picture file (PNG) of the bent bar and of both after they are let go")
    options = parser.parse_args()

    across = max(2, options.cells // 8)
    mesh = tpd.shapes.box((LENGTH, 0.06, 0.06), (options.cells, across, across))
    flow = tpd.Plastic(options.yield_strain, hardening=0.1)
    bars = [tpd.Solid(mesh, 1e7, poisson=0.3, plastic=flow), tpd.Solid(mesh.translated((0, 0, 0.15)), 1e7, poisson=0.3)]
    along = mesh.vertices[:, 0]
    held, turned = np.flatnonzero(along == 0.0), np.flatnonzero(along > 0.99 * LENGTH)
    pins = [tpd.Pin(bar, np.concatenate([held, turned])) for bar in bars]
    scene = tpd.Scene(*bars, *pins, tpd.Damping(25.0))
    sim = tpd.Simulator(scene, 1 / 60, iterations=300)
    hold = torch.arange(2 * len(held)) < len(held)

    def targets(step: int) -> dict[tpd.Pin, torch.Tensor]:
        """The clamps move along the arc of a bar of that length, so that its middle is not stretched."""
        angle = math.radians(options.angle) * min(1.0, (step + 1) / options.steps)
        c, s, radius = math.cos(angle), math.sin(angle), LENGTH / max(angle, 1e-9)
        places = {}
        for pin in pins:
            x, y, z = pin.body.mesh.vertices[pin.vertices].T
            at = np.stack([radius * s - s * (y - 0.03) + c * (x - LENGTH), radius * (1 - c) + c * (y - 0.03) + 0.03
                           + s * (x - LENGTH), z], axis=1)  # fmt: skip
            moved = np.where(hold.numpy()[:, None], pin.body.mesh.vertices[pin.vertices], at)
            places[pin] = torch.tensor(moved, dtype=sim.dtype)
        return places

    bent = sim.rollout(sim.rest_state(), options.steps, every=options.steps, targets=targets).state()
    sim.set_material(pin_hard=hold.repeat(2))  # the ends are released
    free = sim.rollout(bent, 2 * options.steps, every=options.steps, targets=targets(options.steps)).state()

    def end(state: tpd.HistoryState, bar: tpd.Solid) -> float:
        """Height of the end of a bar [m]."""
        return float(state.positions[0, scene.vertex_range(bar)][turned, 1].mean())

    print("bar       end when bent [m]   after it is let go [m]")
    for name, bar in zip(("plastic", "elastic"), bars, strict=True):
        print(f"{name} {end(bent, bar):17.4f} {end(free, bar):17.4f}")
    print(f"largest plastic strain {float(sim.plastic_strain(free)[bars[0]].max()):.4f}")
    if options.out:
        skin = SceneSurface(scene)
        shapes = [trimesh.Trimesh(skin.apply(s.positions[0]) - o, skin.triangles, process=False)
                  for s, o in ((bent, (0.0, 0.0, 0.4)), (free, (0.0, 0.0, 0.0)))]  # fmt: skip
        both = trimesh.util.concatenate(shapes)
        Image.fromarray(render(both.vertices, both.faces, size=(720, 540), samples=64)).save(options.out)


if __name__ == "__main__":
    main()
