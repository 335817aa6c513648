"""What a simulator makes anew on a GPU when its kernel, batch or solver changes: no GPU is needed to know."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

import torchpd as pd
from torchpd.common.gpu import H100
from torchpd.estimate import solver_choice as automatic
from torchpd.estimate.convergence import Spectrum
from torchpd.plan import Plan, compile_plan
from torchpd.plan import placement as placing
from torchpd.plan.compiled import CompiledScene
from torchpd.plan.kernel_choice import choose_plan
from torchpd.plan.preconditioner import precondition_plan, reference_material
from torchpd.scene import SceneValues
from torchpd.simulation import model, settings
from torchpd.simulation.parametrization import plain_copy


def test_another_kernel_makes_the_plan_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU; where it does not fit everything stays."""

    def compiled(sim: pd.Simulator | CompiledScene, dtype: torch.dtype, *_: object) -> Plan:
        if sim.kernel == "cluster":
            raise ValueError("does not fit")
        return choose_plan(sim.scene.values(), dtype, H100, sim.kernel, progress=False)

    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.box((1, 1, 1), (3, 3, 3)), 1e4)), 1 / 60, 8, progress=False)
    sim.kernel = "grid"
    assert sim.plan.kernel is None
    monkeypatch.setattr(placing, "_compile", compiled)
    sim.plan = compiled(sim, torch.float32, torch.device("cuda"))
    assert sim.plan.kernel == "grid"
    sim.kernel = "block"
    assert (sim.kernel, sim.plan.kernel) == ("block", "block")
    plan = sim.plan
    for wrong, error in (("cluster", "does not fit"), ("warp", "kernel .*got 'warp'")):
        with pytest.raises(ValueError, match=error):
            sim.kernel = wrong
        assert (sim.kernel, sim.plan) == ("block", plan)


def test_another_kernel_makes_the_choice_of_auto_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Multilevel runs with "stream" alone, so "auto" leaves it where another kernel is asked for."""
    asked = []

    def compiled(sim: pd.Simulator | CompiledScene, dtype: torch.dtype, *_: object) -> Plan:
        asked.append((sim.kernel, type(sim.solver)))
        levels = isinstance(sim.solver, pd.Multilevel)
        return choose_plan(sim.scene.values(), dtype, H100, sim.kernel, levels=levels, progress=False)

    body = pd.Solid(pd.shapes.box((1, 1, 1), (3, 3, 3)), 1e8)
    sim = pd.Simulator(pd.Scene(body, pd.Gravity(), pd.Ground(-1.0)), 1 / 60, solver="auto", progress=False)
    assert isinstance(sim.solver, pd.Multilevel)
    monkeypatch.setattr(placing, "_compile", compiled)
    monkeypatch.setattr(placing, "move_plan", lambda scene, plan, device: plan)
    monkeypatch.setattr(settings, "move_plan", lambda scene, plan, device: plan)
    monkeypatch.setattr(automatic, "spectrum_of", lambda _: Spectrum(1e-6, 1e-6))
    monkeypatch.setattr(automatic, "runs", lambda solver, scene: scene.kernel == "auto")
    values, reference = sim.scene.values(), reference_material(sim.plan, sim.material(), sim.time_step)
    sim.plan = precondition_plan(choose_plan(values, torch.float32, H100, levels=True), values, *reference)
    sim.kernel = "grid"
    assert (sim.plan.kernel, type(sim.solver), asked) == ("grid", pd.Chebyshev, [("grid", pd.Chebyshev)])


def test_a_move_that_is_refused_leaves_the_choice_of_auto(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the plan that goes with it, though another device begins with one for Chebyshev."""

    def refuse(*_: object) -> None:
        raise RuntimeError("no room")

    body = pd.Solid(pd.shapes.box((1, 1, 1), (3, 3, 3)), 1e8)
    sim = pd.Simulator(pd.Scene(body, pd.Gravity(), pd.Ground(-1.0)), 1 / 60, solver="auto", progress=False)
    before = sim.plan, sim.choice, sim.solver, sim.iterations
    wanted = SimpleNamespace(device=torch.device("cuda", 0), dtype=torch.float32)
    monkeypatch.setattr(model, "check_target_device", lambda *_: wanted)
    monkeypatch.setattr(settings, "check_solver", lambda solver, _: solver)
    monkeypatch.setattr(settings, "plan_for_device", refuse)
    with pytest.raises(RuntimeError, match="no room"):
        sim.to("cuda")
    assert isinstance(sim.solver, pd.Multilevel)
    assert (sim.plan, sim.choice, sim.solver, sim.iterations) == before


@pytest.mark.parametrize("setting", ["kernel", "batch"])
def test_a_plan_made_in_inference_mode_can_be_learnt_with(setting: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placing, "_compile", lambda own, dtype, *_: choose_plan(own.scene.values(), dtype, H100))
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.single_tet(), 1e4)), 1 / 60, 8, progress=False)
    sim.plan = choose_plan(sim.scene.values(), torch.float32, H100)
    with torch.inference_mode():
        setattr(sim, setting, {"kernel": "block", "batch": 5}[setting])
    assert not any(array.is_inference() for array in sim.plan.arrays)


def test_bars_show_for_another_device_too(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []

    def chosen(values: SceneValues, *_: object, progress: bool, **__: object) -> Plan:
        shown.append(progress)
        return compile_plan(values, progress=False)

    monkeypatch.setattr(placing, "choose_plan", chosen)
    monkeypatch.setattr(placing, "properties_of", lambda _: H100)
    for progress in (True, False):
        sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.single_tet(), 1e4)), 1 / 60, 8, progress=progress)
        placing.recompile_plan(sim.compiled, torch.float32, torch.device("cuda"))
        assert shown.pop() == progress
        # nobody waits for those that the library makes for itself
        assert not plain_copy(sim).progress


def test_a_simulator_passes_its_batch_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """When it moves, and when either the batch or the solver changes on a GPU."""
    asked = []

    def chosen(values: SceneValues, *_: object, batch: int | None, **__: object) -> Plan:
        asked.append(batch)
        return compile_plan(values, progress=False)

    monkeypatch.setattr(placing, "choose_plan", chosen)
    monkeypatch.setattr(placing, "properties_of", lambda _: H100)
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.single_tet(), 1e4)), 1 / 60, 8, batch=3)
    placing.recompile_plan(sim.compiled, torch.float32, torch.device("cuda"))
    assert asked == [3]
    sim.batch = 4
    assert asked == [3]  # no plan of a CPU knows of it
    monkeypatch.setattr(Plan, "kernel", "stream")
    monkeypatch.setattr(settings, "recompile_plan", lambda own, *_: chosen(own.scene.values(), batch=own.batch))
    sim.batch = 5
    assert asked == [3, 5]
    for wrong in (0, "x"):
        with pytest.raises(ValueError, match=r"batch .*number >= 1"):
            sim.batch = wrong  # type: ignore[assignment]
    assert sim.batch == 5
    sim.batch = None
    assert asked == [3, 5, None]
