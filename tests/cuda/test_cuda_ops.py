"""The ops on a GPU as citizens of PyTorch: fields, derivatives, compile, opcheck, launches, refusals, large tensors."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from devices import require_gpu
from matrix_classes import CLASSES
from on_gpu import (
    DTYPES,
    GPU,
    KERNELS,
    bar,
    compiled_for,
    crowd,
    device_work,
    full_on_gpu,
    has_clusters,
    moved,
    on_gpu,
    relative,
    small_on_gpu,
    still_works,
)
from op_samples import OPS, samples
from runs import (
    ULP,
    material_with,
    moving,
    noise,
    plan_of,
    same_bits,
    settings_of,
    simulate,
    simulator,
    small,
    small_case,
    state_of,
)
from torch import Tensor

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.plan import kernel_benchmark

require_gpu()
ops = torch.ops.torchpd

# ---- fields and rotations


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("batch", [1, 7])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", ["small", "bar", "several patches", "crowd"])
def test_fields_are_those_of_the_cpu(name: str, kernel: str, batch: int, precision: str) -> None:
    """Energies, gradient, Hessian product and diagonal, with one stiffness for all and one for each environment."""
    if name == "several patches" and kernel in ("block", "cluster"):
        pytest.skip("for a stream with several patches: more than a block or a cluster holds")
    dtype = DTYPES[precision]
    bars = {"bar": (16, 3, 3), "several patches": (30, 4, 4)}
    case = bar(bars[name]) if name in bars else {"small": small_case, "crowd": crowd}[name]()
    sim, exact = on_gpu(case, dtype, kernel), simulator(case, torch.float64)
    assert sim.plan.patches > 1 or name != "several patches"
    rest = exact.rest_state(batch).positions
    x = (rest + 0.01 * noise(rest, 1)).to(dtype)
    direction = noise(rest, 2).to(dtype)
    plan, sure = plan_of(sim), plan_of(exact)
    own = (exact.stiffness.detach() * torch.linspace(0.5, 2.0, batch).double()[:, None]).to(dtype)
    # as in test_ops: grad N of slivers is up to 40 times the inverse of an edge, and some fifty operations follow; the
    # closed form of the rotation is trusted where it magnifies the rounding up to a thousand times, on both devices
    limit = (40 * 50 + 2 * 1000) * ULP[dtype]
    for w in (sim.stiffness.detach().cpu(), own):
        here = [t.to(GPU) for t in (x, direction, w)]
        there = [t.double() for t in (x, direction, w)]
        for field in ("gradient", "element_energy"):
            found = getattr(ops, field)(here[0], material_with(sim, here[2]), plan)
            wanted = getattr(ops, field)(there[0], material_with(exact, there[2]), sure)
            assert relative(found, wanted) <= limit, field
        for field in ("hessian_product", "element_energy_product"):
            found = getattr(ops, field)(*here[:2], material_with(sim, here[2]), plan)
            wanted = getattr(ops, field)(*there[:2], material_with(exact, there[2]), sure)
            assert relative(found, wanted) <= limit, field
        for weighted in (True, False):
            found = ops.elastic_diagonal(material_with(sim, here[2]), plan, weighted=weighted)
            expected = ops.elastic_diagonal(material_with(exact, there[2]), sure, weighted=weighted)
            assert found.shape == expected.shape
            # positive terms only: nothing cancels, in no entry
            error = ((found.cpu().double() - expected) / expected).abs().max()
            assert float(error) <= 50 * ULP[dtype] + 1e3 * ULP[torch.float64]


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", KERNELS)
def test_fields_have_the_same_bits_in_any_batch(kernel: str, precision: str) -> None:
    sim, state = small_on_gpu(DTYPES[precision], kernel, batch=4096)
    x, d, w, plan = state.positions, noise(state.positions), sim.stiffness.detach(), plan_of(sim)
    fields: tuple[Callable[[slice], Tensor], ...] = (
        lambda s: ops.gradient(x[s], material_with(sim, w), plan),
        lambda s: ops.element_energy(x[s], material_with(sim, w), plan),
        lambda s: ops.hessian_product(x[s], d[s], material_with(sim, w), plan),
        lambda s: ops.element_energy_product(x[s], d[s], material_with(sim, w), plan),
    )
    for field in fields:
        together = field(slice(None))
        assert torch.equal(field(slice(None)), together)
        for item in (0, 149, 2047, 4095):
            assert torch.equal(field(slice(item, item + 1))[0], together[item])


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("count", [1, 7, 3000])
def test_rotations_are_those_of_the_cpu(count: int, precision: str) -> None:
    """Singular values of 0.1 and more: sums of two above 0.2 divide the rounding of F, 4 ulp of |F| = 6."""
    dtype = DTYPES[precision]
    given = torch.tensor(CLASSES["large strain"][:count], dtype=dtype)
    found, expected = pd.nearest_rotation(given.to(GPU)), pd.nearest_rotation(given.double())
    limit = 4 * 6 / 0.2 * torch.finfo(dtype).eps
    assert float((found.cpu() - expected).abs().max()) <= limit
    d = noise(given)
    found = ops.rotation_differential(given.to(GPU), d.to(GPU))
    expected = ops.rotation_differential(given.double(), d.double())
    # divided by the sum once more, and |dF| is up to 5
    assert relative(found, expected) <= 5 / 0.2 * limit


# ---- derivatives


def gradients(sim: pd.Simulator, state: pd.State, forces: Tensor) -> dict[str, Tensor]:
    """Of a step and of a rollout, for everything that has them."""
    inputs = {"positions": state.positions, "velocities": state.velocities, "forces": forces}
    leaves = {name: t.detach().clone().requires_grad_() for name, t in inputs.items()}
    trained = ("stiffness", "masses", "gravity", "damping", "pin_stiffness", "pin_targets")
    for name in trained:
        getattr(sim, name).requires_grad_()
        leaves[name] = getattr(sim, name)
    start = pd.State(leaves["positions"], leaves["velocities"])
    after = sim(start, leaves["forces"])
    track = sim.rollout(start, 3, forces=leaves["forces"])
    weights = [noise(t, 10 + n) for n, t in enumerate((*after, *track[:2]))]
    loss = sum((w * t).sum() for w, t in zip(weights, (*after, *track[:2]), strict=True))
    loss = loss + 1e-3 * sim.energy(after.positions).sum()
    found = torch.autograd.grad(loss, list(leaves.values()))
    for name in trained:
        getattr(sim, name).requires_grad_(False)
    return dict(zip(leaves, found, strict=True))


@pytest.mark.parametrize("kernel", KERNELS)
def test_gradients_are_those_of_the_cpu(kernel: str) -> None:
    """float64, near the equilibrium of every step: the adjoint's error follows the residual, and that of its solve."""
    case = bar((6, 2, 2), pd.Gravity(), pd.Damping(0.5))
    body = case.scene.solids[0]
    scene = pd.Scene(*case.scene.parts, pd.Pin(body, [len(case.positions) - 1], 1e3))
    options = {"dtype": torch.float64, "iterations": 600, "progress": False}
    with compiled_for(kernel) as name:
        sim = pd.Simulator(scene, 1 / 60, kernel=name, **options).to(GPU)
    plain = pd.Simulator(scene, 1 / 60, **options)
    state = plain.rest_state(2)
    state = pd.State(state.positions + 0.002 * noise(state.positions, 4), 0.3 * noise(state.positions, 5))
    forces = noise(state.positions, 6)
    found, expected = gradients(sim, moved(state, GPU), forces.to(GPU)), gradients(plain, state, forces)
    for name, want in expected.items():
        finite = want.isfinite().cpu()
        assert torch.equal(found[name].isfinite().cpu(), finite), name
        assert relative(found[name].cpu()[finite], want[finite]) <= 1e-6, name


