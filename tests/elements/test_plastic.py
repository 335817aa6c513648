"""Plastic solids: exact flows, the known bar, states with history, and derivatives through their steps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from element_cases import random_flow, random_rotations
from runs import ULP
from stencil_scenes import PLASTIC_ALPHA, PLASTIC_FORCES
from torch import Tensor

import torchpd as pd
from torchpd.reference.plastic import Flow, PlasticLaw, flow, uniaxial_yield

ops = torch.ops.torchpd
H = 1.0 / 30.0
UNIT = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
# cells of the box of case 15, and its ends
BAR = pd.shapes.box(size=(1.0, 0.2, 0.2), cells=(10, 2, 2))


def tets(count: int) -> pd.TetMesh:
    """Unit tetrahedra apart from each other, whose F is read off their positions."""
    corners = UNIT[None] + 3.0 * np.arange(count)[:, None, None]
    return pd.TetMesh(corners.reshape(-1, 3), np.arange(4 * count).reshape(-1, 4))


def placed(deformations: np.ndarray, dtype: torch.dtype) -> Tensor:
    """Positions [1, 4 N, 3] of `tets` with these deformation gradients [N, 3, 3]."""
    corners = UNIT @ np.swapaxes(deformations, 1, 2)
    return torch.tensor(corners.reshape(1, -1, 3), dtype=dtype)


def bar(dtype: torch.dtype = torch.float64, *, iterations: int = 3000, **options: Any) -> tuple[pd.Simulator, pd.Pin]:
    """The bar of case 15, held at both ends."""
    poisson = options.pop("poisson", 0.3)
    plastic = pd.Plastic(float(0.05 / uniaxial_yield(np.array(1.0), np.array(poisson))), **options)
    solid = pd.Solid(BAR, youngs=1e6, density=1.0, poisson=poisson, plastic=plastic)
    x = BAR.vertices[:, 0]
    pin = pd.Pin(solid, (x < 1e-9) | (x > 1.0 - 1e-9))
    return pd.Simulator(pd.Scene(solid, pin), H, iterations, dtype=dtype), pin


def pulled(sim: pd.Simulator, end: float) -> Tensor:
    """Targets of the pins with the right end at x = `end`."""
    targets = sim.pin_targets.detach().clone()
    targets[targets[:, 0] > 0.5, 0] += end - 1.0
    return targets


def stretched(sim: pd.Simulator, ends: list[float], batch: int = 1) -> pd.HistoryState:
    state = sim.rest_state(batch)
    for end in ends:
        state = sim(state, targets=pulled(sim, end))
        state = state._replace(velocities=torch.zeros_like(state.velocities))
    return state


# ---- flow


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("hardening", "gamma", "stretches"),
    [
        (0.0, 0.0988649278, (1.0840704324, 0.9604422363, 0.9604422363)),
        (0.5, 0.0659099518, (1.0552896197, 0.9734511598, 0.9734511598)),
    ],
)
def test_flow_of_a_uniaxial_stretch(
    hardening: float, gamma: float, stretches: tuple[float, ...], dtype: torch.dtype
) -> None:
    """The known flow at |d| = .05; in float32 to 20 roundings of numbers near 1."""
    plastic = pd.Plastic(float(0.05 / uniaxial_yield(np.array(1.0), np.array(0.3))), hardening)
    sim = pd.Simulator(pd.Scene(pd.Solid(tets(1), 1.0, poisson=0.3, plastic=plastic)), dtype=dtype)
    x = placed(np.diag([1.2, 1.0, 1.0])[None], dtype)
    (found,) = ops.next_history(x, sim.material(), list(sim.plan.arrays), time_step=H)
    wanted = [*np.diag(stretches).reshape(-1), gamma]
    tolerance = 1e-10 if dtype == torch.float64 else 20 * ULP[dtype]
    np.testing.assert_allclose(found[0, 0].double().numpy(), wanted, atol=tolerance)


def random_plastic(count: int) -> tuple[pd.Simulator, np.ndarray, dict[str, np.ndarray]]:
    rng = np.random.default_rng(3)
    rows, ratio = random_flow(rng, count), rng.uniform(0.0, 0.45, count)
    stretches = np.exp(rng.uniform(-0.6, 0.6, (count, 3)))
    stretches[: count // 8, 2] *= -1.0
    rows["creep_time"][::3] = 0.0
    rows["max_flow"][::2] = np.inf
    F = random_rotations(rng, count) @ (stretches[:, :, None] * random_rotations(rng, count))
    named = {name: row for name, row in rows.items() if name != "flow"}
    solid = pd.Solid(tets(count), 1.0, poisson=np.maximum(ratio, 1e-3), plastic=pd.Plastic(0.05))
    sim = pd.Simulator(pd.Scene(solid), H, dtype=torch.float64)
    sim.set_material(flow=torch.tensor(rows["flow"]), **{name: torch.tensor(row) for name, row in named.items()})
    return sim, F, rows


def test_flow_is_that_of_the_reference() -> None:
    """Random states, Fp, creep and bounds; nothing flows where det F <= 0."""
    count = 200
    sim, F, rows = random_plastic(count)
    found = ops.next_history(placed(F, torch.float64), sim.material(), list(sim.plan.arrays), time_step=H)[0][0]
    strain = uniaxial_yield(rows["yield_strain"], sim.plastic_poisson.numpy())
    flows = 0
    for n in range(count):
        one = slice(n, n + 1)
        law = PlasticLaw(strain[one], rows["hardening"][one], rows["creep_time"][n], rows["max_flow"][n])
        state = Flow(rows["flow"][one, :9].reshape(1, 3, 3), rows["flow"][one, 9])
        after = flow(law, F[one] @ np.linalg.inv(state.plastic), state, H)
        np.testing.assert_allclose(found[n, :9].reshape(3, 3), after.plastic[0], atol=1e-12)
        assert found[n, 9].item() == pytest.approx(after.hardening[0], abs=1e-13)
        flows += bool(after.hardening[0] > state.hardening[0])
    assert count // 2 < flows <= count - count // 8


def test_derivatives_of_flow() -> None:
    """By positions, history and rows, also with creep and a bound that holds, and two equal stretches."""
    sim, F, _ = random_plastic(12)
    F[3] = np.diag([1.3, 1.0, 1.0])
    names = ("plastic_poisson", "yield_strain", "hardening", "creep_time", "flow")
    with torch.no_grad():
        sim.max_flow[:6] = 0.3
        sim.flow[3] = torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0])
        sim.creep_time.clamp_(min=0.02)
    material, plan = sim.material(), list(sim.plan.arrays)
    rows = [row.name for row in pd.common.tables.MATERIAL_TABLE]

    def kept(x: Tensor, most: Tensor, *arrays: Tensor) -> Tensor:
        own = dict(zip(names, arrays, strict=True)) | {"max_flow": torch.cat([most, sim.max_flow[6:].detach()])}
        given = [own.get(name, array) for name, array in zip(rows, material, strict=True)]
        found: Tensor = ops.next_history(x, given, plan, time_step=H)[0]
        return found

    inputs = [placed(F, torch.float64), sim.max_flow[:6], *(getattr(sim, name) for name in names)]
    leaves = [array.detach().clone().requires_grad_() for array in inputs]
    assert torch.autograd.gradcheck(kept, leaves, eps=1e-6, atol=1e-6, rtol=1e-6)


# ---- steps


def test_bar_beyond_its_yield() -> None:
    """Case 15: the force of the right face as its end moves to 1.3 and back."""
    sim, pin = bar()
    right = torch.from_numpy(BAR.vertices[:, 0] > 1.0 - 1e-9)
    ends = [1.0 + 0.0375 * n for n in (*range(1, 9), *range(7, -1, -1))]
    state, forces = sim.rest_state(1), {}
    for number, end in enumerate(ends, start=1):
        before, state = state, sim(state, targets=pulled(sim, end))
        elastic = sim.gradient(pd.HistoryState(state.positions, state.velocities, before.history))
        forces[number] = float(elastic[0, right, 0].sum())
        state = state._replace(velocities=torch.zeros_like(state.velocities))
    assert {step: forces[step] for step in PLASTIC_FORCES} == pytest.approx(PLASTIC_FORCES, rel=1e-6)
    (alpha,) = sim.plastic_strain(state).values()
    assert float(alpha.mean()) == pytest.approx(PLASTIC_ALPHA, abs=1e-6)
    determinant = torch.linalg.det(state.history.flow[..., :9].unflatten(-1, (3, 3)))
    torch.testing.assert_close(determinant, torch.ones_like(determinant), rtol=0.0, atol=1e-13)
    assert pin in sim.reactions(before, state).pins


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bits_do_not_depend_on_the_batch(dtype: torch.dtype) -> None:
    sim, _ = bar(dtype, iterations=60)
    single = stretched(sim, [1.1, 1.15])
    for batch in (7, 9):
        many = stretched(sim, [1.1, 1.15], batch)
        for mine, theirs in zip((*single[:2], *single[2]), (*many[:2], *many[2]), strict=True):
            assert all(torch.equal(mine[0], one) for one in theirs)


@pytest.mark.filterwarnings("ignore:Simulator. .* are inverted or flat")
@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Jacobi(), pd.Multilevel()])
@pytest.mark.parametrize("start", ["random", "collapsed", "mirrored", "stretched"])
def test_hard_starts_come_down(start: str, solver: Any) -> None:
    """The objective of a step after flow falls from iterates far away."""
    sim, _ = bar(iterations=60)
    sim.solver = solver
    before = stretched(sim, [1.1, 1.2])
    generator = torch.Generator().manual_seed(0)
    x = before.positions
    first = {
        "random": torch.rand(x.shape, generator=generator, dtype=x.dtype),
        "collapsed": 0.01 * x,
        "mirrored": x * torch.tensor([-1.0, 1.0, 1.0], dtype=x.dtype),
        "stretched": 5.0 * x,
    }[start]
    energies = []
    for iterations in (5, 20, 80, 320):
        sim.iterations = iterations
        _, info = sim(before, start=first, targets=pulled(sim, 1.2), return_info=True)
        energies.append(float(info.energy))
    # sums of a thousand terms of one sign, rounded
    assert (np.diff(energies) <= 1e3 * ULP[torch.float64] * energies[0]).all()
    assert np.isfinite(energies).all()


def gradients_of(sim: pd.Simulator, run: Callable[[pd.HistoryState], pd.HistoryState], names: tuple[str, ...]) -> None:
    """Compare gradients by state, history and rows with differences of a loss."""
    generator = torch.Generator().manual_seed(2)
    begun = stretched(sim, [1.1])
    weights = [torch.randn(part.shape, generator=generator, dtype=part.dtype) for part in (*begun[:2], begun[2].flow)]
    weights[1] *= H

    def loss(state: pd.HistoryState) -> Tensor:
        after = run(state)
        parts = zip(weights, (*after[:2], after[2].flow), strict=True)
        return torch.stack([(weight * part).sum() for weight, part in parts]).sum()

    leaves = [part.detach().clone().requires_grad_() for part in (*begun[:2], begun[2].flow)]
    for name in names:
        getattr(sim, name).requires_grad_()
    rows = [getattr(sim, name) for name in names]
    value = loss(pd.HistoryState(leaves[0], leaves[1], pd.History(leaves[2])))
    found = torch.autograd.grad(value, [*leaves, *rows])
    step = 1e-6
    for leaf, gradient in zip([*leaves, *rows], found, strict=True):
        direction = torch.randn(leaf.shape, generator=generator, dtype=leaf.dtype)
        if leaf.dim() < 3:
            direction = direction.abs() * leaf.detach()
        ends = []
        with torch.no_grad():
            own = leaf.detach().clone()
            for sign in (1.0, -1.0):
                leaf.copy_(own + sign * step * direction)
                ends.append(loss(pd.HistoryState(leaves[0], leaves[1], pd.History(leaves[2]))))
            leaf.copy_(own)
        difference = (ends[0] - ends[1]) / (2.0 * step)
        assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=1e-5, abs=1e-6)


ROWS = ("plastic_youngs", "plastic_poisson", "yield_strain", "hardening", "creep_time")


def small() -> pd.Simulator:
    sim, _ = bar(iterations=2500, hardening=0.2, creep_time=0.05)
    sim.solver = pd.Multilevel()
    sim.iterations = 300
    return sim


def test_gradients_of_a_step() -> None:
    sim = small()
    gradients_of(sim, lambda state: sim(state, targets=pulled(sim, 1.15)), ROWS)


def test_gradients_of_a_rollout() -> None:
    """History is carried backwards, too."""
    sim = small()

    def targets(number: int) -> Tensor:
        return pulled(sim, 1.15 + 0.05 * number)

    gradients_of(sim, lambda state: sim.rollout(state, 2, targets=targets).state(), ROWS)


# ---- states


def test_history_states_are_states() -> None:
    sim, _ = bar(iterations=20)
    state, rest = stretched(sim, [1.2], 3), sim.rest_state(1)
    assert isinstance(state, pd.HistoryState)
    kept = state.where(torch.tensor([True, False, True]), rest)
    assert torch.equal(kept.history.flow[1], rest.history.flow[0])
    assert torch.equal(kept.history.flow[0], state.history.flow[0])
    assert state.to(torch.float32).history.flow.dtype == torch.float32
    copied = state.clone()
    sim.step_(copied, targets=pulled(sim, 1.25))
    after = sim(state, targets=pulled(sim, 1.25))
    for mine, theirs in zip((*copied[:2], copied[2].flow), (*after[:2], after[2].flow), strict=True):
        assert torch.equal(mine, theirs)
    track = sim.rollout(state, 4, 2, targets=pulled(sim, 1.25))
    assert isinstance(track, pd.HistoryTrack)
    assert len(track.positions) == 2
    twice = sim(after, targets=pulled(sim, 1.25))
    assert torch.equal(track.state(0).history.flow, twice.history.flow)
    assert "batch=3" in repr(state)
    assert sim.rollout(state, 1, 2).history.flow.shape == (0, *state.history.flow.shape)


def test_plain_tuples_are_states_everywhere(tmp_path: Path) -> None:
    sim, _ = bar(iterations=20)
    state, rest = stretched(sim, [1.2], 2), sim.rest_state(1)
    plain = (*state[:2], tuple(state.history))
    for given in (plain, [*state[:2], list(state.history)], pd.HistoryState(*plain)):
        after = sim(given)
        assert torch.equal(after.history.flow, sim(state).history.flow)
        assert all(map(torch.equal, sim.plastic_strain(given).values(), sim.plastic_strain(state).values()))
        assert torch.equal(sim.stress(given).cauchy, sim.stress(state).cauchy)
        assert torch.equal(sim.energy(given), sim.energy(state))
        sim.write_vtu(tmp_path / "plain.vtu", given, environment=1)
        sim.write_vtu(tmp_path / "own.vtu", state, environment=1)
        assert (tmp_path / "plain.vtu").read_bytes() == (tmp_path / "own.vtu").read_bytes()
        kept = state.where(torch.tensor([False, True]), given)
        assert torch.equal(kept.history.flow, state.history.flow)
    named = pd.HistoryState(*plain)
    assert torch.equal(named.where(torch.tensor([False, True]), rest).history.flow[0], rest.history.flow[0])


def test_determinant_of_fp_does_not_drift() -> None:
    """3000 flows of float32: each step's error is its own, a few roundings, and adds to no other."""
    count = 16
    sim = pd.Simulator(pd.Scene(pd.Solid(tets(count), 1.0, poisson=0.3, plastic=pd.Plastic(0.01))), H)
    rng = np.random.default_rng(5)
    plan = list(sim.plan.arrays)
    for _ in range(3000):
        stretches = np.exp(rng.uniform(-0.3, 0.3, (count, 3)))
        F = random_rotations(rng, count) @ (stretches[:, :, None] * random_rotations(rng, count))
        material = sim.material()
        (flow,) = ops.next_history(placed(F, torch.float32), material, plan, time_step=H)
        with torch.no_grad():
            sim.flow.copy_(flow[0])
    assert float(sim.flow[:, 9].min()) > 100.0  # they flow
    plastic = sim.flow[:, :9].double().detach().reshape(count, 3, 3)
    np.testing.assert_allclose(torch.linalg.det(plastic).numpy(), 1.0, atol=1e-5)


