"""Shares of rigid motions, and forces that motions change."""

from __future__ import annotations

import numpy as np
import pytest

from torchpd.reference.contact.coarse import BOW, RigidWay, changed_forces
from torchpd.reference.envelopes import Envelopes

RNG = np.random.default_rng(7)


def _way(angle: float) -> tuple[np.ndarray, RigidWay]:
    axis = RNG.normal(size=3)
    w = 2.0 * np.tan(0.5 * angle) * axis / np.linalg.norm(axis)
    places = RNG.normal(size=(30, 3))
    given = RigidWay(np.arange(30), places - 0.1, np.full(3, 0.1), RNG.normal(size=3), w)
    return places, RigidWay.between(given.vertices, places, given.at(1.0), given.center)


@pytest.mark.parametrize("angle", [1e-9, 0.1, 1.0, 0.5 * np.pi])
def test_a_share_of_a_rigid_motion_is_rigid_and_near_the_straight_way(angle: float) -> None:
    """Distances stay to rounding, and places leave the chord by less than BOW times what the turn moves them."""
    places, way = _way(angle)
    assert way.is_valid
    distances = np.linalg.norm(places[:, None] - places, axis=2)
    for share in np.linspace(0.0, 1.0, 21):
        at = way.at(float(share))
        np.testing.assert_allclose(np.linalg.norm(at[:, None] - at, axis=2), distances, atol=1e-13)
        straight = (1.0 - share) * places + share * way.at(1.0)
        assert (np.linalg.norm(at - straight, axis=1) <= BOW * way.chords + 1e-13).all()


def test_turns_beyond_a_right_angle_are_none() -> None:
    assert not _way(1.6)[1].is_valid


def test_forces_stay_where_nothing_moves() -> None:
    """Whatever gaps and slips are left; and they stay in Coulomb's cone."""
    count = 50
    normals = RNG.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = RNG.normal(size=(count, 3))
    across -= (across * normals).sum(axis=1, keepdims=True) * normals
    normal = np.abs(RNG.normal(size=count))
    friction = np.full(count, 0.5)
    size = np.linalg.norm(across, axis=1)
    tangent = across * np.minimum(1.0, friction * normal / size)[:, None]
    slips = RNG.normal(size=(count, 3))
    slips -= (slips * normals).sum(axis=1, keepdims=True) * normals
    at = Envelopes(
        np.zeros((count, 4), np.int64), np.zeros((count, 4)), normals, RNG.normal(size=count), slips, friction,
        np.ones(count), normal, tangent,
    )  # fmt: skip
    anchors = normal[:, None] * normals + tangent
    still = at.forces(friction * at.normal_forces())
    np.testing.assert_allclose(changed_forces(at, still), anchors, atol=1e-14)
    moved = changed_forces(at, still + RNG.normal(size=(count, 3)))
    along = (moved * normals).sum(axis=1)
    assert (along >= 0.0).all()
    assert (np.linalg.norm(moved - along[:, None] * normals, axis=1) <= 0.5 * along + 1e-12).all()
