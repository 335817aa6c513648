"""The ops around the solve of a step's adjoint: its system, contacts included, and what its solution says."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from runs import ULP, noise, plan_of, small
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils import _pytree as pytree

import torchpd as pd
from torchpd.common.tables import MATERIAL_TABLE
from torchpd.ops.diagonal import named_material, step_diagonal

pytestmark = pytest.mark.usefixtures("poisoned")

ops = torch.ops.torchpd
BATCH = 3
NAMES = [row.name for row in MATERIAL_TABLE if not row.effect]


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
    right, inertia, inverse, projector, stuck, sliding = ops.adjoint_system(
        g, w, x, x, v, None, material, plan_of(sim), time_step=h
    )
    rows = BATCH if own not in ("", "gravity") else 1
    assert inertia.shape == inverse.shape == (rows, sim.vertices)
    assert projector.shape == (0, sim.vertices, 3, 3)
    assert stuck.shape == (0, sim.vertices)
    assert sliding.shape == (0, sim.vertices, 5, 3)
    wanted, diagonal = (t.expand(rows, -1) for t in step_diagonal(plan_of(sim), material, h))
    moves = wanted.isfinite()
    assert 0 < int((~moves).sum()) < rows * sim.vertices
    limit = 10 * ULP[dtype]
    assert torch.allclose(inertia, torch.where(moves, wanted, 0.0), rtol=limit, atol=0.0)
    assert torch.allclose(inverse, torch.where(moves, 1.0 / diagonal, 0.0), rtol=limit, atol=0.0)
    assert torch.allclose(right, torch.where(moves[..., None], g + w / h, 0.0), rtol=0.0, atol=100 * limit)


@pytest.mark.parametrize("batch", [0, 1, 3])
@pytest.mark.parametrize("pins", [False, True])
@pytest.mark.parametrize("own", ["", "stiffness", "damping", "pin_stiffness"])
def test_shapes_without_values(own: str, pins: bool, batch: int) -> None:
    """The shapes that the fake kernel promises, for material of each environment, of one, and of all."""
    body = pd.Solid(pd.shapes.box((1.0, 1.0, 1.0), (2, 1, 1)), 1e4)
    sim = pd.Simulator(pd.Scene(body, *([pd.Pin(body, [0, 1], 10.0)] if pins else [])), 1 / 60, progress=False)
    x, v = sim.rest_state(batch)
    material = [array.detach() for array in sim.material()]
    for rows in (1, batch):
        arrays = [
            array.expand(rows, *array.shape).clone() if name == own else array
            for name, array in zip(NAMES, material, strict=True)
        ]
        found = ops.adjoint_system(x, v, x, x, v, None, arrays, plan_of(sim), time_step=sim.time_step)
        with FakeTensorMode() as mode:
            fakes = pytree.tree_map_only(torch.Tensor, mode.from_tensor, (x, v, x, x, v, None, arrays, plan_of(sim)))
            promised = ops.adjoint_system(*fakes, time_step=sim.time_step)
        assert [t.shape for t in found] == [t.shape for t in promised]


def replaced(sim: pd.Simulator, **arrays: Tensor) -> list[Tensor]:
    """The material with some arrays exchanged."""
    return [arrays.get(name, array) for name, array in zip(NAMES, sim.material(), strict=True)]


def test_a_right_side_of_any_strides(dtype: torch.dtype, device: torch.device) -> None:
    sim, (x, _) = small(dtype, device)
    right = noise(x)
    strided = right.transpose(0, 1).contiguous().transpose(0, 1)
    given = (sim.masses, 1 / sim.masses, None, sim.material(), plan_of(sim))
    one, other = (ops.conjugate_gradients(x, t, *given, tolerance=1e-3) for t in (right, strided))
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def held_by_contacts(
    material: dict[str, Tensor], after: Tensor, moved: Tensor, residual: Tensor, diagonal: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Projector, stuck, curvature and sliding of every vertex, one contact after another, from torch operations."""
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
    sliding, contacts = after.new_zeros((*after.shape[:2], 5, 3)), torch.zeros_like(diagonal)
    for normal, gap, friction, motion, curved in surfaces:
        push = (residual * normal).sum(-1)
        left = (projector * normal.unsqueeze(-2)).sum(-1)
        size = (left * left).sum(-1)
        holds = (push > 0) & (gap < push / diagonal) & (size > 1e-6)
        slip = moved - motion
        slip = slip - (slip * normal).sum(-1, keepdim=True) * normal
        length = slip.norm(dim=-1)
        sticks = (friction > 0) & (length * diagonal < 1e-3 * friction * push)
        stuck = stuck | (holds & sticks)
        contacts = contacts + holds
        slides = (holds & (friction > 0) & ~sticks)[..., None]
        way = torch.where(slides, slip / length[..., None], 0.0)
        across = torch.linalg.cross(normal, way)
        rate, bend = (friction * push / length)[..., None].sqrt(), (push * curved)[..., None].sqrt()
        lean = curved[..., None] * ((moved - motion) * normal).sum(-1, keepdim=True)
        rows = friction[..., None] * way, normal, rate * across, friction[..., None] * bend * way, lean * rate * across
        mine = torch.stack([torch.where(slides, row, 0.0) for row in rows], -2)
        sliding = torch.where(holds[..., None, None], mine, sliding)
        share = torch.where(holds, 1 / size, 0.0)[..., None, None]
        projector = projector - share * left.unsqueeze(-1) * left.unsqueeze(-2)
        curvature = curvature + torch.where(holds, push * curved, 0.0)
    sliding = torch.where((stuck | (contacts > 1))[..., None, None], 0.0, sliding)
    return projector, stuck, curvature, sliding


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
    right, inertia, inverse, projector, stuck, sliding = ops.adjoint_system(*given, plan_of(sim), time_step=h)

    known = named_material(material)
    wanted, diagonal = (t.expand(BATCH, -1) for t in step_diagonal(plan_of(sim), material, h))
    moves = wanted.isfinite()
    diagonal = torch.where(moves, diagonal, 1.0)
    residual = pd.ops.adjoint.step_gradient(pd.ops.adjoint.AdjointCall(x, v, f, after, material, plan_of(sim), h))
    held, sticks, curvature, slides = held_by_contacts(known, after, after - x, residual, diagonal)
    assert torch.equal(stuck, sticks)
    assert 0 < int(stuck.sum()) < stuck.numel()
    assert int((curvature > 0).sum()) > 0
    touched = (held - torch.eye(3, dtype=dtype, device=device)).abs().amax((-1, -2)) > 0.1
    assert 0 < int(touched.sum()) < int(moves.sum())
    limit = 1e3 * ULP[dtype]
    assert torch.allclose(projector, held, rtol=0.0, atol=limit)
    assert 0 < int((sliding != 0.0).any(-1).any(-1).sum()) < int(touched.sum())
    largest = slides.abs().amax((0, 1, 3))[:, None]
    assert torch.allclose(sliding / largest, slides / largest, rtol=limit, atol=limit)
    kept = torch.where(moves, wanted, 0.0) - curvature
    assert torch.allclose(inertia, kept, rtol=limit, atol=limit * float(diagonal.max()))
    turning = slides[..., 2, :].square().sum(-1)
    assert torch.allclose(inverse, torch.where(moves & ~sticks, 1.0 / (diagonal + turning), 0.0), rtol=limit, atol=0.0)
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
    material = replaced(sim, masses=masses, damping=damping)
    found = ops.adjoint_result(multiplier, errors[:, 0], w, material, time_step=h)
    assert all(t[1].isnan().all() for t in found)
    inertia = masses / h**2 * (1 + damping.unsqueeze(-1) * h)
    wanted = inertia[..., None] * multiplier - w / h, masses[..., None] / h * multiplier, multiplier
    for one, other in zip(found, wanted, strict=True):
        assert torch.allclose(one[::2], other[::2], rtol=10 * ULP[dtype], atol=1000 * ULP[dtype])


