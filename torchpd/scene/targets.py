"""Targets of a step: pins, spheres and colliders at its end, activations, pressures and wind in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.tables import SPHERES
from .scene import Scene

__all__ = ["NO_INPUTS", "Anchors", "ColliderInputs", "Targets"]

Array = NDArray[np.float64]
Targets = Tensor | Mapping[Any, Tensor]
_LASTING = slice(SPHERES["center"].stop, SPHERES["motion"].start)  # radius and friction
_OWN_ROWS = "; sim.pin_targets has the rows of all pins, and scene.pin_range(pin) says which are its own"


def _overwrite(array: Tensor, rows: slice, value: Tensor, axis: int) -> Tensor:
    """`array` with some rows of an axis, -1 or -2, replaced; batched if either is."""
    lead = torch.broadcast_shapes(array.shape[:axis], value.shape[:axis])
    after = array.shape[axis] - rows.stop
    parts = (array.narrow(axis, 0, rows.start), value, array.narrow(axis, rows.stop, after))
    return torch.cat([part.expand(*lead, *part.shape[axis:]) for part in parts], dim=axis)


def _check_type(name: str, value: object, like: Tensor) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{name} must be a tensor of {like.dtype} on {like.device}, got {type(value).__name__}; "
            "torch.as_tensor(..., dtype=sim.dtype, device=sim.device) makes one"
        )


def _check_precision(name: str, value: Tensor, like: Tensor) -> None:
    if value.dtype != like.dtype or value.device != like.device:
        # half precision is refused even within autocast, unlike for forces
        half = "; in half precision they would be off by millimetres" if value.dtype.itemsize == 2 else ""
        raise TypeError(f"{name} must be {like.dtype} on {like.device}, got {value.dtype} on {value.device}{half}")


class ColliderInputs(NamedTuple):
    """What moves colliders in a step."""

    poses: Tensor | None  # [B, C, 7] at the end, of those without a mass; None: they stay
    wrenches: Tensor | None  # [B, C, 6] N, N m about the origin, on those with a mass; None: zero


NO_INPUTS = ColliderInputs(None, None)


class Anchors:
    """The pins, spheres, fibres, loads and colliders of a scene, keyed by `id`, which torch.compile guards."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.pins = {id(pin): scene.pin_range(pin) for pin in scene.pins}
        self.spheres = {id(sphere): number for number, sphere in enumerate(scene.spheres)}
        self.fibres = {id(part): scene.stencil_ranges(part)["fibre"] for part in scene.fibres}
        self.pressures = {id(part): number for number, part in enumerate(scene.pressures)}
        self.wind = None if scene.wind is None else id(scene.wind)
        self.colliders = {id(part): number for number, part in enumerate(scene.colliders)}
        self.pinned = sum(len(pin.vertices) for pin in scene.pins)

    def __reduce__(self) -> tuple[type[Anchors], tuple[Scene]]:
        """Rebuild from the scene, because unpickled parts have other ids."""
        return Anchors, (self.scene,)

    @property
    def contraction(self) -> Array | None:
        """Relative shortening at full activation of all fibres [N]; None without fibres."""
        parts = [part.contraction for part in self.scene.fibres]
        return np.concatenate(parts) if parts else None

    def place(
        self,
        targets: Targets,
        material: Mapping[str, Tensor],
        contraction: Tensor | None,
        *,
        batch: int,
        time_step: float,
        fix: str = "",
    ) -> dict[str, Tensor]:
        """The arrays of the material that `targets` change, by name: `pin_targets`, `spheres`, `fibre_length`.

        `contraction` [N] is that of all fibres. `fix` ends the errors about another shape or type.
        """
        placed: dict[str, Tensor] = {}
        if isinstance(targets, Tensor):
            by_part = "; one tensor is for all pins, and a pose goes as {collider: pose}" if self.colliders else ""
            placed["pin_targets"] = self._checked(
                "targets", targets, batch, [(self.pinned, 3)], material["pin_targets"], f"{by_part}{fix}"
            )
            return placed
        if not isinstance(targets, Mapping):
            raise TypeError(
                f"targets must be a tensor or a mapping from parts to tensors, got {type(targets).__name__}{fix}"
            )
        for part, value in targets.items():
            if id(part) in self.pins:
                name, rows = "pin_targets", self.pins[id(part)]
                shapes = [(rows.stop - rows.start, 3)]
                own = f"{_OWN_ROWS}{fix}"
                value = self._checked("targets of a Pin", value, batch, shapes, material[name], own)
            elif id(part) in self.spheres:
                name, number = "spheres", self.spheres[id(part)]
                rows = slice(number, number + 1)
                value = self._checked("targets of a Sphere", value, batch, [(3,), (6,)], material[name], fix)
                value = self._row(material[name], number, value.unsqueeze(-2), time_step)
            elif id(part) in self.fibres:
                name, rows = "fibre_length", self.fibres[id(part)]
                assert contraction is not None
                value = self._lengths(value, contraction[rows], batch, fix)
            elif id(part) in self.pressures or id(part) in self.colliders or id(part) == self.wind:
                continue
            else:
                raise ValueError(
                    f"targets: this {type(part).__name__} is not a Pin, Sphere, Fibres, Pressure, Wind or Collider of "
                    "the scene; parts go by identity: a pickled or loaded simulator has its own in sim.scene.pins, "
                    "sim.scene.spheres, sim.scene.fibres, sim.scene.pressures, sim.scene.wind and sim.scene.colliders"
                )
            axis = -1 if name == "fibre_length" else -2
            placed[name] = _overwrite(placed.get(name, material[name]), rows, value, axis)
        return placed

    def place_loads(
        self, targets: Targets | None, loads: Mapping[str, Tensor], *, batch: int, fix: str = ""
    ) -> dict[str, Tensor]:
        """The arrays of loads by name, `pressure` [.., n] and `wind` [.., 3], with `targets` put in."""
        placed = dict(loads)
        for part, value in targets.items() if isinstance(targets, Mapping) else ():
            if id(part) in self.pressures:
                number, pressure = self.pressures[id(part)], placed["pressure"]
                value = self._checked("targets of a Pressure", value, batch, [()], pressure, fix)
                placed["pressure"] = _overwrite(pressure, slice(number, number + 1), value.unsqueeze(-1), -1)
            elif id(part) == self.wind:
                placed["wind"] = self._checked("targets of a Wind", value, batch, [(3,)], placed["wind"], fix)
        return placed

    def place_wrenches(self, targets: Targets | None, poses: Tensor) -> Tensor | None:
        """Wrenches [B, C, 6] on colliders with a mass, from `targets`; None without one."""
        given = targets if isinstance(targets, Mapping) else {}
        pushed = {part: value for part, value in given.items() if id(part) in self.colliders and part.mass is not None}
        if not pushed:
            return None
        wrenches = poses.new_zeros((*poses.shape[:2], 6))
        for part, value in pushed.items():
            value = self._checked("targets of a Collider with a mass", value, len(poses), [(6,)], poses)
            number = self.colliders[id(part)]
            wrenches = _overwrite(wrenches, slice(number, number + 1), value.unsqueeze(-2), -2)
        return wrenches

    def place_colliders(self, targets: Targets | None, poses: Tensor) -> Tensor | None:
        """Poses of the colliders [B, C, 7] with `targets` put in, quaternions normalised; None without a target."""
        given = targets if isinstance(targets, Mapping) else {}
        moved = {part: value for part, value in given.items() if id(part) in self.colliders and part.mass is None}
        for part, value in moved.items():
            value = self._checked("targets of a Collider", value, len(poses), [(7,)], poses)
            length = value[..., 3:].norm(dim=-1, keepdim=True)
            # a GPU would have to wait for the values, and a traced step has none
            read = value.device.type == "cpu" and not torch.compiler.is_compiling()
            good = ((length > 0.0) & value.isfinite()).all(dim=-1) if read else None
            if good is not None and not bool(good.all()):
                worst = int(good.reshape(-1).long().argmin())
                where = f" in environment {worst}" if value.dim() > 1 else ""
                raise ValueError(
                    "targets of a Collider must be finite poses (x, y, z, qw, qx, qy, qz) whose quaternion is not "
                    f"zero, got {value.reshape(-1, 7)[worst].tolist()}{where}; (1, 0, 0, 0) turns nothing"
                )
            number = self.colliders[id(part)]
            pose = torch.cat([value[..., :3], value[..., 3:] / length], dim=-1).unsqueeze(-2)
            poses = _overwrite(poses, slice(number, number + 1), pose, -2)
        return poses if moved else None

    def _lengths(self, activation: Tensor, contraction: Tensor, batch: int, fix: str) -> Tensor:
        """Stretches without tension [n] or [.., n] of fibres: 1 - contraction activation, at least 0."""
        name, count = "targets of Fibres", len(contraction)
        _check_type(name, activation, contraction)
        _check_precision(name, activation, contraction)
        came = tuple(activation.shape)
        if came == (batch,) and batch not in (1, count):
            activation = activation.unsqueeze(-1)
        elif came == (batch,) and batch > 1:
            raise ValueError(
                f"{name}: [{batch}] may be an activation for each of {batch} fibres or of {batch} environments; give "
                f"[1, {count}] or [{batch}, 1]"
            )
        elif not (len(came) <= 2 and came[-1:] in ((), (1,), (count,)) and came[:-1] in ((), (1,), (batch,))):
            raise ValueError(
                f"{name} must be an activation [], [{count}], [{batch}] or [{batch}, {count}] (fibres of the part: "
                f"{count}, environments: {batch}), got {list(came)}{fix}"
            )
        # a negative length would have no majoriser
        return (1.0 - contraction * activation).clamp(min=0.0)

    def _checked(
        self, name: str, value: Tensor, batch: int, shapes: Sequence[tuple[int, ...]], like: Tensor, fix: str = ""
    ) -> Tensor:
        _check_type(name, value, like)
        came = tuple(value.shape)
        if not any(came in (shape, (1, *shape), (batch, *shape)) for shape in shapes):
            wanted = " or ".join(str(list(shape)) for shape in shapes)
            raise ValueError(
                f"{name} must be {wanted}, or that with a batch of {batch} in front, got {list(value.shape)}{fix}"
            )
        _check_precision(name, value, like)
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
