"""A light finger presses a soft cube and drags it: a `Collider` with a mass, moved by a force in each step.

Its motion is solved together with that of the cube. So it is stable at any mass, where an engine that gets the force a
step late needs more than k h^2 / 4 (examples/mujoco_finger.py): k is the stiffness that the finger meets.
"""

from __future__ import annotations

import argparse

import torch

import torchpd as tpd

TIME_STEP = 1 / 60  # s
SIZE, YOUNGS = 0.05, 1e5  # of the cube: m, Pa
WIDTH, HEIGHT = 0.03, 0.01  # of the finger, a plate, m
GAP = 0.002  # to the cube at the start, m
G = 9.81


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=60, help="of 1/60 s; the finger drags in the second half")
    parser.add_argument("--mass", type=float, default=0.05, help="of the finger [kg]")
    parser.add_argument("--press", type=float, default=2.0, help="force down [N]")
    parser.add_argument("--drag", type=float, default=0.5, help="force along x [N]")
    options = parser.parse_args()

    mesh = tpd.shapes.box((SIZE,) * 3, (4, 4, 4)).translated((-SIZE / 2, 0.0, -SIZE / 2))
    cube = tpd.Solid(mesh, youngs=YOUNGS, density=1000.0)
    plate = tpd.shapes.box((WIDTH, HEIGHT, WIDTH), (3, 1, 3)).translated((-WIDTH / 2, -HEIGHT / 2, -WIDTH / 2))
    start = (0.0, SIZE + HEIGHT / 2 + GAP, 0.0, 1, 0, 0, 0)
    finger = tpd.Collider(plate, mass=options.mass, pose=start)
    contact = tpd.Contact(friction=0.8, thickness=1e-3)
    scene = tpd.Scene(cube, finger, contact, tpd.Ground(friction=0.8), tpd.Gravity())
    sim = tpd.Simulator(scene, TIME_STEP, iterations=64)
    print(
        f"{options.mass} kg; with poses in and wrenches out {YOUNGS * SIZE * TIME_STEP**2 / 4:.2f} kg would be needed"
    )

    state = sim.rest_state()
    force = torch.zeros(6)
    for step in range(options.steps):
        drag = options.drag if step >= options.steps // 2 else 0.0
        # at its origin, in world axes: force [N], then torque [N m]
        wrench = torch.tensor([drag, -options.press, 0.0, 0.0, 0.0, 0.0])
        before, state = state, sim(state, targets={finger: wrench})
        force = sim.contact_forces(before, state).on_colliders[0, 0]
        if (step + 1) % max(options.steps // 8, 1) == 0:
            bottom = 1e3 * (float(state.history.poses[0, 0, 1]) - HEIGHT / 2)
            print(
                f"{(step + 1) * TIME_STEP:5.2f} s: bottom at {bottom:6.2f} mm, force {force[0]:6.3f} {force[1]:6.3f} N"
            )
    load = options.press + options.mass * G
    print(f"the cube carries {force[1]:.4f} N of {load:.4f} N, and holds {-force[0]:.4f} N of {options.drag:.4f} N")


if __name__ == "__main__":
    main()
