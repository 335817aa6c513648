"""A finger of MuJoCo rests on a soft cube and drags it: its pose goes into each step, the wrench on it comes out.

MuJoCo moves the finger under gravity, its motor and the wrench of the last step. Then the cube takes a step in which
the finger moves to its new pose. The force is one step old, so the finger must be heavy enough: m + c h > k h^2 / 4.
Here k is the stiffness that it meets, at most E A / L of a block, and c the damping of its joints.
"""

from __future__ import annotations

import argparse
from typing import Protocol

import numpy as np
import torch

import torchpd as tpd

TIME_STEP = 1 / 60  # s
SIZE, YOUNGS = 0.05, 1e5  # of the cube: m, Pa
RADIUS, LENGTH = 0.012, 0.04  # of the finger, m
HEIGHT = SIZE + RADIUS + LENGTH / 2 + 0.002  # of its middle at the start, m
G = 9.81

MODEL = """
<mujoco>
  <option timestep="{h}" gravity="0 -{g} 0"/>
  <worldbody>
    <body name="finger" pos="0 {height} 0">
      <joint name="across" type="slide" axis="1 0 0" damping="{damping}"/>
      <joint name="up" type="slide" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" size="{radius}" fromto="0 -{half} 0 0 {half} 0" mass="{mass}" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor joint="across"/></actuator>
</mujoco>
"""


class Rigid(Protocol):
    """A rigid body of some engine."""

    def step(self, wrench: np.ndarray, pull: float) -> np.ndarray:
        """Its pose (x, y, z, qw, qx, qy, qz) after a step with a wrench [6] about its origin, and a motor [N]."""


class MujocoFinger:
    """The finger in MuJoCo, whose poses and quaternions have torchpd's order."""

    def __init__(self, mass: float, damping: float) -> None:
        try:
            import mujoco
        except ImportError:
            raise SystemExit(
                "mujoco_finger.py: MuJoCo is missing; install it by `pip install mujoco`, or take --engine own"
            ) from None
        numbers = {"h": TIME_STEP, "g": G, "height": HEIGHT, "damping": damping, "radius": RADIUS, "mass": mass}
        self.model = mujoco.MjModel.from_xml_string(MODEL.format(**numbers, half=LENGTH / 2))
        self.data = mujoco.MjData(self.model)
        self.body, self._engine = self.model.body("finger").id, mujoco

    def step(self, wrench: np.ndarray, pull: float) -> np.ndarray:
        data, body = self.data, self.body
        force, torque = wrench[:3], wrench[3:]
        # MuJoCo applies it at the centre of mass, torchpd gives it about the origin of the body's frame
        self._engine.mj_kinematics(self.model, data)
        self._engine.mj_comPos(self.model, data)
        torque = torque + np.cross(data.xpos[body] - data.xipos[body], force)
        data.xfrc_applied[body] = np.concatenate([force, torque])
        data.ctrl[0] = pull
        self._engine.mj_step(self.model, data)
        self._engine.mj_kinematics(self.model, data)
        return np.concatenate([data.xpos[body], data.xquat[body]])


class OwnFinger:
    """The same without MuJoCo: semi-implicit Euler of a body that slides along x and y."""

    def __init__(self, mass: float, damping: float) -> None:
        self.mass, self.damping = mass, damping
        self.place, self.velocity = np.array([0.0, HEIGHT, 0.0]), np.zeros(3)

    def step(self, wrench: np.ndarray, pull: float) -> np.ndarray:
        force = np.array([wrench[0] + pull, wrench[1] - self.mass * G, 0.0])
        self.velocity = (self.mass * self.velocity + TIME_STEP * force) / (self.mass + TIME_STEP * self.damping)
        self.place = self.place + TIME_STEP * self.velocity
        return np.concatenate([self.place, [1.0, 0.0, 0.0, 0.0]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=80, help="of 1/60 s; the motor pulls in the second half")
    parser.add_argument("--mass", type=float, default=0.5, help="of the finger [kg]")
    parser.add_argument("--damping", type=float, default=20.0, help="of its joints [N s/m]")
    parser.add_argument("--pull", type=float, default=1.0, help="force of the motor along x [N]")
    parser.add_argument("--engine", choices=("mujoco", "own"), default="mujoco", help="what moves the finger")
    options = parser.parse_args()

    stiffness = YOUNGS * SIZE  # E A / L
    heavy, least = options.mass + options.damping * TIME_STEP, stiffness * TIME_STEP**2 / 4
    print(f"m + c h = {heavy:.2f} kg, k h^2 / 4 = {least:.2f} kg for k = {stiffness:.0f} N/m")
    if heavy <= least:
        print("the finger is too light and may bounce ever higher: take a smaller time step, damping or more mass")

    mesh = tpd.shapes.box((SIZE,) * 3, (4, 4, 4)).translated((-SIZE / 2, 0.0, -SIZE / 2))
    cube = tpd.Solid(mesh, youngs=YOUNGS, density=1000.0)
    finger = tpd.Collider(tpd.shapes.capsule(RADIUS, LENGTH, 4), pose=(0.0, HEIGHT, 0.0, 1, 0, 0, 0))
    contact = tpd.Contact(friction=0.8, thickness=1e-3)
    scene = tpd.Scene(cube, finger, contact, tpd.Ground(friction=0.8), tpd.Gravity())
    sim = tpd.Simulator(scene, TIME_STEP, iterations=64)
    engine = MujocoFinger if options.engine == "mujoco" else OwnFinger
    rigid: Rigid = engine(options.mass, options.damping)

    state, wrench = sim.rest_state(), np.zeros(6)
    for step in range(options.steps):
        pull = options.pull if step >= options.steps // 2 else 0.0
        pose = rigid.step(wrench, pull)
        targets = {finger: torch.tensor(pose, dtype=sim.dtype)}
        before, state = state, sim(state, targets=targets)
        contacts = sim.contact_forces(before, state, targets=targets)
        wrench = contacts.on_colliders[0, 0].double().numpy()
        if (step + 1) % max(options.steps // 8, 1) == 0:
            tip = 1e3 * (pose[1] - LENGTH / 2 - RADIUS)
            print(f"{(step + 1) * TIME_STEP:5.2f} s: tip at {tip:6.2f} mm, force {wrench[0]:6.3f} {wrench[1]:6.3f} N")
    weight = options.mass * G
    print(f"the cube carries {wrench[1]:.4f} N of {weight:.4f} N, and holds {-wrench[0]:.4f} N of {options.pull:.4f} N")


if __name__ == "__main__":
    main()
