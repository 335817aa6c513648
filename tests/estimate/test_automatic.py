"""`solver="auto"` takes the solver that is expected to be the faster, says why, and chooses the same every time."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from cases import sliver_mesh
from devices import missing_gpu
from multilevel_cases import landing
from programs import ROOT
from runs import same_bits, state_of

import torchpd as pd
from torchpd.accuracy.error import exact_steps
from torchpd.common.gpu import H100
from torchpd.estimate import solver_choice as automatic
from torchpd.estimate.convergence import MOST_OF_LEVELS
from torchpd.estimate.solver_choice import (
    AIM,
    CPU_CHEBYSHEV,
    MOST_OF_CHEBYSHEV,
    PATIENCE,
    TOLERANCE,
    Cost,
    multilevel_cost,
)
from torchpd.plan.compiled import CompiledScene
from torchpd.plan.kernel_choice import choose_plan
from torchpd.plan.kernel_costs import iteration_microseconds
from torchpd.simulation import settings
from torchpd.study.scenes import STUDY_SCENES


def beam(youngs: float, cells: int = 5, **options: Any) -> pd.Simulator:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    body = pd.Solid(mesh, youngs=youngs)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    return pd.Simulator(scene, 1 / 30, progress=False, **{"solver": "auto", **options})


def set_costs(monkeypatch: pytest.MonkeyPatch, chebyshev: Cost, multilevel: Cost) -> None:
    monkeypatch.setattr(automatic, "CPU_CHEBYSHEV", chebyshev)
    monkeypatch.setattr(automatic, "CPU_MULTILEVEL", multilevel)


def swinging(sim: pd.Simulator) -> pd.State:
    state = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    return state


@pytest.mark.parametrize(("youngs", "kind"), [(1e3, pd.Chebyshev), (1e6, pd.Multilevel), (1e8, pd.Multilevel)])
def test_stiff_steps_get_multilevel_and_reach_the_aim(youngs: float, kind: type) -> None:
    sim = beam(youngs)
    assert type(sim.solver) is kind
    exact = exact_steps(beam(youngs, solver=pd.Multilevel()), swinging(sim))[0]
    left = exact.errors_of(sim(swinging(sim)).velocities[0].double().numpy() * sim.time_step).position
    assert left <= AIM
    again = beam(youngs)
    assert (again.solver, again.iterations, again.choice) == (sim.solver, sim.iterations, sim.choice)


def test_the_relaxation_fits_the_spectrum() -> None:
    """Where inertia is nearly all, 1.9 of it overshoots: two iterations of the right relaxation do as well as 28."""
    soft = beam(30.0, cells=2)
    theta = soft.solver.settings()["relaxation"]
    assert isinstance(soft.solver, pd.Chebyshev)
    assert 1.0 < theta < 1.2
    assert beam(1e5, iterations=1000).solver == pd.Chebyshev()
    state = swinging(soft)
    exact = exact_steps(soft, state)[0]
    errors = []
    for solver in (soft.solver, pd.Chebyshev()):
        soft.solver, soft.iterations = solver, 4
        errors.append(exact.errors_of(soft(state).velocities[0].double().numpy() * soft.time_step).position)
    assert errors[0] < 1e-2 * errors[1]


def test_iterations_that_are_given_stay() -> None:
    enough, few = beam(1e5, iterations=1000), beam(1e5, iterations=30)
    assert (type(enough.solver), enough.iterations) == (pd.Chebyshev, 1000)
    assert (type(few.solver), few.iterations) == (pd.Multilevel, 30)
    assert few.choice is not None
    assert not few.choice.sets_iterations
    assert "30 leave about" in repr(few)
    few.prepare_solver()
    assert few.iterations == 30
    # set later: as good as given
    own = beam(1e6)
    own.iterations = 7
    own.prepare_solver()
    assert own.iterations == 7


def test_a_tolerance_leaves_hard_steps_their_iterations() -> None:
    """A beam goes through states where the energy is not convex: with the iterations of the others 0.2 is left."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (25, 5, 5))
    body = pd.Solid(mesh, youngs=1e5, density=1000.0)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    sim = pd.Simulator(scene, 1 / 30, solver="auto", tolerance=1e-4, progress=False)
    track = sim.rollout(sim.rest_state(), 30)
    assert bool(track.info.converged.all())
    enough = sim.iterations / PATIENCE
    assert float(track.info.iterations.double().mean()) < enough < int(track.info.iterations.max())


