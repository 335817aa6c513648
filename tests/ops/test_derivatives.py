"""Derivatives of energies, fields and rotations: finite differences, symmetry, linearity."""

from __future__ import annotations

from typing import cast

import pytest
import torch
from runs import ULP, material_with, noise, plan_of, small
from torch import Tensor

import torchpd as pd

ops = torch.ops.torchpd
BATCH = 3


@pytest.mark.parametrize("shared", [True, False], ids=["one stiffness", "a stiffness each"])
def test_gradcheck_of_the_energy(shared: bool) -> None:
    """Twice differentiable in positions and stiffness together; steps of 1e-6 of metres and of stiffness in 1e4 Pa."""
    sim, state = small(torch.float64, batch=2)
    x = state.positions.clone().requires_grad_()
    unit = (sim.stiffness.detach() / 1e4).expand(*(() if shared else (2,)), -1).clone().requires_grad_()
    plan = plan_of(sim)

    def energy(positions: Tensor, w: Tensor) -> Tensor:
        return cast(Tensor, ops.element_energy(positions, material_with(sim, 1e4 * w), plan)).sum(-1)

    assert torch.autograd.gradcheck(energy, (x, unit), fast_mode=True, rtol=1e-5)
    assert torch.autograd.gradgradcheck(energy, (x, unit), fast_mode=True, rtol=1e-4)


@pytest.mark.parametrize("name", ["gradient", "element_energy_product"])
def test_gradcheck_of_the_fields(name: str) -> None:
    sim, state = small(torch.float64)
    inputs = [state.positions, noise(state.positions)][: 1 if name == "gradient" else 2]
    unit = sim.stiffness.detach() / 1e4
    plan = plan_of(sim)

    def field(*given: Tensor) -> Tensor:
        return cast(Tensor, getattr(ops, name)(*given[:-1], material_with(sim, 1e4 * given[-1]), plan))

    leaves = tuple(tensor.clone().requires_grad_() for tensor in (*inputs, unit))
    assert torch.autograd.gradcheck(field, leaves, fast_mode=True, rtol=1e-4)


def test_hessian_product_is_linear_and_symmetric(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    x, plan = state.positions, plan_of(sim)
    one, other = noise(x, 1), noise(x, 2)
    products = [ops.hessian_product(x, d, sim.material(), plan) for d in (one, other, one + 2 * other)]
    sizes = [float(p.abs().max()) for p in products]
    limit = 40 * 50 * ULP[dtype]  # as for the fields above
    assert float((products[2] - products[0] - 2 * products[1]).abs().max()) <= limit * max(sizes)
    left, right = float((other * products[0]).sum()), float((one * products[1]).sum())
    assert left == pytest.approx(right, abs=limit * x.numel() ** 0.5 * max(sizes))


def test_third_derivatives_are_refused() -> None:
    sim, state = small(torch.float64)
    x = state.positions.clone().requires_grad_()
    product = ops.hessian_product(x, noise(x.detach()), sim.material(), plan_of(sim))
    with pytest.raises(RuntimeError, match="third derivatives of the elastic energy are not provided"):
        product.sum().backward()


def test_gradcheck_of_rotations() -> None:
    matrices = noise(torch.empty(6, 3, 3, dtype=torch.float64)) + 2.0 * torch.eye(3, dtype=torch.float64)
    matrices[:2, :, 2] *= -1.0  # inverted ones too
    matrices.requires_grad_()
    assert torch.autograd.gradcheck(pd.nearest_rotation, (matrices,))
    assert torch.autograd.gradgradcheck(pd.nearest_rotation, (matrices,))


def test_a_singular_matrix_keeps_its_lack_of_derivatives_to_itself() -> None:
    def second(matrices: torch.Tensor) -> torch.Tensor:
        matrices = matrices.clone().requires_grad_()
        weights = torch.arange(9.0, dtype=torch.float64).reshape(3, 3)
        (first,) = torch.autograd.grad((weights * pd.nearest_rotation(matrices)[:2]).sum(), matrices, create_graph=True)
        return torch.autograd.grad(first[:2].square().sum(), matrices)[0]

    sound = torch.stack((torch.eye(3, dtype=torch.float64), 2.0 * torch.eye(3, dtype=torch.float64))) + 0.1
    found = second(torch.cat((sound, torch.zeros(1, 3, 3, dtype=torch.float64))))
    assert torch.equal(found[:2], second(sound))
    assert bool(found[2].isnan().all())


def test_gradients_flow_only_where_asked() -> None:
    sim, state = small(torch.float64)
    plan, w = plan_of(sim), sim.stiffness.detach().clone()
    x = state.positions.clone()
    assert not ops.element_energy(x, material_with(sim, w), plan).requires_grad
    (only,) = torch.autograd.grad(ops.element_energy(x, material_with(sim, w.requires_grad_()), plan).sum(), w)
    # the energy is linear in the stiffness
    linear = float((only * w.detach()).sum())
    assert linear == pytest.approx(float(ops.element_energy(x, material_with(sim, w.detach()), plan).sum()))
    x.requires_grad_()
    with torch.no_grad():
        assert not sim.energy(x).requires_grad
    assert sim.energy(x).requires_grad
    assert all(not parameter.requires_grad for parameter in sim.parameters())


def test_gradient_of_the_mechanical_energy_is_force_and_momentum() -> None:
    """dE/dx = elastic forces + springs - m g, dE/dv = m v."""
    sim, state = small(torch.float64)
    x, v = (t.clone().requires_grad_() for t in state)
    dx, dv = torch.autograd.grad(sim.energy(pd.State(x, v)).sum(), (x, v))
    masses = sim.masses[:, None]
    springs = torch.zeros_like(state.positions)
    springs[:, [9, 12]] = 1e3 * (state.positions[:, [9, 12]] - sim.rest_positions[[9, 12]])
    expected = sim.gradient(state.positions) + springs - masses * sim.gravity
    assert float((dx - expected).abs().max()) <= 64 * ULP[torch.float64] * float(expected.abs().max())
    assert torch.equal(dv, masses * state.velocities)
