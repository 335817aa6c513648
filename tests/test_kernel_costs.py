"""Where the batch is known, a GPU gets the kernel that takes least, by measured times: no GPU is needed to know."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from cases import box
from device_plans import box_values
from programs import ROOT

import torchpd as pd
from torchpd import kernel_costs
from torchpd.gpu import H100, Properties
from torchpd.kernel_costs import block_microseconds, clusters_together, grid_microseconds, iteration_microseconds
from torchpd.regimes import choose_plan, shared_bytes

# cells of those that benchmarks/kernels_by_batch.py measures
MESHES = [(3, 3, 3), (15, 3, 3), (8, 5, 5), (15, 4, 4), (25, 5, 5), (19, 8, 8), (40, 8, 8), (39, 15, 15), (60, 24, 24)]


@pytest.fixture(scope="module")
def measured() -> list[dict[str, Any]]:
    file = ROOT / "benchmarks" / "results" / "kernels-by-batch-h100.json"
    rows: list[dict[str, Any]] = json.loads(file.read_text())["rows"]
    return rows


@pytest.mark.parametrize("cells", MESHES)
def test_auto_takes_the_kernel_that_was_the_quickest(
    cells: tuple[int, int, int], dtype: torch.dtype, measured: list[dict[str, Any]]
) -> None:
    """Of no batch that was measured on an H100 does it take one that was an eighth slower than the best."""
    vertices, tets = box((0.1 * cells[0], 0.1 * cells[1], 0.1 * cells[2]), cells)
    values = pd.Scene(pd.Solid(pd.TetMesh(vertices, tets), 1e5)).values()
    precision = str(dtype).removeprefix("torch.")
    rows = [row for row in measured if (row["mesh"], row["tets"], row["dtype"]) == ("regular", len(tets), precision)]
    assert len(rows) >= 2
    for row in rows:
        assert row["vertices"] == len(vertices)
        plan = choose_plan(values, dtype, H100, batch=row["batch"], progress=False)
        times = {kernel: own["microseconds"] for kernel, own in row["kernels"].items()}
        assert times[str(plan.kernel)] <= 1.125 * min(times.values()), (row["batch"], plan.kernel)
        # with the patches that were measured
        assert plan.patches == row["kernels"][plan.kernel]["patches"]
        expected = iteration_microseconds(plan, len(tets), row["batch"], H100)
        assert 0.7 < times[str(plan.kernel)] / expected < 1.35, (row["batch"], plan.kernel)
        assert f"{expected:.1f} us an iteration" in plan.why or f"{expected:,.0f} us an iteration" in plan.why


def test_on_meshes_that_nothing_was_fitted_to(measured: list[dict[str, Any]]) -> None:
    """Irregular ones."""
    rows = [row for row in measured if row["mesh"] == "irregular"]
    assert len(rows) > 20
    assert max(row["auto_takes_longer"] for row in rows) < 1.25


def test_time_of_an_iteration_by_hand(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Waves, turns and tetrahedra counted: 40 multiprocessors, 81 environments of 750 tetrahedra."""
    fit = kernel_costs._Fit((0.5, 0.005), (1.0, 0.01), (2.0, 0.02), (3.0, 0.04), (4.0, 0.08), 20.0, (5.0, 0.01))
    monkeypatch.setitem(kernel_costs._FITS, dtype, fit)
    values, gpu = box_values((5, 5, 5)), Properties(40, 232_448, 16)
    tets = len(values.tets)
    assert tets == 750

    def time(kernel: str, batch: int) -> float:
        plan = choose_plan(values, dtype, gpu, kernel, batch=batch, progress=False)
        return iteration_microseconds(plan, tets, batch, gpu)

    # a multiprocessor has 3 environments; one waits longer than to be issued
    assert time("block", 81) == pytest.approx(2.0 + 0.02 * 3 * 750)
    monkeypatch.setitem(kernel_costs._FITS, dtype, fit._replace(block=(30.0, 0.01)))
    assert time("block", 40) == pytest.approx(30.0 + 0.01 * 750)
    # of the smallest meshes they wait less; 384 tetrahedra are the most
    waits = [block_microseconds(small, 40, dtype, gpu) for small in (384, 385)]
    monkeypatch.setitem(kernel_costs._FITS, dtype, fit._replace(small_block=(20.0, 0.005), block=(30.0, 0.01)))
    waits += [block_microseconds(small, 40, dtype, gpu) for small in (384, 385)]
    assert waits == pytest.approx([2.0 + 0.02 * 384, 30.0 + 3.85, 20.0 + 1.92, 30.0 + 3.85])
    # ten patches, in two groups of 16 multiprocessors one such cluster each
    assert clusters_together(choose_plan(values, dtype, gpu, "cluster"), gpu) == 2
    assert time("cluster", 5) == pytest.approx(3 * (3.0 + 0.04 * 750))
    # five patches of 150 tetrahedra: eight environments at a time; an exchange takes 20 us at the least
    assert choose_plan(values, dtype, gpu, "grid", batch=5).patches == 5
    assert grid_microseconds(750, 5, 81, dtype, gpu) == 11 * 20.0
    assert grid_microseconds(750, 3, 14, dtype, gpu) == pytest.approx(2 * (4.0 + 0.08 * 250))
    assert time("stream", 2) == pytest.approx(5.0 + 0.01 * 132 / 40 * 2 * 750)


def test_a_grid_has_as_few_patches_as_let_enough_environments_run(dtype: torch.dtype) -> None:
    """Alone many small ones; of a batch as many as share the device, as long as the patches fit."""
    values = box_values((20, 8, 8))  # 7680 tetrahedra
    counts = [choose_plan(values, dtype, H100, "grid", batch=batch).patches for batch in (1, 4, 16, 1_000_000)]
    assert counts[:3] == [51, 33, 8]
    least = counts[3]
    assert least < 8
    # no fewer fit, and asked for without a batch it is as for one
    shared = shared_bytes(choose_plan(values, dtype, H100, "grid", batch=1_000_000), 0, 0)
    assert choose_plan(values, dtype, H100._replace(shared=shared - 1), "grid", batch=1_000_000).patches > least
    assert choose_plan(values, dtype, H100, "grid").patches == 51


def test_what_is_asked_for_counts_and_what_fits(dtype: torch.dtype) -> None:
    values = box_values((5, 5, 5))
    kernels = [choose_plan(values, dtype, H100, batch=batch).kernel for batch in (None, 1, 1024)]
    assert kernels == ["block", "cluster", "block"]
    assert choose_plan(values, dtype, H100, "block", batch=1).kernel == "block"
    assert choose_plan(values, dtype, H100._replace(cluster=1), batch=1).kernel == "grid"
    assert choose_plan(values, dtype, H100._replace(shared=1000), batch=1).kernel == "stream"
    assert choose_plan(box_values((14, 14, 14)), dtype, H100, batch=1, progress=False).kernel == "grid"


def test_blocks_are_shaped_for_the_environments_of_a_multiprocessor() -> None:
    """Rounded up; without a batch nobody knows them."""
    values = box_values((3, 3, 3))

    def environments(kernel: str, batch: int | None) -> int:
        return choose_plan(values, torch.float32, H100, kernel, batch=batch).size("environments")

    assert [environments("block", batch) for batch in (None, 1, 132, 133, 8192, 1 << 40)] == [0, 1, 1, 2, 63, 1 << 20]
    assert environments("grid", 8192) == 0
