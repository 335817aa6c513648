"""Gradients through a step against central differences, in float64."""

from __future__ import annotations

import pytest
import torch
from adjoint_cases import body
from torch.profiler import ProfilerActivity, profile

import torchpd as pd
from torchpd.common.tables import MATERIAL_TABLE

# A central difference with relative step 1e-5 errs by about 1e-10 (truncation) and 1e-16 / 1e-5 (rounding), relative to
# the largest terms; sums that cancel lose some digits more.
TOLERANCE = 1e-6


def check(loss, tensor: torch.Tensor, seed: int = 1) -> None:
    """One random direction of one input."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
    tensor.requires_grad_()
    (gradient,) = torch.autograd.grad(loss(), tensor)
    with torch.no_grad():
        size = 1e-5 * max(float(tensor.abs().max()), 1e-2)
        tensor += size * direction
        above = float(loss())
        tensor -= 2 * size * direction
        below = float(loss())
        tensor += size * direction
    tensor.requires_grad_(False)
    expected = (above - below) / (2 * size)
    scale = float((gradient * direction).abs().sum())
    assert abs(float((gradient * direction).sum()) - expected) <= TOLERANCE * scale


def weighted_loss(sim: pd.Simulator, state: pd.State, forces: torch.Tensor):
    generator = torch.Generator().manual_seed(2)
    weights = [torch.randn(state[0].shape, generator=generator, dtype=torch.float64) for _ in range(2)]

    def loss() -> torch.Tensor:
        after = sim(state, forces=forces)
        return (weights[0] * after.positions).sum() + 0.02 * (weights[1] * after.velocities).sum()

    return loss


@pytest.mark.parametrize("name", ["positions", "velocities", "forces"])
def test_inputs_of_the_step(name: str) -> None:
    sim, state = body()
    forces = torch.randn(state[0].shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    tensor = forces if name == "forces" else getattr(state, name)
    check(weighted_loss(sim, state, forces), tensor)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("name", ["stiffness", "masses", "gravity", "damping", "pin_targets"])
def test_material(name: str, batched: bool) -> None:
    sim, state = body()
    if batched:
        own = getattr(sim, name)
        sim.set_material(**{name: torch.stack([own, 1.1 * own])})
    check(weighted_loss(sim, state, torch.zeros_like(state[0])), getattr(sim, name))


def test_stiffness_of_soft_pins() -> None:
    sim, state = body()
    loss = weighted_loss(sim, state, torch.zeros_like(state[0]))
    soft = ~sim.pin_hard
    sim.pin_stiffness.requires_grad_()
    (gradient,) = torch.autograd.grad(loss(), sim.pin_stiffness)
    sim.pin_stiffness.requires_grad_(False)

    def difference(size: float) -> float:
        values = []
        for change in (size, -size):
            sim.set_material(pin_stiffness=torch.where(soft, 50.0 + change, torch.inf))
            values.append(float(loss()))
        return (values[0] - values[1]) / (2.0 * size)

    # so small an effect wants long intervals: Richardson's extrapolation removes their truncation
    expected = (4.0 * difference(1.0) - difference(2.0)) / 3.0
    assert float(gradient.sum()) == pytest.approx(expected, rel=TOLERANCE)
    assert torch.equal(gradient != 0.0, soft)


def test_resting_contact() -> None:
    # a block pressed on the ground: the vertices that touch do not move along the normal
    mesh = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
    sim = pd.Simulator(
        pd.Scene(pd.Solid(mesh, youngs=2e4), pd.Gravity(), pd.Ground()), 1 / 60, 3000, dtype=torch.float64
    )
    state = sim.rest_state()
    generator = torch.Generator().manual_seed(0)
    noise = 1e-3 * torch.randn(state[0].shape, generator=generator, dtype=torch.float64)
    noise[0, mesh.vertices[:, 1] == 0.0] = 0.0  # they start on the ground
    state = pd.State(state.positions + noise, state.velocities - 0.1)
    check(weighted_loss(sim, state, torch.zeros_like(state[0])), state.velocities)


@pytest.mark.parametrize(("center", "radius"), [((0.5, -0.04, 0.1), 0.05), ((0.5, -0.29, 0.1), 0.3)])
def test_contact_with_a_ball(center: tuple[float, float, float], radius: float) -> None:
    # the surface curves away under a vertex that slides: without that term the first of these is 20 % off
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (4, 2, 2))
    scene = pd.Scene(pd.Solid(mesh, youngs=1e5), pd.Gravity(), pd.Sphere(center, radius))
    sim = pd.Simulator(scene, 1 / 30, 4000, dtype=torch.float64)
    state = sim.rest_state()
    generator = torch.Generator().manual_seed(0)
    state = pd.State(state.positions, 0.05 * torch.randn(state[0].shape, generator=generator, dtype=torch.float64))
    state = pd.State(state.positions, state.velocities - torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64))
    check(weighted_loss(sim, state, torch.zeros_like(state[0])), state.velocities)


@pytest.mark.parametrize("gap", [1e-5, 5e-5])
def test_near_a_contact_is_not_in_it(gap: float) -> None:
    # a free body that is moved moves with it: d(sum of y') / d(translation in y) is the number of vertices
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (4, 2, 2)).translated((0.0, gap, 0.0))
    sim = pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e4), pd.Ground()), 1 / 60, 300, dtype=torch.float64)
    state = sim.rest_state()
    x = state.positions.requires_grad_()
    (gradient,) = torch.autograd.grad(sim(pd.State(x, state.velocities)).positions[..., 1].sum(), x)
    assert float(gradient[..., 1].sum()) == pytest.approx(len(mesh.vertices), rel=1e-9)


def test_friction_that_holds() -> None:
    # vertices that stick move with the start of the step along the ground
    mesh = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
    scene = pd.Scene(pd.Solid(mesh, youngs=2e4), pd.Gravity(), pd.Ground(friction=2.0))
    sim = pd.Simulator(scene, 1 / 60, 4000, dtype=torch.float64)
    state = sim.rest_state()
    x = state.positions.requires_grad_()
    moved = torch.zeros_like(x)
    moved[..., 0] = 1.0
    (gradient,) = torch.autograd.grad(sim(pd.State(x, state.velocities)).positions[..., 0].sum(), x)
    assert float((gradient * moved).sum()) == pytest.approx(len(mesh.vertices), rel=1e-6)


@pytest.mark.parametrize("moving", [False, True])
def test_rollout_op_against_single_steps(moving: bool) -> None:
    # the op's derivative goes backwards through its records; a moving ball must be where it was at each step
    ball = pd.Sphere((0.5, -0.29, 0.1), 0.3)
    sim, state = body(ball)
    here = torch.tensor([0.5, -0.29, 0.1, 0.0, 0.3 if moving else 0.0, 0.0], dtype=torch.float64)
    x = state.positions.clone().requires_grad_()
    track = sim.rollout(pd.State(x, state.velocities), 3, targets={ball: here})
    (gradient,) = torch.autograd.grad(track.positions.square().sum(), x)
    after, total = pd.State(x, state.velocities), torch.zeros((), dtype=torch.float64)
    for step in range(3):
        there = torch.cat([here[:3] + step * here[3:] / 30, here[3:]])
        after = sim(after, targets={ball: there})
        total = total + after.positions.square().sum()
    (expected,) = torch.autograd.grad(total, x)
    assert torch.allclose(gradient, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))


def test_rollouts_that_record_some_states_have_the_gradients_of_those() -> None:
    sim, state = body()
    x = state.positions.clone().requires_grad_()
    weights = torch.linspace(1.0, 2.0, 2, dtype=torch.float64)[:, None, None, None]
    found, expected = (
        torch.autograd.grad((weights * track.positions * track.velocities).sum(), x)[0]
        for track in (
            sim.rollout(pd.State(x, state.velocities), 5, 2),
            pd.Track(
                *(
                    t[1::2][:2] if isinstance(t, torch.Tensor) else t
                    for t in sim.rollout(pd.State(x, state.velocities), 5)
                )
            ),
        )
    )
    assert torch.equal(found, expected)


@pytest.mark.parametrize("steps", [2, 5])
def test_records_of_some_states_are_their_own(steps: int) -> None:
    """With gradients as without: they do not hold on to the states between, and may be changed in place."""
    sim, state = body()
    forces = torch.zeros_like(state.positions).requires_grad_()
    track = sim.rollout(state, steps, 2, forces=forces)
    for records in (track.positions, track.velocities):
        assert records.is_contiguous()
        assert records.untyped_storage().nbytes() == records.numel() * records.element_size()
    (expected,) = torch.autograd.grad(track.positions.sum(), forces, retain_graph=True)
    places = track.positions
    places -= 1.0
    (found,) = torch.autograd.grad(places.sum(), forces)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("batch", [0, 2])
def test_the_adjoint_of_a_rollout_is_that_of_its_steps(batch: int, own: bool) -> None:
    sim, state = body(pd.Sphere((0.5, -0.29, 0.1), 0.3))
    x, v = (t[:batch] for t in state)
    arrays, plan = [array.detach() for array in sim.material()], list(sim.plan.arrays)
    if own:
        arrays = [array.expand(batch, *array.shape).clone() for array in arrays]
    after, speeds, _ = torch.ops.torchpd.rollout(x, v, None, arrays, plan, steps=2, every=1, **sim.step_settings(
        inertial=False, report=False
    ))  # fmt: skip
    h = {"time_step": sim.time_step}
    found = torch.ops.torchpd.rollout_vjp(after, speeds, after, speeds, x, v, None, arrays, plan, **h)
    last = torch.ops.torchpd.step_vjp(after[1], speeds[1], after[1], after[0], speeds[0], None, arrays, plan, **h)
    into = (last[0] + after[0], last[1] + speeds[0])
    first = torch.ops.torchpd.step_vjp(*into, after[0], x, v, None, arrays, plan, **h)
    # by the velocity of the ball it is one step further in the second
    spheres = 3 + [row.name for row in MATERIAL_TABLE].index("spheres")
    last[spheres][..., 5:] += last[spheres][..., :3]
    expected = [first[0], first[1], *(a + b for a, b in zip(last[2:], first[2:], strict=True))]
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        assert torch.allclose(one, other, rtol=1e-12, atol=0.0)


def test_the_adjoint_of_a_rollout_checks_what_it_gets() -> None:
    sim, state = body()
    track = sim.rollout(state, 2)
    x, v, arrays, plan = track.positions, track.velocities, sim.material(), list(sim.plan.arrays)
    for wrong, name in ((x[0], "after"), (x[:, :1], "after"), (x.float(), "after")):
        with pytest.raises((ValueError, TypeError), match=f"^{name} must be"):
            torch.ops.torchpd.rollout_vjp(x, v, wrong, v, *state, None, arrays, plan, time_step=sim.time_step)
    for given, name in (((x[:1], v), "grad_positions"), ((x, v.float()), "grad_velocities")):
        with pytest.raises((ValueError, TypeError), match=f"^{name} must be"):
            torch.ops.torchpd.rollout_vjp(*given, x, v, *state, None, arrays, plan, time_step=sim.time_step)
    # of no steps, too
    none = x[:0]
    for (first, speed, forces, h), name in (
        ((state[0], state[1][:1], None, 0.1), "velocities"),
        ((state[0], state[1], x[0, :1], 0.1), "forces"),
        ((state[0], state[1], None, -1.0), "time_step"),
    ):
        with pytest.raises(ValueError, match=f"^{name} must be"):
            torch.ops.torchpd.rollout_vjp(none, none, none, none, first, speed, forces, arrays, plan, time_step=h)
    with pytest.raises(ValueError, match=r"rollout_vjp: wanted .*got 1 numbers"):
        torch.ops.torchpd.rollout_vjp(x, v, x, v, *state, None, arrays, plan, time_step=sim.time_step, wanted=[True])
    with pytest.raises(ValueError, match=r"material must be .*got 2"):
        torch.ops.torchpd.rollout_vjp(x, v, x, v, *state, None, arrays[:2], plan, time_step=sim.time_step)


def test_the_adjoint_of_no_steps_is_that_of_nothing() -> None:
    sim, state = body()
    none = sim.rollout(state, 0).positions
    arrays = [array.detach() for array in sim.material()]
    found = torch.ops.torchpd.rollout_vjp(
        none, none, none, none, *state, None, arrays, list(sim.plan.arrays), time_step=sim.time_step
    )
    assert [t.shape for t in found] == [state.positions.shape] * 3 + [array.shape for array in arrays]
    assert not any(t.any() for t in found)


@pytest.mark.parametrize("contacts", [False, True])
@pytest.mark.parametrize("value", [-1e5, float("inf")])
def test_elasticity_without_bounds_leaves_its_vertices_out(value: float, contacts: bool) -> None:
    """Whose 1 / D is zero: of a tetrahedron of negative or infinite stiffness."""
    sim, state = body(*([pd.Ground(-1.0)] if contacts else []), iterations=10)
    stiffness = sim.stiffness.detach().clone()
    stiffness[0] = value
    material = [stiffness, *(array.detach() for array in sim.material()[1:])]
    after = sim(state).positions
    given = (torch.ones_like(after), 0.0 * after, after, *state, None, material, list(sim.plan.arrays))
    right, inertia, inverse, *_ = torch.ops.torchpd.adjoint_system(*given, time_step=sim.time_step)
    left_out = (inverse == 0.0).expand(right.shape[:2])
    assert int((left_out & (inertia != 0.0)).sum()) > 0
    assert not right[left_out].any()
    assert bool(right[~left_out].any())


def test_a_failed_solve_is_not_done_twice() -> None:
    """One that fails, and one that stands in."""
    sim, state = body(iterations=1)
    x = (
        0.02 * torch.randn(state[0].shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    ).requires_grad_()
    loss = sim(pd.State(x, state.velocities)).positions.sum()
    with pytest.warns(UserWarning, match="adjoint of a step has no solution"):
        _, calls = gradients_and_calls(loss, [x])
    assert calls.count("torchpd::adjoint_fallback") == 1
    assert calls.count("torchpd::conjugate_gradients") == 1


@pytest.mark.parametrize("error", [0.0, float("nan")])
def test_nothing_is_mended_where_nothing_failed(error: float) -> None:
    """What is no number has lost its solution, and has not failed."""
    sim, state = body()
    plan, material = list(sim.plan.arrays), [array.detach() for array in sim.material()]
    x, right = state.positions, torch.ones_like(state.positions)
    errors, inverse = torch.full((2,), error, dtype=torch.float64), torch.ones(sim.vertices, dtype=torch.float64)
    given = (None, x, right, inverse, None, material, plan)
    found = torch.ops.torchpd.adjoint_fallback(2.0 * right, errors, *given, time_step=sim.time_step)
    assert torch.equal(found, 2.0 * right)


@pytest.mark.parametrize("forces", [False, True])
def test_a_first_iterate_stands_between_state_and_material(forces: bool) -> None:
    """In the order of what autograd may ask for: gradients of the solution do not depend on it."""
    sim, state = body()
    push = torch.ones_like(state.positions).requires_grad_() if forces else None
    names = ["stiffness", "masses", "gravity", "damping", "pin_stiffness", "pin_targets"]
    inputs = [state.positions.requires_grad_(), *(getattr(sim, name).requires_grad_() for name in names)]
    inputs += [push] if push is not None else []
    start = (state.positions + 0.01).detach()
    one, other = (
        torch.autograd.grad(sim(state, push, **options).positions.square().sum(), inputs)
        for options in ({}, {"start": start})
    )
    for plain, given in zip(one, other, strict=True):
        assert torch.allclose(plain, given, rtol=1e-6, atol=1e-9 * float(plain.abs().max()))


def test_step_gradient_vanishes_at_the_solution() -> None:
    sim, state = body()
    forces = torch.randn(state[0].shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    solved = sim.step_gradient(state, sim(state, forces), forces).norm()
    course = sim.step_gradient(state, state.positions + sim.time_step * state.velocities, forces).norm()
    assert float(solved) <= 1e-12 * float(course)  # 600 iterations leave rounding only


def test_rollout_is_differentiable() -> None:
    sim, state = body()
    sim.stiffness.requires_grad_()
    track = sim.rollout(state, 3)
    (gradient,) = torch.autograd.grad(track.positions[-1].square().sum(), sim.stiffness)
    after = state
    for _ in range(3):
        after = sim(after)
    (expected,) = torch.autograd.grad(after.positions.square().sum(), sim.stiffness)
    assert torch.equal(gradient, expected)
    assert float(gradient.abs().max()) > 0.0


def gradients_and_calls(loss: torch.Tensor, inputs: list[torch.Tensor]) -> tuple[tuple[torch.Tensor, ...], list[str]]:
    """Gradients, and the ops and operations that they took, by the profiler."""
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        found = torch.autograd.grad(loss, inputs)
    return found, [event.name for event in seen.events() if event.name.startswith(("torchpd::", "aten::"))]


@pytest.mark.parametrize("steps", [1, 3])
def test_what_nobody_wants_costs_nothing(steps: int) -> None:
    """A gradient alone is that among all, bit by bit, and what the others need is not worked out."""
    sim, state = body()
    names = ["stiffness", "masses", "gravity", "damping", "pin_stiffness", "pin_targets"]
    arrays = [getattr(sim, name).requires_grad_() for name in names]
    start = pd.State(*(t.clone().requires_grad_() for t in state))

    def gradients(*wanted: torch.Tensor) -> tuple[tuple[torch.Tensor, ...], list[str]]:
        return gradients_and_calls(sim.rollout(start, steps).positions.square().sum(), list(wanted))

    everything, most = gradients(*start, *arrays)
    for array in arrays:
        array.requires_grad_(False)
    for name, array, wanted in zip(names, arrays, everything[2:], strict=True):
        (alone,), calls = gradients(array.requires_grad_())
        array.requires_grad_(False)
        assert torch.equal(alone, wanted)
        assert ("torchpd::element_energy_product" in calls) == (name == "stiffness")
        assert ("torchpd::hessian_product" in calls) == (name == "pin_targets")
        assert len(calls) < 0.85 * len(most)
    found, calls = gradients(*start)
    assert all(torch.equal(one, other) for one, other in zip(found, everything, strict=False))
    assert len(calls) < 0.65 * len(most)


def test_what_held_vertices_pass_on_is_worked_out_once() -> None:
    """Both the start of those that friction holds and the targets of pins want it."""
    sim, state = body(pd.Ground(-1.0, friction=0.5))
    start, targets = state.positions.requires_grad_(), sim.pin_targets.requires_grad_()
    loss = sim(pd.State(start, state.velocities)).positions.square().sum()
    _, calls = gradients_and_calls(loss, [start, targets])
    assert calls.count("torchpd::hessian_product") == 1


@pytest.mark.parametrize("wanted", [None, [True] * 3])
def test_the_op_gives_all_gradients_or_wants_to_know_of_each(wanted: list[bool] | None) -> None:
    sim, state = body()
    after = sim(state).positions
    arrays = [array.detach() for array in sim.material()]
    arguments = (after, 0.0 * after, after, *state, None, arrays, list(sim.plan.arrays))
    if wanted is None:
        given = torch.ops.torchpd.step_vjp(*arguments, time_step=sim.time_step)
        assert [t.shape for t in given[3:]] == [array.shape for array in arrays]
        return
    with pytest.raises(ValueError, match=f"of each of the {len(arrays)} arrays of the material .* got 3 numbers"):
        torch.ops.torchpd.step_vjp(*arguments, time_step=sim.time_step, wanted=wanted)


def test_the_op_takes_material_of_any_strides() -> None:
    sim, state = body()
    after = sim(state).positions
    arrays = [array.detach() for array in sim.material()]
    strided = [torch.stack((array, array), dim=-1)[..., 0] for array in arrays]
    given = [
        torch.ops.torchpd.step_vjp(
            after, after, after, *state, None, material, list(sim.plan.arrays), time_step=sim.time_step
        )
        for material in (arrays, strided)
    ]
    assert all(torch.equal(one, other) for one, other in zip(*given, strict=True))


def test_unsolved_step_warns() -> None:
    # one iteration leaves the body crumpled far from equilibrium, where the Hessian is not positive
    sim, state = body(iterations=1)
    crumpled = (
        0.02 * torch.randn(state[0].shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    ).requires_grad_()
    with pytest.warns(UserWarning, match=r"adjoint .*2 of 2 environments"):
        sim(pd.State(crumpled, state.velocities)).positions.sum().backward()
    # still a gradient of sensible size: the majoriser's largest inverse eigenvalue times inertia is at most one
    assert 0.0 < float(crumpled.grad.norm()) <= 1.1 * crumpled.numel() ** 0.5


def test_what_is_lost_does_not_hide_what_has_failed() -> None:
    """One environment of a loss that is no number, one that is far from an equilibrium: each as if it were alone."""
    sim, state = body(iterations=1)
    crumpled = 0.02 * torch.randn(state[0].shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def gradient(weight: list[float]) -> torch.Tensor:
        x = crumpled.clone().requires_grad_()
        loss = torch.tensor(weight, dtype=x.dtype)[:, None, None] * sim(pd.State(x, state.velocities)).positions
        with pytest.warns(UserWarning, match=r"in \d of 2 environments \(relative residual \d\.\de[+-]\d\d\)"):
            (found,) = torch.autograd.grad(loss.sum(), x)
        return found

    both, mixed = gradient([1.0, 1.0]), gradient([torch.nan, 1.0])
    assert mixed[0].isnan().any()
    assert torch.equal(mixed[1], both[1])


@pytest.mark.parametrize("contacts", [False, True])
def test_a_loss_that_is_no_number_has_no_gradient(contacts: bool, recwarn: pytest.WarningsRecorder) -> None:
    """Whoever watches for NaN sees it, in the environment that has it and in what all share."""
    sim, state = body(*([pd.Ground(-1.0, friction=0.5)] if contacts else []))
    x = state.positions.clone().requires_grad_()
    after = sim(pd.State(x, state.velocities)).positions
    weight = torch.ones_like(x)
    weight[0, x.shape[1] // 2, 1] = torch.nan  # not of a vertex that a pin holds
    stiffness, targets = sim.stiffness.requires_grad_(), sim.pin_targets.requires_grad_()
    (weight * sim(pd.State(x, state.velocities)).positions).sum().backward()
    assert after.isfinite().all()
    assert x.grad is not None
    assert x.grad[0].isnan().any()
    assert x.grad[1:].isfinite().all()
    assert stiffness.grad is not None
    assert stiffness.grad.isnan().all()
    assert targets.grad is not None
    assert targets.grad.isnan().all()
    assert not recwarn.list  # more iterations would not help


def test_contacts_that_are_not_there_may_want_gradients() -> None:
    sim, state = body()
    sim.requires_grad_(True)
    sim(state).positions.sum().backward()
    assert sim.stiffness.grad is not None
    sim.rollout(state, 2).positions.sum().backward()


def test_contacts_on_both_sides_leave_their_common_direction() -> None:
    """In a valley of two slopes a vertex moves along it alone, whatever their angle."""
    tip = pd.TetMesh([[0.0, 0.0, 0.0], [0.1, 0.2, -0.05], [-0.1, 0.2, -0.06], [0.01, 0.2, 0.1]], [[0, 1, 2, 3]])
    body = pd.Solid(tip, 1e5)
    slopes = [pd.Ground(0.0, (side, 1.0, 0.0)) for side in (0.5, -0.5)]
    scene = pd.Scene(body, pd.Pin(body, [1, 2, 3], stiffness=300.0), pd.Gravity(), pd.Damping(20.0), *slopes)
    sim = pd.Simulator(scene, 1 / 60, 5000, dtype=torch.float64)
    state = sim.rest_state()
    for _ in range(20):
        state = sim(state)
    forces = torch.zeros_like(state.positions).requires_grad_()
    weights = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((sim(state, forces).positions[0, 0] * weights).sum(), forces)
    assert gradient[0, 0, :2].abs().max() < 1e-12 * gradient[0, 0, 2].abs()
    size = 1e-4
    pull = torch.zeros_like(state.positions)
    pull[0, 0, 2] = size
    above, below = (sim(state, sign * pull).positions[0, 0, 2] for sign in (1.0, -1.0))
    assert float(gradient[0, 0, 2]) == pytest.approx(3.0 * float(above - below) / (2 * size), rel=5e-3)
