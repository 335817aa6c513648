"""Volumes of bodies: sums over tetrahedra, and the divergence theorem for closed sheets."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.small_matrices import dot, tree_sum
from ..scene.cloth import Cloth
from ..scene.effects import Solid
from ..scene.part import Body
from ..scene.scene import Scene

__all__ = ["volumes"]

Index = NDArray[np.int64]

# elements of the bodies that have a volume; kept, because a copy to a GPU would wait for it
_ELEMENTS: WeakKeyDictionary[Scene, dict[torch.device, dict[Body, Tensor]]] = WeakKeyDictionary()


def _elements(scene: Scene, device: torch.device) -> dict[Body, Tensor]:
    """Tetrahedra of the solids and triangles of the closed sheets, by vertices of the scene."""
    kept = _ELEMENTS.setdefault(scene, {})
    if device not in kept:
        kept[device] = {
            body: torch.tensor(body.elements + scene.vertex_range(body).start, device=device)
            for body in scene.bodies
            if isinstance(body, Solid) or (isinstance(body, Cloth) and _is_closed(body.elements))
        }
    return kept[device]


def _is_closed(triangles: Index) -> bool:
    """Whether every edge runs once in either direction."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    forth, back = np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0)
    return len(forth) == len(edges) and np.array_equal(forth, back)


def volumes(scene: Scene, positions: Tensor) -> dict[Body, Tensor]:
    """Implementation of `Simulator.volume` for checked positions [B, V, 3]."""
    found: dict[Body, Tensor] = {}
    for body, elements in _elements(scene, positions.device).items():
        # about a point of the body, so that no digits are lost far from the origin: a tetrahedron's last corner, or the
        # first vertex of a sheet
        a, b, c, *last = (positions[:, elements[:, corner]] for corner in range(elements.shape[1]))
        about = last[0] if last else positions[:, scene.vertex_range(body).start, None]
        a, b, c = a - about, b - about, c - about
        sign = -1.0 if last else 1.0
        found[body] = tree_sum(dot(a, torch.linalg.cross(b, c))[..., None])[..., 0] * (sign / 6.0)
    return found
