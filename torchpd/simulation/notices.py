"""Warnings about probable mistakes, once each: overlapping bodies, starts inside a contact, inverted elements.

The checks are cheap on a CPU. They do not run on a GPU, where they would synchronise, nor under tracing or vmap. Copies
of a simulator, of which studies make many, do not warn.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..common.tables import PLANES, SPHERES
from ..common.warn import SceneWarning, warn_user
from ..geometry.overlaps import Overlap, boxes_meet, find_overlaps
from ..plan.material import CORE_ROWS
from ..scene.contact import Collider, Member, placed
from ..scene.effects import Solid
from ..scene.part import Body
from ..scene.scene import Scene
from ..scene.tie import Tie
from .state import HistoryState, State

__all__ = ["Notices", "warn_of_scene"]

Array = NDArray[np.float64]

_ROUNDINGS = 10.0  # machine epsilons of a position that a contact may be violated by
_PLANES, _SPHERES, _GRAVITY = (CORE_ROWS.index(name) for name in ("planes", "spheres", "gravity"))
_ALONE = "bodies do not collide without Contact: add Contact() to the scene, or move them apart"
_NESTED = "one lies inside the other, where Contact keeps it: move them apart"
_INVERTED, _MISSING = 6, 8  # columns of the rows of a report


def warn_of_scene(scene: Scene, thickness: float = 0.0) -> None:
    """Warn of bodies that overlap at rest, and of surfaces that do not meet where it looks as if they did.

    `thickness`: of `Contact` [m].
    """
    _say_small_spheres(scene)
    _say_rigid(scene)
    _say_rise(scene, thickness)
    _say_rest(scene)


def _say_small_spheres(scene: Scene) -> None:
    """Only vertices meet a sphere, so that edges longer than its radius may pass through it.

    Sheets and rods are looked at, and solids in a scene with `Contact`, from which one expects that surfaces meet.
    """
    met = [body for body in scene.bodies if not isinstance(body, Solid) or scene.contact is not None]
    if not (met and scene.spheres):
        return
    ends = [body.mesh.vertices[body.mesh.boundary() if isinstance(body, Solid) else body.elements] for body in met]
    longest = max(float(np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max()) for x in ends)
    radius = min(sphere.radius for sphere in scene.spheres)
    if radius < longest:
        warn_user(
            f"Simulator: a sphere of radius {radius:.3g} m may meet edges of {_kinds(met)} of up to {longest:.3g} m. "
            "Only their vertices collide with a Sphere, which passes through such edges: refine the mesh until edges "
            f"are shorter than the radius, or take Collider(torchpd.shapes.sphere({radius:.3g})) in a Contact",
            SceneWarning,
        )


def _say_rigid(scene: Scene) -> None:
    """Planes and spheres of the scene act on vertices of bodies, which colliders are not."""
    rigid = sum(collider.mass is not None for collider in scene.colliders)
    walls = [*scene.grounds, *scene.spheres]
    if rigid and walls:
        names = " and ".join(dict.fromkeys(type(wall).__name__ for wall in walls))
        warn_user(
            f"Simulator: {names} and {rigid} Collider with a mass are in one scene, and pass through each other, since "
            "planes and spheres act on vertices of bodies alone. Take a Collider without a mass as the table",
            SceneWarning,
        )


def _say_rise(scene: Scene, thickness: float) -> None:
    """Contact acts on the triangles of free-form patches."""
    rise = max((body.rise() for body in scene.bodies if _takes_part(scene, body)), default=0.0)
    if rise > thickness:
        warn_user(
            f"Simulator: patches lie up to {rise:.2g} m from their triangles, on which Contact acts, and its thickness "
            f"is {thickness:.2g} m: what is drawn may overlap or keep apart by the difference. Take more patches, or "
            "draw the triangles",
            SceneWarning,
        )


def _kinds(bodies: list[Body]) -> str:
    """Kinds of bodies, each once."""
    return ", ".join(dict.fromkeys(type(body).__name__ for body in bodies))


def _say_rest(scene: Scene) -> None:
    """Warn of solids that overlap at rest, and of what lies inside a solid in a `Contact`.

    Surfaces of `Contact` do not cross, so of two that overlap one lies inside the other. A `Tie` may mean it.
    """
    parts: list[Member] = [*scene.bodies, *scene.colliders]
    looked = {n: part for n, part in enumerate(parts) if isinstance(part, Solid) or _takes_part(scene, part)}
    if not scene.solids or len(looked) < 2:
        return
    tied = [{id(part.body), id(part.other)} for part in scene.parts if isinstance(part, Tie)]
    passing, nested = _overlaps(scene, looked, [_places(part) for part in looked.values()])
    _say_overlaps(passing, "at rest", _ALONE)
    _say_overlaps([o for o in nested if {id(parts[o.first]), id(parts[o.second])} not in tied], "at rest", _NESTED)


def _places(part: Member) -> Array:
    """Vertices [n, 3] m at rest."""
    points: Array = part.mesh.vertices
    return placed(np.tile(part.pose, (len(points), 1)), points) if isinstance(part, Collider) else points


def _overlaps(
    scene: Scene, parts: Mapping[int, Member], places: Sequence[Array]
) -> tuple[list[Overlap], list[Overlap]]:
    """Pairs of parts of which one has points inside the other: solids that do not collide, and nested ones.

    Args:
        scene: that has the parts.
        parts: by number.
        places: of their vertices [n, 3] m.
    """
    numbers = list(parts)
    solids = [part.mesh if isinstance(part, Solid) else None for part in parts.values()]
    passing, nested = [], []
    for first, second, points in find_overlaps(solids, places):
        one = Overlap(numbers[first], numbers[second], points)
        if all(_takes_part(scene, parts[number]) for number in one[:2]):
            nested.append(one)
        elif all(isinstance(parts[number], Solid) for number in one[:2]):
            passing.append(one)
    return passing, nested


def _say_overlaps(found: Sequence[Overlap], where: str, why: str) -> None:
    """Warn of pairs of parts by their numbers: all bodies, then colliders."""
    if found:
        pairs = ", ".join(f"{o.first} and {o.second} ({o.points} points of their surfaces)" for o in found[:3])
        more = f" and {len(found) - 3} pairs more" if len(found) > 3 else ""
        warn_user(f"Simulator: bodies {pairs}{more} overlap {where}, and {why}", SceneWarning)


def _may_pass(scene: Scene) -> bool:
    """Whether some solid takes no part in a `Contact`."""
    return not all(_takes_part(scene, solid) for solid in scene.solids)


def _takes_part(scene: Scene, part: Member) -> bool:
    return scene.contact is not None and scene.contact.takes(part)


class Notices:
    """Warnings that a simulator, the `owner`, has given about its scene."""

    def __init__(self, owner: object = None, scene: Scene | None = None) -> None:
        self._owner = None if owner is None else weakref.ref(owner)
        self._scene = scene
        self._said: set[str] = set()
        self._started = False
        self._reports = self._next = 0  # reports with overlapping boxes, and the next one to check

    def __deepcopy__(self, memo: dict[int, Any]) -> Notices:
        return Notices()

    def __reduce__(self) -> tuple[type[Notices], tuple[()]]:
        return Notices, ()

    def before(
        self, owner: object, state: State | HistoryState, material: list[Tensor], time_step: float, *, report: bool
    ) -> None:
        """Check the start of the first step, and of every step that reports."""
        # tested first, so that no compiled step depends on past warnings
        if torch.compiler.is_compiling() or not (report or not self._started) or "inside" in self._said:
            return
        scene = self._looked_at(owner, state[0])
        if scene is None:
            return
        planes, spheres, gravity = arrays = [material[row].detach() for row in (_PLANES, _SPHERES, _GRAVITY)]
        if any(len(a) not in (1, len(state[0])) for a, dims in zip(arrays, (3, 3, 2), strict=True) if a.dim() == dims):
            return  # the step refuses these
        self._started = True
        if not (planes.numel() or spheres.numel()):
            return
        positions = state[0].detach()
        depth = _depth(scene, positions, planes, spheres)
        if not bool((depth > 0.0).any()):
            return
        # tolerated: the fall by gravity in a step, and the rounding of resting positions
        allowed = time_step**2 * gravity.norm(dim=-1).reshape(-1, 1)
        size = torch.finfo(positions.dtype).eps * positions.abs().amax(dim=(1, 2)).unsqueeze(1)
        inside = depth > torch.maximum(allowed, _ROUNDINGS * size)
        if not bool(inside.any()):
            return
        self._said.add("inside")
        environment = int(inside.any(dim=1).nonzero()[0])
        deepest = float(depth[environment].max())
        warn_user(
            f"Simulator: {int(inside[environment].sum())} vertices of environment {environment} start a step inside a "
            f"ground or sphere, up to {deepest:.2g} m deep. The step moves them out, which gives them velocities of "
            f"about {deepest / time_step:.2g} m/s: start outside, or set the velocities after that step to 0. If a "
            "sphere moved there, give its velocity in targets too",
            SceneWarning,
        )

    def after(self, owner: object, positions: Tensor, rows: Tensor) -> None:
        """Check a step that reports: positions [B, V, 3] and rows [B, 7]."""
        scene = self._looked_at(owner, positions)
        if scene is None:
            return
        inverted = rows[:, _INVERTED]
        if "inverted" not in self._said and bool((inverted > 0).any()):
            self._said.add("inverted")
            worst, tets = int(inverted.argmax()), sum(len(solid.mesh.tets) for solid in scene.solids)
            warn_user(
                f"Simulator: {int(inverted[worst])} of {tets} tetrahedra of environment {worst} are inverted or flat "
                "at the end of a step (info.inverted). A body that is too soft for its load, or starts crushed, may "
                "stay folded, in a converged step",
                SceneWarning,
            )
        if len(scene.solids) > 1 and _may_pass(scene) and "overlap" not in self._said:
            self._look_for_overlaps(scene, positions.detach())

    def after_contact(self, owner: object, positions: Tensor, rows: Tensor) -> None:
        """Warn once of an environment whose step was taken back, by rows [B, 13]."""
        scene = None if "capacity" in self._said else self._looked_at(owner, positions)
        if scene is None:
            return
        missing = rows[:, _MISSING]
        if bool(missing.any()):
            self._said.add("capacity")
            worst, capacity = int(missing.argmax()), owner.body_contact.plan.capacity  # type: ignore[attr-defined]
            need = capacity + int(missing[worst])
            warn_user(
                f"Simulator: environment {worst} has {need} pairs of surfaces near each other in a step, more than the "
                f"{capacity} of its Contact. Its step was taken back: positions, velocities and history stay as before "
                f'(info.contact_overflow). Make the scene with Contact(capacity={2 * need}) or capacity="grow", or let '
                "fewer surfaces come near each other",
                SceneWarning,
            )

    def after_growth(self, owner: object, capacity: int) -> None:
        """Say that a step is taken again with a larger capacity."""
        warn_user(
            f"Simulator: more pairs of surfaces are near each other than the capacity of Contact, which is {capacity} "
            "from now on; the step is taken again, and so are later ones that need more. Contact(capacity=) with the "
            "last number, sim.body_contact.plan.capacity, saves these steps",
            SceneWarning,
        )

    def _look_for_overlaps(self, scene: Scene, positions: Tensor) -> None:
        """Check the first environment in which boxes overlap; at the 1st, 2nd, 4th, 8th ... such report."""
        ranges = [scene.vertex_range(solid) for solid in scene.solids]
        corners = positions.numpy()
        # [B, bodies, 3]
        lows, highs = (np.stack([end(corners[:, r], axis=1) for r in ranges], axis=1) for end in (np.min, np.max))
        meet = boxes_meet(lows, highs)
        if not meet.any():
            return
        self._reports += 1
        if self._reports < self._next:
            return
        self._next = 2 * self._reports
        environment = int(meet.argmax())
        places = corners[environment].astype(np.float64)
        solids: dict[int, Member] = {n: body for n, body in enumerate(scene.bodies) if isinstance(body, Solid)}
        passing, _ = _overlaps(scene, solids, [places[part] for part in ranges])
        if passing:
            self._said.add("overlap")
            _say_overlaps(passing, f"in environment {environment} at the end of a step", _ALONE)

    def _looked_at(self, owner: object, positions: Tensor) -> Scene | None:
        """The scene, if this state can be checked."""
        if torch.compiler.is_compiling() or type(positions) not in (Tensor, nn.Parameter):
            return None
        if positions.device.type != "cpu" or torch._C._functorch.is_functorch_wrapped_tensor(positions):
            return None
        if self._owner is None or self._owner() is not owner or self._scene is None:
            return None
        vertices = sum(len(body.mesh.vertices) for body in self._scene.bodies)
        return self._scene if positions.shape[1:] == (vertices, 3) and len(positions) else None


def _depth(scene: Scene, positions: Tensor, planes: Tensor, spheres: Tensor) -> Tensor:
    """Depth of every vertex inside contacts at the start of a step [B, V] m; 0 for pinned ones."""
    planes, spheres = (array if array.dim() == 3 else array[None] for array in (planes, spheres))
    depth = positions.new_zeros(positions.shape[:2])
    for plane in planes.unbind(1):
        normal = plane[:, None, PLANES["normal"]]
        depth = torch.maximum(depth, plane[:, PLANES["height"], None] - (positions * normal).sum(dim=-1))
    for sphere in spheres.unbind(1):
        start = (sphere[:, SPHERES["center"]] - sphere[:, SPHERES["motion"]])[:, None]
        depth = torch.maximum(depth, sphere[:, SPHERES["radius"], None] - (positions - start).norm(dim=-1))
    if scene.pins:
        depth[:, scene._pinned()] = 0.0
    return depth
