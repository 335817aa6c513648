"""Grip a bar at both ends; one grip rotates and pulls. A function of the step number places the pins."""

from __future__ import annotations

import argparse
import math

import torch

import torchpd as tpd

TIME_STEP = 1 / 60  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60, help="of 1/60 s")
    parser.add_argument("--turn", type=float, default=180.0, help="degrees")
    parser.add_argument("--pull", type=float, default=0.2, help="[m]")
    parser.add_argument("--soft", type=float, help="stiffness of the grip [N/m]; default: it holds exactly")
    options = parser.parse_args()

    mesh = tpd.shapes.box((1.0, 0.2, 0.2), (20, 4, 4)).translated((0.0, -0.1, -0.1))
    bar = tpd.Solid(mesh, youngs=1e5, density=1000.0)
    wall = tpd.Pin(bar, mesh.vertices[:, 0] == 0.0)
    grip = tpd.Pin(bar, mesh.vertices[:, 0] == 1.0, stiffness=options.soft)
    sim = tpd.Simulator(tpd.Scene(bar, wall, grip, tpd.Damping(2.0)), TIME_STEP, iterations=128)
    held = torch.from_numpy(mesh.vertices[grip.vertices]).float()

    def targets(step: int) -> dict[tpd.Pin, torch.Tensor]:
        """Positions of the grip at the end of a step; the wall is not named, so it stays."""
        share = (step + 1) / options.steps
        angle = math.radians(options.turn) * share
        turn = torch.tensor(
            [[1.0, 0.0, 0.0], [0.0, math.cos(angle), -math.sin(angle)], [0.0, math.sin(angle), math.cos(angle)]]
        )
        return {grip: held @ turn.T + torch.tensor([options.pull * share, 0.0, 0.0])}

    track = sim.rollout(sim.rest_state(), options.steps, targets=targets, return_info=True, progress=True)

    end = track.positions[-1, 0]
    axis_free = torch.from_numpy((mesh.vertices[:, 1] > 0.09) & (abs(mesh.vertices[:, 2]) < 1e-6))
    print("x at rest [m]   x now [m]   turned [degrees]")
    for vertex in axis_free.nonzero()[::4, 0].tolist():
        x, y, z = end[vertex].tolist()
        print(f"{mesh.vertices[vertex, 0]:13.2f} {x:11.3f} {math.degrees(math.atan2(z, y)):18.1f}")
    miss = (end[torch.from_numpy(grip.vertices)] - targets(options.steps - 1)[grip]).norm(dim=-1).max()
    print(f"the grip misses its targets by at most {float(miss):.1e} m")
    print(f"elastic energy {float(sim.energy(track.positions[-1])):.2f} J")


if __name__ == "__main__":
    main()
