"""The simulator as a module: precision, material, state_dict, copies."""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cases import box
from runs import moving, same_bits, simulate

import torchpd as pd
from torchpd.plan import KERNELS
from torchpd.plan.material import named_arrays
from torchpd.plan.placement import check_target_device
from torchpd.scene.solvers import Solver

pytestmark = pytest.mark.usefixtures("poisoned")


@pytest.mark.parametrize("target", [torch.float64, torch.float32])
def test_precision_can_be_changed(target: torch.dtype, device: torch.device) -> None:
    """After .to(dtype) it is the simulator that would have been compiled so: no digit of float32 is left in it."""
    source = torch.float32 if target == torch.float64 else torch.float64
    moved, fresh = simulate(source, device).to(target), simulate(target, device)
    assert moved.dtype == moved.rest_positions.dtype == target
    for name, one, other in zip([*range(len(fresh.plan.arrays))], moved.plan.arrays, fresh.plan.arrays, strict=True):
        assert one.dtype == other.dtype, name
        assert torch.equal(one, other), name
    assert torch.equal(moved.rest_positions, fresh.rest_positions)
    moved.load_state_dict(fresh.state_dict())
    state = moving(fresh)
    assert same_bits(moved(state), fresh(state))


def test_integer_arrays_survive_every_conversion() -> None:
    sim = simulate(torch.float32)
    kinds = [array.dtype for array in sim.plan.arrays]
    assert [array.dtype for array in sim.double().float().to("cpu").plan.arrays] == kinds


def test_state_dict_restores_the_material(dtype: torch.dtype, device: torch.device) -> None:
    trained = simulate(dtype, device)
    trained.set_material(stiffness=trained.stiffness * 0.3, gravity=torch.tensor([0.0, 1.0, 0.0]), damping=2.0)
    other = simulate(dtype, device)
    state = moving(other)
    assert not same_bits(trained(state), other(state))
    other.load_state_dict(copy.deepcopy(trained.state_dict()))
    assert same_bits(trained(state), other(state))
    assert set(trained.state_dict()) == {
        "stiffness", "masses", "gravity", "damping", "pin_stiffness", "pin_hard", "pin_targets", "planes", "spheres",
    }  # fmt: skip


@pytest.mark.parametrize("change", ["missing", "unexpected", "both"])
def test_a_state_dict_with_other_names_changes_nothing(change: str) -> None:
    sim, trained = simulate(torch.float32), simulate(torch.float32)
    trained.set_material(stiffness=trained.stiffness.expand(2, -1) * 0.3, damping=2.0)
    parameters = list(named_arrays(sim).values())
    before = [array.clone() for array in parameters]
    missing, unexpected = ["pin_targets"] * (change != "unexpected"), ["youngs"] * (change != "missing")
    wrong = {name: value for name, value in trained.state_dict().items() if name not in missing}
    wrong |= {name: torch.ones(3) for name in unexpected}
    with pytest.raises(RuntimeError, match="nothing is loaded") as refusal:
        sim.load_state_dict(wrong)
    assert ("Missing key(s) in state_dict: 'pin_targets'" in str(refusal.value)) == bool(missing)
    assert ("Unexpected key(s) in state_dict: 'youngs'" in str(refusal.value)) == bool(unexpected)
    assert all(one is other for one, other in zip(parameters, named_arrays(sim).values(), strict=True))
    assert all(torch.equal(one, other) for one, other in zip(before, parameters, strict=True))
    # those that are there, where that is asked for
    left = sim.load_state_dict(wrong, strict=False)
    assert (left.missing_keys, left.unexpected_keys) == (missing, unexpected)
    assert torch.equal(sim.stiffness, trained.stiffness)


def test_copies_are_independent(dtype: torch.dtype) -> None:
    sim = simulate(dtype)
    state = moving(sim)
    twin, before = copy.deepcopy(sim), sim(state)
    twin.set_material(stiffness=1e3)
    assert same_bits(sim(state), before)
    assert not same_bits(twin(state), before)


def test_copies_know_their_pins_and_spheres() -> None:
    """A copy shares the scene, whose parts have values only; what was pickled has its own."""
    sim = simulate(torch.float64)
    state = moving(sim)
    (pin, *_), batch = sim.scene.pins, state.positions[:, : len(sim.scene.pins[0].vertices)]
    expected = sim(state, targets={pin: batch})
    for twin in (copy.copy(sim), copy.deepcopy(sim), pickle.loads(pickle.dumps(sim))):
        assert same_bits(twin(state, targets={twin.scene.pins[0]: batch}), expected)
    assert same_bits(copy.deepcopy(sim)(state, targets={pin: batch}), expected)
    task = copy.deepcopy({"scene": sim.scene, "pin": pin})
    other = pd.Simulator(task["scene"], sim.time_step, sim.iterations, dtype=torch.float64)
    assert same_bits(other(state, targets={task["pin"]: batch}), expected)


