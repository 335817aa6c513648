"""Forces of pins against what statics says of them."""

from __future__ import annotations

import pytest
import torch
from cases import box
from readout_cases import MESH, SIDE, settled, weight

import torchpd as pd


@pytest.mark.parametrize("stiffness", [None, 1e4])
def test_what_hangs_pulls_by_its_weight(stiffness: float | None) -> None:
    mesh_top = MESH.vertices[:, 1] == SIDE
    solid = pd.Solid(MESH, youngs=1e5, density=1000.0)
    left, right = (
        pd.Pin(solid, mesh_top & side, stiffness)
        for side in (MESH.vertices[:, 0] < SIDE / 3, MESH.vertices[:, 0] > SIDE / 3)
    )
    scene = pd.Scene(solid, left, right, pd.Gravity(), pd.Damping(5.0))
    sim = pd.Simulator(scene, 1 / 60, 400, dtype=torch.float64)
    state, after = settled(sim)
    reactions = sim.reactions(state, after)
    mg = weight(sim)
    assert reactions.force.sum(1)[0].tolist() == pytest.approx([0.0, mg, 0.0], abs=1e-6 * mg)
    assert torch.equal(reactions.on_vertices[:, left.vertices], reactions.pins[left].force)
    held = reactions.pins[left].wrench.force[0] + reactions.pins[right].wrench.force[0]
    torch.testing.assert_close(held, reactions.force.sum(1)[0])
    torque = reactions.pins[left].wrench.torque + reactions.pins[right].wrench.torque
    assert float(torque.abs().max()) <= 1e-6 * mg * SIDE  # about the centre of mass
    if stiffness is not None:
        expected = stiffness * (sim.pin_targets - after.positions[:, [*left.vertices, *right.vertices]])
        torch.testing.assert_close(reactions.force, expected, rtol=0.0, atol=1e-12 * mg)
    assert float(sim.contact_forces(state, after).residual.norm()) <= 1e-6 * mg


def test_a_clamped_end_holds_force_and_moment() -> None:
    """Statics of the bent beam: the weight, and its moment about the clamp."""
    mesh = pd.TetMesh(*box((0.4, 0.1, 0.1), (8, 2, 2)))
    solid = pd.Solid(mesh, youngs=2e5, density=1000.0)
    pin = pd.Pin(solid, mesh.vertices[:, 0] == 0.0)
    scene = pd.Scene(solid, pin, pd.Gravity(), pd.Damping(20.0))
    sim = pd.Simulator(scene, 1 / 60, solver=pd.Multilevel(), iterations=30, dtype=torch.float64)
    state, after = settled(sim, 250)
    clamp = torch.tensor([0.0, 0.05, 0.05], dtype=torch.float64)
    wrench = sim.reactions(state, after, about=clamp).pins[pin].wrench
    mg = weight(sim)
    center = (after.positions[0] * sim.masses[:, None]).sum(0) / sim.masses.sum()
    up = torch.tensor([0.0, mg, 0.0], dtype=torch.float64)
    torch.testing.assert_close(wrench.force[0], up, rtol=0.0, atol=1e-5 * mg)
    torch.testing.assert_close(wrench.torque[0], torch.linalg.cross(center - clamp, up), rtol=0.0, atol=1e-6 * mg)
    assert float(wrench.torque[0, 2]) > 0.19 * mg


def test_a_hard_pin_takes_what_a_contact_would() -> None:
    ground = pd.Ground(height=0.01)
    solid = pd.Solid(MESH, youngs=1e5, density=1000.0)
    pin = pd.Pin(solid, MESH.vertices[:, 1] == 0.0)
    sim = pd.Simulator(pd.Scene(solid, pin, pd.Gravity(), ground), 1 / 60, 300, dtype=torch.float64)
    state, after = settled(sim, 100)
    assert not bool(sim.contact_forces(state, after).colliders[ground].force[:, pin.vertices].any())
    assert float(sim.reactions(state, after).force[..., 1].sum()) == pytest.approx(weight(sim), rel=1e-3)
