"""Two muscles bend a beam: the gradient of a motion finds the activations that put its tip at a goal."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

import torchpd as tpd
from torchpd.viewing.bodies import SceneSurface
from torchpd.viewing.render import render

GOAL = (0.5, 0.4)  # x and y of the tip [m]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=40, help="of 1/60 s")
    parser.add_argument("--tries", type=int, default=6, help="motions, each with two gradients")
    parser.add_argument("--out", type=Path, help="picture file (PNG) of the rest and of the end")
    options = parser.parse_args()

    mesh = tpd.shapes.box((0.6, 0.1, 0.1), (18, 4, 3)).translated((0.0, 0.2, 0.0))
    beam = tpd.Solid(mesh, youngs=1e6, density=1000.0, poisson=0.4)
    along, height, _ = mesh.vertices[mesh.tets].mean(axis=1).T
    middle = mesh.bounds[:, 1].mean()
    muscles = [
        tpd.Fibres(beam, (1.0, 0.0, 0.0), 2e6, contraction=0.5, tets=part & (height > middle))
        for part in (along < 0.3, along > 0.3)
    ]
    wall = tpd.Pin(beam, mesh.vertices[:, 0] == 0.0)
    scene = tpd.Scene(beam, *muscles, wall, tpd.Gravity(), tpd.Damping(8.0))
    sim = tpd.Simulator(scene, 1 / 60, iterations=400)
    tip = torch.from_numpy(mesh.vertices[:, 0] == mesh.bounds[1, 0])

    def move(activation: torch.Tensor) -> tuple[tpd.State, torch.Tensor]:
        """End of a motion in which the muscles are activated over half of its steps, and where the tip is [2] m."""

        def inputs(step: int) -> dict[tpd.Fibres, torch.Tensor]:
            share = min(1.0, 2.0 * (step + 1) / options.steps)
            return {muscle: share * a for muscle, a in zip(muscles, activation, strict=True)}

        state = sim.rollout(sim.rest_state(), options.steps, targets=inputs).state()
        return state, state.positions[0, tip, :2].mean(dim=0)

    activation = torch.full((2,), 0.2, requires_grad=True)
    print("try   activations   tip [m]   to the goal [mm]")
    for number in range(options.tries):
        state, place = move(activation)
        missing = torch.tensor(GOAL) - place.detach()
        a, b = activation.tolist()
        x, y = place.tolist()
        print(f"{number:3d} {a:7.3f} {b:6.3f} {x:7.4f} {y:6.4f} {1e3 * float(missing.norm()):9.3f}")
        if number + 1 < options.tries:  # Newton's method for two unknowns
            rows = [torch.autograd.grad(p, activation, retain_graph=True)[0] for p in place]
            step = torch.linalg.solve(torch.stack(rows), missing)
            activation = (activation.detach() + step).clamp(0.0, 1.0).requires_grad_()
    if options.out:
        skin = SceneSurface(scene)
        bent, straight = skin.apply(state.positions[0].detach()), skin.apply(mesh.vertices) - (0.0, 0.0, 0.2)
        goal = trimesh.creation.icosphere(subdivisions=4, radius=0.02).apply_translation((*GOAL, 0.12))
        wall = trimesh.creation.box((0.04, 0.4, 0.5)).apply_translation((-0.02, 0.2, -0.05))
        beams = [trimesh.Trimesh(points, skin.triangles, process=False) for points in (bent, straight)]
        scenery = trimesh.util.concatenate([*beams, goal, wall])
        flesh = np.where(mesh.vertices[:, 1:2] > middle, (0.50, 0.03, 0.02), (0.60, 0.40, 0.25))
        others = np.repeat([(0.02, 0.20, 0.08), (0.20, 0.20, 0.22)], [len(goal.vertices), len(wall.vertices)], axis=0)
        image = render(
            scenery.vertices, scenery.faces, color=np.concatenate([flesh, flesh, others]), size=(720, 540), samples=64
        )
        Image.fromarray(image).save(options.out)


if __name__ == "__main__":
    main()