@pytest.mark.parametrize("kernel", KERNELS)
def test_gradcheck_of_the_energy(kernel: str) -> None:
    sim, state = small_on_gpu(torch.float64, kernel, batch=2)
    x = state.positions.clone().requires_grad_()
    unit = (sim.stiffness.detach() / 1e4).clone().requires_grad_()
    plan = plan_of(sim)

    def energy(positions: Tensor, w: Tensor) -> Tensor:
        return ops.element_energy(positions, material_with(sim, 1e4 * w), plan).sum(-1)

    assert torch.autograd.gradcheck(energy, (x, unit), fast_mode=True, rtol=1e-5)
    assert torch.autograd.gradgradcheck(energy, (x, unit), fast_mode=True, rtol=1e-4)


# ---- torch.compile and opcheck


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", OPS)
def test_opcheck(name: str, kernel: str) -> None:
    for dtype in DTYPES.values():
        with compiled_for(kernel) as known:
            arguments, keywords = samples(name, dtype, GPU, kernel=known)
        report = torch.library.opcheck(getattr(ops, name).default, arguments, keywords)
        assert set(report.values()) == {"SUCCESS"}


@pytest.mark.parametrize("dynamic", [False, True])
@pytest.mark.parametrize("kernel", KERNELS)
def test_compiled_step_and_rollout(kernel: str, dynamic: bool) -> None:
    torch._dynamo.reset()
    sim, state = small_on_gpu(torch.float32, kernel)
    forces = noise(state.positions)

    def advance(x: Tensor, v: Tensor, f: Tensor) -> tuple[Tensor, Tensor]:
        after = sim(pd.State(2.0 * x - x, v), 1.0 * f)
        return after.positions + 1.0, sim.rollout(after, 4, every=2).velocities

    compiled = torch.compile(advance, fullgraph=True, backend="aot_eager", dynamic=dynamic)
    for found, expected in zip(compiled(*state, forces), advance(*state, forces), strict=True):
        assert torch.equal(found, expected)


