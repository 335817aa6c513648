"""Forces of contacts, pins and ties in a step.

At a solved step the gradient g of its objective without pins equals the forces of contacts and pins [N]:

    g = m / h^2 (1 + damping h) (x' - x) - m (v / h + gravity) - forces + elastic gradient = contacts + pins.

The forces include those of pressure and wind at the start of the step.

Pins. A hard one puts g on its vertex, a soft one k (target - x'). The rest r = g - pins is left for the contacts.

Ties. One puts k (point - x') on its vertex. Being elastic, it is part of the gradient g, not of the balance.

Contacts. At most three colliders act on a vertex, those with the smallest gaps; n_k are their normals. Their normal
forces p_k minimise |r - sum_k p_k n_k|. An active contact has p_k > 0 and gap_k < 4 max(p_k, n_k . r) / D, because no
iteration without its force crosses a wider gap. D is the diagonal of the step. The factor 4 bounds relaxation times
acceleration, both below 2. Gaps of active contacts are that large only where planes meet at flat angles (see `Ground`).

Several active contacts have p_k = m_k . r, with the m_k dual to their normals, as in
csrc/solver/adjoint/contact_gradients.h. The rest t is tangential to all of them. Colliders share it in proportion to
mu_k p_k, and together take no more than that (Coulomb). So in a corner normal forces come first. The part that contacts
do not take is the residual.

Surfaces. With `Contact` the forces between surfaces are known, see torchpd/simulation/pair_forces.py. They count among
the forces of the gradient, so that pins and colliders take the rest.

Sums over vertices follow a fixed binary tree, so an environment has the same bits in every batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from ..common.by_part import ByPart
from ..common.reprs import by_sizes
from ..common.small_matrices import dot, inverse, length, product
from ..common.tables import PLANES, SPHERES
from ..ops.adjoint import AdjointCall, step_gradient
from ..ops.diagonal import named_material, pinned_vertices, step_diagonal
from ..plan.material import CORE_ROWS
from ..scene.contact import Member
from ..scene.effects import Ground, Pin, Sphere
from ..scene.part import Body
from ..scene.scene import Scene
from ..scene.tie import Tie
from .pair_forces import Met, PairForces, empty_pairs
from .stencil_readouts import forces_of_ties
from .wrenches import Loaded, Wrench, between, loaded_bodies, loaded_colliders, wrench, wrenches

__all__ = [
    "ContactForce",
    "ContactForces",
    "PinForce",
    "Reactions",
    "TieForce",
    "contact_forces",
    "reactions",
]

_SPANNED = 1e-6  # Gram determinant from which normals count as independent, as in csrc/contact/plane_sphere.h
_FASTEST = 4.0  # bound of relaxation times acceleration, both below 2
_PIN_STIFFNESS = CORE_ROWS.index("pin_stiffness")


class ContactForce(NamedTuple):
    """Force of one collider on the vertices in a step; zero where it is not active."""

    force: Tensor  # [B, V, 3] N, on the vertices: normal part and friction
    friction: Tensor  # [B, V, 3] N, its tangential part
    push: Tensor  # [B, V] N, magnitude of its normal part
    touches: Tensor  # [B, V] bool, whether it is active
    bodies: dict[Body, Wrench]  # sum and torque on each body

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch", "vertices")


class ContactForces(NamedTuple):
    """Forces of all contacts on the vertices in a step, see `Simulator.contact_forces`."""

    force: Tensor  # [B, V, 3] N, of all contacts together, on the vertices
    residual: Tensor  # [B, V, 3] N, the part that neither contacts nor pins balance; zero at a solved step
    bodies: ByPart[Member, Wrench]  # sum and torque of all contacts on each body and collider of `Contact`
    colliders: dict[Ground | Sphere, ContactForce]  # by ground and sphere; empty without any
    between: ByPart[tuple[Member, Member], Wrench]  # on the first by the second; empty without `Contact`
    on_colliders: Tensor  # [B, C, 6] N and N m, force and torque on each `Collider` about its actual origin
    pairs: PairForces  # forces between surfaces, pair by pair

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch", "vertices")


class PinForce(NamedTuple):
    """Force of one pin on its vertices."""

    force: Tensor  # [B, p, 3] N, on the vertices, in the order of `Pin.vertices`
    wrench: Wrench  # sum and torque

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch", "pinned")


class TieForce(NamedTuple):
    """Force of one tie on its vertices; the other body feels the opposite."""

    force: Tensor  # [B, n, 3] N, on the vertices, in the order of `Tie.vertices`
    wrench: Wrench  # sum and torque

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch", "tied")


class Reactions(NamedTuple):
    """Forces of all pins and ties on their vertices in a step, see `Simulator.reactions`."""

    force: Tensor  # [B, P, 3] N, on the pinned vertices, in the order of `pin_targets`
    on_vertices: Tensor  # [B, V, 3] N, the same on all vertices, zero on those without a pin
    pins: dict[Pin, PinForce]  # by pin; empty without pins
    ties: dict[Tie, TieForce]  # by tie; empty without ties

    def __repr__(self) -> str:
        return by_sizes(self, self.force, "batch", "pinned")


# ---- pins


def _pin_forces(call: AdjointCall) -> tuple[Tensor, Tensor]:
    """Forces of pins [B, P, 3], and the rest r [B, V, 3] of the gradient; exactly zero at hard pins."""
    material = named_material(call.material)
    free = list(call.material)
    free[_PIN_STIFFNESS] = torch.zeros_like(free[_PIN_STIFFNESS])
    gradient = step_gradient(replace(call, material=free))
    pins = pinned_vertices(call.plan)
    springs = material["pin_stiffness"].unsqueeze(-1)
    hard = torch.isinf(springs)
    pulled = torch.where(hard, 0.0, springs) * (material["pin_targets"] - call.after[:, pins])
    forces = torch.where(hard, gradient[:, pins], pulled)
    return forces, gradient.index_add(1, pins, -forces)


def reactions(scene: Scene, call: AdjointCall, about: Tensor | None, met: Met | None) -> Reactions:
    """Implementation of `Simulator.reactions` for a checked call; arguments as in `contact_forces`."""
    forces, _ = _pin_forces(with_pairs(call, met))
    vertices = pinned_vertices(call.plan)
    on_vertices = torch.zeros_like(call.after).index_add(1, vertices, forces)
    material = named_material(call.material)
    bodies = loaded_bodies(scene, call.after, material["masses"], about)
    pins: dict[Pin, PinForce] = {}
    for pin in scene.pins:
        rows = scene.pin_range(pin)
        own = forces[:, rows]
        pins[pin] = PinForce(own, wrench(own, call.after[:, vertices[rows]], bodies[pin.body].about))
    ties: dict[Tie, TieForce] = {}
    for tie, own in forces_of_ties(scene, call.after, material).items():
        body = bodies[tie.body]
        ties[tie] = TieForce(own, wrench(own, body.positions[:, tie.vertices.tolist()], body.about))
    return Reactions(forces, on_vertices, pins, ties)


# ---- contacts


class _Contacts(NamedTuple):
    """Normals, gaps and friction of all colliders at the vertices: grounds, then spheres."""

    normals: Tensor  # [B, K, V, 3]
    gaps: Tensor  # [B, K, V] m
    friction: Tensor  # [B, K, V]


def _contacts(call: AdjointCall) -> _Contacts:
    material = named_material(call.material)
    x = call.after[:, None]
    planes, spheres = (material[name].unsqueeze(-2) for name in ("planes", "spheres"))
    normals, offsets = planes[..., PLANES["normal"]], x - spheres[..., SPHERES["center"]]
    distances = length(offsets)
    away = offsets / torch.where(distances > 0.0, distances, 1.0).unsqueeze(-1)
    gaps = dot(normals, x) - planes[..., PLANES["height"]], distances - spheres[..., SPHERES["radius"]]
    friction = planes[..., PLANES["friction"]], spheres[..., SPHERES["friction"]]
    rows = zip((normals, away), gaps, friction, strict=True)
    parts = [(n.expand(*gap.shape, 3), gap, part.expand_as(gap)) for n, gap, part in rows]
    return _Contacts(*(torch.cat(pair, dim=1) for pair in zip(*parts, strict=True)))


def _normal_forces(normals: Tensor, force: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
    """Normal forces [B, M, V], M <= 3, of active contacts that best fit the force [B, V, 3], and the Gram determinant.

    N N^T p = N r, with a row of the identity for an inactive contact.
    """
    count = normals.shape[1]
    chosen = torch.where(active.unsqueeze(-1), normals, 0.0)
    right = dot(chosen, force[:, None])
    if count == 1:
        return right, torch.ones_like(right[:, 0])
    missing = 3 - count
    chosen = torch.nn.functional.pad(chosen, (0, 0, 0, 0, 0, missing)).movedim(1, 2)  # [B, V, 3, 3]
    idle = torch.nn.functional.pad(~active, (0, 0, 0, missing), value=True).movedim(1, 2)
    gram = product(chosen, chosen.mT) + torch.diag_embed(idle.to(force.dtype))
    a, b, c = gram.unbind(-1)
    right = torch.nn.functional.pad(right, (0, 0, 0, missing)).movedim(1, 2).unsqueeze(-1)
    return product(inverse(gram), right).squeeze(-1).movedim(2, 1)[:, :count], dot(a, torch.linalg.cross(b, c))


@torch.no_grad()
def _active(contacts: _Contacts, force: Tensor, diagonal: Tensor) -> Tensor:
    """Which contacts are active [B, M, V]: of the sets in which all push, the one with the smallest remaining force."""
    normals, gaps, _ = contacts
    count = normals.shape[1]
    best = torch.zeros_like(gaps, dtype=torch.bool)
    least = dot(force, force)
    numbers = torch.arange(count, device=force.device)[:, None]
    for size in range(1, count + 1):
        for members in combinations(range(count), size):
            mask = torch.stack([numbers == member for member in members]).any(0)
            pushes, independent = _normal_forces(normals, force, mask.expand_as(gaps))
            reach = _FASTEST * torch.maximum(pushes, dot(normals, force[:, None])) / diagonal[..., None, :]
            acts = (pushes > 0.0) & (gaps < reach)
            left = force - _sum_over_contacts(pushes.unsqueeze(-1) * normals)
            error = dot(left, left)
            better = (acts | ~mask).all(1) & (independent > _SPANNED) & (error < least)
            best = torch.where(better[:, None], mask, best)
            least = torch.where(better, error, least)
    return best


def _nearest_three(contacts: _Contacts) -> tuple[_Contacts, Tensor | None]:
    """The contacts with the smallest gaps, and their numbers [B, 3, V] if there were more than three."""
    if contacts.gaps.shape[1] <= 3:
        return contacts, None
    numbers = contacts.gaps.detach().sort(dim=1, stable=True).indices[:, :3]
    normals = contacts.normals.gather(1, numbers.unsqueeze(-1).expand(-1, -1, -1, 3))
    return _Contacts(normals, contacts.gaps.gather(1, numbers), contacts.friction.gather(1, numbers)), numbers


def _split(contacts: _Contacts, force: Tensor, diagonal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normal forces [B, K, V], friction [B, K, V, 3] and active contacts [B, K, V], by the rule of this module."""
    count = contacts.gaps.shape[1]
    near, numbers = _nearest_three(contacts)
    active = _active(near, force, diagonal)
    pushes = torch.where(active, _normal_forces(near.normals, force, active)[0], 0.0)
    tangential = force - _sum_over_contacts(pushes.unsqueeze(-1) * near.normals)
    bounds = near.friction * pushes
    bound, size = _sum_over_contacts(bounds.unsqueeze(-1)).squeeze(-1), length(tangential)
    share = torch.maximum(bound, size)
    share = bounds / torch.where(share > 0.0, share, 1.0)[:, None]
    friction = share.unsqueeze(-1) * tangential[:, None]
    if numbers is None:
        return pushes, friction, active
    of_all = pushes.new_zeros((len(force), count, force.shape[1]))
    wide = numbers.unsqueeze(-1).expand_as(friction)
    return (
        of_all.scatter(1, numbers, pushes),
        of_all.unsqueeze(-1).repeat(1, 1, 1, 3).scatter(1, wide, friction),
        torch.zeros_like(of_all, dtype=torch.bool).scatter(1, numbers, active),
    )


