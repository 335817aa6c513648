"""Rolling contact in the reference: a component tips or rolls on one plane about one vertex or the line through two.

The contact force must point outward, lie within the friction cone, and act between the two vertices. Lines of more than
two vertices bend, and their slips differ: motions within that uncertainty are left to the iterations. A converged
component therefore does not move.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .rigid_piece import (
    FRICTION,
    HEIGHT,
    LYING,
    NORMAL,
    RigidComponent,
    axis_of,
    fraction_of,
    rotation_about,
    turn_about,
)

__all__ = ["RollingContact"]

Array = NDArray[np.float64]

TOUCHING = 1e-3  # depth, over the reach of the plane, to which vertices may sink before they are lifted out
ROUNDED = 0.1  # the same for the vertices it rolls about
RESTING = 0.5  # squared offset of the centre of pressure, over the second moment of the vertices on the plane
ROUNDS = 8  # searches for the vertices it rolls about
IN_LINE = 1e-6  # offset of one vertex at which three count as collinear, relative to their distance
ALIKE = 0.02  # distance of two slip directions that count as one
NEAR = 1e-3  # offset of the pressure from the rolling axis, relative to the extent of the vertices on the plane
DOUBT = 2.0  # uncertainty of friction, over the difference of the slip directions at two vertices
NEWTON = 8  # Newton steps to a balance of torques
ONWARD = 0.9  # least cosine between a slip before and after
UPHILL = 1e-9  # rounding allowance of the energy, relative to that of the displacement


class RollingContact:
    """A component that tips or rolls on one plane, about one vertex or the line through two.

    The vertices stick, or continue to slide in their slip direction. The contact force must point outward, lie within
    the friction cone, and act between the two vertices. An iteration finds them: the vertex that would go deepest
    joins; of three, the two remain beyond whose line the centre of pressure lies.
    """

    def __init__(self, component: RigidComponent, plane: Array) -> None:
        self.component, self.normal, self.friction = component, plane[NORMAL], float(plane[FRICTION])
        self.gap = component.y @ self.normal - float(plane[HEIGHT])
        self.reach = -LYING * float(component.target_offset @ self.normal)
        self.lies, self.slips = self.gap < self.reach, component.slips(self.normal)
        self.free_slips, self.pressure, self.near = self.slips, component.centroid, 0.0  # of a motion

    def motion(self, free: Array) -> Array | None:
        """Displacement [n, 3] m of every vertex (`free` ignores contacts); None if the component does not tip."""
        component, n = self.component, self.normal
        if not (self.reach > 0.0 and self.lies.any()):
            return None
        way = free - component.y
        self.free_slips = self.slips + way - np.outer(way @ n, n)
        lying = component.y[self.lies]
        centroid = lying.mean(axis=0)
        away = self.centre_of_pressure(component.y, centroid)
        spread = (lying - centroid).T @ (lying - centroid) / len(lying)
        self.near = NEAR * float(np.sqrt(np.trace(spread)))
        least = 1e-8 * component.gyration_squared
        line = np.linalg.eigvalsh(spread)[1] <= least
        if not (line or away @ np.linalg.solve(spread + least * np.eye(3), away) > RESTING):
            return None
        on = [int(np.where(self.lies, component.y @ away, -np.inf).argmax())]
        self.pressure = centroid + away
        share = 1.0
        for _ in range(ROUNDS - 1):
            moved, pushes, holds = self.roll_about(on, share)
            worst, depth, left = self.deepest(moved, self.drop(on))
            if depth >= -(ROUNDED if worst in on else TOUCHING) * self.reach:
                way = np.asarray(moved - component.y + max(0.0, -depth) * n)
                # a first iterate may be unbalanced
                lowers = component.first and pushes and component.energy_change(way) < 0.0
                if not lowers and (not holds or self.adds_energy(on, way)):
                    return None
                component.meets_contact = share < 1.0
                return way
            if left >= self.reach:
                share *= left / (left - depth)
                continue
            if not self.gap[worst] - self.drop(on) < self.reach or worst in on:
                return None
            if len(on) == 1:
                on.append(worst)
            else:
                pair = self.pair_of([*on, worst])
                if pair is None or set(pair) == set(on):
                    return None
                on = pair
        return None

    def adds_energy(self, on: list[int], way: Array) -> bool:
        """Return whether a motion [n, 3] adds more energy than it saves friction; torque balances may lie uphill."""
        component, n = self.component, self.normal
        slips, (first, line, _) = self.slips[on], self.line(on)
        after = slips + way[on] - np.outer(way[on] @ n, n)
        further = np.linalg.norm(after, axis=1) - np.linalg.norm(slips, axis=1)
        within = min(max(float((self.pressure - first) @ line) / max(float(line @ line), 1e-300), 0.0), 1.0)
        slid = (1.0 - within) * further[0] + within * further[-1]
        rub = self.friction * self.push(component.y + way) * float(slid)
        fall = component.target_offset
        return component.energy_change(way) + rub > UPHILL * float(component.weight.sum()) * float(fall @ fall)

    def deepest(self, moved: Array, drop: float) -> tuple[int, float, float]:
        """The vertex that stops a motion first, its added depth [m], and its gap [m] after a drop.

        Vertices that lie on a contact after the drop (gap below `reach`) come first, the deepest of them leading. Then
        come the vertices that reach a contact after the least fraction of the motion.
        """
        component, reach = self.component, self.reach
        planes, none = component.planes, component.planes[:0]
        each = [
            (component.y @ plane[NORMAL] - plane[HEIGHT], moved @ plane[NORMAL] - plane[HEIGHT]) for plane in planes
        ]
        each.append((component.gaps(component.y, none), component.gaps(moved, none)))
        before, after = (np.stack(part) for part in zip(*each, strict=True))
        depths = after - np.minimum(before, 0.0)
        left = before - drop * np.append(planes[:, NORMAL] @ self.normal, 0.0)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(np.isfinite(left), left / (left - depths), 1.0)
        order = depths / reach
        order = np.where((left < reach) & (depths < -ROUNDED * reach), order - 3.0, order)
        order = np.where((left >= reach) & (depths < -TOUCHING * reach), share - 2.0, order)
        contact, worst = np.unravel_index(int(order.argmin()), depths.shape)
        return int(worst), float(depths[contact, worst]), float(left[contact, worst])

    def drop(self, on: list[int]) -> float:
        """Height [m] of the given vertices above the plane."""
        return float(self.gap[on].min())

    def centre_of_pressure(self, moved: Array, about: Array) -> Array:
        """Offset [3] m of the centre of pressure from a point of the plane that would hold the component at `moved`."""
        force = self.component.weight * (moved - self.component.z)
        torque = np.cross(moved - about, force).sum(axis=0)
        return np.asarray(np.cross(self.normal, torque) / (force.sum(axis=0) @ self.normal))

    def pair_of(self, three: list[int]) -> list[int] | None:
        """Two of three vertices: those beyond whose line the centre of pressure lies, on the side away from the third.

        For three in a line, the two ends.
        """
        best, pair = 0.0, None
        for i in range(3):
            a, b, c = (self.component.y[three[(i + j) % 3]] for j in range(3))
            outward = np.cross(self.normal, b - a)
            side, length = float((c - a) @ outward), float(np.linalg.norm(outward))
            own = -np.sign(side) * float((self.pressure - a) @ outward) / length
            if abs(side) <= IN_LINE * length**2:
                own = length
            if own > best:
                best, pair = own, [three[i], three[(i + 1) % 3]]
        return pair

    def roll_about(self, on: list[int], share: float) -> tuple[Array, bool, bool]:
        """Positions [n, 3] m after rolling about these vertices by the fraction `share`.

        Also returns whether the contact pushes, and whether a contact can supply its force.
        """
        if self.friction == 0.0:
            slid = self.sliding(on, share, np.zeros(3))
            return (self.component.y, False, False) if slid is None else slid
        stuck = self.sticking(on, share)
        direction, apart = self.slip_direction(on)
        if stuck[2] or apart > ALIKE:
            return stuck
        if self.friction_balances(on, direction, apart):
            moved, end = self.pivot(on, share, np.zeros(3))
            push = self.push(moved)
            return moved, push > 0.0, push > 0.0 and self.between(on, end, push)
        slid = self.sliding(on, share, direction)
        return slid if slid is not None and slid[2] else stuck

    def slip_direction(self, on: list[int]) -> tuple[Array, float]:
        """The slip direction of the vertices, and the distance between their directions: inf if unknown.

        Before the first iteration nothing has slipped: friction then acts against the slip of the free motion.
        """
        slips = self.slips[on]
        if self.component.first and not (np.linalg.norm(slips, axis=1) > self.reach).all():
            slips = self.free_slips[on]
        lengths = np.linalg.norm(slips, axis=1)
        if not (lengths > self.reach).all():
            return np.zeros(3), np.inf
        directions = slips / lengths[:, None]
        return directions[0], float(np.linalg.norm(directions[0] - directions[-1]))

    def pivot(self, on: list[int], share: float, back: Array) -> tuple[Array, Array]:
        """Roll about the vertices, on the plane and moved by -`back`: positions at `share` of the turn and after it."""
        first, _, axis = self.line(on)
        goal = first - back - self.drop(on) * self.normal
        covariance, turn = self.component.covariance_about(goal, first), np.eye(3)
        if self.rolls(on):
            turn = self.component.nearest_rotation(covariance) if axis is None else turn_about(axis, covariance)
        arms = self.component.y - first
        return arms @ fraction_of(turn, share).T + goal, arms @ turn.T + goal

    def push(self, moved: Array) -> float:
        """Normal force [N] of the contact that would hold the component at `moved`."""
        return float((self.component.weight * (moved - self.component.z)).sum(axis=0) @ self.normal)

    def sticking(self, on: list[int], share: float) -> tuple[Array, bool, bool]:
        """Roll with sticking vertices: friction undoes their slip within its cone."""
        slips = self.slips[on]
        moved, end = self.pivot(on, share, self.least_slip(slips))
        force, push = (self.component.weight * (moved - self.component.z)).sum(axis=0), self.push(moved)
        holds = bool(push > 0.0 and np.linalg.norm(force - push * self.normal) <= self.friction * push)
        holds = holds and bool(np.linalg.norm(slips[0] - slips[-1]) <= self.reach)
        return moved, push > 0.0, holds and self.between(on, end, push)

    def least_slip(self, slips: Array) -> Array:
        """The least slip between the slips of two vertices; zero if they differ by as much."""
        way = slips[-1] - slips[0]
        share = -float(slips[0] @ way) / max(float(way @ way), 1e-300)
        least = np.asarray(slips[0] + min(max(share, 0.0), 1.0) * way)
        return least if np.linalg.norm(least) > np.linalg.norm(way) else np.zeros(3)

    def sliding(self, on: list[int], share: float, direction: Array) -> tuple[Array, bool, bool] | None:
        """Roll with vertices that slide along `direction` (against friction, if any); None without a torque balance."""
        component, n = self.component, self.normal
        first, _, axis = self.line(on)
        arm, drop = first - component.centroid, self.drop(on)
        turn = self.sliding_turn(arm, axis, n - self.friction * direction, drop, self.rolls(on))
        if turn is None:
            return None
        moved = self.slid(turn, arm, direction, drop)
        push = self.push(moved)
        holds = push > 0.0 and self.between(on, moved, push)
        if self.friction > 0.0:
            after = self.slips[on[0]] + moved[on[0]] - first
            after -= (after @ n) * n
            holds = holds and after @ direction > ONWARD * np.linalg.norm(after)
        if share < 1.0:
            # fractions of the rolling and of the yaw separately: the line of two vertices stays level
            yaw = np.eye(3) if axis is None else turn_about(n, np.outer(turn @ axis, axis))
            moved = self.slid(fraction_of(yaw, share) @ fraction_of(yaw.T @ turn, share), arm, direction, drop)
        return moved, push > 0.0, bool(holds)

    def line(self, on: list[int]) -> tuple[Array, Array, Array | None]:
        """The first vertex, the vector to the second, and its direction (None for one vertex)."""
        first = self.component.y[on[0]]
        way = np.asarray(self.component.y[on[-1]] - first)
        return first, way, way / np.linalg.norm(way) if len(on) == 2 else None

    def between(self, on: list[int], moved: Array, push: float) -> bool:
        """Return whether the centre of the force `push` at `moved` lies between the two vertices of a line."""
        _, way, axis = self.line(on)
        if axis is None:
            return True
        torque = np.cross(moved - moved[on[0]], self.component.weight * (moved - self.component.z)).sum(axis=0)
        along, length = float(np.cross(self.normal, torque) @ axis) / push, float(np.linalg.norm(way))
        return -1e-6 * length <= along <= (1.0 + 1e-6) * length

    def off(self, on: list[int]) -> Array:
        """Offset [3] m of the centre of pressure of the unmoved component from its rolling axis."""
        first, _, axis = self.line(on)
        if axis is None:
            return np.asarray(self.pressure - first)
        across = np.cross(self.normal, axis)
        return np.asarray((across @ (self.pressure - first)) * across)

    def rolls(self, on: list[int]) -> bool:
        """Return whether the component must roll: the centre of pressure lies outside all vertices that touch."""
        off = self.off(on)
        touching = self.component.y[self.gap - self.drop(on) < TOUCHING * self.reach] - self.component.y[on[0]]
        return bool(off @ off > self.near**2 or (touching @ off).max() < off @ off)

    def friction_balances(self, on: list[int], direction: Array, apart: float) -> bool:
        """Return whether friction balances the unmoved component, within the uncertainty of the slip directions."""
        off, (_, way, _) = self.off(on), self.line(on)
        pushes = self.component.weight * (self.component.y - self.component.z)
        force, torque = pushes.sum(axis=0), np.cross(self.component.y - self.pressure, pushes).sum(axis=0)
        push = float(force @ self.normal)
        left = force - push * (self.normal - self.friction * direction)
        doubt = DOUBT * apart * self.friction * push
        known = np.linalg.norm(left) <= doubt and abs(float(torque @ self.normal)) <= doubt * np.linalg.norm(way)
        return bool(known and off @ off <= self.near**2)

    def slid(self, turn: Array, arm: Array, direction: Array, drop: float) -> Array:
        """Positions [n, 3] m after the rotation, with friction; `drop` lowers the vertex at `arm` from the centroid."""
        component = self.component
        lift = float(self.normal @ (arm - turn @ arm - component.target_offset)) - drop
        shift = component.target_offset + lift * (self.normal - self.friction * direction)
        return np.asarray((component.y - component.centroid) @ turn.T + component.centroid + shift)

    def sliding_turn(self, arm: Array, axis: Array | None, force: Array, drop: float, rolls: bool) -> Array | None:
        """The rotation that balances torques for a contact force along `force` (Newton's method); None if it fails."""
        component, n, turn = self.component, self.normal, np.eye(3)
        weight = float(component.weight.sum())
        for _ in range(NEWTON):
            at = turn @ arm
            product = component.covariance @ turn.T
            lift = weight * (float(n @ (arm - at - component.target_offset)) - drop)
            torque = axis_of(product) + lift * np.cross(at, force)
            slope = np.trace(product) * np.eye(3) - product.T
            slope += weight * np.outer(np.cross(at, force), np.cross(at, n))
            slope += lift * ((at @ force) * np.eye(3) - np.outer(at, force))
            if not rolls:
                yaw = float(force @ torque / (force @ slope @ n))
                turn = rotation_about(yaw * n) @ turn
                size = abs(yaw)
            elif axis is None:
                step = np.linalg.solve(slope, torque)
                turn = rotation_about(step) @ turn
                size = float(np.linalg.norm(step))
            else:
                # friction acts at the centre of pressure, so its torque across n x line and force is unknown
                line = turn @ axis
                basis, tests = np.stack([line, n], axis=1), np.stack([line, force])
                slopes = tests @ slope @ basis
                slopes[0, 1] -= np.cross(n, line) @ torque
                roll, yaw = np.linalg.solve(slopes, tests @ torque)
                turn = rotation_about(yaw * n) @ rotation_about(roll * line) @ turn
                size = float(np.hypot(roll, yaw))
            if size < 1e-14:
                break
        return turn if size < 1e-9 else None
