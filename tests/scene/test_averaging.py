"""Poisson's ratio of solids, and the groups of tetrahedra that share a volume strain."""

from __future__ import annotations

import numpy as np
import pytest

import torchpd as pd
from torchpd.common.warn import SceneWarning
from torchpd.geometry.mesh_faces import match_faces
from torchpd.scene.averaging import _grown


def groups_of(solid: pd.Solid) -> np.ndarray:
    values = pd.Scene(solid).values()
    assert values.tet_group is not None
    return values.tet_group


def shares_faces(mesh: pd.TetMesh, members: np.ndarray) -> bool:
    """Whether the tets of a group hang together by faces."""
    order, begins = match_faces(mesh.tets[members])
    inner = np.flatnonzero(~begins)
    label = np.arange(len(members))
    for one, other in zip(order[inner - 1] // 4, order[inner] // 4, strict=True):
        label[label == label[other]] = label[one]
    return len(np.unique(label)) == 1


@pytest.mark.parametrize(("size", "least"), [(1, 1.0), (2, 0.95), (4, 0.95)])
def test_groups_hang_together_and_are_full(size: int, least: float) -> None:
    """Numbers run from 0 without gaps; nearly all tets of a box are in full groups."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (20, 4, 4))
    group = groups_of(pd.Solid(mesh, 1e5, poisson=0.4, averaging=size))
    counts = np.bincount(group)
    assert group.shape == (1920,)
    assert counts.min() >= 1
    assert counts.max() == size
    assert size * (counts == size).sum() >= least * 1920
    assert all(shares_faces(mesh, np.flatnonzero(group == number)) for number in range(len(counts)))


def test_the_next_member_shares_most_faces() -> None:
    """2 shares two faces with 0, 1 and 3, where 6 shares one and leaves nothing alone."""
    neighbours = [[1, 2], [0, 3, 4], [0, 3, 5, 8], [1, 2, 6, 7], [1, 9, 10, 11, 12], [2], [3], [3], [2], *[[4]] * 4]
    group = _grown(neighbours, 13, 4)
    assert np.flatnonzero(group == group[0]).tolist() == [0, 1, 2, 3]
    assert np.bincount(group).tolist() == [4, 4, 1, 1, 1, 1, 1]


def test_groups_stay_within_one_material() -> None:
    """Bulk moduli that differ by more than a factor of two are kept apart; smaller differences are not."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (10, 2, 2))
    left = np.arange(240) % 6 < 3  # half of the tets of a cell
    for factor, mixed in ((2.1, False), (1.9, True)):
        group = groups_of(pd.Solid(mesh, np.where(left, 1e5, factor * 1e5), poisson=0.3))
        materials = [len(np.unique(left[group == number])) for number in range(group.max() + 1)]
        assert (max(materials) == 2) == mixed
    nearly = groups_of(pd.Solid(mesh, 1e5, poisson=np.where(left, 0.3, 0.45)))  # (1 - 0.6) / (1 - 0.9) = 4
    assert not np.intersect1d(nearly[left], nearly[~left]).size


def test_defaults_are_by_the_mesh() -> None:
    """Pairs in the lattice of `tetrahedralize`, also without its fill; fours in other meshes."""
    lattice = pd.tetrahedralize(pd.shapes.octopus(cells=16), cells=8)
    plain = pd.TetMesh(lattice.vertices, lattice.tets).scaled(2.0)
    for mesh, size in ((lattice, 2), (plain, 2), (pd.shapes.box(cells=(4, 2, 2)), 4), (plain.scaled((1, 1, 2)), 4)):
        assert np.bincount(groups_of(pd.Solid(mesh, 1e5, poisson=0.3))).max() == size


def test_given_groups_and_scenes_of_several_solids() -> None:
    """Group numbers of solids do not meet; a solid of nu = 0 beside another gets zeros and groups of its own."""
    mesh = pd.shapes.box((0.2, 0.2, 0.2), (1, 1, 1))
    first = pd.Solid(mesh, 1e5, poisson=[0.1, 0.2, 0.3, 0.1, 0.2, 0.3], averaging=[7, 7, -1, 7, -1, 9])
    second = pd.Solid(mesh, 1e5)
    values = pd.Scene(first, second).values()
    assert values.tet_group is not None
    assert values.tet_group[:6].tolist() == [1, 1, 0, 1, 0, 2]
    assert set(values.tet_group[6:].tolist()) == {3, 4}
    np.testing.assert_array_equal(values.poisson, [0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0, 0, 0, 0, 0, 0])
    zeros = pd.Scene(pd.Solid(mesh, 1e5, poisson=np.zeros(6))).values()  # an array can be set later
    np.testing.assert_array_equal(zeros.poisson, np.zeros(6))


def test_poisson_and_averaging_are_checked() -> None:
    mesh = pd.shapes.box((0.2, 0.2, 0.2), (1, 1, 1))
    for changed, kind, message in (
        ({"poisson": -1.0}, ValueError, r"Solid\.poisson must lie above -1 .*got -1\.0 at 0 \(6 in all\)"),
        ({"poisson": 0.495}, ValueError, r"Solid\.poisson .*below 0\.495, got 0\.495 at 0"),
        ({"poisson": [0, 0, 0, 0, 0, 0.5]}, ValueError, r"Solid\.poisson .*got 0\.5 at 5 \(1 in all\)"),
        ({"poisson": [0.3]}, ValueError, r"Solid\.poisson must be \[6\] .*got \[1\]"),
        ({"poisson": np.nan}, ValueError, r"Solid\.poisson must be finite, got nan"),
        ({"averaging": 3}, ValueError, r"Solid\.averaging must be 1, 2, 4 .*got 3"),
        ({"averaging": True}, ValueError, r"Solid\.averaging must be 1, 2, 4 .*got True"),
        ({"averaging": [0, 1]}, ValueError, r"Solid\.averaging must be \[6\] .*got \[2\]"),
        ({"averaging": np.ones(6)}, ValueError, r"Solid\.averaging must be 1, 2, 4 "),
    ):
        with pytest.raises(kind, match=message):
            pd.Solid(mesh, 1e5, **changed)
    with pytest.warns(SceneWarning, match=r"Solid\.poisson is 0\.46: above 0\.45 ") as said:
        pd.Solid(mesh, 1e5, poisson=0.46)
    assert said[0].filename == __file__
    with pytest.raises(TypeError, match="Solid has no argument 'nu'; Poisson's ratio is `poisson`"):
        pd.Solid(mesh, 1e5, nu=0.3)
    assert (pd.Solid(mesh, 1e5).poisson, pd.Solid(mesh, 1e5, 500.0).density[0]) == (0.0, 500.0)
