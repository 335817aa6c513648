"""`DistributedDataParallel` with simulators whose material differs between ranks."""

from __future__ import annotations

from typing import TypeVar

from torch import nn
from torch.nn.modules.module import register_module_module_registration_hook
from torch.nn.parallel import DistributedDataParallel

from ..plan.material import MATERIAL_ROWS
from .stepper import Stepper

__all__ = ["keep_material_per_rank", "names_per_rank"]

_Wrapped = TypeVar("_Wrapped", bound=nn.Module)


def keep_material_per_rank(module: _Wrapped) -> _Wrapped:
    """Make `DistributedDataParallel(module)` leave each rank the material of its own environments.

    `DistributedDataParallel` copies all parameters and buffers of rank 0 to the other ranks, and averages gradients.
    For simulators in `module` that is right only for trained arrays that all environments share. This call excludes the
    other arrays: those that are not trained, and those with a batch, whose gradients belong to the environments of
    their rank. A module that holds a simulator cannot be wrapped without this call. See docs/distributed.md.

    Args:
        module: the module to be wrapped, a `Simulator` or a module that holds some. Call this after `requires_grad_`
            and `set_material`.

    Returns:
        The same module.

    Example:
        >>> sim.set_material(stiffness=youngs_of_this_rank[:, None])
        >>> model = DistributedDataParallel(tpd.keep_material_per_rank(Policy(sim)))
    """
    kept = {*getattr(module, "_ddp_params_and_buffers_to_ignore", ()), *names_per_rank(module)}
    DistributedDataParallel._set_params_and_buffers_to_ignore_for_model(module, sorted(kept))
    return module


def names_per_rank(module: nn.Module) -> list[str]:
    """Names of parameters and buffers of simulators in `module` that belong to one rank."""
    found = []
    for path, sim in module.named_modules():
        if isinstance(sim, Stepper):
            names = [name for name, _ in sim.named_buffers()]
            names += [name for name, array in sim.named_parameters() if not _is_shared(name, array)]
            found += [f"{path}.{name}" for name in names]
            # DistributedDataParallel names gradients of the root module ".name"
            found += names if not path else []
    return found


def _is_shared(name: str, array: nn.Parameter) -> bool:
    """Whether all environments of all ranks train the array together."""
    row = MATERIAL_ROWS.get(name.removeprefix("parametrizations.").split(".")[0])
    return array.requires_grad and (row is None or array.dim() <= row.dims)


def _refuse_to_overwrite(parent: nn.Module, _name: str, child: nn.Module | None) -> None:
    """Hook of torch for submodules; wrappers register theirs before they copy parameters."""
    if not isinstance(parent, DistributedDataParallel) or child is None:
        return
    left = sorted({n.removeprefix(".") for n in names_per_rank(child) if n not in parent.parameters_to_ignore})
    if left:
        raise ValueError(
            "DistributedDataParallel would replace the simulator's material on every rank by rank 0's: "
            f"{', '.join(left)}; wrap torchpd.keep_material_per_rank(module), called after requires_grad_ and "
            "set_material, or leave the simulator out of the module"
        )


register_module_module_registration_hook(_refuse_to_overwrite)
