"""What the tests of the CUDA kernels share: a simulator with a given kernel, scenes of the sizes that these are for."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from cases import Case, box
from runs import simulate, simulator, small

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.plan import kernel_choice as regimes

KERNELS = ("block", "cluster", "grid", "stream")
GPU = torch.device("cuda", 0)
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def on_gpu(case: Case, dtype: torch.dtype, kernel: str, **options: Any) -> pd.Simulator:
    """The scene of a case, compiled for one of the kernels or "far"."""
    with compiled_for(kernel) as name:
        return with_kernel(simulator(case, dtype, GPU, kernel=name, **options), name)


def full_on_gpu(dtype: torch.dtype, kernel: str, **options: Any) -> pd.Simulator:
    """`runs.full_scene` for one of the kernels."""
    with compiled_for(kernel) as name:
        return with_kernel(simulate(dtype, GPU, kernel=name, **options), name)


def small_on_gpu(dtype: torch.dtype, kernel: str, batch: int = 3) -> tuple[pd.Simulator, pd.State]:
    """`runs.small` for one of the kernels."""
    with compiled_for(kernel) as name:
        sim, state = small(dtype, GPU, batch, kernel=name)
    return with_kernel(sim, name), state


@contextmanager
def compiled_for(kernel: str) -> Iterator[str]:
    """The name that a simulator knows one of KERNELS by; a "grid" gets many patches of two tetrahedra and more.

    "far": a grid of a few patches with several tetrahedra a thread, of meshes that have 2400 or more.
    """
    if kernel in ("grid", "far"):
        with mock.patch.object(regimes, "_MIN_GRID_TETS", 2 if kernel == "grid" else 1200):
            yield "grid"
    else:
        if kernel == "cluster" and not has_clusters():
            pytest.skip("clusters of blocks need compute capability 9.0")
        yield kernel


def has_clusters() -> bool:
    """Whether blocks can reach each other's shared memory here."""
    return properties_of(GPU).cluster > 1


def with_kernel(sim: pd.Simulator, kernel: str) -> pd.Simulator:
    assert sim.plan.kernel == kernel
    assert sim.device == GPU
    return sim


def bar(cells: tuple[int, int, int], *parts: Any, pinned: bool = True, youngs: float = 1e5) -> Case:
    """A bar of 1 x 0.2 x 0.2 m that swings, held at x = 0 or free."""
    vertices, tets = box((1.0, 0.2, 0.2), cells)
    body = pd.Solid(pd.TetMesh(vertices, tets), youngs)
    held = (pd.Pin(body, vertices[:, 0] == 0.0),) if pinned else ()
    velocities = np.zeros_like(vertices)
    velocities[:, 1] = -3.0 * vertices[:, 0] ** 2
    return Case(pd.Scene(body, *held, *parts), vertices, velocities, 1.0 / 60.0)


def crowd() -> Case:
    """Forty free tetrahedra and a held one: more pieces than warps, patches with several of them."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    bodies = [
        pd.Solid(pd.TetMesh(corners + [2.0 * (n % 7), 2.0 * (n // 7), 0.0], [[0, 1, 2, 3]]), 1e4 * (1 + n))
        for n in range(41)
    ]
    scene = pd.Scene(*bodies, pd.Pin(bodies[20], [0]), pd.Gravity(), pd.Ground(1.0, friction=0.3))
    rest = scene.values().rest_positions
    rng = np.random.default_rng(0)
    x, v = rest + 0.03 * rng.standard_normal(rest.shape), 0.9 * rng.standard_normal(rest.shape)
    return Case(scene, x, v, 1.0 / 60.0)


def moved(state: pd.State, device: torch.device | str, dtype: torch.dtype | None = None) -> pd.State:
    return pd.State(*(t.to(device=device, dtype=dtype or t.dtype) for t in state))


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Largest difference, relative to the largest number."""
    want = expected.detach().double().cpu()
    difference = (found.detach().double().cpu() - want).abs().max()
    return float(difference) / max(float(want.abs().max()), 1e-300)


def rounding_of(run: Callable[[pd.State], torch.Tensor], state: pd.State) -> float:
    """How far rounding alone moves what `run` gives, relative to it: of 64 copies whose positions are an ulp away.

    Coarse corrections with friction converge linearly, and end at 1e-7 of the size: rounding may add a step to one.
    """
    worst = 0.0
    for item in range(len(state.positions)):
        alone = pd.State(*(part[item : item + 1] for part in state))
        many, expected = pd.State(*(part.expand(64, *part.shape[1:]) for part in alone)), run(alone)[0]
        worst = max(worst, *(relative(found, expected) for found in run(an_ulp_away(many))))
    return worst


