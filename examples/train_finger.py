"""Find the forces by which a light finger pushes a soft cube over the ground to a goal: gradients through its motion.

The finger is a `Collider` with a mass: a force in each step moves it, and contact and friction move the cube. Its
weight is held, and the optimiser finds the rest.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

import torchpd as tpd

TIME_STEP = 1 / 60  # s
SIZE, YOUNGS = 0.05, 1e5  # of the cube: m, Pa
RADIUS, MASS, GAP = 0.01, 0.05, 0.002  # of the finger: m, kg, and to the cube
GOAL = (0.02, 0.006)  # m along x and z, where the cube's middle should be
G = 9.81


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20, help="of 1/60 s")
    parser.add_argument("--tries", type=int, default=20, help="steps of the optimiser")
    options = parser.parse_args()

    mesh = tpd.shapes.box((SIZE,) * 3, (3, 3, 3)).translated((-SIZE / 2, 0.0, -SIZE / 2))
    cube = tpd.Solid(mesh, youngs=YOUNGS, density=1000.0)
    pose = (-SIZE / 2 - RADIUS - GAP, SIZE / 2, 0.0, 1, 0, 0, 0)
    finger = tpd.Collider(tpd.shapes.sphere(RADIUS, 2), mass=MASS, pose=pose)
    contact = tpd.Contact(friction=0.8, thickness=1e-3)
    scene = tpd.Scene(cube, finger, contact, tpd.Ground(friction=0.3), tpd.Gravity())
    # gradients are those of converged steps, and as accurate as the steps
    sim = tpd.Simulator(scene, TIME_STEP, iterations=256, dtype=torch.float64)
    goal, share = torch.tensor(GOAL, dtype=torch.float64), sim.masses / sim.masses.sum()
    held = torch.tensor([0.0, MASS * G, 0.0], dtype=torch.float64)

    # force of each step beside the weight [N]: straight ahead and too weak at first
    force = torch.tensor([[0.5, 0.0, 0.0]], dtype=torch.float64).repeat(options.steps, 1).requires_grad_()

    def push() -> tuple[Tensor, Tensor]:
        """Distance of the cube's middle from the goal at the end, and where it is then [m]."""
        wrench = torch.cat([held + force, torch.zeros_like(force)], dim=1)
        end = sim.rollout(sim.rest_state(), options.steps, targets=lambda step: {finger: wrench[step]}).state()
        middle = (share[:, None] * end.positions[0]).sum(0)[[0, 2]]
        return (middle - goal).norm(), middle

    optimiser = torch.optim.Adam([force], lr=0.05)
    slower = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.9)
    print("try   from the goal [mm]")
    for number in range(options.tries):
        optimiser.zero_grad()
        distance, _ = push()
        distance.backward()
        print(f"{number:3d} {1000 * distance.item():18.3f}", flush=True)
        optimiser.step()
        slower.step()
    with torch.no_grad():
        distance, middle = push()
    print(f"end {1000 * distance.item():18.3f}   the middle is at {[round(x, 4) for x in middle.tolist()]} m")


if __name__ == "__main__":
    main()
