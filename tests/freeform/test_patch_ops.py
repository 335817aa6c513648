"""The ops of free-form patches as citizens of PyTorch: opcheck, gradients, vmap, compile, bits, strides, refusals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from patch_cases import KIND_NAMES, KINDS, ball, central, patches_on, samples_on, tumbled
from torch import Tensor

import torchpd as pd

ops = torch.ops.torchpd
F32, F64 = torch.float32, torch.float64

Arguments = tuple[list[Any], dict[str, Any]]


def noise(shape: Any, like: Tensor, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(like)


def arguments(name: str, kind: tuple[str, str], dtype: torch.dtype, device: torch.device) -> Arguments:
    """Of an op: floating inputs first, lists last."""
    patches = patches_on(ball(0), kind, dtype=dtype, device=device, count=5)
    where = samples_on(patches, 9)
    lists = [*patches.lists, *where.lists]
    q, b = patches.quadrics, where.barycentrics
    quadrics = [q.amplitudes, q.centres, q.entries()]
    base, like = [patches.vertices, patches.directors], patches.vertices
    surface, phong = {"on_surface": kind[1] == "surface"}, {"phong": kind[0] == "phong"}
    transport = central(patches, stretch=(0.7, 1.2))
    h, slopes = patches.heights(where)
    vertices, count = len(patches.vertices), len(patches.triangles)
    if name == "height":
        return [*base, *quadrics, b, lists], {**surface, **phong}
    if name == "height_vjp":
        grads = [noise(9, like), noise((9, 2), like)]
        return [*grads, h, *base, *quadrics, b, lists], {**surface, **phong}
    pose = [noise((2, vertices, 3), like), noise((2, vertices, 3, 3), like, 1)]
    if name == "surface":
        return [*pose, *base, h, slopes, b, lists], phong
    if name == "surface_vjp":
        grads = [noise((2, 9, 3), like, 2), noise((2, 9, 2, 3), like, 3)]
        return [*grads, *pose, *base, h, slopes, b, lists], phong
    positions = tumbled(transport, 2, 0.3)
    bounds = {"lower": 0.7, "upper": 1.2}
    gradients = noise((2, count, 3, 3), like, 4)
    if name == "deformation":
        return [positions, transport.inverse_rest, gradients, transport.constraints], bounds
    if name == "deformation_vjp":
        return [gradients, positions, transport.inverse_rest, gradients, transport.constraints], bounds
    if name == "frames":
        return [gradients, transport.areas, lists], {}
    if name == "frames_vjp":
        frames = noise((2, vertices, 3, 3), like, 5)
        return [frames, ops.patch_frames(gradients, transport.areas, lists), gradients, transport.areas, lists], {}
    corners = positions[:, :vertices][:, patches.triangles.long()[where.patch.long()]]
    points = corners.mean(2) + 0.2 * noise((2, 9, 3), like, 6)
    field = [points, positions[:, :vertices].contiguous(), noise(5, like, 7), 0.3 * noise((2, 5, 4, 4), like, 8)]
    options = {"thickness": 0.1, "clip": kind[0] == "flat"}
    return ([*field, lists] if name == "field" else [noise((2, 9), like, 9), *field, lists]), options


FORWARD = ("height", "surface", "field", "deformation", "frames")
NAMES = (*FORWARD, *(f"{name}_vjp" for name in FORWARD))


def wanted(args: list[Any]) -> list[Any]:
    return [a.detach().clone().requires_grad_() if isinstance(a, Tensor) else a for a in args]


@pytest.mark.parametrize("name", NAMES)
def test_opcheck(name: str, dtype: torch.dtype, device: torch.device) -> None:
    args, options = arguments(name, ("phong", "surface"), dtype, device)
    inputs = wanted(args) if name in FORWARD else args
    report = torch.library.opcheck(getattr(ops, f"patch_{name}").default, tuple(inputs), options)
    assert set(report.values()) == {"SUCCESS"}


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
@pytest.mark.parametrize("name", FORWARD)
def test_gradients(name: str, kind: tuple[str, str], device: torch.device) -> None:
    """Of every output for every floating input, against central differences."""
    args, options = arguments(name, kind, F64, device)
    *leaves, lists = wanted(args)
    assert torch.autograd.gradcheck(lambda *inputs: getattr(ops, f"patch_{name}")(*inputs, lists, **options), leaves)


@pytest.mark.parametrize("mode", ["transport", "rotation"])
def test_gradient_through_everything(mode: str, device: torch.device) -> None:
    """From positions, quadrics and the base to points and normals."""
    patches = patches_on(ball(0), ("phong", "surface"), device=device, count=5)
    transport = central(patches, mode=mode)
    where = samples_on(patches, 6)
    q = patches.quadrics

    def run(positions: Tensor, a: Tensor, c: Tensor, m: Tensor, v: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
        shaped = patches.with_shape(v, n).with_quadrics(pd.Quadrics(a, c, m), keep_lists=True)
        found = shaped.surface(where, transport(positions))
        return found.points, found.normals

    leaves = [tumbled(transport, 2), q.amplitudes, q.centres, q.factors, patches.vertices, patches.directors]
    assert torch.autograd.gradcheck(run, wanted(leaves), fast_mode=True)


def test_field_has_gradients_where_matrices_are_shared(device: torch.device) -> None:
    args, options = arguments("field", ("flat", "base"), F64, device)
    points, positions, amplitudes, matrices, lists = args
    leaves = wanted([points, positions, amplitudes, matrices[:1]])
    assert torch.autograd.gradcheck(lambda *inputs: ops.patch_field(*inputs, lists, **options), leaves)


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("name", NAMES)
def test_the_same_bits_every_time_and_in_any_batch(name: str, dtype: torch.dtype, device: torch.device) -> None:
    args, options = arguments(name, ("phong", "surface"), dtype, device)
    op = getattr(ops, f"patch_{name}")
    first, again = op(*args, **options), op(*args, **options)
    tuples = (first, again) if isinstance(first, tuple) else ((first,), (again,))
    assert all(bool(t.isfinite().all()) for t in tuples[0])
    assert all(torch.equal(a, b) for a, b in zip(*tuples, strict=True))
    if name in FORWARD[1:]:
        batched = {"surface": (0, 1), "field": (0, 1, 3), "deformation": (0, 2), "frames": (0,)}[name]
        alone = op(*(a[1:] if n in batched else a for n, a in enumerate(args)), **options)
        whole = first if isinstance(first, tuple) else (first,)
        single = alone if isinstance(alone, tuple) else (alone,)
        assert all(torch.equal(a[1:], b) for a, b in zip(whole, single, strict=True))


@pytest.mark.usefixtures("two_threads")
def test_the_same_bits_on_any_number_of_threads(dtype: torch.dtype) -> None:
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        args, options = arguments("height_vjp", ("phong", "surface"), dtype, torch.device("cpu"))
        patches = patches_on(dtype=dtype)
        results.append([*ops.patch_height_vjp(*args, **options), *patches.surface(samples_on(patches, 5000))])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_strides_do_not_matter(name: str, dtype: torch.dtype, device: torch.device) -> None:
    args, options = arguments(name, ("flat", "surface"), dtype, device)
    op = getattr(ops, f"patch_{name}")

    def strided(t: Any) -> Any:
        return t.repeat_interleave(2, dim=0)[::2] if isinstance(t, Tensor) else t

    one, two = op(*args, **options), op(*map(strided, args), **options)
    pairs = zip(one, two, strict=True) if isinstance(one, tuple) else [(one, two)]
    assert all(torch.equal(a, b) for a, b in pairs)


def test_nothing_to_do(dtype: torch.dtype, device: torch.device) -> None:
    """No samples, no quadrics, no poses: empty results and zero gradients."""
    patches = patches_on(dtype=dtype, device=device)
    transport = central(patches)
    where = samples_on(patches, 0)
    assert patches.surface(where).points.shape == (0, 3)
    assert patches.surface(where, transport(tumbled(transport))).normals.shape == (3, 0, 3)
    nobody = transport(tumbled(transport)[:0])
    assert patches.surface(samples_on(patches, 4), nobody).points.shape == (0, 4, 3)
    assert patches.field(torch.empty(0, 3, dtype=dtype, device=device), torch.empty(0, dtype=torch.int64)).shape == (0,)
    bare = patches.with_quadrics(pd.Quadrics.none(dtype, device))
    h, slopes = bare.heights(samples_on(bare, 4))
    assert not h.any()
    assert not slopes.any()
    factors = patches.quadrics.factors.clone().requires_grad_()
    trained = patches.with_quadrics(pd.Quadrics(patches.quadrics.amplitudes, patches.quadrics.centres, factors))
    trained.heights(where)[0].sum().backward()
    assert factors.grad is not None
    assert not factors.grad.any()


@pytest.mark.parametrize("name", ["surface", "field", "deformation", "frames"])
def test_vmap_joins_the_batch(name: str, dtype: torch.dtype, device: torch.device) -> None:
    """Three copies of a batch of two, changed a little: one by one, the same bits."""
    args, options = arguments(name, ("flat", "base"), dtype, device)
    op = getattr(ops, f"patch_{name}")
    batched = {"surface": (0, 1), "field": (0, 1, 3), "deformation": (0, 2), "frames": (0,)}[name]
    for mapped in (batched, batched[:1]):
        many = [torch.stack([a, 1.1 * a, 0.9 * a]) if n in mapped else a for n, a in enumerate(args)]
        dims = tuple(0 if n in mapped else None for n in range(len(args) - 1))
        found = torch.func.vmap(lambda *inputs: op(*inputs, args[-1], **options), in_dims=dims)(*many[:-1])
        for copy in range(3):
            alone = op(*(a[copy] if n in mapped else a for n, a in enumerate(many)), **options)
            pairs = zip(found, alone, strict=True) if isinstance(found, tuple) else [(found, alone)]
            assert all(torch.equal(a[copy], b) for a, b in pairs)


def test_vmap_of_shared_and_of_own_matrices(dtype: torch.dtype, device: torch.device) -> None:
    args, options = arguments("field", ("flat", "base"), dtype, device)
    points, positions, amplitudes, matrices, lists = args
    many = torch.stack([points, points.flip(1)])
    for W in (matrices[:1], matrices):
        found = torch.func.vmap(lambda x, W=W: ops.patch_field(x, positions, amplitudes, W, lists, **options))(many)
        for x, one in zip(many, found, strict=True):
            assert torch.equal(one, ops.patch_field(x, positions, amplitudes, W, lists, **options))
    mapped = torch.stack([matrices[:1], 2.0 * matrices[:1]])
    found = torch.func.vmap(lambda W: ops.patch_field(points, positions, amplitudes, W, lists, **options))(mapped)
    assert torch.equal(found[1], ops.patch_field(points, positions, amplitudes, mapped[1], lists, **options))


def test_jacobian_by_vmap(device: torch.device) -> None:
    """Of heights for amplitudes: R_i / a_i at each sample. Its rows are the adjoint's, mapped."""
    patches = patches_on(ball(0), device=device, count=5)
    where = samples_on(patches, 7)
    q = patches.quadrics

    a = q.amplitudes.clone().requires_grad_()
    h = patches.with_quadrics(pd.Quadrics(a, q.centres, q.factors), keep_lists=True).heights(where)[0]
    rows = torch.eye(len(h), dtype=F64, device=device)
    jacobian = torch.func.vmap(lambda row: torch.autograd.grad(h, a, row, retain_graph=True)[0])(rows)
    (older,) = torch.autograd.grad(h, a, rows, retain_graph=True, is_grads_batched=True)
    assert torch.equal(older, jacobian)
    bare = patches.with_quadrics(pd.Quadrics.none(F64, device))
    torch.testing.assert_close(jacobian, q.values(bare.surface(where).points) / q.amplitudes, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_compile(kind: tuple[str, str], device: torch.device) -> None:
    """Forward and backward in one graph, to the rounding of the parts that torch fuses."""
    patches = patches_on(kind=kind, device=device)
    transport = central(patches)
    where = samples_on(patches, 12)
    q = patches.quadrics

    def loss(positions: Tensor, amplitudes: Tensor) -> Tensor:
        raised = patches.with_quadrics(pd.Quadrics(amplitudes, q.centres, q.factors), keep_lists=True)
        return raised.surface(where, transport(positions)).normals[..., 0].sum()

    def slopes(run: Callable[..., Tensor]) -> tuple[Tensor, ...]:
        leaves = wanted([tumbled(transport), q.amplitudes])
        value = run(*leaves)
        return (value.detach(), *torch.autograd.grad(value, leaves))

    torch._dynamo.reset()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for found, expected in zip(slopes(compiled), slopes(loss), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_second_derivatives_are_refused() -> None:
    patches = patches_on(ball(0), count=5)
    amplitudes = patches.quadrics.amplitudes.clone().requires_grad_()
    trained = pd.Quadrics(amplitudes, patches.quadrics.centres, patches.quadrics.factors)
    h = patches.with_quadrics(trained).heights(samples_on(patches))[0]
    (slope,) = torch.autograd.grad(h.square().sum(), amplitudes, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives of free-form patches are not provided"):
        slope.sum().backward()


@pytest.mark.parametrize(
    ("name", "number", "change", "error", "message"),
    [
        ("height", 2, lambda t: t.float(), TypeError, r"amplitudes .*got Float \[5\]"),
        ("height", 3, lambda t: t[:, :2], ValueError, r"centres .*got Double \[5, 2\]"),
        ("height", 5, lambda t: t[:4], ValueError, r"barycentrics .*got Double \[4, 3\]"),
        ("height", 6, lambda t: t[:4], ValueError, "lists .*got 4"),
        ("height", 6, lambda t: [t[0].long(), *t[1:]], TypeError, r"lists.triangles .*got Long \[20, 3\]"),
        ("height", 6, lambda t: [t[0][:3], *t[1:]], ValueError, r"lists.triangles .*got Int \[3, 3\]"),
        ("surface", 0, lambda t: t[0], ValueError, r"positions .*got Double \[12, 3\]"),
        ("surface", 1, lambda t: t[:1], ValueError, r"frames .*got Double \[1, 12, 3, 3\]"),
        ("field", 3, lambda t: torch.cat([t, t]), ValueError, r"matrices .*got Double \[4, 5, 4, 4\]"),
        ("deformation", 2, lambda t: t[:, :2], ValueError, r"fallback .*got Double \[2, 2, 3, 3\]"),
        (
            "deformation",
            3,
            lambda t: t[:2],
            ValueError,
            "constraints .*got 2; .*PatchTransport.constraints",
        ),
        (
            "deformation",
            3,
            lambda t: [*t[:2], t[2][:5]],
            ValueError,
            r"point_tet must be .* PatchTransport.constraints",
        ),
        ("frames", 1, lambda t: t[:2], ValueError, r"weights .*got Double \[2\]"),
    ],
)
def test_refusals(name: str, number: int, change: Any, error: Any, message: str) -> None:
    args, options = arguments(name, ("flat", "base"), F64, torch.device("cpu"))
    args[number] = change(args[number])
    with pytest.raises(error, match=message):
        getattr(ops, f"patch_{name}")(*args, **options)


def test_other_refusals() -> None:
    args, options = arguments("field", ("flat", "base"), F64, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"thickness .*got -1"):
        ops.patch_field(*args, **{**options, "thickness": -1.0})
    args, options = arguments("deformation", ("flat", "base"), F64, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"lower .*got 0"):
        ops.patch_deformation(*args, **{**options, "lower": 0.0})
    gradients, areas, lists = arguments("frames", ("flat", "base"), F64, torch.device("cpu"))[0]
    mapped = [torch.stack([t, t]) for t in lists]
    with pytest.raises(ValueError, match=r"lists of patches.*vmap"):
        torch.func.vmap(ops.patch_frames, in_dims=(None, None, [0] * 11))(gradients, areas, mapped)
