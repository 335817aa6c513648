"""Two fingers close on a soft cube and lift it: contact of bodies with rigid surfaces that move by hand."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import torchpd as tpd
from torchpd.viewing.bodies import SceneSurface
from torchpd.viewing.render import CORAL, Studio, contact_sheet

TIME_STEP = 1 / 60  # s
SIZE = 0.05  # m, of the cube


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60, help="of 1/60 s")
    parser.add_argument("--friction", type=float, default=0.8, help="between cube and fingers; with 0 the cube stays")
    parser.add_argument("--squeeze", type=float, default=0.005, help="way of each finger into the cube [m]")
    parser.add_argument("--cells", type=int, default=4, help="of the cube along an edge")
    parser.add_argument("--out", type=Path, help="picture of four times; none if left out")
    options = parser.parse_args()

    mesh = tpd.shapes.box((SIZE,) * 3, (options.cells,) * 3).translated((-SIZE / 2, 0.0, -SIZE / 2))
    cube = tpd.Solid(mesh, youngs=1e5, density=1000.0)
    shape = tpd.shapes.box((0.02, 0.055, 0.04), (1, 2, 2))
    left = tpd.Collider(shape.translated((-0.055, 0.005, -0.02)))  # 1 cm beside the cube
    right = tpd.Collider(shape.translated((0.035, 0.005, -0.02)))
    contact = tpd.Contact(friction=options.friction, thickness=1e-3)
    scene = tpd.Scene(cube, left, right, contact, tpd.Ground(friction=0.5), tpd.Gravity())
    sim = tpd.Simulator(scene, TIME_STEP, iterations=32)

    def targets(step: int) -> dict[tpd.Collider, torch.Tensor]:
        """Poses at the end of a step: the fingers close during three tenths, lift during half, and stay."""
        time = (step + 1) / options.steps
        closed = (0.01 + options.squeeze) * min(time / 0.3, 1.0)
        lifted = 0.1 * min(max((time - 0.3) / 0.5, 0.0), 1.0)
        return {
            finger: torch.tensor([side * closed, lifted, 0.0, 1.0, 0.0, 0.0, 0.0])
            for finger, side in ((left, 1.0), (right, -1.0))
        }

    state = sim.rest_state()
    track = sim.rollout(state, options.steps, targets=targets, return_info=True)
    info = track.info
    height = float(track.positions[-1, 0, :, 1].mean()) - SIZE / 2
    print(f"cube lifted by {height:.4f} m, fingers by {float(targets(options.steps)[left][1]):.4f} m")
    print(f"least distance of surfaces: {float(info.contact_gap.min()):.2f} of the thickness")
    print(f"fingers held back by at most {float(info.held_back.max()):.1e} m")
    print(f"sum of the normal forces at the end: {float(track.state().history.forces[0, :, 0].sum()):.2f} N")

    if options.out:
        skin = SceneSurface(scene)
        fingers = np.stack([left.mesh.vertices, right.mesh.vertices])
        frames = []
        for record in np.linspace(0, options.steps - 1, 4).round().astype(int).tolist():
            moved = np.stack([pose[:3].numpy() for pose in targets(record).values()])
            body = np.asarray(skin.apply(track.positions[record, 0]))
            frames.append(np.concatenate([body, *(fingers + moved[:, None])]))
        triangles, offset = [np.asarray(skin.triangles)], len(body)
        for finger in (left, right):
            triangles.append(finger.mesh.triangles + offset)
            offset += len(finger.mesh.vertices)
        color = np.repeat([CORAL, (0.30, 0.31, 0.33)], [len(body), offset - len(body)], axis=0)
        studio = Studio(np.stack(frames), np.concatenate(triangles), color=color, samples=64)
        contact_sheet([studio.render(frame) for frame in frames], columns=4, path=options.out)


if __name__ == "__main__":
    main()