# ---- what is launched


def ours(names: list[str]) -> list[str]:
    """The work that is not torch's."""
    return [name for name in names if "at::native" not in name]


@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("kernel", ["block", "cluster"])
def test_a_step_is_one_launch(kernel: str, precision: str) -> None:
    sim, state = small_on_gpu(DTYPES[precision], kernel, batch=9)
    assert (sim.plan.patches > 1) == (kernel == "cluster")
    assert len(device_work(lambda: sim(state))) == 1
    assert len(device_work(lambda: sim.step_(state))) == 1
    # torch's own kernels make the columns of the report that every track carries
    assert len(ours(device_work(lambda: sim.rollout(state, 20)))) == 1
    # the report is a pass of its own: u, three fields with their weights, vertices, their sums; then whole numbers,
    # `converged` and the three constants of scenes without Contact
    assert len(device_work(lambda: sim(state, return_info=True))) <= 1 + 9 + 5


@pytest.mark.parametrize("cells", [(2, 2, 2), (8, 5, 5)])
@pytest.mark.parametrize("precision", DTYPES)
def test_patches_of_small_meshes_form_a_cluster(cells: tuple[int, int, int], precision: str) -> None:
    """Two patches, and as many as a cluster has at most; the name of a kernel tells."""
    case = bar(cells, pd.Gravity())
    sim = on_gpu(case, DTYPES[precision], "cluster")
    assert sim.plan.patches == (2 if cells == (2, 2, 2) else properties_of(GPU).cluster)
    state = state_of(case, sim, 3)
    (name,) = ours(device_work(lambda: sim(state)))
    assert "Blocks)1" in name or "Blocks::cluster" in name, name


@pytest.mark.parametrize("precision", DTYPES)
def test_a_step_of_many_patches_is_two_launches(precision: str) -> None:
    case = bar((20, 4, 4))
    sim = on_gpu(case, DTYPES[precision], "grid")
    assert sim.plan.patches > 16
    state = state_of(case, sim, 5)
    for call in (lambda: sim(state), lambda: sim.step_(state), lambda: sim.rollout(state, 20, 10)):
        names = ours(device_work(call))
        assert len(names) == 2, names
        assert "memset" in names[0].lower(), names


def launches(*parts: Any, pinned: bool = True, steps: int = 1) -> int:
    case = bar((8, 2, 2), *parts, pinned=pinned)
    sim = on_gpu(case, torch.float32, "stream", iterations=4)
    state = state_of(case, sim)
    return len(device_work(lambda: sim.rollout(state, steps)))


