"""Scenes with stencils in the kernels block and stream: iterates, gradients, bits, graphs and memory."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from devices import require_gpu
from mixed_scenes import CASES, mixed_case, sheet_case
from on_gpu import DTYPES, GPU, an_ulp_away, gradients_after_two_steps, host_waits, moved, on_gpu, relative, rounds_as
from runs import noise, same_bits, simulator, state_of
from torch import Tensor

import torchpd as pd
from torchpd.common.tables import EFFECT_ROWS, KINDS, MATERIAL_TABLE, ROW_SIZES
from torchpd.estimate.solver_choice import runs
from torchpd.ops import INFO_WIDTH
from torchpd.plan import kernel_choice as regimes
from torchpd.plan.placement import step_bytes

require_gpu()

KERNELS = ("block", "stream")
EFFECTS = {row.name: row for row in EFFECT_ROWS}
pytestmark = [
    pytest.mark.usefixtures("poisoned"),
    # they start a little inside a ground and a ball, so that contacts act
    pytest.mark.filterwarnings("ignore::torchpd.SceneWarning"),
    pytest.mark.parametrize("precision", DTYPES),
]


@pytest.fixture(autouse=True)
def several_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream cuts these small scenes into patches too."""
    for dtype in DTYPES.values():
        monkeypatch.setitem(regimes._STREAM_TETS, dtype, 60)


def pair(name: str, kernel: str, precision: str, **options: Any) -> tuple[pd.Simulator, pd.Simulator, pd.Simulator]:
    """A scene on the GPU, on the CPU in the same precision, and there in float64."""
    case, dtype = CASES[name](), DTYPES[precision]
    sim = on_gpu(case, dtype, kernel, **options)
    # the rod has too few vertices for two patches
    assert (sim.plan.patches > 1) == (kernel == "stream" and name != "rod")
    return sim, simulator(case, dtype, **options), simulator(case, torch.float64, **options)


def different(sim: pd.Simulator, name: str, batch: int) -> tuple[pd.State, Tensor]:
    """Environments no two of which are alike, on the CPU in the precision of `sim`, and forces."""
    state = moved(state_of(CASES[name](), sim, batch), "cpu")
    x, v = state
    return pd.State(x + 0.002 * noise(x, 1), v + 0.1 * noise(v, 2)), 0.02 * noise(x, 3)


def own_rows(sim: pd.Simulator, batch: int) -> dict[str, Tensor]:
    """The effects of a scene, other ones in every environment."""
    shades = torch.linspace(0.8, 1.25, batch, dtype=torch.float64)
    found = {}
    for name in (name for name in sim.material_names if name in EFFECTS):
        row = getattr(sim, name).detach().double().cpu()
        found[name] = row.repeat(batch, *[1] * row.dim())
        # of limits the stiffness, which is the last number
        scaled = found[name][..., -1:] if EFFECTS[name].width > 1 else found[name]
        scaled *= shades.reshape(-1, *[1] * row.dim())
    return {name: row.to(sim.dtype) for name, row in found.items()}


