"""Settings, states and targets that make no sense are refused, with the name, the contract and what came."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from small_scene import body, scene, small_simulator

import torchpd as pd
from torchpd.plan import compile_plan


@pytest.fixture(scope="module")
def sim() -> pd.Simulator:
    return small_simulator()


def test_settings_of_a_simulator_are_checked() -> None:
    parts = scene()
    for keywords, kind, message in (
        ({"time_step": 0.0}, ValueError, "time_step .*got 0"),
        ({"time_step": math.inf}, ValueError, "time_step .*got inf"),
        ({"iterations": -1}, ValueError, "iterations .*got -1"),
        ({"iterations": 2.5}, ValueError, r"iterations .*got 2\.5"),
        ({"time_step": "fast"}, ValueError, "time_step .*got 'fast'"),
        ({"time_step": "1"}, ValueError, "time_step .*got '1'"),
        ({"time_step": None}, ValueError, "time_step .*got None"),
        (
            {"time_step": 1e-20},
            ValueError,
            "time_step .*got 1e-20",
        ),
        ({"time_step": 1e13}, ValueError, r"time_step .*got 10000000000000\.0"),
        (
            {"time_step": 1e160, "dtype": torch.float64},
            ValueError,
            r"time_step .*got 1e\+160",
        ),
        ({"iterations": 2**40}, ValueError, "iterations .*got 1099511627776"),
        ({"time_step": True}, ValueError, "time_step .*got True"),
        ({"tolerance": False}, ValueError, "tolerance .*got False"),
        ({"iterations": "many"}, ValueError, "iterations .*got 'many'"),
        ({"iterations": math.nan}, ValueError, "iterations .*got nan"),
        ({"iterations": True}, ValueError, "iterations .*got True"),
        ({"batch": 0}, ValueError, "batch .*got 0"),
        ({"batch": 1.5}, ValueError, r"batch .* >= 1, got 1\.5"),
        ({"batch": "many"}, ValueError, "batch .*got 'many'"),
        ({"tolerance": 1.0}, ValueError, "tolerance .*got 1"),
        ({"tolerance": -0.1}, ValueError, r"tolerance .*got -0\.1"),
        ({"tolerance": math.nan}, ValueError, "tolerance .*got nan"),
        ({"tolerance": None}, ValueError, "tolerance .*got None"),
        ({"tolerance": "low"}, ValueError, "tolerance .*got 'low'"),
        ({"dt": 0.01}, TypeError, r"^Simulator has no argument 'dt'; .*`time_step`"),
        (
            {"solver": "gauss"},
            TypeError,
            "solver .*got 'gauss'",
        ),
        ({"device": "gpu"}, RuntimeError, "gpu"),
        ({"dtype": "float32"}, ValueError, "dtype .*got 'float32'"),
        ({"dtype": torch.float16}, ValueError, r"dtype .*got torch\.float16"),
    ):
        with pytest.raises(kind, match=message):
            pd.Simulator(parts, **keywords)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"scene .*got Solid"):
        pd.Simulator(body())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"patch_size must lie in 16\.\.8192"):
        compile_plan(parts.values(), patch_size=8)


def test_settings_that_are_replaced_are_checked() -> None:
    sim = small_simulator()
    before = sim.iterations, sim.tolerance, sim.time_step, sim.kernel
    for value in ("a", None, -1, math.nan):
        with pytest.raises(ValueError, match=rf"time_step .*got {value!r}"):
            sim.time_step = value  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"kernel .*got \'foo\'"):
        sim.kernel = "foo"
    with pytest.raises(ValueError, match=r"iterations .*got None"):
        sim.iterations = None  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"tolerance .*got None"):
        sim.tolerance = None  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"set_material: stiffness .*got \[0, 48\]"):
        sim.set_material(stiffness=sim.stiffness.detach().expand(1, -1)[:0])
    assert (sim.iterations, sim.tolerance, sim.time_step, sim.kernel) == before


def test_arguments_of_a_step_are_checked(sim: pd.Simulator) -> None:
    state = sim.rest_state(2)
    pin, soft = sim.scene.pins
    (sphere,) = sim.scene.spheres
    targets: list[tuple[Any, type[Exception], str]] = [
        (torch.zeros(2, 3), ValueError, r"targets .*got \[2, 3\]"),
        (torch.zeros(5, 3, 3), ValueError, r"targets .*got \[5, 3, 3\]"),
        (torch.zeros(3, 3).double(), TypeError, r"targets .*got torch\.float64 on cpu"),
        ({pin: torch.zeros(1, 3)}, ValueError, r"targets of a Pin must be \[2, 3\].*pin_range"),
        ({soft: torch.zeros(3)}, ValueError, r"targets of a Pin must be \[1, 3\]"),
        ({sphere: torch.zeros(4)}, ValueError, r"targets of a Sphere must be \[3\] or \[6\]"),
        ({sphere: torch.tensor(0.0)}, ValueError, r"targets of a Sphere must be \[3\] or \[6\], .* got \[\]"),
        ({sphere: torch.zeros(3).long()}, TypeError, r"targets of a Sphere must be torch\.float32 .* got torch\.int64"),
        ({sphere: (0, 0, 0)}, TypeError, r"targets of a Sphere .* torch\.float32 on cpu, got tuple"),
        ({sphere: np.zeros(3)}, TypeError, r"targets of a Sphere .*, got ndarray; torch\.as_tensor"),
        ({pin: np.zeros((2, 3), np.float32)}, TypeError, r"targets of a Pin .*, got ndarray"),
        ({pin: [[0.0, 0.0, 0.0]] * 2}, TypeError, r"targets of a Pin .*, got list"),
        ({pin: None}, TypeError, r"targets of a Pin .*, got NoneType"),
        (np.zeros((3, 3)), TypeError, r"targets must be a tensor or a mapping from parts to tensors, got ndarray"),
        (
            {pd.Sphere((0, 0, 0), 1.0): torch.zeros(3)},
            ValueError,
            r"this Sphere is not a Pin, Sphere, Fibres, ",
        ),
        ({sim.scene.solids[0]: torch.zeros(3)}, ValueError, r"this Solid is not a Pin, Sphere, Fibres, "),
    ]
    for target, kind, message in targets:
        with pytest.raises(kind, match=message):
            sim(state, targets=target)
        with pytest.raises(kind, match=message):
            sim.rollout(state, 2, targets=lambda _, now=target: now)
    for call in (lambda: sim(state, start="rest"), lambda: sim.rollout(state, 2, start="rest")):
        with pytest.raises(ValueError, match=r'start must be "velocity"(, | or )"inertial"'):
            call()
    for steps, every, message in (
        (-1, 1, r"steps .* >= 0, got -1"),
        (1.5, 1, "steps .*got 1.5"),
        (3, 0, "every .*got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            sim.rollout(state, steps, every)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"first .*got -1"):
        sim.rollout(state, 1, first=-1)
    for batch in (-1, 1.5):
        with pytest.raises(ValueError, match=r"batch .*number >= 0"):
            sim.rest_state(batch)  # type: ignore[arg-type]


FIELDS: dict[str, tuple[Any, str]] = {
    "a list": ([0.0], r"a tensor \[2, 27, 3\] like positions \({}\), got list"),
    "a number": (1.0, r"a tensor \[2, 27, 3\] like positions \({}\), got float"),
    "an array": (np.zeros((2, 27, 3), np.float32), r"a tensor \[2, 27, 3\] like positions \({}\), got ndarray"),
    "doubles": (torch.zeros(2, 27, 3).double(), r"torch\.float32 on cpu like positions \({}\), got torch\.float64 on"),
    "another batch": (torch.zeros(3, 27, 3), r"\[2, 27, 3\] like positions \({}\), got \[3, 27, 3\]"),
    "other vertices": (torch.zeros(26, 3), r"\[2, 27, 3\] like positions \({}\), got \[26, 3\]"),
    "one vector": (torch.zeros(3), r"\[2, 27, 3\] like positions \({}\), got \[3\]"),
}


@pytest.mark.parametrize("name", FIELDS)
def test_forces_and_starts_are_checked(name: str, sim: pd.Simulator) -> None:
    value, words = FIELDS[name]
    state = sim.rest_state(2)
    calls: list[Callable[[], object]] = [
        lambda: sim(state, value),
        lambda: sim.step_(state, value),
        lambda: sim.rollout(state, 2, forces=value),
        lambda: sim.rollout(state, 2, forces=lambda _: value),
        lambda: sim.step_gradient(state, state, value),
    ]
    for call in calls:
        with pytest.raises((TypeError, ValueError), match="forces must be " + words.format("N")):
            call()
    if isinstance(value, torch.Tensor):
        for step in (sim, sim.step_):
            with pytest.raises((TypeError, ValueError), match="start must be " + words.format("first iterate, m")):
                step(state, start=value)


@pytest.mark.parametrize("forces", [torch.zeros(4, 2, 27, 3), [torch.zeros(2, 27, 3)] * 4], ids=["tensor", "list"])
def test_forces_of_every_step_are_a_function(forces: Any, sim: pd.Simulator) -> None:
    message = r"forces must be .*, got (\[4, 2, 27, 3\]|list); .*number"
    with pytest.raises((TypeError, ValueError), match=message):
        sim.rollout(sim.rest_state(2), 4, forces=forces)
    with pytest.raises((TypeError, ValueError), match=r"forces must be .*, got (\[4, 2, 27, 3\]|list)$"):
        sim(sim.rest_state(2), forces)  # whose steps do not differ


def test_targets_of_every_step_are_a_function(sim: pd.Simulator) -> None:
    state, targets = sim.rest_state(2), torch.zeros(4, 2, 3, 3)
    with pytest.raises(ValueError, match=r"targets must be .*, got \[4, 2, 3, 3\]; .*number"):
        sim.rollout(state, 4, targets=targets)
    with pytest.raises(ValueError, match=r"targets .*got \[4, 2, 3, 3\]$"):
        sim(state, targets=targets)


@pytest.mark.parametrize("info", [True, "all", np.zeros((2, 7))])
def test_what_is_no_info_is_refused(info: Any, sim: pd.Simulator) -> None:
    with pytest.raises(
        TypeError, match=rf"step_: info must be None or a float64 tensor \[2, 7\] .* {type(info).__name__}"
    ):
        sim.step_(sim.rest_state(2), info=info)


def test_records_that_are_not_there_are_refused(sim: pd.Simulator) -> None:
    state = sim.rest_state()
    with pytest.raises(IndexError, match=r"Track\.state: .*steps // every is 0"):
        sim.rollout(state, 0).state()
    track = sim.rollout(state, 2)
    for record in (2, -3):
        with pytest.raises(IndexError, match=rf"Track\.state: record .*got {record}"):
            track.state(record)


@pytest.mark.parametrize("start", [None, 1.0, [0.0], np.zeros((2, 27, 3)), pd.State(torch.zeros(1), torch.zeros(1))])
def test_what_is_no_start_is_refused(start: Any, sim: pd.Simulator) -> None:
    state = sim.rest_state(2)
    for call in (lambda: sim(state, start=start), lambda: sim.step_(state, start=start)):
        with pytest.raises(
            ValueError, match=rf"start must be .* or positions \[B, V, 3\], got {type(start).__name__}$"
        ):
            call()
    for other in (start, state.positions):
        with pytest.raises(ValueError, match=rf'must be "velocity" or "inertial", got {type(other).__name__}$'):
            sim.rollout(state, 2, start=other)


ENERGIES: dict[str, Callable[[pd.Simulator, Any], torch.Tensor]] = {
    "state": lambda sim, x: sim.energy(x),
    "positions": lambda sim, x: sim.gradient(x),
    "after": lambda sim, x: sim.step_gradient(sim.rest_state(2), x),
}


@pytest.mark.parametrize("call", ENERGIES.values(), ids=["energy", "gradient", "step_gradient"])
def test_positions_of_energies_and_gradients_are_checked(
    call: Callable[[pd.Simulator, Any], torch.Tensor], sim: pd.Simulator
) -> None:
    x = sim.rest_state(2).positions
    name = next(key for key, value in ENERGIES.items() if value is call)
    for given, message in (
        (None, r"a State, positions and velocities \[B, 27, 3\], .* got NoneType"),
        (x.numpy(), r"a State, positions and velocities \[B, 27, 3\], .* got ndarray"),
        (x.double(), r"torch\.float32 .*got torch\.float64"),
        (x.half(), r"torch\.float32 .*got torch\.float16"),
        (x[0], r"\[B, 27, 3\], got \[27, 3\]"),
        (x[:, :5], r"\[B, 27, 3\], got \[2, 5, 3\]"),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^{name} must be {message}"):
            call(sim, given)
        if isinstance(given, torch.Tensor):
            with pytest.raises((TypeError, ValueError), match=f"^{name} must be {message}"):
                call(sim, pd.State(given, given))
    with pytest.raises(ValueError, match=r"velocities .*got \[1, 27, 3\]"):
        call(sim, pd.State(x, x[:1]))
    assert torch.equal(call(sim, pd.State(x, torch.zeros_like(x))), call(sim, x))


def test_step_gradient_does_not_broadcast(sim: pd.Simulator) -> None:
    one, two = sim.rest_state(1), sim.rest_state(2)
    for state, after, message in (
        (two, one, r"after .*got \[1, 27, 3\]"),
        (one, two.positions, r"after .*got \[2, 27, 3\]"),
        (pd.State(two.positions, one.velocities), two, r"velocities .*got \[1, 27, 3\]"),
        (pd.State(*(t[:, :5] for t in two)), two, r"state .*got \[2, 5, 3\]"),
    ):
        with pytest.raises(ValueError, match=message):
            sim.step_gradient(state, after)


def test_solvers_are_checked() -> None:
    for make, message in (
        (lambda: pd.Jacobi(relaxation=0.0), r"Jacobi\.relaxation must lie in \(0, 2\)"),
        (lambda: pd.Jacobi(relaxation=2.0), r"Jacobi\.relaxation must lie in \(0, 2\)"),
        (lambda: pd.Jacobi(diagonal="full"), r"Jacobi\.diagonal .*got 'full'"),
        (lambda: pd.Chebyshev("fast"), r"Chebyshev\.schedule .*got 'fast'"),
        (lambda: pd.Chebyshev("classic"), r"needs rho; torchpd\.estimate_rho"),
        (lambda: pd.Chebyshev("classic", rho=1.0), r"Chebyshev\.rho .*got 1"),
        (lambda: pd.Chebyshev("classic", rho=0.9, delay=-1), r"Chebyshev\.delay .*got -1"),
        (lambda: pd.Chebyshev("classic", rho=0.9, delay=1.5), r"Chebyshev\.delay .*got 1\.5"),
        (lambda: pd.Chebyshev(rho=math.nan), r"Chebyshev\.rho .*got nan"),
        (lambda: pd.Chebyshev(relaxation=3.0), r"Chebyshev\.relaxation .*got 3\.0"),
        (lambda: pd.Chebyshev(delay=5), r"Chebyshev\.delay .*got 5"),
        (lambda: pd.Chebyshev(diagonal="plain"), r'Chebyshev\.diagonal .*got "plain"'),
    ):
        with pytest.raises(ValueError, match=message):
            make()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("state", [None, 3, torch.zeros(2, 1, 27, 3), (torch.zeros(1, 27, 3),), ("x", "v")])
def test_what_is_no_state_is_refused(state: Any, sim: pd.Simulator) -> None:
    calls: list[Callable[[], object]] = [
        lambda: sim(state),
        lambda: sim.step_(state),
        lambda: sim.step_gradient(state, sim.rest_state().positions),
        lambda: sim.rollout(state, steps=2),
        lambda: sim.tune(state, error=0.1) if state is not None else sim(state),
    ]
    for call in calls:
        with pytest.raises(TypeError, match=r"state .*\[B, 27, 3\], .*got"):
            call()


def test_parts_of_what_is_no_state_are_named(sim: pd.Simulator) -> None:
    rest = sim.rest_state()
    with pytest.raises(TypeError, match=r"got State .*ndarray; rest_state"):
        sim(pd.State(*(part.numpy() for part in rest)))  # type: ignore[arg-type]
