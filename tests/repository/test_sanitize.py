"""tools/sanitize.py, as far as it goes without a GPU: the plans of its scenes, and what it says of kernels that ran."""

from __future__ import annotations

import itertools
import runpy
from collections import Counter
from typing import Any

import pytest
import torch
from programs import ROOT

from torchpd import _C
from torchpd.common.gpu import Properties
from torchpd.plan import Plan
from torchpd.plan import kernel_choice as regimes

TOOLS = ROOT / "tools"
H100 = Properties(132, 232448, 16)
FAR_THREADS = {torch.float32: 384, torch.float64: 192}  # global_memory_threads of csrc/cuda/fused/kernels.cuh
PIPELINE_SLOTS = 1024  # csrc/cuda/stream/pipeline.h
ROUNDS_WARPS = 4  # csrc/cuda/stream/rigid.h: with more parts a team has several blocks


@pytest.fixture(name="tool", scope="module")
def fixture_tool() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        return runpy.run_path(str(TOOLS / "sanitize.py"))


def plans_of(tool: dict[str, Any], kernel: str, dtype: torch.dtype, **flags: bool) -> list[Plan]:
    """For all of a kernel's meshes."""
    plans = []
    for case in tool["KERNEL_CASES"][kernel]:
        values = tool["scene"](case.mesh, **flags).values()
        with tool["compiled_for"](kernel, case) as name:
            plans.append(regimes.choose_plan(values, dtype, H100, name, progress=False))
    return plans


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_patches_are_what_the_kernels_are_to_see(tool: dict[str, Any], dtype: torch.dtype) -> None:
    constants = dict(vars(regimes))
    for contacts, pieces, pins in itertools.product((False, True), repeat=3):
        plans = {
            kernel: plans_of(tool, kernel, dtype, contacts=contacts, pieces=pieces, pins=pins)
            for kernel in tool["KERNELS"]
        }
        for plan in (*plans["grid"], *plans["far"], plans["stream"][0]):
            assert len(plan.shared_start) > 1  # else nothing is exchanged
        assert plans["stream"][1].size("parts") > ROUNDS_WARPS
        (far,) = plans["far"]
        assert min(far.size("most_slots"), 2 * far.size("most_pairs")) > FAR_THREADS[dtype]
        assert bool((far.patch_outer > 0).all())
        assert any(plan.size("most_slots") > PIPELINE_SLOTS for plan in plans["large"])
        assert {plan.patches > 8 for plan in plans["cluster"]} == {False, True}
        assert all(plan.size("most_pairs") <= _C.most_sharing_pairs for plan in plans["several"])
        assert [plan.size("most_pairs") > _C.most_sharing_pairs for plan in plans["block"]] == [True, True, False]
    assert vars(regimes) == constants


def test_every_way_is_planted_an_error_that_shows(tool: dict[str, Any]) -> None:
    """No array ends where another may begin."""
    for kernel in tool["KERNELS"]:
        values = tool["planted_scene"](kernel).values()
        with tool["compiled_for"](kernel, tool["KERNEL_CASES"][kernel][0]) as name:
            plan = regimes.choose_plan(values, torch.float32, H100, name, progress=False)
        assert len(tool["without_last"](plan.part_slot)) == len(plan.part_slot) - 1
    patches = tool["ball_of_patches"]()
    _, starts, entries, *_ = tool["behind_list"](patches).lists
    assert int(starts[-1]) == len(entries) + 1
    assert int(tool["samples_everywhere"](patches).patch.max()) == len(patches.triangles) - 1


def test_kernels_that_did_not_run_are_named(tool: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """As the profiler names them, with what they take, or with other blanks."""
    expected = tool["expected_kernels"](clusters=True)
    assert len(expected) > 200
    assert all(name.startswith("pd::") for name in expected)
    signatures = (
        "void pd::generic::fused_step<float, true, true, (pd::generic::Blocks)1, true, 512>(pd::FusedCall<float>)",
        "void pd::freeform::freeform_items<pd::freeform::CellBoxes<double>>(pd::freeform::CellBoxes<double>, long)",
    )
    assert {tool["plain"](signature) for signature in signatures} < expected
    assert tool["report_missing"](Counter(expected), expected)
    some = sorted(expected)
    assert not tool["report_missing"](Counter(some[1:]), expected)
    assert f"never ran: {some[0]}" in capsys.readouterr().out
    assert not tool["report_missing"](Counter([*some, "pd::new<float>"]), expected)
    assert "pd::new<float>" in capsys.readouterr().out


def test_without_clusters_none_of_their_kernels_is_expected(tool: dict[str, Any]) -> None:
    """Two precisions; held, loose and touching bodies; near and far, few threads and many."""
    assert len(tool["expected_kernels"](clusters=True) - tool["expected_kernels"](clusters=False)) == 24


@pytest.mark.parametrize(
    ("planted", "kernels", "word"),
    [("memcheck", ["grid", "far"], "one kernel"), ("racecheck", ["patches"], "no shared memory"),
     ("initcheck", ["patches"], "PYTORCH_NO_CUDA_MEMORY_CACHING"), ("racecheck", ["grid"], "")],
)  # fmt: skip
def test_what_cannot_be_planted(
    tool: dict[str, Any], monkeypatch: pytest.MonkeyPatch, planted: str, kernels: list[str], word: str
) -> None:
    monkeypatch.delenv("PYTORCH_NO_CUDA_MEMORY_CACHING", raising=False)
    found = tool["why_not_plant"](planted, kernels)
    assert word in found
    assert bool(found) == bool(word)
