"""Fixtures: the devices that this machine and this build have, both precisions, memory that is never zero by luck."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

# Beside each other the processes of pytest-xdist share the cores; with more threads than that they wait for each other.
# Before torch, which loads numpy: its BLAS counts the cores then.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    share = max(1, (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    os.environ.setdefault("OMP_NUM_THREADS", str(share))

import torch
from devices import missing_gpu

# before cuBLAS starts: with deterministic algorithms, see `poisoned`, torch warns of a workspace of any other size
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")


def _devices() -> list[str]:
    return ["cpu"] if missing_gpu() else ["cpu", "cuda"]


@pytest.fixture(scope="session", params=_devices())
def device(request: pytest.FixtureRequest) -> torch.device:
    return torch.device(request.param)


@pytest.fixture(scope="session", params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    chosen: torch.dtype = request.param
    return chosen


@pytest.fixture
def poisoned() -> Iterator[None]:
    """Tensors that an op allocates start as NaN: what it forgets to write shows."""
    fills = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = True
    yield
    torch.use_deterministic_algorithms(False)
    torch.utils.deterministic.fill_uninitialized_memory = fills


def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def one_thread() -> Iterator[None]:
    yield from _threads(1)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """At least two threads, on whatever machine."""
    yield from _threads(2)
