"""One step of bodies in contact: guarded Chebyshev, contact as one more prox, and the promise of no crossing.

    approach: whole bodies to x_t + h v, or as far as they come; search; x_0
    x' = x_{k-1} + omega (x_k - theta g / D - x_{k-1})            as without contact: D knows nothing of it
    x' = prox of the pairs, then planes and spheres of the scene; what moves by hand goes to its target
    x_{k+1} = limit(x')        planes of pairs that x' violates are made anew at x_k before
    a search at x_k precedes where x' leaves a ball; while any pair has a force, five iterations after the last one

Every iterate, and every straight way between two of them, is free of crossings, however few the iterations. Every
fourth iteration the guard compares E + psi with that of the last check. psi is the augmented Lagrangian by the list and
the multipliers of now, on both sides. A coarse correction of bodies in contact will come after the guard, before the
prox: its pushes go through planes and limit like any x', x_{k-1} shifts alike, and the guard forgets the last check.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...common.tables import PLANES, SPHERES
from ..coarse import correct, islands
from ..envelopes import pushes_of
from ..geometry import sphere_normals
from ..pair_step import pair_envelopes
from ..problem import StepProblem, step_problem
from ..schedules import Guarded
from ..solvers import guard_tolerance
from .approach import approach
from .coarse import RigidWay, changed_forces, pairs_between, share_of
from .distance import Closest
from .hands import Hands
from .limit import Walls, into_balls, limit
from .lists import Contacts, found
from .prox import Multipliers, augmented_lagrangian, forces, prox, slips
from .scene import ContactHistory, ContactScene
from .thin import ThinMotions

__all__ = ["ContactStep", "contact_step"]

Array = NDArray[np.float64]

CHECK = 4  # iterations between checks of the guard
PAUSE = 5  # least iterations between searches: a guard that every search blinds would never see a rise
SWEEPS = 8  # with 4 an edge that lies on an edge cycles
PASSES = 64  # of a coarse correction; most of them take 5 to 30
TRIALS = 4  # of a coarse correction whose motions are cut
FIRST = 8  # iterations before the first coarse correction between; then their number doubles


@dataclass(frozen=True)
class ContactStep:
    """The state after a step, and what happened in it."""

    positions: Tensor  # [V, 3] m of deformable bodies
    velocities: Tensor  # [V, 3] m/s
    history: ContactHistory
    gap: float  # least d / r of the pairs at the end; inf without pairs
    held_back: Tensor  # [C] m, of the colliders
    pins_held_back: float  # m
    contacts: Contacts  # the last list
    forces: Tensor  # [N, 3] N of contact on every vertex, pairwise equal and opposite
    pairs: int  # most pairs in a list
    searches: int
    frozen: int  # vertices that no plane let move, summed over iterations
    shortened: int  # vertices whose way was cut, summed over iterations
    restarts: int
    residual: float  # |g - C^T lambda| in the metric of 1 / D, over that of g at the first iterate


def contact_step(
    scene: ContactScene,
    positions: Tensor,
    velocities: Tensor,
    time_step: float,
    *,
    iterations: int = 64,
    history: ContactHistory | None = None,
    poses: Tensor | None = None,
    pin_targets: Array | None = None,
    relaxation: float = 1.9,
    observe: Callable[[int, Tensor], None] | None = None,
) -> ContactStep:
    """One step of length h.

    Args:
        scene: bodies and colliders.
        positions: [V, 3] m of the deformable bodies, free of crossings.
        velocities: [V, 3] m/s.
        time_step: h [s].
        iterations: K.
        history: of the last step; None starts cold, with colliders where the scene has them.
        poses: [C, 7] of the colliders at the step's end; None: where they are.
        pin_targets: [P, 3] m; None: those of the scene.
        relaxation: theta.
        observe: called with k and the places [N, 3] m of all vertices of every iterate x_0 .. x_K.
    """
    start = _places(scene, positions, history)
    if history is None or not torch.equal(history.positions, start):
        scene.check_start(start)
    values = scene.values
    problem = step_problem(values, _array(positions), _array(velocities), time_step, pin_targets=pin_targets)
    run = _Run(scene, problem, start, history, scene.poses if poses is None else poses, relaxation)
    run.start()
    if observe is not None:
        observe(0, run.current)
    for k in range(iterations):
        if k >= FIRST and k & (k - 1) == 0 and iterations - k > 2:
            run.correct()
        run.iterate(k)
        if observe is not None:
            observe(k + 1, run.current)
    run.correct(alone=True)
    if observe is not None:
        observe(iterations + 1, run.current)
    return run.result()


def _array(tensor: Tensor) -> Array:
    return np.asarray(tensor.double().numpy(), np.float64)


def _places(scene: ContactScene, positions: Tensor, history: ContactHistory | None) -> Tensor:
    poses = scene.poses if history is None else history.poses
    return torch.cat([positions, scene.collider_places(poses)])


class _Run:
    """The state of the iterations of one step."""

    def __init__(
        self,
        scene: ContactScene,
        problem: StepProblem,
        start: Tensor,
        history: ContactHistory | None,
        poses: Tensor,
        relaxation: float,
    ) -> None:
        surfaces, dtype = scene.surfaces, start.dtype
        self.scene, self.problem, self.relaxation = scene, problem, relaxation
        radius = min(0.99999, 1.0 - relaxation * problem.smallest_ratio)
        self.schedule = Guarded(radius, guard_tolerance(problem))
        self.coming = self.schedule.omega(0)
        self.diagonal = problem.weighted_diagonal[:, None]
        self.inverse = torch.zeros(len(start), dtype=dtype)
        self.inverse[: scene.count] = torch.as_tensor(1.0 / self.diagonal[:, 0]).to(dtype)
        self.inverse[surfaces.kinematic] = 0.0
        self.begin = self.current = self.previous = start
        targets = torch.cat([self._place(problem.target), scene.collider_places(poses)])
        self.hands = Hands(scene, scene.poses if history is None else history.poses, poses, targets)
        self.keys = history.keys if history is not None else torch.zeros(0, dtype=torch.int64)
        self.known = Multipliers.none(0, dtype) if history is None else Multipliers(history.normal, history.tangential)
        self.checked: tuple[float, Tensor] | None = None  # E and places of the last check
        self.searched_at = self.searches = self.most = 0
        self.frozen = self.shortened = self.restarts = 0
        self.first_residual = 0.0
        self.shares: list[float] = []

    def _place(self, displacement: Array) -> Tensor:
        """Places [V, 3] m of displacements [V, 3] m."""
        return torch.as_tensor(self.problem.positions + displacement).to(self.begin.dtype)

    def _displacement(self, places: Tensor) -> Array:
        return _array(places[: self.scene.count]) - self.problem.positions

    def _by_hand(self, free: Tensor) -> Tensor:
        """Places [N, 3] m of bodies [V, 3] m, with what moves by hand at its targets."""
        padded = torch.cat([free, self.hands.targets[self.scene.count :]])
        return torch.where(self.scene.surfaces.kinematic[:, None], self.hands.targets, padded)

    def start(self) -> None:
        """Approach, search and x_0."""
        scene, surfaces = self.scene, self.scene.surfaces
        want = self._by_hand(self._place(self.problem.unsolved()))
        bodies = len(surfaces.self_contact) - len(self.hands.poses)
        pins = int(self.hands.group.amax()) + 1 - len(self.hands.poses)

        def groups(shares: Tensor) -> Tensor:
            return torch.cat([shares[bodies:], shares.new_zeros(max(pins, 0))])

        masses = torch.zeros_like(self.inverse)
        masses[: scene.count] = torch.tensor(scene.values.masses).to(masses.dtype)
        begun = approach(
            surfaces, self.begin, want, masses, self._walls(self.begin),
            lambda shares: self.hands.placed(self.begin, groups(shares)),
        )  # fmt: skip
        self.hands = replace(self.hands, poses=self.hands.moved(groups(begun.shares)))
        self.current = begun.positions
        self._search(want)
        # what was stopped starts where it was: nearer to x_t + h v it would only be squashed
        stopped = (begun.shares < 1.0)[surfaces.body] & ~surfaces.kinematic
        self._move(torch.where(stopped[:, None], self.current, want))
        self.correct()
        self.previous = self.current

    def _search(self, want: Tensor) -> None:
        self.contacts = found(self.scene.surfaces, self.current, want, self.keys, self.known)
        self.searches += 1
        self.most = max(self.most, len(self.contacts.pairs))

    def _walls(self, positions: Tensor) -> Walls:
        """Planes and spheres of the scene, linearised at positions [N, 3] m and no deeper than these."""
        values, dtype, count = self.problem.values, positions.dtype, self.scene.count
        normals, bounds = [], []
        for plane in values.planes:
            normal = torch.tensor(plane[PLANES["normal"]]).to(dtype)
            normals.append(normal.expand_as(positions))
            bounds.append(torch.full((len(positions),), float(plane[PLANES["height"]]), dtype=dtype))
        for center, sphere in zip(self.problem.sphere_centers, values.spheres, strict=True):
            normal = torch.as_tensor(sphere_normals(_array(positions), center)[0]).to(dtype)
            normals.append(normal)
            bounds.append(normal @ torch.tensor(center).to(dtype) + float(sphere[SPHERES["radius"]]))
        if not normals:
            return Walls(positions.new_zeros((len(positions), 0, 3)), positions.new_zeros((len(positions), 0)))
        normal, bound = torch.stack(normals, dim=1), torch.stack(bounds, dim=1)
        bound = torch.minimum(bound, (normal * positions[:, None]).sum(dim=2))
        bound[self.scene.surfaces.kinematic] = -torch.inf
        bound[count:] = -torch.inf
        return Walls(normal, bound)

    def _move(self, target: Tensor) -> None:
        """Go as near to `target` [N, 3] m as the promise allows."""
        before, contacts = self.current, self.contacts
        stuck, walls = contacts.stuck, self._walls(before)
        free = limit(target, before, contacts.spaces, contacts.balls, walls, stuck, contacts.table)
        self.hands, self.current, held = self.hands.limited(
            free.positions, before, contacts.spaces, contacts.balls, walls, stuck
        )
        mobile = ~self.scene.surfaces.kinematic
        cut = (free.shortened & mobile) | held
        self.previous = torch.where(cut[:, None], self.current, before)
        self.frozen += int((stuck & mobile).sum())
        self.shortened += int(cut.sum())

    def correct(self, *, alone: bool = False) -> None:
        """The coarse correction of bodies that pairs join; `alone`: and of all others.

        Where a motion is cut, forces grow with the gaps of now, and another one follows.
        """
        for _ in range(TRIALS):
            if not self._correct(alone=alone):
                return

    def _correct(self, *, alone: bool) -> bool:
        """One correction; whether a motion was cut."""
        scene, problem, x, contacts = self.scene, self.problem, self.current, self.contacts
        u, before = self._displacement(x), self.previous
        component = torch.full((len(x),), -1)
        component[: scene.count] = torch.tensor(problem.values.component)
        component[scene.count :] -= 1 + scene.collider[scene.count :]
        near = contacts.near(x)
        numbers, pairs = pairs_between(problem, contacts, near, x, self.begin)
        push = forces(contacts.pairs, near.weights, contacts.normals(near), contacts.held, len(x))
        gradient = np.where(problem.free[:, None], problem.gradient(u) - _array(push[: scene.count]), 0.0)
        moved = correct(
            problem, u, pushes_of(problem, u, gradient), pairs, motions=ThinMotions, push_pairs=False, passes=PASSES
        )
        rigid, swept, cut, places = moved.displacement - moved.pushes, False, False, x
        normal, tangential = contacts.held.normal.clone(), contacts.held.tangential.clone()
        pushes = torch.zeros_like(x)
        for bodies, of in islands(problem, pairs):
            own = np.concatenate(bodies)
            if not (alone or len(of)) or not (moved.displacement[own] != u[own]).any():
                continue
            motions = ThinMotions(problem, u, bodies)
            ways = [
                RigidWay.between(body, (problem.positions + u)[body], (problem.positions + rigid)[body], center)
                for body, (center, _) in zip(motions.free, motions.bases, strict=True)
            ]
            if not all(way.is_valid for way in ways):
                continue
            moving, chords = torch.zeros(len(x), dtype=torch.bool), torch.zeros_like(self.inverse)
            for way in ways:
                moving[torch.as_tensor(way.vertices)] = True
                chords[torch.as_tensor(way.vertices)] = torch.as_tensor(way.chords).to(x.dtype)
            here = places

            def after(share: float, here: Tensor = here, ways: list[RigidWay] = ways) -> Tensor:
                out = here.clone()
                for way in ways:
                    own = torch.as_tensor(way.vertices)
                    out[own] = torch.as_tensor(way.at(share)).to(x.dtype)
                return out

            share, leaves = share_of(
                scene.surfaces, component, None if swept else contacts, here, after, chords, moving
            )
            self.shares.append(share)
            swept |= leaves
            places = after(share) if share > 0.0 else here
            pushes[torch.as_tensor(own)] = share * torch.as_tensor(moved.pushes[own]).to(x.dtype)
            cut |= share < 1.0
            index = torch.as_tensor(numbers[of])
            chosen = pairs.chosen(of)
            if share < 1.0:
                at = pair_envelopes(problem, chosen, self._displacement(places))
                each = at.forces(chosen.friction * at.normal_forces())
            else:
                each = changed_forces(pair_envelopes(problem, chosen, u), moved.forces[of])
            force = torch.as_tensor(each).to(x.dtype)
            n = torch.as_tensor(chosen.normals).to(x.dtype)
            normal[index] = (force * n).sum(dim=1)
            tangential[index] = force - normal[index, None] * n
        held = Multipliers(normal.clamp(min=0.0), tangential)
        self.keys, self.known = contacts.pairs.keys, held
        self.current, self.contacts, self.checked = places, replace(contacts, held=held), None
        target = places + pushes
        target = self._by_hand(target[: scene.count])
        if len(problem.values.planes) or len(problem.values.spheres):
            target = self._by_hand(self._place(problem.project(self._displacement(target), self._displacement(places))))
        if swept:
            self._search(target)
        near = self.contacts.near(places)
        self.contacts = self.contacts.refreshed(places, places, near)
        if pushes.any():
            self.contacts = self.contacts.refreshed(places, target, near)
            self._move(target)
        self.previous = before + self.current - x
        return cut

    def iterate(self, k: int) -> None:
        """x_k to x_{k+1}."""
        x, u = self.current, self._displacement(self.current)
        energy, gradient = self.problem.evaluate(u)
        if k == 0:
            self.first_residual = self._size(gradient)
        near = self.contacts.near(x)
        normals = self.contacts.normals(near)
        omega, self.coming = self.coming, self.schedule.omega(k + 1)
        if k % CHECK == 0:
            self._check(energy, near)
        stepped = self._place(u - self.relaxation * gradient / self.diagonal)
        previous = self.previous[: self.scene.count]
        target = self._by_hand(previous + omega * (stepped - previous))
        target, held = prox(
            self.contacts.pairs, near.weights, normals, self.contacts.held, target, self.begin, self.inverse,
            self.relaxation * omega, SWEEPS,
        )  # fmt: skip
        if len(self.problem.values.planes) or len(self.problem.values.spheres):
            target = self._by_hand(self._place(self.problem.project(self._displacement(target), u)))
        self.keys, self.known = self.contacts.pairs.keys, held
        outside = bool(into_balls(self.contacts.balls, target)[1].any())
        if outside and (k - self.searched_at >= PAUSE or not bool(held.normal.any())):
            self._search(target)
            self.searched_at = k
        else:
            self.contacts = replace(self.contacts, held=held).refreshed(x, target, near)
        self._move(target)

    def _check(self, energy: float, near: Closest) -> None:
        """Restart the momentum where E + psi has risen since the last check, by the list and multipliers of now."""
        contacts = self.contacts

        def total(elastic: float, places: Tensor, at: Closest) -> float:
            slip = slips(contacts.pairs, at.weights, contacts.normals(at), places - self.begin)
            return elastic + augmented_lagrangian(
                contacts.pairs, near.weights, self.inverse, contacts.held, at.distance, slip
            )

        if self.checked is not None:
            before = total(*self.checked, contacts.near(self.checked[1]))
            if total(energy, self.current, near) > before + self.schedule.tolerance * abs(before):
                self.schedule.age = 0
                self.restarts += 1
        self.checked = energy, self.current

    def _size(self, forces: Array) -> float:
        """sqrt(sum |f|^2 / D) of forces [V, 3] N on what is free."""
        return float(np.sqrt(((forces**2) / self.diagonal)[self.problem.free].sum()))

    def result(self) -> ContactStep:
        """The state at the step's end."""
        x, contacts, count = self.current, self.contacts, self.scene.count
        near = contacts.near(x)
        push = forces(contacts.pairs, near.weights, contacts.normals(near), contacts.held, len(x))
        gradient = self.problem.gradient(self._displacement(x))
        left = self._size(gradient - _array(push[:count]))
        loaded = (contacts.held.normal > 0.0) | (contacts.held.tangential != 0.0).any(dim=1)
        own = contacts.held
        history = ContactHistory(
            x, self.hands.poses, contacts.pairs.keys[loaded], own.normal[loaded], own.tangential[loaded]
        )
        held_back, pins = self.hands.held_back(x)
        gaps = near.distance / contacts.pairs.thickness
        return ContactStep(
            positions=x[:count],
            velocities=torch.as_tensor(self._displacement(x) / self.problem.time_step).to(x.dtype),
            history=history,
            gap=float(gaps.min()) if len(gaps) else np.inf,
            held_back=held_back,
            pins_held_back=pins,
            contacts=contacts,
            forces=push,
            pairs=self.most,
            searches=self.searches,
            frozen=self.frozen,
            shortened=self.shortened,
            restarts=self.restarts,
            residual=left / self.first_residual if self.first_residual > 0.0 else 0.0,
        )
