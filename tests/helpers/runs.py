"""Runs a `Case` in the simulator, in any precision and batch, and in the reference from the very same numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from cases import Array, Case, box, sliver_mesh
from torch import Tensor

import torchpd as pd
from torchpd.reference import StepProblem, step_problem
from torchpd.reference.solvers import Iterates, Observer, classic_chebyshev, guarded_chebyshev, jacobi

ULP = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}  # rounding of one operation, relative


def simulator(case: Case, dtype: torch.dtype, device: torch.device | str = "cpu", **options: Any) -> pd.Simulator:
    """The scene and time step of a case, compiled."""
    chosen = {"iterations": 64, **options}
    return pd.Simulator(case.scene, case.time_step, dtype=dtype, progress=False, **chosen).to(device)


def state_of(case: Case, sim: pd.Simulator, batch: int = 1) -> pd.State:
    """The state that the case starts from, [batch, V, 3]."""
    return pd.State(*(tensor_of(array, sim, batch) for array in (case.positions, case.velocities)))


def tensor_of(array: Array, sim: pd.Simulator, batch: int | None = None) -> torch.Tensor:
    """The array in the simulator's type; with a batch [batch, ...], the same for every environment."""
    tensor = torch.tensor(array, dtype=sim.dtype, device=sim.device)
    return tensor if batch is None else tensor.expand(batch, *tensor.shape).clone()


def arguments_of(case: Case, sim: pd.Simulator, batch: int = 1) -> dict[str, Any]:
    """What the simulator takes besides the state: start, forces, targets."""
    start = case.start if isinstance(case.start, str) else tensor_of(case.start, sim, batch)
    out: dict[str, Any] = {"start": start}
    if "forces" in case.extras:
        out["forces"] = tensor_of(case.extras["forces"], sim, batch)
    targets: dict[Any, torch.Tensor] = {}
    if "pin_targets" in case.extras:
        for pin in case.scene.pins:
            targets[pin] = tensor_of(case.extras["pin_targets"][case.scene.pin_range(pin)], sim, batch)
    if "sphere_centers" in case.extras:
        centers, starts = case.extras["sphere_centers"], case.extras["sphere_starts"]
        rows = np.concatenate([centers, (centers - starts) / case.time_step], axis=1)
        for sphere, row in zip(case.scene.spheres, rows, strict=True):
            targets[sphere] = tensor_of(row, sim, batch)
    return {**out, "targets": targets} if targets else out


def displacement(sim: pd.Simulator, after: pd.State, item: int = 0) -> Array:
    """x_{t+1} - x_t from the velocity, which keeps more digits than the difference of positions [V, 3]."""
    u: Array = after.velocities[item].double().cpu().numpy() * sim.time_step
    return u


def rounded_problem(case: Case, dtype: torch.dtype) -> StepProblem:
    """The step in the reference, from the state that `dtype` can hold."""
    seen = np.float32 if dtype == torch.float32 else np.float64
    x, v = (array.astype(seen).astype(np.float64) for array in (case.positions, case.velocities))
    return step_problem(case.scene.values(), x, v, case.time_step, **case.extras)


def first_of(problem: StepProblem, case: Case, solver: pd.Jacobi | pd.Chebyshev) -> Array:
    """The iterate that `solver` begins with, in the reference."""
    return problem.with_diagonal(weighted=solver.settings()["weighted"]).first_iterate(case.start)


def ended_by_rounding(problem: StepProblem, displacement: Array) -> float:
    """How far rounding may move an iterate, relative to it, where contacts touch.

    Coarse corrections with friction converge linearly, and end at 1e-7 of the size: rounding may add one more step.
    """
    size = float(np.ptp(problem.positions, axis=0).max())
    contacts = len(problem.values.planes) + len(problem.values.spheres)
    return 1e-7 * size / float(np.abs(displacement).max()) if contacts else 0.0


def reference_run(
    problem: StepProblem,
    first: Array,
    solver: pd.Jacobi | pd.Chebyshev,
    iterations: int,
    observe: Observer | None = None,
) -> Iterates:
    """The iterations of `solver` in the reference; `observe(k, u_k)` sees them."""
    numbers = solver.settings()
    if isinstance(solver, pd.Jacobi):
        return jacobi(
            problem, first, iterations=iterations, relaxation=solver.relaxation, weighted=numbers["weighted"],
            observe=observe,
        )  # fmt: skip
    if solver.schedule == "classic":
        return classic_chebyshev(
            problem, first, iterations=iterations, rho=numbers["rho"], delay=numbers["delay"],
            relaxation=numbers["relaxation"], weighted=numbers["weighted"], observe=observe,
        )  # fmt: skip
    return guarded_chebyshev(
        problem, first, iterations=iterations, relaxation=numbers["relaxation"], rho=solver.rho, observe=observe
    )