def test_what_a_scene_does_not_have_is_not_launched() -> None:
    ground, ball = pd.Ground(-0.1, friction=0.5), pd.Sphere((0.5, -0.5, 0.1), 0.1)
    bare = launches()
    assert launches(pd.Gravity(), pd.Damping(1.0)) == bare
    assert launches(ground, ball) == bare  # contacts are within the passes
    free = launches(pinned=False)
    assert free > bare
    # one launch moves pieces, whatever they touch; contacts take one pass more over the elements, for their forces
    assert launches(ground, pinned=False) == free + 1
    two, touching = launches(steps=2), launches(ball, steps=2)
    assert bare < two < 2 * bare + 1  # loading and weighing are done once
    assert touching > two  # balls move on between steps


# ---- refusals


def test_plan_and_state_must_be_together() -> None:
    sim, state = small_on_gpu(torch.float32, "block")
    plain, there = small(torch.float32)
    with pytest.raises(TypeError, match=r"state must be torch.float32 on cpu"):
        plain(state)
    with pytest.raises(TypeError, match=r"state must be torch.float32 on cuda:0"):
        sim(there)
    numbers = settings_of(sim)
    with pytest.raises((ValueError, TypeError), match="plan"):
        ops.step(*state, None, None, sim.material(), plan_of(plain), **numbers)
    with pytest.raises((ValueError, TypeError), match="plan"):
        ops.step(*there, None, None, plain.material(), plan_of(sim), **numbers)
    with pytest.raises(ValueError, match="must be on cuda:0 like positions"):
        ops.step(*state, None, None, plain.material(), plan_of(sim), **numbers)
    with pytest.raises((ValueError, RuntimeError), match=r"cuda|same device"):
        ops.step(there.positions, state.velocities, None, None, sim.material(), plan_of(sim), **numbers)
    with pytest.raises((ValueError, RuntimeError), match=r"cuda|same device"):
        ops.step(*state, noise(there.positions), None, sim.material(), plan_of(sim), **numbers)
    arrays = plan_of(sim)
    for number, array in enumerate(arrays[1:], start=1):
        wrong = [array.cpu() if n == number else a for n, a in enumerate(arrays)]
        with pytest.raises(ValueError, match=r"plan\.\w+ must be on cuda:0 like positions"):
            ops.step(*state, None, None, sim.material(), wrong, **numbers)
    with pytest.raises(ValueError, match=r"plan\.sizes must be on cpu"):
        ops.step(*state, None, None, sim.material(), [arrays[0].cuda(), *arrays[1:]], **numbers)
    still_works()


@pytest.mark.parametrize("kernel", [kernel for kernel in KERNELS if kernel != "stream"])
def test_levels_are_refused_where_no_kernel_knows_them(kernel: str) -> None:
    sim, state = small_on_gpu(torch.float32, kernel)
    plain, whole = plan_of(sim), plan_of(simulator(small_case(), torch.float32, GPU, solver=pd.Multilevel()))
    with pytest.raises(ValueError, match=r"plan must be one for kernel 3 \(stream\) where .*, got kernel [012]"):
        ops.gradient(state.positions, sim.material(), [*plain, *whole[len(plain) :]])
    still_works()


def test_other_precisions_are_refused() -> None:
    sim, state = small_on_gpu(torch.float32, "block")
    for wrong in (torch.float16, torch.bfloat16):
        with pytest.raises(TypeError, match="float32 or"):
            sim.to(wrong)
        with pytest.raises(TypeError, match=r"state must be torch\.float32"):
            sim(moved(state, GPU, wrong))
        with pytest.raises(TypeError, match="float32 or float64"):
            ops.gradient(state.positions.to(wrong), sim.material(), plan_of(sim))
        with pytest.raises(TypeError, match="float32 or float64"):
            pd.nearest_rotation(torch.eye(3, device=GPU, dtype=wrong))
    still_works()


