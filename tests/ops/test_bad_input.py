"""What an op cannot run is refused, with the name, the contract and what came."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from devices import missing_gpu
from small_scene import call_step, scene, settings, small_simulator
from torch import Tensor

import torchpd as pd
from torchpd.common.tables import SETTINGS_TABLE
from torchpd.plan.material import MATERIAL_ROWS
from torchpd.scene.solvers import Solver

ops = torch.ops.torchpd
PATCHES, MOST_SLOTS = 5, 8  # in the order of PlanSize


@pytest.fixture(scope="module")
def sim() -> pd.Simulator:
    return small_simulator()


def replaced(arrays: list[Tensor], name: str, value: Tensor, sim: pd.Simulator) -> list[Tensor]:
    """Material or plan with one array exchanged."""
    number = [*MATERIAL_ROWS].index(name) if name in MATERIAL_ROWS else [row.name for row in sim.plan.table].index(name)
    return [*arrays[:number], value, *arrays[number + 1 :]]


def twice(x: Tensor) -> Tensor:
    return x.repeat(1, 2, 1)


# what replaces arguments, given fitting positions; the error; its words
STATES: dict[str, tuple[Callable[[Tensor], dict[str, Tensor]], type[Exception], str]] = {
    "positions of integers": (
        lambda x: {"positions": x.long()},
        TypeError,
        "positions .*got Long",
    ),
    "positions of halves": (
        lambda x: {"positions": x.half()},
        TypeError,
        "positions .*got Half",
    ),
    "positions without batch": (
        lambda x: {"positions": x[0]},
        ValueError,
        r"positions must be \[batch, vertices, 3\] \(m\), got Float \[27, 3\] on cpu",
    ),
    "positions in the plane": (
        lambda x: {"positions": x[..., :2]},
        ValueError,
        r"positions .*got Float \[2, 27, 2\]",
    ),
    "too many vertices": (
        lambda x: {"positions": twice(x), "velocities": twice(x)},
        ValueError,
        r"positions .*got Float \[2, 54, 3\]",
    ),
    "other velocities": (
        lambda x: {"velocities": x[:1]},
        ValueError,
        r"velocities .*got Float \[1, 27, 3\]",
    ),
    "precise velocities": (
        lambda x: {"velocities": x.double()},
        TypeError,
        "velocities .*got Double",
    ),
    "other forces": (
        lambda x: {"forces": x[0]},
        ValueError,
        r"forces .*got Float \[27, 3\]",
    ),
    "precise forces": (
        lambda x: {"forces": x.double()},
        TypeError,
        r"forces .*got Double \[2, 27, 3\]",
    ),
    "other start": (
        lambda x: {"start": x[:, :5]},
        ValueError,
        r"start .*got Float \[2, 5, 3\]",
    ),
    "precise state": (
        lambda x: {"positions": x.double(), "velocities": x.double()},
        TypeError,
        r"plan\.[a-z_]+ must be Double \(.*\), got Float",
    ),
}


@pytest.mark.parametrize("name", STATES)
def test_states_are_checked(name: str, sim: pd.Simulator) -> None:
    change, kind, message = STATES[name]
    with pytest.raises(kind, match=message):
        call_step(sim, **change(sim.rest_state(2).positions))


NUMBERS = {
    "schedule": ((-1, 6), r"schedule must be 0 \(jacobi\), .* 4 \(momentum\) or 5 \(newton\), got"),
    "iterations": ((-1, 10**10), r"iterations must be 0\.\.1e9, got"),
    "time_step": ((0.0, -1.0, math.nan, math.inf), r"time_step .*finite \[s\], got"),
    "relaxation": ((0.0, 2.0, -0.1, math.nan), r"relaxation must lie in \(0, 2\), got"),
    "rho": ((-0.1, 1.0, math.nan), r"rho must lie in \[0, 1\), got"),
    "delay": ((-1,), "delay .*got -1"),
    "tolerance": ((-1e-3, math.nan), r"tolerance must be >= 0, got"),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_checked(name: str, sim: pd.Simulator) -> None:
    values, message = NUMBERS[name]
    for value in values:
        with pytest.raises(ValueError, match=message):
            call_step(sim, **{name: value})


@pytest.mark.parametrize("solver", [pd.Jacobi(), pd.Chebyshev(), pd.Chebyshev("classic", rho=0.9), pd.Multilevel()])
def test_a_simulator_gives_every_setting(solver: Solver) -> None:
    """In the types of the schemas, which follow from the table."""
    given = pd.Simulator(scene(), 1 / 60, 2, solver).step_settings(inertial=False, report=True)
    assert {name: type(value).__name__ for name, value in given.items()} == {
        row.name: row.type for row in SETTINGS_TABLE
    }
    for op in (ops.step, ops.step_, ops.rollout):
        named = [argument.name for argument in op.default._schema.arguments if argument.kwarg_only]
        assert [name for name in named if name not in ("steps", "every")] == [row.name for row in SETTINGS_TABLE]


@pytest.mark.parametrize(("steps", "every"), [(-1, 1), (4, 0), (4, -2)])
def test_steps_of_a_rollout_are_checked(steps: int, every: int, sim: pd.Simulator) -> None:
    state = sim.rest_state()
    with pytest.raises(ValueError, match=r"steps must be 0\.\.1e9 and every 1\.\.1e9, got"):
        ops.rollout(*state, None, sim.material(), list(sim.plan.arrays), **settings(sim), steps=steps, every=every)


def test_material_is_checked(sim: pd.Simulator) -> None:
    wrong: list[tuple[str, Tensor, str]] = [
        ("masses", sim.masses[:-1], r"material\.masses .*got Float \[26\]"),
        ("masses", sim.masses.repeat(3, 1), r"material\.masses .*got Float \[3, 27\]"),
        (
            "masses",
            sim.masses.double(),
            r"material\.masses .*got Double",
        ),
        ("gravity", sim.gravity[:2], r"material\.gravity .*got Float \[2\]"),
        ("damping", sim.damping[None, None], r"material\.damping .*got Float \[1, 1\]"),
        ("pin_stiffness", sim.pin_stiffness[:1], r"material\.pin_stiffness must be \[3\]"),
        ("pin_targets", sim.pin_targets.T, r"material\.pin_targets must be (contiguous|\[3, 3\])"),
        ("planes", sim.planes[:, :4].contiguous(), r"material\.planes .*got Float \[1, 4\]"),
        ("spheres", sim.spheres[0], r"material\.spheres .*got Float \[8\]"),
        (
            "stiffness",
            sim.stiffness[: len(sim.stiffness) // 2],
            r"stiffness .*got Float \[24\]",
        ),
    ]
    for name, value, message in wrong:
        with pytest.raises((TypeError, ValueError), match=message):
            call_step(sim, material=replaced(sim.material(), name, value, sim))
    x, few, plan = sim.rest_state(2).positions, sim.material()[:-1], list(sim.plan.arrays)
    for call in (
        lambda: call_step(sim, material=few),
        lambda: ops.gradient(x, few, plan),
        lambda: ops.elastic_diagonal(few, plan, weighted=True),
    ):
        with pytest.raises(ValueError, match=r"material .*got 7"):
            call()


def test_plans_are_checked(sim: pd.Simulator) -> None:
    arrays, plan = list(sim.plan.arrays), sim.plan
    none, many = plan.sizes.clone(), plan.sizes.clone()
    none[PATCHES], many[MOST_SLOTS] = 0, 1000
    wrong: list[tuple[str, Tensor, str]] = [
        ("sizes", plan.sizes.long(), r"plan\.sizes .*got Long"),
        ("sizes", plan.sizes[:-1], r"plan\.sizes .*got Int \[10\]"),
        ("sizes", none, r"plan\.sizes .*got 0 patches"),
        ("sizes", many, r".*got 1 patches with up to 1000 of 27 slots"),
        ("sizes", plan.sizes + 1, r"plan\.vertex_order .*got Int \[27\]"),
        ("tet_rest", plan.tet_rest.double(), r"plan\.tet_rest .*got Double \[3, 96\]"),
        ("tet_rest", plan.tet_rest[:, :9].contiguous(), r"plan\.tet_rest .*got Float \[3, 9\]"),
        ("tet_rest", plan.tet_rest[:-1], r"plan\.tet_rest .*got Float \[2, 96\] on cpu"),
        ("tet_corner", plan.tet_corner.int(), r"plan\.tet_corner must be Short"),
        ("slot_vertex", plan.slot_vertex[:-1], r"plan\.slot_vertex must be \[27\] \(internal vertex"),
        ("vertex_component", plan.vertex_component[:-1], r"plan\.vertex_component must be \[27\]"),
        ("shared_slot", torch.zeros(1, dtype=torch.int32), r"plan\.shared_slot must be \[0\]"),
        ("vertex_order", plan.vertex_order.flip(0)[::2], r"plan\.vertex_order .*got strides \[2\]"),
    ]
    for name, value, message in wrong:
        with pytest.raises((TypeError, ValueError), match=message):
            call_step(sim, plan=replaced(arrays, name, value, sim))
    with pytest.raises(ValueError, match=r"plan .*got 1"):
        call_step(sim, plan=arrays[:1])


@pytest.mark.parametrize("change", [-17, -15, -1, 1, 8, 15, 17])
def test_stiffness_of_another_mesh(change: int, sim: pd.Simulator) -> None:
    """One value too few would be read, and an energy written, past the end of an array."""
    count = len(sim.stiffness) + change
    material = replaced(sim.material(), "stiffness", torch.ones(count), sim)
    x = sim.rest_state().positions
    plan = list(sim.plan.arrays)
    message = rf"stiffness must be \[48\] or \[batch, 48\], one value per tetrahedron .* got Float \[{count}\]"
    for call in (
        lambda: ops.element_energy(x, material, plan),
        lambda: ops.gradient(x, material, plan),
        lambda: ops.elastic_diagonal(material, plan, weighted=True),
        lambda: call_step(sim, material=material),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_stiffness_of_a_diagonal_is_checked(sim: pd.Simulator) -> None:
    plan = list(sim.plan.arrays)

    def diagonal(stiffness: Tensor) -> Tensor:
        found: Tensor = ops.elastic_diagonal(replaced(sim.material(), "stiffness", stiffness, sim), plan, weighted=True)
        return found

    with pytest.raises(TypeError, match=r"stiffness .*got Long"):
        diagonal(sim.stiffness.long())
    with pytest.raises(TypeError, match=r"plan\.[a-z_]+ must be Double \(.*\), got Float"):
        diagonal(sim.stiffness.double())


def test_step_in_place_checks_what_it_writes(sim: pd.Simulator) -> None:
    x, v = sim.rest_state(2)
    rest = (None, None, sim.material(), list(sim.plan.arrays))
    info = torch.empty(2, 7, dtype=torch.float64)
    for bad in (info[:1], info.float(), info[:, :5], info.T.contiguous().T):
        with pytest.raises(ValueError, match=r"info .*contiguous float64 \[2, 7\], got"):
            ops.step_(x, v, bad, *rest, **settings(sim))
    for state in ((x.mT.contiguous().mT, v), (x, v.mT.contiguous().mT)):
        with pytest.raises(ValueError, match=r"step_: positions .*contiguous"):
            ops.step_(*state, info, *rest, **settings(sim))


def test_rotations_are_checked() -> None:
    for bad, kind, message in (
        (torch.eye(3).long(), TypeError, "matrices .*got Long"),
        (torch.zeros(3), ValueError, r"matrices .*got Float \[3\]"),
        (torch.zeros(5, 3, 2), ValueError, r"matrices .*got Float \[5, 3, 2\]"),
    ):
        with pytest.raises(kind, match=message):
            pd.nearest_rotation(bad)
    with pytest.raises(TypeError, match=r"nearest_rotation: F .*got ndarray"):
        pd.nearest_rotation(np.eye(3))  # type: ignore[arg-type]
    for other in (torch.zeros(1, 3, 3), torch.zeros(2, 3, 3, dtype=torch.float64)):
        with pytest.raises(ValueError, match=r"direction must be .* like matrices, got"):
            ops.rotation_differential(torch.zeros(2, 3, 3), other)


@pytest.mark.skipif(bool(missing_gpu()), reason="a second device is needed to mix devices")
def test_devices_are_not_mixed(sim: pd.Simulator) -> None:
    x = sim.rest_state(2).positions
    with pytest.raises(Exception, match=r"velocities must be on cpu like positions|same device"):
        call_step(sim, velocities=x.cuda())
