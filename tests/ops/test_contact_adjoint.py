"""Gradients through a step with contact between bodies: the compiled adjoint, its op, and what has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from adjoint_scenes import (
    CASES,
    WITH_SCENE,
    Step,
    cube_on_cube,
    seeded,
    sliding_cube,
    sticking_cube,
    vertex_on_triangle,
)
from body_scenes import block, gravity, pose, simulator
from op_samples import OF_CONTACT, samples
from torch import Tensor

import torchpd as pd

pytestmark = pytest.mark.filterwarnings("ignore::torchpd.MeshWarning")

STEPS = {
    "positions": 1e-7, "velocities": 1e-5, "forces": 1e-4, "contact_friction": 1e-5, "contact_thickness": 1e-7,
    "pin_targets": 1e-7,
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_reference(name: str) -> None:
    """To 1e-8 of the dense reference, which differences of converged steps confirm to 1e-6: CG stops at 1e-10."""
    step = CASES[name]()
    found = step.gradients()
    for key, wanted in step.reference_gradients().items():
        assert float((found[key] - wanted).norm()) <= 1e-8 * float(wanted.norm()), key
    friction = step.reference().friction
    assert float(found["contact_friction"].sum()) == pytest.approx(float(friction.sum()), rel=1e-8, abs=1e-12)


@pytest.mark.parametrize("name", WITH_SCENE)
def test_with_planes_spheres_pins_and_damping(name: str) -> None:
    """What the reference lacks, against differences: to 1e-6 along a random direction."""
    step = WITH_SCENE[name]()
    inputs, found = step.inputs(), step.gradients()
    left = ("damping", "planes", "spheres", "pin_stiffness")  # at the rim of what is allowed, or infinite
    for number, (key, gradient) in enumerate(found.items()):
        if key in left:
            continue
        direction = torch.ones_like(gradient) if key == "contact_friction" else seeded(gradient, 10 + number)
        along = float((gradient * direction).sum())
        wanted = step.difference(key, direction, STEPS.get(key, 1e-4 * float(inputs[key].abs().max())))
        assert along == pytest.approx(wanted, rel=1e-6), key
    if name == "rough ground":  # its height
        direction = torch.zeros_like(inputs["planes"])
        direction[..., 3] = 1.0
        along = float((found["planes"] * direction).sum())
        assert along == pytest.approx(step.difference("planes", direction, 1e-7), rel=1e-6)


def test_gradcheck() -> None:
    """Every number of the Jacobian of a step of a tetrahedron on a triangle, to 1e-6."""
    step = vertex_on_triangle()
    inputs = step.inputs()
    names = ("positions", "velocities", "forces")

    def of_state(*state: Tensor) -> tuple[Tensor, Tensor]:
        after = step.run({**inputs, **dict(zip(names, state, strict=True))})
        return after.positions, after.velocities

    given = tuple(inputs[name].requires_grad_() for name in names)
    assert torch.autograd.gradcheck(of_state, given, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_float32() -> None:
    """To 2e-3 of the gradient in double: an angle of a normal is known to an ulp of the place over the thickness."""
    step = sliding_cube()
    wanted = step.gradients()
    sim = pd.Simulator(step.sim.scene, step.sim.time_step, 256, progress=False)
    state = step.state.to(torch.float32)
    found = replace(step, sim=sim, state=state).gradients()
    for key in ("positions", "velocities", "forces", "end"):
        assert found[key].dtype == torch.float32
        assert float((found[key].double() - wanted[key]).norm()) <= 2e-3 * float(wanted[key].norm()), key


@pytest.mark.parametrize("make", [sliding_cube, sticking_cube, cube_on_cube])
def test_the_same_bits_in_a_batch(make: Any, two_threads: None) -> None:
    """Gradients of an environment have the bits that it has alone, on one thread."""
    step = make()
    alone = step.gradients()
    moved = step.state.positions + torch.tensor([0.001, 0.0, 0.0], dtype=torch.float64)
    others = [step.state, pd.HistoryState(moved, *step.state[1:]), step.state]
    parts = zip(*((x, v, *history) for x, v, history in others), strict=True)
    x, v, *history = (torch.cat(arrays) for arrays in parts)
    batch = Step(step.sim, pd.HistoryState(x, v, pd.ContactHistory(*history)), step.colliders, step.poses)

    def loss_of(state: Any) -> tuple[Tensor, ...]:
        state = pd.HistoryState(
            state.positions.clone().requires_grad_(), state.velocities.clone().requires_grad_(), state.history
        )
        inputs = {**batch.inputs(), "positions": state.positions, "velocities": state.velocities}
        after = batch.run(inputs)
        like = step.state.positions
        sums = (seeded(like, 0) * after.positions).sum() + step.sim.time_step * (
            seeded(like, 1) * after.velocities
        ).sum()
        return torch.autograd.grad(sums, state[:2])

    together = loss_of(batch.state)
    for number in (0, 2):
        assert torch.equal(together[0][number], alone["positions"][0])
        assert torch.equal(together[1][number], alone["velocities"][0])


def test_a_step_that_is_taken_back() -> None:
    """An environment whose pairs exceed the capacity passes gradients on as they are; others are untouched."""
    lower, upper = block(0.1, 2, (0.0, 0.05, 0.0)), block(0.1, 2, (0.01, 0.1515, 0.0))
    sim = simulator(pd.Scene(lower, upper, gravity(), pd.Contact(thickness=1e-3, capacity=1)), 16)
    state: Any = sim.rest_state()
    sim.stiffness.requires_grad_()
    x, v = state.positions.clone().requires_grad_(), state.velocities.clone().requires_grad_()
    with pytest.warns(pd.SceneWarning, match="capacity"):
        after = sim(pd.HistoryState(x, v, state.history))
    assert torch.equal(after.positions, x)
    weights = seeded(x, 0), seeded(x, 1)
    loss = (weights[0] * after.positions).sum() + (weights[1] * after.velocities).sum()
    by_x, by_v, by_stiffness = torch.autograd.grad(loss, (x, v, sim.stiffness))
    assert torch.equal(by_x, weights[0])
    assert torch.equal(by_v, weights[1])
    assert not by_stiffness.any()


def test_what_is_held_back() -> None:
    """A plate that cannot reach its target does not depend on it; one that can does."""
    cube = pd.Solid(pd.shapes.box((0.1,) * 3, (2,) * 3).translated((-0.05, 0.001, -0.05)), youngs=1e5, density=1000.0)
    shape = pd.shapes.box((0.2, 0.02, 0.2), (1,) * 3)
    lower, upper = (
        pd.Collider(shape.translated((-0.1, -0.02, -0.1))),
        pd.Collider(shape.translated((-0.1, 0.102, -0.1))),
    )
    sim = simulator(pd.Scene(cube, lower, upper, pd.Contact(thickness=1e-3, capacity=5000)), 64)
    for way, reaches in ((-0.3, False), (-0.001, True)):
        target = pose(0.0, way).requires_grad_()
        after, info = sim(sim.rest_state(), targets={upper: target}, return_info=True)
        assert (float(info.held_back) == 0.0) == reaches
        (found,) = torch.autograd.grad(after.positions.sum() + after.history.poses[0, 1, 1], target)
        assert bool(found.any()) == reaches


def test_what_has_no_gradient() -> None:
    """Forces of a step are reports: a loss of them is refused by the op, and its second derivatives are."""
    step = sliding_cube()
    inputs = {name: value.requires_grad_() for name, value in step.inputs().items()}
    after = step.run(inputs)
    assert not after.history.forces.requires_grad
    assert not after.history.keys.requires_grad
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(
            torch.autograd.grad(after.positions.sum(), inputs["positions"], create_graph=True)[0].sum(),
            inputs["positions"],
        )


@pytest.mark.parametrize("name", OF_CONTACT)
def test_opcheck(name: str, dtype: torch.dtype) -> None:
    arguments, keywords = samples(name, dtype, torch.device("cpu"))
    report = torch.library.opcheck(getattr(torch.ops.torchpd, name).default, arguments, keywords)
    assert set(report.values()) == {"SUCCESS"}


def test_compiled() -> None:
    """A compiled step has the gradients of an eager one, to the bit."""
    step = sliding_cube()
    sim, state = step.sim, step.state

    def of(positions: Tensor) -> Tensor:
        after = sim(pd.HistoryState(positions, *state[1:]))
        return (seeded_like * after.positions).sum()

    seeded_like = seeded(state.positions, 0)
    found = []
    for function in (of, torch.compile(of, fullgraph=True, backend="aot_eager")):
        x = state.positions.clone().requires_grad_()
        found.append(torch.autograd.grad(function(x), x)[0])
    assert torch.equal(*found)