def an_ulp_away(state: pd.State, seed: int = 0) -> pd.State:
    """The state with its positions rounded otherwise."""
    x, v = state
    ulps = torch.randint(-1, 2, x.shape, generator=torch.Generator().manual_seed(seed)).to(x)
    return pd.State(x * (1.0 + ulps * torch.finfo(x.dtype).eps), v.contiguous())


def rounds_as(found: torch.Tensor, cpu: torch.Tensor, wide: torch.Tensor) -> bool:
    """Whether it is as near to float64 as the CPU is: its rounding differs by the order of sums alone."""
    least = 1e-12 if found.dtype == torch.float64 else 4.0 * relative(cpu, wide) + 2.0**-21
    return bool(torch.isfinite(found).all()) and relative(found, wide) <= least


class _Loss(torch.nn.Module):
    def __init__(self, sim: pd.Simulator, run: Callable[[], torch.Tensor]) -> None:
        super().__init__()
        self.sim, self.run = sim, run

    def forward(self) -> torch.Tensor:
        return self.run()


def gradients_after_two_steps(
    sim: pd.Simulator, state: pd.State, forces: torch.Tensor, rows: dict[str, torch.Tensor], weight: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Of a loss, for the state, the forces and every array of the material; `rows` replace some of these."""
    given = {name: getattr(sim, name).detach() for name in sim.material_names} | {
        name: row.to(sim.device, sim.dtype) for name, row in rows.items()
    }
    given = {name: row.clone().requires_grad_() for name, row in given.items() if row.numel()}
    starts = [t.to(sim.device, sim.dtype).clone().requires_grad_() for t in (*state, forces)]

    def run() -> torch.Tensor:
        after = sim(sim(pd.State(starts[0], starts[1]), starts[2]), starts[2])
        scale = weight.to(after.positions)
        loss: torch.Tensor = (scale * after.positions).sum() + 0.01 * (scale * after.velocities).sum()
        return loss

    with torch.enable_grad():
        loss = torch.func.functional_call(_Loss(sim, run), {f"sim.{name}": row for name, row in given.items()}, ())
    names = ["positions", "velocities", "forces", *given]
    return dict(zip(names, torch.autograd.grad(loss, [*starts, *given.values()]), strict=True))


def host_waits(call: Callable[[], object]) -> bool:
    """Whether the host waits for the device in a call: an error where torch knows that it would.

    What torch does not know of shows in the time: the device is busy meanwhile, and done when such a call returns.
    """
    torch.cuda.synchronize()
    done = torch.cuda.Event()
    torch.cuda._sleep(400_000_000)  # cycles: a fifth of a second
    done.record()
    torch.cuda.set_sync_debug_mode("error")
    try:
        call()
        return bool(done.query())
    finally:
        torch.cuda.set_sync_debug_mode("default")
        torch.cuda.synchronize()


def poll() -> None:
    """Waits for the device as torch does not know of."""
    reached = torch.cuda.Event()
    reached.record()
    while not reached.query():
        pass


def threads_of(call: Callable[[], object], folder: Path) -> set[int]:
    """Threads a block of the kernels that a call gives to the device; empty where the profiler sees none."""
    call()
    torch.cuda.synchronize()
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        call()
        torch.cuda.synchronize()
    trace = folder / "trace.json"
    profile.export_chrome_trace(str(trace))
    events = json.loads(trace.read_text())["traceEvents"]
    return {event["args"]["block"][0] for event in events if event.get("cat") == "kernel"}


def device_work(call: Callable[[], object]) -> list[str]:
    """Names of the kernels, copies and fills that a call gives to the device."""

    def names(work: Callable[[], object]) -> list[str]:
        activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
        with torch.profiler.profile(activities=activities) as profile:
            work()
            torch.cuda.synchronize()
        return [e.name for e in profile.events() if e.device_type == torch.autograd.DeviceType.CUDA]

    call()  # first: loading modules and allocating is not what is counted
    torch.cuda.synchronize()
    ones = torch.ones(8, device=GPU)
    names(lambda: ones.add(1.0))  # and the profiler's own start
    if len(names(lambda: ones.add(1.0))) != 1:
        pytest.skip("the profiler does not see the kernels of this machine")
    return names(call)


def still_works() -> None:
    """No error has stayed behind in the context, and no kernel is broken."""
    torch.cuda.synchronize()
    sim, state = small_on_gpu(torch.float32, "block")
    expected = small(torch.float32)[0](moved(state, "cpu"))
    assert relative(sim(state).velocities, expected.velocities) <= 1e-4
