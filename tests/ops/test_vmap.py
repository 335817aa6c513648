"""vmap over any argument and dimension is a loop over it."""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import pytest
import torch
from runs import ULP, material_with, noise, plan_of, settings_of, small
from torch import Tensor

import torchpd as pd
from torchpd.common.tables import MATERIAL_TABLE

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
    numbers, material, plan = settings_of(sim), sim.material(), plan_of(sim)

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
        return cast(Tensor, ops.element_energy(positions, material_with(sim, w), plan))

    expected = torch.stack([torch.stack([energy(one) for one in row]) for row in x])
    assert torch.equal(torch.vmap(torch.vmap(energy))(x), expected)
    moved = torch.vmap(energy, in_dims=2)(x[0].movedim(0, 2))
    assert torch.equal(moved, expected[0])


def test_vmap_of_rollout_fields_and_rotations(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    x = state.positions + 0.01 * noise(torch.empty(4, *state.positions.shape, dtype=dtype, device=device))
    numbers = {**settings_of(sim), "steps": 4, "every": 2}
    material, plan, w = sim.material(), plan_of(sim), sim.stiffness.detach()
    d = noise(x, 1)
    own = w * torch.linspace(0.5, 1.5, BATCH, dtype=dtype, device=device)[:, None]  # a stiffness for each environment
    matrices = noise(torch.empty(4, 5, 3, 3, dtype=dtype, device=device))
    cases: list[tuple[Any, tuple[Tensor, ...]]] = [
        (lambda y: ops.rollout(y, state.velocities, None, material, plan, **numbers)[0], (x,)),
        (lambda y: ops.gradient(y, material_with(sim, own), plan), (x,)),
        (lambda y: ops.hessian_product(y, d[0], material_with(sim, w), plan), (x,)),
        (lambda e: ops.hessian_product(x[0], e, material_with(sim, own), plan), (d,)),
        (lambda y, e: ops.element_energy_product(y, e, material_with(sim, w), plan), (x, d)),
        (lambda s: ops.element_energy(x[0], material_with(sim, s), plan), (torch.stack([w, 2 * w, 3 * w, 4 * w]),)),
        (
            lambda s: ops.elastic_diagonal(material_with(sim, s), plan, weighted=True),
            (torch.stack([w, 2 * w, 3 * w, 4 * w]),),
        ),
        (
            lambda s: ops.elastic_diagonal(material_with(sim, s), plan, weighted=False),
            (torch.stack([own, 2 * own, 3 * own, 4 * own]),),
        ),
        (ops.nearest_rotation, (matrices,)),
        (ops.rotation_differential, (matrices, matrices.flip(0))),
    ]
    for number, (function, given) in enumerate(cases):
        mapped = torch.vmap(function)(*given)
        single = torch.stack([function(*(t[m] for t in given)) for m in range(4)])
        assert torch.equal(mapped, single), number


def test_vmap_of_the_multilevel_solver(dtype: torch.dtype) -> None:
    sim, state = small(dtype, solver=pd.Multilevel())
    plan, material, numbers = plan_of(sim), sim.material(), settings_of(sim)
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
        return cast(Tensor, ops.element_energy(state.positions, sim.material(), arrays))

    with pytest.raises(ValueError, match="the plan cannot be mapped"):
        torch.vmap(energy)(torch.stack([sim.plan.tet_volume] * 2))


def test_one_map_is_refused_as_it_is_alone(device: torch.device) -> None:
    """What comes without a batch, or with another one: rules see the shapes of a map, not of all maps together."""
    sim, state = small(torch.float64, device, solver=pd.Multilevel())
    x, v = state
    plan, material, w = plan_of(sim), sim.material(), sim.stiffness
    numbers = settings_of(sim)
    maps = torch.ones(3, 1, 1, 1, dtype=x.dtype, device=device)
    cases: list[tuple[Callable[..., Any], tuple[Tensor, ...]]] = [
        (lambda a, b: sim((a, b)), (x, v)),
        (lambda a, b: sim.rollout((a, b), 2), (x, v)),
        (sim.energy, (x,)),
        (lambda a: ops.gradient(a, material_with(sim, w), plan), (x,)),
        (lambda a: ops.element_energy(a, material_with(sim, w), plan), (x,)),
        (lambda a: ops.hessian_product(a, x, material_with(sim, w), plan), (x,)),
        (lambda a: ops.precondition(a, plan), (x,)),
        (lambda s: ops.elastic_diagonal(material_with(sim, s), plan, weighted=False), (w.expand(2, 1, 1, -1),)),
        (lambda s: ops.element_energy(x, material_with(sim, s), plan), (w.expand(2, 2, -1),)),
        (lambda a: ops.step(x, a, None, None, material, plan, **numbers), (maps * v[:1],)),
        (lambda a: ops.step(x, v, a, None, material, plan, **numbers), (maps * v[:2],)),
        (ops.nearest_rotation, (torch.eye(3, dtype=x.dtype, device=device),)),
        (ops.rotation_differential, (torch.eye(3, dtype=x.dtype, device=device),) * 2),
    ]
    for function, given in cases:
        with pytest.raises((ValueError, RuntimeError)) as alone:
            function(*(t[0] for t in given))
        first = str(alone.value).splitlines()[0]
        with pytest.raises(type(alone.value), match=re.escape(first)):
            torch.vmap(function)(*given)


# ---- derivatives of many at once


def _match(found: Tensor, expected: Tensor) -> None:
    """The same bits on the CPU. On a GPU torch may add up another batch in another order, so that the adjoint's solve,
    which ends at 1e-5 or 1e-10, ends elsewhere within that; a hundred times as much for the condition of the system.
    """
    assert found.shape == expected.shape
    if not found.is_cuda:
        assert torch.equal(found, expected)
    elif found.numel():
        bound = {torch.float32: 1e-3, torch.float64: 1e-8}[found.dtype]
        assert float((found - expected).abs().max()) <= bound * float(expected.abs().max())


def _same(mapped: Any, single: list[Any]) -> None:
    """Each of the mapped results is that of its turn in the loop."""
    for m, one in enumerate(single):
        for every, alone in zip(mapped, one, strict=True):
            _match(every[m], alone)


@pytest.mark.parametrize("batch", [1, 3])
def test_vmap_of_the_adjoint_of_a_step(batch: int, dtype: torch.dtype, device: torch.device) -> None:
    """Any argument mapped, material shared by all environments, by one, and of each."""
    sim, (x, v) = small(dtype, device, batch)
    maps, plan, shared = 3, plan_of(sim), [array.detach() for array in sim.material()]
    factor = torch.linspace(0.5, 2.0, maps, dtype=dtype, device=device)
    w = shared[0]
    after = ops.step(x, v, None, None, shared, plan, **settings_of(sim, iterations=64))[0]
    grads = noise(torch.empty(maps, *x.shape, dtype=dtype, device=device))
    of_each = [array.expand(batch, *array.shape).clone() for array in shared]

    def adjoint(g: Tensor, y: Tensor, stiffness: Tensor, forces: Tensor | None, material: list[Tensor]) -> Any:
        arrays = [stiffness, *material[1:]]
        wanted = [row.name != "damping" for row in MATERIAL_TABLE if not row.effect]
        return ops.step_vjp(g, 0.1 * g, y, x, v, forces, arrays, plan, time_step=sim.time_step, wanted=wanted)

    moved = after + 1e-3 * factor[:, None, None, None] * x
    own = w * torch.linspace(0.5, 1.5, batch, dtype=dtype, device=device)[:, None]
    cases: list[tuple[tuple[int | None, ...], tuple[Any, ...], list[Tensor]]] = [
        ((0, None, None, None), (grads, after, w, None), shared),
        ((0, None, None, None), (grads, after, own, None), of_each),
        ((0, None, None, None), (grads, after, w[None], grads[0]), shared),
        ((None, 0, None, 0), (grads[0], moved, w, grads), shared),
        ((None, None, 0, None), (grads[0], after, factor[:, None] * w, None), shared),
        ((None, None, 0, None), (grads[0], after, factor[:, None, None] * own, None), of_each),
    ]
    for dims, given, material in cases:
        call = lambda *args, m=material: adjoint(*args, m)  # noqa: E731
        mapped = torch.vmap(call, in_dims=dims)(*given)
        _same(mapped, [call(*(t if d is None else t[m] for t, d in zip(given, dims, strict=True))) for m in range(3)])


@pytest.mark.parametrize("batch", [1, 3])
def test_vmap_of_the_adjoint_of_a_rollout(batch: int, dtype: torch.dtype, device: torch.device) -> None:
    """Any argument mapped. What environments share adds up over the steps first there, which rounds differently."""
    sim, (x, v) = small(dtype, device, batch)
    plan, shared = plan_of(sim), [array.detach() for array in sim.material()]
    after, speeds, _ = ops.rollout(x, v, None, shared, plan, **settings_of(sim, iterations=64), steps=2, every=1)
    grads = noise(torch.empty(3, *after.shape, dtype=dtype, device=device))
    factor = torch.linspace(0.5, 2.0, 3, dtype=dtype, device=device)[:, None]

    def adjoint(g: Tensor, y: Tensor, w: Tensor, forces: Tensor | None) -> Any:
        arrays = [w, *shared[1:]]
        wanted = [row.name != "damping" for row in MATERIAL_TABLE if not row.effect]
        return ops.rollout_vjp(
            g, 0.1 * g, y, speeds, x, v, forces, arrays, plan, time_step=sim.time_step, wanted=wanted
        )

    moved = after + 1e-3 * factor[..., None, None, None] * x
    cases: list[tuple[tuple[int | None, ...], tuple[Any, ...]]] = [
        ((0, None, None, None), (grads, after, shared[0], None)),
        ((1, None, None, 0), (grads.movedim(0, 1), after, shared[0], grads[:, 0])),
        ((None, 0, 0, None), (grads[0], moved, factor * shared[0], None)),
    ]
    for dims, given in cases:
        mapped = torch.vmap(adjoint, in_dims=dims)(*given)
        single = [
            adjoint(*(t if d is None else t.select(d, m) for t, d in zip(given, dims, strict=True))) for m in range(3)
        ]
        _same(mapped[:3], [one[:3] for one in single])
        for m, one in enumerate(single):
            for found, expected in zip(mapped[3:], one[3:], strict=True):
                assert found[m].shape == expected.shape
                bound = 256 * ULP[dtype] if device.type == "cpu" else {torch.float32: 1e-3, torch.float64: 1e-8}[dtype]
                assert not expected.numel() or float((found[m] - expected).abs().max()) <= bound * float(
                    expected.abs().max()
                )
    # errors are those of one map
    for wrong, name in (
        ((grads[:, 0], after, shared[0], None), "grad_positions"),
        ((grads, after, shared[0], noise(x)[:, 1:]), "forces"),
        ((grads, after, shared[0][1:], None), "stiffness"),
    ):
        with pytest.raises((ValueError, RuntimeError), match=name):
            torch.vmap(adjoint, in_dims=(0, None, None, None))(*wrong)


def test_batched_gradients_of_every_op(dtype: torch.dtype, device: torch.device) -> None:
    """`is_grads_batched`, which is an older vmap, is a loop over the gradients."""
    sim, (x, v) = small(dtype, device)
    plan, numbers = plan_of(sim), settings_of(sim, iterations=256)
    levels = plan_of(small(dtype, device, solver=pd.Multilevel())[0])
    w, d = sim.stiffness.detach(), noise(x, 1)
    own = w * torch.linspace(0.5, 1.5, BATCH, dtype=dtype, device=device)[:, None]
    rest = sim.material()[1:]
    F = noise(torch.empty(5, 3, 3, dtype=dtype, device=device))
    cases: list[tuple[Callable[..., Tensor], tuple[Tensor, ...]]] = [
        (lambda x, w: ops.element_energy(x, material_with(sim, w), plan), (x, w)),
        (lambda x, w: ops.gradient(x, material_with(sim, w), plan), (x, own)),
        (lambda d: ops.hessian_product(x, d, material_with(sim, w), plan), (d,)),
        (lambda x, d, w: ops.element_energy_product(x, d, material_with(sim, w), plan), (x, d, w)),
        (lambda d: ops.precondition(d, levels), (d,)),
        (ops.nearest_rotation, (F,)),
        (ops.rotation_differential, (F, F.flip(0))),
        (lambda x, v, f, w: ops.step(x, v, f, None, [w, *rest], plan, **numbers)[0], (x, v, d, w)),
        (lambda x, f, w: ops.rollout(x, v, f, [w, *rest], plan, **numbers, steps=3, every=1)[1], (x, d, own)),
    ]
    for function, given in cases:
        inputs = [t.detach().clone().requires_grad_() for t in given]
        out = function(*inputs)
        many = noise(torch.empty(4, *out.shape, dtype=dtype, device=device), 2)
        batched = torch.autograd.grad(out, inputs, many, retain_graph=True, is_grads_batched=True)
        single = [torch.autograd.grad(out, inputs, g, retain_graph=True) for g in many]
        _same(batched, single)
        # its backward runs autograd itself, which torch.vmap does not allow
        if function is not ops.rotation_differential:
            newer = torch.vmap(lambda g, o=out, i=inputs: torch.autograd.grad(o, i, g, retain_graph=True))(many)
            _same(newer, single)


def test_batched_gradients_in_another_thread() -> None:
    """As autograd has for a GPU: what torch counts for its older vmap is not known there."""
    sim, (x, _) = small(torch.float64, torch.device("cpu"))
    plan, material = plan_of(sim), [array.detach() for array in sim.material()]

    class Elsewhere(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, field: Tensor) -> Tensor:
            return field.clone()

        @staticmethod
        def backward(ctx: Any, *grads: Tensor) -> Any:
            with ThreadPoolExecutor(1) as pool:
                return pool.submit(ops.hessian_product, x, grads[0], material, plan).result()

    field = x.clone().requires_grad_()
    many = noise(torch.empty(4, *x.shape, dtype=x.dtype), 2)
    (found,) = torch.autograd.grad(Elsewhere.apply(field), field, many, is_grads_batched=True)
    assert torch.equal(found, torch.stack([ops.hessian_product(x, one, material, plan) for one in many]))


def test_the_older_vmap_is_not_nested() -> None:
    sim, (x, _) = small(torch.float64, torch.device("cpu"))
    twice = torch._vmap_internals._vmap(torch._vmap_internals._vmap(sim.gradient))
    with pytest.raises(RuntimeError, match=r"torchpd: torch's older vmap, .* cannot be nested"):
        twice(x.expand(2, 3, *x.shape))


def test_vectorized_jacobians_and_hessians(device: torch.device) -> None:
    """Of a step for forces and stiffness, and of an energy, the loop's."""
    sim, state = small(torch.float64, device)
    x, rest, numbers = state.positions, sim.material()[1:], settings_of(sim, iterations=64)

    def step(forces: Tensor, stiffness: Tensor) -> Tensor:
        material = [stiffness, *rest]
        return cast(Tensor, ops.step(*state, forces, None, material, plan_of(sim), **numbers)[0][:, ::9, 1])

    given = (torch.zeros_like(x), sim.stiffness.detach())
    jacobians = [torch.autograd.functional.jacobian(step, given, vectorize=fast) for fast in (True, False)]
    for fast, slow in zip(*jacobians, strict=True):
        _match(fast, slow)
    assert jacobians[0][1].abs().max() > 0
    hessians = [
        torch.autograd.functional.hessian(lambda y: sim.energy(y).sum(), x[:2], vectorize=fast)
        for fast in (True, False)
    ]
    _match(*hessians)
    # and differentiated once more, as where a penalty on gradients is trained
    y = x.clone().requires_grad_()
    many = noise(torch.empty(2, BATCH, dtype=x.dtype, device=device))
    (g,) = torch.autograd.grad(sim.energy(y), y, many, is_grads_batched=True, create_graph=True)
    alone = [torch.autograd.grad(sim.energy(y), y, row, create_graph=True)[0] for row in many]
    for batched, single in zip(g, alone, strict=True):
        bits = [torch.autograd.grad(t.square().sum(), y, retain_graph=True)[0] for t in (batched, single)]
        torch.testing.assert_close(*bits, rtol=1e-12, atol=1e-12 * float(bits[1].abs().max()))
