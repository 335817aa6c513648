"""`Contact` and `Collider`: their values, and refusals that name the argument, the contract, what came and the fix."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from sheets import cloth, surface
from small_scene import body

import torchpd as pd
from torchpd.accuracy.error import scene_without_friction
from torchpd.scene.contact import placed
from torchpd.viewing.bodies import SceneSurface

TRIANGLE = pd.TriMesh([[0.0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 2, 1]])
FLOOR = pd.Collider(TRIANGLE)
SOLID, SHEET = body(), cloth()
ROD = pd.Rod(np.linspace((0.0, 2, 0), (1, 2, 0), 4), 1e6, 1e-2)


def friction_of(contact: pd.Contact, *others: Any) -> list[list[float]]:
    """Table of a solid, a sheet and colliders."""
    values = pd.Scene(SOLID, SHEET, *others, contact).values().contact
    assert values is not None
    return values.friction.tolist()


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (
            lambda: pd.Collider("mesh"),
            TypeError,
            r"Collider: mesh must be a TriMesh or a TetMesh, got str; .*TriMesh\(",
        ),
        (lambda: pd.Collider(TRIANGLE, friction=-0.1), ValueError, r"Collider\.friction must be >= 0, got -0\.1"),
        (lambda: pd.Collider(TRIANGLE, friction=math.nan), ValueError, r"Collider\.friction must be finite, got nan"),
        (lambda: pd.Collider(TRIANGLE, pose=(0, 0, 0)), ValueError, r"Collider\.pose must be \[7\] .*got \[3\]"),
        (
            lambda: pd.Collider(TRIANGLE, pose=(0, 0, math.inf, 1, 0, 0, 0)),
            ValueError,
            r"Collider\.pose must be finite, got inf at \[2\]",
        ),
        (
            lambda: pd.Collider(TRIANGLE, pose=(1, 2, 3, 0, 0, 0, 0)),
            ValueError,
            r"Collider\.pose must have a quaternion .* not zero, got \[0, 0, 0, 0\]; \(1, 0, 0, 0\)",
        ),
        (
            lambda: pd.Contact("all"),
            TypeError,
            "Contact takes Solid, Cloth, Rod and Collider, got str; pass them one by one",
        ),
        (lambda: pd.Contact([SOLID]), TypeError, "Contact takes Solid, .*got list; pass them one by one"),
        (
            lambda: pd.Contact(SOLID, pd.Ground()),
            TypeError,
            r"Contact takes .*got Ground; .*Ground\(friction=\): leave",
        ),
        (lambda: pd.Contact(0.3), TypeError, r"Contact takes .*got float; .*by name, Contact\(friction=0\.3\)"),
        (
            lambda: pd.Contact(friction={(SOLID, pd.Sphere((0.0, 0.0, 0.0), 1.0)): 0.3}),
            TypeError,
            r"Contact\.friction takes .*got Sphere; .*coefficient is Sphere\(friction=\): leave it out",
        ),
        (lambda: pd.Contact(SOLID, SOLID), ValueError, "each body must be given once, got the same Solid twice"),
        (lambda: pd.Contact(FLOOR), ValueError, "bodies must have one that deforms, .*got 1 colliders alone; name it"),
        (lambda: pd.Contact(thickness=0.0), ValueError, r"Contact\.thickness must be positive \[m\], got 0\.0; None"),
        (lambda: pd.Contact(thickness=math.nan), ValueError, r"Contact\.thickness must be finite, got nan"),
        (lambda: pd.Contact(capacity=0), ValueError, r"Contact\.capacity must be a whole number >= 1, got 0"),
        (lambda: pd.Contact(capacity=8.5), ValueError, r"Contact\.capacity must be a whole number >= 1, got 8\.5"),
        (
            lambda: pd.Contact(self_contact=SHEET),
            TypeError,
            r"self_contact must be a bool or a list .*got Cloth; .*\[b",
        ),
        (lambda: pd.Contact(self_contact=["rod"]), TypeError, r"Contact\.self_contact takes Solid, .*Rod .*got str"),
        (
            lambda: pd.Contact(self_contact=[FLOOR]),
            TypeError,
            r"self_contact must list .* got a Collider; leave it out",
        ),
        (
            lambda: pd.Contact(SOLID, self_contact=[SHEET]),
            ValueError,
            "of self_contact .*got a Cloth there .*; name it",
        ),
        (lambda: pd.Contact(friction=-1.0), ValueError, r"Contact\.friction must be >= 0, got -1\.0"),
        (
            lambda: pd.Contact(friction={SOLID: 0.3}),
            TypeError,
            r"friction must have pairs .*got Solid; \{\(cloth, table",
        ),
        (lambda: pd.Contact(friction={(SOLID, 0): 0.3}), TypeError, r"Contact\.friction takes Solid, .*got int"),
        (
            lambda: pd.Contact(friction={(SOLID, SHEET): -0.3}),
            ValueError,
            r"Contact\.friction of \(Solid, Cloth\) must be >= 0, got -0\.3",
        ),
        (
            lambda: pd.Contact(friction={(SOLID, SHEET): 0.3, (SHEET, SOLID): 0.3}),
            ValueError,
            r"friction must have each pair once, got \(Cloth, Solid\) in both orders; leave out one",
        ),
        (
            lambda: pd.Contact(SOLID, friction={(SOLID, SHEET): 0.3}),
            ValueError,
            "those of self_contact and friction, got a Cloth there that is not among them; name it too",
        ),
        (
            lambda: pd.Contact(SOLID, FLOOR, friction={(FLOOR, FLOOR): 0.3}),
            ValueError,
            r"Contact\.friction must name pairs that can touch, got \(Collider, Collider\), .*; leave the pair out",
        ),
        (
            lambda: pd.Contact(SOLID, self_contact=False, friction={(SOLID, SOLID): 0.3}),
            ValueError,
            r"Contact\.friction must name pairs that can touch, got \(Solid, Solid\)",
        ),
    ],
)
def test_parts_are_checked(make: Callable[[], object], kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message):
        make()


@pytest.mark.parametrize(
    ("parts", "kind", "message"),
    [
        ((SOLID, pd.Contact(), pd.Contact(SOLID)), ValueError, "Scene takes at most one Contact, got 2"),
        ((SOLID, FLOOR), ValueError, r"a Collider acts by a Contact of this scene, got none; add Contact\(\)"),
        ((SOLID, FLOOR, pd.Contact(SOLID)), ValueError, "a Collider acts by .*got 1 that it does not name; name them"),
        ((SOLID, pd.Contact(SHEET)), ValueError, "the body of a Contact must be a part of this scene, got another one"),
        ((SOLID, pd.Contact(SOLID, FLOOR)), ValueError, "the body of a Contact must be a part of this scene"),
        ((SOLID, pd.Contact(self_contact=[SHEET])), ValueError, "the body of a Contact must be a part of this scene"),
        ((FLOOR, pd.Contact()), ValueError, "Scene needs at least one body, got none"),
        ((SOLID, FLOOR, FLOOR, pd.Contact()), ValueError, "got the same Collider twice"),
        ((SOLID, FLOOR, pd.Contact(friction={(FLOOR, FLOOR): 1.0})), ValueError, "must name pairs that can touch"),
    ],
)  # fmt: skip
def test_scenes_are_checked(parts: tuple[Any, ...], kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message):
        pd.Scene(*parts)


def test_parts_keep_their_values() -> None:
    table = {(SOLID, SHEET): 0.3}
    contact = pd.Contact(SOLID, SHEET, friction=table)
    table.clear()
    assert contact.friction == {(SOLID, SHEET): 0.3}
    for part, name in ((contact, "friction"), (FLOOR, "pose")):
        with pytest.raises(dataclasses.FrozenInstanceError, match=f"cannot assign to field '{name}'"):
            setattr(part, name, 3.0)
    assert copy.deepcopy(contact) is contact
    with pytest.raises(ValueError, match="read-only"):
        FLOOR.pose[0] = 1.0


def test_printed() -> None:
    assert repr(pd.Contact()) == "Contact(bodies=())"
    assert repr(pd.Contact(friction=0.3, self_contact=False)) == "Contact(bodies=(), self_contact=False, friction=0.3)"
    assert repr(FLOOR) == "Collider(mesh=TriMesh(3 vertices, 1 triangles), pose=float64 [7])"


def test_poses() -> None:
    """Quaternions of length 1 keep their bits, others are normalised; half a turn about y."""
    unit = np.array([0.5, -0.5, 0.5, 0.5])
    assert pd.Collider(TRIANGLE).pose.tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert pd.Collider(TRIANGLE, pose=torch.tensor([1.0, 2, 3, *unit])).pose.tolist() == [1, 2, 3, *unit]
    assert pd.Collider(TRIANGLE, pose=[1, 2, 3, *(1e100 * unit)]).pose.tolist() == [1, 2, 3, *unit]
    turned = pd.Collider(TRIANGLE, pose=(0.5, 1, 0, 0, 0, 3, 0)).pose
    np.testing.assert_array_equal(
        placed(np.tile(turned, (3, 1)), TRIANGLE.vertices), [[0.5, 1, 0], [-0.5, 1, 0], [0.5, 1, -1]]
    )
    quarter = np.sqrt([[0, 0, 0, 0.5, 0, 0, 0.5]])  # about z
    np.testing.assert_allclose(placed(quarter, np.array([[1.0, 2, 3]])), [[-2, 1, 3]], atol=1e-15)


def test_a_collider_of_tetrahedra_is_their_boundary() -> None:
    """27 vertices of a 2 x 2 x 2 box, one of them inside; outward, as the volume says."""
    mesh = pd.shapes.box((1.0, 1.0, 1.0), (2, 2, 2))
    rigid = pd.Collider(mesh).mesh
    assert (len(rigid.vertices), len(rigid.triangles)) == (26, 48)
    assert rigid.volume() == pytest.approx(1.0)


def test_friction() -> None:
    """Bodies 0 and 1 deform, 2 and 3 are colliders of .9 and of none."""
    rough, plain = pd.Collider(TRIANGLE, friction=0.9), pd.Collider(TRIANGLE)
    assert friction_of(pd.Contact()) == [[0, 0], [0, 0]]
    assert friction_of(pd.Contact(friction=0.1)) == [[0.1, 0.1], [0.1, 0.1]]
    usual = friction_of(pd.Contact(friction=0.1), rough, plain)
    mean = pytest.approx(0.3)  # sqrt(.1 .9)
    assert usual == [[0.1, 0.1, mean, 0.1], [0.1, 0.1, mean, 0.1], [mean, mean, 0.9, mean], [0.1, 0.1, mean, 0.1]]
    alone = friction_of(pd.Contact(), rough, plain)
    assert alone == [[0, 0, 0.9, 0], [0, 0, 0.9, 0], [0.9, 0.9, 0.9, 0.9], [0, 0, 0.9, 0]]
    pairs = friction_of(pd.Contact(friction={(rough, SOLID): 0.2, (SHEET, SHEET): 0.4}), rough, plain)
    assert pairs == [[0, 0, 0.2, 0], [0, 0.4, 0.9, 0], [0.2, 0.9, 0.9, 0.9], [0, 0, 0.9, 0]]
    assert friction_of(pd.Contact(SOLID, rough, friction={(SOLID, rough): 0.2}), rough)[2] == [0.2, 0.9, 0.9]


def test_who_touches_itself() -> None:
    for contact, flags in (
        (pd.Contact(), [True, True, False]),
        (pd.Contact(self_contact=False), [False, False, False]),
        (pd.Contact(self_contact=np.True_), [True, True, False]),
        (pd.Contact(self_contact=[SHEET]), [False, True, False]),
        (pd.Contact(self_contact=[]), [False, False, False]),
        (pd.Contact(SHEET, FLOOR), [False, True, False]),
    ):
        values = pd.Scene(SOLID, FLOOR, SHEET, contact).values().contact
        assert values is not None
        assert values.self_contact.tolist() == flags


def test_numbers_are_those_of_the_scene() -> None:
    """Bodies first, whatever the order of parts; a rod that takes no part keeps its place."""
    moved = pd.Collider(TRIANGLE, pose=(0, 5, 0, 1, 0, 0, 0))
    scene = pd.Scene(moved, SOLID, ROD, FLOOR, SHEET, pd.Contact(SHEET, SOLID, FLOOR, moved))
    values = scene.values().contact
    assert values is not None
    own = len(scene.rest_positions)
    assert np.bincount(values.body).tolist() == [27, 4, 25, 3, 3]
    assert values.kinds == ("Solid", "Rod", "Cloth", "Collider", "Collider")
    np.testing.assert_array_equal(values.collider, [*[-1] * own, 0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(values.points, np.tile(TRIANGLE.vertices, (2, 1)))
    assert values.poses[:, 1].tolist() == [5, 0]
    boundary = SOLID.mesh.boundary()
    np.testing.assert_array_equal(values.triangles[: len(boundary)], boundary)
    np.testing.assert_array_equal(values.triangles[len(boundary) : -2], surface().triangles + 31)
    np.testing.assert_array_equal(values.triangles[-2:], TRIANGLE.triangles + [[own], [own + 3]])
    assert not len(values.segments)
    with_rod = pd.Scene(SOLID, ROD, SHEET, pd.Contact(ROD, SHEET)).values().contact
    assert with_rod is not None
    assert with_rod.segments.tolist() == [[27, 28], [28, 29], [29, 30]]
    np.testing.assert_array_equal(with_rod.triangles, surface().triangles + 31)


def test_the_rest_of_a_scene_does_not_know_contact() -> None:
    """The same arrays, ranges, pictures and steps with it and without; contact itself is there only if given."""
    without, scene = pd.Scene(SOLID, SHEET), pd.Scene(FLOOR, SOLID, pd.Contact(), SHEET)
    one, two = without.values(), scene.values()
    assert one.contact is None
    assert (without.contact, without.colliders, scene.colliders) == (None, (), (FLOOR,))
    for field in dataclasses.fields(one):
        value = getattr(one, field.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(two, field.name), value)
    assert scene.vertex_range(SHEET) == without.vertex_range(SHEET)
    assert scene.bodies == without.bodies
    np.testing.assert_array_equal(SceneSurface(scene).triangles, SceneSurface(without).triangles)
    loaded = pickle.loads(pickle.dumps(pd.Scene(SOLID, FLOOR, pd.Contact(friction={(SOLID, FLOOR): 0.3}))))
    assert loaded.values().contact.friction.tolist() == [[0, 0.3], [0.3, 0]]


def test_without_friction() -> None:
    rough = pd.Collider(TRIANGLE, friction=0.9, pose=(0, 1, 0, 1, 0, 0, 0))
    scene = scene_without_friction(
        pd.Scene(SOLID, rough, pd.Contact(SOLID, rough, friction=0.3, thickness=1e-3, capacity=9, self_contact=False))
    )
    values = scene.values().contact
    assert values is not None
    assert not values.friction.any()
    assert values.poses.tolist() == [[0, 1, 0, 1, 0, 0, 0]]
    assert (values.thickness, values.capacity, values.self_contact.any()) == (1e-3, 9, False)