def _sum_over_contacts(values: Tensor) -> Tensor:
    """Sum over contacts of [B, M, V, k], one after another."""
    total = torch.zeros_like(values[:, 0])
    for one in values.unbind(1):
        total = total + one
    return total


def contact_forces(scene: Scene, call: AdjointCall, about: Tensor | None, met: Met | None) -> ContactForces:
    """Implementation of `Simulator.contact_forces` for a checked call, whose forces are without those between surfaces.

    Args:
        scene: of the simulator.
        call: the step.
        about: point of torques.
        met: what surfaces did to each other in the step; None without `Contact`.
    """
    pairs = empty_pairs(call.after) if met is None else met.pairs
    _, force = _pin_forces(with_pairs(call, met))
    bodies = loaded_bodies(scene, call.after, named_material(call.material)["masses"], about)
    total, found = _colliders(scene, call, force, bodies)
    residual = force - total
    total = total if met is None else total + pairs.on_vertices
    hands = loaded_colliders(scene, met, about)
    on_hands = {} if met is None else wrenches(met.forces, hands)
    stacked = [torch.cat([one.force, one.torque], dim=-1) for one in on_hands.values()]
    return ContactForces(
        force=total,
        residual=residual,
        bodies=ByPart([*wrenches(total, bodies).items(), *on_hands.items()]),
        colliders=found,
        between=ByPart(between(scene, met, [*bodies.items(), *hands.items()])),
        on_colliders=torch.stack(stacked, dim=1) if stacked else total.new_zeros((len(total), 0, 6)),
        pairs=pairs,
    )