def test_the_result_with_contacts(dtype: torch.dtype, device: torch.device) -> None:
    """A vertex that friction holds moves with its start, by what contacts let through of dL/dx' + dL/dv' / h - K l.

    One that slides has the turning of its slip, across it, but where the solve has failed.
    """
    sim, (x, _) = small(dtype, device)
    h = sim.time_step
    multiplier, w, g, elastic = (noise(x, seed) for seed in range(4))
    projector = noise(torch.empty(*x.shape, 3, dtype=dtype, device=device), 4)
    stuck = noise(x, 5)[..., 0] > 0.5
    sliding = noise(torch.empty(*x.shape[:2], 5, 3, dtype=dtype, device=device), 6)
    sliding[stuck] = 0.0
    sliding[:, 1::2] = 0.0
    errors = torch.tensor([0.0, torch.nan, 1.0], dtype=torch.float64, device=device)
    given = (multiplier, errors, w, sim.material())
    found = ops.adjoint_result(*given, g, elastic, projector, stuck, sliding, time_step=h)
    without = ops.adjoint_result(*given, time_step=h)
    assert all(torch.equal(one[::2], other[::2]) for one, other in zip(found[1:], without[1:], strict=True))
    assert all(t[1].isnan().all() for t in found)
    passed = (projector * (g + w / h - elastic).unsqueeze(-2)).sum(-1)
    wanted = without[0] + torch.where(stuck[..., None], passed, 0.0)
    assert errors[2] > pd.ops.adjoint.ADJOINT_TOLERANCE[dtype]
    across = sliding[..., 2, :].clone()
    across[2] = 0.0
    wanted = wanted + across * (across * multiplier).sum(-1, keepdim=True)
    assert torch.allclose(found[0][::2], wanted[::2], rtol=10 * ULP[dtype], atol=1e4 * ULP[dtype])
    plain = ~stuck & (across == 0.0).all(-1)
    assert torch.equal(found[0][plain].nan_to_num(7.0), without[0][plain].nan_to_num(7.0))
    assert 0 < int(stuck.sum()) < stuck.numel()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"error": torch.zeros(BATCH)}, "error must be float64"),
        ({"error": torch.zeros(1, dtype=torch.float64)}, "error must be float64"),
        ({"grad_velocities": torch.zeros(BATCH, 2, 3)}, "grad_velocities must be"),
        ({"masses": torch.ones(2)}, r"masses .*got Float \[2\]"),
        ({"damping": torch.ones(2, 2)}, "damping must"),
        ({"time_step": 0.0}, "time_step must be positive"),
        ({"elastic": None}, "come together or not at all"),
        ({"elastic": torch.zeros(BATCH, 2, 3)}, "elastic must be"),
        ({"grad_positions": torch.zeros(BATCH, 2, 3)}, "grad_positions must be"),
        ({"projector": torch.zeros(BATCH, 2, 3, 3)}, r"projector .*got Float \[3, 2, 3, 3\]"),
        ({"stuck": torch.zeros(BATCH, 2, dtype=torch.bool)}, "stuck must be bool"),
        ({"stuck": torch.zeros(BATCH, 2)}, "stuck must be bool"),
        ({"sliding": None}, "come together or not at all"),
        ({"sliding": torch.zeros(BATCH, 2, 5, 3)}, "sliding must be"),
        ({"sliding": torch.zeros(BATCH, 12, 4, 3, dtype=torch.float64)}, "sliding must be"),
    ],
)
def test_the_result_refuses(change: dict[str, Any], said: str) -> None:
    sim, (x, _) = small(torch.float32)
    given = {
        "multiplier": x, "error": torch.zeros(BATCH, dtype=torch.float64), "grad_velocities": x,
        "material": sim.material(), "grad_positions": x, "elastic": x, "projector": torch.zeros(*x.shape, 3),
        "stuck": torch.zeros(x.shape[:2], dtype=torch.bool), "sliding": torch.zeros(*x.shape[:2], 5, 3),
        "time_step": sim.time_step,
    }  # fmt: skip
    ops.adjoint_result(**given)
    wrong = {name: value for name, value in change.items() if name not in NAMES}
    if len(wrong) < len(change):
        wrong["material"] = replaced(sim, **change)
    with pytest.raises((TypeError, ValueError), match=said):
        ops.adjoint_result(**{**given, **wrong})


