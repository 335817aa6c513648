"""Every op of `torch.ops.torchpd`, with arguments for it."""

from __future__ import annotations

from typing import Any

import torch
from runs import noise, plan_of, settings_of, small
from torch import Tensor

import torchpd as pd
from torchpd.ops.registration import INFO_WIDTH

BATCH = 3


def samples(
    name: str, dtype: torch.dtype, device: torch.device, **options: Any
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Arguments of an op; those for which it has derivatives ask for gradients."""
    sim, state = small(dtype, device, **options)
    material, plan = sim.material(), plan_of(sim)
    x, v = state
    f, direction = noise(x), noise(x, 1)
    still, zero = sim.rest_state(BATCH)
    info = torch.full((BATCH, INFO_WIDTH), float("nan"), dtype=torch.float64, device=device)
    numbers = settings_of(sim)
    matrices = noise(torch.empty(5, 3, 3, dtype=dtype, device=device)) + 2.0 * torch.eye(3, dtype=dtype, device=device)

    def wanted(tensor: Tensor) -> Tensor:
        return tensor.detach().clone().requires_grad_()

    trained = [wanted(sim.stiffness), *material[1:]]
    found: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = {
        # near an equilibrium, where the adjoint of a step has a solution
        "step": (
            (wanted(still), wanted(zero), wanted(0.01 * f), None, material, plan),
            {**numbers, "iterations": 400},
        ),
        "step_": ((x.clone(), v.clone(), info, f, x + 0.01 * direction, material, plan), numbers),
        "rollout": (
            (wanted(still), wanted(zero), wanted(0.01 * f), material, plan),
            {**numbers, "iterations": 400, "steps": 3, "every": 1},
        ),
        "step_vjp": (
            (f, direction, still, still, zero, 0.01 * f, material, plan),
            {"time_step": sim.time_step, "wanted": [number % 3 != 1 for number in range(len(material))]},
        ),
        "rollout_vjp": (
            (noise(still[None]), noise(still[None], 1), still[None], zero[None], still, zero, 0.01 * f, material, plan),
            {"time_step": sim.time_step, "wanted": [number % 3 != 1 for number in range(len(material))]},
        ),
        "gradient": ((wanted(x), trained, plan), {}),
        "element_energy": ((wanted(x), trained, plan), {}),
        "element_energy_product": ((wanted(x), wanted(direction), trained, plan), {}),
        "hessian_product": ((x, wanted(direction), material, plan), {}),
        "elastic_diagonal": ((material, plan), {"weighted": True}),
        "nearest_rotation": ((wanted(matrices),), {}),
        "rotation_differential": ((wanted(matrices), wanted(matrices.flip(0))), {}),
    }
    return found[name] if name in found else samples_of_the_adjoint(sim, x)[name]


def samples_of_the_adjoint(sim: pd.Simulator, x: Tensor) -> dict[str, tuple[tuple[Any, ...], dict[str, Any]]]:
    """Arguments of the ops that it is made of, which have no derivatives."""
    material, plan = [array.detach() for array in sim.material()], plan_of(sim)
    f, direction = noise(x), noise(x, 1)
    still, zero = sim.rest_state(BATCH)
    h, double = {"time_step": sim.time_step}, {"dtype": torch.float64, "device": x.device}
    progress, errors = torch.full((BATCH, 4), -1.0, **double), torch.tensor([0.0, 2.0, 1.0], **double)
    inertia = sim.masses / sim.time_step**2
    projector = torch.eye(3, dtype=x.dtype, device=x.device).repeat(*x.shape[:2], 1, 1)
    sliding = noise(projector.new_empty(*x.shape[:2], 5, 3), 3)
    return {
        "conjugate_gradients_": (
            (0 * x, f.clone(), f.clone(), progress, x, sim.masses, 1 / sim.masses, None, material, plan),
            {"tolerance": 1e-3, "iterations": 2},
        ),
        "conjugate_gradients": (
            (x, f, inertia, 1 / inertia, projector, material, plan, 0.1 * sliding), {"tolerance": 1e-3},
        ),
        "adjoint_system": ((f, direction, x, still, zero, 0.01 * f, material, plan), h),
        "contact_gradients": ((direction, f, f, direction, x, still, zero, 0.01 * f, material, plan), h),
        "adjoint_result": (
            (f, errors, direction, material, f, direction, projector, x[..., 0] > 0.1, sliding), h,
        ),
        **samples_of_contact(x),
        **samples_of_rigid_motion(x),
        "adjoint_fallback": ((direction, errors, 0 * errors, still, f, 1 / inertia, None, material, plan), h),
    }  # fmt: skip


def rigid_bodies(batch: int, like: Tensor) -> tuple[Tensor, ...]:
    """Poses, velocities and wrenches [batch, 2, n], gravity [3] and constant numbers [2, 10] of two colliders."""
    rates = noise(like.new_empty(batch, 2, 12))
    poses = torch.cat([0.1 * rates[..., :3], torch.nn.functional.normalize(rates[..., 3:7], dim=-1)], dim=-1)
    moments = [0.01, 0.001, -0.002, 0.015, 0.003, 0.012], [1e-3, 0, 0, 2e-3, 0, 2.5e-3]
    bodies = like.new_tensor([[0.5, 0.1, 0.2, 0.3, *moments[0]], [0.02, 0, 0, 0.01, *moments[1]]])
    gravity = like.new_tensor([0.0, -10.0, 1.0])
    return poses, noise(rates[..., :6], 1) * 10.0, 0.1 * noise(rates[..., :6], 2), gravity, bodies


def samples_of_rigid_motion(x: Tensor) -> dict[str, tuple[tuple[Any, ...], dict[str, Any]]]:
    """Arguments of the ops of colliders with a mass."""
    given, h = rigid_bodies(BATCH, x.detach()), {"time_step": 1 / 60}
    goal, rates, rows = torch.ops.torchpd.free_motion(*given, **h)
    after = given[0], goal, rates, rows, given[0], given[-1]

    def wanted(arrays: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return tuple(array.detach().clone().requires_grad_() for array in arrays)

    return {
        "free_motion": (wanted(given), h),
        "free_motion_vjp": ((noise(goal), noise(rates), noise(rows), *given), h),
        "motion_after": (wanted(after), h),
        "motion_after_vjp": ((noise(rates), *after), h),
    }


def samples_of_contact(x: Tensor) -> dict[str, tuple[tuple[Any, ...], dict[str, Any]]]:
    """Arguments of the ops of a step with contact between bodies."""
    mesh = pd.shapes.box((0.1,) * 3, (1,) * 3)
    cubes = [pd.Solid(mesh.translated((0.01 * n, 0.102 * n, 0.0)), youngs=1e5, density=1000.0) for n in range(2)]
    scene = pd.Scene(*cubes, pd.Contact(friction=0.3, thickness=1e-3))
    sim = pd.Simulator(scene, dtype=x.dtype, device=x.device, progress=False)
    assert sim.body_contact is not None
    state: Any = sim.rest_state(BATCH)
    state.velocities[:, 8:, 1] = -0.5
    material, plan, contact = sim.material(), plan_of(sim), sim.body_contact.arrays
    poses, keys, forces, *_ = state.history
    taken = torch.ops.torchpd.contact_step(
        *state[:2], None, poses, [poses, keys, forces], material, plan, contact, **settings_of(sim)
    )
    after, numbers, actual, keys, forces, pushes = (taken[place] for place in (0, 3, 5, 6, 7, 8))
    f, h = noise(state.positions), {"time_step": sim.time_step}
    pairs = [state.positions, after, poses, actual, poses, keys, forces, *contact]
    inertia = (sim.masses / sim.time_step**2).detach()
    trained = [array.clone().requires_grad_() if array.is_floating_point() else array for array in contact]
    moving = [array.detach().clone().requires_grad_() for array in state[:2]]
    solve = (after, f, inertia, 1.0 / (inertia + 1e4), None, material, plan, None, None, pairs)
    history, back = [poses, actual, keys, forces], numbers[:, 1] > 0
    errors = torch.tensor([0.0, 2.0, 1.0], dtype=torch.float64, device=x.device)
    return {
        "contact_step": (
            (*moving, None, poses, [poses, *state.history[1:3]], material, plan, trained), settings_of(sim),
        ),
        "contact_conjugate": (solve, {"tolerance": 1e-3}),
        "contact_fallback": ((f, errors, None, *solve[:2], *solve[3:7], None, pairs), h),
        "contact_step_vjp": (
            (f, f, actual, after, *state[:2], None, poses, history, pushes, back, material, plan, contact), h,
        ),
    }  # fmt: skip


OF_CONTACT = ("contact_step", "contact_conjugate", "contact_fallback", "contact_step_vjp")
OPS = (
    "step", "step_", "rollout", "gradient", "element_energy", "element_energy_product", "hessian_product",
    "elastic_diagonal", "nearest_rotation", "rotation_differential", "step_vjp", "rollout_vjp", "conjugate_gradients_",
    "adjoint_system", "contact_gradients", "adjoint_result", "adjoint_fallback", "conjugate_gradients",
    "free_motion", "free_motion_vjp", "motion_after", "motion_after_vjp",
)  # fmt: skip
