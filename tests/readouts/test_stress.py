"""Stress and strain of deformations that are known, and their averages at vertices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cases import box, sliver_mesh
from runs import noise, small
from torch import Tensor

import torchpd as pd

VERTICES, TETS = box((0.3, 0.2, 0.2), (3, 2, 2))
YOUNGS = np.linspace(1e4, 2e5, len(TETS))


def body(dtype: torch.dtype = torch.float64) -> pd.Simulator:
    solid = pd.Solid(pd.TetMesh(VERTICES, TETS), youngs=YOUNGS)
    return pd.Simulator(pd.Scene(solid), dtype=dtype, progress=False)


def rotation(seed: int = 0) -> Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)).double())
    return q * torch.det(q)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stretch", [0.8, 1.0, 1.25])
def test_uniform_stretch(dtype: torch.dtype, stretch: float) -> None:
    """Poisson ratio 0: sigma_xx = w (l - 1), nothing across; so det F = l cancels one l of P F^T."""
    sim = body(dtype)
    x = sim.rest_positions * torch.tensor([stretch, 1.0, 1.0], dtype=dtype)
    found = sim.stress(x[None])
    u = 2.0**-24 if dtype == torch.float32 else 2.0**-53
    along = sim.stiffness * (stretch - 1.0)
    expected = torch.zeros(1, len(TETS), 3, 3, dtype=dtype)
    expected[..., 0, 0] = along
    # F by differences of positions that are 0.3 m where edges are 0.1 m
    error = 40 * u * float(sim.stiffness.max())
    torch.testing.assert_close(found.cauchy, expected, rtol=0.0, atol=error)
    torch.testing.assert_close(found.von_mises[0], along.abs(), rtol=0.0, atol=2 * error)
    strain = torch.zeros(3, 3, dtype=dtype)
    strain[0, 0] = 0.5 * (stretch**2 - 1.0)
    torch.testing.assert_close(found.strain[0], strain.expand(len(TETS), 3, 3), rtol=0.0, atol=40 * u)
    assert not bool(found.inverted.any())


def test_uniform_stretch_of_three_axes() -> None:
    """sigma_i = w (l_i - 1) l_i / (l_1 l_2 l_3), turned by the rotation that comes after."""
    sim, stretch = body(), torch.tensor([1.3, 0.9, 1.1]).double()
    principal = (stretch - 1.0) * stretch / stretch.prod()
    deviator = principal - principal.mean()
    for turn in (torch.eye(3).double(), rotation(3)):
        found = sim.stress(((sim.rest_positions * stretch) @ turn.T)[None])
        expected = turn @ torch.diag(principal) @ turn.T
        scale = sim.stiffness[None, :, None, None]
        torch.testing.assert_close(found.cauchy / scale, expected.expand(1, len(TETS), 3, 3), rtol=0.0, atol=1e-13)
        von_mises = (1.5 * deviator.square().sum()).sqrt() * sim.stiffness
        torch.testing.assert_close(found.von_mises[0], von_mises, rtol=1e-12, atol=0.0)


def test_stress_turns_with_the_body() -> None:
    sim, state = small(torch.float64, batch=2)
    turn, shift = rotation(), torch.tensor([1.0, -2.0, 3.0]).double()
    one, other = sim.stress(state), sim.stress(state.positions @ turn.T + shift)
    assert torch.equal(one.inverted, other.inverted)
    whole = ~one.inverted
    scale = 1e-9 * float(one.cauchy[whole].abs().max())
    torch.testing.assert_close(turn @ one.cauchy[whole] @ turn.T, other.cauchy[whole], rtol=1e-9, atol=scale)
    torch.testing.assert_close(one.von_mises[whole], other.von_mises[whole], rtol=1e-9, atol=scale)
    torch.testing.assert_close(one.strain, other.strain, rtol=1e-9, atol=1e-9)
    assert torch.equal(one.cauchy[whole], one.cauchy[whole].mT)


def test_stress_is_the_derivative_of_the_energy() -> None:
    """Virtual work: dE of a field u is the sum of V det F sigma : grad u."""
    sim = body()
    x = (sim.rest_positions + 0.01 * noise(sim.rest_positions, 1))[None]
    A = noise(torch.zeros(3, 3), 2).double()
    work = (sim.gradient(x) * (x @ A.T)).sum()
    corners = x[0][torch.from_numpy(TETS)]
    volumes = torch.det(corners[:, 1:] - corners[:, :1]) / 6.0
    found = sim.stress(x)
    assert not bool(found.inverted.any())
    expected = (volumes[:, None, None] * found.cauchy[0] * A).sum()
    assert float(work) == pytest.approx(float(expected), rel=1e-9)


def energy_of(solid: pd.Solid, x: Tensor) -> Tensor:
    """Sum of V mu |F - R|^2, and of V lambda phi(t) over groups, with R by singular values: written independently."""
    youngs, poisson, group = (
        torch.as_tensor(np.array(a)) for a in (solid.youngs, solid.poisson, solid.averaging_groups)
    )
    rest, tets = torch.from_numpy(VERTICES)[TETS], torch.from_numpy(TETS)
    edges = (rest[:, 1:] - rest[:, :1]).mT
    F = (x[tets][:, 1:] - x[tets][:, :1]).mT @ torch.linalg.inv(edges)
    u, _, vh = torch.linalg.svd(F.detach())
    R = u @ torch.diag_embed(torch.stack([torch.ones(len(u)).double()] * 2 + [torch.det(u @ vh)], dim=-1)) @ vh
    volume = torch.det(edges) / 6.0
    mu = youngs / (2.0 * (1.0 + poisson))
    bulk = youngs * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    strain = F - R
    energy = (volume * mu * strain.square().sum((1, 2))).sum()
    for number in group.unique():
        own = group == number
        weight = (volume * bulk)[own]
        t = (weight * (R * strain).sum((1, 2))[own]).sum() / weight.sum()
        cap = (2.0 * mu / bulk)[own].min()
        energy = energy + weight.sum() * torch.where(t > cap, cap * (t - 0.5 * cap), 0.5 * t * t)
    return energy


@pytest.mark.parametrize("size", [1.0, 1.6])
def test_with_a_poisson_ratio_it_is_the_derivative_of_the_energy(size: float) -> None:
    """Virtual work with the mean of t over groups, capped where the body is 1.6 times as large."""
    poisson = np.linspace(0.2, 0.45, len(TETS))
    solid = pd.Solid(pd.TetMesh(VERTICES, TETS), youngs=YOUNGS, poisson=poisson, averaging=4)
    sim = pd.Simulator(pd.Scene(solid), dtype=torch.float64, progress=False)
    x = size * (sim.rest_positions + 0.01 * noise(sim.rest_positions, 1))
    x.requires_grad_()
    (gradient,) = torch.autograd.grad(energy_of(solid, x), x)
    A = noise(torch.zeros(3, 3), 2).double()
    corners = x.detach()[torch.from_numpy(TETS)]
    volumes = torch.det(corners[:, 1:] - corners[:, :1]) / 6.0
    work = (volumes[:, None, None] * sim.stress(x.detach()[None]).cauchy[0] * A).sum()
    assert float((gradient * (x.detach() @ A.T)).sum()) == pytest.approx(float(work), rel=1e-9)


def test_uniaxial_stress_with_a_poisson_ratio() -> None:
    """sigma = E (l - 1) / b^2 along it and nothing across, with b = 1 - nu (l - 1) the stretch across."""
    nu, stretch = 0.4, 1.2
    across = 1.0 - nu * (stretch - 1.0)
    sim = pd.Simulator(
        pd.Scene(pd.Solid(pd.TetMesh(VERTICES, TETS), youngs=YOUNGS, poisson=nu)), dtype=torch.float64, progress=False
    )
    found = sim.stress((sim.rest_positions * torch.tensor([stretch, across, across], dtype=torch.float64))[None])
    expected = torch.zeros(1, len(TETS), 3, 3, dtype=torch.float64)
    expected[..., 0, 0] = sim.stiffness * (stretch - 1.0) / across**2
    torch.testing.assert_close(found.cauchy, expected, rtol=0.0, atol=1e-13 * float(sim.stiffness.max()))


def test_inverted_tetrahedra_are_marked() -> None:
    sim = body()
    x = sim.rest_positions.clone()[None].repeat(2, 1, 1)
    x[1, 0] = x[1, TETS.max()] + 1.0  # through all others
    found = sim.stress(x)
    corners = x[:, torch.from_numpy(TETS)]
    expected = torch.det(corners[:, :, 1:] - corners[:, :, :1]) <= 0.0
    assert torch.equal(found.inverted, expected)
    assert not bool(expected[0].any())
    assert bool(expected[1].any())
    assert torch.equal(found.von_mises.isnan(), expected)
    assert torch.equal(found.cauchy.isnan().all(-1).all(-1), expected)
    flat = sim.rest_positions[None] * torch.tensor([1.0, 0.0, 1.0]).double()
    assert bool(sim.stress(flat).inverted.all())
    assert bool(sim.stress(torch.full_like(flat, torch.nan)).inverted.all())


def test_inverted_tetrahedra_have_no_part_in_gradients() -> None:
    """Of a mirrored one the nearest rotation has no derivative."""
    sim = body()
    x = sim.rest_positions[None] * torch.tensor([[[1.1, 1.0, 1.0]], [[-1.0, 1.0, 1.0]]]).double()
    x.requires_grad_()
    found = sim.stress(x)
    assert found.inverted.all(1).tolist() == [False, True]
    kept = torch.where(found.inverted, 0.0, found.von_mises).sum()
    (gradient,) = torch.autograd.grad(kept, x)
    assert bool(gradient.isfinite().all())
    assert [bool(one.any()) for one in gradient] == [True, False]


def test_gradients_by_finite_differences() -> None:
    solid = pd.Solid(pd.TetMesh(*box((0.1, 0.1, 0.1), (1, 1, 1))), youngs=2.0)
    sim = pd.Simulator(pd.Scene(solid), dtype=torch.float64)
    x = (sim.rest_positions + 0.01 * noise(sim.rest_positions))[None].repeat(2, 1, 1).requires_grad_()
    stiffness = sim.stiffness.detach().clone().requires_grad_()

    def read(x: Tensor, stiffness: Tensor) -> tuple[Tensor, ...]:
        found = pd.simulation.stress.stress(sim.scene, x, {"stiffness": stiffness})
        return found.cauchy, found.von_mises, found.strain, sim.vertex_average(found.von_mises)

    assert torch.autograd.gradcheck(read, (x, stiffness))


def test_at_rest_the_gradient_of_von_mises_is_zero() -> None:
    sim = body()
    x = sim.rest_positions[None].clone().requires_grad_()
    found = sim.stress(x).von_mises
    (gradient,) = torch.autograd.grad(found.sum(), x)
    assert bool(gradient.isfinite().all())


def test_averages_at_vertices() -> None:
    """Each tetrahedron counts by its rest volume; of two bodies."""
    mesh = sliver_mesh((2, 2, 2))
    scene = pd.Scene(pd.Solid(mesh, 1e4), pd.Solid(pd.TetMesh(VERTICES, TETS), 1e4))
    sim = pd.Simulator(scene, dtype=torch.float64)
    all_tets = np.concatenate([mesh.tets, TETS + len(mesh.vertices)])
    corners = sim.rest_positions.numpy()[all_tets]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1])
    values = noise(torch.zeros(2, len(all_tets), 3, 3), 4).double()
    expected = np.zeros((2, sim.vertices, 3, 3))
    for vertex in range(sim.vertices):
        mine = (all_tets == vertex).any(axis=1)
        expected[:, vertex] = np.average(values[:, mine].numpy(), axis=1, weights=volumes[mine])
    found = sim.vertex_average(values)
    assert found.numpy() == pytest.approx(expected, abs=1e-12)
    assert torch.equal(sim.vertex_average(values[1:]), found[1:])
    assert torch.equal(sim.vertex_average(values[..., 0, 1]), found[..., 0, 1])
    for wrong in (values[:, 1:], values[0, :, 0, 0]):
        with pytest.raises(ValueError, match="values must be"):
            sim.vertex_average(wrong)
    with pytest.raises(TypeError, match=r"torch\.float32"):
        sim.vertex_average(values.float())