def test_auto_sets_a_tolerance_with_its_iterations() -> None:
    """One that is set stays, also when "auto" chooses again; and iterations that are given run to their end."""
    sim = beam(1e6)
    assert sim.tolerance == TOLERANCE
    sim.tolerance = 0.0
    sim.prepare_solver()
    assert sim.tolerance == 0.0
    sim.solver = "auto"
    assert sim.tolerance == TOLERANCE
    assert beam(1e6, tolerance=1e-4).tolerance == 1e-4
    given = beam(1e6, iterations=20)
    assert (given.iterations, given.tolerance) == (20, 0.0)


def test_costs_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 1e6 Pa some 370 iterations stand against 19: Chebyshev wins when one of Multilevel costs 100 of its."""
    set_costs(monkeypatch, Cost(1.0, 1.0), Cost(100.0, 100.0))
    assert isinstance(beam(1e6).solver, pd.Chebyshev)
    set_costs(monkeypatch, Cost(1.0, 1.0), Cost(1.0, 1.0))
    assert isinstance(beam(1e4).solver, pd.Multilevel)


@pytest.mark.parametrize("multiprocessors", [20, 132, 170])
def test_multilevel_costs_more_than_chebyshev_everywhere(
    multiprocessors: int, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An iteration has the same local step: on every GPU, in both precisions, for any number of environments."""
    for cells in (3, 9, 10, 20):
        scene = pd.Scene(pd.Solid(pd.shapes.box((1.0, 1.0, 1.0), (cells,) * 3), 1e5))
        sim = pd.Simulator(scene, 1 / 60, dtype=dtype, progress=False)
        times = [
            cost.iteration(sim.vertices, 16) for cost in (CPU_CHEBYSHEV, multilevel_cost(sim.vertices, on_gpu=False))
        ]
        assert [automatic._chebyshev_time(sim.compiled, 16), automatic._multilevel_time(sim.compiled, 16)] == times
        assert times[1] > 2.0 * times[0] > 0.0
        for batch in (1, 16, 1024):
            gpu = H100._replace(multiprocessors=multiprocessors)
            sim.plan = choose_plan(scene.values(), dtype, gpu, batch=batch, progress=False)
            assert (
                automatic._multilevel_time(sim.compiled, batch)
                > 2.0 * automatic._chebyshev_time(sim.compiled, batch)
                > 0.0
            )


@pytest.mark.parametrize(
    ("youngs", "friction", "chosen"),
    [
        (1e4, 0.0, pd.Multilevel),
        (1e6, 0.0, pd.Multilevel),
        (1e7, 0.0, pd.Multilevel),
        (10.0, 0.0, pd.Chebyshev),
        (1e4, 0.5, pd.Chebyshev),
    ],
)
def test_what_lands_reaches_the_aim(youngs: float, friction: float, chosen: type[pd.Solver]) -> None:
    """A tilted cube of two centimetres, in each of the steps that take it into the ground."""
    case = landing(youngs, friction=friction)
    sim = pd.Simulator(case.scene, case.time_step, solver="auto", dtype=torch.float64, progress=False)
    assert isinstance(sim.solver, chosen)
    assert ("friction may stall Multilevel" in repr(sim)) == (friction > 0.0)
    exact = pd.Simulator(case.scene, case.time_step, 60000, dtype=torch.float64, tolerance=1e-9, progress=False)
    state, errors = state_of(case, sim), []
    for _ in range(4):
        after, (solution, info) = sim(state), exact(state, return_info=True)
        assert bool(info.converged)
        # as a tolerance is measured: relative to what contacts and elasticity displace, or gravity if that is more
        target = state.positions + sim.time_step * state.velocities
        target[..., 1] -= 9.81 * sim.time_step**2
        displaced = max(float((target - solution.positions).norm()), 9.81 * sim.time_step**2 * sim.vertices**0.5)
        errors.append(float((after.positions - solution.positions).norm()) / displaced)
        state = solution
    assert max(errors) <= AIM


