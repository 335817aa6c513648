"""Every kernel gives the same bits: on every run, alone or in a batch, step by step or in a rollout, in a graph."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path

import pytest
import torch
from devices import require_gpu
from environments import assert_same_bits, count_sliding, different_environments, gradients, run
from environments import scene as scene_of_all_effects
from on_gpu import (
    DTYPES,
    GPU,
    KERNELS,
    bar,
    compiled_for,
    device_work,
    full_on_gpu,
    has_clusters,
    moved,
    on_gpu,
    small_on_gpu,
    threads_of,
)
from runs import moving, noise, same_bits, state_of
from torch import Tensor

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.ops import INFO_WIDTH
from torchpd.plan import kernel_choice as regimes
from torchpd.simulation.state import Info

require_gpu()

BATCH = 4096  # more than any kernel has on the device at once
pytestmark = pytest.mark.parametrize("precision", DTYPES)


def unlike(sim: pd.Simulator, batch: int) -> tuple[pd.State, Tensor]:
    """Environments no two of which are alike, and forces."""
    rest = sim.rest_state(batch)
    return (
        pd.State(rest.positions + 0.01 * noise(rest.positions, 1), noise(rest.positions, 2)),
        0.1 * noise(rest.positions, 3),
    )


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize(("iterations", "tolerance"), [(14, 0.0), (1300, 0.3)])
@pytest.mark.parametrize("kernel", KERNELS)
def test_runs_and_batches_do_not_matter(
    kernel: str, iterations: int, tolerance: float, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    dtype = DTYPES[precision]
    monkeypatch.setitem(regimes._STREAM_TETS, dtype, 100)
    sim = on_gpu(scene_of_all_effects(), dtype, kernel, iterations=iterations, tolerance=tolerance)
    assert (sim.plan.patches > 1) == (kernel != "block")
    state, forces = unlike(sim, BATCH)
    together = run(sim, state, forces)
    for _ in range(3):
        assert_same_bits(run(sim, state, forces), together)
    for item in (0, 1, 7, 131, 132, 299, 2047, BATCH - 1):
        alone = run(sim, state, forces, slice(item, item + 1))
        assert_same_bits([t[item : item + 1] for t in together], alone)
    some = torch.tensor([5, 3, 4000, 16, 0], device=GPU)
    assert_same_bits(run(sim, state, forces, some), [t[some] for t in together])


@pytest.mark.usefixtures("poisoned")
@pytest.mark.filterwarnings("ignore:torchpd. the adjoint")
@pytest.mark.parametrize("kernel", [*KERNELS, "levels"])
def test_gradients_do_not_feel_their_batch(kernel: str, precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where vertices slide against friction, which has a method of its own, and where nothing does."""
    dtype = DTYPES[precision]
    monkeypatch.setitem(regimes._STREAM_TETS, dtype, 100)
    options = {"solver": pd.Multilevel(), "iterations": 60} if kernel == "levels" else {"iterations": 400}
    sim = on_gpu(scene_of_all_effects(), dtype, "stream" if kernel == "levels" else kernel, **options)
    state, forces = unlike(sim, 500)
    state.velocities[..., 0] += 1.0
    state.velocities[::2, :, 1] = 5.0
    assert len(count_sliding(sim, state, forces).bool().unique()) == 2
    together = gradients(sim, state, forces, slice(500))
    assert_same_bits(gradients(sim, state, forces, slice(500)), together)
    for items in (slice(0, 1), slice(1, 2), slice(133, 134), slice(498, 500), slice(101, 300)):
        assert_same_bits([t[items] for t in together], gradients(sim, state, forces, items))


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("cells", [(3, 3, 3), (8, 5, 5), (6, 6, 6)])
def test_the_shape_of_a_block_does_not_matter(cells: tuple[int, int, int], precision: str, tmp_path: Path) -> None:
    """It follows from the batch that a simulator is told, whatever comes then; only sums over vertices differ by it.

    In float32 the smallest meshes follow the batch of a call: test_cuda_several.
    """
    dtype, rows = DTYPES[precision], 700
    case = bar(cells, pd.Gravity(), pd.Ground(-0.02, friction=0.4), pd.Damping(0.5), pinned=False)

    def made(solver: pd.Jacobi | pd.Chebyshev, batch: int | None) -> pd.Simulator:
        return on_gpu(case, dtype, "block", iterations=14, solver=solver, batch=batch)

    for solver in (pd.Jacobi(), pd.Chebyshev()):
        plain = made(solver, None)
        state, forces = unlike(plain, rows)
        expected = run(plain, state, forces)
        shapes = set()
        for batch in (1, 200, 2000, 10_000):
            sim = made(solver, batch)
            assert sim.plan.size("environments") == -(-batch // properties_of(GPU).multiprocessors)
            together = run(sim, state, forces)
            # an iterate asks for a sum only where the energy rises, and for the translation of a free body
            near = 200 * torch.finfo(dtype).eps
            torch.testing.assert_close(together[0], expected[0], rtol=0.0, atol=near)
            assert_same_bits(run(sim, state, forces, slice(3, 4)), [t[3:4] for t in together])
            shapes.add(frozenset(threads_of(partial(sim, state, forces), tmp_path)))
        # of larger meshes one shape may be the best for all
        assert len(shapes) > 1 or cells != (3, 3, 3) or precision == "float32" or shapes == {frozenset()}


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize(("iterations", "tolerance"), [(18, 0.0), (60, 0.9)])
@pytest.mark.parametrize(
    ("cells", "patch"), [((8, 5, 5), 100), ((19, 40, 1), 2304), ((24, 12, 9), 2304), ((2, 2, 2), 2304)]
)
def test_blocks_that_go_from_patch_to_patch(
    cells: tuple[int, int, int],
    patch: int,
    iterations: int,
    tolerance: float,
    precision: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without contacts a block of a stream has many patches: small, thin, thick ones, less than a warp has.

    With a ground, however far, there is a block for every patch.
    """
    dtype = DTYPES[precision]
    monkeypatch.setitem(regimes._STREAM_TETS, dtype, patch)
    options = {"iterations": iterations, "tolerance": tolerance}
    sim = on_gpu(bar(cells, pd.Gravity()), dtype, "stream", **options)
    other = on_gpu(bar(cells, pd.Gravity(), pd.Ground(-50.0)), dtype, "stream", **options)
    assert (sim.plan.patches > 1) == (patch < sim.plan.size("tets"))
    gpu = properties_of(GPU)
    batch = 11 * gpu.multiprocessors // sim.plan.patches + 3  # some blocks have twelve patches
    state, forces = unlike(sim, batch)
    # environments that stop after different iterations
    state = pd.State(state.positions, state.velocities * torch.linspace(0.1, 1.0, batch, device=GPU)[:, None, None])
    if precision == "float32" and 2 * regimes.shared_bytes(sim.plan, 0, 0) <= gpu.shared:
        assert any("stream_pipeline" in name for name in device_work(lambda: sim(state, forces)))
    stiffness = sim.stiffness * torch.linspace(0.5, 20.0, batch, dtype=dtype, device=GPU)[:, None]
    # patches of one stiffness and of several
    several = stiffness.shape[1] // 3
    stiffness[:, :several] *= torch.linspace(1.0, 2.0, several, dtype=dtype, device=GPU)
    sim.set_material(stiffness=stiffness)
    other.set_material(stiffness=stiffness)
    together = run(sim, state, forces)
    assert_same_bits(run(sim, state, forces), together)
    if tolerance:
        assert len(together[4].unique()) > 1
    expected = run(other, state, forces)
    if precision == "float64":
        torch.testing.assert_close(together[0], expected[0], rtol=0.0, atol=16 * torch.finfo(dtype).eps)
    else:
        exact = on_gpu(bar(cells, pd.Gravity()), torch.float64, "stream", **options)
        exact.set_material(stiffness=stiffness.double())
        exact_run = run(exact, pd.State(*(t.double() for t in state)), forces.double())
        assert_as_near(together, expected, exact_run)
    for item in (0, 1, batch // 2, batch - 1):
        sim.set_material(stiffness=stiffness[item : item + 1])
        alone = run(sim, state, forces, slice(item, item + 1))
        assert_same_bits([t[item : item + 1] for t in together], alone)


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("tolerance", [0.0, 0.9])
@pytest.mark.parametrize("stops", [32, 33, 65, 90])
def test_blocks_with_more_patches_than_they_know_of_at_a_time(
    stops: int, tolerance: float, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They look for 32 more again and again, past environments that are done. Bits are those of small batches."""
    dtype = DTYPES[precision]
    monkeypatch.setitem(regimes._STREAM_TETS, dtype, 300)
    sim = on_gpu(bar((8, 5, 5), pd.Gravity()), dtype, "stream", iterations=20, tolerance=tolerance)
    assert sim.plan.patches == 4
    blocks = properties_of(GPU).multiprocessors
    few, batch = 11 * blocks // 4, -(-stops * blocks // 4)
    state, forces = unlike(sim, batch)
    state = pd.State(state.positions, state.velocities * torch.linspace(0.1, 1.0, batch, device=GPU)[:, None, None])
    together = run(sim, state, forces)
    if tolerance:
        assert len(together[4].unique()) > 1
    for first in range(0, batch, few):
        part = slice(first, first + few)
        assert_same_bits([t[part] for t in together], run(sim, state, forces, part))


def assert_as_near(found: list[Tensor], other: list[Tensor], exact: list[Tensor]) -> None:
    """To a float64 step as another kernel is, which has its tetrahedra in other frames; the same iterates, not bits."""
    # who stops elsewhere is elsewhere
    same = (other[4] == exact[4]) & (found[4] == exact[4])
    assert same.double().mean() > 0.9
    error, allowed = (float((positions - exact[0])[same].abs().max()) for positions in (found[0], other[0]))
    assert 0.0 < error <= 2.0 * allowed


@pytest.mark.parametrize("kernel", ["cluster", "grid", "far", "stream"])
def test_many_patches_many_times(kernel: str, precision: str) -> None:
    """What blocks of a grid say to each other arrives in any order; a hundred runs are the same."""
    cells = (8, 5, 5) if kernel == "cluster" else (24, 5, 5)
    case = bar(cells, pd.Gravity(), pd.Ground(-0.02, friction=0.4), pinned=False)
    sim = on_gpu(case, DTYPES[precision], kernel, iterations=20)
    assert sim.plan.patches > 1
    state = state_of(case, sim)
    first, info = sim(state, return_info=True)
    assert not bool(first.positions.isnan().any())
    for _ in range(100):
        after, rows = sim(state, return_info=True)
        assert same_bits(after, first)
        assert all(torch.equal(one, other) for one, other in zip(rows, info, strict=True))


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("batch", [1, 5, 150])
@pytest.mark.parametrize("kernel", KERNELS)
def test_rollout_is_repeated_steps(kernel: str, batch: int, precision: str) -> None:
    sim = on_gpu(scene_of_all_effects(), DTYPES[precision], kernel, iterations=9)
    state, forces = unlike(sim, batch)
    track = sim.rollout(state, 7, 2, forces=forces, return_info=True)
    inplace = pd.State(*(t.clone() for t in state))
    rows = torch.full((batch, INFO_WIDTH), float("nan"), dtype=torch.float64, device=GPU)
    for step in range(6):
        state, info = sim(state, forces, return_info=True)
        sim.step_(inplace, forces, info=rows)
        assert same_bits(inplace, state)
        assert all(torch.equal(one, other) for one, other in zip(Info.from_rows(rows), info, strict=True))
        if step % 2 == 1:
            assert same_bits(track.state(step // 2), state)
            columns = [column[step // 2] for column in track.info]
            assert all(torch.equal(one, other) for one, other in zip(columns, info, strict=True))


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("tolerance", [0.0, 0.1])
@pytest.mark.parametrize("iterations", [1, 2, 5, 6])
@pytest.mark.parametrize("contacts", [False, True])
def test_graphs_and_rollouts_of_many_patches(
    contacts: bool, iterations: int, tolerance: float, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels that start before the one before them has ended do so from step to step and from replay to replay.

    The last iteration writes the state from either of two places that change from one iteration to the next.
    """
    dtype = DTYPES[precision]
    monkeypatch.setitem(regimes._STREAM_TETS, dtype, 50)
    parts = (pd.Gravity(), pd.Ground(-0.3)) if contacts else (pd.Gravity(),)
    sim = on_gpu(bar((19, 6, 6), *parts), dtype, "stream", iterations=iterations, tolerance=tolerance)
    assert sim.plan.patches > 50
    start, forces = unlike(sim, 13)
    if precision == "float32":
        expected = ["stream_shared", "stream_patches" if contacts else "stream_pipeline"]
        work = device_work(lambda: sim(start, forces))
        assert all(any(kernel in name for name in work) for kernel in expected)
    eager, own = (pd.State(*(t.clone() for t in start)) for _ in range(2))
    track = sim.rollout(start, 6, forces=forces)
    step = sim.capture(own, forces)
    for _ in range(6):
        sim.step_(eager, forces)
    for _ in range(6):
        step.replay()
    state, steps = start, []
    for _ in range(6):
        state = sim(state, forces)
        torch.cuda.synchronize()
        steps.append(state)
    assert not same_bits(steps[-1], steps[-2])
    assert same_bits(eager, state)
    assert same_bits(own, state)
    assert all(same_bits(track.state(number), steps[number]) for number in range(6))


@pytest.mark.parametrize("iterations", [0, 8])
@pytest.mark.parametrize("kernel", KERNELS)
def test_start_may_be_the_state_that_is_overwritten(kernel: str, iterations: int, precision: str) -> None:
    sim = full_on_gpu(DTYPES[precision], kernel)
    sim.iterations = iterations
    state = moving(sim, 5)
    expected = sim(state, start=state.positions)
    sim.step_(state, start=state.positions)
    assert same_bits(state, expected)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_broken_environment_ends_and_breaks_alone(kernel: str, precision: str) -> None:
    """NaN must not hold up the blocks that wait for each other."""
    sim = full_on_gpu(DTYPES[precision], kernel, tolerance=1e-4)
    clean = moving(sim, 9)
    for value in (float("nan"), float("inf"), 1e30):
        sick = pd.State(clean.positions.clone(), clean.velocities.clone())
        sick.positions[1, 20, 1] = value
        expected, found = (sim.rollout(state, 3, return_info=True) for state in (clean, sick))
        if value != 1e30:
            assert not bool(found.positions[:, 1].isfinite().all(dim=(-2, -1)).any())
        others = [item for item in range(9) if item != 1]
        for one, other in zip([*found[:2], *found.info], [*expected[:2], *expected.info], strict=True):
            assert torch.equal(one[:, others], other[:, others])


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_stream_of_the_callers_is_used(kernel: str, precision: str) -> None:
    """Work that another stream is busy with is waited for, and the default stream is not touched."""
    sim, state = small_on_gpu(DTYPES[precision], kernel)
    expected = sim(state)
    torch.cuda.synchronize()
    side = torch.cuda.Stream()
    late = pd.State(*(torch.zeros_like(t) for t in state))
    torch.cuda.synchronize()
    with torch.cuda.stream(side):
        torch.cuda._sleep(200_000_000)  # a tenth of a second, in which nothing that runs elsewhere may overtake
        for to, value in zip(late, state, strict=True):
            to.copy_(value)
        after = sim(late)
    side.synchronize()
    assert same_bits(after, expected)


@pytest.mark.parametrize("side", [False, True], ids=["torch's stream", "a stream of its own"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_graph_replays_the_step(kernel: str, side: bool, precision: str) -> None:
    sim, state = small_on_gpu(DTYPES[precision], kernel)
    sim.tolerance = 1e-3
    other = moved(pd.State(state.positions.flip(0) + 0.01, 0.5 * state.velocities.flip(0)), GPU)
    forces = noise(state.positions)
    expected = [(sim(s, forces), sim.rollout(s, 3)) for s in (state, other)]
    inputs = pd.State(*(t.clone() for t in state))
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):  # warm up as torch.cuda.graph wants it
        sim(inputs, forces)
        sim.rollout(inputs, 3)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream if side else None):
        after, track = sim(inputs, forces), sim.rollout(inputs, 3)
    for given, (want, record) in itertools.chain(*[zip((state, other), expected, strict=True)] * 2):
        with torch.cuda.stream(stream if side else torch.cuda.current_stream()):
            for to, value in zip(inputs, given, strict=True):
                to.copy_(value)
            graph.replay()
        torch.cuda.synchronize()
        assert same_bits(after, want)
        assert same_bits(track, record)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_graph_of_steps_in_place_goes_on(kernel: str, precision: str) -> None:
    sim, start = small_on_gpu(DTYPES[precision], kernel)
    eager, own = (pd.State(*(t.clone() for t in start)) for _ in range(2))
    sim.step_(eager)
    graph = torch.cuda.CUDAGraph()
    torch.cuda.synchronize()
    with torch.cuda.graph(graph):
        sim.step_(own)
    assert same_bits(own, start)  # a capture runs nothing
    for _ in range(4):
        graph.replay()
        assert same_bits(own, eager)
        sim.step_(eager)


@pytest.mark.usefixtures("poisoned")
def test_kernels_agree(precision: str) -> None:
    """They add up in different orders; nothing else is different."""
    dtype = DTYPES[precision]
    found = []
    for kernel in KERNELS:
        if kernel == "cluster" and not has_clusters():
            continue
        sim = on_gpu(scene_of_all_effects(), dtype, kernel, iterations=12)
        state, forces = different_environments(sim, 4)
        found.append(sim(state, forces).velocities)
    for one in found[1:]:
        # rounding of some fifty operations an iteration, of random sign
        limit = 50 * 12 * torch.finfo(dtype).eps * float(found[0].abs().max())
        assert float((one - found[0]).abs().max()) <= limit


@pytest.mark.parametrize("iterations", [0, 1])
@pytest.mark.parametrize("kernel", KERNELS)
def test_few_iterations_in_place_do_as_elsewhere(kernel: str, iterations: int, precision: str) -> None:
    """Patches that nothing holds back before the end of the step: none reads what another has written already."""
    case = bar((8, 2, 2))
    sim = on_gpu(case, DTYPES[precision], kernel, solver=pd.Jacobi(), iterations=iterations)
    state = state_of(case, sim, 9)
    after = sim(state)
    sim.step_(state)
    assert same_bits(after, state)


@pytest.mark.parametrize("kernel", KERNELS)
def test_another_kernel_is_that_of_a_simulator_made_with_it(kernel: str, precision: str) -> None:
    expected, state = small_on_gpu(DTYPES[precision], kernel)
    sim, _ = small_on_gpu(DTYPES[precision], "block" if kernel == "stream" else "stream")
    assert sim.plan.kernel != kernel
    with compiled_for(kernel):
        sim.kernel = kernel
    assert (sim.kernel, sim.plan.kernel, sim.plan.patches) == (kernel, kernel, expected.plan.patches)
    assert same_bits(sim(state), expected(state))
