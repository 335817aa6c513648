"""Derivatives of strain limits, the volume law and damping by central differences in float64.

A difference of width 2 e has an error of e^2 / 6 of the third derivative and u / e of the function: 1e-6 suffices.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from runs import noise, simulator, state_of
from stretch_cases import KINDS, small_body
from torch import Tensor

import torchpd as pd
from torchpd.common.tables import KINDS as TABLE
from torchpd.common.tables import MATERIAL_TABLE
from torchpd.ops.diagonal import elastic_material

ops = torch.ops.torchpd
NAMES = [row.name for row in MATERIAL_TABLE]


def difference(of: Callable[[Tensor], Tensor], at: Tensor, along: Tensor, width: float = 1e-6) -> Tensor:
    return (of(at + width * along) - of(at - width * along)) / (2.0 * width)


def with_row(material: list[Tensor], name: str, value: Tensor) -> list[Tensor]:
    return [value if own == name else array for own, array in zip(NAMES, material, strict=True)]


def prepared(kind: str) -> tuple[pd.Simulator, Tensor, Tensor, list[Tensor], list[Tensor]]:
    """A simulator, a moved state, its start, material and plan."""
    case = small_body(kind)
    sim = simulator(case, torch.float64)
    start, velocities = state_of(case, sim)
    return sim, start + 0.01 * velocities, start, sim.material(), list(sim.plan.arrays)


@pytest.mark.parametrize("kind", KINDS)
def test_hessian_and_rows_of_the_energy(kind: str) -> None:
    sim, x, start, material, plan = prepared(kind)
    direction = noise(x)
    damped = kind == "damper"

    def gradient(at: Tensor, rows: list[Tensor] = material, before: Tensor = start) -> Tensor:
        if damped:
            return ops.damping_gradient(at, before, rows, plan, time_step=sim.time_step)
        return ops.gradient(at, rows, plan)

    expected = difference(gradient, x, direction)
    if damped:
        product, by_start, *by_rows = ops.damping_vjp(x, start, direction, material, plan, time_step=sim.time_step)
    else:
        product, by_rows = ops.hessian_product(x, direction, material, plan), None
    torch.testing.assert_close(product, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))
    if by_rows is None:
        by_rows = ops.effect_products(x, direction, material, plan)
    else:
        other = noise(x, 1)
        turned = difference(lambda y: (gradient(x, before=y) * direction).sum(), start, other)
        assert float((by_start * other).sum()) == pytest.approx(float(turned), rel=1e-6)
    found = dict(zip([*(["stiffness"] if damped else []), *NAMES[8:]], by_rows, strict=True))
    for name in TABLE[kind].rows:
        row = material[NAMES.index(name)]
        along = noise(row, 2) * row
        change = difference(lambda r, n=name: (gradient(x, with_row(material, n, r)) * direction).sum(), row, along)
        own = found[name] if name in found else ops.lame_product(x, direction, material, plan)[..., 0]
        assert float((own[0] * along).sum()) == pytest.approx(float(change), rel=1e-6), name


@pytest.mark.parametrize("kind", ["solid_limit", "cloth_limit", "volume"])
def test_energy_of_a_state(kind: str) -> None:
    """sim.energy by positions and by every row, and the derivative of that again."""
    _, x, _, material, plan = prepared(kind)
    x.requires_grad_()
    inputs = {name: material[NAMES.index(name)].detach().requires_grad_() for name in TABLE[kind].rows}
    rows = elastic_material(material)
    for name, row in inputs.items():
        rows = with_row(rows, name, row)
    energy = ops.effect_energy(x, rows, plan).sum()
    slopes = torch.autograd.grad(energy, [x, *inputs.values()], create_graph=True)
    along = noise(x)
    expected = difference(lambda y: ops.effect_energy(y, rows, plan), x.detach(), along)
    assert float((slopes[0] * along).sum()) == pytest.approx(float(expected), rel=1e-6)
    for (name, row), slope in zip(inputs.items(), slopes[1:], strict=True):
        turn = noise(row) * row.detach()
        change = difference(
            lambda r, n=name: ops.effect_energy(x.detach(), with_row(rows, n, r), plan), row.detach(), turn
        )
        assert float((slope * turn).sum()) == pytest.approx(float(change), rel=1e-6), name


def test_damping_is_no_elastic_energy() -> None:
    """Energy and gradient of a state are those of the same solid without damping."""
    case = small_body("damper")
    sim = simulator(case, torch.float64)
    body = case.scene.solids[0]
    plain = pd.Solid(body.mesh, body.youngs, poisson=body.poisson, averaging=1)
    other = pd.Simulator(
        pd.Scene(plain, pd.Pin(plain, case.scene.pins[0].vertices), pd.Gravity((0.0, -9.8, 0.0))),
        case.time_step, dtype=torch.float64, progress=False,
    )  # fmt: skip
    state = state_of(case, sim)
    torch.testing.assert_close(sim.energy(state), other.energy(state), rtol=1e-14, atol=0.0)
    torch.testing.assert_close(sim.gradient(state), other.gradient(state), rtol=1e-12, atol=1e-9)
    after = sim(state)
    assert not torch.allclose(after.positions, other(state).positions, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_a_step(kind: str) -> None:
    """Of a random linear function of the state after two steps, by the state before and by every row."""
    case = small_body(kind)
    sim = simulator(case, torch.float64, iterations=5000 if kind == "cloth_limit" else 1200)
    x, v = state_of(case, sim)
    names = TABLE[kind].rows
    for name in names:
        getattr(sim, name).requires_grad_()
    weights = [noise(x, seed) for seed in (3, 4)]

    def loss(state: pd.State) -> Tensor:
        track = sim.rollout(state, 2)
        return (track.positions[-1] * weights[0]).sum() + 0.01 * (track.velocities[-1] * weights[1]).sum()

    x.requires_grad_()
    v.requires_grad_()
    arrays = {name: getattr(sim, name) for name in names}
    grads = torch.autograd.grad(loss(pd.State(x, v)), [x, v, *arrays.values()])

    def along(at: Tensor, grad: Tensor, of: Callable[[Tensor], Tensor], seed: int, scale: Any = 1.0) -> None:
        turn = noise(at, seed) * scale
        with torch.no_grad():
            change = difference(of, at.detach(), turn, 1e-5)
        assert float((grad * turn).sum()) == pytest.approx(float(change), rel=2e-5, abs=1e-9)

    along(x, grads[0], lambda y: loss(pd.State(y, v.detach())), 5, 0.01)
    along(v, grads[1], lambda y: loss(pd.State(x.detach(), y)), 6)
    for name, grad in zip(names, grads[2:], strict=True):
        own = arrays[name].detach().clone()

        def with_value(value: Tensor, name: str = name) -> Tensor:
            with torch.no_grad():
                getattr(sim, name).copy_(value)
            return loss(pd.State(x.detach(), v.detach()))

        along(own, grad, with_value, 7, own)
        with_value(own)


def test_the_ops_of_damping_are_sound() -> None:
    """Schemas, fake kernels, derivatives and vmap."""
    sim, x, start, material, plan = prepared("damper")
    trained = [array.detach().requires_grad_() if NAMES[i] in TABLE["damper"].rows else array.detach()
               for i, array in enumerate(material)]  # fmt: skip
    numbers = {"time_step": sim.time_step}
    leaves = x.detach().requires_grad_(), start.detach().requires_grad_()
    torch.library.opcheck(ops.damping_gradient.default, (*leaves, trained, plan), numbers)
    detached = [array.detach() for array in material]
    torch.library.opcheck(ops.damping_vjp.default, (x, start, noise(x), detached, plan), numbers)
    states = torch.stack([x, x + 0.01 * noise(x)])
    together = torch.vmap(lambda y: ops.damping_gradient(y, start, detached, plan, **numbers))(states)
    for one, other in zip(together, states, strict=True):
        assert torch.equal(one, ops.damping_gradient(other, start, detached, plan, **numbers))


def test_gradients_of_a_step_under_vmap() -> None:
    """A batch of gradients at once is each by itself, damping's start included."""
    case = small_body("damper")
    sim = simulator(case, torch.float64, iterations=400)
    x, v = state_of(case, sim)
    x.requires_grad_()
    after = sim(pd.State(x, v)).positions
    rows = torch.stack([noise(x, 1), noise(x, 2)])
    (together,) = torch.autograd.grad(after, x, rows, is_grads_batched=True, retain_graph=True)
    for one, row in zip(together, rows, strict=True):
        (alone,) = torch.autograd.grad(after, x, row, retain_graph=True)
        torch.testing.assert_close(one, alone, rtol=1e-9, atol=1e-12)
