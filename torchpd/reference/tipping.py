"""How the oracle's components tip or roll on one plane: about one vertex, or the line through two.

Forces that contacts have: outward, in sum within friction's cone, between the two vertices. Lines of more than two
vertices bend, and slips along one differ: what is within that is left to the iterations, so that nothing moves once
they have converged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .rigid_piece import FRICTION, HEIGHT, LYING, NORMAL, Piece, axis_of, part_of, rotation_about, turn_about

__all__ = ["Tipping"]

Array = NDArray[np.float64]

TOUCHING = 1e-3  # of that: vertices may go so deep, and are lifted out again
ROUNDED = 0.1  # the same of those that it turns about
RESTING = 0.5  # square of how far off pressure is, by the spread of what lies on the plane
ROUNDS = 8  # searches for the vertices that it tips about
IN_LINE = 1e-6  # of three vertices, by how far one is off
ALIKE = 0.02  # directions of slips that count as one: their distance
NEAR = 1e-3  # of the spread of what lies on the plane: pressure is no further off what it turns about
DOUBT = 2.0  # of friction whose direction differs between two vertices, by that difference
NEWTON = 8  # steps to a balance of torques
ONWARD = 0.9  # least cosine between a slip before and after
UPHILL = 1e-9  # what rounding may add to the energy, of that of the way that it goes


class Tipping:
    """A component that tips or rolls on one plane, about one vertex or the line through two.

    They stick, or slide the way that they slid, and what pushes them must be a force that contacts have: outward,
    within friction's cone, and between the two. Which they are is found by turns: the vertex that would go deepest
    comes next; of three the two remain beyond whose line the pressure has its centre.
    """

    def __init__(self, piece: Piece, plane: Array) -> None:
        self.piece, self.normal, self.friction = piece, plane[NORMAL], float(plane[FRICTION])
        self.gap = piece.y @ self.normal - float(plane[HEIGHT])
        self.reach = -LYING * float(piece.lag @ self.normal)
        self.lies, self.slips = self.gap < self.reach, piece.slips(self.normal)
        self.free_slips, self.pressure, self.near = self.slips, piece.middle, 0.0  # of a motion

    def motion(self, free: Array) -> Array | None:
        """What every vertex is to be moved by [n, 3], `free` without contacts; None where it does not tip."""
        piece, n = self.piece, self.normal
        if not (self.reach > 0.0 and self.lies.any()):
            return None
        way = free - piece.y
        self.free_slips = self.slips + way - np.outer(way @ n, n)
        lying = piece.y[self.lies]
        middle = lying.mean(axis=0)
        away = self.centre_of_pressure(piece.y, middle)
        spread = (lying - middle).T @ (lying - middle) / len(lying)
        self.near = NEAR * float(np.sqrt(np.trace(spread)))
        least = 1e-8 * piece.square
        line = np.linalg.eigvalsh(spread)[1] <= least
        if not (line or away @ np.linalg.solve(spread + least * np.eye(3), away) > RESTING):
            return None
        on = [int(np.where(self.lies, piece.y @ away, -np.inf).argmax())]
        self.pressure = middle + away
        share = 1.0
        for _ in range(ROUNDS - 1):
            moved, pushes, holds = self.about(on, share)
            worst, depth, left = self.deepest(moved, self.drop(on))
            if depth >= -(ROUNDED if worst in on else TOUCHING) * self.reach:
                way = np.asarray(moved - piece.y + max(0.0, -depth) * n)
                # a first iterate may be out of balance
                lowers = piece.first and pushes and piece.gain(way) < 0.0
                if not lowers and (not holds or self.climbs(on, way)):
                    return None
                piece.comes = share < 1.0
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

    def climbs(self, on: list[int], way: Array) -> bool:
        """Whether a motion [n, 3] adds more energy than it spares friction: balances of torques may lie uphill."""
        piece, n = self.piece, self.normal
        slips, (first, line, _) = self.slips[on], self.line(on)
        after = slips + way[on] - np.outer(way[on] @ n, n)
        further = np.linalg.norm(after, axis=1) - np.linalg.norm(slips, axis=1)
        within = min(max(float((self.pressure - first) @ line) / max(float(line @ line), 1e-300), 0.0), 1.0)
        slid = (1.0 - within) * further[0] + within * further[-1]
        rub = self.friction * self.push(piece.y + way) * float(slid)
        return piece.gain(way) + rub > UPHILL * float(piece.weight.sum()) * float(piece.lag @ piece.lag)

    def deepest(self, moved: Array, drop: float) -> tuple[int, float, float]:
        """The vertex that stops a motion first, how deep it goes beyond where it was, and how far off a drop leaves it.

        Those that then lie on a contact, less than `reach` off, come first, the deepest; then those that come to it
        after the least share of the motion.
        """
        piece, reach = self.piece, self.reach
        planes, none = piece.planes, piece.planes[:0]
        each = [(piece.y @ plane[NORMAL] - plane[HEIGHT], moved @ plane[NORMAL] - plane[HEIGHT]) for plane in planes]
        each.append((piece.gaps(piece.y, none), piece.gaps(moved, none)))
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
        """How far above the plane they are."""
        return float(self.gap[on].min())

    def centre_of_pressure(self, moved: Array, about: Array) -> Array:
        """From a point of the plane [3]: where contact would have to push for the component to be at `moved`."""
        force = self.piece.weight * (moved - self.piece.z)
        torque = np.cross(moved - about, force).sum(axis=0)
        return np.asarray(np.cross(self.normal, torque) / (force.sum(axis=0) @ self.normal))

    def pair_of(self, three: list[int]) -> list[int] | None:
        """Two of three vertices: those beyond whose line the pressure has its centre, the third being on this side.

        Of three in a line the ends.
        """
        best, pair = 0.0, None
        for i in range(3):
            a, b, c = (self.piece.y[three[(i + j) % 3]] for j in range(3))
            outward = np.cross(self.normal, b - a)
            side, length = float((c - a) @ outward), float(np.linalg.norm(outward))
            own = -np.sign(side) * float((self.pressure - a) @ outward) / length
            if abs(side) <= IN_LINE * length**2:
                own = length
            if own > best:
                best, pair = own, [three[i], three[(i + 1) % 3]]
        return pair

    def about(self, on: list[int], share: float) -> tuple[Array, bool, bool]:
        """Where it goes if it turns about these vertices [n, 3], or that share of the way.

        And whether the contact pushes then; as contacts can.
        """
        if self.friction == 0.0:
            slid = self.sliding(on, share, np.zeros(3))
            return (self.piece.y, False, False) if slid is None else slid
        stuck = self.sticking(on, share)
        direction, apart = self.slide(on)
        if stuck[2] or apart > ALIKE:
            return stuck
        if self.rubs(on, direction, apart):
            moved, end = self.pivot(on, share, np.zeros(3))
            push = self.push(moved)
            return moved, push > 0.0, push > 0.0 and self.between(on, end, push)
        slid = self.sliding(on, share, direction)
        return slid if slid is not None and slid[2] else stuck

    def slide(self, on: list[int]) -> tuple[Array, float]:
        """The way that they slide, and how far apart their directions are: inf where that is not known.

        Before any iteration nothing has slid: friction acts against how they would.
        """
        slips = self.slips[on]
        if self.piece.first and not (np.linalg.norm(slips, axis=1) > self.reach).all():
            slips = self.free_slips[on]
        lengths = np.linalg.norm(slips, axis=1)
        if not (lengths > self.reach).all():
            return np.zeros(3), np.inf
        directions = slips / lengths[:, None]
        return directions[0], float(np.linalg.norm(directions[0] - directions[-1]))

    def pivot(self, on: list[int], share: float, back: Array) -> tuple[Array, Array]:
        """About them at where they are less `back`, on the plane: that share of the way, and all of it."""
        first, _, axis = self.line(on)
        goal = first - back - self.drop(on) * self.normal
        covariance, turn = self.piece.about(goal, first), np.eye(3)
        if self.rolls(on):
            turn = self.piece.nearest_rotation(covariance) if axis is None else turn_about(axis, covariance)
        arms = self.piece.y - first
        return arms @ part_of(turn, share).T + goal, arms @ turn.T + goal

    def push(self, moved: Array) -> float:
        """Of the contact, for the component to be there."""
        return float((self.piece.weight * (moved - self.piece.z)).sum(axis=0) @ self.normal)

    def sticking(self, on: list[int], share: float) -> tuple[Array, bool, bool]:
        """Friction takes back how far they slid, within its cone."""
        slips = self.slips[on]
        moved, end = self.pivot(on, share, self.least_slip(slips))
        force, push = (self.piece.weight * (moved - self.piece.z)).sum(axis=0), self.push(moved)
        holds = bool(push > 0.0 and np.linalg.norm(force - push * self.normal) <= self.friction * push)
        holds = holds and bool(np.linalg.norm(slips[0] - slips[-1]) <= self.reach)
        return moved, push > 0.0, holds and self.between(on, end, push)

    def least_slip(self, slips: Array) -> Array:
        """Of the slips between two; none if they differ by as much."""
        way = slips[-1] - slips[0]
        share = -float(slips[0] @ way) / max(float(way @ way), 1e-300)
        least = np.asarray(slips[0] + min(max(share, 0.0), 1.0) * way)
        return least if np.linalg.norm(least) > np.linalg.norm(way) else np.zeros(3)

    def sliding(self, on: list[int], share: float, direction: Array) -> tuple[Array, bool, bool] | None:
        """They go on that way and friction acts against it, or freely; None where torques find no balance."""
        piece, n = self.piece, self.normal
        first, _, axis = self.line(on)
        arm, drop = first - piece.middle, self.drop(on)
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
            # of how it rolls and of how it turns about the normal: the line of two vertices stays level
            yaw = np.eye(3) if axis is None else turn_about(n, np.outer(turn @ axis, axis))
            moved = self.slid(part_of(yaw, share) @ part_of(yaw.T @ turn, share), arm, direction, drop)
        return moved, push > 0.0, bool(holds)

    def line(self, on: list[int]) -> tuple[Array, Array, Array | None]:
        """A point, the way to the other, and its direction if there is one."""
        first = self.piece.y[on[0]]
        way = np.asarray(self.piece.y[on[-1]] - first)
        return first, way, way / np.linalg.norm(way) if len(on) == 2 else None

    def between(self, on: list[int], moved: Array, push: float) -> bool:
        """Whether that push at `moved` has its centre between the two vertices of a line."""
        _, way, axis = self.line(on)
        if axis is None:
            return True
        torque = np.cross(moved - moved[on[0]], self.piece.weight * (moved - self.piece.z)).sum(axis=0)
        along, length = float(np.cross(self.normal, torque) @ axis) / push, float(np.linalg.norm(way))
        return -1e-6 * length <= along <= (1.0 + 1e-6) * length

    def off(self, on: list[int]) -> Array:
        """How far the centre of pressure, if nothing moves, is off what it turns about [3]."""
        first, _, axis = self.line(on)
        if axis is None:
            return np.asarray(self.pressure - first)
        across = np.cross(self.normal, axis)
        return np.asarray((across @ (self.pressure - first)) * across)

    def rolls(self, on: list[int]) -> bool:
        """Whether it has to, since pressure is off all that touches there: lines of more than two vertices bend."""
        off = self.off(on)
        touching = self.piece.y[self.gap - self.drop(on) < TOUCHING * self.reach] - self.piece.y[on[0]]
        return bool(off @ off > self.near**2 or (touching @ off).max() < off @ off)

    def rubs(self, on: list[int], direction: Array, apart: float) -> bool:
        """Whether, if nothing moves, friction balances it, but for what slips that differ leave unknown of that."""
        off, (_, way, _) = self.off(on), self.line(on)
        pushes = self.piece.weight * (self.piece.y - self.piece.z)
        force, torque = pushes.sum(axis=0), np.cross(self.piece.y - self.pressure, pushes).sum(axis=0)
        push = float(force @ self.normal)
        left = force - push * (self.normal - self.friction * direction)
        doubt = DOUBT * apart * self.friction * push
        known = np.linalg.norm(left) <= doubt and abs(float(torque @ self.normal)) <= doubt * np.linalg.norm(way)
        return bool(known and off @ off <= self.near**2)

    def slid(self, turn: Array, arm: Array, direction: Array, drop: float) -> Array:
        """The component turned; the vertex at `arm` from its middle goes down by `drop`, against friction."""
        piece = self.piece
        lift = float(self.normal @ (arm - turn @ arm - piece.lag)) - drop
        shift = piece.lag + lift * (self.normal - self.friction * direction)
        return np.asarray((piece.y - piece.middle) @ turn.T + piece.middle + shift)

    def sliding_turn(self, arm: Array, axis: Array | None, force: Array, drop: float, rolls: bool) -> Array | None:
        """The turn that balances torques when contact pushes a vertex along `force`, by Newton's method."""
        piece, n, turn = self.piece, self.normal, np.eye(3)
        weight = float(piece.weight.sum())
        for _ in range(NEWTON):
            at = turn @ arm
            product = piece.covariance @ turn.T
            lift = weight * (float(n @ (arm - at - piece.lag)) - drop)
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
                # friction acts where the push has its centre: across n x line and force nothing is known of it
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
