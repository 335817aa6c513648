"""The ops as citizens of PyTorch: opcheck, compile, vmap, derivatives, strides, empty batches."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import torch
from cases import Case, sliver_mesh
from runs import ULP, rounded_problem, simulator, tensor_of
from torch import Tensor

import torchpd as pd
from torchpd.state import Info

ops = torch.ops.torchpd
BATCH = 3


def small_case() -> Case:
    """Slivers with hard and soft pins, drag, gravity, a ground and a ball with friction."""
    mesh = sliver_mesh((3, 2, 2))
    body = pd.Solid(mesh, youngs=10.0 ** np.random.default_rng(0).uniform(3.0, 5.0, len(mesh.tets)))
    scene = pd.Scene(
        body, pd.Pin(body, [0, 3]), pd.Pin(body, [9, 12], 1e3), pd.Gravity(), pd.Damping(1.0),
        pd.Ground(-0.01, friction=0.5), pd.Sphere((0.4, 0.1, 0.1), 0.1, friction=0.2),
    )  # fmt: skip
    rng = np.random.default_rng(1)
    x = mesh.vertices + 0.01 * rng.standard_normal(mesh.vertices.shape)
    return Case(scene, x, rng.standard_normal(x.shape), 1.0 / 60.0)


def small(dtype: torch.dtype, device: torch.device | str = "cpu", batch: int = BATCH) -> tuple[pd.Simulator, pd.State]:
    """A simulator and different environments."""
    case = small_case()
    sim = simulator(case, dtype, device, iterations=6)
    factor = torch.linspace(0.5, 1.5, batch, dtype=dtype, device=device)[:, None, None]
    x, v = (tensor_of(array, sim) for array in (case.positions, case.velocities))
    return sim, pd.State(sim.rest_positions + factor * (x - sim.rest_positions), factor * v)


def noise(like: Tensor, seed: int = 0) -> Tensor:
    return torch.randn(like.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(like)


def plan_of(sim: pd.Simulator) -> list[Tensor]:
    return list(sim.plan.arrays)


def numbers_of(sim: pd.Simulator, **changed: Any) -> dict[str, Any]:
    """The keyword arguments of `step`."""
    given = {"iterations": 4, "time_step": sim.time_step, "tolerance": 0.0, "inertial": False, "report": True}
    return {**sim.solver.numbers(), **given, **changed}


def samples(name: str, dtype: torch.dtype, device: torch.device) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Arguments of an op: those with gradients ask for them where the op has derivatives."""
    sim, state = small(dtype, device)
    material, plan, w = sim.material(), plan_of(sim), sim.stiffness.detach()
    x, v = state.positions, state.velocities
    f = noise(x)
    direction = noise(x, 1)
    matrices = noise(torch.empty(5, 3, 3, dtype=dtype, device=device)) + 2.0 * torch.eye(3, dtype=dtype, device=device)
    info = torch.full((BATCH, len(Info._fields)), float("nan"), dtype=torch.float64, device=device)
    numbers = numbers_of(sim)
    found: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = {
        "step": ((x, v, f, None, material, plan), numbers),
        "step_": ((x.clone(), v.clone(), info, f, x + 0.01 * direction, material, plan), numbers),
        "rollout": ((x, v, f, material, plan), {**numbers, "steps": 4, "every": 2}),
        "gradient": ((x.requires_grad_(), w.requires_grad_(), plan), {}),
        "element_energy": ((x.requires_grad_(), w.requires_grad_(), plan), {}),
        "element_energy_product": ((x.requires_grad_(), direction.requires_grad_(), w.requires_grad_(), plan), {}),
        "hessian_product": ((x.detach(), direction.requires_grad_(), w.detach(), plan), {}),
        "nearest_rotation": ((matrices.requires_grad_(),), {}),
        "rotation_differential": ((matrices.requires_grad_(), noise(matrices.detach(), 2).requires_grad_()), {}),
    }
    return found[name]


OPS = (
    "step", "step_", "rollout", "gradient", "element_energy", "element_energy_product", "hessian_product",
    "nearest_rotation", "rotation_differential",
)  # fmt: skip
FIELDS = OPS[3:7]


@pytest.mark.parametrize("name", OPS)
def test_opcheck(name: str, dtype: torch.dtype, device: torch.device) -> None:
    arguments, keywords = samples(name, dtype, device)
    report = torch.library.opcheck(getattr(ops, name).default, arguments, keywords)
    assert set(report.values()) == {"SUCCESS"}


