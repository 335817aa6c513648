"""Quadratic stencils as rows of a matrix in the plans of a GPU: forces, energy, diagonal and the entries of a step."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from cases import Case
from device_plans import BLOCK, LANES, NONE, SIZES, STREAM, Arrays, Lanes
from mixed_scenes import CASES, rod_case
from numpy.typing import NDArray
from sheets import cloth, surface

import torchpd as pd
from torchpd.common.tables import KINDS, ROW_SIZES
from torchpd.plan.cpu_plan import Plan
from torchpd.plan.gpu_plan import compile_device_plan, device_table
from torchpd.plan.kernel_choice import shared_bytes
from torchpd.scene import SceneValues
from torchpd.scene.stencils import KINDS as SCENE_KINDS
from torchpd.scene.stencils import StencilGroup

PLANS = [(BLOCK, 1), (STREAM, 1), (STREAM, 7)]
FLAT = ("free sheet", "flat sheet", "ties", "mixed", "mixed, poisson")
Reals = NDArray[np.floating]


def arrays_of(values: SceneValues, patches: int, kernel: int, dtype: torch.dtype = torch.float64) -> Arrays:
    tensors = compile_device_plan(values, patches, kernel, dtype)
    return Arrays(**{row.name: t.numpy() for row, t in zip(device_table(values), tensors, strict=True)})


def quadratic(values: SceneValues) -> list[StencilGroup]:
    return [group for group in values.stencils if group.is_quadratic]


def weights(group: StencilGroup) -> NDArray[np.float64]:
    """w V of every stencil."""
    return group.measure * group.material[KINDS[group.kind].rows[0]]


class Rows:
    """The rows of a plan, with their numbers from its terms, lane by lane."""

    def __init__(self, plan: Arrays, values: SceneValues) -> None:
        blocks, lines = np.diff(plan.row_start), plan.row_neighbour.view(np.uint32).reshape(-1, LANES)
        patch = np.repeat(np.arange(len(plan.patch_row) - 1), np.diff(plan.patch_row))
        packed = plan.row_corner.view(np.uint32).reshape(-1, LANES)
        self.patch = patch[:, None]  # [blocks, 1]
        self.slot, self.entry = (packed & 65535).astype(np.int64) // 8, (packed >> 16).astype(np.int64)
        self.live = self.entry != NONE
        self.block = np.repeat(np.arange(len(blocks)), blocks)  # of each line
        self.vertex = self._vertex(plan, self.patch, self.slot)
        neighbour = np.stack([lines & 65535, lines >> 16], axis=-1).astype(np.int64) // 8  # [lines, 32, 2]
        self.neighbour = self._vertex(plan, self.patch[self.block][..., None], neighbour)
        number = self._numbers(plan, values)
        count = 2 * lines.size
        self.t = number[0, :count].reshape(-1, LANES, 2)
        self.diagonal = number[:, count:].reshape(2, -1, LANES)  # at rest, of the majoriser

    @staticmethod
    def _vertex(plan: Arrays, patch: NDArray[np.int64], slot: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.asarray(plan.vertex_order[plan.slot_vertex[plan.patch_slot[patch] + slot]], dtype=np.int64)

    @staticmethod
    def _numbers(plan: Arrays, values: SceneValues) -> Reals:
        """Sums of w g_a . g_b, and of the same times l_e."""
        stencil, corner = np.divmod(plan.row_term, 32)
        block, lane = np.divmod(stencil, LANES)
        # in the precision of the plan, as a GPU computes them
        weight, product = (np.zeros(len(stencil), plan.stencil_stored.dtype) for _ in range(2))
        for group in quadratic(values):
            here = plan.stencil_block[block, 0] == list(KINDS).index(group.kind)
            order = plan.stencil_order[block, lane][here]
            edges = plan.stencil_block[block[here], 2][:, None] + np.arange(group.corners.shape[1] - 1)
            g = plan.stencil_stored[edges, lane[here][:, None]]
            g = np.concatenate([-g.sum(axis=1, keepdims=True), g], axis=1)
            rows = np.arange(len(g))
            weight[here] = weights(group)[order]
            assert (plan.stencil_measure[block, lane][here] > 0.0).all()  # no padding
            product[here] = g[rows, corner[here] // 5] * g[rows, corner[here] % 5]
        terms = weight * product
        ends = plan.term_start

        def sums(terms: Reals) -> Reals:
            return np.array([terms[a:b].sum() for a, b in itertools.pairwise(ends)], terms.dtype)

        return np.stack([sums(terms), sums(terms * plan.stencil_bound[block, lane])])

    def forces(self, x: Reals) -> Reals:
        """What each lane writes to its entry, [blocks, 32, 3]."""
        own = x[self.vertex[self.block]]
        found = np.zeros((*self.slot.shape, 3), x.dtype)
        t = self.t.astype(x.dtype)
        for side in (0, 1):
            np.add.at(found, self.block, t[..., side, None] * (x[self.neighbour[..., side]] - own))
        return found

    def energy(self, x: Reals) -> float:
        edges = x[self.neighbour] - x[self.vertex[self.block]][:, :, None]
        return -0.25 * float((self.t * (edges**2).sum(axis=-1)).sum())

    def gathered(self, lanes: Reals, vertices: int) -> Reals:
        """Sums of numbers of lanes at vertices, over patches."""
        sums = np.zeros((vertices, *lanes.shape[2:]), lanes.dtype)
        np.add.at(sums, self.vertex[self.live], lanes[self.live])
        return sums


def forces_of(values: SceneValues, x: Reals) -> tuple[Reals, float]:
    """Gradient and energy of the quadratic stencils, from F = sum g_a x_a."""
    sums, energy = np.zeros_like(x), 0.0
    for group in quadratic(values):
        g = group.gradients[..., 0].astype(x.dtype)
        edges = x[group.corners[:, 1:]] - x[group.corners[:, :1]]
        curvature = (g[:, 1:, None] * edges).sum(axis=1)
        stress = weights(group).astype(x.dtype)[:, None] * curvature
        np.add.at(sums, group.corners, g[..., None] * stress[:, None])
        energy += 0.5 * float((stress * curvature).sum())
    return sums, energy


@pytest.fixture(scope="module", params=itertools.product(FLAT, PLANS), ids=lambda p: f"{p[0]}, {p[1]}")
def built(request: pytest.FixtureRequest) -> tuple[Case, SceneValues, Arrays]:
    name, (kernel, patches) = request.param
    case = CASES[name]()
    values = case.scene.values()
    return case, values, arrays_of(values, patches, kernel)


def test_rows_are_the_forces_and_the_energy(built: tuple[Case, SceneValues, Arrays]) -> None:
    case, values, plan = built
    rows = Rows(plan, values)
    forces, energy = forces_of(values, case.positions)
    found = rows.gathered(rows.forces(case.positions), len(case.positions))
    np.testing.assert_allclose(found, forces, rtol=0.0, atol=1e-11 * np.abs(forces).max())
    assert rows.energy(case.positions) == pytest.approx(energy, rel=1e-10)


def test_diagonals_are_those_of_the_stencils(built: tuple[Case, SceneValues, Arrays]) -> None:
    _, values, plan = built
    rows, vertices = Rows(plan, values), len(values.rest_positions)
    rest, majoriser = np.zeros(vertices), np.zeros(vertices)
    for group in quadratic(values):
        g = group.gradients[..., 0]
        squares = weights(group)[:, None] * g**2
        np.add.at(rest, group.corners, squares)
        # d = 1: one eigenvalue, the number of corners that have a share
        np.add.at(majoriser, group.corners, squares * (g != 0.0).sum(axis=1)[:, None])
    for found, expected in zip(rows.diagonal, (rest, majoriser), strict=True):
        np.testing.assert_allclose(rows.gathered(found, vertices), expected, rtol=1e-12)


def test_every_entry_of_a_step_has_one_writer(built: tuple[Case, SceneValues, Arrays]) -> None:
    _, values, plan = built
    parts = []
    if len(plan.pair_tet):
        packed = plan.step_pair_corner.view(np.uint32).reshape(-1, 5, LANES).transpose(0, 2, 1).reshape(-1, 5)
        pairs = Lanes.of(plan)
        assert (packed & 65535 == pairs.slot * 8).all()
        parts.append((np.broadcast_to(pairs.patch[:, None], packed.shape), packed))
    names = list(KINDS)
    for patch, (begin, end) in enumerate(itertools.pairwise(plan.patch_stencil)):
        kinds = [names[kind] for kind in plan.stencil_block[begin:end, 0]]
        rows = {group.kind for group in quadratic(values)}
        as_rows = [kind in rows for kind in kinds]
        assert as_rows == sorted(as_rows)  # elements first
        assert plan.patch_element[patch] == end - sum(as_rows)
        for number, kind in zip(range(begin, end), kinds, strict=True):
            first = plan.stencil_block[number, 1]
            corners = plan.step_corner.view(np.uint32)[first : first + KINDS[kind].corners]
            assert (corners & 65535 == plan.stencil_corner.view(np.uint32)[first : first + len(corners)] & 65535).all()
            assert (corners >> 16 == NONE).all() or kind not in rows
            parts.append((np.full(corners.shape, patch), corners))
    lanes = Rows(plan, values)
    parts.append((np.broadcast_to(lanes.patch, lanes.slot.shape), plan.row_corner.view(np.uint32).reshape(-1, LANES)))
    patch, packed = (np.concatenate([part[i].ravel() for part in parts]) for i in (0, 1))
    entry, slot, used = packed >> 16, (packed & 65535) // 8, packed >> 16 != NONE
    patch, entry, slot = patch[used], entry[used].astype(np.int64), slot[used]
    assert len(np.unique(np.stack([patch, entry]), axis=1).T) == len(patch)
    step = plan.step_row.view(np.uint32)
    row = plan.patch_slot[patch] + slot
    assert ((entry - (step & 65535)[row]) % 8 == 0).all()
    assert ((entry - (step & 65535)[row].astype(np.int64)) // 8 < (step >> 16 & 32767)[row]).all()
    np.testing.assert_array_equal(np.bincount(row, minlength=len(step)), step >> 16 & 32767)
    assert ((step ^ plan.slot_row.view(np.uint32)) >> 31 == 0).all()
    most = plan.row_sizes[ROW_SIZES["step_entries"]]
    assert entry.max() < most <= plan.sizes[SIZES.index("most_entries")]


def test_float32_rows_are_as_near_as_stencils() -> None:
    """A stiff fine sheet with waves, from which the stencils' own float32 error comes too."""
    mesh = surface(size=(1.0, 1.0), cells=(24, 24))
    values = pd.Scene(cloth(mesh, bending=1e-2)).values()
    x = mesh.vertices + 0.02 * np.sin(9.0 * mesh.vertices[:, [2, 0, 1]])
    exact, _ = forces_of(values, x)
    narrow = x.astype(np.float32)
    rows = Rows(arrays_of(values, 1, BLOCK, torch.float32), values)
    assert rows.t.dtype == np.float32
    found = rows.gathered(rows.forces(narrow), len(x))
    today, _ = forces_of(values, narrow)
    error, own = (float(np.linalg.norm(force - exact) / np.linalg.norm(exact)) for force in (found, today))
    assert error <= 2.0 * own


