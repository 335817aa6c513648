"""Fake kernels of the ops: shapes, types and devices of results only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from .. import _C
from ..common.tables import EFFECT_ROWS, HISTORY_ROWS, KINDS, MATERIAL_TABLE
from .diagonal import CORE_COUNT, STIFFNESS_PLACE, elastic_rows, named_material

__all__ = ["INFO_WIDTH"]

INFO_WIDTH = _C.info_numbers
CONTACT_INFO_WIDTH = 8  # contact_info_count of csrc/contact/views.h
CONTACT_MISSING = 1  # its column of pairs that the capacity lacks
# places among the arrays of contact, csrc/binding/contact_ops.h: the body of each vertex, points of colliders,
# friction, masses of colliders and thickness
CONTACT_BODY, CONTACT_LOCAL, CONTACT_FRICTION, CONTACT_RIGID, CONTACT_THICKNESS = 4, 14, 16, 17, 18


def _register_fake(name: str) -> Callable[[Callable[..., Any]], None]:
    """Register a fake kernel that refuses arguments partly on "meta".

    Torch also takes a fake kernel when one argument of several is on "meta", and would return uninitialised memory.
    """

    def register(kernel: Callable[..., Any]) -> None:
        def checked(*given: Any, **settings: Any) -> Any:
            first, *others = (leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor))
            if first.device.type != "meta" and any(other.device.type == "meta" for other in others):
                raise RuntimeError(
                    f"torchpd::{name}: arguments must be on one device, got some on {first.device} and some on "
                    '"meta", where tensors have no values'
                )
            return kernel(*given, **settings)

        torch.library.register_fake(f"torchpd::{name}", checked)

    return register


@_register_fake("step")
def _(positions: Tensor, velocities: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor, Tensor]:
    info = positions.new_empty((positions.shape[0], INFO_WIDTH), dtype=torch.float64)
    return positions.new_empty(positions.shape), positions.new_empty(velocities.shape), info


@_register_fake("step_")
def _(*_: Any, **__: Any) -> None:
    return None


@_register_fake("rollout")
def _(positions: Tensor, *_: Any, steps: int, every: int, **__: Any) -> tuple[Tensor, Tensor, Tensor]:
    shape = (steps // every, *positions.shape)
    info = positions.new_empty((*shape[:2], INFO_WIDTH), dtype=torch.float64)
    return positions.new_empty(shape), positions.new_empty(shape), info


@_register_fake("contact_step")
def _(
    positions: Tensor,
    velocities: Tensor,
    forces: Tensor | None,
    poses: Tensor,
    history: Sequence[Tensor],
    material: Sequence[Tensor],
    plan: Sequence[Tensor],
    contact: Sequence[Tensor],
    **_: Any,
) -> tuple[Tensor, ...]:
    batch, colliders = poses.shape[:2]
    info, numbers = (
        positions.new_empty((batch, width), dtype=torch.float64) for width in (INFO_WIDTH, CONTACT_INFO_WIDTH)
    )
    held_back = positions.new_empty((batch, colliders))
    state = positions.new_empty(positions.shape), positions.new_empty(velocities.shape)
    pushes = positions.new_empty((batch, len(contact[CONTACT_BODY]), 3))
    return *state, info, numbers, held_back, *(part.new_empty(part.shape) for part in history), pushes


@_register_fake("contact_step_vjp")
def _(
    grad_positions: Tensor,
    grad_velocities: Tensor,
    grad_poses: Tensor,
    after: Tensor,
    positions: Tensor,
    velocities: Tensor,
    forces: Tensor | None,
    poses: Tensor,
    history: Sequence[Tensor],
    pushes: Tensor,
    taken_back: Tensor,
    material: Sequence[Tensor],
    plan: Sequence[Tensor],
    contact: Sequence[Tensor],
    *,
    time_step: float,
    wanted: Sequence[bool] | None = None,
) -> list[Tensor]:
    state = [positions.new_empty(positions.shape) for _ in range(3)]
    moved = [poses.new_empty(poses.shape) for _ in range(2)]
    own = [positions.new_empty(contact[place].shape) for place in (CONTACT_FRICTION, CONTACT_THICKNESS, CONTACT_RIGID)]
    asked = zip(material, [True] * len(material) if wanted is None else wanted, strict=True)
    return [*state, *moved, *own, *(array.new_empty(array.shape) for array, one in asked if one)]


@_register_fake("gradient")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("hessian_product")
def _(positions: Tensor, direction: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("element_energy")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((positions.shape[0], material[STIFFNESS_PLACE].shape[-1]))


@_register_fake("element_energy_product")
def _(positions: Tensor, direction: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((positions.shape[0], material[STIFFNESS_PLACE].shape[-1]))


@_register_fake("effect_energy")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty(positions.shape[:1])


@_register_fake("lame_product")
def _(positions: Tensor, direction: Tensor | None, material: Sequence[Tensor], plan: Sequence[Tensor]) -> Tensor:
    return positions.new_empty((*positions.shape[:1], material[STIFFNESS_PLACE].shape[-1], 2))


@_register_fake("effect_products")
def _(positions: Tensor, direction: Tensor | None, material: Sequence[Tensor], plan: Sequence[Tensor]) -> list[Tensor]:
    return _fake_products(positions, material)


def _fake_products(positions: Tensor, material: Sequence[Tensor]) -> list[Tensor]:
    """Derivatives by the arrays that only some scenes have, of every environment."""
    rows = zip(EFFECT_ROWS, material[CORE_COUNT:], strict=False)
    return [positions.new_empty((len(positions), *array.shape[array.dim() - row.dims :])) for row, array in rows]


@_register_fake("damping_gradient")
def _(positions: Tensor, *_: Any, time_step: float) -> Tensor:
    return positions.new_empty(positions.shape)


@_register_fake("damping_vjp")
def _(
    positions: Tensor, start: Tensor, direction: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor], **_: Any
) -> list[Tensor]:
    by_state = [positions.new_empty(positions.shape) for _ in range(2)]
    by_stiffness = positions.new_empty((len(positions), material[STIFFNESS_PLACE].shape[-1]))
    return [*by_state, by_stiffness, *_fake_products(positions, material)]


@_register_fake("next_history")
def _(positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor], *, time_step: float) -> list[Tensor]:
    named = named_material(material)
    return [positions.new_empty((len(positions), *named[row.name].shape[-2:])) for row in HISTORY_ROWS]


@_register_fake("next_history_vjp")
def _(
    gradients: Sequence[Tensor], positions: Tensor, material: Sequence[Tensor], plan: Sequence[Tensor], **_: Any
) -> list[Tensor]:
    return [positions.new_empty(positions.shape), *_fake_products(positions, material)]


@_register_fake("elastic_diagonal")
def _(material: Sequence[Tensor], plan: Sequence[Tensor], *, weighted: bool, time_step: float = 0.0) -> Tensor:
    stiffness, (_, vertex_order, *_) = material[STIFFNESS_PLACE], plan
    own = [len(array) for row, array in elastic_rows(material) if array.dim() > row.dims]
    return stiffness.new_empty((*own[:1], vertex_order.shape[0]))


@_register_fake("stiffness_at_rest")
def _(material: Sequence[Tensor], plan: Sequence[Tensor], *, time_step: float = 0.0) -> Tensor:
    named, stiffness = named_material(material), material[STIFFNESS_PLACE]
    own = [len(array) for row, array in elastic_rows(material) if array.dim() > row.dims]
    rows = {row.name: row for row in MATERIAL_TABLE}
    counts = [
        named[name].shape[named[name].dim() - rows[name].dims]
        for name, *_ in (kind.own_rows for kind in KINDS.values() if kind.own_rows)
        if name in named
    ]
    # the material does not tell which tetrahedra have stencils
    some = any(named[name].shape[-1] > 0 for name in ("poisson", "stiffness_damping") if name in named)
    count = torch.library.get_ctx().new_dynamic_size() if some else stiffness.shape[-1] + sum(counts)
    return stiffness.new_empty((*own[:1], count))


@_register_fake("precondition")
def _(field: Tensor, plan: Sequence[Tensor]) -> Tensor:
    return field.new_empty(field.shape)


@_register_fake("adjoint_system")
def _(*step: Any, time_step: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    _, _, _, positions, _, _, material, _ = step
    batch, vertices, _ = positions.shape
    rows = list(zip(MATERIAL_TABLE[: len(material)], material, strict=True))
    touching = any(row.name in ("planes", "spheres") and array.shape[-2] > 0 for row, array in rows)
    # arrays that inertia and diagonal depend on
    own = touching or any(
        (row.effect or row.name in ("stiffness", "masses", "damping", "pin_stiffness"))
        and array.dim() > row.dims
        and len(array) != 1
        and array.shape[1:].numel() > 0
        for row, array in rows
    )
    inertia, inverse = (positions.new_empty((batch if own else 1, vertices)) for _ in range(2))
    held = batch if touching else 0
    projector = positions.new_empty((held, vertices, 3, 3))
    stuck = positions.new_empty((held, vertices), dtype=torch.bool)
    sliding = positions.new_empty((held, vertices, _C.slide_vectors, 3))
    return positions.new_empty(positions.shape), inertia, inverse, projector, stuck, sliding


@_register_fake("contact_gradients")
def _(multiplier: Tensor, *step: Any, time_step: float) -> tuple[Tensor, Tensor]:
    material = named_material(step[-2])
    planes, spheres = (
        multiplier.new_empty((len(multiplier), *material[name].shape[-2:])) for name in ("planes", "spheres")
    )
    return planes, spheres


def _fake_solve(positions: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
    return positions.new_empty(positions.shape), positions.new_empty(positions.shape[:1], dtype=torch.float64)


def _fake_fallback(solution: Tensor, *_: Any, **__: Any) -> Tensor:
    return solution.new_empty(solution.shape)


for _solve, _fallback in (("conjugate_gradients", "adjoint_fallback"), ("contact_conjugate", "contact_fallback")):
    _register_fake(_solve)(_fake_solve)
    _register_fake(_fallback)(_fake_fallback)


def _fake_vjp(*call: Any, time_step: float, wanted: Sequence[bool] | None = None) -> list[Tensor]:
    *_, positions, _, _, material, _ = call
    state = [positions.new_empty(positions.shape) for _ in range(3)]
    asked = zip(material, [True] * len(material) if wanted is None else wanted, strict=True)
    return [*state, *(array.new_empty(array.shape) for array, own in asked if own)]


for _name in ("step_vjp", "rollout_vjp"):
    _register_fake(_name)(_fake_vjp)


@_register_fake("adjoint_result")
def _(multiplier: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor, Tensor]:
    x, v, out = (multiplier.new_empty(multiplier.shape) for _ in range(3))
    return x, v, out


@_register_fake("conjugate_gradients_")
def _(*_: Any, **__: Any) -> None:
    return None


@_register_fake("nearest_rotation")
def _(matrices: Tensor) -> Tensor:
    return matrices.new_empty(matrices.shape)


@_register_fake("rotation_differential")
def _(matrices: Tensor, direction: Tensor) -> Tensor:
    return matrices.new_empty(matrices.shape)