@pytest.mark.parametrize("iterations", [1, 2, 9, 40])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_steps_are_those_of_the_cpu(name: str, kernel: str, iterations: int, precision: str) -> None:
    sims = pair(name, kernel, precision, iterations=iterations)
    for batch in (1, 7):
        state, forces = different(sims[1], name, batch)
        (one, info), (two, _), (wide, said) = (
            sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype), return_info=True) for sim in sims
        )
        assert rounds_as(one.velocities, two.velocities, wide.velocities)
        assert rounds_as(one.positions, two.positions, wide.positions)
        near = 1e-10 if precision == "float64" else 1e-3
        assert relative(info.energy, said.energy) <= near
        assert torch.equal(info.iterations.cpu(), said.iterations)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_environments_have_rows_of_their_own(name: str, kernel: str, precision: str) -> None:
    sims = pair(name, kernel, precision, iterations=12)
    state, forces = different(sims[1], name, 7)
    rows = own_rows(sims[1], 7)
    for sim in sims:
        sim.set_material(**{key: row.to(sim.device, sim.dtype) for key, row in rows.items()})
    one, two, wide = (sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype)) for sim in sims)
    assert rounds_as(one.velocities, two.velocities, wide.velocities)
    assert not same_bits(
        one, on_gpu(CASES[name](), sims[0].dtype, kernel, iterations=12)(moved(state, GPU), forces.to(GPU))
    )


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
@pytest.mark.parametrize("own", [False, True], ids=["shared", "own rows"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["sheet", "mixed", "mixed, poisson", "mixed, all"])
def test_runs_and_batches_do_not_matter(name: str, kernel: str, own: bool, tolerance: float, precision: str) -> None:
    batch = 700
    case, dtype = CASES[name](), DTYPES[precision]
    sim = on_gpu(case, dtype, kernel, iterations=14, tolerance=tolerance)
    state, forces = different(sim, name, batch)
    state, forces = moved(state, GPU), forces.to(GPU)
    rows = {key: row.to(GPU) for key, row in own_rows(sim, batch).items()} if own else {}

    def run(items: slice) -> list[Tensor]:
        other = on_gpu(case, dtype, kernel, iterations=14, tolerance=tolerance)
        if own:
            other.set_material(**{key: row[items] for key, row in rows.items()})
        after, info = other(pd.State(*(t[items] for t in state)), forces[items], return_info=True)
        return [*after, *info]

    together = run(slice(None))
    for one, other in zip(run(slice(None)), together, strict=True):
        assert torch.equal(one, other)
    for item in (0, 1, 133, batch - 1):
        for one, other in zip(run(slice(item, item + 1)), together, strict=True):
            assert torch.equal(one, other[item : item + 1])


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["mixed", "mixed, all"])
def test_a_rollout_is_its_steps(name: str, kernel: str, precision: str) -> None:
    sim = on_gpu(CASES[name](), DTYPES[precision], kernel, iterations=10)
    state, forces = different(sim, name, 5)
    state, forces = moved(state, GPU), forces.to(GPU)
    track = sim.rollout(state, 3, forces=forces)
    for step in range(3):
        state = sim(state, forces)
        assert torch.equal(track.positions[step], state.positions)
        assert torch.equal(track.velocities[step], state.velocities)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["mixed", "mixed, all"])
def test_a_replay_is_a_step_in_place(name: str, kernel: str, precision: str) -> None:
    sim = on_gpu(CASES[name](), DTYPES[precision], kernel, iterations=10)
    start, forces = different(sim, name, 3)
    own, eager = (moved(start, GPU) for _ in range(2))
    eager = pd.State(*(t.clone() for t in eager))
    forces = forces.to(GPU)
    step = sim.capture(own, forces)
    for number in range(1, 4):
        forces.copy_(0.1 * noise(forces, number))
        sim.bending.mul_(1.1)  # read anew too
        step.replay()
        sim.step_(eager, forces)
        assert same_bits(own, eager)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["mixed", "mixed, all"])
def test_the_host_never_waits(name: str, kernel: str, precision: str) -> None:
    sim = on_gpu(CASES[name](), DTYPES[precision], kernel, iterations=10)
    state, _ = different(sim, name, 3)
    state = moved(state, GPU)
    sim(state)
    assert not host_waits(lambda: sim(state))