def test_a_landing_without_slivers_takes_few_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    """669 iterations of Chebyshev are worth two roots of that, 53, of Multilevel each 11.2 as long; a seventh is 96."""
    set_costs(monkeypatch, Cost(1.0, 0.0), Cost(8.0, 0.0))
    case = landing(2e5)
    sim = pd.Simulator(case.scene, case.time_step, solver="auto", progress=False)
    assert (sim.solver, sim.iterations) == (pd.Multilevel(), 95 * PATIENCE)
    assert "about 669 iterations of Chebyshev reach 0.001, or about 53 of Multilevel, each as long as 11" in repr(sim)


def test_multilevel_is_worth_it_where_slivers_may_land(monkeypatch: pytest.MonkeyPatch) -> None:
    """A seventh of 1545 iterations, each as long as 11.2, is too many; 79 without slivers are not, and end there."""
    set_costs(monkeypatch, Cost(1.0, 0.0), Cost(8.0, 0.0))
    scene = pd.Scene(pd.Solid(sliver_mesh(), 1e6), pd.Gravity(), pd.Ground(-0.1))
    sim = pd.Simulator(scene, 1 / 60, solver="auto", progress=False)
    assert isinstance(sim.solver, pd.Multilevel)
    assert "about 227 of Multilevel, each as long as 11; about 79 where no sliver" in " ".join(str(sim).split())


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_few_iterations_on_smooth_contacts_are_multilevels(friction: float) -> None:
    """Those of Chebyshev leave 1e-2 of a cube that slides, and with friction Multilevel may leave more."""
    body = pd.Solid(pd.shapes.box((0.3, 0.3, 0.3), (6, 6, 6)), 1e7)
    scene = pd.Scene(body, pd.Gravity(), pd.Ground(0.0, friction=friction))
    few = pd.Simulator(scene, 1 / 60, 64, solver="auto", dtype=torch.float64, progress=False)
    assert few.iterations == 64
    assert isinstance(few.solver, pd.Chebyshev if friction else pd.Multilevel)
    many = pd.Simulator(scene, 1 / 60, 4000, solver="auto", dtype=torch.float64, progress=False)
    assert isinstance(many.solver, pd.Chebyshev)
    if friction == 0.0:
        assert "expected when a stiff body lands" in repr(few)


@pytest.mark.parametrize("iterations", [2, 4, 8])
def test_solvers_that_know_nothing_of_contacts_are_not_chosen_there(iterations: int) -> None:
    for youngs in (10.0, 30.0, 1e3):
        case = landing(youngs)
        sim = pd.Simulator(case.scene, case.time_step, iterations, solver="auto", progress=False)
        assert isinstance(sim.solver, pd.Chebyshev) or sim.solver == pd.Multilevel()


def test_time_of_a_batch() -> None:
    """2 + 4 * 0.5 us of one environment, 500 vertices; two others take turns, or 0.8 * 0.5 us each, or 1.2 / 4 more.

    Never longer than taking turns: 20 * 0.5 us are 10.
    """
    assert Cost(2.0, 4.0).iteration(500) == 4.0
    assert Cost(2.0, 4.0).iteration(500, 3) == 12.0
    assert Cost(2.0, 4.0, 0.8).iteration(500, 3) == pytest.approx(4.0 + 2 * 0.4)
    assert Cost(2.0, 4.0, 0.8, 1.2).iteration(500, 3) == pytest.approx(4.0 + 2 * 0.7)
    assert Cost(2.0, 4.0, 20.0).iteration(500, 3) == 12.0


