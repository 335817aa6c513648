"""Fixtures: the devices that this machine and this build have, both precisions, memory that is never zero by luck."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from torchpd.extension import load_extension


def _devices() -> list[str]:
    extension, _ = load_extension()
    with_cuda = extension is not None and extension.build_info()["cuda"] and torch.cuda.is_available()
    return ["cpu", "cuda"] if with_cuda else ["cpu"]


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


@pytest.fixture
def two_threads() -> Iterator[None]:
    """At least two threads, on whatever machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(threads)
