"""Poisson's ratio on a GPU: steps, fields and gradients are those of the CPU, alone and in a batch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from cases import Case, box
from devices import require_gpu
from on_gpu import DTYPES, GPU, gradients_after_two_steps, moved, on_gpu, relative, rounds_as
from runs import noise, same_bits, simulator, state_of
from torch import Tensor

import torchpd as pd
from torchpd.ops import INFO_WIDTH
from torchpd.plan import kernel_choice as regimes
from torchpd.plan.placement import step_bytes
from torchpd.scene import Scene
from torchpd.scene.effects import Solid

require_gpu()

KERNELS = ("block", "grid", "stream")
AVERAGING = (1, 2, 4)
pytestmark = [
    pytest.mark.usefixtures("poisoned"),
    # one starts a little inside a ground and a ball, so that contacts act
    pytest.mark.filterwarnings("ignore::torchpd.SceneWarning"),
    pytest.mark.parametrize("precision", DTYPES),
]


@pytest.fixture(autouse=True)
def several_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream cuts these small scenes into patches too."""
    for dtype in DTYPES.values():
        monkeypatch.setitem(regimes._STREAM_TETS, dtype, 60)


def bar(averaging: int, *parts: Any, held: bool = True, cells: tuple[int, int, int] = (6, 3, 3)) -> Case:
    """A bar of unlike materials that swings, far stretched: some of its tetrahedra are beyond the cap of tension."""
    mesh, rng = pd.TetMesh(*box((0.6, 0.3, 0.3), cells)), np.random.default_rng(0)
    count = len(mesh.tets)
    youngs, poisson = rng.uniform(0.5e5, 2e5, count), rng.uniform(0.2, 0.45, count)
    body = Solid(mesh, youngs=youngs, poisson=poisson, averaging=averaging, density=1000.0)
    pins = [pd.Pin(body, mesh.vertices[:, 0] == 0.0)] if held else []
    x = mesh.vertices * [1.0, 1.3, 1.2] + rng.uniform(-0.02, 0.02, mesh.vertices.shape)
    return Case(Scene(body, *pins, *parts), x, rng.normal(size=x.shape), 1.0 / 60.0)


def held(averaging: int) -> Case:
    return bar(averaging, pd.Gravity((1.0, -9.8, 0.5)), pd.Damping(1.0))


def free(averaging: int) -> Case:
    """Falls on a ground and a ball with friction."""
    return bar(
        averaging, pd.Gravity(), pd.Ground(0.01, friction=0.4), pd.Sphere((0.3, -0.1, 0.15), 0.13, 0.3), held=False
    )


def afloat(averaging: int) -> Case:
    """Free, without contacts."""
    return bar(averaging, held=False)


SCENES: dict[str, Callable[[int], Case]] = {"held": held, "free": free, "afloat": afloat}


def sims_of(case: Case, kernel: str, precision: str, **options: Any) -> tuple[pd.Simulator, pd.Simulator, pd.Simulator]:
    """On the GPU, on the CPU in the same precision, and there in float64."""
    dtype = DTYPES[precision]
    return (
        on_gpu(case, dtype, kernel, **options),
        simulator(case, dtype, **options),
        simulator(case, torch.float64, **options),
    )


def different(case: Case, sim: pd.Simulator, batch: int) -> tuple[pd.State, Tensor]:
    """Environments no two of which are alike, on the CPU in the precision of `sim`, and forces."""
    x, v = moved(state_of(case, sim, batch), "cpu")
    return pd.State(x + 0.003 * noise(x, 1), v + 0.1 * noise(v, 2)), 0.02 * noise(x, 3)


def own_rows(sim: pd.Simulator, batch: int) -> dict[str, Tensor]:
    """Moduli of tetrahedra, other ones in every environment."""
    shades = torch.linspace(0.8, 1.08, batch, dtype=torch.float64)[:, None]
    return {
        name: (shades.roll(turn) * getattr(sim, name).detach().double().cpu()).to(sim.dtype)
        for turn, name in enumerate(("stiffness", "poisson"))
    }


def set_rows(sim: pd.Simulator, rows: dict[str, Tensor]) -> None:
    sim.set_material(**{name: row.to(sim.device, sim.dtype) for name, row in rows.items()})


def test_groups_have_all_sizes(precision: str) -> None:
    group = held(4).scene.values().tet_group
    assert set(np.bincount(np.bincount(group)).nonzero()[0]) == {1, 2, 3, 4}
    for kernel in KERNELS:
        sim = on_gpu(held(4), DTYPES[precision], kernel)
        assert (sim.plan.patches > 1) == (kernel != "block")


