"""Poisson's ratio on a GPU: steps, fields and gradients are those of the CPU, alone and in a batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cases import box
from devices import require_gpu

import torchpd as pd
from torchpd.scene import Scene
from torchpd.scene.effects import Gravity, Pin, Solid

require_gpu()
KERNELS = ("block", "grid", "stream")


def scene_of(averaging: int, cells: tuple[int, int, int] = (8, 3, 3)) -> tuple[Scene, pd.State]:
    """A bar of unlike materials that swings fast, some of its tetrahedra far stretched."""
    mesh, rng = pd.TetMesh(*box((0.8, 0.3, 0.3), cells)), np.random.default_rng(0)
    count = len(mesh.tets)
    body = Solid(
        mesh, youngs=rng.uniform(0.5e5, 2e5, count), poisson=rng.uniform(0.2, 0.45, count), averaging=averaging,
        density=1000.0,
    )  # fmt: skip
    x = mesh.vertices * [1.0, 1.5, 1.2] + rng.uniform(-0.03, 0.03, mesh.vertices.shape)
    state = pd.State(torch.tensor(x[None]), torch.tensor(rng.normal(size=x.shape)[None]))
    return Scene(body, Pin(body, np.flatnonzero(mesh.vertices[:, 0] < 1e-9)), Gravity((0.0, -9.8, 0.0))), state


def on(device: str, state: pd.State, dtype: torch.dtype) -> pd.State:
    return pd.State(*(array.to(device, dtype) for array in state))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("averaging", [1, 2, 4])
def test_steps_are_those_of_the_cpu(averaging: int, kernel: str, dtype: torch.dtype) -> None:
    scene, state = scene_of(averaging)
    found = []
    for device in ("cpu", "cuda"):
        sim = pd.Simulator(scene, 1 / 60, 20, pd.Chebyshev(), dtype, device=device, kernel=kernel)
        after, info = sim(on(device, state, dtype), return_info=True)
        found.append((after.positions.cpu().double(), info.energy.cpu().double()))
    # twenty iterations, each of which rounds positions of 1 m a few times
    tolerance = 1e-12 if dtype == torch.float64 else 20 * 8 * 2.0**-24
    torch.testing.assert_close(found[1][0], found[0][0], rtol=0, atol=tolerance)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e2 * tolerance, atol=0)


@pytest.mark.parametrize("kernel", KERNELS)
def test_same_bits_alone_and_in_a_batch(kernel: str) -> None:
    scene, state = scene_of(4)
    sim = pd.Simulator(scene, 1 / 60, 12, pd.Chebyshev(), device="cuda", kernel=kernel)
    alone = sim(on("cuda", state, torch.float32))
    many = pd.State(*(array.repeat(7, 1, 1) for array in on("cuda", state, torch.float32)))
    many.velocities[:3] *= 0.5
    assert torch.equal(sim(many).positions[5], alone.positions[0])


@pytest.mark.parametrize("averaging", [1, 2, 4])
@pytest.mark.parametrize("kernel", ["block", "stream"])
def test_fields_and_gradients_are_those_of_the_cpu(kernel: str, averaging: int) -> None:
    scene, state = scene_of(averaging)
    found = []
    for device in ("cpu", "cuda"):
        sim = pd.Simulator(scene, 1 / 60, 400, pd.Chebyshev(), torch.float64, device=device, kernel=kernel)
        here = on(device, state, torch.float64)
        rows = {name: getattr(sim, name).requires_grad_() for name in ("stiffness", "poisson")}
        x = here.positions.clone().requires_grad_()
        energy = sim.energy(x).sum()
        first = torch.autograd.grad(energy, [x, *rows.values()], create_graph=True)
        d = torch.sin(torch.arange(x.numel(), dtype=x.dtype, device=device)).reshape(x.shape)
        second = torch.autograd.grad((first[0] * d).sum(), [x, *rows.values()])
        after = sim(pd.State(x, here.velocities))
        of_step = torch.autograd.grad((after.positions * d).sum(), [x, *rows.values()])
        found.append([array.detach().cpu() for array in (energy, *first, *second, *of_step)])
    for cpu, gpu in zip(*found, strict=True):
        torch.testing.assert_close(gpu, cpu, rtol=1e-8, atol=1e-8 * float(cpu.abs().max()))


def test_multilevel_solves_as_on_the_cpu() -> None:
    scene, state = scene_of(4)
    found = []
    for device in ("cpu", "cuda"):
        sim = pd.Simulator(scene, 1 / 60, 300, pd.Multilevel(), torch.float64, device=device)
        found.append(sim(on(device, state, torch.float64)).positions.cpu())
    torch.testing.assert_close(found[1], found[0], rtol=0, atol=1e-9)


def test_what_a_gpu_does_not_take() -> None:
    scene, _ = scene_of(4)
    with pytest.raises(ValueError, match="cluster"):
        pd.Simulator(scene, device="cuda", kernel="cluster")
    mesh = scene.solids[0].mesh
    apart = np.arange(len(mesh.tets)) // 2
    apart[[0, -1]] = apart[[-1, 0]]  # groups without a common face
    body = Solid(mesh, youngs=1e5, poisson=0.3, averaging=apart, density=1.0)
    with pytest.raises(ValueError, match="common face"):
        pd.Simulator(Scene(body), device="cuda")