# ---- values


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("scale", [0.01, 3.0], ids=["small strains", "tumbled elements"])
def test_fields_are_those_of_the_reference(scale: float, dtype: torch.dtype, device: torch.device) -> None:
    """Energy, gradient, Hessian product and slope of the elastic energy alone."""
    case = small_case()
    sim = simulator(case, dtype, device)
    seen = tensor_of(case.positions + scale * np.random.default_rng(3).standard_normal(case.positions.shape), sim, 1)
    x = seen[0].double().cpu().numpy()
    problem = rounded_problem(Case(case.scene, x, 0.0 * x, case.time_step), torch.float64)
    direction = noise(seen)
    d = direction[0].double().cpu().numpy()
    deformation = problem.deformation_gradients(0.0 * x)
    strain = deformation - pd.reference.nearest_rotation(deformation)
    energies = 0.5 * problem.element_weight * (strain**2).sum(axis=(1, 2))
    stress = np.swapaxes(problem.element_weight[:, None, None] * strain, 1, 2).reshape(-1, 3)
    gradient = problem.operator.T @ stress
    slopes = ((problem.operator @ d) * stress).reshape(-1, 9).sum(axis=1)
    weight = np.repeat(problem.weight, 3)
    product = (problem.hessian(0.0 * x) @ d.reshape(-1) - weight * d.reshape(-1)).reshape(-1, 3)

    w, plan = sim.stiffness, plan_of(sim)
    found = {
        "energy": (ops.element_energy(seen, w, plan), energies),
        "gradient": (ops.gradient(seen, w, plan), gradient),
        "slope": (ops.element_energy_product(seen, direction, w, plan), slopes),
        "product": (ops.hessian_product(seen, direction, w, plan), product),
    }
    # slivers have grad N up to 40 times the inverse of their longest edge, and some fifty operations follow one another
    relative = 40 * 50 * ULP[dtype]
    # second derivatives are divided by sums of singular values: below 1e-2 of the strain only where elements tumble
    loose = {"product": 1e2 if scale > 1.0 else 1.0}
    for name, (have, want) in found.items():
        error = np.abs(have[0].detach().double().cpu().numpy() - want).max()
        assert error <= loose.get(name, 1.0) * relative * np.abs(want).max(), name


def test_step_allocates_what_it_fills(poisoned: None, dtype: torch.dtype, device: torch.device) -> None:
    for batch in (1, 3, 8, 17):
        sim, state = small(dtype, device, batch)
        for out in (sim(state, return_info=True), sim.rollout(state, 5, 2, return_info=True)):
            flat = torch.utils._pytree.tree_leaves(out)
            assert all(bool(t.isfinite().all()) for t in flat)


