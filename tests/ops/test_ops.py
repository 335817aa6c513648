"""The ops as citizens of PyTorch: opcheck, values, strides, empty batches, inputs left alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cases import Case
from op_samples import BATCH, OPS, samples
from runs import ULP, material_with, noise, plan_of, rounded_problem, simulator, small, small_case, tensor_of
from torch import Tensor

import torchpd as pd

ops = torch.ops.torchpd


@pytest.mark.parametrize("name", OPS)
def test_opcheck(name: str, dtype: torch.dtype, device: torch.device) -> None:
    arguments, keywords = samples(name, dtype, device)
    report = torch.library.opcheck(getattr(ops, name).default, arguments, keywords)
    assert set(report.values()) == {"SUCCESS"}


def test_ops_with_a_plan_stay_out_of_the_graphs_of_torch_compile() -> None:
    """Which cannot return the counts that a plan has on the CPU."""
    schemas = [schema for schema in torch._C._jit_get_all_schemas() if schema.name.startswith("torchpd::")]
    with_plan = [s.name.split("::")[1] for s in schemas if any(a.name == "plan" for a in s.arguments)]
    assert {"step", "rollout", "gradient", "precondition", "step_vjp", "rollout_vjp"} <= set(with_plan)
    for name in with_plan:
        assert torch.Tag.cudagraph_unsafe in getattr(ops, name).default.tags, name


@pytest.mark.parametrize("name", ["step_vjp", "rollout_vjp"])
def test_opcheck_of_adjoints_of_permuted_arrays(name: str, dtype: torch.dtype, device: torch.device) -> None:
    """Whose results are laid out as their fakes say: torch.compile relies on that."""
    arguments, keywords = samples(name, dtype, device)

    def permuted(t: Any) -> Any:
        if isinstance(t, list):
            return [permuted(array) for array in t]
        return t if t is None else t.transpose(0, -1).contiguous().transpose(0, -1)

    *arrays, plan = arguments
    report = torch.library.opcheck(getattr(ops, name).default, (*map(permuted, arrays), plan), keywords)
    assert set(report.values()) == {"SUCCESS"}


@pytest.mark.parametrize("outer", ["lbfgs", "momentum"])
@pytest.mark.parametrize("name", ["step", "step_", "rollout", "step_vjp", "rollout_vjp"])
def test_opcheck_of_the_multilevel_solver(name: str, outer: str, dtype: torch.dtype) -> None:
    arguments, keywords = samples(name, dtype, torch.device("cpu"), solver=pd.Multilevel(outer))  # type: ignore[arg-type]
    report = torch.library.opcheck(getattr(ops, name).default, arguments, keywords)
    assert set(report.values()) == {"SUCCESS"}


def test_opcheck_of_the_preconditioner(dtype: torch.dtype) -> None:
    sim, state = small(dtype, solver=pd.Multilevel())
    field = noise(state.positions).requires_grad_()
    assert set(torch.library.opcheck(ops.precondition.default, (field, plan_of(sim))).values()) == {"SUCCESS"}
    if dtype == torch.float64:
        plan = plan_of(sim)
        assert torch.autograd.gradcheck(lambda f: ops.precondition(f, plan), field[:1], fast_mode=True)
    assert ops.precondition(field[:0], plan_of(sim)).shape == (0, sim.vertices, 3)


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
    solids = problem.groups[0]
    energies, stress = solids.law.evaluate(solids.deformation(0.0 * x))
    gradient, slopes = solids.nodal(stress), (solids.change(d) * stress).sum(axis=(1, 2))
    weight = np.repeat(problem.weight, 3)
    product = (problem.hessian(0.0 * x) @ d.reshape(-1) - weight * d.reshape(-1)).reshape(-1, 3)

    w, plan = sim.stiffness, plan_of(sim)
    found = {
        "energy": (ops.element_energy(seen, material_with(sim, w), plan), energies),
        "gradient": (ops.gradient(seen, material_with(sim, w), plan), gradient),
        "slope": (ops.element_energy_product(seen, direction, material_with(sim, w), plan), slopes),
        "product": (ops.hessian_product(seen, direction, material_with(sim, w), plan), product),
    }
    # slivers have grad N up to 40 times the inverse of their longest edge, and some fifty operations follow one another
    relative = 40 * 50 * ULP[dtype]
    # second derivatives are divided by sums of singular values: below 1e-2 of the strain only where elements tumble
    loose = {"product": 1e2 if scale > 1.0 else 1.0}
    for name, (have, want) in found.items():
        error = np.abs(have[0].detach().double().cpu().numpy() - want).max()
        assert error <= loose.get(name, 1.0) * relative * np.abs(want).max(), name


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("weighted", [True, False])
def test_elastic_diagonal_is_the_sum_over_elements(weighted: bool, dtype: torch.dtype, device: torch.device) -> None:
    """sum_e l_e w_e V_e |grad N_i|^2 from the mesh alone, for a shared stiffness and for one of each environment."""
    case = small_case()
    sim = simulator(case, dtype, device)
    values = case.scene.values()
    shape = pd.reference.elements(values.rest_positions, values.tets)
    factor = shape.volumes * (shape.eigenvalue_bound if weighted else 1.0)
    many = torch.stack([sim.stiffness, 3.0 * sim.stiffness.flip(0)])
    for stiffness in (sim.stiffness, many, many[:1], many[:0]):
        found = ops.elastic_diagonal(material_with(sim, stiffness), plan_of(sim), weighted=weighted)
        assert found.dtype == dtype
        assert found.shape == (*stiffness.shape[:-1], sim.vertices)
        rows = zip(stiffness.reshape(-1, len(values.tets)), found.reshape(-1, sim.vertices), strict=True)
        for w, row in rows:
            share = (w.detach().double().cpu().numpy() * factor)[:, None] * (shape.shape_gradients**2).sum(axis=2)
            want = np.zeros(sim.vertices)
            np.add.at(want, values.tets, share)
            # positive terms: rounding of some twenty operations each and of a sum of up to 24; the inverse of a rest
            # matrix, of condition up to 1e3 on slivers, is found in float64 for both precisions
            np.testing.assert_allclose(
                row.double().cpu().numpy(), want, rtol=50 * ULP[dtype] + 1e3 * ULP[torch.float64]
            )


def test_elastic_diagonal_refuses_a_gradient() -> None:
    sim, _ = small(torch.float32)
    stiffness = sim.stiffness.detach().requires_grad_()
    diagonal = ops.elastic_diagonal(material_with(sim, stiffness), plan_of(sim), weighted=True)
    with pytest.raises(RuntimeError, match=r"no derivative; detach stiffness"):
        diagonal.sum().backward()
    stiffness, masses, *rest = sim.material()
    masses = masses.detach().requires_grad_()
    diagonal = ops.elastic_diagonal([stiffness.detach(), masses, *rest], plan_of(sim), weighted=True)
    (slope,) = torch.autograd.grad((masses + diagonal).sum(), masses)
    assert torch.equal(slope, torch.ones_like(masses))


def test_step_allocates_what_it_fills(poisoned: None, dtype: torch.dtype, device: torch.device) -> None:
    for batch in (1, 3, 8, 17):
        sim, state = small(dtype, device, batch)
        after, info = sim(state, return_info=True)
        track = sim.rollout(state, 5, 2, return_info=True)
        for out, report in ((after, info), (track[:2], track.info)):
            assert bool((report.contact_gap == torch.inf).all())  # without Contact
            flat = torch.utils._pytree.tree_leaves((out, report._replace(contact_gap=report.held_back)))
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


@pytest.mark.parametrize("batch", [1, 3, 9])
def test_strides_do_not_matter(batch: int, dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device, batch)
    forces = noise(state.positions)

    def strided(t: Tensor) -> list[Tensor]:
        wide = torch.full((*t.shape[:-1], 7), float("nan"), dtype=t.dtype, device=t.device)
        wide[..., 1:7:2] = t
        return [
            wide[..., 1:7:2],
            t.permute(2, 0, 1).contiguous().permute(1, 2, 0),
            t.repeat_interleave(2, dim=1)[:, ::2],
        ]

    plain, energy, gradient = sim(state, forces), sim.energy(state), sim.gradient(state.positions)
    track = sim.rollout(state, 3, forces=forces)
    for x, v, f in zip(strided(state.positions), strided(state.velocities), strided(forces), strict=True):
        assert not x.is_contiguous()
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
    assert ops.hessian_product(*empty, sim.material(), plan_of(sim)).shape == empty.positions.shape
    assert pd.nearest_rotation(torch.empty(0, 3, 3, dtype=dtype, device=device)).shape == (0, 3, 3)
    sim.step_(empty)


def test_no_steps_and_no_iterations(dtype: torch.dtype, device: torch.device) -> None:
    sim, state = small(dtype, device)
    assert sim.rollout(state, 0).positions.shape == (0, BATCH, sim.vertices, 3)
    assert sim.rollout(state, 2, every=3).positions.shape == (0, BATCH, sim.vertices, 3)
    sim.iterations = 0
    _, info = sim(state, return_info=True)
    assert info.iterations.tolist() == [0] * BATCH
    # where it was, nothing balances
    assert bool(((info.residual > 0.1) & (info.residual <= 1.0)).all())
    after = sim(state, start=state.positions)
    free = torch.ones(sim.vertices, dtype=torch.bool)
    free[[0, 3]] = False
    gaps = state.positions[..., 1] + 0.01
    away = (state.positions - tensor_of(np.array([0.4, 0.1, 0.1]), sim)).norm(dim=-1) - 0.1
    untouched = free.to(device) & (gaps > 0) & (away > 0)
    # what no pin or contact moves keeps its shape, and its distances from the pins: the body turns about these
    targets = sim.rest_positions[[0, 3]].expand(BATCH, 2, 3)
    for mask, before, moved, pins in zip(untouched, state.positions, after.positions, targets, strict=True):
        assert int(mask.sum()) >= 30
        lengths = [
            torch.cdist(part, part, compute_mode="donot_use_mm_for_euclid_dist")
            for part in (torch.cat([x[mask], pins]).double() for x in (before, moved))
        ]
        assert float((lengths[0] - lengths[1]).abs().max()) <= 4 * ULP[dtype]
