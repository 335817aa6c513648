"""A GPU that is not there, or has no room, is refused in words before anything moves; no GPU is needed to know."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
import torch
from runs import simulate, simulator, small_case

import torchpd as pd
from torchpd.common.gpu import H100
from torchpd.plan import Plan, compile_plan
from torchpd.plan import placement as placing
from torchpd.plan.compiled import CompiledScene
from torchpd.plan.kernel_choice import choose_plan
from torchpd.plan.material import material_of, material_rows
from torchpd.plan.preconditioner import has_preconditioner
from torchpd.simulation import settings

GPU = torch.device("cuda", 0)
STEP = 123_456  # bytes


@pytest.fixture
def two_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: f"kind {index}")


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch) -> pd.Simulator:
    """A simulator that takes itself to be on a GPU, where a step of its batch wants STEP bytes each."""
    monkeypatch.setattr(placing, "properties_of", lambda _: H100)
    monkeypatch.setattr(placing, "step_bytes", lambda scene, plan, batch, device: STEP * batch)
    sim = simulate(torch.float32)
    sim.plan = choose_plan(sim.scene.values(), torch.float32, H100)
    for kind in (pd.Simulator, CompiledScene):
        monkeypatch.setattr(kind, "device", GPU)
    values = sim.scene.values()
    # the ops would want the plan where the simulator says that it is
    plan, arrays = compile_plan(values, progress=False), material_rows(material_of(values, torch.float32))
    reference = placing.reference_material(plan, arrays, 1 / 60)
    monkeypatch.setattr(placing, "reference_material", lambda *_: reference)
    return sim


def bytes_asked_for(call: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> int:
    """What a call is refused that finds no memory."""
    monkeypatch.setattr(placing, "free_memory", lambda _: 0)
    with pytest.raises(RuntimeError, match=r"plan, .*need [\d,]+ B of memory") as refusal:
        call()
    (needed,) = re.findall(r"need ([\d,]+) B", str(refusal.value))
    return int(needed.replace(",", ""))


def test_a_solver_whose_plan_does_not_fit_is_refused(on_gpu: pd.Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulator is what it was."""
    sim, plan = on_gpu, on_gpu.plan

    def change() -> None:
        sim.solver = pd.Multilevel()

    moved: list[Plan] = []
    asked = bytes_asked_for(change, monkeypatch)
    assert (sim.plan, sim.solver) == (plan, pd.Chebyshev())
    monkeypatch.setattr(placing, "free_memory", lambda _: asked)
    monkeypatch.setattr(Plan, "to", lambda self, device: moved.append(self) or self)
    change()
    assert sim.plan is moved[0]
    assert sim.plan.for_multilevel
    assert asked == sim.plan.bytes + STEP


def test_gradients_by_levels_need_the_kernel_that_reads_them(
    on_gpu: pd.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With patches for the solver; a kernel that cannot is refused by name, and nothing changes."""
    sim, plan = on_gpu, on_gpu.plan
    monkeypatch.setattr(placing, "free_memory", lambda _: 10**9)
    monkeypatch.setattr(Plan, "to", lambda self, device: self)
    assert plan.kernel == "block"
    said = r"""adjoint="multilevel" needs kernel="stream" on a GPU, got kernel='auto' .*block"""
    with pytest.raises(ValueError, match=said):
        sim.adjoint = "multilevel"
    assert (sim.adjoint, sim.plan) == ("solver", plan)
    sim.kernel = "stream"
    sim.adjoint = "multilevel"
    assert (sim.plan.kernel, sim.plan.for_multilevel, has_preconditioner(sim.plan.arrays)) == ("stream", False, True)
    own = sim.plan
    with pytest.raises(ValueError, match="got kernel='block'"):
        sim.kernel = "block"
    assert (sim.kernel, sim.plan) == ("stream", own)
    sim.solver = pd.Multilevel()
    assert (sim.plan.for_multilevel, has_preconditioner(sim.plan.arrays)) == (True, True)
    sim.solver = pd.Chebyshev()
    assert (sim.plan.for_multilevel, has_preconditioner(sim.plan.arrays)) == (False, True)


def test_a_batch_whose_plan_does_not_fit_is_refused(on_gpu: pd.Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    sim, plan = on_gpu, on_gpu.plan
    new = choose_plan(sim.scene.values(), torch.float32, H100, batch=7)
    monkeypatch.setattr(settings, "recompile_plan", lambda *_: new)

    def change() -> None:
        sim.batch = 7

    assert bytes_asked_for(change, monkeypatch) == new.bytes + 7 * STEP
    assert (sim.plan, sim.batch) == (plan, None)


def test_a_body_that_is_let_go_gets_a_plan_once(on_gpu: pd.Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """A compiled one, which has to fit; otherwise the simulator is what it was."""
    sim, plan = on_gpu, on_gpu.plan
    assert plan.size("pieces") == 0
    asked = bytes_asked_for(lambda: sim.set_material(pin_hard=False), monkeypatch)
    assert sim.plan is plan
    assert sim.pin_hard.any()
    monkeypatch.setattr(placing, "free_memory", lambda _: asked)
    monkeypatch.setattr(Plan, "to", lambda self, device: self)
    sim.set_material(pin_hard=False)
    free = sim.plan
    assert free.size("pieces") == 1
    assert asked == free.bytes + STEP
    sim.set_material(pin_hard=True)
    sim.set_material(pin_hard=torch.zeros(3, len(sim.pin_hard), dtype=torch.bool))
    assert sim.plan is free


def test_what_moves_to_a_gpu_has_to_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan, material, and a step of the batch it is for."""
    monkeypatch.setattr(placing, "properties_of", lambda _: H100)
    monkeypatch.setattr(placing, "step_bytes", lambda scene, plan, batch, device: STEP * batch)
    for batch in (None, 3):
        sim = simulator(small_case(), torch.float64, batch=batch)
        plan = choose_plan(sim.scene.values(), torch.float64, H100, batch=batch)
        numbers = sum(array.numel() for array in (*sim.material(), sim.rest_positions))
        asked = bytes_asked_for(lambda: placing.plan_for_device(sim.compiled, torch.float64, GPU), monkeypatch)  # noqa: B023
        assert asked == plan.bytes + 8 * numbers + (batch or 1) * STEP


@pytest.mark.usefixtures("two_gpus")
def test_a_gpu_that_is_not_there_is_told_which_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placing, "_reason", lambda *_: "")

    def fail(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("CUDA error: invalid device ordinal\nGPU device may be out of range")

    there = r"torch sees cuda:0 \(kind 0\), cuda:1 \(kind 1\); CUDA_VISIBLE_DEVICES"
    with pytest.raises(RuntimeError, match=rf"^Simulator: device must be an existing GPU: {there}"):
        placing.check_target_device(fail, torch.empty(0))
    with pytest.raises(ValueError, match=rf"^--device must be an existing GPU, got cuda:2: {there}"):
        placing.find_device("cuda:2")
    assert [placing.find_device(name).index for name in ("cuda", "cuda:0", "cuda:1")] == [None, 0, 1]
