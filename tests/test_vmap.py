"""vmap over any argument and dimension is a loop over it."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch
from runs import noise, numbers_of, plan_of, small
from torch import Tensor

import torchpd as pd

ops = torch.ops.torchpd
BATCH = 3


@pytest.mark.parametrize("batch", [1, 3])
def test_vmap_over_states_forces_and_material(batch: int, dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device, batch)
    maps = 4
    factor = torch.linspace(0.5, 2.0, maps, dtype=dtype, device=device)
    velocities = factor[:, None, None, None] * state.velocities
    forces = noise(velocities)
    stiffness = factor[:, None] * sim.stiffness
    numbers, material, plan = numbers_of(sim), sim.material(), plan_of(sim)

    def step(v: Tensor, f: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return cast(
            "tuple[Tensor, Tensor, Tensor]", ops.step(state.positions, v, f, None, [w, *material[1:]], plan, **numbers)
        )

    for dims in ((0, 0, 0), (None, 0, None), (None, None, 0), (0, None, None)):
        given = [t if d == 0 else t[1] for t, d in zip((velocities, forces, stiffness), dims, strict=True)]
        mapped = torch.vmap(step, in_dims=dims)(*given)
        for m in range(maps):
            single = step(*(t[m] if d == 0 else t for t, d in zip(given, dims, strict=True)))
            assert all(torch.equal(one[m], other) for one, other in zip(mapped, single, strict=True)), dims


def test_vmap_over_another_dimension_and_nested(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    x = state.positions + 0.01 * noise(torch.empty(2, 2, *state.positions.shape, dtype=dtype, device=device))
    w, plan = sim.stiffness, plan_of(sim)

    def energy(positions: Tensor) -> Tensor:
        return cast(Tensor, ops.element_energy(positions, w, plan))

    expected = torch.stack([torch.stack([energy(one) for one in row]) for row in x])
    assert torch.equal(torch.vmap(torch.vmap(energy))(x), expected)
    moved = torch.vmap(energy, in_dims=2)(x[0].movedim(0, 2))
    assert torch.equal(moved, expected[0])


def test_vmap_of_rollout_fields_and_rotations(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    x = state.positions + 0.01 * noise(torch.empty(4, *state.positions.shape, dtype=dtype, device=device))
    numbers = {**numbers_of(sim), "steps": 4, "every": 2}
    material, plan, w = sim.material(), plan_of(sim), sim.stiffness.detach()
    d = noise(x, 1)
    own = w * torch.linspace(0.5, 1.5, BATCH, dtype=dtype, device=device)[:, None]  # a stiffness for each environment
    matrices = noise(torch.empty(4, 5, 3, 3, dtype=dtype, device=device))
    cases: list[tuple[Any, tuple[Tensor, ...]]] = [
        (lambda y: ops.rollout(y, state.velocities, None, material, plan, **numbers)[0], (x,)),
        (lambda y: ops.gradient(y, own, plan), (x,)),
        (lambda y: ops.hessian_product(y, d[0], w, plan), (x,)),
        (lambda e: ops.hessian_product(x[0], e, own, plan), (d,)),
        (lambda y, e: ops.element_energy_product(y, e, w, plan), (x, d)),
        (lambda s: ops.element_energy(x[0], s, plan), (torch.stack([w, 2 * w, 3 * w, 4 * w]),)),
        (lambda s: ops.elastic_diagonal(s, plan, weighted=True), (torch.stack([w, 2 * w, 3 * w, 4 * w]),)),
        (lambda s: ops.elastic_diagonal(s, plan, weighted=False), (torch.stack([own, 2 * own, 3 * own, 4 * own]),)),
        (ops.nearest_rotation, (matrices,)),
        (ops.rotation_differential, (matrices, matrices.flip(0))),
    ]
    for number, (function, given) in enumerate(cases):
        mapped = torch.vmap(function)(*given)
        single = torch.stack([function(*(t[m] for t in given)) for m in range(4)])
        assert torch.equal(mapped, single), number


def test_vmap_of_the_multilevel_solver(dtype: torch.dtype) -> None:
    sim, state = small(dtype, solver=pd.Multilevel())
    plan, material, numbers = plan_of(sim), sim.material(), numbers_of(sim)
    field = noise(torch.empty(4, *state.positions.shape, dtype=dtype))
    assert torch.equal(
        torch.vmap(lambda f: ops.precondition(f, plan))(field), torch.stack([ops.precondition(f, plan) for f in field])
    )
    moved = torch.vmap(lambda f: ops.precondition(f, plan), in_dims=2)(field.movedim(0, 2))
    assert torch.equal(moved, torch.stack([ops.precondition(f, plan) for f in field]))

    def step(forces: Tensor) -> Tensor:
        return cast(Tensor, ops.step(*state, forces, None, material, plan, **numbers)[0])

    assert torch.equal(torch.vmap(step)(field), torch.stack([step(f) for f in field]))


def test_vmap_over_the_plan_is_refused() -> None:
    sim, state = small(torch.float32)
    plan = plan_of(sim)

    def energy(volume: Tensor) -> Tensor:
        arrays = [volume if t is sim.plan.tet_volume else t for t in plan]
        return cast(Tensor, ops.element_energy(state.positions, sim.stiffness, arrays))

    with pytest.raises(ValueError, match="the plan cannot be mapped"):
        torch.vmap(energy)(torch.stack([sim.plan.tet_volume] * 2))