def ops_of(sim: pd.Simulator, state: pd.State, along: Tensor) -> dict[str, list[Tensor]]:
    """All fields of the elastic energy."""
    ops, material, plan = torch.ops.torchpd, [t.detach() for t in sim.material()], list(sim.plan.arrays)
    x, d = state.positions, along
    start, h = x - 0.2 * d, sim.time_step
    moduli = [ops.lame_product(x, way, material, plan) for way in (d, None) if "poisson" in sim.material_names]
    return {
        "moduli": moduli,
        "gradient": [ops.gradient(x, material, plan)],
        "hessian": [ops.hessian_product(x, d, material, plan)],
        "diagonal": [ops.elastic_diagonal(material, plan, weighted=False)],
        "weighted": [ops.elastic_diagonal(material, plan, weighted=True)],
        "tets": [ops.element_energy(x, material, plan), ops.element_energy_product(x, d, material, plan)],
        "energy": [ops.effect_energy(x, material, plan)],
        "products": list(ops.effect_products(x, d, material, plan)),
        "derivatives": list(ops.effect_products(x, None, material, plan)),
        "at rest": [ops.stiffness_at_rest(material, plan), ops.stiffness_at_rest(material, plan, time_step=h)],
        "damped diagonal": [ops.elastic_diagonal(material, plan, weighted=True, time_step=h)],
        "damping": [ops.damping_gradient(x, start, material, plan, time_step=h)],
        "derivatives of damping": list(ops.damping_vjp(x, start, d, material, plan, time_step=h)),
    }


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own rows"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
def test_fields_are_those_of_the_cpu(name: str, kernel: str, own: bool, precision: str) -> None:
    sims = pair(name, kernel, precision)
    state, along = different(sims[1], name, 7)
    rows = own_rows(sims[1], 7) if own else {}
    found = []
    for sim in sims:
        if own:
            sim.set_material(**{key: row.to(sim.device, sim.dtype) for key, row in rows.items()})
        found.append(ops_of(sim, moved(state, sim.device, sim.dtype), along.to(sim.device, sim.dtype)))
    for field, wide in found[2].items():
        for number, expected in enumerate(wide):
            if expected.numel():
                one, two = (of[field][number] for of in found[:2])
                assert one.shape == expected.shape, field
                assert rounds_as(one, two, expected)


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own rows"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore:torchpd. the adjoint")
def test_gradients_of_every_row_are_those_of_the_cpu(name: str, kernel: str, own: bool, precision: str) -> None:
    sims = pair(name, kernel, precision, iterations=1500)
    state, forces = different(sims[1], name, 3)
    rows = own_rows(sims[1], 3) if own else {}
    weight = noise(state.positions, 5)
    one, wide = (gradients_after_two_steps(sim, state, forces, rows, weight) for sim in (sims[0], sims[2]))
    rounded = [state, *(an_ulp_away(state, seed) for seed in range(3))]
    ways = [gradients_after_two_steps(sims[1], start, forces, rows, weight) for start in rounded]
    assert one.keys() == wide.keys()
    for key, expected in wide.items():
        if not expected.abs().max() > 0.0:
            assert not one[key].abs().max() > 0.0, key
            continue
        # both solve to the adjoint's tolerance
        rounding = max(relative(two[key], expected) for two in ways)
        least = 1e-7 if precision == "float64" else 4.0 * rounding + 1e-3
        assert relative(one[key], expected) <= least, key


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["sheet", "springs, poisson", "damped"])
def test_gradients_do_not_feel_their_batch(name: str, kernel: str, precision: str) -> None:
    sim = on_gpu(CASES[name](), DTYPES[precision], kernel, iterations=200)
    state, forces = different(sim, name, 40)
    rows, weight = own_rows(sim, 40), noise(state.positions, 5)
    together = gradients_after_two_steps(sim, state, forces, rows, weight)

    def some(items: slice) -> dict[str, Tensor]:
        start = pd.State(*(t[items] for t in state))
        return gradients_after_two_steps(
            sim, start, forces[items], {k: r[items] for k, r in rows.items()}, weight[items]
        )

    for items in (slice(0, 1), slice(17, 20), slice(0, 40)):
        alone = some(items)
        for key in ("positions", "velocities", "forces", *rows):
            assert torch.equal(alone[key], together[key][items]), key


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["mixed", "mixed, poisson", "limited sheet", "mixed, all"])
def test_a_step_takes_what_it_is_said_to(name: str, kernel: str, precision: str) -> None:
    sim = on_gpu(CASES[name](), DTYPES[precision], kernel, iterations=2)

    def taken(batch: int) -> int:
        state = sim.rest_state(batch)
        sim.step_(state)
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats(GPU)
        before = torch.cuda.memory_stats(GPU)["requested_bytes.all.current"]
        sim.step_(state)
        torch.cuda.synchronize()
        peak: int = torch.cuda.memory_stats(GPU)["requested_bytes.all.peak"]
        return peak - before - 8 * INFO_WIDTH * batch

    for batch in (1, 7, 3000):
        assert step_bytes(sim.compiled, sim.plan, batch, GPU) == taken(batch)
    sim.set_material(**{name: row.to(GPU) for name, row in own_rows(sim, 7).items()})
    assert step_bytes(sim.compiled, sim.plan, 7, GPU) == taken(7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_flat_hinges_and_ties_are_rows(kernel: str, precision: str) -> None:
    taken = {}
    for name in ("flat sheet", "free sheet", "mixed", "ties", "sheet", "rod"):
        plan = on_gpu(CASES[name](), DTYPES[precision], kernel).plan
        taken[name] = [
            bool(plan.row_sizes[ROW_SIZES["kinds"]] >> list(KINDS).index(kind) & 1) for kind in ("hinge", "tie")
        ]
        # corners of rows need no entries; a row has one of its own
        assert plan.step_entries <= plan.size("most_entries")
    assert taken == {
        "flat sheet": [True, False], "free sheet": [True, False], "mixed": [True, True], "ties": [False, True],
        "sheet": [False, False], "rod": [False, False],
    }  # fmt: skip


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_guard_sees_the_energy_of_rows(kernel: str, precision: str) -> None:
    """The schedule restarts when the energy rises: as often as on the CPU, where hinges are elements.

    Hinges are a hundred times as stiff as the membrane, over the square of an edge. With differences of positions in
    float32 the rounding of their energy is hundreds of times the slack of the guard.
    """
    case, dtype = CASES["flat sheet"](), DTYPES[precision]
    restarts = []
    for sim in (on_gpu(case, dtype, kernel, iterations=200), simulator(case, torch.float64, iterations=200)):
        sim.set_material(bending=100.0)
        state, forces = different(simulator(case, dtype), "flat sheet", 5)
        _, info = sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype), return_info=True)
        restarts.append(info.restarts.cpu())
    assert restarts[1].all()
    assert torch.equal(*restarts)