@pytest.mark.parametrize("name", ["adjoint_system", "contact_gradients"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"grad_positions": torch.zeros(BATCH, 2, 3)}, "grad_positions must be"),
        ({"grad_velocities": torch.zeros(BATCH, 2, 3)}, "grad_velocities must be"),
        ({"after": torch.zeros(1, 2, 3)}, r"after .*got Float \[1, 2, 3\]"),
        ({"velocities": torch.zeros(1, 2, 3)}, r"velocities .*got Float \[1, 2, 3\]"),
        ({"forces": torch.zeros(1, 2, 3)}, r"forces .*got Float \[1, 2, 3\]"),
        ({"material": []}, "material .*got 0"),
        ({"time_step": -1.0}, "time_step must be positive"),
    ],
)
def test_a_step_that_was_not_taken_is_refused(change: dict[str, Any], said: str, name: str) -> None:
    sim, (x, v) = small(torch.float32)
    given = {
        "grad_positions": x, "grad_velocities": x, "after": x, "positions": x, "velocities": v, "forces": None,
        "material": material_of(sim, contacts=True), "plan": plan_of(sim), "time_step": sim.time_step,
    }  # fmt: skip
    if name == "contact_gradients":
        given |= {"multiplier": x, "elastic": x}
    op = getattr(ops, name)
    op(**given)
    with pytest.raises(ValueError, match=said):
        op(**{**given, **change})


@pytest.mark.parametrize("field", ["multiplier", "elastic"])
def test_gradients_for_contacts_refuse(field: str) -> None:
    sim, (x, v) = small(torch.float32)
    given = {"multiplier": x, "elastic": x, field: torch.zeros(BATCH, 2, 3)}
    with pytest.raises(ValueError, match=f"{field} must be"):
        ops.contact_gradients(
            *given.values(), x, x, x, x, v, None, material_of(sim, contacts=True), plan_of(sim), time_step=0.1
        )
