"""Contact between bodies in a simulator: its constant arrays, its step, poses of colliders, and what is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..common.checks import check_scalar
from ..ops.diagonal import named_material
from ..ops.fake_kernels import CONTACT_FRICTION, CONTACT_RIGID, CONTACT_THICKNESS
from ..plan.contact_clusters import contact_clusters
from ..plan.contact_plan import ContactPlan, contact_plan
from ..plan.contact_start import check_start
from ..plan.contact_tree import FAN_OUT
from ..scene.contact import placed
from ..scene.scene import SceneValues
from ..scene.targets import ColliderInputs
from .pair_forces import ContactSurfaces
from .state import ContactHistory, HistoryState, State, widened

__all__ = ["BodyContact"]

_ops = torch.ops.torchpd
# columns in csrc/contact/views.h
_MISSING, _PINS_HELD_BACK, _UNBALANCED, _PAIRS, _SHORTENED, _FROZEN = 1, 2, 3, 4, 6, 7
_RESIDUAL = 0  # column of the rows of a step
_CAPACITY = 2  # place among the sizes of the op
_RIGID_NUMBERS = 13  # rigid_numbers in csrc/contact/views.h: filled in by steps, of scenes with such colliders alone


class RigidBodies(NamedTuple):
    """Colliders with a mass, among all; csrc/solver/contact/rigid_motion.h says how they move."""

    is_rigid: Tensor  # [C, 1] bool
    # [C, 10] mass [kg], 0 for others, centre of mass [m] and moment of inertia about it [kg m^2], xx xy xz yy yz zz
    numbers: Tensor


@dataclass(frozen=True, eq=False)
class BodyContact:
    """The contact of a scene compiled for a precision and a device."""

    plan: ContactPlan
    arrays: list[Tensor]  # of the op, csrc/binding/contact_ops.h
    history: tuple[Tensor, Tensor, Tensor, Tensor]  # poses, keys, forces and motion of a new state, without a batch
    rigid: RigidBodies | None  # None if no collider has a mass

    @staticmethod
    def of(values: SceneValues, dtype: torch.dtype) -> BodyContact:
        """Compile the contact of a scene on the CPU; refuse rest positions that cross or touch."""
        plan = contact_plan(values)
        made = BodyContact._made(plan, dtype, torch.device("cpu"))
        check_start(plan, plan.rest, torch.finfo(dtype).eps, "Simulator: rest positions")
        return made

    def to(self, dtype: torch.dtype, device: torch.device) -> BodyContact:
        """The same elsewhere, or in another precision, whose rounding must be below the thickness."""
        return BodyContact._made(self.plan, dtype, device)

    def tensors(self) -> dict[str, Tensor]:
        """Friction and thickness of the scene, as a simulator holds them."""
        return {
            "contact_friction": self.arrays[CONTACT_FRICTION].clone(),
            "contact_thickness": self.arrays[CONTACT_THICKNESS].clone(),
        }

    def checked_friction(self, given: Any) -> Tensor:
        """What `sim.contact_friction` is set to, as a tensor: the one that is given, or a number for all pairs."""
        bodies, like = len(self.plan.friction), self.arrays[CONTACT_FRICTION]
        value = _real("contact_friction", given, like.dtype, like.device)
        if not isinstance(given, Tensor) and value.dim() == 0:
            value = value.expand(bodies, bodies).clone()
        _check_shape(value, bodies)
        if value.device.type == "meta":
            return value
        if not bool((value.detach().isfinite() & (value.detach() >= 0.0)).all()):
            low, high = value.detach().aminmax()
            raise ValueError(f"contact_friction must be finite and >= 0, got {float(low):.6g} to {float(high):.6g}")
        if value.dim() and not torch.equal(value, value.mT):
            raise ValueError(
                "contact_friction must be the same for (a, b) and (b, a), got another; give table + table.mT"
            )
        return value

    def checked_thickness(self, given: Any) -> Tensor:
        """What `sim.contact_thickness` is set to, as a tensor: the one that is given, or a number as [1]."""
        value = _real("contact_thickness", given, self.arrays[CONTACT_FRICTION].dtype, torch.device("cpu"))
        if value.numel() != 1:
            raise ValueError(
                f"contact_thickness must be one number for all surfaces, got a tensor {list(value.shape)}; set a float "
                "or a tensor []"
            )
        number = check_scalar("contact_thickness", float(value.detach()))
        if number <= 0.0:
            raise ValueError(f"contact_thickness must be positive [m], got {number}")
        return value if isinstance(given, Tensor) else value.reshape(1)

    def with_thickness(self, thickness: Tensor, values: SceneValues) -> BodyContact:
        """The same with the pairs that are closer than a checked thickness at rest. `values`: those of the scene."""
        if bool(thickness.detach() == self.arrays[CONTACT_THICKNESS]):
            return self
        assert values.contact is not None
        own = replace(values.contact, thickness=float(thickness.detach()), capacity=self.plan.capacity)
        like = self.arrays[CONTACT_FRICTION]
        return BodyContact._made(contact_plan(replace(values, contact=own)), like.dtype, like.device)

    @staticmethod
    def _made(plan: ContactPlan, dtype: torch.dtype, device: torch.device) -> BodyContact:
        plan.check_resolution(dtype)
        poses = torch.tensor(plan.poses, dtype=dtype, device=device).reshape(-1, 7)
        keys = torch.tensor(-1, device=device).expand(plan.capacity)
        forces = torch.zeros((), dtype=dtype, device=device).expand(plan.capacity, 4)
        rigid = _rigid_bodies(plan, dtype, device)
        motion = poses.new_zeros((0 if rigid is None else len(poses), 6))
        return BodyContact(plan, _arrays(plan, dtype, device), (poses, keys, forces, motion), rigid)

    def with_capacity(self, capacity: int) -> BodyContact:
        """The same with room for another number of pairs in an environment."""
        sizes = self.arrays[0].clone()
        sizes[_CAPACITY] = capacity
        poses, keys, forces, motion = self.history
        history = poses, keys[:1].expand(capacity), forces[:1].expand(capacity, 4), motion
        return replace(
            self, plan=replace(self.plan, capacity=capacity), arrays=[sizes, *self.arrays[1:]], history=history
        )

    def check_eager(self, name: str) -> None:
        """Refuse `torch.compile` and CUDA graphs where a step reads how many pairs there are."""
        if torch.compiler.is_compiling():
            where = "torch.compile"
        elif self.arrays[1].is_cuda and torch.cuda.is_current_stream_capturing():
            where = "a CUDA graph"
        else:
            return
        raise RuntimeError(
            f'{name}: Contact(capacity="grow") must step eagerly, got {where}, where no step can be taken again; give '
            f"the number, Contact(capacity={self.plan.capacity}) or more"
        )

    def step(
        self,
        state: State | HistoryState,
        forces: Tensor | None,
        given: Tensor | None,
        friction: Tensor,
        thickness: Tensor,
        inputs: ColliderInputs,
        material: list[Tensor],
        plan: list[Tensor],
        settings: dict[str, Any],
    ) -> tuple[HistoryState, Tensor]:
        """The next state, and rows [B, 13] for `Info.from_rows`.

        Args:
            state: a checked one, whose flow is in the material.
            forces: on the vertices [B, V, 3] N.
            given: first iterate, which is refused.
            friction: [], [Q, Q], [B, 1, 1] or [B, Q, Q].
            thickness: [] or [1] m, on the CPU.
            inputs: what moves colliders.
            material: in the order of the ops.
            plan: arrays of the compiled scene.
            settings: of a step, by name.
        """
        if given is not None:
            raise ValueError(
                'start must be "velocity" or "inertial" in a scene with Contact, got positions, which others may be in '
                "the way of; leave it out"
            )
        self.check_transforms(state[0], state[1], *material)
        before = widened(ContactHistory(*state[2]), self.plan.capacity)  # type: ignore[misc]
        history = [before.poses.contiguous(), before.keys.contiguous(), before.forces.detach().contiguous()]
        wanted, time_step = history[0] if inputs.poses is None else inputs.poses.contiguous(), settings["time_step"]
        arrays, motion, rigid = list(self.arrays), before.motion, self.rigid
        bodies = len(self.plan.friction)
        arrays[CONTACT_FRICTION] = _tables(friction, bodies)
        arrays[CONTACT_THICKNESS] = thickness.reshape(1)
        if rigid is not None:
            gravity = named_material(material)["gravity"]
            goal, rates, masses = _ops.free_motion(
                history[0], motion, inputs.wrenches, gravity.unsqueeze(-2), rigid.numbers, time_step=time_step
            )
            wanted = torch.where(rigid.is_rigid, goal, wanted)
            arrays[CONTACT_RIGID] = masses.flatten(0, 1)
        positions, velocities, rows, numbers, held, actual, keys, pushes, _ = _ops.contact_step(
            state[0], state[1], forces, wanted, history, material, plan, arrays, **settings
        )
        lacks = numbers[:, _MISSING : _MISSING + 1]
        missing = (lacks > 0)[..., None]
        if rigid is not None:
            after = _ops.motion_after(history[0], goal, rates, masses, actual, rigid.numbers, time_step=time_step)
            motion = torch.where(missing, motion, after)
        flow = before.flow
        if flow.shape[-2]:
            (flowed,) = _ops.next_history(positions, material, plan, time_step=time_step)
            # the step of an environment whose pairs exceed the capacity is taken back
            flow = torch.where(missing, flow, flowed)
        held_back = numbers[:, _PINS_HELD_BACK:_UNBALANCED]
        if held.shape[1]:
            held_back = torch.cat([held_back, held.double()], dim=1).amax(dim=1, keepdim=True)
        # lists that were cut know no distance
        gap = torch.where(lacks > 0, math.nan, numbers[:, :_MISSING])
        # the residual of other scenes would count forces between bodies as unbalanced
        unbalanced = numbers[:, _UNBALANCED : _UNBALANCED + 1]
        found, frozen = numbers[:, _PAIRS:_SHORTENED], numbers[:, _FROZEN : _FROZEN + 1]
        rows = torch.cat([unbalanced, rows[:, _RESIDUAL + 1 :], gap, lacks, held_back, found, frozen], dim=1)
        return HistoryState(positions, velocities, ContactHistory(actual, keys, pushes, motion, flow)), rows

    def surfaces(self, thickness: Tensor) -> ContactSurfaces:
        """What forces between surfaces are read by, with the present thickness [] or [1] m."""
        triangles, edges, _, body, collider = self.arrays[1:6]
        points, cell = self.arrays[14:16]
        return ContactSurfaces(triangles, edges, body, collider, points, cell, thickness.detach().to(points))

    @staticmethod
    def check_transforms(*given: object) -> None:
        """Refuse `torch.func.vmap` and its kin, where not traced: the op refuses them there."""
        if torch.compiler.is_compiling():
            return
        if any(isinstance(of, Tensor) and torch._C._functorch.is_functorch_wrapped_tensor(of) for of in given):
            raise RuntimeError(
                "a step with Contact must not be transformed by torch.func or vmap, got mapped arguments; "
                "put the environments in the batch of a state instead: sim.rest_state(batch)"
            )

    def check(self, state: State | HistoryState) -> None:
        """Refuse a state in which surfaces of an environment cross or touch, or whose poses are none."""
        poses = state[2][0].double().cpu().numpy()  # type: ignore[misc]
        rounding = torch.finfo(state[0].dtype).eps
        lengths = np.linalg.norm(poses[..., 3:], axis=-1)
        if not np.all(np.abs(lengths - 1.0) <= 64.0 * rounding):
            raise ValueError(
                f"history.poses must have unit quaternions (qw, qx, qy, qz), got lengths of {lengths.min():.6g} to "
                f"{lengths.max():.6g}; divide by the length"
            )
        plan = self.plan
        number = plan.collider[plan.collider >= 0]
        for environment, places in enumerate(state[0].detach().double().cpu().numpy()):
            world = placed(poses[environment][number], plan.points)
            check_start(
                plan, np.concatenate([places, world]), rounding, f"check: positions of environment {environment}"
            )


def _arrays(plan: ContactPlan, dtype: torch.dtype, device: torch.device) -> list[Tensor]:
    """Arrays of the op in their order. The first and the last, sizes and thickness, stay on the host."""

    def whole(array: Any) -> Tensor:
        return torch.tensor(np.asarray(array), dtype=torch.int32)

    def real(array: Any) -> Tensor:
        return torch.tensor(np.asarray(array), dtype=dtype)

    bodies = len(plan.self_contact)
    trees = [plan.vertex_tree, plan.edge_tree, plan.triangle_tree]
    clusters = contact_clusters(trees, [plan.vertices[:, None], plan.edges, plan.triangles], plan.body)
    # vertices, and those of surfaces, lie body by body
    starts = [np.searchsorted(of, np.arange(bodies + 1)) for of in (plan.body, plan.body[plan.vertices])]
    parts = np.bincount(plan.body[plan.vertices], minlength=bodies)
    can_be_free = bool(((plan.apart > 0.0) | ~plan.self_contact | (parts == 0)).all())
    sizes = whole([bodies, len(plan.poses), plan.capacity, *clusters.counts, can_be_free])
    surfaces = [plan.triangles, plan.edges, plan.vertices, plan.body, plan.collider, plan.self_contact]
    search = [clusters.leaves.reshape(-1, FAN_OUT), clusters.body, np.stack(starts)]
    rest = [plan.near.thickness, plan.shape, plan.apart]
    reals = [*rest, plan.points.reshape(-1, 3), plan.cell, plan.friction, np.zeros((0, _RIGID_NUMBERS))]
    keys = torch.tensor(plan.near.keys, dtype=torch.int64)
    moved = [array.to(device) for array in (*map(whole, [*surfaces, *search]), keys, *map(real, reals))]
    return [sizes, *moved, real([plan.thickness])]


def _check_shape(friction: Tensor, bodies: int) -> None:
    if friction.dim() not in (0, 2, 3) or friction.shape[-2:] not in ((), (1, 1), (bodies, bodies)):
        raise ValueError(
            f"contact_friction must be [], [{bodies}, {bodies}], [B, 1, 1] or [B, {bodies}, {bodies}] of the {bodies} "
            f"bodies and colliders, got {list(friction.shape)}"
        )


def _tables(friction: Tensor, bodies: int) -> Tensor:
    """Symmetric tables [Q, Q] or [B, Q, Q], so that gradients are the same for (a, b) and (b, a)."""
    _check_shape(friction, bodies)
    if friction.dim() > 0 and friction.shape[-1] > 1:
        friction = 0.5 * (friction + friction.mT)
    tables = friction.expand(*friction.shape[:-2], bodies, bodies)
    # one environment is taken last: autograd then adds the gradients of steps as for any batch
    return (tables[0] if tables.dim() == 3 and len(tables) == 1 else tables).contiguous()


def _real(name: str, given: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A number or a tensor in this precision and on this device; what is trained must have both, and stays itself."""
    try:
        tensor = given if isinstance(given, Tensor) else torch.as_tensor(given, dtype=dtype)
        value = tensor.to(dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{name} must be a number or a tensor, got {given!r}") from None
    if value is not tensor and tensor.requires_grad:
        raise TypeError(
            f"{name} must be {dtype} on {device} to be trained, got {tensor.dtype} on {tensor.device}; make it so "
            "before requires_grad_(), since a converted copy would not follow the optimiser"
        )
    return value


def _rigid_bodies(plan: ContactPlan, dtype: torch.dtype, device: torch.device) -> RigidBodies | None:
    if not any(plan.rigid):
        return None
    rows = np.zeros((len(plan.rigid), 10))
    for row, one in zip(rows, plan.rigid, strict=True):
        if one is not None:
            row[:] = [one.mass, *one.center, *np.asarray(one.inertia)[np.triu_indices(3)]]
    return RigidBodies(torch.tensor(rows[:, :1] > 0.0, device=device), torch.tensor(rows, dtype=dtype, device=device))
