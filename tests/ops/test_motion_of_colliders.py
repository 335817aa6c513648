"""The ops of colliders with a mass: the midpoint rule, derivatives, bits of batches, and what has none."""

from __future__ import annotations

import pytest
import torch
from op_samples import rigid_bodies
from torch import Tensor

ops = torch.ops.torchpd
H = 1 / 60
SPIN = 10.0  # rad/s
DOUBLE = torch.empty(0, dtype=torch.float64)


def rotation(quaternion: Tensor) -> Tensor:
    """Matrices [..., 3, 3] of unit quaternions."""
    w, axis = quaternion[..., 0, None, None], quaternion[..., 1:]
    cross = torch.linalg.cross(axis.unsqueeze(-2), torch.eye(3, dtype=axis.dtype).expand(*axis.shape, 3)).mT
    return torch.eye(3, dtype=axis.dtype) + 2.0 * (w * cross + cross @ cross)


def symmetric(six: Tensor) -> Tensor:
    """Matrices [..., 3, 3] of xx xy xz yy yz zz."""
    return six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))


@pytest.mark.parametrize("moments", [(1.0, 1.0, 1.0), (1.0, 0.8, 0.3), (1.0, 1.0, 0.1), (1.0, 1.0, 0.01)])
@pytest.mark.parametrize("spin", [0.1, 20.0, 200.0])
def test_free_rotation_is_the_midpoint_rule(moments: tuple[float, ...], spin: float) -> None:
    """R_m J R_m^T u = h L with the rotation R_m half way along cay(u), to rounding, also of needles and large turns.

    The error is that of L over its condition: moments of 100 : 1 have ten digits at the fastest turn.
    """
    poses, rates, *_ = rigid_bodies(200, DOUBLE)
    motion = torch.cat([rates[..., :3], spin / SPIN * rates[..., 3:]], dim=-1)
    bodies = torch.zeros(2, 10, dtype=torch.float64)
    bodies[:, 0] = 1.0
    bodies[:, [4, 7, 9]] = torch.tensor(moments, dtype=torch.float64)
    goal, left, rows = ops.free_motion(poses, motion, None, torch.zeros(3).double(), bodies, time_step=H)
    start, end = rotation(poses[..., 3:]), rotation(goal[..., 3:])
    inertia, momentum = torch.diag(torch.tensor(moments, dtype=torch.float64)), left[..., 3:]
    torch.testing.assert_close(
        momentum,
        (start @ inertia @ start.mT @ motion[..., 3:, None])[..., 0],
        rtol=0,
        atol=1e-12 * spin,
    )
    signs = torch.where((poses[..., 3:] * goal[..., 3:]).sum(-1, keepdim=True) < 0.0, -1.0, 1.0)
    halfway = torch.nn.functional.normalize(poses[..., 3:] + signs * goal[..., 3:], dim=-1)
    middle = rotation(halfway)
    world = middle @ inertia @ middle.mT
    torch.testing.assert_close(symmetric(rows[..., 4:10]) * H**2, world, rtol=0, atol=1e-11)
    turn = H * torch.linalg.solve(world, momentum)
    cross = 0.5 * torch.linalg.cross(turn.unsqueeze(-2), torch.eye(3).double().expand(*turn.shape, 3)).mT
    cayley = torch.linalg.solve(torch.eye(3).double() - cross, torch.eye(3).double() + cross)
    torch.testing.assert_close(cayley @ start, end, rtol=0, atol=1e-9)


def test_derivatives_are_those_of_differences() -> None:
    given = [array.requires_grad_() for array in rigid_bodies(2, DOUBLE)]
    assert torch.autograd.gradcheck(lambda *arrays: ops.free_motion(*arrays, time_step=H), given)
    goal, rates, rows = (array.detach() for array in ops.free_motion(*given, time_step=H))
    poses = goal + 0.02 * torch.linspace(-1.0, 1.0, goal.numel(), dtype=torch.float64).reshape(goal.shape)
    after = [array.detach().clone().requires_grad_() for array in (given[0], goal, rates, rows, poses, given[-1])]
    assert torch.autograd.gradcheck(lambda *arrays: ops.motion_after(*arrays, time_step=H), after)


def test_derivatives_where_nothing_is_in_the_way() -> None:
    """Both ops together, with the poses of the free motion: the results are exact, and so are their derivatives."""
    poses, motion, wrenches, gravity, bodies = rigid_bodies(2, DOUBLE)

    def step(motion: Tensor, wrenches: Tensor) -> Tensor:
        goal, rates, rows = ops.free_motion(poses, motion, wrenches, gravity, bodies, time_step=H)
        moved: Tensor = ops.motion_after(poses, goal, rates, rows, 1.0 * goal, bodies, time_step=H)
        return moved

    assert torch.autograd.gradcheck(step, (motion.requires_grad_(), wrenches.requires_grad_()))


