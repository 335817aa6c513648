"""What docs/limits.md says of time steps, contacts and gradients, measured: the tables there come from here."""

from __future__ import annotations

import itertools
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpd as pd

CUBE = 0.05  # m
MESH = pd.shapes.box((CUBE, CUBE, CUBE), (4, 4, 4))
BAR = pd.shapes.box((0.6, 0.15, 0.15), (12, 3, 3))


def cube(*parts: Any, time_step: float = 1 / 60, youngs: float = 1e5, **options: Any) -> pd.Simulator:
    chosen: dict[str, Any] = {"iterations": 64, "solver": pd.Multilevel(), **options}
    scene = pd.Scene(pd.Solid(MESH, youngs=youngs, density=1000.0), *parts)
    return pd.Simulator(scene, time_step, dtype=torch.float64, progress=False, **chosen)


def moved(state: pd.State, shift: tuple[float, float, float], velocity: tuple[float, float, float]) -> pd.State:
    return pd.State(state.positions + state.positions.new_tensor(shift), state.velocities + torch.tensor(velocity))


def spin_left(sim: pd.Simulator, rate: float) -> float:
    """Angular momentum about z after a second over that at first."""

    def momentum(state: pd.State) -> Tensor:
        mass = sim.masses[:, None]
        centre = (mass * state.positions).sum(1, keepdim=True) / mass.sum()
        return (mass * torch.linalg.cross(state.positions - centre, state.velocities)).sum(1)[0, 2]

    rest = sim.rest_state()
    arm = rest.positions - rest.positions.mean(1, keepdim=True)
    axis = torch.tensor([0.0, 0.0, rate], dtype=torch.float64).expand_as(arm)
    start = pd.State(rest.positions, torch.linalg.cross(axis, arm))
    return float(momentum(sim.rollout(start, round(1 / sim.time_step)).state()) / momentum(start))


@pytest.mark.parametrize(
    ("rate", "share_60", "share_240"), [(3.0, 0.878, 0.965), (10.0, 0.482, 0.739), (30.0, 0.180, 0.344)]
)
def test_the_integrator_damps_spin(rate: float, share_60: float, share_240: float) -> None:
    """Whatever the solver and its iterations."""
    for time_step, share in ((1 / 60, share_60), (1 / 240, share_240)):
        for solver, iterations in ((pd.Chebyshev(), 16), (pd.Chebyshev(), 64), (pd.Multilevel(), 32)):
            sim = cube(time_step=time_step, youngs=1e6, solver=solver, iterations=iterations)
            assert spin_left(sim, rate) == pytest.approx(share, abs=6e-4)


@pytest.mark.parametrize(("depth", "rises"), [(0.005, (0.007, 0.069)), (0.02, (0.083, 1.08)), (0.049, (0.462, 6.35))])
def test_a_body_that_starts_inside_is_thrown_out(depth: float, rises: tuple[float, float]) -> None:
    """A stiff one at depth / h."""
    for time_step, rise in zip((1 / 60, 1 / 240), rises, strict=True):
        sim = cube(pd.Gravity(), pd.Ground(height=depth), youngs=1e6, time_step=time_step)
        track = sim.rollout(sim.rest_state(), round(1 / time_step))
        fastest = float(track.velocities[..., 1].mean((1, 2)).max())
        assert 0.9 * depth / time_step < fastest < depth / time_step
        height = track.positions[..., 1].mean((1, 2)).max() - 0.5 * CUBE
        assert float(height) == pytest.approx(rise, rel=0.05, abs=5e-4)


def test_fast_bodies_pass_through_balls() -> None:
    """Contacts are looked for at the end of a step: 20 m/s are 0.33 m in one of 1/60 s."""
    for speed, radius, time_step, through in (
        (20.0, 0.05, 1 / 60, True),
        (20.0, 0.2, 1 / 60, True),
        (20.0, 0.05, 1 / 240, True),
        (10.0, 0.05, 1 / 60, True),
        (10.0, 0.2, 1 / 60, False),
        (10.0, 0.05, 1 / 240, False),
        (20.0, 0.2, 1 / 240, False),
    ):
        sim = cube(pd.Sphere((0.5, CUBE / 2, CUBE / 2), radius), time_step=time_step)
        start = moved(sim.rest_state(), (0.0, 0.0, 0.0), (speed, 0.0, 0.0))
        end = sim.rollout(start, round(1.0 / (speed * time_step)) + 2).state()
        assert bool(end.positions[..., 0].mean() > 0.5) == through
        if (speed, radius, time_step) == (20.0, 0.05, 1 / 60):
            assert float(end.velocities[..., 0].min()) == pytest.approx(speed, rel=1e-6)  # no step ends in the ball


def test_contacts_have_no_restitution() -> None:
    """A cube that falls by half a metre rises by what its own elasticity gives back."""
    for youngs, time_step, rise in (
        (1e5, 1 / 60, 0.0),
        (1e5, 1 / 240, 0.009),
        (1e6, 1 / 240, 0.0),
        (1e5, 1 / 960, 0.112),
    ):
        sim = cube(pd.Gravity(), pd.Ground(), youngs=youngs, time_step=time_step, tolerance=1e-4)
        start = moved(sim.rest_state(), (0.0, 0.5, 0.0), (0.0, 0.0, 0.0))
        lowest = sim.rollout(start, round(1 / time_step)).positions[:, 0, :, 1].amin(1)
        landed = int((lowest < 1e-3).nonzero()[0])
        assert float(lowest[landed:].max()) == pytest.approx(rise, rel=0.1, abs=1e-3)


