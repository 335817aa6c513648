"""The search of csrc/solver/contact against brute force: the same pairs in the order of their keys, and the balls."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from programs import HELPERS, compiled

import torchpd as pd
from torchpd.geometry.closest_points import segment_distances, triangle_distances
from torchpd.plan.contact_plan import ContactPlan
from torchpd.simulation.body_contact import BodyContact

Array = NDArray[np.float64]
Index = NDArray[np.int64]
REACH, ROOM, CELLS = 1.2, 0.49, 0.25  # csrc/contact/pairs/pair.h


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = (HELPERS / "contact" / "search_program.cpp").read_text(encoding="utf-8")
    return compiled(source, tmp_path_factory.mktemp("search"))


@dataclass(frozen=True)
class Case:
    """Places and targets [N, 3] m of a scene."""

    contact: BodyContact
    places: Array
    targets: Array

    @property
    def plan(self) -> ContactPlan:
        return self.contact.plan


@dataclass(frozen=True)
class Found:
    most: int
    listed: int
    balls: Array  # [N] m
    itself: Index  # [bodies] whether they are asked with themselves
    largest: Array  # [bodies] m, of balls
    keys: Index


def box(cells: tuple[int, int, int], center: tuple[float, float, float]) -> pd.Solid:
    """Cells of 25 mm."""
    mesh = pd.shapes.box(tuple(0.025 * n for n in cells), cells)
    return pd.Solid(mesh.translated(tuple(np.subtract(center, mesh.vertices.mean(axis=0)))), youngs=1e5, density=1000.0)


def level(size: float, cells: int, height: float) -> pd.TriMesh:
    mesh = pd.shapes.sheet((size, size), (cells, cells))
    middle = mesh.vertices.mean(axis=0)
    x, y, z = (mesh.vertices - middle).T
    flat = np.stack([x, z + height, y] if np.ptp(z) == 0.0 else [x, y + height, z], axis=1)
    return pd.TriMesh(flat, mesh.triangles)


def scene(several: bool) -> pd.Scene:
    """Solids, a cloth that meets itself, and a collider; `several`: over 32 clusters, and bodies of less than one."""
    bodies: list[Any] = [
        box((4, 4, 3), (0.0, 0.06, 0.0)),
        pd.Cloth(level(0.3, 24 if several else 9, 0.115), youngs=1e5, thickness=1e-3, area_density=0.2, bending=1e-5),
        pd.Collider(level(0.4, 5, 0.0)),
    ]
    if several:
        bodies += [box((1, 1, 1), (0.03 * n, 0.14, 0.04)) for n in range(-2, 3)]
    return pd.Scene(*bodies, pd.Contact(thickness=1e-3))


def case(several: bool, seed: int, noise: float, way: float) -> Case:
    """Every body shifted and turned by up to 2 cm and .3 rad, its vertices by `noise` of a cell."""
    sim = pd.Simulator(scene(several), dtype=torch.float64, progress=False)
    assert sim.body_contact is not None
    plan, random = sim.body_contact.plan, np.random.default_rng(seed)
    places = plan.rest.copy()
    for body in range(int(plan.body.max()) + 1):
        own = plan.body == body
        middle = places[own].mean(axis=0)
        turn = np.linalg.qr(np.eye(3) + 0.3 * random.uniform(-1.0, 1.0, (3, 3)))[0]
        turn *= np.sign(np.diag(turn))
        places[own] = (places[own] - middle) @ turn + middle + random.uniform(-0.02, 0.02, 3)
    places += noise * plan.cell[:, None] * random.uniform(-1.0, 1.0, places.shape)
    return Case(sim.body_contact, places, places + way * random.standard_normal(places.shape))


def search(program: Path, of: Case, capacity: int | None = None) -> Found:
    plan, arrays = of.plan, of.contact.arrays
    bodies, colliders, given, points, edges, _ = arrays[0].tolist()
    sizes = [
        len(plan.body), len(of.plan.shape), len(plan.triangles), len(plan.edges), len(plan.vertices), bodies, colliders,
        given if capacity is None else capacity, len(arrays[8]), points, edges, len(plan.near.keys),
    ]  # fmt: skip
    numbers = [sizes, *arrays[1:], plan.kinematic, of.places, of.targets]
    rows = [np.asarray(row, dtype=np.float64).reshape(-1) for row in numbers]
    text = "\n".join(" ".join([str(len(row)), *map(repr, row.tolist())]) for row in rows)
    out = subprocess.run([str(program)], input=text, capture_output=True, text=True, check=True).stdout.split("\n")
    most, listed, kept = map(int, out[0].split())
    balls, largest = (np.array(out[row].split(), dtype=float) for row in (1, 3))
    itself, keys = (np.array(out[row].split(), dtype=np.int64) for row in (2, 4))
    assert len(keys) == kept
    return Found(most, listed, balls, itself, largest, keys)


@dataclass(frozen=True)
class Sides:
    """All pairs that count, by brute force."""

    keys: Index
    one: Index  # [n, 2] vertices of a side, the last one repeated
    other: Index  # [n, 3]
    distance: Array


def near(low: Array, high: Array, others_low: Array, others_high: Array, reach: float) -> tuple[Index, Index]:
    """Boxes that are nearer than `reach`: distances of all pairs of the larger scenes would take minutes."""
    meet = np.ones((len(low), len(others_low)), dtype=bool)
    for axis in range(3):
        meet &= low[:, None, axis] <= others_high[:, axis] + reach
        meet &= others_low[:, axis] <= high[:, None, axis] + reach
    one, other = np.nonzero(meet)
    return one, other


def all_pairs(of: Case) -> Sides:
    plan, x = of.plan, of.places
    number, edges = len(plan.rest), plan.edges.astype(np.int64)
    points, corners, ends = x[plan.vertices], x[plan.triangles], x[edges]
    reach = 2.0 * CELLS * plan.cell.max() + plan.thickness
    vertex, triangle = near(points, points, corners.min(axis=1), corners.max(axis=1), reach)
    first, second = near(*(f(axis=1) for f in (ends.min, ends.max) * 2), reach)
    first, second = first[first < second], second[first < second]
    vertex = plan.vertices[vertex].astype(np.int64)
    one = np.concatenate([np.stack([vertex, vertex], axis=1), edges[first]])
    other = np.concatenate([plan.triangles[triangle], edges[second][:, [0, 1, 1]]])
    keys = np.concatenate([
        vertex * len(plan.triangles) + triangle, number * len(plan.triangles) + first * len(edges) + second
    ])  # fmt: skip
    counts = (one[:, :, None] != other[:, None, :]).all(axis=(1, 2))
    counts &= ~(plan.kinematic[one].all(axis=1) & plan.kinematic[other].all(axis=1))
    counts &= (plan.body[one[:, 0]] != plan.body[other[:, 0]]) | plan.self_contact[plan.body[one[:, 0]]]
    counts &= ~np.isin(keys, plan.near.keys[plan.near.thickness == 0.0])
    keys, one, other, edge = keys[counts], one[counts], other[counts], (np.arange(len(counts)) >= len(vertex))[counts]
    distance = np.empty(len(keys))
    distance[~edge] = triangle_distances(x[one[~edge, 0]], x[other[~edge]])
    distance[edge] = segment_distances(x[one[edge]], x[other[edge][:, :2]])
    return Sides(keys, one, other, distance)


def check(of: Case, found: Found) -> Index:
    """Balls by their definition and pairs by the balls; returns the keys."""
    plan, all_of = of.plan, all_pairs(of)
    surface = np.zeros(len(plan.rest), dtype=bool)
    surface[plan.vertices] = True
    most, whole = found.largest[plan.body], CELLS * plan.cell
    asked = (found.itself == 1) | ~plan.self_contact
    np.testing.assert_allclose(most[surface & asked[plan.body]], whole[surface & asked[plan.body]], rtol=1e-12)
    assert np.all(most <= whole * (1.0 + 1e-12))
    within = all_of.distance <= most[all_of.one].max(axis=1) + most[all_of.other].max(axis=1) + plan.thickness
    own = plan.body[all_of.one[:, 0]] == plan.body[all_of.other[:, 0]]
    assert np.all(asked[plan.body[all_of.one[within & own, 0]]])  # parts of others are out of reach
    room = np.full(len(plan.rest), np.inf)
    for vertices in (*all_of.one.T, *all_of.other.T):
        np.minimum.at(room, vertices[within], all_of.distance[within])
    free = ~plan.kinematic
    wanted = REACH * np.linalg.norm(of.targets - of.places, axis=1) + plan.thickness * free
    balls = np.minimum(np.maximum(wanted, np.where(free, ROOM * (room - plan.thickness), 0.0)), most)
    np.testing.assert_allclose(found.balls[surface], balls[surface], rtol=1e-12)
    assert np.all(np.isinf(found.balls[~surface]))
    reach = found.balls[all_of.one].max(axis=1) + found.balls[all_of.other].max(axis=1) + plan.thickness
    return np.sort(all_of.keys[all_of.distance <= reach])


@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize(("noise", "way"), [(0.0, 1e-4), (0.01, 3e-4), (0.3, 5e-3)])
@pytest.mark.parametrize("seed", [0, 1])
def test_pairs_are_those_of_brute_force(program: Path, several: bool, noise: float, way: float, seed: int) -> None:
    of = case(several, seed, noise, way)
    found = search(program, of)
    keys = check(of, found)
    assert len(keys) > 0
    np.testing.assert_array_equal(found.keys, keys)
    assert found.itself[0] == (noise > 0.1)  # a solid near its rest shape is not asked


def test_a_full_list_changes_nothing(program: Path) -> None:
    """Near pairs that do not fit are looked for again."""
    of = case(False, 0, 0.3, 5e-4)
    whole = search(program, of)
    short = search(program, of, capacity=len(whole.keys))
    assert short.listed > 2 * len(whole.keys)
    np.testing.assert_array_equal(short.keys, whole.keys)
    np.testing.assert_array_equal(short.balls, whole.balls)


def test_more_pairs_than_the_capacity(program: Path) -> None:
    """None are kept, and their number is known."""
    of = case(False, 0, 0.3, 5e-3)
    whole = search(program, of)
    few = search(program, of, capacity=10)
    assert (few.most, len(few.keys)) == (len(whole.keys), 0)


def test_bodies_far_apart_are_not_asked(program: Path) -> None:
    """Only the cloth is, with itself; it finds what its balls reach within its plane."""
    of = case(False, 0, 0.0, 1e-4)
    apart = 10.0 * np.eye(3)[of.plan.body]
    away = replace(of, places=of.places + apart, targets=of.targets + apart)
    found = search(program, away)
    np.testing.assert_array_equal(found.keys, check(away, found))
    assert found.itself.tolist() == [0, 1, 0]