@pytest.mark.parametrize("endless", [np.inf, [np.inf] * 240], ids=["number", "per tetrahedron"])
def test_flow_may_have_no_bound(endless: Any) -> None:
    sim, usual = bar(iterations=20, max_flow=endless)[0], bar(iterations=20)[0]
    assert bool(sim.max_flow.isinf().all())
    assert torch.equal(stretched(sim, [1.4]).history.flow, stretched(usual, [1.4]).history.flow)


def test_states_without_history_are_refused() -> None:
    sim, _ = bar(iterations=20)
    state = sim.rest_state(2)
    with pytest.raises(TypeError, match=r"state must be a HistoryState, in a scene with plastic solids, .* got State"):
        sim(pd.State(*state[:2]))
    with pytest.raises(ValueError, match=r"history.flow must be \[2, 240, 10\], as rest_state\(\) has it, got \[1, "):
        sim(pd.HistoryState(*state[:2], pd.History(state.history.flow[:1])))
    elastic = pd.Simulator(pd.Scene(pd.Solid(BAR, 1e5)), dtype=torch.float64)
    with pytest.raises(TypeError, match="state must be a State"):
        elastic(state)
    with pytest.raises(ValueError, match="rollout must have no plastic solids"):
        ops.rollout(
            *state[:2], None, sim.material(), list(sim.plan.arrays), steps=1, every=1,
            **sim.step_settings(inertial=False, report=False),
        )  # fmt: skip


