"""Fibres in a solid: muscles, which contract, and passive fibres, which resist stretch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_shape
from ..common.synonyms import check_arguments
from ..geometry.mesh_quality import shape_gradients
from .effects import Solid
from .part import ArrayLike, KeyPart, Place, per_item, selected, set_fields, unit_vectors
from .stencils import StencilGroup

__all__ = ["Fibres"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(eq=False, repr=False)
class Fibres(KeyPart):
    """Fibres along a direction in a solid: w / 2 (|F f| - L)^2 per volume of material, L = 1 - contraction activation.

    F is the deformation gradient of a tetrahedron, f the direction at rest. A uniform bar of Young's modulus E without
    a Poisson's ratio takes the stretch (E + w L) / (E + w) along them.

    Args:
        solid: the body.
        direction: of the fibres at rest, [3] or one per fibre [N, 3]; normalised here.
        stiffness: w [Pa], a scalar or one value per fibre, positive.
        contraction: relative shortening at an activation of 1, a scalar or one value per fibre in [0, 1].
        activation: from 0 (passive) to 1, a scalar or one value per fibre, for steps without another one: an activation
            is an input of each step, `targets={fibres: activation}` (`Simulator.forward`).
        tension_only: whether fibres shorter than L are slack.
        tets: tetrahedra with a fibre [N], numbers or a boolean mask. None: all.

    Example:
        >>> biceps = Fibres(arm, (1.0, 0.0, 0.0), 1e5, tets=arm.mesh.regions == 2)
    """

    solid: Solid
    direction: Array  # [N, 3]
    stiffness: Array  # [N]
    contraction: Array  # [N]
    activation: Array  # [N]
    tension_only: bool
    tets: Index  # [N]

    @check_arguments("Fibres")
    def __init__(
        self,
        solid: Solid,
        direction: Any,
        stiffness: ArrayLike,
        contraction: ArrayLike = 0.3,
        *,
        activation: ArrayLike = 0.0,
        tension_only: bool = False,
        tets: Any = None,
    ) -> None:
        if not isinstance(solid, Solid):
            raise TypeError(f"Fibres.solid must be a Solid of the scene, got {type(solid).__name__}")
        if not isinstance(tension_only, bool | np.bool_):
            raise TypeError(f"Fibres.tension_only must be True or False, got {tension_only!r}")
        count = len(solid.mesh.tets)
        chosen = np.arange(count, dtype=np.int64)
        if tets is not None:
            chosen = selected("Fibres.tets", tets, count, of="solid", items="tetrahedron")
        number = len(chosen)
        set_fields(
            self,
            solid=solid,
            direction=_directions(direction, number),
            stiffness=per_item("Fibres.stiffness", stiffness, number, of="fibre", unit="Pa"),
            contraction=_shares("contraction", contraction, number),
            activation=_shares("activation", activation, number),
            tension_only=bool(tension_only),
            tets=chosen,
        )

    @property
    def lengths(self) -> Array:
        """Stretches L without tension [N]: 1 - contraction activation."""
        return 1.0 - self.contraction * self.activation

    def bodies_used(self) -> tuple[Solid, ...]:
        return (self.solid,)

    def stencils(self, place: Place) -> tuple[StencilGroup, ...]:
        mesh = self.solid.mesh
        corners = mesh.tets[self.tets]
        gradients, volumes = shape_gradients(mesh.vertices, corners)
        group = StencilGroup.of(
            "fibre",
            corners + place(self.solid),
            np.einsum("nak,nk->na", gradients, self.direction)[:, :, None],
            volumes if mesh.fill is None else volumes * mesh.fill[self.tets],
            constants=np.full((len(corners), 1), float(self.tension_only)),
            fibre_stiffness=self.stiffness,
            fibre_length=self.lengths,
        )
        return (group,)


def _directions(value: Any, count: int) -> Array:
    name = "Fibres.direction"
    array = as_array(name, value, np.float64)
    if array.shape == (3,):
        array = np.tile(array, (count, 1))
    check_shape(name, array, (count, 3), "one direction for all fibres [3], or one per fibre")
    return unit_vectors(name, array)


def _shares(name: str, value: ArrayLike, count: int) -> Array:
    array = per_item(f"Fibres.{name}", value, count, of="fibre", unit="1", zero=True)
    bad = np.flatnonzero(array > 1.0)
    if bad.size:
        raise ValueError(f"Fibres.{name} must lie in [0, 1], got {array[bad[0]]} at {int(bad[0])} ({bad.size} in all)")
    return array