def test_states_move_copy_and_detach() -> None:
    state = pd.State(torch.ones(1, 2, 3, requires_grad=True), torch.zeros(1, 2, 3))
    wide = state.to(torch.float64)
    assert isinstance(wide, pd.State)
    assert (wide.positions.dtype, wide.velocities.dtype) == (torch.float64, torch.float64)
    assert state.to(dtype=torch.float32).positions is state.positions
    copied = state.clone()
    assert copied.positions.requires_grad
    assert copied.velocities.data_ptr() != state.velocities.data_ptr()
    assert (
        pd.State(*(part.transpose(0, 1) for part in (torch.ones(2, 3, 3), torch.ones(2, 3, 3))))
        .clone()[0]
        .is_contiguous()
    )
    loose = state.detach()
    assert not loose.positions.requires_grad
    assert loose.positions.data_ptr() == state.positions.data_ptr()


def test_parameters_are_there_to_be_trained_on_request() -> None:
    sim = simulate(torch.float64)
    assert all(not parameter.requires_grad for parameter in sim.parameters())
    sim.stiffness.requires_grad_()
    sim.set_material(stiffness=2e4)
    assert sim.stiffness.requires_grad
    assert sim.stiffness.is_leaf
    (slope,) = torch.autograd.grad(sim.energy(moving(sim).positions * 1.1).sum(), sim.stiffness)
    assert float(slope.abs().max()) > 0.0


def test_set_material_is_the_scene_of_those_values(dtype: torch.dtype, device: torch.device) -> None:
    """Every value of a scene set afterwards gives the bits of the scene that had it from the start."""
    vertices, tets = box((0.3, 0.2, 0.2), (3, 2, 2))
    youngs = np.random.default_rng(0).uniform(1e4, 1e5, len(tets))

    def build(e: Any, rho: float, g: float, rate: float, k: float, mu: float, r: float) -> pd.Simulator:
        body = pd.Solid(pd.TetMesh(vertices, tets), e, rho)
        parts = pd.Pin(body, [0, 1], k), pd.Gravity((0.0, g, 0.0)), pd.Damping(rate), pd.Ground(-0.01, friction=mu)
        scene = pd.Scene(body, *parts, pd.Sphere((0.3, -0.2, 0.1), r))
        return pd.Simulator(scene, 1 / 60, 10, dtype=dtype).to(device)

    wanted = build(youngs, 700.0, -3.0, 4.0, 2e3, 0.1, 0.21)
    sim = build(1e5, 1000.0, -9.8, 1.0, 1e3, 0.9, 0.1)
    state = moving(sim)
    assert not same_bits(sim(state), wanted(state))
    sim.set_material(**{name: getattr(wanted, name) for name in wanted.state_dict()})
    assert same_bits(sim(state), wanted(state))
    sim.set_material(stiffness=5e4, damping=0.5)
    assert torch.equal(sim.stiffness, torch.full_like(sim.stiffness, 5e4))
    assert sim.damping.shape == ()


def test_pickled_simulator_takes_the_same_step(dtype: torch.dtype) -> None:
    sim = simulate(dtype, kernel="stream")
    state = moving(sim)
    twin = pickle.loads(pickle.dumps(sim))
    assert (twin.kernel, twin.plan.kernel) == ("stream", None)
    assert same_bits(twin(state), sim(state))


def test_kernel_changes_nothing_on_the_cpu(dtype: torch.dtype) -> None:
    sim = simulate(dtype)
    state = moving(sim)
    for kernel in KERNELS:
        assert same_bits(simulate(dtype, kernel=kernel)(state), sim(state))
    refusal = "kernel .*got 'warp'"
    with pytest.raises(ValueError, match=refusal):
        simulate(dtype, kernel="warp")


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
def test_meta_and_back_is_compiled_again(solver: Solver, dtype: torch.dtype) -> None:
    sim = simulate(dtype, solver=solver)
    state, arrays = moving(sim), sim.plan.arrays
    there = sim.to("meta")
    assert there.device.type == there.plan.vertex_order.device.type == "meta"
    back = there.to_empty(device="cpu")
    assert all(torch.equal(one, other) for one, other in zip(back.plan.arrays, arrays, strict=True))
    fresh = simulate(dtype, solver=solver)
    back.load_state_dict(fresh.state_dict())
    assert same_bits(back(state), fresh(state))
    assert same_bits(back.rest_state(), fresh.rest_state())


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
def test_what_needs_values_says_that_meta_has_none(solver: Solver, tmp_path: Path) -> None:
    sim = simulate(torch.float32, solver=solver)
    values = sim.state_dict()
    sim.to("meta")
    assert sim(sim.rest_state(2)).positions.shape == (2, sim.vertices, 3)
    way_out = r'the simulator is on "meta", .*; .* sim\.to_empty\(device="cpu"\) and then sim\.load_state_dict'
    assert re.search(way_out, repr(sim))
    for name, call in (
        ("set_material", lambda: sim.set_material(stiffness=1e5)),
        (r"Simulator\.load_state_dict", lambda: sim.load_state_dict(values)),
        ("prepare_solver", sim.prepare_solver),
        ("tune", lambda: sim.tune(error=0.1)),
        ("estimate_rho", lambda: pd.estimate_rho(sim, sim.rest_state())),
        ("save", lambda: sim.save(tmp_path / "bar.safetensors")),
    ):
        with pytest.raises(RuntimeError, match=f"^{name}: {way_out}"):
            call()