def test_a_mesh_that_does_not_fit_is_refused_and_auto_finds_a_kernel() -> None:
    case = bar((40, 8, 8))  # 15360 tetrahedra: no block has the memory
    with pytest.raises((ValueError, RuntimeError), match="block"):  # when it is compiled for the device, or moved there
        simulator(case, torch.float32, GPU, kernel="block")
    still_works()
    sim = simulator(case, torch.float32, GPU)
    assert sim.plan.kernel in ("grid", "stream")
    with pytest.raises(ValueError, match="cluster"):
        simulator(case, torch.float32, GPU, kernel="cluster")
    assert bool(sim(state_of(case, sim)).positions.isfinite().all())
    small = bar((6, 2, 2))
    assert simulator(small, torch.float32, GPU).plan.kernel == "block"
    # what few environments get is what one may ask for
    few = simulator(small, torch.float32, GPU, batch=1)
    assert few.plan.kernel == ("cluster" if has_clusters() else "block")
    asked = simulator(small, torch.float32, GPU, kernel=few.plan.kernel, batch=1)
    assert same_bits(few(few.rest_state()), asked(asked.rest_state()))
    assert "; for a batch of 1; " in str(few)
    assert simulator(small, torch.float32, GPU, batch=1024).plan.kernel == "block"
    with pytest.raises((ValueError, TypeError), match="kernel"):
        simulator(case, torch.float32, GPU, kernel="wide")


@pytest.mark.parametrize("kernel", KERNELS)
def test_strides_do_not_matter(kernel: str) -> None:
    sim, state = small_on_gpu(torch.float32, kernel)
    forces = noise(state.positions)
    expected = sim(state, forces, start=state.positions)

    def strided(t: Tensor) -> Tensor:
        return t.permute(2, 0, 1).contiguous().permute(1, 2, 0)

    x, v, f = (strided(t) for t in (*state, forces))
    assert not x.is_contiguous()
    assert same_bits(sim(pd.State(x, v), f, start=x), expected)
    with pytest.raises(ValueError, match="step_: positions and velocities must be contiguous"):
        sim.step_(pd.State(x, v))
    assert sim(sim.rest_state(0)).positions.shape == (0, sim.vertices, 3)
    still_works()


def test_there_and_back_again() -> None:
    """A simulator that comes back to the CPU is the one that never left."""
    sim = simulate(torch.float32)
    state = moving(sim)
    expected = sim(state)
    there = sim.to(GPU)
    assert there.material()[0].is_cuda
    there(moved(state, GPU))
    back = there.to("cpu")
    assert back.plan.device.type == "cpu"
    assert same_bits(back(state), expected)


# ---- large tensors


@pytest.mark.slow
@pytest.mark.skipif("TORCHPD_LARGE_TESTS" not in os.environ, reason="TORCHPD_LARGE_TESTS=1 runs it; needs 40 GB")
@pytest.mark.parametrize("kernel", KERNELS)
def test_more_numbers_than_32_bits_count(kernel: str) -> None:
    sim = full_on_gpu(torch.float32, kernel, iterations=2)
    batch = (1 << 31) // (3 * sim.vertices) + 1000
    needed = batch * sim.vertices * (24 + (100 if kernel == "stream" else 0)) + batch * 48
    free, _ = torch.cuda.mem_get_info()
    if free < 1.1 * needed:
        pytest.skip(f"needs {needed / 1e9:.0f} GB")
    one = moving(sim, 1)
    expected = sim(one)
    state = pd.State(*(t.expand(batch, -1, -1).clone() for t in one))
    sim.step_(state)
    for item in (0, batch // 2, batch - 1):
        assert torch.equal(state.positions[item], expected.positions[0])
        assert torch.equal(state.velocities[item], expected.velocities[0])
    # a difference anywhere shows in the sum over environments of what should be zero
    worst = max(float((part - expected.positions[0]).abs().max()) for part in state.positions.split(1 << 16))
    assert worst == 0.0
    assert np.isfinite(worst)


def test_benchmark_times_every_kernel_once_and_steps_with_the_quickest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_benchmark, "_TIMES", {})
    case = bar((6, 2, 2))
    sim = simulator(case, torch.float32, GPU, kernel="benchmark", batch=4)
    (times,) = kernel_benchmark._TIMES.values()
    assert times.keys() >= {"block", "grid", "stream"}
    assert sim.plan.kernel == min(times, key=lambda kernel: times[kernel])
    assert "the fastest kernel, milliseconds per step" in repr(sim)
    asked = simulator(case, torch.float32, GPU, kernel=str(sim.plan.kernel), batch=4)
    state = sim.rest_state(batch=4)
    assert torch.equal(sim(state).positions, asked(state).positions)
    simulator(case, torch.float32, GPU, kernel="benchmark", batch=4)
    assert len(kernel_benchmark._TIMES) == 1
