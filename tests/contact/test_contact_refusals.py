"""What scenes with `Contact` refuse, by name and with the fix; starts that cross or touch; what they report."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from body_scenes import THICKNESS, H, block, gripper, plane, pose, simulator, two_cubes
from torch import Tensor

import torchpd as pd

COURSE = gripper(0.5)
SIM = simulator(COURSE.scene, 8)
STATE: Any = SIM.rest_state()
LEFT = COURSE.scene.colliders[0]
SIMULATORS: dict[str, Callable[[], object]] = {
    "solver must be Chebyshev or Jacobi in a scene with Contact, .*remove Contact": lambda: pd.Simulator(
        COURSE.scene, solver="multilevel"
    ),
    "solver must be Chebyshev or Jacobi .* got Multilevel": lambda: setattr(SIM, "solver", pd.Multilevel()),
    "adjoint must be \"solver\" in a scene with Contact.* got 'multilevel'": lambda: setattr(
        SIM, "adjoint", "multilevel"
    ),
    "device must be a CPU or a GPU in a scene with Contact, got meta; .*leave device out": lambda: pd.Simulator(
        COURSE.scene, device="meta"
    ),
    "device must be a CPU or a GPU in a scene with Contact, got meta": lambda: SIM.to("meta"),
}


def wanted(tensor: Tensor) -> Tensor:
    return tensor.clone().requires_grad_()


def with_history(**changes: Tensor) -> Any:
    return pd.HistoryState(*STATE[:2], STATE.history._replace(**changes))


def mapped(state: Any) -> Any:
    return pd.HistoryState(*(part[None] for part in state[:2]), pd.ContactHistory(*(part[None] for part in state[2])))


STEPS: dict[str, Callable[[], object]] = {
    'start must be "velocity" or "inertial" in a scene with Contact, got positions': lambda: SIM(
        STATE, start=STATE.positions
    ),
    r"contact_friction must be \[\], \[3, 3\], .* of the 3 bodies and colliders, got \[2\]": lambda: setattr(
        SIM, "contact_friction", torch.ones(2)
    ),
    "contact_friction must be finite and >= 0, got -1": lambda: setattr(SIM, "contact_friction", -1.0),
    r"contact_friction must be the same for \(a, b\) and \(b, a\)": lambda: setattr(
        SIM, "contact_friction", torch.arange(9.0).reshape(3, 3)
    ),
    r"contact_thickness must be one number for all surfaces, got a tensor \[2\]": lambda: setattr(
        SIM, "contact_thickness", torch.ones(2)
    ),
    "contact_thickness must be positive .*got -1": lambda: setattr(SIM, "contact_thickness", -1.0),
    "Contact must not be transformed by torch.func or vmap, got mapped .*rest_state": lambda: torch.func.vmap(SIM)(
        mapped(STATE)
    ),
    "must not be transformed by torch.func or vmap": lambda: torch.func.vmap(
        lambda target: SIM(STATE, targets={LEFT: target}).positions
    )(pose()[None]),
    "capture: the simulator must be on a GPU for a CUDA graph, got cpu": lambda: SIM.capture(STATE),
    "state must be a HistoryState, in a scene with Contact, .* got State": lambda: SIM(pd.State(*STATE[:2])),
    "targets of a Collider must be finite poses .* quaternion is not zero": lambda: SIM(
        STATE, targets={LEFT: torch.zeros(7, dtype=torch.float64)}
    ),
    r"targets of a Collider must be finite poses .*got \[nan[^\]]*\]; \(1, 0": lambda: SIM(
        STATE, targets={LEFT: pose(math.nan)}
    ),
    r"finite poses .*got \[nan.*\] in environment 1; \(1, 0": lambda: SIM(
        SIM.rest_state(2), targets={LEFT: torch.stack([pose(), pose(math.nan)])}
    ),
    r"targets of a Collider must be \[7\], .*got \[3\]": lambda: SIM(STATE, targets={LEFT: pose()[:3]}),
    "targets of a Collider must be torch.float64": lambda: SIM(STATE, targets={LEFT: pose().float()}),
    "this Collider is not a .*Collider of the scene.*sim.scene.colliders": lambda: SIM(
        STATE, targets={pd.Collider(plane(1.0, 1.0, 1)): pose()}
    ),
    r"step_: info must be float64 \[1, 13\] in a scene with Contact, got torch.float64 \[1, 7\]": lambda: SIM.step_(
        STATE.clone(), info=torch.zeros(1, 7, dtype=torch.float64)
    ),
    r"history.keys must be torch.int64 on cpu": lambda: SIM(with_history(keys=STATE.history.keys.float())),
    r"history.poses must be \[1, 2, 7\], as rest_state\(\) has it, got \[1, 1, 7\]": lambda: SIM(
        with_history(poses=STATE.history.poses[:, :1])
    ),
    "targets of a Collider must be a tensor of torch.float64 on cpu, got list; torch.as_tensor": lambda: SIM(
        STATE, targets={LEFT: pose().tolist()}
    ),
    "targets of a Collider must be a tensor of .*got ndarray": lambda: SIM.rollout(
        STATE, 2, targets=lambda step: {LEFT: pose().numpy()}
    ),
    r"targets must be \[0, 3\], .*got \[7\]; .*all pins, and a pose goes as \{collider: pose\}": lambda: SIM(
        STATE, targets=pose()
    ),
}


@pytest.mark.parametrize("message", [*SIMULATORS, *STEPS])
def test_refusals(message: str) -> None:
    with pytest.raises((TypeError, ValueError, RuntimeError), match=message):
        (SIMULATORS | STEPS)[message]()
    SIM(STATE)  # as it was


def test_trained_material() -> None:
    """step_ takes a step without gradients, with the places of one that has them."""
    sim = simulator(COURSE.scene, 4)
    sim.stiffness.requires_grad_()
    after: Any = sim(STATE)
    assert after.positions.requires_grad
    assert not after.history.forces.requires_grad
    kept = STATE.clone()
    sim.step_(kept)
    assert torch.equal(kept.positions, after.positions)


def test_the_op_refuses_maps_and_gradients() -> None:
    """In a compiled step too, where Python sees no values."""

    def run(x: Tensor) -> Tensor:
        return SIM(pd.HistoryState(x, *STATE[1:])).positions

    with pytest.raises(Exception, match="Contact"):
        torch.compile(torch.func.vmap(run), backend="aot_eager", fullgraph=True)(STATE.positions[None])


def test_auto_takes_chebyshev() -> None:
    mesh = pd.shapes.box((0.1,) * 3, (4,) * 3)
    stiff = pd.Solid(mesh, youngs=1e9, density=1e3)
    alone, met = (pd.Scene(stiff, *parts) for parts in ((), (pd.Contact(),)))
    assert isinstance(pd.Simulator(alone, solver="auto", iterations=16, progress=False).solver, pd.Multilevel)
    sim = pd.Simulator(met, solver="auto", iterations=16, progress=False)
    assert isinstance(sim.solver, pd.Chebyshev)
    assert "Multilevel does not run on a scene with Contact" in str(sim)


# ---- starts


def two(shift: tuple[float, float, float], *parts: pd.scene.Part) -> pd.Scene:
    return pd.Scene(block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, shift), *parts, pd.Contact(thickness=THICKNESS))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rest_positions_that_cross_or_touch(dtype: torch.dtype) -> None:
    message = (
        r"Simulator: rest positions must be free of crossings, got \d+: the edge of vertices \[\d+, \d+\] of body [01] "
        r"passes through the triangle of vertices \[\d+, \d+, \d+\] of body [01]; move the bodies apart"
    )
    with pytest.raises(ValueError, match=message):
        pd.Simulator(two((0.03, 0.06, 0.02)), dtype=dtype)
    with pytest.raises(ValueError, match=r"rest positions must leave .* got 0.0e\+00 m between .* leave the thickness"):
        pd.Simulator(two((0.0, 0.1, 0.0)), dtype=dtype)
    pd.Simulator(two((0.0, 0.1 + 1e-5, 0.0)), dtype=dtype)


def test_tied_sides_may_touch() -> None:
    """Those that a Tie joins are no pairs, so boxes that it glues start face on face."""
    lower, upper = block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (0.0, 0.1, 0.0))
    bottom = np.flatnonzero(upper.mesh.vertices[:, 1] < 0.0501)
    scene = pd.Scene(lower, upper, pd.Tie(upper, bottom, lower, stiffness=1e4), pd.Contact(thickness=THICKNESS))
    sim = simulator(scene, 16)
    after = sim.rollout(sim.rest_state(), 4).state()
    assert torch.allclose(after.positions, sim.rest_positions[None], atol=1e-9)


def test_check_of_a_state() -> None:
    """Names the environment; what steps return passes."""
    course = two_cubes()
    sim = simulator(course.scene, 16)
    state: Any = sim.rest_state(3)
    sim.check(state)
    sim.check(course.last(sim, 8)[0])
    crossing = state.clone()
    crossing.positions[2, 64:, 1] -= 0.05
    with pytest.raises(ValueError, match=r"check: positions of environment 2 must be free of crossings"):
        sim.check(crossing)
    with pytest.raises(ValueError, match=r"history.poses must have unit quaternions .*got lengths of 2"):
        SIM.check(with_history(poses=2.0 * STATE.history.poses))
    with pytest.raises(TypeError, match="HistoryState"):
        sim.check(pd.State(*state[:2]))
    plain = pd.Simulator(pd.Scene(block(0.1, 1, (0.0, 0.0, 0.0))), progress=False)
    plain.check(plain.rest_state())


def test_poses_take_part_in_the_check() -> None:
    """A collider that a state has inside of the cube."""
    poses = STATE.history.poses.clone()
    poses[0, 0, 0] = 0.04
    with pytest.raises(ValueError, match="environment 0 must be free of crossings"):
        SIM.check(with_history(poses=poses))


def test_rounding_of_far_places() -> None:
    """Refused in float32 at construction, and by `to`, which then changes nothing."""
    far = two((30.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"Contact.thickness must be at least .* in torch.float32"):
        pd.Simulator(far)
    sim = simulator(far)
    with pytest.raises(ValueError, match=r"Contact\.thickness must be at least"):
        sim.to(torch.float32)
    assert sim.dtype == torch.float64
    sim(sim.rest_state())


def test_a_body_that_touches_a_collider() -> None:
    """A Tie joins bodies alone, so the fix names none."""
    cube, table = pd.Solid(pd.shapes.box((0.1,) * 3, (1,) * 3), 1e5, 1e3), pd.Collider(plane(1.0, 1.0, 1))
    with pytest.raises(ValueError, match=r"leave the thickness, 0\.001 m; a Pin .* follow it$"):
        simulator(pd.Scene(cube, table, pd.Contact(thickness=THICKNESS)))


def test_check_of_values() -> None:
    state = STATE.clone()
    state.velocities[0, 3, 1] = math.nan
    with pytest.raises(ValueError, match="check: velocities must be finite, got others in environment 0"):
        SIM.check(state)


# ---- reports


def test_info_without_contact() -> None:
    sim = pd.Simulator(pd.Scene(block(0.1, 1, (0.0, 0.0, 0.0))), H, 4, progress=False)
    _, info = sim(sim.rest_state(2), return_info=True)
    assert info.contact_gap.tolist() == [math.inf] * 2
    assert info.contact_overflow.tolist() == info.held_back.tolist() == [0, 0]
    assert pd.Info(*info[:7]).contact_gap == math.inf


def test_the_residual_falls_to_zero() -> None:
    """Of two cubes that meet: forces between bodies are balanced; without them most of it would stay."""
    low, high = block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (0.02, 0.1015, 0.01))
    sim = pd.Simulator(pd.Scene(low, high, pd.Contact(thickness=1e-3)), H, 2000, dtype=torch.float64, progress=False)
    state = sim.rest_state()
    state.velocities[0, sim.scene.vertex_range(high), 1] = -0.5
    after, info = sim(state, return_info=True)
    assert float(info.residual) < 1e-6
    assert float(after.history.forces[..., 0].sum()) > 0.0
    sim.iterations = 4
    assert float(sim(state, return_info=True)[1].residual) > 1e-3


def test_print_tells_thickness_and_capacity() -> None:
    text = str(SIM)
    plan: Any = SIM.body_contact.plan  # type: ignore[union-attr]
    assert f"contact: 1 bodies, 2 colliders ({len(plan.triangles)} triangles, {len(plan.edges)} edges)" in text
    assert f"thickness 0.001 m, up to {plan.capacity} pairs in each environment" in text
    small, large = (
        simulator(pd.Scene(block(0.1, 1, (0.0, 0.0, 0.0)), pd.Contact(capacity=count))) for count in (10, 1010)
    )
    taken = [int(re.findall(r"([\d,]+) B per environment", str(sim))[0].replace(",", "")) for sim in (small, large)]
    assert taken[1] - taken[0] == 1000 * (8 + 32 + 2 * (32 + 24 * 8) + 16 + 8 + 32)


def test_overlaps_name_contact() -> None:
    """The warning about bodies that pass through each other says what keeps them apart."""
    bodies = block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (0.03, 0.06, 0.02))
    with pytest.warns(pd.SceneWarning, match=r"overlap at rest.*add Contact\(\)"):
        pd.Simulator(pd.Scene(*bodies), progress=False)
    with pytest.warns(pd.SceneWarning, match="bodies 0 and 1 .* overlap at rest"):  # the second takes no part
        pd.Simulator(pd.Scene(*bodies, pd.Contact(bodies[0])), progress=False)