def test_values_and_meta_are_not_mixed() -> None:
    """Torch takes the fake kernel of an op as soon as one argument is on "meta": what it returns is never written."""
    sim = simulate(torch.float32)
    state = moving(sim)
    shapes = state.to("meta")
    with pytest.raises(TypeError, match=r"state .*got .* on meta"):
        sim(shapes)
    for call in (sim, sim.step_, lambda state: sim.rollout(state, 2)):
        with pytest.raises(TypeError, match=r"velocities .*got torch\.float32 on meta"):
            call(pd.State(state.positions, shapes.velocities))
    stiffness = {"stiffness": sim.stiffness.to("meta")}
    with pytest.raises(RuntimeError, match=r'torchpd::step: .*cpu .*"meta"'):
        torch.func.functional_call(sim, stiffness, (state,))


def test_the_default_device_changes_nothing(tmp_path: Path) -> None:
    expected = simulate(torch.float32)
    state, rho = moving(expected), pd.estimate_rho(expected, moving(expected), "power")
    with torch.device("meta"):
        sim = simulate(torch.float32)
        assert sim.device.type == "cpu"
        assert same_bits(sim.rest_state(), expected.rest_state())
        assert pd.estimate_rho(sim, state, "power") == rho
        sim.set_material(damping=0.0, gravity=expected.gravity)
        sim.save(tmp_path / "bar.safetensors")
        loaded = pd.Simulator.load(tmp_path / "bar.safetensors")
        sim.tune(state, error=0.5, most=8)
    expected.set_material(damping=0.0)
    assert same_bits(loaded(state), expected(state))


def test_a_checkpoint_of_torch_holds_states(tmp_path: Path) -> None:
    sim = simulate(torch.float32)
    after, info = sim(moving(sim), return_info=True)
    track = sim.rollout(after, 2)
    torch.save({"sim": sim.state_dict(), "state": after, "info": info, "track": track}, tmp_path / "run.pt")
    loaded = torch.load(tmp_path / "run.pt", weights_only=True)
    sim.load_state_dict(loaded["sim"])
    assert [type(loaded[name]) for name in ("state", "info", "track")] == [pd.State, pd.Info, pd.Track]
    assert same_bits(loaded["state"], after)
    assert same_bits(loaded["track"].state(), track.state())
    # wherever in the package their classes are
    assert {kind.__module__ for kind in (pd.State, pd.Info, pd.Track)} == {"torchpd"}
    assert b"torchpd.simulation.state" not in pickle.dumps((after, info, track))
    assert same_bits(pickle.loads(pickle.dumps(track)).state(), track.state())


@pytest.mark.skipif(torch.version.cuda is not None, reason="for a CPU build of torch")
def test_a_gpu_that_cannot_be_had_is_explained() -> None:
    sim = simulate(torch.float32)
    state = moving(sim)
    expected = sim(state)
    for move in (lambda: sim.to("cuda"), sim.cuda):
        with pytest.raises(RuntimeError, match=r"no CUDA here: .*CPU build.*build torchpd again; `python -m torchpd"):
            move()
    assert same_bits(sim(state), expected)


