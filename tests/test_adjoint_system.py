"""The ops around the solve of a step's adjoint: its system, contacts included, and what its solution says."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from runs import ULP, noise, plan_of, small
from torch import Tensor

import torchpd as pd
from torchpd.diagonal import named_material, step_diagonal
from torchpd.tables import MATERIAL_TABLE

pytestmark = pytest.mark.usefixtures("poisoned")

ops = torch.ops.torchpd
BATCH = 3
NAMES = [row.name for row in MATERIAL_TABLE]


def material_of(sim: pd.Simulator, *, contacts: bool) -> list[Tensor]:
    """The small scene's, with its ground and ball or without."""
    arrays = [array.detach() for array in sim.material()]
    if contacts:
        return arrays
    return [array[:0] if name in ("planes", "spheres") else array for name, array in zip(NAMES, arrays, strict=True)]


def for_each(material: list[Tensor], name: str) -> list[Tensor]:
    """The material with one array for each environment."""
    array = material[NAMES.index(name)]
    factor = torch.linspace(0.5, 1.5, BATCH, dtype=array.dtype, device=array.device)
    own = factor.reshape(-1, *[1] * array.dim()) * array
    return [own if known == name else other for known, other in zip(NAMES, material, strict=True)]


@pytest.mark.parametrize("own", ["", "stiffness", "masses", "damping", "pin_stiffness", "gravity"])
def test_the_system_without_contacts(own: str, dtype: torch.dtype, device: torch.device) -> None:
    """What environments share has one row; a hard pin has no part in anything, a soft one adds its spring."""
    sim, (x, v) = small(dtype, device)
    material = material_of(sim, contacts=False)
    material = for_each(material, own) if own else material
    g, w, h = noise(x), noise(x, 1), sim.time_step
    right, inertia, inverse, projector, stuck = ops.adjoint_system(
        g, w, x, x, v, None, material, plan_of(sim), time_step=h
    )
    rows = BATCH if own not in ("", "gravity") else 1
    assert inertia.shape == inverse.shape == (rows, sim.vertices)
    assert projector.shape == (0, sim.vertices, 3, 3)
    assert stuck.shape == (0, sim.vertices)
    wanted, diagonal = (t.expand(rows, -1) for t in step_diagonal(plan_of(sim), material, h))
    moves = wanted.isfinite()
    assert 0 < int((~moves).sum()) < rows * sim.vertices
    limit = 10 * ULP[dtype]
    assert torch.allclose(inertia, torch.where(moves, wanted, 0.0), rtol=limit, atol=0.0)
    assert torch.allclose(inverse, torch.where(moves, 1.0 / diagonal, 0.0), rtol=limit, atol=0.0)
    assert torch.allclose(right, torch.where(moves[..., None], g + w / h, 0.0), rtol=0.0, atol=100 * limit)