def reference_runs(
    problem: StepProblem, first: Array, solver: pd.Jacobi | pd.Chebyshev, counts: Sequence[int]
) -> Iterator[Iterates]:
    """What `reference_run` gives for each of some counts, from one run; `energies` has that of its end."""
    seen: dict[int, Array] = {}
    run = reference_run(problem, first, solver, max(counts), seen.__setitem__)
    weighed = problem.with_diagonal(weighted=solver.settings()["weighted"])
    for count in counts:
        u = weighed.align(seen[count])
        residual = weighed.relative_residual(u)
        restarts = [k for k in run.restarts if k < count]
        yield Iterates(u, residual, count, restarts, [(count, problem.energy(u))])


def taken_off(problem: StepProblem, u: Array, dtype: torch.dtype) -> float:
    """The most that `Info.residual` leaves out as rounding: 4 eps of every stiffness times the largest position."""
    size = float(np.linalg.norm(np.ptp(problem.positions, axis=0)) + np.abs(problem.positions).max() + np.abs(u).max())
    rounding = 4 * torch.finfo(dtype).eps * 2 * size * float(np.linalg.norm(problem.weighted_diagonal))
    return rounding * problem.relative_residual(u) / float(np.linalg.norm(problem.residual(u)))


def residual_error(problem: StepProblem, expected: Iterates, found: float, dtype: torch.dtype) -> float:
    """Of `Info.residual`, relative to that of the reference, beyond what it may leave out as rounding."""
    least = expected.residual - taken_off(problem, expected.displacement, dtype)
    return max(found - expected.residual, least - found, 0.0) / expected.residual


def small_case() -> Case:
    """Slivers with hard and soft pins, drag, gravity, a ground and a ball with friction."""
    mesh = sliver_mesh((3, 2, 2))
    body = pd.Solid(mesh, youngs=10.0 ** np.random.default_rng(0).uniform(3.0, 5.0, len(mesh.tets)))
    scene = pd.Scene(
        body, pd.Pin(body, [0, 3]), pd.Pin(body, [9, 12], 1e3), pd.Gravity(), pd.Damping(1.0),
        pd.Ground(-0.01, friction=0.5), pd.Sphere((0.4, 0.1, 0.1), 0.1, friction=0.2),
    )  # fmt: skip
    rng = np.random.default_rng(1)
    x = mesh.vertices + 0.01 * rng.standard_normal(mesh.vertices.shape)
    return Case(scene, x, rng.standard_normal(x.shape), 1.0 / 60.0)


def small(
    dtype: torch.dtype, device: torch.device | str = "cpu", batch: int = 3, **options: Any
) -> tuple[pd.Simulator, pd.State]:
    """A simulator and different environments."""
    case = small_case()
    sim = simulator(case, dtype, device, **{"iterations": 6, **options})
    factor = torch.linspace(0.5, 1.5, batch, dtype=dtype, device=device)[:, None, None]
    x, v = (tensor_of(array, sim) for array in (case.positions, case.velocities))
    return sim, pd.State(sim.rest_positions + factor * (x - sim.rest_positions), factor * v)


def noise(like: Tensor, seed: int = 0) -> Tensor:
    return torch.randn(like.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(like)


def plan_of(sim: pd.Simulator) -> list[Tensor]:
    return list(sim.plan.arrays)


def settings_of(sim: pd.Simulator, **changed: Any) -> dict[str, Any]:
    """The keyword arguments of `step`."""
    return {**sim.step_settings(inertial=False, report=True), "iterations": 4, "tolerance": 0.0, **changed}


def material_with(sim: pd.Simulator, stiffness: Tensor) -> list[Tensor]:
    """The simulator's material with another stiffness, which comes first."""
    return [stiffness, *sim.material()[1:]]


def full_scene() -> pd.Scene:
    mesh = pd.TetMesh(*box((0.4, 0.2, 0.2), (4, 2, 2)))
    body = pd.Solid(mesh, youngs=5e4)
    return pd.Scene(
        body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Pin(body, [40, 44], 1e3), pd.Gravity(), pd.Damping(1.0),
        pd.Ground(-0.02, friction=0.5), pd.Sphere((0.4, -0.3, 0.1), 0.25, friction=0.2),
    )  # fmt: skip


def simulate(dtype: torch.dtype, device: torch.device | str = "cpu", **options: Any) -> pd.Simulator:
    return pd.Simulator(full_scene(), 1 / 60, dtype=dtype, progress=False, **{"iterations": 12, **options}).to(device)


def moving(sim: pd.Simulator, batch: int = 3) -> pd.State:
    """Different environments that fall and swing."""
    state = sim.rest_state(batch)
    speed = torch.linspace(0.2, 1.0, batch, dtype=sim.dtype, device=sim.device)[:, None]
    velocities = state.velocities.clone()
    velocities[..., 1] = -3.0 * speed * state.positions[..., 0]
    velocities[..., 2] = speed
    return pd.State(state.positions, velocities)


def same_bits(one: pd.State | pd.Track, other: pd.State | pd.Track) -> bool:
    return torch.equal(one.positions, other.positions) and torch.equal(one.velocities, other.velocities)
