"""Tetrahedra with Poisson's ratio: energy, stress, derivatives and the majoriser, alone and in groups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import box
from numpy.typing import NDArray
from torch import Tensor

import torchpd as pd
from torchpd.common.tables import MATERIAL_TABLE
from torchpd.plan.cpu_plan import Plan, compile_plan
from torchpd.plan.material import material_of, material_rows
from torchpd.scene import Scene
from torchpd.scene.averaging import average_over
from torchpd.scene.effects import Solid

Array = NDArray[np.float64]
OPS = torch.ops.torchpd
POISSON = [row.name for row in MATERIAL_TABLE].index("poisson")
STIFFNESS = 0
SIZES = (1, 2, 4)  # elements of a group
UNIT = pd.TetMesh(np.concatenate([np.zeros((1, 3)), np.eye(3)]), np.array([[0, 1, 2, 3]]))

STRAINED = np.array([[1.1, 0.2, -0.1], [0.05, 0.9, 0.3], [0.0, -0.2, 1.3]])
INVERTED = np.array([[1.1, 0.2, -0.1], [0.05, 0.9, 0.3], [0.1, -0.2, -0.5]])
CAPPED = 1.4 * np.eye(3) + 0.1 * (STRAINED - np.eye(3))
# E = 1, nu = 0.4: energy density and entries of P = dpsi / dF, from an independent prototype in float64
KNOWN = (
    (STRAINED, 0.1533328234616, [[0.59259215583, 0.12839335275, -0.06258442296],
                                 [0.04784595421, 0.45431170097, 0.17084591456],
                                 [-0.01184241555, -0.10013721359, 0.73984320579]]),
    (INVERTED, 1.6894638741880, [[np.nan] * 3, [np.nan, np.nan, -1.6931728596], [np.nan, np.nan, -1.6592959787]]),
    (CAPPED, 0.8810446428571, CAPPED / 1.4),
)  # fmt: skip


def elements(
    mesh: pd.TetMesh, youngs: Array | float, poisson: Array | float, group: Array | None = None, dtype=torch.float64
) -> tuple[Plan, list[Tensor]]:
    """Plan and material of elements alone; youngs and poisson are [E] or [B, E], `group` the numbers of groups [E]."""
    values = Scene(Solid(mesh, youngs=1.0, density=1.0)).values()
    groups = None if group is None else np.asarray(group, dtype=np.int64)
    values = replace(values, poisson=np.zeros(len(mesh.tets)), tet_group=groups)
    material = material_rows(material_of(values, dtype))
    count = (len(mesh.tets),)
    for place, value in ((STIFFNESS, youngs), (POISSON, poisson)):
        rows = np.asarray(value, np.float64)
        material[place] = torch.tensor(np.broadcast_to(rows, (*rows.shape[:-1], *count)).copy(), dtype=dtype)
    return compile_plan(values, dtype=dtype, progress=False), material


def rough_mesh(seed: int = 0) -> pd.TetMesh:
    """72 tetrahedra of uneven shapes."""
    vertices, tets = box((3.0, 2.0, 2.0), (3, 2, 2))
    return pd.TetMesh(vertices + np.random.default_rng(seed).uniform(-0.15, 0.15, vertices.shape), tets)


def mixed(size: int) -> tuple[pd.TetMesh, Plan, list[Tensor]]:
    """Groups of unlike materials: stiffness varies tenfold, Poisson's ratio from 0.2 to 0.49."""
    mesh, rng = rough_mesh(), np.random.default_rng(1)
    count = len(mesh.tets)
    group = average_over(mesh, np.ones(count), size)
    return mesh, *elements(mesh, 10.0 ** rng.uniform(0.0, 1.0, count), rng.uniform(0.2, 0.49, count), group)


def positions_of(mesh: pd.TetMesh, state: str, seed: int = 2) -> Tensor:
    """Random, stretched or far stretched positions, where groups reach their cap, [1, V, 3]."""
    rng = np.random.default_rng(seed)
    stretch, noise = {"random": (1.0, 0.3), "stretched": ([1.6, 1.2, 1.1], 0.05), "capped": ([3.0, 2.0, 2.0], 0.3)}[
        state
    ]
    return torch.tensor((mesh.vertices * stretch + rng.uniform(-noise, noise, mesh.vertices.shape))[None])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("F", "energy", "stress"), KNOWN, ids=["strained", "inverted", "capped"])
