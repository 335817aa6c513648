"""Plans keep groups of tetrahedra that average their volume strain together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cases import box
from sheets import cloth

import torchpd as pd
from torchpd.common.gpu import H100
from torchpd.common.tables import DEVICE_SIZES, KINDS
from torchpd.plan.cpu_plan import compile_plan
from torchpd.plan.gpu_plan import compile_device_plan, device_table
from torchpd.plan.kernel_choice import choose_plan
from torchpd.scene import Scene
from torchpd.scene.effects import Solid
from torchpd.scene.scene import SceneValues

LANES, PAIRS = 16, 32  # of a block on the CPU and on a GPU
BLOCK, GRID, STREAM = 0, 2, 3


def values_of(size: int, *others: Any) -> SceneValues:
    mesh = pd.TetMesh(*box((6.0, 4.0, 4.0), (6, 4, 4)))
    values = Scene(Solid(mesh, youngs=1.0, poisson=0.4, averaging=size, density=1.0), *others).values()
    assert values.tet_group is not None
    counts = np.bincount(values.tet_group)
    assert counts.max() == size
    assert len(counts) < 1.1 * len(mesh.tets) / size
    return values


@pytest.mark.parametrize("size", [2, 4])
@pytest.mark.parametrize("patch_size", [64, 4096])
def test_a_group_has_one_lane_of_consecutive_blocks(size: int, patch_size: int) -> None:
    values = values_of(size)
    plan = compile_plan(values, dtype=torch.float64, patch_size=patch_size, progress=False)
    assert plan.sizes[9] == size
    order, volume = (array.numpy().reshape(-1, size, LANES) for array in (plan.tet_order, plan.tet_volume))
    there = volume > 0.0
    # each lane of as many blocks is one group, whole, and padding repeats a member
    groups = values.tet_group[order]
    assert (groups == groups[:, :1]).all()
    assert sorted(order[there]) == list(range(len(values.tets)))
    found = groups[:, 0][there.any(axis=1)]
    assert len(np.unique(found)) == len(found)


@pytest.mark.parametrize("size", [2, 4])
@pytest.mark.parametrize(
    ("kernel", "patches", "others"),
    [(BLOCK, 1, ()), (GRID, 5, ()), (STREAM, 1, ()), (STREAM, 5, ()), (BLOCK, 1, (cloth(),)), (STREAM, 5, (cloth(),))],
)
def test_a_group_is_a_pair_or_two_neighbouring_ones(size: int, kernel: int, patches: int, others: Any) -> None:
    values = values_of(size, *others)
    names = [row.name for row in device_table(values)]
    plan = dict(zip(names, compile_device_plan(values, patches, kernel, torch.float32, progress=False), strict=True))
    assert plan["sizes"][DEVICE_SIZES.index("members")] == size
    tets = plan["pair_tet"].numpy().reshape(-1, 2, PAIRS)
    coupled = plan["pair_coupled"].numpy().reshape(-1, PAIRS) if size == 4 else np.zeros((len(tets), PAIRS))
    where: dict[int, set[tuple[int, int]]] = {}
    for block, which, lane in np.argwhere(tets >= 0):
        place = lane // 2 * 2 if coupled[block, lane] else lane
        where.setdefault(int(values.tet_group[tets[block, which, lane]]), set()).add((int(block), int(place)))
    assert sorted(tets[tets >= 0]) == list(range(len(values.tets)))
    assert all(len(places) == 1 for places in where.values())
    lanes = [place for places in where.values() for place in places]
    assert len(set(lanes)) == len(lanes)


@pytest.mark.parametrize(("kernel", "patches"), [(BLOCK, 1), (STREAM, 3)])
def test_tets_beside_a_volume_energy_are_marked(kernel: int, patches: int) -> None:
    """Stencils have it for one of two solids, whose tetrahedra are alone; the other one's are in groups of four."""
    mesh = pd.TetMesh(*box((2.0, 2.0, 2.0), (2, 2, 2)))
    grouped = Solid(mesh, youngs=1.0, poisson=0.4, averaging=4, density=1.0)
    traceless = Solid(mesh.translated((5.0, 0.0, 0.0)), youngs=1.0, poisson=0.4, law="volume", density=1.0)
    values = Scene(grouped, traceless).values()
    names = [row.name for row in device_table(values)]
    plan = dict(zip(names, compile_device_plan(values, patches, kernel, torch.float64, progress=False), strict=True))
    tets, bound = plan["pair_tet"].numpy().reshape(-1), plan["pair_bound"].numpy().reshape(-1)
    there = tets >= 0
    assert sorted(tets[there]) == list(range(len(values.tets)))
    assert ((bound[there] < 0.0) == (values.tet_group[tets[there]] < 0)).all()
    count = int(plan["stencil_sizes"][4 + list(KINDS).index("volume")])
    assert count == (bound[there] < 0.0).sum() == len(mesh.tets)


def test_patches_do_not_cut_a_group() -> None:
    mesh = pd.TetMesh(np.concatenate([np.zeros((1, 3)), np.eye(3), np.ones((1, 3))]), [[0, 1, 2, 3], [1, 2, 3, 4]])
    values = Scene(Solid(mesh, youngs=1.0, poisson=0.4, averaging=2, density=1.0)).values()
    with pytest.raises(ValueError, match=r"patches must lie in 1\.\.1, "):
        compile_device_plan(values, 2, GRID, torch.float32, progress=False)
    for kernel in ("block", "grid", "stream"):
        plan = choose_plan(values, torch.float32, H100, kernel, progress=False)
        assert (plan.size("members"), plan.patches) == (2, 1)


def test_groups_that_no_pairs_make_are_refused() -> None:
    """One tetrahedron with three neighbours: a GPU has no place for it."""
    vertices = np.concatenate([np.zeros((1, 3)), np.eye(3), [[1.0, 1.0, 1.0], [-1.0, 0.2, 0.1], [0.3, -1.0, 0.2]]])
    tets = np.array([[0, 1, 2, 3], [1, 3, 2, 4], [0, 3, 2, 5], [0, 1, 3, 6]])
    corners = vertices[tets]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    mesh = pd.TetMesh(vertices, np.where(turned[:, None], tets[:, [0, 2, 1, 3]], tets))
    values = Scene(Solid(mesh, youngs=1.0, poisson=0.4, averaging=np.zeros(4, dtype=int), density=1.0)).values()
    assert compile_plan(values, progress=False).sizes[9] == 4
    with pytest.raises(ValueError, match="common face"):
        compile_device_plan(values, 1, BLOCK, torch.float32, progress=False)
    apart = replace(values, tet_group=np.array([0, 1, 1, 0]))
    with pytest.raises(ValueError, match="group of 2 does not"):
        compile_device_plan(apart, 1, BLOCK, torch.float32, progress=False)
