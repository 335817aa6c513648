"""The multilevel solver on a GPU does what it does on the CPU, however many blocks share an environment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import Case, beam, contact_block, on_sphere, slivers
from devices import require_gpu
from multilevel_cases import irregular, many_bodies, precondition, swing
from on_gpu import GPU, device_work, host_waits, moved, relative
from runs import arguments_of, noise, same_bits, simulator, small, state_of

import torchpd as pd
from torchpd.tables import MULTILEVEL_TABLE

require_gpu()

pytestmark = pytest.mark.usefixtures("poisoned")

SOLVERS = {"lbfgs": pd.Multilevel(), "momentum": pd.Multilevel("momentum")}
# one block; several; a middle level; pieces; contacts of every kind
CASES: dict[str, Callable[[], Case]] = {
    "slivers": slivers,
    "beam": lambda: beam(1e6),
    "box": lambda: swing(13, 1e6),
    "octopus": irregular,
    "bodies": many_bodies,
    "ground": lambda: contact_block(pd.Ground(), velocity=(0.0, -1.0, 0.0), youngs=1e6, cells=4),
    "sphere": lambda: on_sphere(0.3),
    "sliding": lambda: contact_block(pd.Ground(friction=0.5), velocity=(1.0, -1.0, 0.0), youngs=1e6, cells=4),
}


def pair(case: Case, dtype: torch.dtype, solver: pd.Multilevel, **options: object) -> tuple[pd.Simulator, pd.Simulator]:
    sims = [simulator(case, dtype, device, solver=solver, **options) for device in ("cpu", GPU)]
    return sims[0], sims[1]


@pytest.mark.parametrize("name", ["slivers", "beam", "box", "bodies"])
def test_preconditioner_is_that_of_the_cpu(name: str, dtype: torch.dtype) -> None:
    cpu, gpu = pair(CASES[name](), dtype, SOLVERS["lbfgs"])
    field = noise(cpu.rest_positions).double().numpy()
    given = torch.tensor(np.stack([field, -2.0 * field]), dtype=dtype, device=GPU)
    found = torch.ops.torchpd.precondition(given, list(gpu.plan.arrays))
    # as in test_multilevel.py, but for the sums' order
    assert relative(found[0], torch.tensor(precondition(cpu, field))) <= (1e-9 if dtype == torch.float64 else 1e-2)
    assert torch.equal(-2.0 * found[0], found[1])


@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize("name", CASES)
def test_iterates_are_those_of_the_cpu(name: str, outer: str) -> None:
    case = CASES[name]()
    sims = pair(case, torch.float64, SOLVERS[outer], iterations=8)
    after = [sim(state_of(case, sim, 2), return_info=True, **arguments_of(case, sim, 2)) for sim in sims]
    (cpu, expected), (gpu, info) = after
    # rounding grows with every iteration; contacts that one of two roundings touches differ by it
    assert relative(gpu.positions - sims[1].rest_positions, cpu.positions - sims[0].rest_positions) <= 1e-8
    for field in ("iterations", "restarts", "converged"):
        assert torch.equal(getattr(info, field).cpu(), getattr(expected, field)), field
    assert relative(info.energy, expected.energy) <= 1e-8
    assert relative(info.rho, expected.rho) <= 1e-9


@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize("name", ["beam", "octopus", "ground"])
def test_float32_ends_where_float64_does(name: str, outer: str) -> None:
    case = CASES[name]()
    ends = []
    for dtype, device in ((torch.float64, "cpu"), (torch.float32, GPU)):
        sim = simulator(case, dtype, device, solver=SOLVERS[outer], iterations=120)
        ends.append(sim(state_of(case, sim), **arguments_of(case, sim)).velocities)
    assert relative(ends[1], ends[0]) <= 2e-4


@pytest.mark.parametrize("outer", SOLVERS)
def test_material_that_it_was_not_made_for(outer: str) -> None:
    """Stiffness of each environment, springs that it takes for strangers, and pins that came since."""
    case = beam(1e6)
    body = case.scene.solids[0]
    scene = pd.Scene(body, pd.Pin(body, np.arange(36), stiffness=1.0), pd.Gravity((0.0, -9.8, 0.0)))
    case = Case(scene, case.positions, case.velocities, case.time_step, start="inertial")
    ends, rho = [], []
    for sim in pair(case, torch.float64, SOLVERS[outer], iterations=8):
        factor = torch.tensor([[1.0], [0.1], [3.0]], dtype=torch.float64, device=sim.device)
        springs = torch.tensor([[1.0], [1e6], [float("inf")]], dtype=torch.float64, device=sim.device)
        springs = springs.expand(3, len(sim.pin_stiffness)).contiguous()
        sim.set_material(stiffness=factor * sim.stiffness, masses=(1.0 + factor) * sim.masses, pin_stiffness=springs)
        after, info = sim(state_of(case, sim, 3), start="inertial", return_info=True)
        ends.append(after.velocities)
        rho.append(info.rho)
    assert relative(ends[1], ends[0]) <= 1e-7
    assert relative(rho[1], rho[0]) <= 1e-9


@pytest.mark.parametrize("outer", SOLVERS)
@pytest.mark.parametrize("name", ["slivers", "beam", "ground"])
def test_an_environment_does_not_know_of_the_others(name: str, outer: str, dtype: torch.dtype) -> None:
    """Alone by many blocks, in a batch by fewer, and among more than run at once."""
    case = CASES[name]()
    sim = simulator(case, dtype, GPU, solver=SOLVERS[outer], iterations=6)
    factor = torch.linspace(0.5, 1.5, 300, dtype=dtype, device=GPU)[:, None, None]
    state = state_of(case, sim, 300)
    state = pd.State(state.positions, factor * state.velocities)
    together = sim(state)
    assert same_bits(together, sim(state))
    for first, last in ((0, 1), (7, 12), (299, 300)):
        few = sim(pd.State(state.positions[first:last], state.velocities[first:last]))
        assert same_bits(few, pd.State(together.positions[first:last], together.velocities[first:last]))
    assert not torch.equal(together.velocities[0], together.velocities[1])


def test_rollout_is_its_steps_and_a_recording_too() -> None:
    sim, start = small(torch.float32, GPU, solver=pd.Multilevel(), tolerance=1e-3, iterations=20)
    track = sim.rollout(start, 3)
    own = pd.State(*(t.clone() for t in start))
    step = sim.capture(own)
    state = start
    for number in range(3):
        state = sim(state)
        step.replay()
        assert same_bits(own, state)
        assert torch.equal(track.positions[number], state.positions)
    assert not host_waits(lambda: sim(start))
    # one launch for all iterations
    names = device_work(lambda: sim(start))
    assert sum("outer_iterations" in name for name in names) == 1


def test_solvers_can_be_exchanged() -> None:
    sim, start = small(torch.float64, GPU)
    plain = sim(start)
    sim.solver = pd.Multilevel()
    assert sim.plan.for_levels
    text = str(sim)
    assert "preconditioner: " in text
    assert "all iterations in one launch" in text
    first = sim(start)
    assert not same_bits(first, plain)
    sim.set_material(stiffness=2.0 * sim.stiffness)
    sim.prepare_solver()
    sim.set_material(stiffness=0.5 * sim.stiffness)
    sim.prepare_solver()
    assert same_bits(sim(start), first)
    sim.solver = pd.Chebyshev()
    assert not sim.plan.for_levels
    assert same_bits(sim(start), plain)
    sim_with_levels, _ = small(torch.float64, GPU, solver=pd.Multilevel())
    block, _ = small(torch.float64, GPU, kernel="block")
    with pytest.raises(ValueError, match="Multilevel runs with kernel=\"stream\" on a GPU, got kernel='block'"):
        block.solver = pd.Multilevel()
    assert block.solver == pd.Chebyshev()
    levels = sim_with_levels.plan.arrays[-len(MULTILEVEL_TABLE) :]
    numbers = {**block.numbers(inertial=False, report=False), **pd.Multilevel().numbers()}
    with pytest.raises(ValueError, match="plan must be one for kernel 2"):
        torch.ops.torchpd.step(*start, None, None, block.material(), [*block.plan.arrays, *levels], **numbers)


def test_gradients_are_those_of_the_cpu() -> None:
    case = contact_block(pd.Ground(), velocity=(0.3, -1.0, 0.0))
    found = []
    for sim in pair(case, torch.float64, pd.Multilevel(), iterations=200):
        sim.stiffness.requires_grad_()
        state = state_of(case, sim, 2)
        state.velocities.requires_grad_()
        sim(state).positions.square().sum().backward()
        found.append((state.velocities.grad, sim.stiffness.grad))
    for cpu, gpu in zip(*found, strict=True):
        assert relative(gpu, cpu) <= 1e-7


def test_there_and_back_and_through_a_file(tmp_path: Path) -> None:
    """Inertia and stiffness that it was made of go along, in the order of the user's vertices."""
    cpu, start = small(torch.float64, solver=pd.Multilevel("momentum"))
    cpu.set_material(stiffness=3.0 * cpu.stiffness)
    cpu.prepare_solver()
    expected = cpu(start)
    gpu = pd.Simulator.load(_saved(cpu, tmp_path / "cpu")).to(GPU)
    assert relative(gpu(moved(start, GPU)).velocities, expected.velocities) <= 1e-9
    back = pd.Simulator.load(_saved(gpu, tmp_path / "gpu"))
    assert same_bits(back(start), expected)
    assert same_bits(gpu.to("cpu")(start), expected)
    text = str(gpu.float().to(GPU))
    assert "float32" in text


def _saved(sim: pd.Simulator, path: Path) -> Path:
    sim.save(path)
    return path