def test_step_leaves_its_inputs_alone(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    forces, start = noise(state.positions), state.positions + 0.01
    before = [t.clone() for t in (*state, forces, start, *sim.material(), *sim.plan.arrays)]
    sim(state, forces, start=start)
    sim.rollout(state, 3, forces=forces)
    sim.energy(state)
    after = (*state, forces, start, *sim.material(), *sim.plan.arrays)
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


# ---- shapes and strides


@pytest.mark.parametrize("batch", [1, 3, 9])
def test_strides_do_not_matter(batch: int, dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device, batch)
    forces = noise(state.positions)

    def strided(t: Tensor) -> list[Tensor]:
        wide = torch.full((*t.shape[:-1], 7), float("nan"), dtype=t.dtype, device=t.device)
        wide[..., 1:7:2] = t
        return [wide[..., 1:7:2], t.permute(2, 0, 1).contiguous().permute(1, 2, 0), t.flip(0).contiguous().flip(0)]

    plain, energy, gradient = sim(state, forces), sim.energy(state), sim.gradient(state.positions)
    track = sim.rollout(state, 3, forces=forces)
    for x, v, f in zip(strided(state.positions), strided(state.velocities), strided(forces), strict=True):
        assert not x.is_contiguous() or x.shape[0] == 1
        after = sim(pd.State(x, v), f, start=x)
        assert torch.equal(after.positions, sim(state, forces, start=state.positions).positions)
        assert torch.equal(sim(pd.State(x, v), f).velocities, plain.velocities)
        assert torch.equal(sim.energy(pd.State(x, v)), energy)
        assert torch.equal(sim.gradient(x), gradient)
        assert torch.equal(sim.rollout(pd.State(x, v), 3, forces=f).positions, track.positions)


def test_empty_batch(dtype: torch.dtype, device: torch.device) -> None:
    sim, _ = small(dtype, device)
    empty = sim.rest_state(0)
    after, info = sim(empty, return_info=True)
    assert after.positions.shape == after.velocities.shape == (0, sim.vertices, 3)
    assert all(column.shape == (0,) for column in info)
    assert sim.rollout(empty, 4, 2).positions.shape == (2, 0, sim.vertices, 3)
    assert sim.energy(empty).shape == (0,)
    assert sim.gradient(empty.positions).shape == empty.positions.shape
    assert ops.hessian_product(*empty, sim.stiffness, plan_of(sim)).shape == empty.positions.shape
    assert pd.nearest_rotation(torch.empty(0, 3, 3, dtype=dtype, device=device)).shape == (0, 3, 3)
    sim.step_(empty)


def test_no_steps_and_no_iterations(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    assert sim.rollout(state, 0).positions.shape == (0, BATCH, sim.vertices, 3)
    assert sim.rollout(state, 2, every=3).positions.shape == (0, BATCH, sim.vertices, 3)
    sim.iterations = 0
    after, info = sim(state, return_info=True, start=state.positions)
    assert info.iterations.tolist() == [0] * BATCH
    assert info.residual.tolist() == [1.0] * BATCH
    free = torch.ones(sim.vertices, dtype=torch.bool)
    free[[0, 3]] = False
    gaps = state.positions[..., 1] + 0.01
    away = (state.positions - tensor_of(np.array([0.4, 0.1, 0.1]), sim)).norm(dim=-1) - 0.1
    untouched = free.to(device) & (gaps > 0) & (away > 0)
    # the first iterate is the start where no pin or contact has its say; x + (x - x) is exact
    assert torch.equal(after.positions[untouched], state.positions[untouched])


# ---- compile


@pytest.mark.parametrize("dynamic", [False, True])
def test_compiled_step_is_the_step(dynamic: bool) -> None:
    sim, state = small(torch.float32)
    forces = noise(state.positions)

    def advance(x: Tensor, v: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
        after = sim(pd.State(2.0 * x - x, v), 1.0 * f)
        return after.positions, after.velocities + 1.0

    compiled = torch.compile(advance, fullgraph=True, backend="aot_eager", dynamic=dynamic)
    x, v = compiled(*state, forces)
    expected = sim(state, forces)
    assert torch.equal(x, expected.positions)
    assert torch.equal(v, expected.velocities + 1.0)


def test_compiled_rollout_is_the_rollout() -> None:
    sim, state = small(torch.float32)

    def play(x: Tensor, v: Tensor) -> Tensor:
        return sim.rollout(pd.State(x, v), 6, every=2).positions.mean(dim=2)

    assert torch.equal(torch.compile(play, fullgraph=True, backend="aot_eager")(*state), play(*state))


def test_compiled_energy_has_its_gradient() -> None:
    sim, state = small(torch.float64)

    def energy(x: Tensor) -> Tensor:
        return sim.energy(x).sum()

    x = state.positions.clone().requires_grad_()
    (expected,) = torch.autograd.grad(energy(x), x)
    compiled = torch.compile(energy, fullgraph=True, backend="aot_eager")
    (found,) = torch.autograd.grad(compiled(x), x)
    # the decomposed backward may add up in another order
    assert float((found - expected).abs().max()) <= 64 * ULP[torch.float64] * float(expected.abs().max())


def test_export_keeps_the_ops() -> None:
    sim, state = small(torch.float32)

    class Model(torch.nn.Module):
        def forward(self, matrices: Tensor) -> Tensor:
            return cast(Tensor, ops.nearest_rotation(matrices))

    given = noise(torch.empty(4, 3, 3))
    program = torch.export.export(Model(), (given,))
    assert any(node.target is ops.nearest_rotation.default for node in program.graph.nodes)
    assert torch.equal(program.module()(given), pd.nearest_rotation(given))
    assert sim.vertices == state.positions.shape[1]


# ---- vmap


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
        (ops.nearest_rotation, (matrices,)),
        (ops.rotation_differential, (matrices, matrices.flip(0))),
    ]
    for number, (function, given) in enumerate(cases):
        mapped = torch.vmap(function)(*given)
        single = torch.stack([function(*(t[m] for t in given)) for m in range(4)])
        assert torch.equal(mapped, single), number


def test_vmap_over_the_plan_is_refused() -> None:
    sim, state = small(torch.float32)
    plan = plan_of(sim)

    def energy(volume: Tensor) -> Tensor:
        arrays = [volume if t is sim.plan.tet_volume else t for t in plan]
        return cast(Tensor, ops.element_energy(state.positions, sim.stiffness, arrays))

    with pytest.raises(ValueError, match="the plan cannot be mapped"):
        torch.vmap(energy)(torch.stack([sim.plan.tet_volume] * 2))


# ---- derivatives


@pytest.mark.parametrize("shared", [True, False], ids=["one stiffness", "a stiffness each"])
def test_gradcheck_of_the_energy(shared: bool) -> None:
    """Twice differentiable in positions and stiffness together; steps of 1e-6 of metres and of stiffness in 1e4 Pa."""
    sim, state = small(torch.float64, batch=2)
    x = state.positions.clone().requires_grad_()
    unit = (sim.stiffness.detach() / 1e4).expand(*(() if shared else (2,)), -1).clone().requires_grad_()
    plan = plan_of(sim)

    def energy(positions: Tensor, w: Tensor) -> Tensor:
        return cast(Tensor, ops.element_energy(positions, 1e4 * w, plan)).sum(-1)

    assert torch.autograd.gradcheck(energy, (x, unit), fast_mode=True, rtol=1e-5)
    assert torch.autograd.gradgradcheck(energy, (x, unit), fast_mode=True, rtol=1e-4)


@pytest.mark.parametrize("name", ["gradient", "element_energy_product"])
def test_gradcheck_of_the_fields(name: str) -> None:
    arguments, _ = samples(name, torch.float64, torch.device("cpu"))
    *tensors, plan = arguments
    inputs = [t.detach().clone().requires_grad_() for t in tensors[:-1]]
    unit = (tensors[-1].detach() / 1e4).requires_grad_()

    def field(*given: Tensor) -> Tensor:
        return cast(Tensor, getattr(ops, name)(*given[:-1], 1e4 * given[-1], plan))

    assert torch.autograd.gradcheck(field, (*inputs, unit), fast_mode=True, rtol=1e-4)


def test_hessian_product_is_linear_and_symmetric(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    x, plan = state.positions, plan_of(sim)
    one, other = noise(x, 1), noise(x, 2)
    products = [ops.hessian_product(x, d, sim.stiffness, plan) for d in (one, other, one + 2 * other)]
    sizes = [float(p.abs().max()) for p in products]
    limit = 40 * 50 * ULP[dtype]  # as for the fields above
    assert float((products[2] - products[0] - 2 * products[1]).abs().max()) <= limit * max(sizes)
    left, right = float((other * products[0]).sum()), float((one * products[1]).sum())
    assert left == pytest.approx(right, abs=limit * x.numel() ** 0.5 * max(sizes))


def test_third_derivatives_are_refused() -> None:
    sim, state = small(torch.float64)
    x = state.positions.clone().requires_grad_()
    product = ops.hessian_product(x, noise(x.detach()), sim.stiffness, plan_of(sim))
    with pytest.raises(RuntimeError, match="third derivatives of the elastic energy are not provided"):
        product.sum().backward()


def test_gradcheck_of_rotations() -> None:
    matrices = noise(torch.empty(6, 3, 3, dtype=torch.float64)) + 2.0 * torch.eye(3, dtype=torch.float64)
    matrices[:2, :, 2] *= -1.0  # inverted ones too
    matrices.requires_grad_()
    assert torch.autograd.gradcheck(pd.nearest_rotation, (matrices,))
    assert torch.autograd.gradgradcheck(pd.nearest_rotation, (matrices,))


def test_gradients_flow_only_where_asked() -> None:
    sim, state = small(torch.float64)
    plan, w = plan_of(sim), sim.stiffness.detach().clone()
    x = state.positions.clone()
    assert not ops.element_energy(x, w, plan).requires_grad
    (only,) = torch.autograd.grad(ops.element_energy(x, w.requires_grad_(), plan).sum(), w)
    # the energy is linear in the stiffness
    assert float((only * w.detach()).sum()) == pytest.approx(float(ops.element_energy(x, w.detach(), plan).sum()))
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
