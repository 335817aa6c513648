"""Registration, autograd and vmap of `torch.ops.torchpd`."""

from .registration import INFO_WIDTH

__all__ = ["INFO_WIDTH"]
