"""Friction, height and radius by their names in `set_material`."""

from __future__ import annotations

import pytest
import torch

import torchpd as pd
from torchpd.common.tables import PLANES, SPHERES

H = 1 / 60
G = 9.81


def cube(*contacts: pd.Ground | pd.Sphere, **options: object) -> pd.Simulator:
    body = pd.Solid(pd.shapes.box((0.1, 0.1, 0.1), (2, 2, 2)), 1e5, 1000.0)
    scene = pd.Scene(body, pd.Gravity((0.0, -G, 0.0)), *contacts)
    return pd.Simulator(scene, H, 200, dtype=torch.float64, progress=False, **options)  # type: ignore[arg-type]


def test_columns_stand_where_files_have_them() -> None:
    """Files of simulators and checkpoints hold whole rows: another order would read them as something else."""
    assert {"normal": slice(0, 3), "height": 3, "friction": 4} == PLANES
    assert {"center": slice(0, 3), "radius": 3, "friction": 4, "motion": slice(5, 8)} == SPHERES


def test_every_environment_slides_by_its_own_friction(device: torch.device) -> None:
    """A body that slides loses mu g of its speed in a second."""
    sim = cube(pd.Ground(0.0)).to(device)
    mu = torch.tensor([0.0, 0.1, 0.2, 0.3], dtype=torch.float64, device=device)
    sim.set_material(friction=mu[:, None])
    assert sim.planes.shape == (4, 1, 5)
    state = sim.rest_state(4)
    state.velocities[..., 0] = 2.0
    for _ in range(20):
        state = sim(state)
    speeds = state.velocities[..., 0].mean(dim=1)
    torch.testing.assert_close(speeds, 2.0 - 20 * H * G * mu, rtol=0, atol=1e-6)


def test_grounds_come_first_then_spheres() -> None:
    sim = cube(pd.Ground(-1.0), pd.Sphere((0.0, -3.0, 0.0), 0.5), pd.Ground(-2.0, normal=(1.0, 0.0, 0.0)))
    planes, spheres = sim.planes.detach().clone(), sim.spheres.detach().clone()
    friction = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    sim.set_material(friction=friction, height=torch.tensor([-4.0, -5.0]), radius=0.25)
    planes[:, 4], planes[:, 3] = friction[:2], torch.tensor([-4.0, -5.0])
    spheres[:, 4], spheres[:, 3] = friction[2], 0.25
    assert torch.equal(sim.planes.detach(), planes)
    assert torch.equal(sim.spheres.detach(), spheres)


def test_one_number_is_for_all_and_batches_are_met() -> None:
    sim = cube(pd.Ground(-1.0, friction=0.1), pd.Ground(-2.0, friction=0.2))
    parameter = sim.planes
    sim.set_material(friction=0.5)
    assert sim.planes is parameter
    assert sim.planes[:, 4].tolist() == [0.5, 0.5]
    sim.set_material(height=torch.tensor([[-1.0], [-3.0], [-5.0]]))  # of both grounds, for each environment
    sim.set_material(friction=torch.tensor([0.25, 0.75]))  # of each ground, for all environments
    assert sim.planes[..., 3].tolist() == [[-1.0, -1.0], [-3.0, -3.0], [-5.0, -5.0]]
    assert sim.planes[..., 4].tolist() == 3 * [[0.25, 0.75]]
    # arrays of other names in the same call
    sim.set_material(friction=0.5, height=-2.0, stiffness=2e5)
    assert sim.planes[..., 3:].tolist() == 3 * [2 * [[-2.0, 0.5]]]
    assert float(sim.stiffness.mean()) == 2e5


def test_what_they_cannot_be_is_said_and_changes_nothing() -> None:
    sim = cube(pd.Ground(-1.0), pd.Sphere((0.0, -3.0, 0.0), 0.5))
    sim.set_material(friction=torch.full((3, 2), 0.5))
    before = [array.clone() for array in sim.material()]
    for arrays, kind, message in (
        ({"friction": -0.1}, ValueError, r"set_material: planes: friction \(column 4\) must be >= 0 .* -0\.1\] at"),
        ({"radius": 0.0}, ValueError, r"set_material: spheres: the radius \(column 3\) must be positive"),
        ({"height": float("nan")}, ValueError, "set_material: planes .*got nan"),
        (
            {"friction": torch.ones(3)},
            ValueError,
            r"friction .*got \[3\]",
        ),
        (
            {"radius": torch.ones(1, 1, 1)},
            ValueError,
            r"radius .*got \[1, 1, 1\]",
        ),
        ({"height": torch.zeros(4, 1)}, ValueError, "height .*got 4"),
        ({"friction": "much"}, TypeError, "friction .*got 'much'"),
        ({"friction": torch.ones(2) > 0}, TypeError, r"friction .*got torch\.bool"),
        ({"friction": 0.1, "planes": sim.planes}, TypeError, r"give .*column 4.*, got both"),
        ({"height": 0.1, "gravity": torch.ones(2)}, ValueError, r"gravity .*got \[2\]"),
    ):
        with pytest.raises(kind, match=message):
            sim.set_material(**arrays)  # type: ignore[arg-type]
    assert all(torch.equal(now, then) for now, then in zip(sim.material(), before, strict=True))
    with pytest.raises(ValueError, match=r"radius .*none"):
        cube(pd.Ground()).set_material(radius=1.0)
    with pytest.raises(ValueError, match=r"friction .*none"):
        cube().set_material(friction=1.0)


def test_what_they_are_made_of_gets_no_gradient_and_that_is_said() -> None:
    sim = cube(pd.Ground(-1.0))
    friction = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    with pytest.warns(UserWarning, match=r"copies the values of planes, .*functional_call\(sim, \{\"planes\": "):
        sim.set_material(friction=friction)
    sim.planes.requires_grad_()
    sim.set_material(friction=0.25)  # what is learned stays what an optimiser knows
    assert sim.planes.requires_grad
    assert sim.planes[0, 4].item() == 0.25