def test_derivatives_without_a_turn() -> None:
    """Where the pose keeps its bits: d(quaternion) = h w q / 2 for an angular velocity w, and L = J w."""
    poses, _, _, _, bodies = rigid_bodies(1, DOUBLE)
    none = torch.zeros(3, dtype=torch.float64)

    def step(motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found: tuple[Tensor, Tensor, Tensor] = ops.free_motion(poses, motion, None, none, bodies, time_step=H)
        return found

    goal, *_ = step(torch.zeros(1, 2, 6, dtype=torch.float64))
    assert torch.equal(goal, poses)
    slope = torch.autograd.functional.jacobian(lambda motion: step(motion)[0], torch.zeros(1, 2, 6).double())
    w, axis = poses[0, 1, 3], poses[0, 1, 4:]
    unit = torch.eye(3, dtype=torch.float64)
    wanted = 0.5 * H * torch.cat([-axis[:, None], w * unit + torch.linalg.cross(unit, axis.expand(3, 3))], dim=1).T
    torch.testing.assert_close(slope[0, 1, 3:, 0, 1, 3:], wanted, rtol=0, atol=1e-15)


def test_environments_have_the_bits_that_they_have_alone(dtype: torch.dtype) -> None:
    given = rigid_bodies(70, torch.empty(0, dtype=dtype))
    together = ops.free_motion(*given, time_step=H)
    for number in (0, 1, 69):
        one = slice(number, number + 1)
        alone = ops.free_motion(*(array[one] for array in given[:3]), *given[3:], time_step=H)
        assert all(torch.equal(mine, its[one]) for mine, its in zip(alone, together, strict=True))
    rows = ops.motion_after(given[0], *together, given[0], given[-1], time_step=H)
    alone = ops.motion_after(given[0][:1], *(array[:1] for array in together), given[0][:1], given[-1], time_step=H)
    assert torch.equal(alone, rows[:1])


def test_colliders_without_a_mass_stay_and_leave_zeros(dtype: torch.dtype) -> None:
    poses, motion, wrenches, gravity, bodies = rigid_bodies(3, torch.empty(0, dtype=dtype))
    bodies[1] = 0.0
    goal, rates, rows = ops.free_motion(poses, motion, wrenches, gravity, bodies, time_step=H)
    assert torch.equal(goal[:, 1], poses[:, 1])
    assert not rates[:, 1].any()
    assert not rows[:, 1].any()
    after = ops.motion_after(poses, goal, rates, rows, goal, bodies, time_step=H)
    assert not after[:, 1].any()
    assert after[:, 0].all()


def test_a_missing_wrench_is_one_of_zeros(dtype: torch.dtype) -> None:
    poses, motion, wrenches, gravity, bodies = rigid_bodies(3, torch.empty(0, dtype=dtype))
    found = ops.free_motion(poses, motion, None, gravity, bodies, time_step=H)
    wanted = ops.free_motion(poses, motion, 0.0 * wrenches, gravity, bodies, time_step=H)
    assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))
    motion.requires_grad_()
    ops.free_motion(poses, motion, None, gravity, bodies, time_step=H)[0].sum().backward()
    assert motion.grad is not None


def test_vmap(dtype: torch.dtype) -> None:
    """Over any of the arrays, with the bits of a loop."""
    given = rigid_bodies(3, torch.empty(0, dtype=dtype))
    poses, motion, wrenches, gravity, bodies = given
    maps = torch.linspace(0.5, 2.0, 4, dtype=dtype)

    def of_motion(scale: Tensor) -> Tensor:
        goal, rates, rows = ops.free_motion(poses, scale * motion, wrenches, gravity, bodies, time_step=H)
        after: Tensor = ops.motion_after(poses, goal, rates, rows, poses, bodies, time_step=H)
        return after

    def of_gravity(scale: Tensor) -> Tensor:
        goal: Tensor = ops.free_motion(poses, motion, None, scale * gravity, scale * bodies, time_step=H)[0]
        return goal

    assert torch.equal(torch.vmap(of_motion)(maps), torch.stack([of_motion(scale) for scale in maps]))
    assert torch.equal(torch.vmap(of_gravity)(maps), torch.stack([of_gravity(scale) for scale in maps]))


def test_batched_gradients(dtype: torch.dtype) -> None:
    """torch's older vmap maps the adjoint, too."""
    given = [array.requires_grad_() for array in rigid_bodies(3, torch.empty(0, dtype=dtype))]
    goal = ops.free_motion(*given, time_step=H)[0]
    many = torch.linspace(-1.0, 1.0, 2 * goal.numel(), dtype=dtype).reshape(2, *goal.shape)
    together = torch.autograd.grad(goal, given, many, retain_graph=True, is_grads_batched=True)
    for number, one in enumerate(many):
        alone = torch.autograd.grad(goal, given, one, retain_graph=True)
        assert all(torch.equal(a[number], b) for a, b in zip(together, alone, strict=True))


def test_what_is_refused() -> None:
    poses, motion, wrenches, gravity, bodies = rigid_bodies(3, DOUBLE)
    with pytest.raises(ValueError, match=r"motion must be like poses.*\[3, 2, 5\]"):
        ops.free_motion(poses, motion[..., :5], wrenches, gravity, bodies, time_step=H)
    with pytest.raises(ValueError, match=r"gravity must be like poses"):
        ops.free_motion(poses, motion, wrenches, gravity.float(), bodies, time_step=H)
    with pytest.raises(ValueError, match=r"time_step must be positive"):
        ops.free_motion(poses, motion, wrenches, gravity, bodies, time_step=0.0)
    motion.requires_grad_()
    loss = ops.free_motion(poses, motion, wrenches, gravity, bodies, time_step=H)[0].square().sum()
    (slope,) = torch.autograd.grad(loss, motion, create_graph=True)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        slope.sum().backward()
