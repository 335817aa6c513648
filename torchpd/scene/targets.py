"""Targets of pins and spheres at the end of a step, as rows of the material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..common.tables import SPHERES
from .scene import Scene

__all__ = ["Anchors", "Targets"]

Targets = Tensor | Mapping[Any, Tensor]
_LASTING = slice(SPHERES["center"].stop, SPHERES["motion"].start)  # radius and friction


def _overwrite(array: Tensor, rows: slice, value: Tensor) -> Tensor:
    """`array` [.., n, k] with some rows replaced, batched if either is."""
    lead = torch.broadcast_shapes(array.shape[:-2], value.shape[:-2])
    parts = (array[..., : rows.start, :], value, array[..., rows.stop :, :])
    return torch.cat([part.expand(*lead, *part.shape[-2:]) for part in parts], dim=-2)


class Anchors:
    """The pins and spheres of a scene, keyed by `id`, which torch.compile guards."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.pins = {id(pin): scene.pin_range(pin) for pin in scene.pins}
        self.spheres = {id(sphere): number for number, sphere in enumerate(scene.spheres)}
        self.pinned = sum(len(pin.vertices) for pin in scene.pins)

    def __reduce__(self) -> tuple[type[Anchors], tuple[Scene]]:
        """Rebuild from the scene, because unpickled parts have other ids."""
        return Anchors, (self.scene,)

    def place(
        self, targets: Targets | None, pins: Tensor, spheres: Tensor, *, batch: int, time_step: float, fix: str = ""
    ) -> tuple[Tensor, Tensor]:
        """`pin_targets` [.., P, 3] and `spheres` [.., S, 8] with `targets` put in.

        `fix` ends the errors about another shape or type.
        """
        if targets is None:
            return pins, spheres
        if isinstance(targets, Tensor):
            return self._checked("targets", targets, batch, [(self.pinned, 3)], pins, fix), spheres
        if not isinstance(targets, Mapping):
            raise TypeError(
                f"targets must be a tensor or a mapping from parts to tensors, got {type(targets).__name__}{fix}"
            )
        for part, value in targets.items():
            if id(part) in self.pins:
                rows = self.pins[id(part)]
                value = self._checked("targets of a Pin", value, batch, [(rows.stop - rows.start, 3)], pins, fix)
                pins = _overwrite(pins, rows, value)
            elif id(part) in self.spheres:
                number = self.spheres[id(part)]
                value = self._checked("targets of a Sphere", value, batch, [(3,), (6,)], spheres, fix)
                row = self._row(spheres, number, value.unsqueeze(-2), time_step)
                spheres = _overwrite(spheres, slice(number, number + 1), row)
            else:
                raise ValueError(
                    f"targets: this {type(part).__name__} is not a Pin or Sphere of the scene; parts go by identity: "
                    "a pickled or loaded simulator has its own in sim.scene.pins and sim.scene.spheres"
                )
        return pins, spheres

    def _checked(
        self, name: str, value: Tensor, batch: int, shapes: Sequence[tuple[int, ...]], like: Tensor, fix: str = ""
    ) -> Tensor:
        if not isinstance(value, Tensor):
            raise TypeError(
                f"{name} must be a tensor of {like.dtype} on {like.device}, got {type(value).__name__}; "
                "torch.as_tensor(..., dtype=sim.dtype, device=sim.device) makes one"
            )
        came, front = tuple(value.shape), ((), (1,), (batch,))
        if not any(came[-len(shape) :] == shape and came[: -len(shape)] in front for shape in shapes):
            wanted = " or ".join(str(list(shape)) for shape in shapes)
            raise ValueError(
                f"{name} must be {wanted}, or that with a batch of {batch} in front, got {list(value.shape)}{fix}"
            )
        if value.dtype != like.dtype or value.device != like.device:
            # half precision is refused even within autocast, unlike for forces
            half = "; in half precision they would be off by millimetres" if value.dtype.itemsize == 2 else ""
            raise TypeError(f"{name} must be {like.dtype} on {like.device}, got {value.dtype} on {value.device}{half}")
        return value

    def _row(self, spheres: Tensor, number: int, value: Tensor, time_step: float) -> Tensor:
        """Row of a sphere: centre at the end of the step, radius, friction, motion during the step."""
        own = spheres[..., number : number + 1, _LASTING]
        motion = value[..., 3:] * time_step if value.shape[-1] == 6 else torch.zeros_like(value)
        lead = torch.broadcast_shapes(own.shape[:-1], value.shape[:-1])
        return torch.cat([value[..., :3].expand(*lead, 3), own.expand(*lead, 2), motion.expand(*lead, 3)], dim=-1)

    def with_velocities(
        self, targets: Mapping[Any, Tensor], before: Tensor, *, batch: int, time_step: float
    ) -> dict[Any, Tensor]:
        """`targets` with velocities added to sphere centres, from their positions `before` [.., S, 8]."""
        filled = dict(targets)
        for part, value in targets.items():
            if id(part) not in self.spheres:
                continue
            last = before[..., self.spheres[id(part)], SPHERES["center"]]
            value = self._checked("targets of a Sphere", value, batch, [(3,), (6,)], last)
            if value.shape[-1] == 3:
                velocity = (value - last) / time_step
                filled[part] = torch.cat([value.expand(velocity.shape), velocity], dim=-1)
        return filled

    @staticmethod
    def moved_on(spheres: Tensor, steps: int) -> Tensor:
        """Spheres after some steps of constant motion, summed in the order of the kernels."""
        if spheres.shape[-2] == 0:
            return spheres
        # also if none moves, because testing that would wait for a GPU
        centre = spheres[..., SPHERES["center"]]
        for _ in range(steps):
            centre = centre + spheres[..., SPHERES["motion"]]
        return torch.cat([centre, spheres[..., _LASTING.start :]], dim=-1)
