"""Small meshes in float32 share blocks: how many have one follows from the batch of a call, and no bit from that."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from devices import require_gpu
from environments import assert_same_bits, run
from on_gpu import GPU, bar, crowd, device_work, moved, on_gpu, relative, threads_of
from runs import noise, simulator
from torch import Tensor

import torchpd as pd
from torchpd import _C
from torchpd.common.gpu import H100, properties_of
from torchpd.ops.diagonal import named_material, step_diagonal

require_gpu()


def unlike(sim: pd.Simulator, count: int) -> tuple[pd.State, Tensor, dict[str, Tensor]]:
    """Environments no two of which are alike: states, forces, and all of the material; spheres move."""
    rest = sim.rest_state(count)
    state = pd.State(rest.positions + 0.01 * noise(rest.positions, 1), noise(rest.positions, 2))
    material = {}
    for number, (name, array) in enumerate(named_material(sim.material()).items()):
        own = array.detach().expand(count, *array.shape).clone()
        if name in ("planes", "spheres"):  # height; centre, and how far it moves in a step
            for moving in [own[..., 3:4]] if name == "planes" else [own[..., :3], own[..., 5:8]]:
                moving += 0.01 * noise(moving, 10 + number)
        elif name == "pin_targets":
            own += 0.01 * noise(own, 10 + number)
        else:
            own *= torch.exp(0.3 * noise(own, 10 + number))
        material[name] = own
    return state, 0.1 * noise(rest.positions, 3), material


def some(sim: pd.Simulator, everything: tuple[pd.State, Tensor, dict[str, Tensor]], items: slice) -> list[Tensor]:
    state, forces, material = everything
    sim.set_material(**{name: array[items] for name, array in material.items()})
    return run(sim, state, forces, items)


def touching() -> tuple[pd.scene.Part, ...]:
    """What a bar of 0.2 m height meets at once, some of it and not all."""
    return pd.Ground(0.0, friction=0.4), pd.Sphere((0.6, -0.08, 0.1), 0.1, friction=0.3)


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize(("iterations", "tolerance"), [(15, 0.0), (200, 0.1)])
@pytest.mark.parametrize(("pinned", "contacts"), [(True, True), (False, True), (False, False), (True, False)])
@pytest.mark.parametrize("cells", [(1, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4)])
def test_how_many_share_a_block_does_not_matter(
    cells: tuple[int, int, int], pinned: bool, contacts: bool, iterations: int, tolerance: float, tmp_path: Path
) -> None:
    parts = (pd.Gravity(), pd.Damping(0.5), *(touching() if contacts else ()))
    sim = on_gpu(bar(cells, *parts, pinned=pinned), torch.float32, "block", iterations=iterations, tolerance=tolerance)
    assert sim.plan.size("most_pairs") <= _C.most_sharing_pairs
    most = 23 * properties_of(GPU).multiprocessors + 1  # on an H100 the last block is not full, however many share one
    everything = unlike(sim, most)
    together, shapes = some(sim, everything, slice(None)), set()
    state, forces, _ = everything
    plain = sim(state, forces)  # without a report there are fewer barriers
    assert_same_bits(some(sim, everything, slice(None)), together)
    assert_same_bits([*plain], together[:2])
    if tolerance:
        assert len(together[4].unique()) > 1
    for first, last in ((0, 1), (1, 3), (0, 131), (5, 305), (0, 1025), (most - 2, most), (0, most)):
        items = slice(first, last)
        assert_same_bits(some(sim, everything, items), [t[items] for t in together])
        step = partial(sim, pd.State(*(t[items] for t in state)), forces[items])
        shapes.add(frozenset(threads_of(step, tmp_path)))
    # of the smallest, one warp is the best for all
    assert len(shapes) > 1 or cells == (1, 1, 1) or shapes == {frozenset()}


def both(contacts: bool, **options: Any) -> tuple[pd.Simulator, pd.Simulator, pd.State]:
    """A bar in float32, many of which share blocks, and in float64 with a kernel of another kind."""
    case = bar((3, 3, 3), pd.Gravity(), pd.Damping(0.5), *(touching() if contacts else ()), pinned=False)
    sim = on_gpu(case, torch.float32, "block", **options)
    other = on_gpu(case, torch.float64, "stream", **options)
    state, _, material = unlike(sim, 12 * properties_of(GPU).multiprocessors + 1)  # three a block on an H100
    sim.set_material(**material)
    other.set_material(**{name: array.double() for name, array in material.items()})
    return sim, other, state


def taken_off(sim: pd.Simulator, before: pd.State, after: pd.State, dtype: torch.dtype) -> Tensor:
    """The most that `Info.residual` leaves out as rounding [B]: 4 eps of every stiffness times the largest position."""
    _, diagonal = step_diagonal(list(sim.plan.arrays), sim.material(), sim.time_step)
    size = (after.positions.amax(1) - after.positions.amin(1)).norm(dim=-1) + after.positions.abs().amax((1, 2))
    inertial = sim.step_gradient(before, after) - sim.gradient(after)  # a (u - s), a part of the forces
    rounding = 4 * torch.finfo(dtype).eps * 2 * size * diagonal.norm(dim=-1)
    return rounding / inertial.flatten(1).norm(dim=-1)


@pytest.mark.parametrize("contacts", [False, True])
@pytest.mark.parametrize("solver", [pd.Jacobi(), pd.Chebyshev(), pd.Chebyshev("classic", rho=0.95, delay=3)])
def test_blocks_of_several_agree_with_float64(solver: pd.Jacobi | pd.Chebyshev, contacts: bool, tmp_path: Path) -> None:
    """A rollout, whose spheres move."""
    sim, other, state = both(contacts, iterations=13, solver=solver)
    if properties_of(GPU).multiprocessors == H100.multiprocessors:
        assert threads_of(partial(sim, state), tmp_path) <= {128}
    found = sim.rollout(state, 3, return_info=True)
    expected = other.rollout(moved(state, GPU, torch.float64), 3, return_info=True)
    assert relative(found.positions, expected.positions) < 1e-5
    assert torch.equal(found.info.iterations, expected.info.iterations)
    assert relative(found.info.energy, expected.info.energy) < 1e-4
    left = expected.info.residual - found.info.residual
    states = [moved(state, GPU, torch.float64), *(expected.state(record) for record in range(3))]
    for record, (before, after) in enumerate(pairwise(states)):
        allowed = 1e-3 * expected.info.residual[record] + taken_off(other, before, after, torch.float32)
        assert bool((left[record].abs() <= allowed).all())
    assert torch.equal(sim.rollout(state, 3).positions, found.positions)


@pytest.mark.parametrize("contacts", [False, True])
def test_blocks_of_several_stop_where_float64_stops(contacts: bool) -> None:
    """Each environment at its own iteration; rounding decides for those that are on the threshold."""
    sim, other, state = both(contacts, iterations=300, tolerance=0.05)
    found, info = sim(state, return_info=True)
    expected, other_info = other(moved(state, GPU, torch.float64), return_info=True)
    same = info.iterations == other_info.iterations
    assert len(info.iterations[same].unique()) > 3
    assert same.double().mean() > 0.9
    assert torch.equal(info.converged[same], other_info.converged[same])
    assert bool(info.converged.any())
    assert relative(found.positions[same], expected.positions[same]) < 1e-4


def test_many_pieces_share_a_block() -> None:
    """More pieces than a block has warps, each shifted by itself, in more environments than a wave has."""
    case = crowd()
    sim = on_gpu(case, torch.float32, "block", iterations=6)
    assert sim.plan.size("most_pairs") <= _C.most_sharing_pairs
    assert sim.plan.size("pieces") == 41
    everything = unlike(sim, 3000)
    together = some(sim, everything, slice(None))
    for first, last in ((0, 1), (17, 400), (2999, 3000)):
        assert_same_bits(some(sim, everything, slice(first, last)), [t[first:last] for t in together])
    cpu = simulator(case, torch.float64, iterations=6)
    state, forces, material = everything
    cpu.set_material(**{name: array[:9].double().cpu() for name, array in material.items()})
    expected = cpu(moved(pd.State(*(t[:9] for t in state)), "cpu", torch.float64), forces[:9].double().cpu())
    assert relative(together[0][:9], expected.positions) < 1e-5


@pytest.mark.parametrize(("cells", "share"), [((4, 4, 4), True), ((5, 4, 4), False)])
def test_which_meshes_share_blocks(cells: tuple[int, int, int], share: bool) -> None:
    for dtype in (torch.float32, torch.float64):
        sim = on_gpu(bar(cells), dtype, "block")
        assert (sim.plan.size("most_pairs") <= _C.most_sharing_pairs) == share
        state = sim.rest_state(3)
        (name,) = device_work(partial(sim, state))
        assert ("small_batch_step" in name) == (share and dtype == torch.float32), name