def test_curved_hinges_have_no_rows() -> None:
    values = rod_case().scene.values()
    plan = arrays_of(values, 1, BLOCK)
    assert not quadratic(values)
    assert not plan.row_sizes.any()
    assert not len(plan.row_corner)
    sim = pd.Simulator(rod_case().scene, 1 / 60, progress=False)
    assert "rest_curvature" in sim.material_names
    assert "rest_curvature" not in pd.Simulator(CASES["free sheet"]().scene, 1 / 60, progress=False).material_names


def test_a_step_needs_less_shared_memory() -> None:
    """Of the 18 entries of a vertex of cloth a step keeps 6, and one for its row."""
    mesh = surface(size=(1.0, 1.0), cells=(15, 15))

    def entries(**options: float) -> tuple[int, int]:
        values = pd.Scene(cloth(mesh, bending=1e-3, **options)).values()
        plan = Plan(compile_device_plan(values, 1, BLOCK, torch.float32), table=device_table(values))
        return plan.step_entries, shared_bytes(plan, 0, 0)

    flat, curved = entries(), entries(rest_curvature=1.0)
    assert flat[0] < 0.5 * curved[0]
    assert flat[1] < 0.6 * curved[1]


def test_the_scene_knows_the_quadratic_kinds() -> None:
    assert {name: kind.quadratic for name, kind in SCENE_KINDS.items()} == {
        name: kind.quadratic for name, kind in KINDS.items()
    }