def test_errors_of_others_are_left_alone() -> None:
    def fail(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("something else")

    with pytest.raises(RuntimeError, match=r"^something else$"):
        check_target_device(fail, torch.empty(0))


def test_capture_wants_a_gpu() -> None:
    sim = simulate(torch.float32)
    with pytest.raises(RuntimeError, match=r'capture: .*got cpu.*\.to\("cuda"\)'):
        sim.capture(moving(sim))


def test_inference_mode_leaves_a_simulator_that_learns() -> None:
    """What it keeps is made as outside, so that it can be changed and differentiated later."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (4, 1, 1))
    body = pd.Solid(mesh, 1e5)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    with torch.inference_mode():
        sim = pd.Simulator(scene, 1 / 60, 8).double()
        sim.set_material(stiffness=sim.stiffness * torch.rand(4, 1, dtype=torch.float64).add(0.5))
        sim.solver = pd.Multilevel()
        after = sim(sim.rest_state(4))
    assert after.positions.is_inference()
    assert not any(p.is_inference() for p in (*sim.parameters(), *sim.buffers(), *sim.plan.arrays))
    sim.set_material(stiffness=torch.full_like(sim.stiffness, 5e4))
    sim.stiffness.requires_grad_()
    sim(sim.rest_state(4)).positions.sum().backward()
    assert sim.stiffness.grad is not None
    assert sim.stiffness.grad.abs().sum() > 0


def test_states_of_some_environments_are_replaced() -> None:
    sim = simulate(torch.float32)
    old, new = sim.rest_state(3), pd.State(*(torch.randn(3, *part.shape[1:]) for part in sim.rest_state()))
    done = torch.tensor([True, False, True])
    mixed = new.where(done, old)
    for part, mine, theirs in zip(mixed, new, old, strict=True):
        assert torch.equal(part[done], mine[done])
        assert torch.equal(part[~done], theirs[~done])
    for wrong in (torch.tensor([True]), done.float(), done[None]):
        with pytest.raises(ValueError, match=r"State.where: condition .*bool \[3\], one for each"):
            new.where(wrong, old)
    with pytest.raises(TypeError, match=r"State.where: condition .*got list"):
        new.where([True, False, True], old)  # type: ignore[arg-type]
    for other, message in (
        (
            pd.State(*(t[:2] for t in old)),
            r"other must have positions \[3, 45, 3\], or those of one .*, got \[2, 45, 3\]",
        ),
        (pd.State(old.positions, old.velocities[:2]), r"other must have velocities .*, got \[2, 45, 3\]"),
        (old.to(torch.float64), r"other .* torch\.float32 on cpu, got torch\.float64 on cpu"),
        (old.positions, r"other .* State, got Tensor"),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^State.where: {message}"):
            new.where(done, other)
    one = sim.rest_state()
    assert same_bits(new.where(done, one), new.where(done, sim.rest_state(3)))


def test_a_time_step_must_do_in_another_precision() -> None:
    sim = simulate(torch.float64)
    sim.time_step = 1e-50
    with pytest.raises(ValueError, match=r"time_step .*got 1e-50"):
        sim.float()
    assert sim.dtype == torch.float64
    sim(sim.rest_state())


def test_numbers_are_no_states() -> None:
    sim, number = simulate(torch.float32), torch.tensor(0.0)
    for step in (sim, sim.step_, lambda state: sim.rollout(state, 2), sim.energy):
        with pytest.raises(ValueError, match=r"must be \[B, 45, 3\], got \[\]"):
            step(pd.State(number, number))


def test_the_elastic_gradient_depends_on_the_stiffness_alone() -> None:
    """Neither a gradient nor a change in place of other arrays concerns it."""
    sim = pd.Simulator(pd.Scene(pd.Solid(pd.shapes.box((1, 1, 1), (1, 1, 1)), 1e5)), progress=False)
    x = (1.1 * sim.rest_state().positions).requires_grad_()
    energy = sim.gradient(x).square().sum()
    sim.masses.requires_grad_()
    assert not sim.gradient(x.detach()).requires_grad
    with torch.no_grad():
        sim.damping.fill_(0.1)
    energy.backward()
    assert x.grad is not None


def test_auto_in_inference_mode_leaves_tensors_that_can_be_trained() -> None:
    body = pd.Solid(pd.shapes.box((3.0, 0.6, 0.6), (30, 6, 6)), 1e8)
    scene = pd.Scene(body, pd.Pin(body, body.mesh.vertices[:, 0] < 1e-6), pd.Gravity())
    with torch.inference_mode():
        sim = pd.Simulator(scene, 1 / 30, solver="auto", progress=False)
    assert isinstance(sim.solver, pd.Multilevel)
    assert not any(array.is_inference() for array in sim.plan.arrays)


def test_an_unsolved_warning_that_is_an_error_is_raised_once() -> None:
    body = pd.Solid(pd.shapes.box((3.0, 0.3, 0.3), (20, 2, 2)), 1e4)
    sim = pd.Simulator(pd.Scene(body, pd.Pin(body, body.mesh.vertices[:, 0] < 1e-6), pd.Gravity()), progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(pd.UnsolvedWarning):
            sim.set_material(stiffness=1e9)
        sim.set_material(stiffness=2e9)