def test_known_states(F: Array, energy: float, stress: list[list[float]], dtype: torch.dtype) -> None:
    plan, material = elements(UNIT, 1.0, 0.4, dtype=dtype)
    x = torch.tensor((UNIT.vertices @ F.T)[None], dtype=dtype)
    # a trace strain of a few roundings of |F|, which lambda = 1.43 multiplies; the prototype has 10 digits
    tolerance = 1e-9 if dtype == torch.float64 else 8 * 2.0**-24 * 1.43 * float(np.linalg.norm(F))
    found = OPS.element_energy(x, material, list(plan.arrays)).item() * 6.0
    assert abs(found - energy) <= tolerance * max(1.0, energy)
    P = OPS.gradient(x, material, list(plan.arrays))[0, 1:].double().mT * 6.0
    known = torch.tensor(np.asarray(stress))
    there = ~known.isnan()
    assert (P - known)[there].abs().max() <= tolerance


@pytest.mark.parametrize("nu", [-0.3, 0.0, 0.3, 0.45])
def test_free_bar_and_dilation(nu: float) -> None:
    """Lateral contraction nu (s - 1) leaves P = E (s - 1) e_1 e_1^T; (1 + e) I gives E e / (1 - 2 nu) up to the cap."""
    plan, material = elements(UNIT, 2.0, nu)
    cap = (1.0 - 2.0 * nu) / (3.0 * nu) * 2.0 if nu > 0.0 else np.inf  # 3 lambda e = 2 mu, doubled
    for F, P in (
        (np.diag([1.2, 1.0 - 0.2 * nu, 1.0 - 0.2 * nu]), np.diag([0.4, 0.0, 0.0])),
        (np.diag([0.7, 1.0 + 0.3 * nu, 1.0 + 0.3 * nu]), np.diag([-0.6, 0.0, 0.0])),
        (0.9 * np.eye(3), -0.2 / (1.0 - 2.0 * nu) * np.eye(3)),
        *([((1.0 + cap) * np.eye(3), 2.0 / (1.0 + nu) * (1.0 + cap) * np.eye(3))] if nu > 0.0 else []),
    ):
        found = OPS.gradient(torch.tensor((UNIT.vertices @ F.T)[None]), material, list(plan.arrays))
        np.testing.assert_allclose(found[0, 1:].T * 6.0, P, atol=1e-13)


@pytest.mark.parametrize("state", ["random", "stretched", "capped"])
@pytest.mark.parametrize("size", SIZES)
def test_derivatives_by_positions(size: int, state: str) -> None:
    mesh, plan, material = mixed(size)
    x, arrays = positions_of(mesh, state), list(plan.arrays)
    d = torch.tensor(np.random.default_rng(3).normal(size=x.shape))
    e = 1e-6
    energy = [OPS.effect_energy(x + sign * e * d, material, arrays) for sign in (1, -1)]
    gradient = [OPS.gradient(x + sign * e * d, material, arrays) for sign in (1, -1)]
    slope = (OPS.gradient(x, material, arrays) * d).sum()
    torch.testing.assert_close((energy[0] - energy[1]) / (2 * e), slope[None], rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(OPS.element_energy_product(x, d, material, arrays).sum(), slope, rtol=1e-12, atol=1e-12)
    H = OPS.hessian_product(x, d, material, arrays)
    torch.testing.assert_close((gradient[0] - gradient[1]) / (2 * e), H, rtol=1e-6, atol=1e-6 * float(H.abs().max()))
    each = OPS.element_energy(x, material, arrays).sum(-1)
    torch.testing.assert_close(each, OPS.effect_energy(x, material, arrays), rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("state", ["random", "capped"])
@pytest.mark.parametrize("size", SIZES)
def test_derivatives_by_material(size: int, state: str) -> None:
    """By E and nu of every element, of the energy and of the gradient's product with a direction."""
    mesh, plan, material = mixed(size)
    x, arrays = positions_of(mesh, state), list(plan.arrays)
    d = torch.tensor(np.random.default_rng(3).normal(size=x.shape))
    values = {
        None: lambda rows: OPS.effect_energy(x, rows, arrays),
        "product": lambda rows: (OPS.gradient(x, rows, arrays) * d).sum()[None],
    }
    for kind, value in values.items():
        found = OPS.lame_product(x, None if kind is None else d, material, arrays)[0]
        for tet in (0, 17, 40, 71):
            for number, place in enumerate((STIFFNESS, POISSON)):
                ends = []
                for sign in (1, -1):
                    rows = list(material)
                    rows[place] = rows[place].clone()
                    rows[place][tet] += sign * 1e-6
                    ends.append(value(rows))
                difference = ((ends[0] - ends[1]) / 2e-6).item()
                assert abs(difference - found[tet, number].item()) <= 1e-6 * max(1.0, float(found[tet].abs().max()))


def test_curvature_stays_bounded_where_two_stretches_cancel() -> None:
    """At diag(4, 1, -1 + 1e-3) the twist has a curvature of 4.8e3 E without the cap, and 0.69 E with it."""
    plan, material = elements(UNIT, 1.0, 0.45)
    x = torch.tensor((UNIT.vertices * [4.0, 1.0, -1.0 + 1e-3])[None])
    twist = np.zeros((3, 3))
    twist[1, 2], twist[2, 1] = np.sqrt(0.5), -np.sqrt(0.5)
    d = torch.tensor((UNIT.vertices @ twist.T)[None])
    curvature = (OPS.hessian_product(x, d, material, list(plan.arrays)) * d).sum().item() * 6.0
    assert abs(curvature - 1.0 / 1.45) < 1e-3


def group_of(size: int) -> pd.TetMesh:
    """One element with up to three neighbours on its faces."""
    vertices = np.concatenate([UNIT.vertices, [[1.0, 1.0, 1.0], [-1.0, 0.2, 0.1], [0.3, -1.0, 0.2]]])
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [0, 2, 3, 5], [0, 1, 3, 6]])[:size]
    corners = vertices[tets]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    tets = np.where(turned[:, None], tets[:, [0, 2, 1, 3]], tets)
    return pd.TetMesh(vertices[: tets.max() + 1], tets)


