"""Where the batch is known, a GPU gets the kernel that takes least, by measured times: no GPU is needed to know."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from device_plans import box_values
from programs import ROOT

import torchpd as pd
from torchpd.common.gpu import H100, Properties
from torchpd.plan import Plan, kernel_benchmark, kernel_costs
from torchpd.plan.kernel_choice import choose_plan, shared_bytes
from torchpd.plan.kernel_costs import concurrent_environments, iteration_microseconds, kernel_microseconds

# of those that benchmarks/kernels_by_batch.py measures, what is quickly made
REGULAR = [(3, 3, 3), (15, 3, 3), (8, 5, 5), (15, 4, 4), (25, 5, 5), (19, 8, 8), (40, 8, 8), (39, 15, 15), (60, 24, 24)]
MESHES = [("regular", cells) for cells in REGULAR] + [
    ("irregular", cells) for cells in [(3, 3, 3), (15, 4, 4), (9, 9, 9)]
]


@pytest.fixture(scope="module")
def measured() -> list[dict[str, Any]]:
    file = ROOT / "benchmarks" / "results" / "kernels-by-batch-h100.json"
    rows: list[dict[str, Any]] = json.loads(file.read_text())["rows"]
    return rows


@pytest.mark.parametrize(("mesh", "cells"), MESHES)
def test_auto_takes_the_kernel_that_was_the_quickest(
    mesh: str, cells: tuple[int, int, int], measured: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of no batch that was measured on an H100 does it take one that was an eighth slower than the best."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    values = importlib.import_module("gpu_scenes").GpuScene("bars", cells, mesh=mesh).build().values()
    tets = len(values.tets)
    rows = [row for row in measured if (row["mesh"], row["tets"]) == (mesh, tets)]
    assert len(rows) >= 2
    for row in rows:
        dtype = getattr(torch, row["dtype"])
        plan = choose_plan(values, dtype, H100, batch=row["batch"], progress=False)
        times = {kernel: own["microseconds"] for kernel, own in row["kernels"].items()}
        assert times[str(plan.kernel)] <= 1.125 * min(times.values()), (row["batch"], plan.kernel)
        # with the patches that were measured
        assert plan.patches == row["kernels"][plan.kernel]["patches"]
        assert f"{row['batch']} environment" in plan.why
        if dtype == torch.float32:  # `solver="auto"` compares these times with those of other solvers
            expected = iteration_microseconds(plan, tets, row["batch"], H100)
            assert 0.7 < times[str(plan.kernel)] / expected < 1.35, (row["batch"], plan.kernel)


def test_time_of_an_iteration_by_hand(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """Turns and tetrahedra counted: 40 multiprocessors, 750 tetrahedra."""
    monkeypatch.setattr(kernel_costs, "_LATENCY", {"block": 2.0, "cluster": 3.0, "grid": 4.0, "stream": 5.0})
    monkeypatch.setitem(kernel_costs._RATE, dtype, 0.02)
    values, gpu = box_values((5, 5, 5)), Properties(40, 232_448, 16)
    tets = len(values.tets)
    assert tets == 750

    def time(kernel: str, batch: int) -> float:
        plan = choose_plan(values, dtype, gpu, kernel, batch=batch, progress=False)
        return iteration_microseconds(plan, tets, batch, gpu)

    # 81 environments: a multiprocessor has 3
    assert time("block", 81) == pytest.approx(2.0 + 0.02 * 3 * 750)
    # ten patches, in two groups of 16 multiprocessors one such cluster each: 5 environments take 3 turns
    assert concurrent_environments(choose_plan(values, dtype, gpu, "cluster"), gpu) == 2
    assert time("cluster", 5) == pytest.approx(3 * (3.0 + 0.02 * 75))
    # five patches of 150 tetrahedra: eight environments at a time
    assert choose_plan(values, dtype, gpu, "grid", batch=5).patches == 5
    assert kernel_microseconds("grid", 5, 750, 81, dtype, gpu) == pytest.approx(11 * (4.0 + 0.02 * 150))
    assert time("stream", 2) == pytest.approx(5.0 + 1.2 * 0.02 * 2 * 750 / 40)


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


def test_benchmark_takes_the_quickest_of_the_kernels_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is timed once, and not again for the same sizes; one that wants too much memory is not taken."""
    monkeypatch.setattr(kernel_benchmark, "_TIMES", {})
    milliseconds = {"block": 3.0, "cluster": math.inf, "grid": 2.0, "stream": 9.0}
    timed = []

    def time(prepare: partial[Any], device: torch.device) -> float:
        timed.append(prepare.args[0].kernel)
        return milliseconds[timed[-1]]

    monkeypatch.setattr(kernel_benchmark, "_milliseconds", time)
    monkeypatch.setattr(torch.cuda, "get_device_name", str)
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.box((1, 1, 1), (5, 5, 5)), 1e5)), progress=False)

    def chosen(batch: int) -> Plan:
        scene = replace(sim.compiled, batch=batch)
        pick = partial(kernel_benchmark.fastest_plan, scene=scene, dtype=torch.float32, device=torch.device("cuda"))
        return choose_plan(scene.scene.values(), torch.float32, H100, "benchmark", batch=batch, fastest=pick)

    plan = chosen(16)
    assert plan.kernel == "grid"
    assert plan.why.endswith("grid 2 ms, block 3 ms, stream 9 ms, cluster inf ms")
    assert sorted(timed) == ["block", "cluster", "grid", "stream"]
    assert chosen(16).kernel == "grid"
    assert len(timed) == 4
    milliseconds["grid"] = 4.0
    assert chosen(17).kernel == "block"