def test_files_keep_plastic_solids_and_states(tmp_path: Path) -> None:
    sim, _ = bar(iterations=20, hardening=0.1, max_flow=0.4)
    state = stretched(sim, [1.2])
    sim.save(tmp_path / "bar.safetensors")
    torch.save(state, tmp_path / "state.pt")
    again, kept = pd.Simulator.load(tmp_path / "bar.safetensors"), torch.load(tmp_path / "state.pt")
    assert isinstance(kept, pd.HistoryState)
    mine, theirs = (one(start, targets=pulled(sim, 1.25)) for one, start in ((sim, state), (again, kept)))
    assert torch.equal(mine.history.flow, theirs.history.flow)
    assert torch.equal(mine.positions, theirs.positions)
    assert sim.write_vtu(tmp_path / "bar.vtu", mine).exists()
    assert "plastic_strain" in (tmp_path / "bar.vtu").read_text(errors="ignore")


def test_vmap_and_batched_gradients() -> None:
    sim, _ = bar(iterations=30)
    state = stretched(sim, [1.2], 2)
    targets = pulled(sim, 1.25)
    mapped = torch.vmap(lambda one: sim(one, targets=targets))(
        pd.HistoryState(*(part[:, None] for part in state[:2]), pd.History(state.history.flow[:, None]))
    )
    assert torch.equal(mapped.history.flow[:, 0], sim(state, targets=targets).history.flow)
    flow = state.history.flow.clone().requires_grad_()
    after = sim(pd.HistoryState(*state[:2], pd.History(flow)), targets=targets)
    gradients = torch.randn((3, *flow.shape), generator=torch.Generator().manual_seed(0), dtype=flow.dtype)
    (batched,) = torch.autograd.grad(after.history.flow, flow, gradients, is_grads_batched=True, retain_graph=True)
    for gradient, found in zip(gradients, batched, strict=True):
        (alone,) = torch.autograd.grad(after.history.flow, flow, gradient, retain_graph=True)
        torch.testing.assert_close(found, alone)


