"""Find the path of a rigid paddle that pushes a soft cube over a rough table to a goal: gradients through contact.

`python examples/push_by_collider.py` ends 29 mm beside the goal at first, and within 0.5 mm of it after 20 tries.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

import torchpd as tpd

GOAL = (0.06, 0.02)  # m, x and z of the cube's centre, which starts at (0, 0)
TIME_STEP = 1 / 60  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=24, help="of 1/60 s")
    parser.add_argument("--tries", type=int, default=20, help="steps of the optimiser")
    parser.add_argument("--friction", type=float, default=0.4, help="between all surfaces")
    options = parser.parse_args()

    mesh = tpd.shapes.box((0.05, 0.05, 0.05), (2, 2, 2)).translated((-0.025, 0.001, -0.025))
    cube = tpd.Solid(mesh, youngs=1e5, density=1000.0)
    table = tpd.Collider(tpd.shapes.box((0.6, 0.02, 0.6), (3, 1, 3)).translated((-0.25, -0.02, -0.3)))
    paddle = tpd.Collider(tpd.shapes.box((0.01, 0.04, 0.08), (1, 1, 1)).translated((-0.037, 0.006, -0.04)))
    contact = tpd.Contact(friction=options.friction, thickness=1e-3)
    sim = tpd.Simulator(tpd.Scene(cube, table, paddle, contact, tpd.Gravity()), TIME_STEP, 64, dtype=torch.float64)
    goal, share = torch.tensor(GOAL, dtype=torch.float64), sim.masses / sim.masses.sum()

    # speed along x and z [m/s] and rate of the turn about y [rad/s] in each step: straight ahead and too slow at first
    speed = torch.tensor([[0.1, 0.0, 0.0]], dtype=torch.float64).repeat(options.steps, 1).requires_grad_()

    def push() -> tuple[Tensor, Tensor]:
        """Distance of the cube's centre from the goal at the end, and its x and z then [m]."""
        x, z, angle = (TIME_STEP * speed.cumsum(0)).unbind(1)
        zero = torch.zeros_like(x)
        poses = torch.stack([x, zero, z, torch.cos(angle / 2), zero, torch.sin(angle / 2), zero], dim=1)
        end = sim.rollout(sim.rest_state(), options.steps, targets=lambda step: {paddle: poses[step]}).state()
        middle = (share[:, None] * end.positions[0]).sum(0)[[0, 2]]
        return (middle - goal).norm(), middle

    optimiser = torch.optim.Adam([speed], lr=0.03)
    slower = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.85)
    print("try   from the goal [mm]")
    for number in range(options.tries):
        optimiser.zero_grad()
        distance, _ = push()
        distance.backward()
        print(f"{number:3d} {1000 * distance.item():18.3f}")
        optimiser.step()
        slower.step()
    with torch.no_grad():
        distance, middle = push()
    print(f"end {1000 * distance.item():18.3f}   the middle is at {[round(x, 4) for x in middle.tolist()]} m")


if __name__ == "__main__":
    main()