@pytest.mark.parametrize("size", ["1k", "3k", "10k"])
def test_few_environments_get_the_solver_that_was_faster(size: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the measured steps of 16 beams on a GPU, with the costs of one: the choice itself is the same on the CPU."""
    file = ROOT / "benchmarks" / "results" / "time-to-error-cuda-batch-16.json"
    rows = [row for row in json.loads(file.read_text())["rows"] if row["size"] == size]
    studied = STUDY_SCENES["beam"]()
    mesh = studied.mesh({"1k": 5, "3k": 8, "10k": 12}[size])

    def chebyshev_time(compiled: CompiledScene, batch: int) -> float:
        plan = choose_plan(compiled.scene.values(), compiled.dtype, H100, batch=batch, progress=False)
        return iteration_microseconds(plan, len(mesh.tets), batch, H100)

    def multilevel_time(compiled: CompiledScene, batch: int) -> float:
        return multilevel_cost(compiled.vertices, on_gpu=True).iteration(compiled.vertices, batch)

    monkeypatch.setattr(automatic, "_chebyshev_time", chebyshev_time)
    monkeypatch.setattr(automatic, "_multilevel_time", multilevel_time)
    chosen = []
    for row in rows:
        scene = studied.scene(mesh, row["youngs"])
        sim = pd.Simulator(scene, studied.time_step, solver="auto", batch=row["batch"], progress=False)
        took = [row["solvers"][name]["milliseconds"]["min"] for name in ("Chebyshev", "Multilevel")]
        assert took[isinstance(sim.solver, pd.Multilevel)] <= 1.1 * min(took), row["youngs"]
        chosen.append(type(sim.solver))
    assert len(chosen) == 5
    assert chosen[0] is pd.Chebyshev
    assert chosen[-1] is pd.Multilevel
    # alone they get Chebyshev where sixteen get Multilevel
    if size == "1k":
        alone = pd.Simulator(studied.scene(mesh, 1e6), studied.time_step, solver="auto", batch=1, progress=False)
        assert isinstance(alone.solver, pd.Chebyshev)
        assert chosen[2] is pd.Multilevel


def test_the_batch_decides_where_environments_share_a_device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As on a GPU: Multilevel's iteration costs 9 times as much for one environment, 30 times for a thousand."""
    set_costs(monkeypatch, Cost(1.0, 0.0, 0.04), Cost(9.0, 0.0, 1.22))
    unknown, alone, many = beam(1e6), beam(1e6, batch=1), beam(1e6, batch=1024)
    assert isinstance(unknown.solver, pd.Multilevel)
    assert isinstance(alone.solver, pd.Multilevel)
    assert isinstance(many.solver, pd.Chebyshev)
    assert "each as long as 30 in a batch of 1024" in repr(many)
    assert "in a batch" not in repr(unknown)
    assert "in a batch" not in repr(alone)
    # which may be said later
    alone.batch = 1024
    assert isinstance(alone.solver, pd.Chebyshev)
    alone.batch = 1
    assert isinstance(alone.solver, pd.Multilevel)
    # another choice is for the same batch: after a change, in a file, on another precision
    many.prepare_solver()
    assert isinstance(many.solver, pd.Chebyshev)
    many.save(tmp_path / "beam.safetensors")
    loaded = pd.Simulator.load(tmp_path / "beam.safetensors")
    assert loaded.batch == 1024
    loaded.prepare_solver()
    assert isinstance(loaded.solver, pd.Chebyshev)
    many.solver = pd.Multilevel()
    many.solver = "auto"
    assert isinstance(many.solver, pd.Chebyshev)


def test_the_kernel_of_chebyshev_is_compared_whatever_ran_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU a simulator with Multilevel has a plan of other patches, whose costs are not Chebyshev's."""
    sim = beam(1e6)
    sim.plan = dataclasses.replace(sim.plan, for_multilevel=True)
    solvers = []

    def fails(compiled: CompiledScene, *_: object) -> None:
        solvers.append(compiled.solver)
        raise ArithmeticError

    monkeypatch.setattr(settings, "choose_solver", fails)
    for choose in (lambda: setattr(sim, "solver", "auto"), sim.prepare_solver):
        with pytest.raises(ArithmeticError):
            choose()
        assert isinstance(solvers.pop(), pd.Chebyshev)
        # all or nothing
        assert isinstance(sim.solver, pd.Multilevel)
        assert sim.plan.for_multilevel


@pytest.mark.parametrize("youngs", [1e3, 1e4, 1e5, 1e6])
def test_on_the_cpu_the_batch_changes_nothing(youngs: float) -> None:
    alone, many = beam(youngs), beam(youngs, batch=1024)
    assert (alone.solver, alone.iterations) == (many.solver, many.iterations)


def test_print_says_why_and_any_other_solver_ends_it() -> None:
    sim = beam(1e6)
    text = repr(sim)
    assert "solver: Multilevel lbfgs" in text
    assert (
        "chosen because about 374 iterations of Chebyshev reach 0.001, or about 19 of Multilevel, each as long as 3.8"
        in text
    )
    sim.solver = pd.Chebyshev()
    assert sim.choice is None
    assert "chosen because" not in repr(sim)
    sim.solver = "auto"
    assert isinstance(sim.solver, pd.Multilevel)
    with pytest.raises(TypeError, match=r"solver must be .*, got the class Multilevel: write Multilevel\(\)"):
        beam(1e5, solver=pd.Multilevel)
    with pytest.raises(TypeError, match=r"solver .*got 'fast'"):
        sim.solver = "fast"  # type: ignore[assignment]
    assert sim.choice is not None


def test_prepare_solver_chooses_for_the_present_material() -> None:
    sim = beam(1e3)
    sim.set_material(stiffness=1e8)
    assert isinstance(sim.solver, pd.Chebyshev)
    sim.prepare_solver()
    assert isinstance(sim.solver, pd.Multilevel)
    assert sim.iterations == beam(1e8).iterations


def test_a_device_without_multilevel_gets_chebyshev(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(solver: Any, device: torch.device) -> Any:
        if isinstance(solver, pd.Multilevel):
            raise RuntimeError("no kernels")
        return solver

    monkeypatch.setattr(automatic, "check_solver", refuse)
    sim = beam(1e8)
    assert isinstance(sim.solver, pd.Chebyshev)
    assert "Multilevel does not run on cpu" in repr(sim)
    assert sim.iterations > 3000


@pytest.mark.parametrize("youngs", [1e3, 1e6])
def test_files_keep_the_choice_and_that_it_was_one(youngs: float, tmp_path: Path) -> None:
    sim = beam(youngs)
    sim.save(tmp_path / "beam.safetensors")
    loaded = pd.Simulator.load(tmp_path / "beam.safetensors")
    assert (loaded.solver, loaded.iterations, loaded.choice) == (sim.solver, sim.iterations, sim.choice)
    assert same_bits(loaded(swinging(loaded)), sim(swinging(sim)))
    loaded.solver = pd.Chebyshev()
    loaded.save(tmp_path / "beam.safetensors")
    assert pd.Simulator.load(tmp_path / "beam.safetensors").choice is None


def test_precision_and_copies_keep_it() -> None:
    sim = beam(1e6)
    wide = sim.double()
    assert isinstance(wide.solver, pd.Multilevel)
    assert wide.choice is not None
    state = swinging(wide)
    assert bool(wide(state).positions.isfinite().all())


@pytest.mark.skipif(bool(missing_gpu()), reason=missing_gpu())
@pytest.mark.parametrize("youngs", [1e3, 1e6])
def test_moving_chooses_for_the_device(youngs: float) -> None:
    sim = beam(youngs)
    there = (sim.solver, sim.iterations)
    sim.to("cuda")
    assert sim.choice is not None
    assert sim.device.type == "cuda"
    assert bool(sim(swinging(sim)).positions.isfinite().all())
    sim.to("cpu")
    assert (sim.solver, sim.iterations) == there


def test_a_sheet_that_buckles_over_a_ball_gets_chebyshev() -> None:
    """With the 83 iterations of Multilevel that ground would do with 0.2 to 0.4 of a step were left."""
    mesh = pd.shapes.box((1.0, 0.01, 1.0), (16, 1, 16)).translated((-0.5, 0.35, -0.5))
    parts = pd.Sphere((0.0, 0.0, 0.0), 0.3), pd.Gravity(), pd.Ground(-0.3), pd.Damping(0.5)
    scene = pd.Scene(pd.Solid(mesh, 1e5, 300.0), *parts)
    sim = pd.Simulator(scene, 1 / 60, solver="auto", progress=False, dtype=torch.float64)
    assert isinstance(sim.solver, pd.Chebyshev)
    assert "a ball may stall Multilevel" in str(sim)
    state = sim.rollout(sim.rest_state(), 13).state()
    converged = pd.Simulator(scene, 1 / 60, 4000, progress=False, dtype=torch.float64)(state).positions
    error = (sim(state).positions - converged).norm()
    assert error <= 1e-3 * (state.positions + state.velocities / 60 - converged).norm()


def clip(*parts: Any, size: float = 1e-3) -> pd.Scene:
    """Steel, so small and stiff that no number of iterations in float32 would do."""
    body = pd.Solid(pd.shapes.box((size, 0.2 * size, 0.2 * size), (5, 1, 1)), 2e11, 7800.0)
    return pd.Scene(body, pd.Gravity(), *parts)


def test_steps_end() -> None:
    """Where nothing would do "auto" takes a number that ends, and says what is left; a bound is no reason to warn."""
    with pytest.warns(pd.UnsolvedWarning, match=r"Simulator: .*40,000 .*about (0\.\d|1) .*time_step"):
        rough = pd.Simulator(clip(pd.Ground(-1e-3, friction=0.5)), solver="auto")
    assert isinstance(rough.solver, pd.Chebyshev)
    assert rough.iterations == MOST_OF_CHEBYSHEV * PATIENCE
    assert f'; "auto" takes no more than {rough.iterations:,}' in " ".join(str(rough).split())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        smooth = pd.Simulator(clip(pd.Ground(-1e-3)), solver="auto")
    assert isinstance(smooth.solver, pd.Multilevel)
    assert smooth.iterations == MOST_OF_LEVELS * PATIENCE
    assert bool(rough(rough.rest_state()).positions.isfinite().all())


def test_a_choice_that_is_not_capped_warns_when_it_has_become_too_few(tmp_path: Path) -> None:
    body = pd.Solid(pd.shapes.box((0.05, 0.01, 0.01), (5, 1, 1)), 1e9, 7800.0)
    sim = pd.Simulator(pd.Scene(body, pd.Gravity(), pd.Ground(-0.05)), solver="auto", tolerance=1e-3)
    assert MOST_OF_LEVELS < sim.iterations < PATIENCE * MOST_OF_LEVELS
    with pytest.warns(pd.UnsolvedWarning, match=r"prepare_solver\(\) chooses again"):
        sim.set_material(stiffness=1e6 * sim.stiffness)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.prepare_solver()
    assert sim.iterations == PATIENCE * MOST_OF_LEVELS
    # one that is capped is told so again where it comes from a file
    with pytest.warns(pd.UnsolvedWarning, match=r"Simulator: .*40,000 "):
        pd.Simulator(clip(pd.Ground(-1e-3, friction=0.5)), solver="auto").save(tmp_path / "clip")
    with pytest.warns(pd.UnsolvedWarning, match=r"^Simulator\.load: .*40,000 "):
        pd.Simulator.load(tmp_path / "clip")