@pytest.mark.parametrize("size", SIZES)
def test_no_state_raises_the_energy(size: int) -> None:
    """E(x - theta g / D) <= E - theta (1 - theta / 2) g . g / D on 21,000 random states of unlike materials."""
    mesh, rng, count = group_of(size), np.random.default_rng(4), 3000
    at_rest = mesh.vertices[None]
    shape = (count, *mesh.vertices.shape)
    noise = rng.normal(size=shape)
    states = (
        at_rest + 0.1 * noise,
        noise,
        at_rest * 10.0 ** rng.uniform(-3.0, 0.0, (count, 1, 3)),  # collapsed
        at_rest * 10.0 ** rng.uniform(0.0, 1.2, (count, 1, 3)),  # stretched
        at_rest * [1.0, 1.0, -1.0] + 0.1 * noise,  # inverted
        at_rest * [4.0, 1.0, -1.0] + 0.01 * noise,  # where the uncapped energy has no bound
        at_rest * [0.0, 0.0, 1.0] + 1e-3 * noise,  # lines
    )
    poisson, youngs = rng.uniform(0.05, 0.494, (count, size)), 10.0 ** rng.uniform(0.0, 4.0, (count, size))
    plan, material = elements(mesh, youngs, poisson, np.zeros(size))
    arrays = list(plan.arrays)
    D = OPS.elastic_diagonal(material, arrays, weighted=True)[..., None]
    for state in states:
        x = torch.tensor(state)
        energy, gradient = OPS.effect_energy(x, material, arrays), OPS.gradient(x, material, arrays)
        for theta in (0.3, 1.0, 1.9):
            promised = energy - theta * (1.0 - theta / 2.0) * (gradient * gradient / D).sum((1, 2))
            after = OPS.effect_energy(x - theta * gradient / D, material, arrays)
            assert (after <= promised + 1e-12 * energy.abs() + 1e-14).all()


def test_autograd_of_energy_and_gradient() -> None:
    """Energies differentiate twice by positions, and once by both parameters; shared rows sum over environments."""
    mesh, plan, material = mixed(4)
    x = positions_of(mesh, "random").repeat(2, 1, 1)
    x[1] += 0.01 * torch.randn(x[1].shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    x.requires_grad_()
    rows = [array.requires_grad_() if place in (STIFFNESS, POISSON) else array for place, array in enumerate(material)]
    weights = torch.tensor([1.0, -2.0], dtype=x.dtype)
    energy = (weights * OPS.effect_energy(x, rows, list(plan.arrays))).sum()
    (slope,) = torch.autograd.grad(energy, x, create_graph=True)
    torch.testing.assert_close(slope, weights[:, None, None] * OPS.gradient(x, rows, list(plan.arrays)))
    d = torch.ones_like(x)
    (curved,) = torch.autograd.grad((slope * d).sum(), x, retain_graph=True)
    product = OPS.hessian_product(x.detach(), d, material, list(plan.arrays))
    torch.testing.assert_close(curved, weights[:, None, None] * product)
    by = torch.autograd.grad(energy, (rows[STIFFNESS], rows[POISSON]))
    found = (weights[:, None, None] * OPS.lame_product(x.detach(), None, material, list(plan.arrays))).sum(0)
    torch.testing.assert_close(torch.stack(by, -1), found)
    with pytest.raises(RuntimeError, match="effect_energy"):
        OPS.element_energy(x, rows, list(plan.arrays)).sum().backward()


def test_more_than_four_in_a_group_are_refused() -> None:
    with pytest.raises(ValueError, match="up to 4 tetrahedra, got 5"):
        elements(rough_mesh(), 1.0, 0.3, np.arange(72) // 5)