def with_pairs(call: AdjointCall, met: Met | None) -> AdjointCall:
    """The step with the forces between surfaces among those that are given."""
    if met is None:
        return call
    pushes = met.pairs.on_vertices
    return replace(call, forces=pushes if call.forces is None else call.forces + pushes)


def _colliders(
    scene: Scene, call: AdjointCall, force: Tensor, bodies: dict[Body, Loaded]
) -> tuple[Tensor, dict[Ground | Sphere, ContactForce]]:
    """Forces [B, V, 3] of grounds and spheres that balance a force [B, V, 3], together and of each."""
    colliders: Sequence[Ground | Sphere] = (*scene.grounds, *scene.spheres)
    if not colliders:
        return torch.zeros_like(force), {}
    contacts = _contacts(call)
    with torch.no_grad():
        diagonal = step_diagonal(call.plan, call.material, call.time_step)[1]
    pushes, friction, active = _split(contacts, force, diagonal)
    forces = pushes.unsqueeze(-1) * contacts.normals + friction
    on_bodies = wrenches(forces, bodies)
    found = {
        part: ContactForce(
            forces[:, k],
            friction[:, k],
            pushes[:, k],
            active[:, k],
            {solid: Wrench(all_.force[:, k], all_.torque[:, k], all_.about) for solid, all_ in on_bodies.items()},
        )
        for k, part in enumerate(colliders)
    }
    return _sum_over_contacts(forces), found
