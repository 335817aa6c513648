"""The op behind the adjoint: conjugate gradients on the Hessian of a step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpd as pd
from torchpd.adjoint import _System

pytestmark = pytest.mark.usefixtures("poisoned")

ops = torch.ops.torchpd
BATCH = 3


def noise(shape: torch.Size, dtype: torch.dtype, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def system(
    dtype: torch.dtype,
    device: torch.device,
    *,
    cells: tuple[int, int, int] = (3, 2, 2),
    contacts: bool = False,
    kernel: str = "auto",
) -> tuple[_System, Tensor, Tensor]:
    """A bar whose environments differ, three of its vertices held; positions, and a right side of what may move."""
    mesh = pd.shapes.box((1.0, 0.4, 0.3), cells)
    solid = pd.Solid(mesh, youngs=2e4, density=1000.0)
    options: dict[str, Any] = {"kernel": kernel} if device.type == "cuda" else {}
    sim = pd.Simulator(pd.Scene(solid), 1 / 60, dtype=dtype, progress=False, **options).to(device)
    x = sim.rest_state(BATCH).positions.cpu()
    spread = torch.tensor([1.0, 0.3, 2.5], dtype=dtype)[:, None]
    moves = torch.ones(BATCH, sim.vertices, dtype=dtype)
    moves[:, :3] = 0.0
    inertia = 0.5 * sim.masses.cpu() / sim.time_step**2 * (1 + 0.1 * noise((BATCH, sim.vertices), dtype))
    normal = torch.nn.functional.normalize(noise((*x.shape[:2], 3), dtype, 1), dim=-1)
    projector = (
        torch.eye(3, dtype=dtype)
        - normal[..., None] * normal[..., None, :] * (torch.arange(sim.vertices) % 2)[:, None, None]
    )
    stiffness = spread * sim.stiffness.cpu()
    diagonal = inertia + ops.elastic_diagonal(stiffness.to(device), list(sim.plan.arrays), weighted=True).cpu()
    found = _System(
        inertia.to(device), (moves / diagonal).to(device), projector.to(device) if contacts else None,
        stiffness.to(device), list(sim.plan.arrays),
    )  # fmt: skip
    # little enough for elements of any size to leave the Hessian positive
    smallest = min(length / count for length, count in zip((1.0, 0.4, 0.3), cells, strict=True))
    positions = (x + smallest / 15.0 * noise(x.shape, dtype, 2)).to(device)
    return found, positions, found.allowed(noise(x.shape, dtype, 3).to(device))


def start(s: _System, right: Tensor) -> list[Tensor]:
    """Solution, residual, direction and progress before the first iteration, which alone says what is in the others."""
    progress = torch.full((len(right), 4), -1.0, dtype=torch.float64, device=right.device)
    unwritten = torch.full_like(right, float("nan"))
    return [unwritten.clone(), right.clone(), unwritten, progress]


def iterate(s: _System, state: list[Tensor], positions: Tensor, iterations: int, tolerance: float = 0.0) -> None:
    ops.conjugate_gradients_(
        *state, positions, s.inertia, s.inverse, s.projector, s.stiffness, s.plan,
        tolerance=tolerance, iterations=iterations,
    )  # fmt: skip


def environment(s: _System, e: int) -> _System:
    """One of them, alone."""
    own: dict[str, Any] = {name: getattr(s, name)[e : e + 1] for name in ("inertia", "inverse", "stiffness")}
    return replace(s, projector=None if s.projector is None else s.projector[e : e + 1], **own)


@pytest.mark.parametrize("contacts", [False, True])
def test_the_solution_is_that_of_a_dense_matrix(contacts: bool, dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device, contacts=contacts)
    solution, error = s.solve(positions, right, 1e-6 if dtype == torch.float32 else 1e-12)
    exact, x, b = system(torch.float64, device, contacts=contacts)
    units = torch.eye(x[0].numel(), dtype=torch.float64, device=device).reshape(-1, *x[0].shape)
    for e in range(BATCH):
        alone = environment(exact, e)
        fields = [alone.allowed(unit[None]) for unit in units]
        matrix = torch.stack([alone.product_at(x[e : e + 1])(field).flatten() for field in fields])
        outside = torch.stack([(unit - field[0]).flatten() for unit, field in zip(units, fields, strict=True)])
        wanted = torch.linalg.solve(matrix + float(matrix.diagonal().max()) * outside, b[e].flatten()).reshape(
            x[e].shape
        )
        assert float((solution[e] - wanted).norm() / wanted.norm()) < (1e-4 if dtype == torch.float32 else 1e-9)
    assert float(error.max()) < (2e-6 if dtype == torch.float32 else 2e-12)


# "block" on a GPU: a thread has one pair, several, and several slots too; two blocks share a multiprocessor, or cannot
SHAPES = {
    torch.float32: {"any": (3, 2, 2), "one": (3, 2, 2), "pairs": (15, 3, 3), "slots": (29, 3, 3), "alone": (9, 9, 9)},
    torch.float64: {"any": (3, 2, 2), "one": (3, 2, 2), "pairs": (9, 3, 3), "slots": (15, 3, 3), "alone": (6, 6, 6)},
}


@pytest.mark.parametrize("shape", ["any", "several", "one", "pairs", "slots", "alone"])
def test_it_does_what_torch_operations_do(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    """Iteration by iteration; ten of them leave a residual that rounding has little part in."""
    # "several": on a GPU blocks share the vertices of an environment, which are more than 1024
    cells = (22, 9, 9) if shape == "several" else SHAPES[dtype][shape]
    kernel = {"any": "auto", "several": "grid"}.get(shape, "block")
    s, positions, right = system(dtype, device, contacts=True, cells=cells, kernel=kernel)
    state = start(s, right)
    iterate(s, state, positions, 10)
    wanted = torch.zeros_like(right)
    # by hand, in float64
    exact, x, b = system(torch.float64, device, contacts=True, cells=cells)
    inverse = exact.inverse.unsqueeze(-1)
    r, d = b, inverse * b
    wanted, rho = torch.zeros_like(b), (b * d).sum((1, 2), keepdim=True)
    for _ in range(10):
        image = exact.product_at(x)(d)
        length = rho / (d * image).sum((1, 2), keepdim=True)
        wanted, r = wanted + length * d, r - length * image
        z = inverse * r
        last, rho = rho, (r * z).sum((1, 2), keepdim=True)
        d = z + rho / last * d
    limit = 1e-4 if dtype == torch.float32 else 1e-11
    assert float((state[0] - wanted).norm() / wanted.norm()) < limit
    assert float((state[1] - r).norm() / b.norm()) < limit
    assert torch.allclose(state[3][:, 0], rho.flatten(), rtol=100 * limit)
    assert state[3][:, 2].tolist() == [1.0] * BATCH
    assert float((state[3][:, 3] - r.norm(dim=(1, 2)) / b.norm(dim=(1, 2))).abs().max()) < limit


@pytest.mark.parametrize(
    ("cells", "kernel"), [((3, 2, 2), "auto"), ((40, 9, 9), "auto"), ((15, 3, 3), "block")],
    ids=["one patch", "several", "block"],
)  # fmt: skip
def test_an_environment_has_the_same_bits_alone(
    cells: tuple[int, int, int], kernel: str, dtype: torch.dtype, device: torch.device
) -> None:
    s, positions, right = system(dtype, device, cells=cells, contacts=True, kernel=kernel)
    threads = torch.get_num_threads()
    together = start(s, right)
    iterate(s, together, positions, 7)
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            for e in range(BATCH):
                own = environment(s, e)
                alone = start(own, right[e : e + 1])
                iterate(own, alone, positions[e : e + 1], 7)
                assert all(torch.equal(one[0], many[e]) for one, many in zip(alone, together, strict=True))
    finally:
        torch.set_num_threads(threads)


def test_calls_go_on_where_the_last_one_ended(dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device)
    once, twice = start(s, right), start(s, right)
    iterate(s, once, positions, 9)
    iterate(s, twice, positions, 4)
    iterate(s, twice, positions, 5)
    assert all(torch.equal(one, other) for one, other in zip(once, twice, strict=True))


@pytest.mark.parametrize("kernel", ["auto", "block"])
@pytest.mark.parametrize("factor", [2.0**-80, 2.0**70], ids=["tiny", "huge"])
def test_the_size_of_the_right_side_does_not_matter(
    factor: float, kernel: str, dtype: torch.dtype, device: torch.device
) -> None:
    """Nor where the squares of its numbers are no longer of its type; environments of several sizes, one zero."""
    s, positions, right = system(dtype, device, contacts=True, kernel=kernel)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-11
    sizes = torch.tensor([1.0, factor, 0.0], dtype=dtype, device=device)[:, None, None]
    wanted, _ = s.solve(positions, right, tolerance)
    for solve in (s.solve, s.solve_by_operations):
        found, error = solve(positions, sizes * right, tolerance)
        assert float(error.max()) <= tolerance
        for e in (0, 1):
            back = found[e].double() / float(sizes[e])
            assert float((back - wanted[e]).norm() / wanted[e].norm()) < 20 * tolerance
        assert not found[2].any()
    once, twice = start(s, sizes * right), start(s, sizes * right)
    iterate(s, once, positions, 9)
    iterate(s, twice, positions, 4)
    iterate(s, twice, positions, 5)
    assert all(torch.equal(one, other) for one, other in zip(once, twice, strict=True))


def test_an_environment_ends_by_itself(dtype: torch.dtype, device: torch.device) -> None:
    """One is done, one not positive, one not to go on at all: the first has its solution, the others what they had."""
    s, positions, right = system(dtype, device)
    inertia = s.inertia.clone()
    inertia[1] = -1e9
    s = replace(s, inertia=inertia)
    state = start(s, right)
    state[2][:] = s.inverse.unsqueeze(-1) * right
    state[3][2, 2] = 0.0
    before = [part.clone() for part in state]
    before[0][1] = 0.0
    tolerance = 1e-4
    iterate(s, state, positions, 500, tolerance)
    assert state[3][:, 2].tolist() == [0.0, 0.0, 0.0]
    own = environment(s, 0)
    left = right[:1] - own.product_at(positions[:1])(state[0][:1])
    assert 1e-6 * float(right[0].norm()) < float(left.norm()) <= 1.1 * tolerance * float(right[0].norm())
    for e in (1, 2):
        assert all(
            torch.equal(now[e].nan_to_num(7.0), then[e].nan_to_num(7.0))
            for now, then in zip(state[:3], before[:3], strict=True)
        )
    assert float(state[3][0, 3]) <= tolerance
    assert state[3][1:, 3].tolist() == [1.0, -1.0]


def test_environments_that_are_lost_keep_to_themselves(dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device)
    wanted, error = s.solve(positions, right, 1e-5)
    assert float(error.max()) <= 1e-5
    positions[1], right[2] = float("nan"), float("nan")
    solution, lost = s.solve(positions, right, 1e-5)
    assert torch.equal(solution[0], wanted[0])
    assert torch.equal(lost[0], error[0])
    assert lost[1:].isnan().all()


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("where", ["position", "right side"])
@pytest.mark.parametrize("way", [_System.solve, _System.solve_by_operations])
def test_one_number_that_is_none_leaves_no_error(
    way: Any, where: str, number: float, dtype: torch.dtype, device: torch.device
) -> None:
    """Also a position that no right side shows: nothing is asked of its environment."""
    s, positions, right = system(dtype, device)
    right[1] = 0.0
    (positions if where == "position" else right)[1, 5, 2] = number
    _, error = way(s, positions, right, 1e-5)
    assert error.isnan().tolist() == [False, True, False]


@pytest.mark.parametrize("way", [_System.solve, _System.solve_by_operations])
def test_nothing_asked_is_no_error(way: Any, dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device)
    right[1] = 0.0
    solution, error = way(s, positions, right, 1e-5)
    assert float(error[1]) == 0.0
    assert not solution[1].any()


def test_what_overflows_on_the_way_is_an_error(device: torch.device) -> None:
    """Everything that came was a number."""
    s, positions, right = system(torch.float32, device)
    right[1] *= 1e30
    _, error = s.solve(positions, right, 1e-5)
    assert not error.isnan().any()
    assert float(error[0]) <= 1e-5


def test_the_general_way_agrees(dtype: torch.dtype, device: torch.device) -> None:
    """By torch operations, as with levels and for large meshes on GPUs."""
    s, positions, right = system(dtype, device, contacts=True)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    solution, _ = s.solve(positions, right, tolerance)
    other, _ = s.solve_by_operations(positions, right, tolerance)
    assert float((solution - other).norm() / other.norm()) < 100 * tolerance


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("solution", lambda t: t[:, :-1], "solution must be"),
        ("residual", lambda t: t.to(torch.float16), "residual must be"),
        ("direction", lambda t: t.transpose(0, 1).contiguous().transpose(0, 1), "direction must be contiguous"),
        ("progress", lambda t: t.float(), "progress must be Double"),
        ("progress", lambda t: t[:, :2].contiguous(), "progress must be"),
        ("inertia", lambda t: t[:, :-1].contiguous(), "inertia must be"),
        ("inverse", lambda t: t.to(torch.float16), "inverse must be"),
        ("projector", lambda t: t[..., 0], "projector must be"),
        ("stiffness", lambda t: t[..., :-1], "stiffness must be"),
    ],
)
def test_bad_input(name: str, change: Any, said: str, device: torch.device) -> None:
    s, positions, right = system(torch.float64, device, contacts=True)
    assert s.projector is not None
    arguments = dict(zip(("solution", "residual", "direction", "progress"), start(s, right), strict=True))
    arguments |= {"positions": positions, "inertia": s.inertia, "inverse": s.inverse}
    arguments |= {"projector": s.projector, "stiffness": s.stiffness}
    arguments[name] = change(arguments[name])
    with pytest.raises((TypeError, ValueError), match=said):
        ops.conjugate_gradients_(*arguments.values(), s.plan, tolerance=1e-3, iterations=1)


@pytest.mark.parametrize(("numbers", "said"), [({"tolerance": -1.0}, "tolerance"), ({"iterations": -1}, "iterations")])
def test_bad_numbers(numbers: dict[str, Any], said: str, device: torch.device) -> None:
    s, positions, right = system(torch.float64, device)
    with pytest.raises(ValueError, match=said):
        iterate(s, start(s, right), positions, **{"iterations": 1, **numbers})