def test_a_plan_with_rows_refuses_a_curvature(precision: str) -> None:
    sim = on_gpu(CASES["flat sheet"](), DTYPES[precision], "block")
    assert "rest_curvature" not in sim.material_names
    material, names = [t.detach() for t in sim.material()], [row.name for row in MATERIAL_TABLE]
    material[names.index("rest_curvature")] = torch.zeros_like(sim.bending)
    state, plan = sim.rest_state(1), list(sim.plan.arrays)
    settings = sim.step_settings(inertial=False, report=False)
    with pytest.raises(ValueError, match=r"material\.rest_curvature must be empty for the plan of a scene without it"):
        torch.ops.torchpd.step(*state, None, None, material, plan, **settings)


def test_what_has_no_stencils_is_refused_by_name(precision: str) -> None:
    case, dtype = sheet_case(), DTYPES[precision]
    for kernel in ("cluster", "grid"):
        with pytest.raises(ValueError, match=rf"kernel must be .*cloth.* got '{kernel}'; leave it"):
            simulator(case, dtype, GPU, kernel=kernel)
    with pytest.raises(ValueError, match=r"solver must be Chebyshev\(\) or Jacobi\(\) .*cloth.* got Multilevel"):
        simulator(case, dtype, GPU, solver=pd.Multilevel())
    assert not runs(pd.Multilevel(), simulator(case, dtype, GPU).compiled)
    with pytest.raises(ValueError, match=r'adjoint="multilevel" needs a scene of solids alone'):
        simulator(case, dtype, GPU, adjoint="multilevel", kernel="stream")


def test_a_simulator_moves_there_and_back(precision: str) -> None:
    case, dtype = mixed_case(), DTYPES[precision]
    sim = simulator(case, dtype)
    state = state_of(case, sim, 2)
    before = sim(state)
    sim.to("cuda")
    assert sim.plan.kernel == "block"
    sim(moved(state, GPU))
    sim.to("cpu")
    assert same_bits(sim(state), before)
