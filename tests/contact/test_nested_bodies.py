"""What lies whole inside a solid crosses nothing; scenes with `Contact` say so at rest."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from body_scenes import THICKNESS, block, cloth, plane, simulator

import torchpd as pd

AROUND = block(0.2, 2, (0.0, 0.0, 0.0))
BALL = pd.shapes.sphere(0.02, 2)


def rod(y: float = 0.01) -> pd.Rod:
    return pd.Rod(np.linspace((-0.03, y, 0.01), (0.04, y + 0.01, 0.02), 5), 1e6, 2e-3)


def inside(name: str) -> tuple[Any, ...]:
    parts = {
        "solid": block(0.03, 1, (0.01, 0.013, 0.017)),
        "rod": rod(),
        "rod along an axis": pd.Rod(np.linspace((-0.03, 0.0, 0.0), (0.03, 0.0, 0.0), 5), 1e6, 2e-3),  # on faces of tets
        "cloth": cloth(plane(0.03, 0.04, 2)),
        "collider": pd.Collider(BALL, pose=(0.01, 0.02, 0.0, 1, 0, 0, 0)),
        "heavy collider": pd.Collider(BALL, mass=0.1),
    }
    return (parts[name],)


@pytest.mark.parametrize("name", ["solid", "rod", "rod along an axis", "cloth", "collider", "heavy collider"])
def test_what_lies_inside_a_solid_is_said(name: str) -> None:
    contact = pd.Contact(thickness=THICKNESS)
    with pytest.warns(pd.SceneWarning, match=r"bodies 0 and 1 \(\d+ points .*overlap at rest, and one lies inside"):
        simulator(pd.Scene(AROUND, *inside(name), contact), 4)


@pytest.mark.parametrize(
    "parts",
    [
        (pd.Collider(pd.shapes.sphere(0.3, 3)),),  # a room around the solid
        (pd.Collider(BALL, pose=(0.01, 0.0, 0.13, 1, 0, 0, 0)), rod(0.12), block(0.03, 1, (0.0, -0.13, 0.0))),
    ],
)
def test_what_lies_outside_is_not(parts: tuple[Any, ...]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.SceneWarning)
        simulator(pd.Scene(AROUND, *parts, pd.Contact(thickness=THICKNESS)), 4)


def test_a_tie_means_it() -> None:
    """A rod that is tied into a solid, as reinforcement."""
    bar = rod()
    tie = pd.Tie(bar, np.arange(5), AROUND, stiffness=1e4)
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.SceneWarning)
        simulator(pd.Scene(AROUND, bar, tie, pd.Contact(thickness=THICKNESS)), 4)


def test_what_takes_no_part_passes() -> None:
    """Of solids alone: a rod that the contact does not name may be inside."""
    small, bar = block(0.03, 1, (0.01, -0.04, 0.017)), rod()
    contact = pd.Contact(AROUND, thickness=THICKNESS)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", pd.SceneWarning)
        simulator(pd.Scene(AROUND, bar, small, contact), 4)
    (text,) = (str(one.message) for one in said)
    assert "bodies 0 and 2" in text
    assert "do not collide" in text