def test_stress_is_that_of_the_elastic_part() -> None:
    """The forces of the stress of a state are the gradient of its energy, beside an elastic solid as well."""
    plastic = pd.Solid(BAR, 1e6, poisson=0.3, plastic=pd.Plastic(0.02))
    elastic = pd.Solid(BAR.translated((0.0, 1.0, 0.0)), 1e5, poisson=0.2, averaging=1)
    sim = pd.Simulator(pd.Scene(elastic, plastic), H, 5, dtype=torch.float64)
    state = sim.rest_state(1)
    generator = torch.Generator().manual_seed(1)
    moved = state.positions + 0.01 * torch.randn(state.positions.shape, generator=generator, dtype=torch.float64)
    state = sim(state._replace(positions=moved))
    assert float(sim.plastic_strain(state)[plastic].max()) > 0.0
    corners = torch.from_numpy(sim.scene.tets)
    edges = (state.positions[:, corners[:, 1:]] - state.positions[:, corners[:, :1]]).mT
    forces = torch.zeros_like(state.positions)
    # sigma grad N times the present volume
    shapes = torch.linalg.inv(edges)
    volume = torch.linalg.det(edges) / 6.0
    inner = (sim.stress(state).cauchy @ shapes.mT * volume[..., None, None]).mT
    for corner in range(3):
        forces.index_add_(1, corners[:, corner + 1], inner[:, :, corner])
    forces.index_add_(1, corners[:, 0], -inner.sum(2))
    torch.testing.assert_close(forces, sim.gradient(state), rtol=1e-9, atol=1e-9 * float(forces.abs().max()))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"plastic": 0.02}, "Solid.plastic must be a Plastic or None, got float"),
        ({"law": "volume"}, 'Solid.law must be "corotated" beside plastic'),
        ({"averaging": 4}, "Solid.averaging must be 1 or None beside plastic"),
        ({"stiffness_damping": 0.1}, "Solid.stiffness_damping must be 0 beside plastic"),
        ({"plastic": "rows"}, "Plastic.yield_strain must be"),
    ],
)
def test_what_does_not_go_together_is_refused(options: dict[str, Any], words: str) -> None:
    given = {"plastic": pd.Plastic(0.02), "poisson": 0.3} | options
    if given["plastic"] == "rows":
        given["plastic"] = pd.Plastic([0.1, 0.2])
    with pytest.raises((TypeError, ValueError), match=words):
        pd.Solid(BAR, 1e6, **given)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0,), "Plastic.yield_strain must be positive, got 0.0"),
        ((0.1, -1.0), "Plastic.hardening must be >= 0, got -1.0"),
        ((0.1, 0.0, np.nan), "Plastic.creep_time must be finite"),
        ((0.1, 0.0, 0.0, -1.0), "Plastic.max_flow must be positive, got -1.0"),
        ((0.1, 0.0, 0.0, -np.inf), "Plastic.max_flow must be positive, got -inf"),
        ((0.1, 0.0, 0.0, [np.inf, np.nan]), "Plastic.max_flow must be finite"),
        (([[0.1]],), r"Plastic.yield_strain must be a scalar or one value per tetrahedron \[E\], got \[1, 1\]"),
    ],
)
def test_numbers_are_checked(arguments: tuple[Any, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        pd.Plastic(*arguments)


def test_material_is_set_by_name() -> None:
    sim, _ = bar(iterations=20)
    sim.set_material(yield_strain=0.5)
    assert float(stretched(sim, [1.2]).history.flow[..., 9].max()) == 0.0
    with pytest.raises(ValueError, match="max_flow must be positive"):
        sim.set_material(max_flow=0.0)
    elastic = pd.Simulator(pd.Scene(pd.Solid(BAR, 1e5)))
    with pytest.raises(TypeError, match=r"no array 'yield_strain'.* no solid is plastic"):
        elastic.set_material(yield_strain=0.1)
    assert "plastic flow: 240 tetrahedra" in repr(sim)


def test_the_modulus_of_elastic_solids_is_refused_without_any() -> None:
    sim, _ = bar(iterations=20)
    for given, came in ((2e5, r"200000\.0"), (torch.ones(2, 1), r"\[2, 1\]")):
        with pytest.raises(ValueError, match=f"stiffness has no rows in this scene.* got {came}; .*plastic_youngs"):
            sim.set_material(stiffness=given)
    sim.set_material(stiffness=sim.stiffness, plastic_youngs=2e5)
    assert float(sim.plastic_youngs.min()) == 2e5
    with pytest.raises(ValueError, match=r"pin_hard has no rows in this scene.* got True"):
        pd.Simulator(pd.Scene(pd.Solid(BAR, 1e5))).set_material(pin_hard=True)


def test_ops_of_history_are_citizens_of_torch() -> None:
    sim, F, _ = random_plastic(3)
    x, plan = placed(F, torch.float64).requires_grad_(), list(sim.plan.arrays)
    trained = [array.detach().clone().requires_grad_() for array in sim.material()]
    torch.library.opcheck(ops.next_history.default, (x, trained, plan), {"time_step": H})
    detached, noise = [array.detach() for array in trained], torch.ones((1, 3, 10), dtype=torch.float64)
    torch.library.opcheck(ops.next_history_vjp.default, ([noise], x.detach(), detached, plan), {"time_step": H})
    with pytest.raises(ValueError, match=r"gradients must be \[1, 3, 10\] like the history"):
        ops.next_history_vjp([noise[:, :1]], x.detach(), detached, plan, time_step=H)
    elastic = pd.Simulator(pd.Scene(pd.Solid(tets(1), 1.0)), dtype=torch.float64)
    with pytest.raises(ValueError, match="material must have a history"):
        ops.next_history(placed(F[:1], torch.float64), elastic.material(), list(elastic.plan.arrays), time_step=H)


def test_steps_are_compiled() -> None:
    sim, _ = bar(iterations=20)
    state, targets = stretched(sim, [1.2]), pulled(sim, 1.25)
    compiled = torch.compile(lambda given: sim(given, targets=targets), backend="eager", fullgraph=True)
    for mine, theirs in zip(compiled(state)[:2], sim(state, targets=targets)[:2], strict=True):
        assert torch.equal(mine, theirs)
