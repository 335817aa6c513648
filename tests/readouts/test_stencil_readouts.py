"""Stress of cloth, tensions of rods, springs and fibres, and forces of ties, in states that are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cases import box
from readout_cases import MESH, SIDE, settled, weight
from runs import noise
from sheets import cloth, deformation, group_of, surface
from torch import Tensor

import torchpd as pd
from torchpd.simulation.stencil_readouts import membrane_stress, tensions

YOUNGS, THICKNESS, NU = 1e5, 1e-3, 0.3
Y = YOUNGS * THICKNESS  # N/m


def turn(seed: int = 0) -> Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)).double())
    return q * torch.det(q)


def double(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def simulator(*parts: object, dtype: torch.dtype = torch.float64) -> pd.Simulator:
    return pd.Simulator(pd.Scene(*parts), dtype=dtype, progress=False)  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stretch", [0.9, 1.0, 1.2])
def test_uniaxial_stretch_of_a_membrane(dtype: torch.dtype, stretch: float) -> None:
    """A/A0 = l (1 - nu (l - 1)) leaves no force across; along it Y (l - 1) per rest width, whatever the axes."""
    across = 1.0 - NU * (stretch - 1.0)
    sheet = surface()
    uv = sheet.vertices[sheet.triangles][:, :, [0, 2]]
    for rest_uv in (None, uv):
        body = cloth(sheet, poisson=NU, bending=0.0, rest_uv=rest_uv)
        sim = simulator(body, dtype=dtype)
        flat = torch.from_numpy(sheet.vertices) * double(stretch, 1.0, across)
        found = sim.membrane_stress((flat @ turn().T + 0.3)[None].to(dtype))[body]
        nominal = Y * (stretch - 1.0) / across
        u = 2.0**-24 if dtype == torch.float32 else 2.0**-53
        error = 200 * u * Y  # F from positions of about 2 m and edges of 0.25 m, times 2 mu + lambda
        expected = torch.tensor(sorted([nominal, 0.0], reverse=True), dtype=dtype)
        torch.testing.assert_close(found.principal[0], expected.expand(len(uv), 2), rtol=0.0, atol=error)
        assert not bool(found.collapsed.any())
        if rest_uv is not None:
            wanted = torch.diag(torch.tensor([nominal, 0.0], dtype=dtype)).expand(len(uv), 2, 2)
            torch.testing.assert_close(found.cauchy[0], wanted, rtol=0.0, atol=error)
            green = 0.5 * torch.diag(torch.tensor([stretch**2 - 1.0, across**2 - 1.0], dtype=dtype))
            torch.testing.assert_close(found.strain[0], green.expand(len(uv), 2, 2), rtol=0.0, atol=200 * u)


def test_membrane_stress_is_the_derivative_of_the_energy() -> None:
    """Virtual work: dE of a field u = A x is the sum of area sigma : A in the plane of each triangle, threads too."""
    body = cloth(poisson=NU, bending=0.0, warp=50.0, weft=20.0, grain=(1.0, 0.0, 0.5))
    sim = simulator(body)
    x = (sim.rest_positions + 0.05 * noise(sim.rest_positions, 1))[None]
    A = noise(torch.zeros(3, 3), 2).double()
    work = float((sim.gradient(x) * (x @ A.T)).sum())
    found = sim.membrane_stress(x)[body]
    F = deformation(group_of("triangle", body), x[0].numpy())
    left, _, right = np.linalg.svd(F, full_matrices=False)
    frames = torch.from_numpy(left @ right)  # nearest, in space
    area = torch.from_numpy(body.areas * np.sqrt(np.linalg.det(np.swapaxes(F, 1, 2) @ F)))
    in_plane = frames.mT @ A @ frames
    expected = float((area[:, None, None] * found.cauchy[0] * in_plane).sum())
    assert work == pytest.approx(expected, rel=1e-9)
    assert torch.equal(found.cauchy, found.cauchy.mT)


def test_a_capped_membrane_has_no_more_than_twice_its_shear_modulus() -> None:
    """Beyond an area growth of (1 - nu) / nu both tensions per rest width are 2 mu (l - 1) + 2 mu."""
    body = cloth(poisson=NU, bending=0.0)
    sim = simulator(body)
    found = sim.membrane_stress(4.0 * sim.rest_positions[None])[body]
    nominal = Y / (1.0 + NU) * (3.0 + 1.0)
    torch.testing.assert_close(found.principal, torch.full_like(found.principal, nominal / 4.0), rtol=1e-12, atol=0.0)


def test_collapsed_triangles_are_marked_and_have_no_part_in_gradients() -> None:
    body = cloth(bending=0.0, warp=50.0, grain=(1.0, 0.0, 0.0))
    sim = simulator(body)
    x = sim.rest_positions[None].repeat(3, 1, 1)
    x = (x * torch.tensor([[[1.1, 1.0, 1.0]], [[1.0, 1.0, 0.0]], [[0.0, 0.0, 0.0]]]).double()).requires_grad_()
    found = sim.membrane_stress(x)[body]
    assert found.collapsed.all(1).tolist() == [False, True, True]
    assert torch.equal(found.principal.isnan().all(-1), found.collapsed)
    (gradient,) = torch.autograd.grad(torch.where(found.collapsed, 0.0, found.principal[..., 0]).sum(), x)
    assert bool(gradient.isfinite().all())
    assert [bool(one.any()) for one in gradient] == [True, False, False]


def test_tension_of_springs_and_rods() -> None:
    """k (l - L) of a spring; E A times the strain of a rod, in every segment of another length."""
    rod = pd.Rod(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]]), youngs=[1e6, 2e6], radius=[0.01, 0.005])
    spring = pd.Springs(rod, [[0, 2]], 40.0, rest_length=0.2)
    sim = simulator(spring, rod)
    found = sim.tensions(1.25 * sim.rest_positions[None] @ turn().T)
    assert list(found) == [spring, rod]
    area = torch.pi * double(0.01**2, 0.005**2)
    expected = double(1e6, 2e6) * area * 0.25
    torch.testing.assert_close(found[rod].tension[0], expected, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found[rod].strain[0], double(0.25, 0.25), rtol=1e-12, atol=0.0)
    assert float(found[spring].tension) == pytest.approx(40.0 * (1.25 * 0.3 - 0.2), rel=1e-12)
    assert float(found[spring].strain) == pytest.approx(1.25 * 0.3 / 0.2 - 1.0, rel=1e-12)


def test_tension_of_fibres_follows_their_activation() -> None:
    """w (l - 1 + contraction activation) at a stretch l along them, and nothing of a slack one."""
    solid = pd.Solid(pd.TetMesh(*box((0.3, 0.1, 0.1), (3, 1, 1))), 1e4)
    both, pulls = pd.Fibres(solid, (1, 0, 0), 2e3, 0.4), pd.Fibres(solid, (1, 0, 0), 3e3, 0.4, tension_only=True)
    sim = simulator(solid, both, pulls)
    x = sim.rest_positions[None].repeat(2, 1, 1) * double(0.7, 1.0, 1.0)
    activation = double(0.5, 1.0)
    found = sim.tensions(x, {both: activation, pulls: activation})
    lengths = 1.0 - 0.4 * activation[:, None]
    torch.testing.assert_close(found[both].tension, (2e3 * (0.7 - lengths)).expand(2, 18), rtol=1e-11, atol=0.0)
    assert not bool(found[pulls].tension[0].any())
    torch.testing.assert_close(found[pulls].tension[1], double(*[3e3 * 0.1] * 18), rtol=1e-11, atol=0.0)
    torch.testing.assert_close(found[both].strain, double(-0.3).expand(2, 18), rtol=1e-12, atol=0.0)


def test_a_tie_carries_the_weight_that_hangs_on_it() -> None:
    top = pd.Solid(MESH.translated((0.0, SIDE, 0.0)), youngs=1e5)
    hung = pd.Solid(MESH, youngs=1e5, density=1000.0)
    tie = pd.Tie(hung, MESH.vertices[:, 1] == SIDE, top, stiffness=1e4)
    pin = pd.Pin(top, top.mesh.vertices[:, 1] == 2 * SIDE)
    scene = pd.Scene(top, hung, tie, pin, pd.Gravity(), pd.Damping(10.0))
    sim = pd.Simulator(scene, 1 / 60, 200, dtype=torch.float64)
    state, after = settled(sim, 240)
    found = sim.reactions(state, after).ties[tie]
    mg = weight(sim) / 2.0
    assert found.force.shape == (1, 9, 3)
    assert found.wrench.force[0].tolist() == pytest.approx([0.0, mg, 0.0], abs=1e-6 * mg)
    assert float(found.wrench.torque.abs().max()) <= 1e-6 * mg * SIDE


def test_material_of_each_environment_is_its_own_and_a_wrong_number_is_refused() -> None:
    body = cloth(bending=0.0, poisson=0.0)
    sim = simulator(body)
    sim.set_material(membrane_youngs=double(1e5, 3e5)[:, None])
    x = sim.rest_positions * double(1.1, 1.0, 1.0)
    found = sim.membrane_stress(x.expand(2, -1, -1))[body].principal[..., 0]
    torch.testing.assert_close(found[1], 3.0 * found[0], rtol=1e-12, atol=0.0)
    with pytest.raises(ValueError, match="membrane_youngs, 2, got 3"):
        sim.membrane_stress(x.expand(3, -1, -1))


def test_gradients_by_finite_differences() -> None:
    body = cloth(surface(cells=(1, 1)), warp=50.0, grain=(1.0, 0.0, 0.2))
    rod = pd.Rod(np.array([[0.0, 1, 0], [0.4, 1, 0]]), youngs=1e4, radius=0.01)
    sim = simulator(body, rod)
    x = (sim.rest_positions + 0.1 * noise(sim.rest_positions))[None].repeat(2, 1, 1).requires_grad_()
    names = ("membrane_youngs", "membrane_poisson", "thickness", "thread_stiffness", "spring_stiffness", "rest_length")
    rows = [getattr(sim, name).detach().clone().requires_grad_() for name in names]

    def read(x: Tensor, *rows: Tensor) -> tuple[Tensor, ...]:
        material = dict(zip(names, rows, strict=True))
        sheet, line = membrane_stress(sim.scene, x, material)[body], tensions(sim.scene, x, material)[rod]
        return sheet.cauchy, sheet.principal, sheet.strain, *line

    assert torch.autograd.gradcheck(read, (x, *rows))


def test_the_same_bits_alone_and_in_a_batch() -> None:
    body = cloth(warp=50.0, grain=(1.0, 0.0, 0.2))
    solid = pd.Solid(MESH, 1e5, poisson=0.4)
    sim = simulator(body, solid, pd.Fibres(solid, (0, 1, 0), 1e4), dtype=torch.float32)
    x = sim.rest_positions + 0.02 * torch.stack([noise(sim.rest_positions, seed) for seed in range(7)])

    def read(x: Tensor) -> list[Tensor]:
        stress = sim.stress(x)
        (tension,) = sim.tensions(x).values()
        return [*sim.membrane_stress(x)[body][:3], *tension, stress.cauchy, *sim.volume(x).values()]

    for whole, one in zip(read(x), read(x[3:4]), strict=True):
        assert torch.equal(whole[3:4], one)
