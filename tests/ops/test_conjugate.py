"""The op behind the adjoint: conjugate gradients on the Hessian of a step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from conjugate_cases import BATCH, CELLS, MANY, environment, environments, given_of, noise, sliding_on, system
from conjugate_reference import System, conjugate_gradients, stabilised_gradients
from devices import missing_gpu
from torch import Tensor

pytestmark = pytest.mark.usefixtures("poisoned")

ops = torch.ops.torchpd

# of a multilevel solver: what M is on a GPU, an inverse or levels, depends on the mesh
LEVELS: dict[str, dict[str, Any]] = {
    "levels": {"levels": True},
    "levels above one": {"levels": True, "cells": (22, 9, 9)},
    "levels above two": {"levels": True, "cells": (54, 14, 14)},
}
SHAPES = {"any": {}, "several": {"cells": (22, 9, 9)}, **LEVELS, **MANY}
# "block" on a GPU: a thread has one pair, several, and several slots too; two blocks share a multiprocessor, or cannot
BLOCKS = {
    torch.float32: {"one": (3, 2, 2), "pairs": (15, 3, 3), "slots": (29, 3, 3), "alone": (9, 9, 9)},
    torch.float64: {"one": (3, 2, 2), "pairs": (9, 3, 3), "slots": (15, 3, 3), "alone": (6, 6, 6)},
}


def shapes(*names: str) -> pytest.MarkDecorator:
    """Those of the names that this machine tells apart: a CPU has no kernels to choose from."""
    of_kernels = {*MANY, *BLOCKS[torch.float32]}
    return pytest.mark.parametrize("shape", [name for name in names if not (missing_gpu() and name in of_kernels)])


def start(s: System, right: Tensor) -> list[Tensor]:
    """Solution, residual, direction and progress before the first iteration, which alone says what is in the others."""
    progress = torch.full((len(right), 4), -1.0, dtype=torch.float64, device=right.device)
    unwritten = torch.full_like(right, float("nan"))
    return [unwritten.clone(), right.clone(), unwritten, progress]


def iterate(s: System, state: list[Tensor], positions: Tensor, iterations: int, tolerance: float = 0.0) -> None:
    ops.conjugate_gradients_(
        *state, positions, s.inertia, s.inverse, s.projector, s.material, s.plan,
        tolerance=tolerance, iterations=iterations,
    )  # fmt: skip


@pytest.mark.parametrize("levels", [False, True])
@pytest.mark.parametrize("contacts", [False, True])
def test_the_solution_is_that_of_a_dense_matrix(
    contacts: bool, levels: bool, dtype: torch.dtype, device: torch.device
) -> None:
    s, positions, right = system(dtype, device, contacts=contacts, levels=levels)
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


@pytest.mark.parametrize("contacts", [False, True])
@shapes(*SHAPES, *BLOCKS[torch.float32])
def test_it_does_what_torch_operations_do(shape: str, contacts: bool, dtype: torch.dtype, device: torch.device) -> None:
    """Iteration by iteration; so few of them leave a residual that rounding has little part in."""
    options = SHAPES.get(shape, {"kernel": "block", "cells": BLOCKS[dtype].get(shape, CELLS)})
    iterations = 3 if shape in LEVELS else 10
    s, positions, right = system(dtype, device, contacts=contacts, **options)
    state = start(s, right)
    iterate(s, state, positions, iterations)
    exact, x, b = system(torch.float64, device, contacts=contacts, cells=options.get("cells", CELLS))
    # M as it is in either precision, where rounding may have chosen other aggregates
    wanted, r, rho = conjugate_gradients(
        exact.product_at(x), lambda field: s.preconditioner()(field.to(dtype)).double(), b, 0.0, iterations
    )
    limit = 1e-4 if dtype == torch.float32 else 1e-11
    assert float((state[0] - wanted).norm() / wanted.norm()) < limit
    assert float((state[1] - r).norm() / b.norm()) < limit
    assert torch.allclose(state[3][:, 0], rho, rtol=100 * limit)
    assert state[3][:, 2].tolist() == [1.0] * BATCH
    assert float((state[3][:, 3] - r.norm(dim=(1, 2)) / b.norm(dim=(1, 2))).abs().max()) < limit


@shapes("any", "several", "levels", "levels above one", "pairs", *MANY)
def test_an_environment_has_the_same_bits_alone(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    options = SHAPES.get(shape, {"kernel": "block", "cells": BLOCKS[dtype].get(shape, CELLS)})
    s, positions, right = system(dtype, device, contacts=True, **options)
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


@shapes("any", "levels", "grid")
def test_more_environments_than_a_device_has_at_a_time(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    """One after another in the same memory; some are lost, or not to go on, and they end when they are done."""
    s, positions, right = system(dtype, device, contacts=True, **SHAPES[shape])
    positions[2] = float("nan")
    few = start(s, right)
    iterate(s, few, positions, 400, 1e-4)
    index = torch.arange(300 if device.type == "cuda" else 9, device=device) % BATCH
    many = start(s, right[index])
    left_out = torch.arange(len(index), device=device) % 7 == 4
    many[3][left_out, 2] = 0.0
    iterate(environments(s, index), many, positions[index], 400, 1e-4)
    assert few[3][:2, 2].tolist() == [0.0, 0.0]
    for one, found in zip(few, many, strict=True):
        kept, wanted = found[~left_out], one[index[~left_out]]
        assert torch.equal(kept.nan_to_num(7.0), wanted.nan_to_num(7.0))
    assert torch.equal(many[1][left_out], right[index[left_out]])
    assert (many[3][left_out, 3] == -1.0).all()


@shapes("any", "levels", *MANY)
def test_calls_go_on_where_the_last_one_ended(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device, **SHAPES[shape])
    once, twice = start(s, right), start(s, right)
    iterate(s, once, positions, 9)
    iterate(s, twice, positions, 4)
    iterate(s, twice, positions, 5)
    assert all(torch.equal(one, other) for one, other in zip(once, twice, strict=True))


@shapes("any", "levels", *MANY)
@pytest.mark.parametrize("largest", [False, True], ids=["tiny", "huge"])
def test_the_size_of_the_right_side_does_not_matter(
    largest: bool, shape: str, dtype: torch.dtype, device: torch.device
) -> None:
    """Nor where the squares of its numbers are no longer of its type; environments of several sizes, one zero."""
    factor = 2.0**70 if largest else 2.0**-80
    if dtype == torch.float64:
        factor = factor**8
    s, positions, right = system(dtype, device, contacts=True, **SHAPES[shape])
    tolerance = 1e-5 if dtype == torch.float32 else 1e-11
    sizes = torch.tensor([1.0, factor, 0.0], dtype=dtype, device=device)[:, None, None]
    wanted, _ = s.solve(positions, right, tolerance)
    found, error = s.solve(positions, sizes * right, tolerance)
    assert float(error.max()) <= tolerance
    for e in (0, 1):
        back = found[e].double() / float(sizes[e])
        assert float((back - wanted[e]).norm() / wanted[e].norm()) < 20 * tolerance
    assert not found[2].any()
    if dtype == torch.float64:
        return  # the product of residuals that lies between two calls has no room
    once, twice = start(s, sizes * right), start(s, sizes * right)
    iterate(s, once, positions, 9)
    iterate(s, twice, positions, 4)
    iterate(s, twice, positions, 5)
    assert all(torch.equal(one, other) for one, other in zip(once, twice, strict=True))


@shapes("any", "levels", *MANY)
def test_an_environment_ends_by_itself(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    """One is done, one not positive, one not to go on at all: the first has its solution, the others what they had."""
    s, positions, right = system(dtype, device, **SHAPES[shape])
    inertia = s.inertia.clone()
    inertia[1] = -1e9
    s = replace(s, inertia=inertia)
    state = start(s, right)
    state[2][:] = s.preconditioner()(right)
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


@shapes("any", "levels", *MANY)
def test_environments_that_are_lost_keep_to_themselves(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device, **SHAPES[shape])
    wanted, error = s.solve(positions, right, 1e-5)
    assert float(error.max()) <= 1e-5
    positions[1], right[2] = float("nan"), float("nan")
    solution, lost = s.solve(positions, right, 1e-5)
    assert torch.equal(solution[0], wanted[0])
    assert torch.equal(lost[0], error[0])
    assert lost[1:].isnan().all()


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("where", ["position", "right side"])
@shapes("any", "levels", *MANY)
def test_one_number_that_is_none_leaves_no_error(
    shape: str, where: str, number: float, dtype: torch.dtype, device: torch.device
) -> None:
    """Also a position that no right side shows: nothing is asked of its environment."""
    s, positions, right = system(dtype, device, **SHAPES[shape])
    right[1] = 0.0
    (positions if where == "position" else right)[1, 5, 2] = number
    _, error = s.solve(positions, right, 1e-5)
    assert error.isnan().tolist() == [False, True, False]


@shapes("any", "levels", *MANY)
def test_nothing_asked_is_no_error(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    s, positions, right = system(dtype, device, **SHAPES[shape])
    right[1] = 0.0
    solution, error = s.solve(positions, right, 1e-5)
    assert float(error[1]) == 0.0
    assert not solution[1].any()


def test_what_overflows_on_the_way_is_an_error(device: torch.device) -> None:
    """Everything that came was a number."""
    s, positions, right = system(torch.float32, device)
    right[1] *= 1e30
    _, error = s.solve(positions, right, 1e-5)
    assert not error.isnan().any()
    assert float(error[0]) <= 1e-5


@shapes("any", "levels", *MANY)
def test_what_slides_is_harder_to_turn(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    """A direction of some vertices, whose square H has more."""
    s, positions, right = system(dtype, device, contacts=True, **SHAPES[shape])
    sliding = torch.zeros((*right.shape[:2], 5, 3), dtype=dtype, device=device)
    sliding[:, ::3, 2] = 20.0 * s.off_normals(noise(right.shape, dtype, 7).to(device))[:, ::3]
    across = sliding[:, :, 2]
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    given = (positions, right, s.inertia, s.inverse, s.projector, s.material, s.plan)
    found, _ = ops.conjugate_gradients(*given, sliding, tolerance=tolerance)
    plain, _ = ops.conjugate_gradients(*given, tolerance=tolerance)
    without = s.product_at(positions)
    wanted, *_ = conjugate_gradients(
        lambda d: without(d) + s.allowed(across * (across * d).sum(-1, keepdim=True)),
        s.preconditioner(),
        right,
        tolerance,
    )
    assert float((found - wanted).norm() / wanted.norm()) < 300 * tolerance
    assert float((plain - wanted).norm() / wanted.norm()) > 1e-2


@shapes("any", "several", "levels", "levels above one", "pairs", *MANY)
def test_friction_is_solved_for(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    """What comes is G^T y of the system that is not symmetric; where nothing slides the bits of the one that is."""
    options = SHAPES.get(shape, {"kernel": "block", "cells": BLOCKS[dtype].get(shape, CELLS)})
    s, positions, right = system(dtype, device, contacts=True, **options)
    sliding = sliding_on(s, right)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-11
    given = given_of(s, positions, right)
    found, error = ops.conjugate_gradients(*given, sliding, tolerance=tolerance)
    plain, _ = ops.conjugate_gradients(*given, tolerance=tolerance)
    assert float(error.max()) <= 10 * tolerance
    assert torch.equal(found[2], plain[2])
    exact, x, b = system(torch.float64, device, contacts=True, cells=options.get("cells", CELLS))
    for e in (0, 1):
        wide, own = sliding[e : e + 1].double(), environment(exact, e)
        y, products = stabilised_gradients(
            own.friction_product_at(x[e : e + 1], wide), own.preconditioner(), b[e : e + 1], 1e-13
        )
        assert products < 2000
        wanted = y + wide[..., 1, :] * (wide[..., 0, :] * y).sum(-1, keepdim=True)
        assert float((found[e] - wanted[0]).norm() / wanted.norm()) < 100 * tolerance
        assert float((plain[e] - wanted[0]).norm() / wanted.norm()) > 1e-2


@shapes("any", "several", "levels", "pairs", *MANY)
def test_friction_of_an_environment_has_the_same_bits_alone(
    shape: str, dtype: torch.dtype, device: torch.device
) -> None:
    """Beside one that nothing slides in and one that is lost, on one thread or two, and by units of any size."""
    options = SHAPES.get(shape, {"kernel": "block", "cells": BLOCKS[dtype].get(shape, CELLS)})
    s, positions, right = system(dtype, device, contacts=True, **options)
    sliding = sliding_on(s, right)
    right[1] *= 2.0**40
    positions[2] = float("nan")
    threads = torch.get_num_threads()
    together, _ = ops.conjugate_gradients(*given_of(s, positions, right), sliding, tolerance=1e-4)
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            for e in (0, 1):
                own = environment(s, e)
                given = given_of(own, positions[e : e + 1], right[e : e + 1])
                alone, error = ops.conjugate_gradients(*given, sliding[e : e + 1], tolerance=1e-4)
                assert float(error) <= 1e-3
                assert torch.equal(alone[0], together[e])
    finally:
        torch.set_num_threads(threads)


@shapes("any", "levels", *MANY)
def test_friction_that_jams_is_an_error(shape: str, dtype: torch.dtype, device: torch.device) -> None:
    """Vertices that their own friction presses ever harder: the residual says so, and what came is finite."""
    s, positions, right = system(dtype, device, contacts=True, **SHAPES[shape])
    sliding = sliding_on(s, right, push=1e4)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-11
    given = given_of(s, positions, right)
    found, error = ops.conjugate_gradients(*given, sliding, tolerance=tolerance)
    plain, _ = ops.conjugate_gradients(*given, tolerance=tolerance)
    assert torch.equal(found[2], plain[2])
    assert float(error[:2].min()) > 1e3 * tolerance
    assert found[:2].isfinite().all()


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("solution", lambda t: t[:, :-1], r"solution .*got Double \[3, 35, 3\]"),
        ("residual", lambda t: t.to(torch.float16), r"residual .*got Half \[3, 36, 3\]"),
        ("direction", lambda t: t.transpose(0, 1).contiguous().transpose(0, 1), r"direction .*got strides \[3, 9, 1\]"),
        ("progress", lambda t: t.float(), r"progress .*got Float \[3, 4\]"),
        ("progress", lambda t: t[:, :2].contiguous(), r"progress .*got Double \[3, 2\]"),
        ("inertia", lambda t: t[:, :-1].contiguous(), r"inertia .*got Double \[3, 35\]"),
        ("inverse", lambda t: t.to(torch.float16), r"inverse .*got Half \[3, 36\]"),
        ("projector", lambda t: t[..., 0], r"projector .*got Double \[3, 36, 3\]"),
        ("material", lambda t: [t[0][..., :-1], *t[1:]], r"stiffness .*got Double \[3, 71\]"),
        ("material", lambda t: t[1:], "material .*got 7"),
    ],
)
def test_bad_input(name: str, change: Any, said: str, device: torch.device) -> None:
    s, positions, right = system(torch.float64, device, contacts=True)
    assert s.projector is not None
    arguments: dict[str, Any] = dict(
        zip(("solution", "residual", "direction", "progress"), start(s, right), strict=True)
    )
    arguments |= {"positions": positions, "inertia": s.inertia, "inverse": s.inverse}
    arguments |= {"projector": s.projector, "material": s.material}
    arguments[name] = change(arguments[name])
    with pytest.raises((TypeError, ValueError), match=said):
        ops.conjugate_gradients_(*arguments.values(), s.plan, tolerance=1e-3, iterations=1)


@pytest.mark.parametrize(("numbers", "said"), [({"tolerance": -1.0}, "tolerance"), ({"iterations": -1}, "iterations")])
def test_bad_numbers(numbers: dict[str, Any], said: str, device: torch.device) -> None:
    s, positions, right = system(torch.float64, device)
    with pytest.raises(ValueError, match=said):
        iterate(s, start(s, right), positions, **{"iterations": 1, **numbers})
