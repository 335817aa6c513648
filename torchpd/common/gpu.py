"""Requirements of a simulator on a GPU, and the errors that name the fix."""

from __future__ import annotations

from typing import NamedTuple

import torch

__all__ = [
    "DOCTOR",
    "H100",
    "MIN_CAPABILITY",
    "Properties",
    "check_free_memory",
    "free_memory",
    "properties_of",
    "unavailable_reason",
    "visible_devices",
]

MIN_CAPABILITY = (8, 0)
DOCTOR = "`python -m torchpd doctor` says more"


class Properties(NamedTuple):
    """Properties of a GPU that the choice of a kernel depends on."""

    multiprocessors: int
    shared: int  # most shared memory per block [bytes]
    cluster: int = 1  # most blocks per cluster


H100 = Properties(132, 232_448, cluster=16)  # the GPU of the measurements


def properties_of(device: torch.device) -> Properties:
    """Read the properties of a GPU."""
    from .. import _C  # imported here: the doctor works without the extension

    found = torch.cuda.get_device_properties(device)
    # missing from the type stubs of torch
    shared: int = found.shared_memory_per_block_optin  # type: ignore[attr-defined]
    with torch.cuda.device(device):
        return Properties(found.multi_processor_count, shared, _C.largest_cluster())


def unavailable_reason(
    built: bool, torch_cuda: str | None, devices: int, capability: tuple[int, int] | None = None
) -> str:
    """Reason why no simulator can run on a GPU, with the fix; empty if one can.

    Args:
        built: whether the extension has CUDA kernels.
        torch_cuda: `torch.version.cuda`, None for a CPU build of torch.
        devices: number of GPUs that torch sees.
        capability: compute capability of the requested GPU, if known.
    """
    if torch_cuda is None:
        return (
            "this torch is a CPU build: install a torch for CUDA (pytorch.org/get-started), then build torchpd again; "
            f"{DOCTOR}"
        )
    if not built:
        return (
            f"this build of torchpd has no CUDA kernels: install the CUDA {torch_cuda} toolkit or set CUDA_HOME, then "
            f"build torchpd again; {DOCTOR}"
        )
    if devices == 0:
        return f"torch sees no CUDA device: check the driver (nvidia-smi) and CUDA_VISIBLE_DEVICES; {DOCTOR}"
    if capability is not None and capability < MIN_CAPABILITY:
        return (
            f"the GPU has compute capability {_dotted(capability)} and the kernels need {_dotted(MIN_CAPABILITY)} or "
            'newer (Ampere): take another device, or stay on the CPU with .to("cpu")'
        )
    return ""


def _dotted(capability: tuple[int, int]) -> str:
    return ".".join(map(str, capability))


def visible_devices() -> str:
    """List the GPUs that torch sees, for an error message."""
    names = [f"cuda:{index} ({torch.cuda.get_device_name(index)})" for index in range(torch.cuda.device_count())]
    return f"torch sees {', '.join(names) or 'none'}; CUDA_VISIBLE_DEVICES limits them"


def free_memory(device: torch.device) -> int:
    """Bytes that torch can still allocate on a GPU."""
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def check_free_memory(needed: int, free: int) -> None:
    """Raise an error before an allocation would fail halfway."""
    if needed > free:
        raise RuntimeError(
            f"Simulator: plan, material and a step need {needed:,} B of memory on the GPU and {free:,} B are free. "
            "Free some (torch.cuda.empty_cache(), other processes), or take a coarser mesh, torch.float32, a smaller "
            'batch or the CPU. kernel="grid" works on fewer environments at a time than "stream".'
        )