@pytest.mark.parametrize("iterations", [1, 2, 9, 40])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
@pytest.mark.parametrize("name", SCENES)
def test_steps_are_those_of_the_cpu(name: str, averaging: int, kernel: str, iterations: int, precision: str) -> None:
    case = SCENES[name](averaging)
    sims = sims_of(case, kernel, precision, iterations=iterations)
    for batch in (1, 5):
        state, forces = different(case, sims[1], batch)
        (one, info), (two, _), (wide, said) = (
            sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype), return_info=True) for sim in sims
        )
        assert rounds_as(one.velocities, two.velocities, wide.velocities)
        assert rounds_as(one.positions, two.positions, wide.positions)
        near = 1e-10 if precision == "float64" else 1e-3
        assert relative(info.energy, said.energy) <= near
        assert torch.equal(info.iterations.cpu(), said.iterations)


@pytest.mark.parametrize("averaging", AVERAGING)
def test_threads_take_several_pairs(averaging: int, precision: str) -> None:
    """A grid of few patches, which have more pairs than threads."""
    case = bar(averaging, pd.Gravity(), cells=(24, 6, 6))
    sims = sims_of(case, "far", precision, iterations=12)
    assert sims[0].plan.size("most_pairs") > 384
    state, forces = different(case, sims[1], 2)
    one, two, wide = (sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype)) for sim in sims)
    assert rounds_as(one.velocities, two.velocities, wide.velocities)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
def test_environments_have_moduli_of_their_own(averaging: int, kernel: str, precision: str) -> None:
    case = held(averaging)
    sims = sims_of(case, kernel, precision, iterations=12)
    state, forces = different(case, sims[1], 5)
    shared = sims[0](moved(state, GPU), forces.to(GPU))
    for names in (["stiffness"], ["poisson"], ["stiffness", "poisson"]):
        rows = {name: row for name, row in own_rows(sims[1], 5).items() if name in names}
        found = []
        for sim in sims_of(case, kernel, precision, iterations=12):
            set_rows(sim, rows)
            found.append(sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype)).velocities)
        assert rounds_as(*found)
        assert not torch.equal(found[0], shared.velocities)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
