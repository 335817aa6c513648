"""Whatever shape, type or number comes: it runs or it is refused, never a crash."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_scene import call_step, small_simulator
from torch import Tensor

import torchpd as pd

ops = torch.ops.torchpd


@pytest.fixture(scope="module")
def sim() -> pd.Simulator:
    return small_simulator()


SHAPES = st.lists(st.sampled_from([0, 1, 2, 3, 5, 6, 8, 27, 48]), max_size=4)
TYPES = st.sampled_from([torch.float32, torch.float64, torch.int32, torch.int64, torch.float16, torch.bool])
FUZZ = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def tensors() -> st.SearchStrategy[Tensor]:
    """Zeros and ones of any shape and type: only what is checked can go wrong."""
    return st.builds(
        lambda shape, kind, one: torch.full(shape, one, dtype=torch.float32).to(kind), SHAPES, TYPES, st.integers(0, 1)
    )


@FUZZ
@given(which=st.sampled_from(["positions", "velocities", "forces", "start"]), tensor=tensors())
def test_any_state_is_run_or_refused(which: str, tensor: Tensor, sim: pd.Simulator) -> None:
    good = tensor.dtype == torch.float32 and tuple(tensor.shape) == (2, 27, 3)
    if good:
        call_step(sim, **{which: tensor})
    else:
        with pytest.raises((ValueError, TypeError), match=f"{which}|like positions|vertices of the plan"):
            call_step(sim, **{which: tensor})


@FUZZ
@given(index=st.integers(1, 7), tensor=tensors())
def test_any_material_is_run_or_refused(index: int, tensor: Tensor, sim: pd.Simulator) -> None:
    material = sim.material()
    own = material[index]
    rows_free = (
        tensor.dim() >= 2 and index >= 6 and tensor.shape[-1] == own.shape[-1] and tensor.shape[:-2] in ((), (1,), (2,))
    )
    fits = tuple(tensor.shape) == tuple(own.shape) or (
        tuple(tensor.shape[1:]) == tuple(own.shape) and tensor.shape[0] in (1, 2)
    )
    material[index] = tensor
    if tensor.dtype == torch.float32 and (fits or rows_free):
        call_step(sim, material=material)
    else:
        with pytest.raises((ValueError, TypeError), match=r"material\."):
            call_step(sim, material=material)


@FUZZ
@given(tensor=tensors())
def test_any_matrices_are_run_or_refused(tensor: Tensor) -> None:
    if tensor.dtype in (torch.float32, torch.float64) and tensor.dim() >= 2 and tensor.shape[-2:] == (3, 3):
        assert pd.nearest_rotation(tensor).shape == tensor.shape
    else:
        with pytest.raises((ValueError, TypeError), match="matrices must be"):
            pd.nearest_rotation(tensor)


@FUZZ
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-30, 1.0, 1e8, 1e30]), batch=st.sampled_from([1, 2, 9]))
def test_any_numbers_run(seed: int, scale: float, batch: int, sim: pd.Simulator) -> None:
    """Values are never refused: whatever comes out, comes out."""
    values = torch.from_numpy(np.random.default_rng(seed).standard_normal((3, batch, 27, 3)) * scale).float()
    after, info = sim(pd.State(values[0], values[1]), values[2], return_info=True)
    assert after.positions.shape == values[0].shape
    assert info.iterations.tolist() == [sim.iterations] * batch
    if scale <= 1e8:
        assert bool(after.positions.isfinite().all())
