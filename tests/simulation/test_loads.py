"""Pressure and wind in steps: forces of the step's start, by closed forms and by the same forces given by hand."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from runs import same_bits
from scipy.optimize import brentq
from sheets import cloth, surface
from torch import Tensor

import torchpd as pd
from torchpd.accuracy.error import exact_steps, problem_of

R = 0.3  # m, from the middle of the octahedron to its vertices


def octahedron(**changed: Any) -> pd.Cloth:
    points = R * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return cloth(pd.TriMesh(points, faces), **changed)


class Loaded:
    """A balloon above rough ground and a held sheet in the wind, and the same scene without loads."""

    def __init__(self, dtype: torch.dtype = torch.float32, **settings: Any) -> None:
        balloon, sheet = octahedron(), cloth(surface(cells=(2, 3), alternating=False))
        pin = pd.Pin(sheet, sheet.surface.vertices[:, 0] == 0.0)
        self.gas = pd.Pressure(balloon, 40.0, gas=True, ambient=300.0)
        self.suction = pd.Pressure(balloon, -10.0)
        self.wind = pd.Wind((1.0, 3.0, 0.5))
        parts = (balloon, sheet, pin, pd.Gravity(), pd.Ground(-0.31, friction=0.4))
        given = {"time_step": 1 / 60, "iterations": 60, "dtype": dtype, **settings}
        self.sim = pd.Simulator(pd.Scene(self.gas, *parts, self.wind, self.suction), **given)
        self.bare = pd.Simulator(pd.Scene(*parts), **given)

    def state(self, batch: int = 2) -> pd.State:
        made = torch.Generator().manual_seed(4)
        rest = self.sim.rest_state(batch)
        moved = (0.01 * torch.randn(rest.positions.shape, generator=made, dtype=torch.float64)).to(self.sim.dtype)
        return pd.State(rest.positions + moved, 20.0 * moved.flip(1))

    def targets(self, batch: int = 2) -> dict[Any, Tensor]:
        dtype = self.sim.dtype
        pascals = torch.linspace(20.0, 60.0, batch, dtype=dtype)
        return {self.gas: pascals, self.wind: torch.tensor([0.0, -4.0, 1.0], dtype=dtype)}


@pytest.mark.parametrize("given", [False, True], ids=["of the scene", "of the step"])
def test_loads_are_forces_of_the_step(given: bool) -> None:
    """To the bit: steps, in place too, reports, gradients of the objective and read-outs."""
    case = Loaded()
    sim, bare, state = case.sim, case.bare, case.state()
    targets = case.targets() if given else None
    more = 0.1 * torch.ones_like(state.positions)
    loads = sim.load_forces(state, targets)
    assert not torch.equal(loads, sim.load_forces(state, None if given else case.targets()))
    for own, forces in ((None, loads), (more, more + loads)):
        for start in ("velocity", "inertial"):
            (mine, report), (theirs, expected) = (
                sim(state, own, targets, start, return_info=True),
                bare(state, forces, None, start, return_info=True),
            )
            assert same_bits(mine, theirs)
            assert torch.equal(report.residual, expected.residual)
        moved = state.clone()
        sim.step_(moved, own, targets)
        assert same_bits(moved, bare(state, forces))
        after = bare(state, forces)
        assert torch.equal(sim.step_gradient(state, after, own, targets), bare.step_gradient(state, after, forces))
        for read in ("contact_forces", "reactions"):
            mine, theirs = getattr(sim, read)(state, after, own, targets), getattr(bare, read)(state, after, forces)
            assert torch.equal(mine.force, theirs.force)
    assert torch.equal(sim.energy(state, targets), bare.energy(state))


def test_a_rollout_takes_the_forces_of_every_step() -> None:
    case = Loaded()
    sim, start, more = case.sim, case.state(), 0.05
    push, breeze = torch.full_like(start.positions, more), case.targets()

    def gusts(step: int) -> dict[Any, Tensor]:
        return {case.wind: torch.tensor([0.0, 1.0 + step, 0.0]), case.gas: torch.tensor(20.0 * step)}

    for forces, targets in ((None, None), (push, breeze), (lambda step: push * step, gusts)):
        track = sim.rollout(start, 6, 2, forces=forces, targets=targets, return_info=True)
        state = start
        for step in range(6):
            pushed = forces(step) if callable(forces) else forces
            state, info = sim(state, pushed, targets(step) if callable(targets) else targets, return_info=True)
            if step % 2:
                assert same_bits(track.state(step // 2), state)
                assert torch.equal(track.info.residual[step // 2], info.residual)
    first = sim.rollout(start, 2, targets=gusts)
    assert same_bits(
        sim.rollout(first.state(), 4, targets=gusts, first=2).state(), sim.rollout(start, 6, targets=gusts).state()
    )
    assert same_bits(sim.rollout(start, 3, progress=True).state(), sim.rollout(start, 3).state())
    assert len(sim.rollout(start, 0).positions) == 0


def test_gradients_by_differences() -> None:
    """Through two steps: of states, pressures and wind. Differences are exact to 3e-7, by size^2 and by rounding."""
    case = Loaded(torch.float64, iterations=400, solver=pd.Multilevel())
    sim, start = case.sim, case.state()
    inputs = [
        start.positions,
        start.velocities,
        torch.tensor([30.0, 50.0]).double(),
        torch.tensor([0.3, 4.0, 1.0]).double(),
    ]
    weights = torch.randn(start.positions.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(x: Tensor, v: Tensor, pascals: Tensor, air: Tensor) -> Tensor:
        track = sim.rollout(pd.State(x, v), 2, targets={case.suction: pascals, case.wind: air})
        return (weights * track.positions[-1]).sum()

    leaves = [one.clone().requires_grad_() for one in inputs]
    gradients = torch.autograd.grad(loss(*leaves), leaves)
    for number, gradient in enumerate(gradients):
        way = torch.randn(gradient.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        size = 1e-6 * max(1.0, float(inputs[number].abs().max()))
        ends = [[*inputs[:number], inputs[number] + sign * size * way, *inputs[number + 1 :]] for sign in (1, -1)]
        difference = (loss(*ends[0]) - loss(*ends[1])) / (2.0 * size)
        assert float((gradient * way).sum()) == pytest.approx(float(difference), rel=2e-6)


def test_pressure_and_wind_are_material() -> None:
    """Trainable, with a batch, and given to a call; a target replaces them."""
    case = Loaded(torch.float64)
    sim, state = case.sim, case.state()
    assert sim.pressure.tolist() == [40.0, -10.0]
    assert sim.wind.tolist() == [1.0, 3.0, 0.5]
    air = torch.tensor([[1.0, 2.0, 3.0], [0.0, -1.0, 0.0]], dtype=torch.float64, requires_grad=True)
    expected = sim(state, targets={case.wind: air})
    found = torch.func.functional_call(sim, {"wind": air}, (state,))
    assert same_bits(found, expected)
    gradients = [torch.autograd.grad(one.positions.sum(), air)[0] for one in (found, expected)]
    assert torch.equal(*gradients)
    assert bool(gradients[0].any())
    sim.set_material(wind=air.detach(), pressure=torch.tensor([[50.0], [60.0]]))
    assert sim.pressure.tolist() == [[50.0, 50.0], [60.0, 60.0]]
    sixty = torch.tensor([50.0, 60.0], dtype=torch.float64)
    assert same_bits(
        sim(state), case.sim(state, targets={case.gas: sixty, case.suction: sixty, case.wind: air.detach()})
    )
    found = sim(state, targets={case.suction: torch.tensor(-7.0, dtype=torch.float64)})
    pressure = torch.tensor([[50.0, -7.0], [60.0, -7.0]], dtype=torch.float64)
    assert same_bits(found, torch.func.functional_call(sim, {"pressure": pressure}, (state,)))
    with pytest.raises(ValueError, match="state must have as many environments as the simulator's pressure, 2, got 3"):
        sim(case.state(3))
    with pytest.raises(TypeError, match=r"no array 'wind'; .*the scene has no wind"):
        case.bare.set_material(wind=torch.zeros(3))


def test_same_bits_alone_and_in_a_batch() -> None:
    case = Loaded()
    state, targets = case.state(3), case.targets(3)
    whole = case.sim(state, targets=targets)
    for number in range(3):
        one = pd.State(*(part[number, None] for part in state))
        alone = case.sim(one, targets={**targets, case.gas: targets[case.gas][number, None]})
        assert same_bits(alone, pd.State(*(part[number, None] for part in whole)))
    assert case.sim(case.state(0)).positions.shape == (0, 18, 3)


def test_transformed_steps() -> None:
    """vmap, torch.compile and autocast give the bits of steps; copies and other precisions have loads of their own."""
    case = Loaded()
    sim, state, wind = case.sim, case.state(), torch.tensor([[0.0, 2.0, 0.0], [0.0, 5.0, 1.0]])

    def step(x: Tensor, v: Tensor, air: Tensor) -> Tensor:
        after: pd.State = sim(pd.State(x, v), targets={case.wind: air})
        return after.positions

    expected = step(*state, wind)
    mapped = torch.func.vmap(step)(*(part[:, None] for part in state), wind)
    assert torch.equal(mapped[:, 0], expected)
    compiled = torch.compile(step, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(*state, wind), expected)

    def play(x: Tensor, v: Tensor, air: Tensor) -> Tensor:
        track: pd.Track = sim.rollout(pd.State(x, v), 2, targets={case.wind: air})
        return track.positions

    assert torch.equal(torch.compile(play, fullgraph=True, backend="aot_eager")(*state, wind), play(*state, wind))
    of_each = torch.func.vmap(lambda air: torch.func.functional_call(sim, {"wind": air}, (state,)).positions)(wind)
    assert torch.equal(of_each[1, 1], expected[1])
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(step(*state, wind), expected)
    slopes = []
    for function in (step, compiled):
        leaf = wind.clone().requires_grad_()
        slopes.append(torch.autograd.grad(function(*state, leaf).square().sum(), leaf)[0])
    assert torch.equal(*slopes)
    plain = sim(state)
    assert same_bits(copy.deepcopy(sim)(state), plain)
    assert same_bits(pickle.loads(pickle.dumps(sim))(state), plain)
    made, wide = Loaded(torch.float64), copy.deepcopy(sim).double()
    wide.set_material(masses=made.sim.masses)
    strong = torch.tensor([0.0, 400.0, 0.0], dtype=torch.float64)  # bounded by masses
    loads = wide.load_forces(made.state(), {case.wind: strong})
    assert torch.equal(loads, made.sim.load_forces(made.state(), {made.wind: strong}))


def test_a_balloon_grows_to_its_equilibrium() -> None:
    """E(s) of a uniform growth s: A0 Y / (1 - nu) (s - 1)^2, and the work of the gas 3 p(s) V0 s^2 ds."""
    body = octahedron(poisson=0.25, bending=0.0)
    gas = pd.Pressure(body, 150.0, gas=True, ambient=100.0)
    sim = pd.Simulator(pd.Scene(body, gas, pd.Damping(8.0)), 1 / 60, 40, dtype=torch.float64)
    area, volume = 8.0 * 3**0.5 / 4.0 * 2.0 * R**2, 4.0 / 3.0 * R**3

    def balance(s: float) -> float:
        return 2.0 * area * 100.0 / 0.75 * (s - 1.0) - 3.0 * (250.0 / s**3 - 100.0) * volume * s**2

    state = sim.rest_state()
    track = sim.rollout(state, 400)
    grown = track.positions[-1, 0].norm(dim=1) / R
    np.testing.assert_allclose(grown, brentq(balance, 1.0, 2.0, xtol=1e-12), rtol=1e-7)
    assert float(track.positions[:, 0].mean(1).abs().max()) < 1e-12
    assert bool(((track.positions[0] - state.positions) * state.positions).sum(-1).gt(0.0).all())
    s = 1.3
    scaled = sim.load_forces(pd.State(s * state.positions, state.velocities))
    torch.testing.assert_close(scaled, sim.load_forces(state) * s**2 * (250.0 / s**3 - 100.0) / 150.0)


def test_a_falling_sheet_reaches_its_terminal_velocity() -> None:
    """rho c / 2 A v^2 = m g, across the fall: v = sqrt(2 g m / A / (rho c))."""
    sheet = cloth(surface(cells=(3, 2)), area_density=0.3)
    sim = pd.Simulator(pd.Scene(sheet, pd.Wind((0, 0, 0), drag=1.1), pd.Gravity((0, -9.8, 0))), dtype=torch.float64)
    end = sim.rollout(sim.rest_state(), 150, 150).velocities[-1, 0]
    terminal = (2.0 * 9.8 * 0.3 / (1.2 * 1.1)) ** 0.5
    np.testing.assert_allclose(end, np.broadcast_to([0.0, -terminal, 0.0], end.shape), atol=1e-9 * terminal)


def test_the_converged_step_has_the_loads() -> None:
    """In the reference of errors, with targets, and in `tune`."""
    case = Loaded(torch.float64, solver=pd.Multilevel(), iterations=100)
    sim, targets = case.sim, case.targets()
    sim.set_material(friction=0.0)
    state = case.state()
    after = sim(state, targets=targets)
    exact = exact_steps(sim, state, targets=targets)
    for number, step in enumerate(exact):
        assert step.uncertainty < 1e-6
        moved = after.velocities[number].numpy() * sim.time_step
        np.testing.assert_allclose(step.solution, moved, atol=1e-8)
        own = problem_of(case.bare, state, number, forces=sim.load_forces(state, targets))
        np.testing.assert_array_equal(problem_of(sim, state, number, targets=targets).target, own.target)


def test_tune_has_the_loads() -> None:
    """There is no motion but that by the wind of the targets."""
    sheet, wind = cloth(surface(cells=(3, 3))), pd.Wind((0.0, 0.0, 0.0))
    pin = pd.Pin(sheet, sheet.surface.vertices[:, 0] == 0.0)
    sim = pd.Simulator(pd.Scene(sheet, pin, wind), dtype=torch.float64)
    with pytest.raises(ValueError, match="no motion that needs solving"):
        sim.tune(error=0.05)
    breeze = torch.tensor([[0.0, 2.0, 0.0], [1.0, 4.0, 0.0]], dtype=torch.float64)
    found = sim.tune(sim.rest_state(2), error=0.05, targets={wind: breeze}, candidates=[pd.Chebyshev()])
    assert found.attained
    assert found.matches(sim)
    with torch.no_grad():
        sim.wind.add_(1.0)
    assert not found.matches(sim)


def test_saved_and_loaded(tmp_path: Path) -> None:
    case = Loaded()
    case.sim.set_material(wind=torch.tensor([[0.0, 5.0, 0.0], [0.0, 2.0, 0.0]]))
    case.sim.save(tmp_path / "sim.safetensors")
    loaded = pd.Simulator.load(tmp_path / "sim.safetensors")
    assert same_bits(loaded(case.state()), case.sim(case.state()))
    gas, suction = loaded.scene.pressures
    assert (gas.gas, gas.ambient, gas.pascals, suction.gas) == (True, 300.0, 40.0, False)
    assert gas.body is loaded.scene.bodies[0]
    assert loaded.scene.wind is not None
    targets = {gas: torch.tensor(7.0), loaded.scene.wind: torch.tensor([0.0, 1.0, 0.0])}
    expected = case.sim(case.state(), targets={case.gas: torch.tensor(7.0), case.wind: torch.tensor([0.0, 1.0, 0.0])})
    assert same_bits(loaded(case.state(), targets=targets), expected)
    text = str(loaded)
    assert "pressures: 2" in text
    assert "wind:" in text


def test_targets_of_loads_are_checked() -> None:
    case = Loaded()
    sim, state = case.sim, case.state()
    for targets, kind, message in (
        ({case.gas: 1.0}, TypeError, "targets of a Pressure must be a tensor of torch.float32 .*got float"),
        ({case.gas: torch.zeros(3)}, ValueError, r"targets of a Pressure must be \[\], .* batch of 2 .*got \[3\]"),
        (
            {case.wind: torch.zeros(3).double()},
            TypeError,
            "targets of a Wind must be torch.float32 .*got torch.float64",
        ),
        ({case.wind: torch.zeros(3, 3)}, ValueError, r"targets of a Wind must be \[3\], .* batch of 2 .*got \[3, 3\]"),
        ({pd.Wind((1, 0, 0)): torch.zeros(3)}, ValueError, "this Wind is not a Pin, .*sim.scene.wind"),
    ):
        with pytest.raises(kind, match=message):
            sim(state, targets=targets)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"state must be \[B, 18, 3\], got \[2, 17, 3\]"):
        sim(pd.State(*(part[:, :17] for part in state)))


def test_a_scene_without_loads_has_nothing_of_them() -> None:
    bare = Loaded().bare
    assert bare.loads is None
    assert not {"pressure", "wind"} & {name for name, _ in bare.named_parameters()}
    assert not bare.load_forces(bare.rest_state()).any()


def test_time_steps_that_are_too_long_for_loads_are_named() -> None:
    """At the limit d.k_g.d = d.(k + 4 M / h^2).d of a growth d a gas is stable, and beyond it is not."""
    body = octahedron(poisson=0.25, bending=0.0)
    area, volume, mass = 8.0 * 3**0.5 / 4.0 * 2.0 * R**2, 4.0 / 3.0 * R**3, float(body.masses().sum())
    limit = (4.0 * mass * R**2 * 60.0**2 + 2.0 * area * 100.0 / 0.75) / (9.0 * volume)

    def grown(share: float) -> float:
        gas = pd.Pressure(body, 0.0, gas=True, ambient=share * limit)
        sim = pd.Simulator(pd.Scene(body, gas), 1 / 60, 50, dtype=torch.float64)
        rest = sim.rest_state()
        end = sim.rollout(pd.State(1.001 * rest.positions, rest.velocities), 60).positions[-1, 0]
        return float((end.norm(dim=1) / R - 1.0).abs().max())

    assert grown(0.98) < 1e-3
    with pytest.warns(pd.SceneWarning, match=r"gas of a Pressure .* too stiff .* take at most 0\.0163 s"):
        assert not grown(1.02) < 1e-2
    light = cloth(area_density=0.05)
    assert pd.Simulator(pd.Scene(light, pd.Wind((0.0, 4.1, 0.0)))).loads is not None
    with pytest.warns(
        pd.SceneWarning, match=r"wind of 4\.2 m/s .* 0\.05 kg/m\^2 is weakened, .* take at most 0\.0165 s"
    ):
        pd.Simulator(pd.Scene(light, pd.Wind((0.0, 4.2, 0.0))))