def test_a_ratio_of_zero_is_a_solid_without(averaging: int, kernel: str, precision: str) -> None:
    """The group's terms vanish; both round differently."""
    case = held(averaging)
    (plain,) = case.scene.solids
    body = Solid(plain.mesh, youngs=plain.stiffness, density=1000.0)
    others = [pd.Pin(body, plain.mesh.vertices[:, 0] == 0.0), pd.Gravity((1.0, -9.8, 0.5)), pd.Damping(1.0)]
    without = Case(Scene(body, *others), case.positions, case.velocities, case.time_step)
    sim = on_gpu(case, DTYPES[precision], kernel, iterations=12)
    sim.set_material(poisson=torch.zeros_like(sim.poisson))
    sims = sims_of(without, kernel, precision, iterations=12)
    state, forces = different(case, sims[1], 2)
    found = sim(moved(state, GPU), forces.to(GPU)).velocities
    assert rounds_as(
        found,
        sims[1](state, forces).velocities,
        sims[2](moved(state, "cpu", torch.float64), forces.double()).velocities,
    )


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
def test_a_negative_modulus_is_reported(averaging: int, kernel: str, precision: str) -> None:
    """Environments with one each, of either tetrahedron of a pair, also beside a neighbour; the last one has none."""
    case = held(averaging)
    gpu, cpu, _ = sims_of(case, kernel, precision, iterations=12, tolerance=0.9)
    moduli = cpu.stiffness.detach()
    bad = torch.arange(0, len(moduli), 3)
    rows = moduli.repeat(len(bad) + 1, 1)
    rows[torch.arange(len(bad)), bad] *= -1.0
    state, forces = different(case, cpu, len(rows))
    found = []
    for sim in (gpu, cpu):
        sim.set_material(stiffness=rows.abs().to(sim.device))
        with torch.no_grad():
            sim.stiffness.copy_(rows)
        _, info = sim(moved(state, sim.device), forces.to(sim.device), return_info=True)
        material, plan = [t.detach() for t in sim.material()], list(sim.plan.arrays)
        diagonals = [torch.ops.torchpd.elastic_diagonal(material, plan, weighted=kind) for kind in (False, True)]
        said = (info.converged, ~info.residual.isnan(), info.rho < info.rho.max())
        found.append([*(good.cpu() for good in said), *(t.cpu() == -torch.inf for t in diagonals)])
    for good in found[0][:3]:
        assert good.tolist() == [False] * len(bad) + [True]
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
@pytest.mark.parametrize("own", [False, True], ids=["shared", "own rows"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
def test_runs_and_batches_do_not_matter(
    averaging: int, kernel: str, own: bool, tolerance: float, precision: str
) -> None:
    case, batch = free(averaging), 300
    sim = on_gpu(case, DTYPES[precision], kernel, iterations=14, tolerance=tolerance)
    state, forces = different(case, sim, batch)
    state, forces = moved(state, GPU), forces.to(GPU)
    rows = {key: row.to(GPU) for key, row in own_rows(sim, batch).items()} if own else {}

    def run(items: slice) -> list[Tensor]:
        other = on_gpu(case, DTYPES[precision], kernel, iterations=14, tolerance=tolerance)
        other.set_material(**{key: row[items] for key, row in rows.items()})
        after, info = other(pd.State(*(t[items] for t in state)), forces[items], return_info=True)
        return [*after, *info]

    together = run(slice(None))
    for one, other in zip(run(slice(None)), together, strict=True):
        assert torch.equal(one, other)
    for item in (0, 133, batch - 1):
        for one, other in zip(run(slice(item, item + 1)), together, strict=True):
            assert torch.equal(one, other[item : item + 1])


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_replay_and_a_rollout_are_steps(kernel: str, precision: str) -> None:
    case = free(4)
    sim = on_gpu(case, DTYPES[precision], kernel, iterations=10)
    start, forces = different(case, sim, 3)
    state, own, forces = moved(start, GPU), pd.State(*(t.to(GPU).clone() for t in start)), forces.to(GPU)
    track = sim.rollout(state, 3, forces=forces)
    step = sim.capture(own, forces)
    for number in range(3):
        step.replay()
        state = sim(state, forces)
        assert same_bits(own, state)
        assert torch.equal(track.positions[number], state.positions)
        assert torch.equal(track.velocities[number], state.velocities)
    sim.poisson.mul_(0.5)  # read anew
    step.replay()
    assert same_bits(own, sim(state, forces))


def fields_of(sim: pd.Simulator, x: Tensor, along: Tensor) -> dict[str, Tensor]:
    """All fields of the elastic energy."""
    ops, material, plan = torch.ops.torchpd, [t.detach() for t in sim.material()], list(sim.plan.arrays)
    return {
        "gradient": ops.gradient(x, material, plan),
        "hessian": ops.hessian_product(x, along, material, plan),
        "diagonal": ops.elastic_diagonal(material, plan, weighted=False),
        "weighted": ops.elastic_diagonal(material, plan, weighted=True),
        "energies": ops.element_energy(x, material, plan),
        "energy product": ops.element_energy_product(x, along, material, plan),
        "energy": ops.effect_energy(x, material, plan),
        "moduli": ops.lame_product(x, None, material, plan),
        "moduli product": ops.lame_product(x, along, material, plan),
        "at rest": ops.stiffness_at_rest(material, plan),
    }


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own rows"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
def test_fields_are_those_of_the_cpu(averaging: int, kernel: str, own: bool, precision: str) -> None:
    case = held(averaging)
    sims = sims_of(case, kernel, precision)
    state, along = different(case, sims[1], 5)
    rows = own_rows(sims[1], 5) if own else {}
    found = []
    for sim in sims:
        set_rows(sim, rows)
        found.append(fields_of(sim, state.positions.to(sim.device, sim.dtype), along.to(sim.device, sim.dtype)))
    for field, wide in found[2].items():
        assert found[0][field].shape == wide.shape, field
        assert rounds_as(found[0][field], found[1][field], wide), field


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own rows"])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", AVERAGING)
@pytest.mark.parametrize("name", ["held", "free"])
@pytest.mark.filterwarnings("ignore:torchpd. the adjoint")
def test_gradients_of_every_row_are_those_of_the_cpu(
    name: str, averaging: int, kernel: str, own: bool, precision: str
) -> None:
    case = SCENES[name](averaging)
    sims = sims_of(case, kernel, precision, iterations=1500)
    state, forces = different(case, sims[1], 3)
    rows = own_rows(sims[1], 3) if own else {}
    weight = noise(state.positions, 5)
    one, two, wide = (gradients_after_two_steps(sim, state, forces, rows, weight) for sim in sims)
    assert {"positions", "velocities", "stiffness", "poisson"} <= one.keys() == wide.keys()
    assert wide["poisson"].abs().max() > 0.0
    for key, expected in wide.items():
        if not expected.abs().max() > 0.0:
            assert not one[key].abs().max() > 0.0, key
            continue
        # both solve to the adjoint's tolerance
        least = 1e-7 if precision == "float64" else 4.0 * relative(two[key], expected) + 1e-3
        assert relative(one[key], expected) <= least, key


@pytest.mark.parametrize("kernel", KERNELS)
def test_gradients_do_not_feel_their_batch(kernel: str, precision: str) -> None:
    case = held(4)
    sim = on_gpu(case, DTYPES[precision], kernel, iterations=200)
    state, forces = different(case, sim, 40)
    rows, weight = own_rows(sim, 40), noise(state.positions, 5)
    together = gradients_after_two_steps(sim, state, forces, rows, weight)
    for items in (slice(0, 1), slice(17, 20), slice(0, 40)):
        start = pd.State(*(t[items] for t in state))
        own = {key: row[items] for key, row in rows.items()}
        alone = gradients_after_two_steps(sim, start, forces[items], own, weight[items])
        for key in ("positions", "velocities", "forces", *rows):
            assert torch.equal(alone[key], together[key][items]), key


@pytest.mark.parametrize("averaging", AVERAGING)
def test_multilevel_solves_as_on_the_cpu(averaging: int, precision: str) -> None:
    """To the same minimum: the distance that the CPU's float32 keeps from float64 is that of converged steps."""
    case, dtype, options = held(averaging), DTYPES[precision], {"solver": pd.Multilevel(), "iterations": 200}
    sims = [
        simulator(case, dtype, GPU, **options),
        simulator(case, dtype, **options),
        simulator(case, torch.float64, **options),
    ]
    state, forces = different(case, sims[1], 3)
    rows = own_rows(sims[1], 3)
    for own in (False, True):
        for sim in sims if own else []:
            set_rows(sim, rows)
        one, two, wide = (sim(moved(state, sim.device, sim.dtype), forces.to(sim.device, sim.dtype)) for sim in sims)
        least = 1e-8 if precision == "float64" else 4.0 * relative(two.velocities, wide.velocities) + 1e-5
        assert relative(one.velocities, wide.velocities) <= least


def test_multilevel_adjoint(precision: str) -> None:
    """The preconditioned solve has the gradients of the plain one."""
    case, dtype = held(4), DTYPES[precision]
    plain = on_gpu(case, dtype, "stream", iterations=1500)
    state, forces = different(case, plain, 2)
    weight = noise(state.positions, 5)
    preconditioned = simulator(case, dtype, GPU, kernel="stream", iterations=1500, adjoint="multilevel")
    expected, found = (gradients_after_two_steps(sim, state, forces, {}, weight) for sim in (plain, preconditioned))
    least = 1e-7 if precision == "float64" else 2e-3
    for key in ("positions", "velocities", "forces", "stiffness", "poisson"):
        assert relative(found[key], expected[key]) <= least, key


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_step_takes_what_it_is_said_to(kernel: str, precision: str) -> None:
    sim = on_gpu(held(4), DTYPES[precision], kernel, iterations=2)

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

    for batch in (1, 7, 300):
        assert step_bytes(sim.compiled, sim.plan, batch, GPU) == taken(batch)
    for name, row in own_rows(sim, 7).items():
        set_rows(sim, {name: row})
        assert step_bytes(sim.compiled, sim.plan, 7, GPU) == taken(7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_one_group_is_one_patch(kernel: str, precision: str) -> None:
    vertices = np.concatenate([np.zeros((1, 3)), np.eye(3), np.ones((1, 3))])
    body = Solid(pd.TetMesh(vertices, [[0, 1, 2, 3], [1, 2, 3, 4]]), youngs=1e4, poisson=0.4, averaging=2)
    case = Case(Scene(body, pd.Pin(body, [0]), pd.Gravity()), 1.3 * vertices, 0.0 * vertices, 1.0 / 60.0)
    sims = sims_of(case, kernel, precision, iterations=20)
    assert sims[0].plan.patches == 1
    one, two, wide = (sim(state_of(case, sim)) for sim in sims)
    assert rounds_as(one.velocities, two.velocities, wide.velocities)


def test_what_a_gpu_does_not_take(precision: str) -> None:
    case, dtype = held(4), DTYPES[precision]
    with pytest.raises(ValueError, match=r'kernel must not be "cluster" .*Poisson'):
        simulator(case, dtype, GPU, kernel="cluster")
    mesh = case.scene.solids[0].mesh
    apart = np.arange(len(mesh.tets)) // 2
    apart[[0, -1]] = apart[[-1, 0]]  # groups without a common face
    body = Solid(mesh, youngs=1e5, poisson=0.3, averaging=apart, density=1.0)
    with pytest.raises(ValueError, match="common face"):
        pd.Simulator(Scene(body), device="cuda", dtype=dtype)


def test_a_simulator_moves_there_and_back(precision: str) -> None:
    case, dtype = held(4), DTYPES[precision]
    sim = simulator(case, dtype)
    state = state_of(case, sim, 2)
    before = sim(state)
    sim.to("cuda")
    assert relative(sim(moved(state, GPU)).positions, before.positions) <= 1e-3
    sim.to("cpu")
    assert same_bits(sim(state), before)
