"""A witness of its own for the promise: ipctk tests iterates for intersections, and the straight ways between them.

Intersections alone would miss a ball that is wholly past a sheet. The continuous collision detection of ipctk (tight
inclusion, Wang et al. 2021) shares no code and no formula with `torchpd.geometry.crossings`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import ipctk
import numpy as np
import pytest
import torch
from contact_scenes import (
    ContactCase,
    ball_on_sheet,
    fixed_edge,
    folded_cloth,
    free_hit,
    gripper,
    needle,
    rings,
    twisted_strip,
    two_cubes,
)
from numpy.typing import NDArray

from torchpd.reference.contact import lists
from torchpd.reference.contact.planes import Planes, make_planes

Array = NDArray[np.float64]

# by default it takes for a meeting what comes to a fifth of the distance at the start
MEETS = ipctk.TightInclusionCCD(conservative_rescaling=0.999)


class Witness:
    """Judges places [N, 3] m of the vertices of a scene."""

    def __init__(self, case: ContactCase) -> None:
        surfaces = case.scene.surfaces
        self.used = surfaces.vertices.numpy()
        number = np.full(len(surfaces.rest), -1)
        number[self.used] = np.arange(len(self.used))
        edges, faces = (number[array.numpy()].astype(np.int32) for array in (surfaces.edges, surfaces.triangles))
        self.mesh = ipctk.CollisionMesh(self._own(surfaces.rest), edges, faces)

    def _own(self, places: torch.Tensor) -> Array:
        return np.asfortranarray(places.double().numpy()[self.used])

    def intersects(self, places: torch.Tensor) -> bool:
        return bool(ipctk.has_intersections(self.mesh, self._own(places)))

    def collides(self, before: torch.Tensor, after: torch.Tensor) -> bool:
        """Whether anything meets on the straight ways."""
        ways = self._own(before), self._own(after)
        return not ipctk.is_step_collision_free(self.mesh, *ways, narrow_phase_ccd=MEETS)


def met(case: ContactCase, steps: int, iterations: int) -> list[bool]:
    """Whether surfaces meet at an iterate, or on the straight way to it from the one before; of all iterates."""
    witness, last, found = Witness(case), torch.empty(0), []

    def observe(k: int, places: torch.Tensor) -> None:
        nonlocal last
        # x_0 is reached along screws
        found.append(witness.intersects(places) or (k > 0 and witness.collides(last, places)))
        last = places.clone()

    for _ in case.steps(steps, iterations, observe=observe):
        pass
    return found


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("iterations", [4, 16])
@pytest.mark.parametrize(
    ("make", "steps"),
    [
        (two_cubes, 6),
        (partial(free_hit, 2, 10.0), 3),
        (partial(ball_on_sheet, speed=40.0), 4),
        (partial(rings, speed=5.0), 2),
        (needle, 6),
        (fixed_edge, 6),
        (partial(twisted_strip, (16, 4), seconds=0.5), 6),
        (partial(folded_cloth, 8), 8),
        (partial(gripper, 0.8), 8),
    ],
    ids=["two cubes", "free hit", "ball on sheet", "rings", "needle", "edge", "twist", "fold", "gripper"],
)
def test_nothing_meets_between_iterates(
    make: Callable[..., ContactCase], steps: int, iterations: int, dtype: torch.dtype
) -> None:
    found = met(make(dtype=dtype), steps, iterations)
    assert len(found) >= steps * (iterations + 1)  # coarse corrections count, too
    assert not any(found)


def test_without_planes_surfaces_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    """A control: half-spaces that hold everything."""

    def nowhere(*args: Any) -> Planes:
        made = make_planes(*args)
        far = torch.full_like(made.above, torch.inf)
        return replace(made, above=-far, below=far, frozen=torch.zeros_like(made.frozen))

    monkeypatch.setattr(lists, "make_planes", nowhere)
    assert any(met(free_hit(2, 10.0), 4, 8))


def test_the_witness_sees_what_it_should() -> None:
    """A ball that is past the sheet intersects nothing; the way there does."""
    case = ball_on_sheet()
    witness, surfaces = Witness(case), case.scene.surfaces
    ball = (surfaces.body == 1)[:, None]
    rest = surfaces.rest
    down = torch.tensor([0.0, 1.0, 0.0], dtype=rest.dtype)
    height = float(rest[surfaces.body == 1][:, 1].mean() - rest[surfaces.body == 0][:, 1].mean())
    inside, past = (torch.where(ball, rest - share * height * down, rest) for share in (1.0, 2.0))
    assert not witness.intersects(rest)
    assert witness.intersects(inside)
    assert not witness.intersects(past)
    assert witness.collides(rest, past)
    assert not witness.collides(rest, torch.where(ball, rest + down, rest))