def test_planes_move_by_material() -> None:
    sim = cube(pd.Gravity(), pd.Ground(friction=0.8), solver=pd.Chebyshev())
    state = sim.rest_state()
    for step in range(30):
        sim.set_material(planes=torch.tensor([[0.0, 1.0, 0.0, 0.002 * step, 0.8]]))
        state = sim(state)
    assert float(state.positions[..., 1].min()) == pytest.approx(0.058, abs=1e-4)
    assert float(state.velocities[..., 1].mean()) == pytest.approx(0.12, rel=1e-2)


def test_a_large_ball_carries_along() -> None:
    ball = pd.Sphere((CUBE / 2, -10.0, CUBE / 2), 10.0, 0.8)
    sim = cube(pd.Gravity(), ball, solver=pd.Chebyshev())

    def path(step: int) -> dict[pd.Sphere, Tensor]:
        return {ball: torch.tensor([CUBE / 2 + 0.1 * (step + 1) / 60, -10.0, CUBE / 2], dtype=torch.float64)}

    end = sim.rollout(sim.rest_state(), 60, targets=path).state()
    assert float(end.velocities[..., 0].mean()) == pytest.approx(0.1, rel=1e-2)


def test_the_reaction_of_a_contact() -> None:
    """Of a body at rest its weight, on the vertices of the face that it lies on."""
    sim = cube(pd.Gravity(), pd.Ground())
    state = sim.rollout(sim.rest_state(), 120).state()
    reaction = sim.step_gradient(state, sim(state))[0]
    weight = 9.81 * float(sim.masses.sum())
    assert reaction.sum(0).tolist() == pytest.approx([0.0, weight, 0.0], abs=1e-3 * weight)
    touching = sim.rest_positions[:, 1] == 0.0
    assert float(reaction[~touching].abs().max()) <= 1e-2 * float(reaction[touching, 1].max())


def test_a_pin_is_let_go_in_one_environment() -> None:
    """By a tiny spring, or by the mask: the body falls freely. 0 N/m does not say whether a hard pin lets go."""
    solid = pd.Solid(MESH, youngs=1e5, density=1000.0)
    scene = pd.Scene(solid, pd.Pin(solid, [0, 1, 5]), pd.Gravity())
    springs = torch.tensor([[torch.inf] * 3, [1e-9] * 3])
    free_fall = -9.81 / 2 * 30 * 31 / 60**2
    for solver, let_go in itertools.product(
        (None, pd.Multilevel()), ({"pin_stiffness": springs}, {"pin_hard": springs.isinf()})
    ):
        sim = pd.Simulator(scene, 1 / 60, 64, solver, progress=False)
        sim.set_material(**let_go)
        end = sim.rollout(sim.rest_state(2), 30).state()
        fallen = (end.positions - sim.rest_positions)[..., 1].mean(1) / free_fall
        assert float(fallen[1]) == pytest.approx(1.0, abs=1e-3), (solver, let_go)
        assert float(fallen[0]) < 0.1
    with pytest.raises(ValueError, match=r"pin_stiffness is 0 at hard pins.* pin_hard=False"):
        sim.set_material(pin_stiffness=torch.zeros(2, 3))


class Swing(torch.nn.Module):
    """Height of the tip of a bar after 100 steps."""

    def __init__(self, sim: pd.Simulator) -> None:
        super().__init__()
        self.sim = sim

    def forward(self, state: pd.State) -> Tensor:
        end = self.sim.rollout(state, 100).positions[-1, 0]
        return end[self.sim.rest_positions[:, 0] > 0.599, 1].mean()


def slopes(youngs: float, **options: Any) -> tuple[float, float]:
    """Its derivative by a factor of the stiffness: by autograd, and by differences of the same steps."""
    solid = pd.Solid(BAR, youngs=youngs, density=1000.0)
    scene = pd.Scene(solid, pd.Pin(solid, BAR.vertices[:, 0] == 0.0), pd.Gravity())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sim = pd.Simulator(scene, 1 / 60, dtype=torch.float64, progress=False, **options)
    swing, state = Swing(sim), sim.rest_state()

    def tip(factor: Tensor) -> Tensor:
        height: Tensor = torch.func.functional_call(swing, {"sim.stiffness": factor * sim.stiffness}, (state,))
        return height

    one, change = torch.ones((), dtype=torch.float64), 1e-4
    factor = one.clone().requires_grad_()
    (slope,) = torch.autograd.grad(tip(factor), factor)
    with torch.no_grad():
        difference = (tip((1.0 + change) * one) - tip((1.0 - change) * one)) / (2.0 * change)
    return float(slope), float(difference)


def test_gradients_are_those_of_converged_steps() -> None:
    """A motion of unconverged steps has another derivative than the one that it is given."""
    right, same = slopes(1e6, solver=pd.Multilevel(), iterations=16)
    assert right == pytest.approx(same, rel=1e-5)
    slope, difference = slopes(1e6)  # 64 iterations of Chebyshev
    assert slope / right == pytest.approx(1.196, abs=0.01)
    assert difference / right == pytest.approx(1.073, abs=0.01)
    for tolerance, error in ((1e-3, 4e-3), (1e-4, 4e-4)):
        slope, _ = slopes(1e6, solver=pd.Multilevel(), iterations=124, tolerance=tolerance)
        assert slope == pytest.approx(right, rel=error)
