"""Rigid motions of the oracle: components go as far as pins and contacts leave them to where their energy is least.

Along them E is sum a / 2 |x + u - (x + s)|^2, a weighted fit of two sets of points (Kabsch 1976). Hard pins at a point
or along a line leave turns about that; smooth planes the turn about their normal and the way along all of them; a plane
with friction, or the edge of two planes, the way along it, shortened as by Coulomb. On one plane a component may tip
besides (`_Tipping`); one that hovers goes as far as the first plane. Other contacts leave it nothing. Where a motion
ends since the component comes to a contact, it goes on from there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .reference import StepProblem

__all__ = ["align", "begin", "gaps_of"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOLD = 8  # planes that are told apart
LYING = 0.01  # of the way that a plane stops: a vertex lies on it that is no further off
TOUCHING = 1e-3  # of that: vertices may go so deep, and are lifted out again
ROUNDED = 0.1  # the same of those that it turns about
RESTING = 0.5  # square of how far off pressure is, by the spread of what lies on the plane
LEGS = 4  # parts of a motion that contacts end one after the other
ROUNDS = 8  # searches for the vertices that it tips about
IN_LINE = 1e-6  # of three vertices, by how far one is off
ALIKE = 0.02  # directions of slips that count as one: their distance
NEWTON = 8  # steps to a balance of torques
ONWARD = 0.9  # least cosine between a slip before and after
HALF_TURN = 1e-6  # 4 cos^2(angle / 2), at most, of what counts as half a turn
SQUEEZE = 0.5  # of the most that pushes of contacts may squeeze a component by
LIFT = 6.0  # of what it costs to shift it as a whole by that push
WORTH = 0.01  # of what is left: less squeeze is no reason to give up the course


class NearestRotation(Protocol):
    def __call__(self, matrices: Array) -> Array: ...


def gaps_of(positions: Array, planes: Array, centers: Array, spheres: Array) -> Array:
    """Distance of every position to the nearest of planes and spheres [n]; inf without any."""
    gaps = np.full(len(positions), np.inf)
    for plane in planes:
        gaps = np.minimum(gaps, positions @ plane[:3] - plane[3])
    for center, sphere in zip(centers, spheres, strict=True):
        gaps = np.minimum(gaps, np.linalg.norm(positions - center, axis=1) - sphere[3])
    return gaps


def begin(problem: StepProblem, guess: Array, diagonal: Array) -> Array:
    """The first iterate [V, 3], before rigid motions: `guess` out of the contacts, or components where they are.

    Contacts push vertices out each for itself, by p, which squeezes a component by sum k / 2 |p - mean p|^2 at most,
    k = D - a. One that starts from where it is has less energy left, half of that counted, there or after rigid
    motions: a shift by how far contacts push, d, costs sum a / 2 d^2. It has no hard pins, and forces would take it
    into no other contacts than the first planes.
    """
    planes, out = problem.values.planes, problem.project(guess, guess)
    kept = problem._hold(np.zeros_like(guess))
    still, begun, there = problem.project(kept, kept), out.copy(), problem.positions + problem.target
    others = gaps_of(there, planes[TOLD:], problem.sphere_centers, problem.values.spheres) <= 0.0
    for number in range(int(problem.values.component.max()) + 1):
        of = problem.values.component == number
        a, push = problem.weight[of, None], (out - guess)[of]
        if (others | ~problem.free)[of].any():
            continue
        k = diagonal[of, None] - a
        squeeze = SQUEEZE * float((k * (push - (k * push).sum(axis=0) / max(k.sum(), 1e-300)) ** 2).sum())
        left, before = (float((a * (u - problem.target)[of] ** 2).sum()) for u in (out, still))
        pushed = float(k[push.any(axis=1)].sum())
        lift = LIFT * float(a.sum()) * float((k * push**2).sum()) / max(pushed, 1e-300)
        if squeeze > min(before - left, lift) and squeeze > WORTH * left:
            begun[of] = still[of]
    return begun


def align(
    problem: StepProblem, displacement: Array, nearest_rotation: NearestRotation, *, first: bool = False
) -> Array:
    """Displacements [V, 3] after the rigid motion of every component; `first`: before any iteration."""
    values, moved = problem.values, displacement.copy()
    for number in range(int(values.component.max()) + 1):
        of = values.component == number
        for _ in range(LEGS):
            piece = _Piece(problem, moved, of, nearest_rotation, first)
            way = np.zeros_like(moved)
            way[of] = piece.motion()
            moved = np.where(problem.free[:, None], moved + way, moved)
            if not piece.comes:
                break
    return moved


class _Piece:
    """One component, its n vertices at y = x + u, their targets z = x + s."""

    def __init__(
        self, problem: StepProblem, displacement: Array, of: Mask, nearest_rotation: NearestRotation, first: bool
    ) -> None:
        self.problem, self.nearest_rotation, self.first = problem, nearest_rotation, first
        self.planes = problem.values.planes
        self.u, self.weight = displacement[of], problem.weight[of, None]
        self.y, self.z = problem.positions[of] + self.u, problem.positions[of] + problem.target[of]
        share = self.weight / self.weight.sum()
        self.middle, self.lag = (share * self.y).sum(axis=0), (share * (self.z - self.y)).sum(axis=0)
        self.square = float((share * (self.y - self.middle) ** 2).sum())  # of its radius of gyration
        self.covariance = self.about(self.middle + self.lag, self.middle)
        self.pinned = ~problem.free[of]
        self.rest = problem.values.rest_positions[of]
        self.comes = False  # its motion ends where it comes to a contact

    def about(self, goal: Array, pivot: Array) -> Array:
        """Sum of a (z - goal) (y - pivot)^T."""
        return np.asarray((self.weight * (self.z - goal)).T @ (self.y - pivot))

    def gaps(self, positions: Array, planes: Array, *, balls: bool = True) -> Array:
        spheres = self.problem.values.spheres if balls else np.zeros((0, 5))
        return gaps_of(positions, planes, self.problem.sphere_centers[: len(spheres)], spheres)

    def left(self, moved: Array, planes: Array) -> Array:
        """Gaps after a motion. After the iterations 0 or less too where a ball could keep a vertex from that motion.

        That is with a force within the cone of its friction, if the vertex lies on it: balls curve away from what goes
        along them. One ball alone holds nothing by friction that it does not push.
        """
        after, way, spheres = self.gaps(moved, planes), moved - self.y, self.problem.values.spheres
        if self.first:
            return after
        size, several = np.linalg.norm(way, axis=1), len(self.planes) + len(spheres) > 1
        for center, sphere in zip(self.problem.sphere_centers, spheres, strict=True):
            arm = self.y - center
            length = np.linalg.norm(arm, axis=1, keepdims=True)
            normals = np.where(length > 0.0, arm / np.maximum(length, 1e-300), [0.0, 1.0, 0.0])
            across = (normals * way).sum(axis=1)
            along = np.linalg.norm(way - across[:, None] * normals, axis=1)
            rounding = 4 * np.finfo(np.float64).eps * (np.linalg.norm(self.y, axis=1) + sphere[3])
            lies = length[:, 0] - sphere[3] <= LYING * size + rounding
            after = np.where(lies, np.minimum(after, across - several * sphere[4] * along), after)
        return after

    def deepest(self, moved: Array, drop: Array, reach: float) -> tuple[int, float, float]:
        """The vertex that stops a motion first, how deep it goes beyond where it was, and how far off a drop leaves it.

        Those that then lie on a contact, less than `reach` off, come first, the deepest; then those that come to it
        after the least share of the motion.
        """
        none = self.planes[:0]
        each = [(self.y @ plane[:3] - plane[3], moved @ plane[:3] - plane[3]) for plane in self.planes]
        each.append((self.gaps(self.y, none), self.gaps(moved, none)))
        before, after = (np.stack(part) for part in zip(*each, strict=True))
        depths = after - np.minimum(before, 0.0)
        left = before + np.append(self.planes[:, :3] @ drop, 0.0)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(np.isfinite(left), left / (left - depths), 1.0)
        order = depths / reach
        order = np.where((left < reach) & (depths < -ROUNDED * reach), order - 3.0, order)
        order = np.where((left >= reach) & (depths < -TOUCHING * reach), share - 2.0, order)
        contact, worst = np.unravel_index(int(order.argmin()), depths.shape)
        return int(worst), float(depths[contact, worst]), float(left[contact, worst])

    def lowers(self, way: Array) -> bool:
        """Whether there is less energy after a motion by that [n, 3]."""
        return bool((self.weight * ((self.y + way - self.z) ** 2 - (self.y - self.z) ** 2)).sum() < 0.0)

    def motion(self) -> Array:
        """What every vertex is to be moved by [n, 3]."""
        turn, pivot, shift = self.nearest_rotation(self.covariance), self.middle, self.lag
        still = np.zeros_like(self.u)
        if self.pinned.any():
            at_rest, at = self.rest[self.pinned], self.y[self.pinned]
            if np.linalg.matrix_rank(at_rest - at_rest.mean(axis=0), tol=1e-6) > 1:
                return still
            pivot, shift = at.mean(axis=0), np.zeros(3)
            _, sizes, directions = np.linalg.svd(at - pivot, full_matrices=True)
            apart = 1e-4 * np.sqrt(self.square * self.pinned.sum())
            if (sizes[1:] > apart).any():
                return still
            covariance = self.about(pivot, pivot)
            turn = _turn_about(directions[0], covariance) if sizes[0] > apart else self.nearest_rotation(covariance)
        free = (self.y - pivot) @ turn.T + pivot + shift
        if self.left(free, self.planes[TOLD:]).min() <= 0.0:
            return still
        touched = np.array([bool((free @ plane[:3] <= plane[3]).any()) for plane in self.planes[:TOLD]], dtype=bool)
        if not touched.any():
            return np.asarray(free - self.y)
        planes = self.planes[:TOLD][touched]
        if len(planes) == 1 and not self.pinned.any():
            tipped = _Tipping(self, planes[0]).motion(free)
            if tipped is not None:
                return tipped
        share = self.share_to(planes, free)
        if share > LYING:
            self.comes = True
            part = _part(turn, share) @ (self.y - pivot).T
            return np.asarray(part.T + pivot + share * shift - self.y)
        if self.pinned.any():
            return still
        turn, shift = np.eye(3), self.way_on(planes)
        if np.linalg.matrix_rank(planes[:, :3], tol=1e-6) == 1 and not planes[:, 4].any():
            turn = _turn_about(planes[0, :3], self.covariance)
        along = (self.y - self.middle) @ (turn - np.eye(3)).T + shift
        beside = min(
            self.gaps(self.y + along, self.planes[:TOLD][~touched], balls=False).min(),
            self.left(self.y + along, self.planes[TOLD:]).min(),
        )
        return np.asarray(along if beside > 0.0 else still)

    def share_to(self, planes: Array, free: Array) -> float:
        """Of its free motion, that brings it to planes."""
        least = 1.0
        for plane in planes:
            before, after = (y @ plane[:3] - plane[3] for y in (self.y, free))
            comes, touches = (before > 0.0) & (after <= 0.0), after <= 0.0
            shares = np.where(comes, before / np.where(comes, np.maximum(before - after, 1e-300), 1.0), 0.0)
            least = min(least, float(shares[touches].min(initial=1.0)))
        return least

    def slips(self, normal: Array) -> Array:
        return np.asarray(self.u - np.outer(self.u @ normal, normal))

    def way_on(self, planes: Array) -> Array:
        """How far it goes along all planes that it touches [3]."""
        normals, friction = planes[:, :3], planes[:, 4]
        _, sizes, directions = np.linalg.svd(normals)
        span = directions[: int((sizes > 1e-6).sum())]
        along = self.lag - span.T @ (span @ self.lag)
        if not friction.any():
            return along if len(span) < 3 else np.zeros(3)
        if len(span) != len(planes) or len(span) > 2:
            return np.zeros(3)
        if len(planes) == 1 and float(self.lag @ normals[0]) >= 0.0:
            return np.asarray(along)
        # how far the planes push it together, and the slips on those that are rough
        pushes = np.linalg.solve(normals @ normals.T, -normals @ self.lag)
        if len(planes) > 1 and not (pushes > 0.0).all():
            return np.zeros(3)
        rough = [plane for plane in planes if plane[4] > 0.0]
        lies = [self.y @ plane[:3] - plane[3] < -LYING * float(self.lag @ plane[:3]) for plane in rough]
        slips = np.concatenate([self.slips(plane[:3])[own] for plane, own in zip(rough, lies, strict=True)])
        if not len(slips):
            return np.zeros(3)
        mean = slips.mean(axis=0)
        if len(span) == 2:
            mean = mean - span.T @ (span @ mean)
        # slips that differ leave a doubt about where friction acts: what is within it is left to the iterations
        apart = 2.0 * float(np.linalg.norm(slips.max(axis=0) - slips.min(axis=0)))
        free, rub, slip = mean + along, float(friction @ pushes), float(np.linalg.norm(mean))
        left = float(np.linalg.norm(free)) - rub
        if left <= 0.0:
            return np.asarray(-mean if slip > max(apart, apart * rub / max(slip, 1e-300)) else np.zeros(3))
        way = left * free / np.linalg.norm(free) - mean
        doubt = rub * min(2.0, apart / left)
        return np.asarray(max(0.0, 1.0 - doubt / max(float(np.linalg.norm(way)), 1e-300)) * way)


class _Tipping:
    """A component that tips or rolls on one plane, about one vertex or the line through two.

    They stick, or slide the way that they slid, and what pushes them must be a force that contacts have: outward,
    within friction's cone, and between the two. Which they are is found by turns: the vertex that would go deepest
    comes next; of three the two remain beyond whose line the pressure has its centre.
    """

    def __init__(self, piece: _Piece, plane: Array) -> None:
        self.piece, self.normal, self.friction = piece, plane[:3], float(plane[4])
        self.gap = piece.y @ self.normal - float(plane[3])
        self.reach = -LYING * float(piece.lag @ self.normal)
        self.lies, self.slips = self.gap < self.reach, piece.slips(self.normal)

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
        least = 1e-8 * piece.square
        line = np.linalg.eigvalsh(spread)[1] <= least
        if not (line or away @ np.linalg.solve(spread + least * np.eye(3), away) > RESTING):
            return None
        on = [int(np.where(self.lies, piece.y @ away, -np.inf).argmax())]
        pressure = middle + away
        share = 1.0
        for _ in range(ROUNDS - 1):
            moved, pushes, holds = self.about(on, share)
            worst, depth, left = piece.deepest(moved, -self.drop(on) * n, self.reach)
            if depth >= -(ROUNDED if worst in on else TOUCHING) * self.reach:
                way = np.asarray(moved - piece.y + max(0.0, -depth) * n)
                # a first iterate may be out of balance
                if not holds and not (piece.first and pushes and piece.lowers(way)):
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
                pair = self.pair_of([*on, worst], pressure)
                if pair is None or set(pair) == set(on):
                    return None
                on = pair
        return None

    def drop(self, on: list[int]) -> float:
        """How far above the plane they are."""
        return float(self.gap[on].min())

    def centre_of_pressure(self, moved: Array, about: Array) -> Array:
        """From a point of the plane [3]: where contact would have to push for the component to be at `moved`."""
        force = self.piece.weight * (moved - self.piece.z)
        torque = np.cross(moved - about, force).sum(axis=0)
        return np.asarray(np.cross(self.normal, torque) / (force.sum(axis=0) @ self.normal))

    def pair_of(self, three: list[int], pressure: Array) -> list[int] | None:
        """Two of three vertices: those beyond whose line the pressure has its centre, the third being on this side.

        Of three in a line the ends.
        """
        best, pair = 0.0, None
        for i in range(3):
            a, b, c = (self.piece.y[three[(i + j) % 3]] for j in range(3))
            outward = np.cross(self.normal, b - a)
            side, length = float((c - a) @ outward), float(np.linalg.norm(outward))
            own = -np.sign(side) * float((pressure - a) @ outward) / length
            if abs(side) <= IN_LINE * length**2:
                own = length
            if own > best:
                best, pair = own, [three[i], three[(i + 1) % 3]]
        return pair

    def about(self, on: list[int], share: float) -> tuple[Array, bool, bool]:
        """Where it goes if it turns about these vertices [n, 3], or that share of the way.

        And whether the contact pushes then; as contacts can.
        """
        sticking = self.sticking(on, share) if self.friction > 0.0 else None
        if sticking is not None and sticking[2]:
            return sticking
        sliding = self.sliding(on, share)
        if sliding is not None and (sliding[2] or sticking is None):
            return sliding
        return sticking if sticking is not None else (self.piece.y, False, False)

    def sticking(self, on: list[int], share: float) -> tuple[Array, bool, bool]:
        """Friction takes back how far they slid, within its cone."""
        piece, n = self.piece, self.normal
        first, way, axis = self.line(on)
        slips = self.slips[on]
        goal = first - slips[0] - self.drop(on) * n
        covariance = piece.about(goal, first)
        turn = piece.nearest_rotation(covariance) if axis is None else _turn_about(axis, covariance)
        moved = (piece.y - first) @ _part(turn, share).T + goal
        force = (piece.weight * (moved - piece.z)).sum(axis=0)
        push = float(force @ n)
        holds = bool(push > 0.0 and np.linalg.norm(force - push * n) <= self.friction * push)
        holds = holds and bool(np.linalg.norm(slips[0] - slips[-1]) <= self.reach)
        holds = holds and self.between((piece.y - first) @ turn.T + goal, goal, axis, way, push)
        return moved, push > 0.0, holds

    def sliding(self, on: list[int], share: float) -> tuple[Array, bool, bool] | None:
        """Friction acts against how they slid, and they go on that way; None where that is not known.

        Before any iteration nothing has slid: it acts against how they would.
        """
        piece, n = self.piece, self.normal
        first, way, axis = self.line(on)
        slips, direction = self.slips[on], np.zeros(3)
        if piece.first and not (np.linalg.norm(slips, axis=1) > self.reach).all():
            slips = self.free_slips[on]
        if self.friction > 0.0:
            lengths = np.linalg.norm(slips, axis=1)
            if not (lengths > self.reach).all():
                return None
            directions = slips / lengths[:, None]
            if np.linalg.norm(directions[0] - directions[-1]) > ALIKE:
                return None
            direction = directions[0]
        arm = first - piece.middle
        drop = self.drop(on)
        turn = self.sliding_turn(arm, axis, n - self.friction * direction, drop)
        if turn is None:
            return None
        moved = self.slid(turn, arm, direction, drop)
        push = float((piece.weight * (moved - piece.z)).sum(axis=0) @ n)
        holds = push > 0.0 and self.between(moved, moved[on[0]], axis, way, push)
        if self.friction > 0.0:
            after = self.slips[on[0]] + moved[on[0]] - first
            after -= (after @ n) * n
            holds = holds and after @ direction > ONWARD * np.linalg.norm(after)
        if share < 1.0:
            # of how it rolls and of how it turns about the normal: the line of two vertices stays level
            yaw = np.eye(3) if axis is None else _turn_about(n, np.outer(turn @ axis, axis))
            moved = self.slid(_part(yaw, share) @ _part(yaw.T @ turn, share), arm, direction, drop)
        return moved, push > 0.0, bool(holds)

    def line(self, on: list[int]) -> tuple[Array, Array, Array | None]:
        """A point, the way to the other, and its direction if there is one."""
        first = self.piece.y[on[0]]
        way = np.asarray(self.piece.y[on[-1]] - first)
        return first, way, way / np.linalg.norm(way) if len(on) == 2 else None

    def between(self, moved: Array, at: Array, axis: Array | None, way: Array, push: float) -> bool:
        """Whether that push at `moved` has its centre between the two vertices of a line."""
        if axis is None:
            return True
        torque = np.cross(moved - at, self.piece.weight * (moved - self.piece.z)).sum(axis=0)
        along, length = float(np.cross(self.normal, torque) @ axis) / push, float(np.linalg.norm(way))
        return -1e-6 * length <= along <= (1.0 + 1e-6) * length

    def slid(self, turn: Array, arm: Array, direction: Array, drop: float) -> Array:
        """The component turned; the vertex at `arm` from its middle goes down by `drop`, against friction."""
        piece = self.piece
        lift = float(self.normal @ (arm - turn @ arm - piece.lag)) - drop
        shift = piece.lag + lift * (self.normal - self.friction * direction)
        return np.asarray((piece.y - piece.middle) @ turn.T + piece.middle + shift)

    def sliding_turn(self, arm: Array, axis: Array | None, force: Array, drop: float) -> Array | None:
        """The turn that balances torques when contact pushes a vertex along `force`, by Newton's method."""
        piece, n, turn = self.piece, self.normal, np.eye(3)
        weight = float(piece.weight.sum())
        for _ in range(NEWTON):
            at = turn @ arm
            product = piece.covariance @ turn.T
            lift = weight * (float(n @ (arm - at - piece.lag)) - drop)
            torque = _axis(product) + lift * np.cross(at, force)
            slope = np.trace(product) * np.eye(3) - product.T
            slope += weight * np.outer(np.cross(at, force), np.cross(at, n))
            slope += lift * ((at @ force) * np.eye(3) - np.outer(at, force))
            if axis is None:
                step = np.linalg.solve(slope, torque)
                turn = _rotation(step) @ turn
                size = float(np.linalg.norm(step))
            else:
                line = turn @ axis
                basis = np.stack([line, n], axis=1)
                roll, yaw = np.linalg.solve(basis.T @ slope @ basis, basis.T @ torque)
                turn = _rotation(yaw * n) @ _rotation(roll * line) @ turn
                size = float(np.hypot(roll, yaw))
            if size < 1e-14:
                break
        return turn if size < 1e-9 else None


def _axis(matrix: Array) -> Array:
    """Twice the axis of the skew part."""
    return np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])


def _rotation(half: Array) -> Array:
    """By Cayley's formula, about an axis by 2 atan(|v| / 2)."""
    v = 0.5 * half
    skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + 2.0 / (1.0 + v @ v) * (skew + skew @ skew))


def _part(turn: Array, share: float) -> Array:
    """About that share of a turn: Cayley's vector of it times `share`; none of half a turn, which has no axis."""
    if share == 1.0:
        return turn
    left = 1.0 + float(np.trace(turn))
    return _rotation(share * 2.0 / left * _axis(turn)) if left > HALF_TURN else np.eye(3)


def _turn_about(normal: Array, covariance: Array) -> Array:
    """The rotation R about a normal that maximises tr(R^T covariance), by its angle."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(normal, first)])
    flat = frame @ covariance @ frame.T
    angle = np.arctan2(flat[1, 0] - flat[0, 1], flat[0, 0] + flat[1, 1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(np.outer(normal, normal) + frame.T @ turn @ frame)
