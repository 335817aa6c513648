"""Find the motion of a hand that pushes a block over rough ground to a goal: gradients through contact and friction."""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

import torchpd as tpd

GOAL = (0.09, 0.05, 0.06)  # m, centre of the block, which starts at (0.05, 0.05, 0.05)
RADIUS = 0.2  # m, of the hand


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20, help="steps of 1/60 s: the hand moves, then the block stops")
    parser.add_argument("--tries", type=int, default=20, help="steps of the optimiser")
    options = parser.parse_args()

    mesh = tpd.shapes.box((0.1, 0.1, 0.1), (4, 4, 4))
    hand = tpd.Sphere((-RADIUS, 0.05, 0.05), RADIUS, friction=0.8)
    scene = tpd.Scene(tpd.Solid(mesh, youngs=1e5), tpd.Gravity(), tpd.Ground(friction=0.4), hand)
    # gradients are those of converged steps, and as accurate as the steps
    sim = tpd.Simulator(scene, time_step=1 / 60, iterations=1000, dtype=torch.float64, tolerance=1e-6)
    goal, share = torch.tensor(GOAL, dtype=torch.float64), sim.masses / sim.masses.sum()

    # speed of the hand in each step [m/s]: straight ahead and too slow at first
    speed = torch.tensor([[0.06, 0.0, 0.0]], dtype=torch.float64).repeat(options.steps, 1).requires_grad_()

    def push() -> tuple[Tensor, Tensor]:
        """Distance of the block's centre from the goal at the end, and its position then [m]."""
        places = torch.tensor(hand.center, dtype=torch.float64) + sim.time_step * speed.cumsum(0)
        end = sim.rollout(sim.rest_state(), options.steps, targets=lambda step: {hand: places[step]}).state()
        middle = (share[:, None] * end.positions[0]).sum(0)
        return (middle - goal).norm(), middle

    optimiser = torch.optim.Adam([speed], lr=0.02)
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
