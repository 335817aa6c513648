"""Forward and backward in a CUDA graph: a solve of the adjoint is one launch and asks nobody."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from conjugate_cases import MANY, environment, environments, given_of, sliding_on, system
from conjugate_reference import conjugate_gradients
from devices import require_gpu
from on_gpu import DTYPES, GPU, KERNELS, device_work, relative, small_on_gpu
from runs import noise
from torch import Tensor

import torchpd as pd

require_gpu()

pytestmark = pytest.mark.parametrize("precision", DTYPES)

WAYS = [*KERNELS, "levels"]
SOLVED = 400  # iterations, after which the implicit function theorem holds


def simulator(kernel: str, precision: str) -> tuple[pd.Simulator, pd.State]:
    """Of a kernel, or "levels" of the multilevel solver."""
    sim, state = small_on_gpu(DTYPES[precision], "stream" if kernel == "levels" else kernel)
    if kernel == "levels":
        sim.solver = pd.Multilevel()
    sim.iterations = SOLVED
    return sim, state


class Training:
    """A step, its loss and the gradients of all that it learns, with tensors that a CUDA graph can know."""

    def __init__(self, sim: pd.Simulator, state: pd.State) -> None:
        self.sim, self.state = sim, state
        self.forces = torch.zeros_like(state.positions).requires_grad_()
        self.stiffness = sim.stiffness.requires_grad_()
        self.speed = state.velocities.clone().requires_grad_()
        self.weight = noise(state.positions)

    def run(self) -> tuple[Tensor, ...]:
        first = pd.State(self.state.positions, self.speed)
        last = self.sim(self.sim(first, self.forces))
        loss = (self.weight * last.positions).sum() + last.velocities.square().sum()
        return loss, *torch.autograd.grad(loss, [self.forces, self.stiffness, self.speed])

    def change(self, seed: int) -> None:
        """New numbers in the same places."""
        with torch.no_grad():
            self.forces.copy_(noise(self.forces, seed))
            self.speed.copy_(0.3 * noise(self.speed, seed + 1))
            self.stiffness.mul_(1.0 + 0.1 * seed)

    def record(self) -> tuple[torch.cuda.CUDAGraph, tuple[Tensor, ...]]:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            self.run()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            results = self.run()
        return graph, results


@pytest.mark.parametrize("kernel", WAYS)
def test_a_recorded_training_step_is_that_of_python(kernel: str, precision: str) -> None:
    sim, state = simulator(kernel, precision)
    training = Training(sim, state)
    graph, results = training.record()
    for seed in range(1, 4):
        training.change(seed)
        graph.replay()
        own = [t.clone() for t in results]
        wanted = training.run()
        assert all(torch.equal(one, other) for one, other in zip(own, wanted, strict=True))
        assert all(bool((t != 0).any()) for t in own)


@pytest.mark.parametrize("kernel", WAYS)
def test_backward_waits_once_a_step(kernel: str, precision: str) -> None:
    """Whether or not anything slides."""
    sim, state = simulator(kernel, precision)
    training = Training(sim, state)  # of two steps
    training.run()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            training.run()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert sum("called a synchronizing CUDA operation" in str(one.message) for one in caught) == 2


@pytest.mark.parametrize("kernel", WAYS)
def test_a_recording_takes_rotations_as_constant_where_python_would(kernel: str, precision: str) -> None:
    """One environment is crumpled: Python is warned, a graph cannot be, and both take the same gradient."""
    sim, state = simulator(kernel, precision)
    sim.iterations = 1
    state.positions[1] = 0.02 * noise(state.positions[1], 5)
    training = Training(sim, state)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # before it is recorded it runs once
        graph, results = training.record()
    graph.replay()
    with pytest.warns(UserWarning, match="adjoint of a step has no solution"):
        wanted = training.run()
    assert all(torch.equal(one, other) for one, other in zip(results, wanted, strict=True))


@pytest.mark.parametrize("kernel", WAYS)
def test_a_solve_is_one_kernel_behind_its_weights(kernel: str, precision: str) -> None:
    """However many iterations it takes."""
    sim, state = simulator(kernel, precision)
    right = noise(state.positions)
    diagonal = torch.ops.torchpd.elastic_diagonal(sim.material(), list(sim.plan.arrays), weighted=True)
    inertia = 0.1 * diagonal
    inverse = (1.0 / (inertia + diagonal)).contiguous()
    plan = list(sim.plan.arrays)
    rest = sim.rest_positions.expand_as(right).contiguous()
    vectors = [torch.zeros_like(right), right.clone(), torch.zeros_like(right)]
    progress = torch.full((len(right), 4), -1.0, dtype=torch.float64, device=GPU)

    def solve() -> None:
        for vector, first in zip(vectors, (0.0, right, 0.0), strict=True):
            vector.copy_(torch.as_tensor(first, device=GPU))
        progress.fill_(-1.0)
        torch.ops.torchpd.conjugate_gradients_(
            *vectors, progress, rest, inertia, inverse, None, sim.material(), plan, tolerance=1e-5, iterations=2000
        )

    names = [name for name in device_work(solve) if "pd::" in name]
    assert len(names) == 2
    assert ("conjugate_block" if kernel == "block" else "conjugate_teams") in names[1]
    assert progress[:, 2].tolist() == [0.0] * len(right)
    product = torch.ops.torchpd.hessian_product
    wanted, *_ = conjugate_gradients(
        lambda f: inertia[..., None] * f + product(rest, f.contiguous(), sim.material(), plan),
        lambda f: inverse[..., None] * f, right, 1e-5,
    )  # fmt: skip
    assert relative(vectors[0], wanted) < 1e-3


def test_a_recording_knows_sliding_friction(precision: str) -> None:
    """It asks nobody whether anything slides, nor for how many iterations: the bits are those of Python."""
    mesh = pd.shapes.box((0.4, 0.2, 0.2), (4, 2, 2))
    block = pd.Solid(mesh, youngs=2e4, density=1000.0)
    scene = pd.Scene(block, pd.Gravity(), pd.Ground(float(mesh.vertices[:, 1].min()), friction=0.3))
    sim = pd.Simulator(scene, 1 / 60, 1000, dtype=DTYPES[precision]).to(GPU)
    state = sim.rest_state(3)
    state.velocities[..., 0] = torch.tensor([1.0, 0.5, 0.0], device=GPU)[:, None]
    training = Training(sim, state)
    graph, results = training.record()
    graph.replay()
    wanted = training.run()
    assert all(torch.equal(one, other) for one, other in zip(results, wanted, strict=True))
    plain = pd.Simulator(pd.Scene(block, pd.Gravity(), pd.Ground(scene.grounds[0].height)), 1 / 60, 1000)
    assert relative(results[1], Training(plain.to(DTYPES[precision]).to(GPU), state).run()[1]) > 0.1


@pytest.mark.parametrize("shape", ["pairs", "levels", *MANY])
def test_friction_is_solved_for_in_the_same_launch(shape: str, precision: str) -> None:
    """The weights, and one kernel for the symmetric part and for friction, however many products they take."""
    options = MANY.get(shape, {"levels": True} if shape == "levels" else {"kernel": "block", "cells": (9, 3, 3)})
    s, positions, right = system(DTYPES[precision], GPU, contacts=True, **options)
    sliding = sliding_on(s, right)

    def solve() -> None:
        torch.ops.torchpd.conjugate_gradients(*given_of(s, positions, right), sliding, tolerance=1e-4)

    names = [name for name in device_work(solve) if "pd::" in name]
    assert len(names) == 2
    assert ("conjugate_block" if shape == "pairs" else "conjugate_teams") in names[1]


def test_friction_goes_on_in_the_next_launch(precision: str) -> None:
    """So many vertices are solved for in several launches; alone in one, with the same bits."""
    dtype = DTYPES[precision]
    s, positions, right = system(dtype, GPU, contacts=True, kernel="stream", cells=(60, 26, 26))
    sliding = sliding_on(s, right)
    index = torch.arange(960, device=GPU) % len(right)
    given = given_of(environments(s, index), positions[index], right[index])
    found: list[Tensor] = []

    def solve() -> None:
        found[:] = torch.ops.torchpd.conjugate_gradients(*given, sliding[index], tolerance=1e-5)

    assert sum("conjugate_teams" in name for name in device_work(solve)) > 10
    for e in range(len(right)):
        given = given_of(environment(s, e), positions[e : e + 1], right[e : e + 1])
        alone, error = torch.ops.torchpd.conjugate_gradients(*given, sliding[e : e + 1], tolerance=1e-5)
        assert float(error) <= 1e-4
        assert all(torch.equal(each, alone[0]) for each in found[0][e :: len(right)])


@pytest.mark.parametrize(("cells", "batch"), [((47, 6, 6), 66), ((13, 8, 8), 66)])
def test_the_way_back_runs_with_patches_as_large_as_fit(
    cells: tuple[int, int, int], batch: int, precision: str
) -> None:
    """In float32 of the first, in float64 of the second a step had room for patches that a solve had none for."""

    def slopes(**options: Any) -> tuple[Tensor, ...]:
        mesh = pd.shapes.box((0.1 * cells[0], 0.1 * cells[1], 0.1 * cells[2]), cells)
        body = pd.Solid(mesh, 1e4)
        scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
        sim = pd.Simulator(scene, 1 / 60, 200, dtype=DTYPES[precision], progress=False, **options).to(GPU)
        state, stiffness = sim.rest_state(2), sim.stiffness.requires_grad_()
        forces = (1e-2 * noise(state.positions)).requires_grad_()
        loss = (noise(state.positions, 5) * sim(state, forces).positions).sum()
        return torch.autograd.grad(loss, [forces, stiffness])

    expected = slopes(kernel="stream")
    for options in ({"batch": batch}, {"batch": batch, "kernel": "grid"}):
        for found, other in zip(slopes(**options), expected, strict=True):
            assert relative(found, other) < {"float32": 1e-3, "float64": 1e-8}[precision]
