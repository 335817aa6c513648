"""Read-outs on a GPU: those of the CPU, with the same bits alone and in any batch. None waits: test_cuda_host.py."""

from __future__ import annotations

import pytest
import torch
from devices import require_gpu
from on_gpu import DTYPES, GPU, KERNELS, small_on_gpu
from runs import noise, small
from torch import Tensor
from torch.utils._pytree import tree_leaves

import torchpd as pd

require_gpu()


def leaves(sim: pd.Simulator, state: pd.State, after: pd.State, forces: Tensor) -> list[Tensor]:
    stress = sim.stress(after)
    parts = sim.contact_forces(state, after, forces), sim.reactions(state, after, forces), stress
    found: list[Tensor] = tree_leaves((parts, sim.vertex_average(stress.strain)))
    return found


@pytest.mark.parametrize("kernel", KERNELS)
def test_read_outs_are_those_of_the_cpu(kernel: str) -> None:
    sim, state = small_on_gpu(torch.float64, kernel, 7)
    host, _ = small(torch.float64, batch=7)
    forces = noise(state.positions, 5)
    after = sim(state, forces)
    found = leaves(sim, state, after, forces)
    expected = leaves(host, state.to("cpu"), after.to("cpu"), forces.cpu())
    for one, other in zip(found, expected, strict=True):
        assert one.device == GPU
        if one.dtype == torch.bool:
            assert torch.equal(one.cpu(), other)
        else:
            scale = float(other.nan_to_num().abs().max()) if other.numel() else 0.0
            torch.testing.assert_close(one.cpu(), other, rtol=1e-9, atol=1e-11 * scale, equal_nan=True)


@pytest.mark.parametrize("precision", DTYPES)
def test_batches_do_not_matter(precision: str) -> None:
    sim, state = small_on_gpu(DTYPES[precision], "block", 150)
    forces = noise(state.positions, 5)
    after = sim(state, forces)
    together = [leaf.nan_to_num(7.0) for leaf in leaves(sim, state, after, forces)]
    for item in (0, 149):
        row = slice(item, item + 1)
        one, then = (pd.State(*(array[row].clone() for array in of)) for of in (state, after))
        alone = leaves(sim, one, then, forces[row].clone())
        assert all(torch.equal(a.nan_to_num(7.0), b[row]) for a, b in zip(alone, together, strict=True))


def test_gradients_are_those_of_the_cpu() -> None:
    sim, state = small_on_gpu(torch.float64, "block", 3)
    host, _ = small(torch.float64, batch=3)
    gradients = []
    for runner in (sim, host):
        x, v = (array.detach().to(runner.device).clone() for array in state)
        after = runner(pd.State(x, v)).positions.requires_grad_()
        found = leaves(runner, pd.State(x, v), pd.State(after, v), torch.zeros_like(x))
        whole = [leaf.nan_to_num() for leaf in found if leaf.dtype != torch.bool and leaf.requires_grad]
        loss = sum((noise(leaf, 3) * leaf / (1.0 + leaf.detach().abs().max())).sum() for leaf in whole)
        gradients.append(torch.autograd.grad(loss, after)[0].cpu())
    scale = float(gradients[1].abs().max())
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-7, atol=1e-9 * scale)