def held_by_contacts(
    material: dict[str, Tensor], after: Tensor, moved: Tensor, residual: Tensor, diagonal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Projector, stuck and curvature of every vertex, one contact after another, from torch operations."""
    surfaces = []
    for plane in material["planes"].unbind(-2):
        normal = plane[..., None, :3].expand_as(after)
        gap = (after * normal).sum(-1) - plane[..., None, 3]
        surfaces.append((normal, gap, plane[..., None, 4], torch.zeros_like(after), torch.zeros_like(gap)))
    for ball in material["spheres"].unbind(-2):
        offset = after - ball[..., None, :3]
        length = offset.norm(dim=-1)
        gap = length - ball[..., None, 3]
        surfaces.append((offset / length[..., None], gap, ball[..., None, 4], ball[..., None, 5:], 1 / length))
    projector = torch.eye(3, dtype=after.dtype, device=after.device).expand(*after.shape, 3)
    stuck, curvature = torch.zeros_like(diagonal, dtype=torch.bool), torch.zeros_like(diagonal)
    for normal, gap, friction, motion, curved in surfaces:
        push = (residual * normal).sum(-1)
        holds = (push > 0) & (gap < push / diagonal)
        slip = moved - motion
        slip = (slip - (slip * normal).sum(-1, keepdim=True) * normal).norm(dim=-1)
        stuck = stuck | (holds & (friction > 0) & (slip * diagonal < 1e-3 * friction * push))
        left = (projector * normal.unsqueeze(-2)).sum(-1)
        size = (left * left).sum(-1)
        share = torch.where(holds & (size > 1e-6), 1 / size, 0.0)[..., None, None]
        projector = projector - share * left.unsqueeze(-1) * left.unsqueeze(-2)
        curvature = curvature + torch.where(holds, push * curved, 0.0)
    return projector, stuck, curvature


@pytest.mark.parametrize("forces", [False, True])
@pytest.mark.parametrize("own", ["", "planes", "spheres", "gravity", "pin_targets", "stiffness"])
def test_the_system_with_contacts(own: str, forces: bool, dtype: torch.dtype, device: torch.device) -> None:
    """Against torch operations; on the ground and on a ball amid the body, where friction holds some vertices."""
    sim, (x, v) = small(dtype, device)
    material = material_of(sim, contacts=True)
    f = 50.0 * noise(x, 2) if forces else None
    # every third vertex with next to no slip
    after = x - 0.004 * noise(x, 3).abs()
    after[:, ::3] = x[:, ::3]
    ball = material[NAMES.index("spheres")]
    ball[0, :3] = after[0].mean(0)
    ball[0, 3] = (after[0] - ball[0, :3]).norm(dim=-1).quantile(0.8)
    material = for_each(material, own) if own else material
    g, w, h = noise(x), noise(x, 1), sim.time_step
    given = (g, w, after, x, v, f, material)
    right, inertia, inverse, projector, stuck = ops.adjoint_system(*given, plan_of(sim), time_step=h)

    known = named_material(material)
    wanted, diagonal = (t.expand(BATCH, -1) for t in step_diagonal(plan_of(sim), material, h))
    moves = wanted.isfinite()
    diagonal = torch.where(moves, diagonal, 1.0)
    residual = pd.adjoint.step_gradient(pd.adjoint.AdjointCall(x, v, f, after, material, plan_of(sim), h))
    held, sticks, curvature = held_by_contacts(known, after, after - x, residual, diagonal)
    assert torch.equal(stuck, sticks)
    assert 0 < int(stuck.sum()) < stuck.numel()
    assert int((curvature > 0).sum()) > 0
    touched = (held - torch.eye(3, dtype=dtype, device=device)).abs().amax((-1, -2)) > 0.1
    assert 0 < int(touched.sum()) < int(moves.sum())
    limit = 1e3 * ULP[dtype]
    assert torch.allclose(projector, held, rtol=0.0, atol=limit)
    kept = torch.where(moves, wanted, 0.0) - curvature
    assert torch.allclose(inertia, kept, rtol=limit, atol=limit * float(diagonal.max()))
    assert torch.allclose(inverse, torch.where(moves & ~sticks, 1.0 / diagonal, 0.0), rtol=limit, atol=0.0)
    free = torch.where((moves & ~sticks)[..., None], g + w / h, 0.0)
    assert torch.allclose(right, (held * free.unsqueeze(-2)).sum(-1), rtol=0.0, atol=1e2 * limit)


@pytest.mark.parametrize("own", [False, True])
def test_the_result(own: bool, dtype: torch.dtype, device: torch.device) -> None:
    """dL/dx = m / h^2 (1 + damping h) l - dL/dv' / h, dL/dv = m / h l; an environment without an error has none."""
    sim, (x, _) = small(dtype, device)
    masses, damping, h = sim.masses, sim.damping, sim.time_step
    if own:
        factor = torch.linspace(0.5, 1.5, BATCH, dtype=dtype, device=device)
        masses, damping = factor[:, None] * masses, factor * damping
    multiplier, w = noise(x), noise(x, 1)
    errors = torch.tensor([[0.0, 9.0], [torch.nan, 9.0], [torch.inf, 9.0]], dtype=torch.float64, device=device)
    found = ops.adjoint_result(multiplier, errors[:, 0], w, masses, damping, time_step=h)
    assert all(t[1].isnan().all() for t in found)
    inertia = masses / h**2 * (1 + damping.unsqueeze(-1) * h)
    wanted = inertia[..., None] * multiplier - w / h, masses[..., None] / h * multiplier, multiplier
    for one, other in zip(found, wanted, strict=True):
        assert torch.allclose(one[::2], other[::2], rtol=10 * ULP[dtype], atol=1000 * ULP[dtype])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"error": torch.zeros(BATCH)}, "error must be float64"),
        ({"error": torch.zeros(1, dtype=torch.float64)}, "error must be float64"),
        ({"grad_velocities": torch.zeros(BATCH, 2, 3)}, "grad_velocities must be"),
        ({"masses": torch.ones(2)}, "masses must be"),
        ({"damping": torch.ones(2, 2)}, "damping must"),
        ({"time_step": 0.0}, "time_step must be positive"),
    ],
)
def test_the_result_refuses(change: dict[str, Any], said: str) -> None:
    sim, (x, _) = small(torch.float32)
    given = {
        "multiplier": x, "error": torch.zeros(BATCH, dtype=torch.float64), "grad_velocities": x, "masses": sim.masses,
        "damping": sim.damping, "time_step": sim.time_step,
    }  # fmt: skip
    with pytest.raises((TypeError, ValueError), match=said):
        ops.adjoint_result(**{**given, **change})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"grad_positions": torch.zeros(BATCH, 2, 3)}, "grad_positions must be"),
        ({"grad_velocities": torch.zeros(BATCH, 2, 3)}, "grad_velocities must be"),
        ({"after": torch.zeros(1, 2, 3)}, "after must be"),
        ({"velocities": torch.zeros(1, 2, 3)}, "velocities must be"),
        ({"forces": torch.zeros(1, 2, 3)}, "forces must be"),
        ({"material": []}, "material must be"),
        ({"time_step": -1.0}, "time_step must be positive"),
    ],
)
def test_the_system_refuses(change: dict[str, Any], said: str) -> None:
    sim, (x, v) = small(torch.float32)
    given = {
        "grad_positions": x, "grad_velocities": x, "after": x, "positions": x, "velocities": v, "forces": None,
        "material": material_of(sim, contacts=True), "plan": plan_of(sim), "time_step": sim.time_step,
    }  # fmt: skip
    with pytest.raises(ValueError, match=said):
        ops.adjoint_system(**{**given, **change})
