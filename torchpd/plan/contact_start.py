"""Starts of contact: surfaces that cross, or that touch so closely that no plane separates them, are refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.closest_points import segment_distances, triangle_distances
from ..geometry.crossings import crosses
from .contact_near import own_vertices
from .contact_plan import ContactPlan
from .contact_tree import Boxes, ContactTree, meeting

__all__ = ["check_start"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDINGS = 8.0  # of the largest place, within which no direction separates two surfaces


def check_start(plan: ContactPlan, positions: Array, rounding: float, name: str) -> None:
    """Refuse places of all vertices, those of colliders last, from which no step can start.

    Sides that a `Tie` joins may touch, and cross.

    Args:
        plan: the compiled contact.
        positions: [N, 3] m.
        rounding: machine epsilon of the precision of a step.
        name: of the positions in errors.

    Raises:
        ValueError: names an edge and a triangle that cross, or the two sides that touch.
    """
    found = _crossing(plan, positions)
    if len(found):
        edge, triangle = found[0].tolist()
        ends, corners = plan.edges[edge].tolist(), plan.triangles[triangle].tolist()
        raise ValueError(
            f"{name} must be free of crossings, got {len(found)}: the edge of {own_vertices(plan.body, ends)} passes "
            f"through the triangle of {own_vertices(plan.body, corners)}; move the bodies apart"
        )
    least = _ROUNDINGS * rounding * float(np.abs(positions[plan.vertices]).sum(axis=1).max())
    for corners, sides, distance in (_near_points(plan, positions, least), _near_edges(plan, positions, least)):
        if len(distance) and distance.min() <= least:
            four = corners[int(distance.argmin())].tolist()
            one, other = own_vertices(plan.body, four[:sides]), own_vertices(plan.body, four[sides:])
            rigid = (plan.collider[four] >= 0).any()
            fix = "; a Pin of vertices near the collider can follow it" if rigid else ", or join them by a Tie"
            raise ValueError(
                f"{name} must leave {least:.1e} m between surfaces, got {distance.min():.1e} m between {one} and "
                f"{other}; leave the thickness, {plan.thickness:.3g} m{fix}"
            )


def _boxes(tree: ContactTree, places: Array, margin: float = 0.0) -> Boxes:
    """Boxes of primitives [n, k, 3] m, wider by a margin."""
    return Boxes.of(tree, places.min(axis=1) - margin, places.max(axis=1) + margin)


def _counted(plan: ContactPlan, one: Index, other: Index) -> NDArray[np.bool_]:
    """Whether sides [m, a] and [m, b] may be in contact [m]: apart in the mesh, and not both moved by hand."""
    met = (one[:, :, None] == other[:, None]).any(axis=(1, 2))
    body = plan.body[one[:, 0]]
    same = body == plan.body[other[:, 0]]
    moving = ~(plan.kinematic[one].all(axis=1) & plan.kinematic[other].all(axis=1))
    return np.asarray(~met & moving & (~same | plan.self_contact[body]))


def _tied(plan: ContactPlan, keys: Index) -> NDArray[np.bool_]:
    """Whether a tie joins the sides of pairs, by their keys."""
    return np.isin(keys, plan.near.keys[plan.near.thickness == 0.0])


def _point_keys(plan: ContactPlan, vertex: Index, triangle: Index) -> Index:
    return vertex * len(plan.triangles) + triangle


def _edge_keys(plan: ContactPlan, first: Index, second: Index) -> Index:
    first, second = np.minimum(first, second), np.maximum(first, second)
    return len(plan.rest) * len(plan.triangles) + first * len(plan.edges) + second


def _crossing(plan: ContactPlan, positions: Array) -> Index:
    """Edges and triangles [n, 2] that cross, in increasing order."""
    edge, triangle = meeting(
        _boxes(plan.edge_tree, positions[plan.edges]), _boxes(plan.triangle_tree, positions[plan.triangles])
    )
    order = np.lexsort((triangle, edge))
    edge, triangle = edge[order], triangle[order]
    ends, corners = plan.edges[edge].astype(np.int64), plan.triangles[triangle].astype(np.int64)
    keep = _counted(plan, ends, corners)
    edge, triangle, ends, corners = edge[keep], triangle[keep], ends[keep], corners[keep]
    found = crosses(positions, np.concatenate([ends, corners], axis=1))
    edge, triangle, ends, corners = edge[found], triangle[found], ends[found], corners[found]
    joined = np.zeros(len(edge), dtype=np.bool_)
    for end in ends.T:
        joined |= _tied(plan, _point_keys(plan, end, triangle))
    for side in ((0, 1), (1, 2), (2, 0)):
        joined |= _tied(plan, _edge_keys(plan, edge, _edge_numbers(plan, corners[:, side])))
    return np.stack([edge[~joined], triangle[~joined]], axis=1)


def _edge_numbers(plan: ContactPlan, ends: Index) -> Index:
    """Numbers [m] of the edges between vertices [m, 2]."""
    ends, count = np.sort(ends, axis=1), len(plan.rest)
    keys = plan.edges[:, 0].astype(np.int64) * count + plan.edges[:, 1]  # increasing
    return np.searchsorted(keys, ends[:, 0] * count + ends[:, 1])


def _near_points(plan: ContactPlan, positions: Array, margin: float) -> tuple[Index, int, Array]:
    """Corners [m, 4] and distances [m] m of vertices and triangles whose boxes come within a margin."""
    vertex, triangle = meeting(
        _boxes(plan.vertex_tree, positions[plan.vertices][:, None], margin),
        _boxes(plan.triangle_tree, positions[plan.triangles]),
    )
    vertex = plan.vertices[vertex].astype(np.int64)
    corners = np.concatenate([vertex[:, None], plan.triangles[triangle]], axis=1)
    keep = _counted(plan, corners[:, :1], corners[:, 1:]) & ~_tied(plan, _point_keys(plan, vertex, triangle))
    corners = corners[keep]
    return corners, 1, triangle_distances(positions[corners[:, 0]], positions[corners[:, 1:]])


def _near_edges(plan: ContactPlan, positions: Array, margin: float) -> tuple[Index, int, Array]:
    """Corners [m, 4] and distances [m] m of edges whose boxes come within a margin."""
    boxes = _boxes(plan.edge_tree, positions[plan.edges], 0.5 * margin)
    first, second = meeting(boxes, boxes)
    corners = np.concatenate([plan.edges[first], plan.edges[second]], axis=1).astype(np.int64)
    keep = _counted(plan, corners[:, :2], corners[:, 2:]) & ~_tied(plan, _edge_keys(plan, first, second))
    corners = corners[keep]
    return corners, 2, segment_distances(positions[corners[:, :2]], positions[corners[:, 2:]])
