"""What `print(sim)` and the check before a simulator moves say of memory is what torch's allocator hands out."""

from __future__ import annotations

import gc
import re

import pytest
import torch
from cases import Case
from devices import require_gpu
from on_gpu import DTYPES, GPU, KERNELS, bar, on_gpu
from runs import noise, plan_of, simulator, small
from torch import Tensor

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.common.tables import DEVICE_SIZES
from torchpd.ops import INFO_WIDTH
from torchpd.plan.placement import step_bytes

require_gpu()

SOLVERS = ("lbfgs", "momentum")


def body(contacts: bool, cells: tuple[int, int, int] = (8, 3, 3)) -> Case:
    """Held, or free to move over a ground."""
    parts = (pd.Ground(-0.3), pd.Sphere((0.0, -9.0, 0.0), 0.5)) if contacts else (pd.Gravity(),)
    return bar(cells, *parts, pinned=not contacts)


def bytes_taken(sim: pd.Simulator, batch: int) -> int:
    """Of torch's memory by a step in place, which holds nothing else; as asked for, before the allocator rounds it."""
    rest = sim.rest_state(batch)
    state = pd.State(rest.positions + 0.01 * noise(rest.positions, 1), noise(rest.positions, 2))
    sim.step_(state)
    torch.cuda.synchronize()
    gc.collect()  # not while it is measured
    torch.cuda.reset_peak_memory_stats(GPU)
    before = torch.cuda.memory_stats(GPU)["requested_bytes.all.current"]
    held = torch.cuda.memory_allocated(GPU)
    sim.step_(state)
    torch.cuda.synchronize()
    taken: int = torch.cuda.memory_stats(GPU)["requested_bytes.all.peak"] - before
    # blocks of the allocator: of 512 bytes, and large ones with up to 1 MB that is not worth splitting off
    assert taken <= torch.cuda.max_memory_allocated(GPU) - held <= taken + (1 << 20) + 512
    return taken - 8 * INFO_WIDTH * batch  # which nobody asked for, and step_ fills in all the same


def batches() -> tuple[int, ...]:
    """Of one, of several, and of more than are in work at a time."""
    return (1, 7, 24 * properties_of(GPU).multiprocessors)


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", [*KERNELS, "far"])
@pytest.mark.parametrize("contacts", [False, True], ids=["plain", "contacts"])
def test_a_step_takes_what_it_is_said_to(contacts: bool, kernel: str, precision: str) -> None:
    case = body(contacts, (24, 6, 6) if kernel == "far" else (8, 3, 3))
    sim = on_gpu(case, DTYPES[precision], kernel, iterations=2)
    for batch in batches():
        assert step_bytes(sim.compiled, sim.plan, batch, GPU) == bytes_taken(sim, batch)
    own = sim.stiffness * torch.linspace(0.5, 2.0, 7, dtype=sim.dtype, device=GPU)[:, None]
    sim.set_material(stiffness=own)
    assert step_bytes(sim.compiled, sim.plan, 7, GPU) == bytes_taken(sim, 7)


@pytest.mark.parametrize("cells", [(2, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4)])
def test_environments_that_share_blocks_take_no_more_than_is_said(cells: tuple[int, int, int]) -> None:
    """How many share one follows from the batch; what all of them take at most does not."""
    sim = on_gpu(body(contacts=True, cells=cells), torch.float32, "block", iterations=2)
    found = re.search(r"at most ([\d,]+) B in all", repr(sim))
    assert found
    most = int(found[1].replace(",", ""))
    for batch in (1, 7, 529, 1025, 1585, 3169, 4225, 8185, 20_000):
        taken = bytes_taken(sim, batch)
        assert step_bytes(sim.compiled, sim.plan, batch, GPU) == taken
        assert taken <= most


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize("batch", [None, 1024])
def test_a_step_of_the_multilevel_solver_takes_what_it_is_said_to(
    batch: int | None, outer: str, precision: str
) -> None:
    """With the patches and the preconditioner of few and of many environments."""
    for contacts in (False, True):
        solver = pd.Multilevel(outer)
        sim = simulator(body(contacts), DTYPES[precision], GPU, solver=solver, batch=batch, iterations=2)
        for count in batches():
            assert step_bytes(sim.compiled, sim.plan, count, GPU) == bytes_taken(sim, count)


@pytest.mark.parametrize("kernel", KERNELS)
def test_print_says_how_much(kernel: str) -> None:
    sim = on_gpu(body(contacts=False), torch.float32, kernel)
    said = re.search(r"([\d,]+) B per environment during a step(, at most ([\d,]+) B in all)?$", str(sim), re.MULTILINE)
    assert said
    one, _, most = said.groups()
    assert int(one.replace(",", "")) == bytes_taken(sim, 1)
    if kernel == "stream":
        assert most is None
    else:
        assert int(most.replace(",", "")) == bytes_taken(sim, batches()[-1])


def test_a_plan_that_is_still_on_the_cpu_tells_it_too() -> None:
    """Before anything moves."""
    sim, _ = small(torch.float32, GPU)
    assert step_bytes(sim.compiled, sim.plan.to("cpu"), 3, GPU) == step_bytes(sim.compiled, sim.plan, 3, GPU) > 0


def test_more_blocks_than_32_bits_count_are_refused() -> None:
    """Of a plan whose sizes say so: kernels count the corners of their pairs, 160 a block."""
    sim, state = small(torch.float32, GPU)
    arrays: list[Tensor] = plan_of(sim)
    sizes = arrays[0].clone()
    sizes[DEVICE_SIZES.index("blocks")] = 2**32 // 160 + 1
    with pytest.raises(ValueError, match=r"up to 26843545 blocks of 32 pairs of tetrahedra.* got 26843546; compile"):
        torch.ops.torchpd.gradient(state.positions, sim.material(), [sizes, *arrays[1:]])
