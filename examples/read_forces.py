"""Forces of clamp and sphere under a beam that bends by its weight, its stress, and files for ParaView."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

import torchpd as tpd

TIME_STEP = 1 / 60  # s
LENGTH = 0.5  # m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=120, help="of 1/60 s")
    parser.add_argument("--youngs", type=float, default=1e5, help="Young's modulus [Pa]")
    parser.add_argument("--out", type=Path, default=Path("beam.pvd"), help="ParaView file, with a .vtu per ten steps")
    options = parser.parse_args()

    mesh = tpd.shapes.box((LENGTH, 0.1, 0.1), (20, 4, 4))
    left, low = mesh.bounds[0, :2]
    beam = tpd.Solid(mesh, youngs=options.youngs, density=1000.0)
    clamp = tpd.Pin(beam, mesh.vertices[:, 0] == left)
    ball = tpd.Sphere((left + 0.8 * LENGTH, low - 0.22, 0.0), radius=0.2, friction=0.4)
    scene = tpd.Scene(beam, clamp, ball, tpd.Gravity(), tpd.Damping(5.0))
    sim = tpd.Simulator(scene, TIME_STEP, iterations=256, dtype=torch.float64)

    state, frames, contact, reaction = sim.rest_state(), [], [], []
    for step in range(options.steps):
        before, state = state, sim(state)
        if step % 10 == 0:
            frames.append(state)
            contact.append(sim.contact_forces(before, state).force)
            reaction.append(sim.reactions(before, state).on_vertices)

    # forces in the last step, with torques about the centre of the clamp
    middle = torch.tensor([left, low + 0.05, 0.0], dtype=sim.dtype)
    contacts = sim.contact_forces(before, state, about=middle)
    pins = sim.reactions(before, state, about=middle)
    weight = float(sim.masses.sum() * 9.81)
    carried, held = contacts.bodies[beam], pins.pins[clamp].wrench
    print(f"weight {weight:.3f} N")
    print(f"ball   {float(carried.force[0, 1]):.3f} N on {int(contacts.colliders[ball].touches.sum())} vertices")
    print(f"clamp  {float(held.force[0, 1]):.3f} N, moment {float(held.torque[0, 2]):.3f} N m")
    print(f"not balanced: {float(contacts.residual.sum(1).norm()):.1e} N")
    stress = sim.stress(state)
    worst = int(stress.von_mises[0].argmax())
    print(f"von Mises stress up to {float(stress.von_mises[0, worst]):.0f} Pa, in tetrahedron {worst}")

    fields = {"contact_force": torch.stack(contact), "reaction": torch.stack(reaction)}
    times = [TIME_STEP * (10 * number + 1) for number in range(len(frames))]
    print(f"written: {sim.write_vtu(options.out, frames, times=times, point_data=fields)}")


if __name__ == "__main__":
    main()
