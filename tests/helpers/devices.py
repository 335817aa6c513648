"""Whether there is a GPU that the kernels can run on."""

from __future__ import annotations

import pytest
import torch

from torchpd.common.extension import load_extension


def missing_gpu() -> str:
    """Why the kernels cannot run here; empty where they can."""
    extension, reason = load_extension()
    if extension is None:
        return reason
    if not extension.build_info()["cuda"]:
        return "this build of torchpd has no CUDA kernels"
    return "" if torch.cuda.is_available() else "torch finds no CUDA device"


def require_gpu() -> None:
    """Skip the module that calls this where no kernel can run."""
    reason = missing_gpu()
    if reason:
        pytest.skip(reason, allow_module_level=True)
