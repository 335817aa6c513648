"""Gradients of steps in which vertices slide against friction, beside finite differences."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from conjugate_reference import System, stabilised_gradients
from torch import Tensor

import torchpd as pd

pytestmark = pytest.mark.usefixtures("poisoned")

MESH = pd.shapes.box((0.4, 0.2, 0.2), (4, 2, 2))
GROUND = float(MESH.vertices[:, 1].min())
MATERIAL = ("stiffness", "masses", "gravity", "damping")


def noise(like: Tensor, seed: int) -> Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(like)


def simulator(*parts: pd.scene.Part, mesh: pd.TetMesh = MESH, youngs: float = 2e4) -> pd.Simulator:
    """A soft block, in float64 and solved to rounding."""
    block = pd.Solid(mesh, youngs, density=1000.0)
    scene = pd.Scene(block, pd.Gravity(), pd.Damping(0.5), *parts)
    return pd.Simulator(scene, 1 / 60, 6000, dtype=torch.float64, tolerance=1e-14)


def scene(surface: str) -> pd.Simulator:
    rough: dict[str, list[pd.scene.Part]] = {
        "ground": [pd.Ground(GROUND, friction=0.3)],
        "slope": [pd.Ground(-0.01, (0.3, 1.0, 0.1), friction=0.2)],
        "ball": [pd.Sphere((0.2, GROUND - 0.3, 0.1), 0.3, friction=0.3)],
        "small balls": [pd.Sphere((x, GROUND - 0.05, 0.1), 0.05, friction=0.5) for x in (0.0, 0.2, 0.4)],
    }
    return simulator(*rough[surface])


def motion(sim: pd.Simulator, across: float) -> tuple[pd.State, Tensor]:
    """Two environments that slide by now, the second one faster, and forces that push them on."""
    state = sim.rest_state(2)
    push = torch.zeros_like(state.positions)
    push[..., 0], push[..., 2] = 80.0 / sim.vertices, across * 80.0 / sim.vertices
    push[1] *= 1.5
    with torch.no_grad():
        for _ in range(6):
            state = sim(state, push)
    return state, push


def count_sliding(sim: pd.Simulator, state: pd.State, push: Tensor, targets: Any = None) -> int:
    material = [array.detach() for array in sim.material_at(targets, len(push))]
    after = sim(state, push, targets).positions.detach()
    *_, sliding = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, push, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    return int((sliding[..., 0, :] != 0.0).any(-1).sum())


@pytest.mark.parametrize("across", [0.3, 0.0])
@pytest.mark.parametrize("surface", ["ground", "slope", "ball", "small balls"])
def test_gradients_are_those_of_differences(surface: str, across: float) -> None:
    """For all that is differentiable, at once in random directions."""
    sim = scene(surface)
    state, push = motion(sim, across)
    assert count_sliding(sim, state, push) >= 1
    compare_with_differences(sim, state, push)


def compare_with_differences(
    sim: pd.Simulator, state: pd.State, push: Tensor, *, error: float = 2e-5, **targets: Any
) -> None:
    weight = noise(state.positions, 3)
    weight[..., 0] += 1.0
    inputs: dict[str, Tensor] = {"positions": state.positions, "velocities": state.velocities, "forces": push}
    inputs |= {name: getattr(sim, name) for name in MATERIAL}

    def loss(values: dict[str, Tensor]) -> Tensor:
        material = {name: values[name] for name in MATERIAL}
        given = pd.State(values["positions"], values["velocities"]), values["forces"]
        after = torch.func.functional_call(sim, material, given, targets)
        return (weight * after.positions).sum() + 0.01 * (weight * after.velocities).sum()

    leaves = {name: value.detach().clone().requires_grad_() for name, value in inputs.items()}
    gradients = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values())), strict=True))
    for seed, (name, value) in enumerate(leaves.items()):
        size = 1e-6 * float(value.detach().abs().max())
        direction = size * noise(value, 10 + seed)
        with torch.no_grad():
            ends = [float(loss({**leaves, name: value + sign * direction})) for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / 2.0
        assert float((gradients[name] * direction).sum()) == pytest.approx(expected, rel=error, abs=1e-13), name


@pytest.mark.parametrize(("frictions", "error"), [((0.3, 0.0), 1e-3), ((0.0, 0.3), 1e-3), ((0.3, 0.2), 2e-2)])
def test_along_a_wall(frictions: tuple[float, float], error: float) -> None:
    """On the ground and against a wall: the corner was up to 21 % off (csrc/solver/adjoint/friction.h)."""
    walls = (pd.Ground(GROUND, friction=frictions[0]), pd.Ground(0.0, (0.0, 0.0, 1.0), friction=frictions[1]))
    sim = simulator(*walls, youngs=2e5)
    sim.set_material(gravity=torch.tensor([0.0, -9.8, -4.0]))
    state = sim.rest_state(2)
    with torch.no_grad():
        for _ in range(8):
            state = sim(state)
    state.velocities[..., 0] += torch.tensor([1.0, 2.0])[:, None]
    still = torch.zeros_like(state.positions)
    material = [array.detach() for array in sim.material_at(None, 2)]
    after = sim(state).positions.detach()
    system = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, still, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    slides = (system[-1][..., 0, :] != 0.0).any(-1)
    in_corner = system[3].diagonal(dim1=-2, dim2=-1).sum(-1) < 1.5
    assert int((slides & in_corner).sum()) >= 4
    compare_with_differences(sim, state, still, error=error)


def test_landing_on_a_ball_that_moves() -> None:
    """Fast along the normal, so that it turns under the slip."""
    ball = pd.Sphere((0.2, GROUND - 0.11, 0.1), 0.1, friction=0.4)
    sim = simulator(ball)
    state = sim.rest_state(2)
    velocities = torch.tensor([[1.5, -1.0, 0.4], [1.0, -1.5, -0.4]], dtype=torch.float64)[:, None].expand_as(
        state.positions
    )
    target = torch.tensor([0.21, GROUND - 0.105, 0.1, 0.3, 0.2, 0.0], dtype=torch.float64)
    state = pd.State(state.positions, velocities.contiguous())
    still = torch.zeros_like(state.positions)
    assert count_sliding(sim, state, still, {ball: target}) > 0
    compare_with_differences(sim, state, still, targets={ball: target})


@pytest.mark.parametrize("moves", ["its velocity is given", "by its centre alone", "not at all"])
def test_what_lands_on_a_ball_and_sticks_turns_about_its_centre(moves: str) -> None:
    """It ends on the line from the centre to its start: 22 % nearer to others that start beside it, or farther."""
    ball = pd.Sphere((0.21, GROUND - 0.06, 0.1), 0.05, friction=5.0)
    sim = simulator(ball)
    state = sim.rest_state(2)
    velocities = torch.zeros_like(state.positions)
    velocities[..., 1] = torch.tensor([-2.0, -1.0], dtype=torch.float64)[:, None]
    targets = {
        "its velocity is given": {ball: torch.tensor([0.215, GROUND - 0.055, 0.1, 0.3, 0.3, 0.0], dtype=torch.float64)},
        "by its centre alone": {ball: torch.tensor([0.215, GROUND - 0.055, 0.1], dtype=torch.float64)},
        "not at all": None,
    }[moves]
    state, still = pd.State(state.positions, velocities), torch.zeros_like(state.positions)
    material = [array.detach() for array in sim.material_at(targets, 2)]
    after = sim(state, still, targets).positions.detach()
    *_, stuck, _ = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, still, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    assert int(stuck.sum()) >= 2
    compare_with_differences(sim, state, still, targets=targets)


def test_some_slide_some_stick_and_some_are_held() -> None:
    """By hard pins and soft ones, of one block."""
    block = pd.Solid(MESH, youngs=2e4, density=1000.0)
    far, near = MESH.vertices[:, 0] > 0.35, MESH.vertices[:, 0] < 0.05
    parts = [pd.Pin(block, far & (MESH.vertices[:, 1] > 0.05)), pd.Pin(block, near, stiffness=30.0)]
    surfaces = [pd.Ground(GROUND, friction=0.3)]
    sim = pd.Simulator(
        pd.Scene(block, pd.Gravity(), *parts, *surfaces), 1 / 60, 6000, dtype=torch.float64, tolerance=1e-14
    )
    state = sim.rest_state(2)
    state.velocities[..., 0] = 0.5 * (0.4 - state.positions[..., 0])
    push = torch.zeros_like(state.positions)
    push[..., 2] = 0.3
    assert count_sliding(sim, state, push) > 4
    compare_with_differences(sim, state, push)


@pytest.mark.parametrize("pushed", [1.05, 1.3, 2.0])
def test_slow_slip_takes_no_more_products(pushed: float) -> None:
    """The slower, the more a slip turns for a force across it: by up to a thousand times what elasticity holds."""
    sim = simulator(pd.Ground(0.0, friction=0.4), mesh=pd.shapes.box((0.6, 0.15, 0.4), (12, 3, 8)))
    state = sim.rest_state()
    push = torch.zeros_like(state.positions)
    push[..., 0], push[..., 2] = pushed * 0.4 * 9.81 * sim.masses, 0.3 * sim.masses
    with torch.no_grad():
        for _ in range(8):
            state = sim(state, push)
    assert count_sliding(sim, state, push) > 100
    material = [array.detach() for array in sim.material_at(None, 1)]
    after = sim(state, push).positions.detach()
    along = torch.zeros_like(after)
    along[..., 0] = 1.0
    right, inertia, inverse, projector, _, sliding = torch.ops.torchpd.adjoint_system(
        along, 0.0 * along, after, *state, push, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    system = System(inertia, inverse, projector, material, list(sim.plan.arrays))
    product = system.friction_product_at(after, sliding)
    _, products = stabilised_gradients(product, system.preconditioner(), right, 1e-10)
    assert 0 < products <= 100
    multiplier, error = torch.ops.torchpd.conjugate_gradients(
        after, right, inertia, inverse, projector, material, system.plan, sliding, tolerance=1e-10
    )
    assert float(error) <= 1e-9
    left = right - product(system.off_normals(multiplier))
    assert float(left.norm() / right.norm()) <= 2e-9


def test_where_a_solve_fails_friction_is_left_out() -> None:
    """All of it: the start of a slip too, which else would be worth more the slower it is."""
    sim = scene("ground")
    sim.iterations, sim.tolerance = 1, 0.0
    rest = sim.rest_state()
    crumpled = rest.positions + 0.05 * noise(rest.positions, 1)
    crumpled[..., 1] = crumpled[..., 1].abs() + GROUND
    sizes = []
    for speed in (0.3, 3e-3):
        x = crumpled.clone().requires_grad_()
        velocities = torch.zeros_like(x)
        velocities[..., 0], velocities[..., 1] = speed, -1.0
        with pytest.warns(UserWarning, match="adjoint of a step has no solution"):
            (gradient,) = torch.autograd.grad(sim(pd.State(x, velocities)).positions[..., 0].sum(), x)
        sizes.append(float(gradient.norm()))
    assert max(sizes) < 3.0 * min(sizes)


def test_who_slides_feels_what_presses_him_down() -> None:
    """A block pushed along the ground: weight slows it by mu h^2 for each m/s^2, and by none without friction."""
    sim = scene("ground")
    sim.set_material(stiffness=1e6)
    state, push = motion(sim, 0.0)
    sim.gravity.requires_grad_()
    loss = sim(state, push).positions[0, :, 0].mean()
    (gradient,) = torch.autograd.grad(loss, sim.gravity)
    h, slowed = sim.time_step, 0.3 / (1.0 + 0.5 * sim.time_step)
    # of the block as a whole; it is not rigid, and takes more than a step to press all of its weight on the ground
    assert float(gradient[1]) == pytest.approx(slowed * h**2, rel=0.05)


def test_in_float32_and_in_a_batch_with_others(device: torch.device) -> None:
    """One environment slides, one rests, one flies, one has no state: the others are what they are alone."""
    sim = scene("ground")
    state, push = motion(sim, 0.3)
    rest = sim.rest_state()
    still = torch.zeros_like(rest.positions)
    high = rest.positions + torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    positions = torch.cat([state.positions[:1], rest.positions, high, torch.full_like(high, torch.nan)])
    velocities, forces = (
        torch.cat([state.velocities[:1], still, still, still]),
        torch.cat([push[:1], still, still, still]),
    )
    sim.tolerance = 0.0
    sim.iterations = 2000
    wanted = gradient_of(sim, positions, velocities, forces)
    single = sim.to(torch.float32).to(device)
    found = gradient_of(single, *(t.to(torch.float32).to(device) for t in (positions, velocities, forces)))
    assert found[3].isnan().all()
    assert float((found[:3].cpu() - wanted[:3]).norm() / wanted[:3].norm()) < 1e-3
    for e in range(3):
        one = (t[e : e + 1].to(torch.float32).to(device) for t in (positions, velocities, forces))
        assert torch.equal(gradient_of(single, *one)[0], found[e])


def gradient_of(sim: pd.Simulator, x: Tensor, v: Tensor, forces: Tensor) -> Tensor:
    """Of the way along the ground, for forces."""
    push = forces.clone().requires_grad_()
    (found,) = torch.autograd.grad(sim(pd.State(x, v), push).positions[..., 0].sum(), push)
    return found


@pytest.mark.parametrize("factor", [2.0**-90, 2.0**118])
def test_a_loss_may_be_of_any_size(factor: float) -> None:
    """In float32, to the ends of its range."""
    sim = scene("ground")
    state, push = (t.float() if isinstance(t, Tensor) else pd.State(*(x.float() for x in t)) for t in motion(sim, 0.3))
    sim.tolerance = 0.0
    sim.iterations = 300
    sim.to(torch.float32)
    x = push.clone().requires_grad_()
    loss = sim(state, x).positions[..., 0].sum()
    (wanted,) = torch.autograd.grad(loss, x, retain_graph=True)
    (found,) = torch.autograd.grad(factor * loss, x)
    torch.testing.assert_close(
        found.double() / factor, wanted.double(), rtol=1e-3, atol=1e-3 * float(wanted.abs().max())
    )


def test_multilevel_has_the_same_gradients() -> None:
    sim = scene("ground")
    state, push = motion(sim, 0.3)
    wanted = gradient_of(sim, *state, push)
    sim.solver = pd.Multilevel()
    found = gradient_of(sim, *state, push)
    assert float((found - wanted).norm() / wanted.norm()) < 1e-6


def test_friction_that_jams_is_said() -> None:
    """As the residual of the system with friction says; what was found stays."""
    sim = scene("ground")
    state, push = motion(sim, 0.3)
    material = [array.detach() for array in sim.material_at(None, 2)]
    solution, right, inverse = noise(push, 1), noise(push, 2), 1.0 / sim.masses
    solved, jams = torch.tensor([0.0, 0.0], dtype=torch.float64), torch.tensor([0.0, 0.1], dtype=torch.float64)
    given = (state.positions, right, inverse, None, material, list(sim.plan.arrays))
    with pytest.warns(UserWarning, match=r"friction .*1 of 2 environments .*1\.0e-01.*jams"):
        found = torch.ops.torchpd.adjoint_fallback(solution, solved, jams, *given, time_step=sim.time_step)
    assert torch.equal(found, solution)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torch.ops.torchpd.adjoint_fallback(solution, solved, solved, *given, time_step=sim.time_step)


def test_without_friction_nothing_is_added() -> None:
    """Nor where friction holds everything: the bits are those of the system without it."""
    for friction in (0.0, 5.0):
        block = pd.Solid(MESH, youngs=2e4)
        sim = pd.Simulator(pd.Scene(block, pd.Gravity(), pd.Ground(GROUND, friction=friction)), 1 / 60, 500)
        x = sim.rest_state().positions
        still, material = torch.zeros_like(x), [array.detach() for array in sim.material_at(None, 1)]
        after = sim(pd.State(x, still)).positions
        right, inertia, inverse, projector, _, sliding = torch.ops.torchpd.adjoint_system(
            x, still, after, x, still, None, material, list(sim.plan.arrays), time_step=sim.time_step
        )
        given = (after, right, inertia, inverse, projector, material, list(sim.plan.arrays))
        found, error = torch.ops.torchpd.conjugate_gradients(*given, sliding, tolerance=1e-5)
        wanted, same = torch.ops.torchpd.conjugate_gradients(*given, tolerance=1e-5)
        assert torch.equal(found, wanted)
        assert torch.equal(error, same)
