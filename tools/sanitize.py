"""Runs every CUDA kernel once on tiny meshes, for NVIDIA's sanitizer, which makes a program a hundred times slower:

compute-sanitizer --tool memcheck python tools/sanitize.py          and racecheck, initcheck, synccheck
PYTORCH_NO_CUDA_MEMORY_CACHING=1 makes every tensor an allocation of its own, so that memcheck sees its end.

That a tool reports nothing says something if it would report an error. `--plant TOOL` makes one that TOOL must report,
for each kernel in a process of its own, since memcheck ends the one in which it finds something:

PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool memcheck --error-exitcode 86 \\
    python tools/sanitize.py --plant memcheck --kernel grid             has to exit with 86, whatever else it prints

memcheck    an array of the plan lacks its last number: a kernel reads behind it
initcheck   nobody has written the velocities that a step starts with
racecheck   all pairs of a patch leave their forces in the same place of shared memory
For synccheck there is none: the threads of a block part for no argument.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import torch
import trimesh
from torch import Tensor

import torchpd as pd
from torchpd import multilevel, regimes
from torchpd.device_plan import compile_device_plan
from torchpd.gpu import properties_of
from torchpd.plan import KERNELS as PLAN_KERNELS
from torchpd.plan import Plan
from torchpd.render import Camera
from torchpd.tables import DEVICE_PLAN_TABLE

# "far" is a grid of patches that have several tetrahedra and vertices a thread
KERNELS = ("block", "cluster", "grid", "far", "stream")
RUNS = (*KERNELS, "levels", "patches")  # and what the multilevel solver runs with, and the ops of free-form patches
SOLVERS = (pd.Chebyshev(), pd.Jacobi(), pd.Chebyshev("classic", rho=0.9, delay=1))
ops = torch.ops.torchpd


# constants of torchpd.regimes that decide how many patches there are
SIZES = {
    "cluster": ("_CLUSTER_EACH", 40),
    "grid": ("_GRID_TETS", 8),
    "far": ("_GRID_TETS", 1200),
    "stream": ("_STREAM_TETS", {torch.float32: 24, torch.float64: 24}),
}
CELLS = {"far": (13, 5, 4)}  # of a bar


def compiled_for(kernel: str) -> str:
    """The name that a simulator knows one of KERNELS by, from now on: a "grid" gets more patches than a cluster has."""
    if kernel in SIZES:
        setattr(regimes, *SIZES[kernel])
    return "grid" if kernel == "far" else kernel


def scene(*, contacts: bool, pieces: bool, pins: bool, cells: tuple[int, int, int] = (6, 2, 2)) -> pd.Scene:
    """Two bars, the second of which is free where pieces are wanted."""
    mesh = pd.shapes.box((0.6, 0.2, 0.2), cells)
    bars = [pd.Solid(pd.TetMesh(mesh.vertices + [0.0, y, 0.0], mesh.tets), 1e5) for y in (0.0, 0.5)]
    held = bars[:1] if pieces else bars
    parts: list[pd.scene.Part] = [*bars, pd.Gravity(), pd.Damping(0.5)]
    if pins:
        for bar in held:
            parts += [pd.Pin(bar, np.arange(9)), pd.Pin(bar, [40, 41], 1e3)]
    if contacts:
        parts += [pd.Ground(-0.001, friction=0.5), pd.Sphere((0.3, -0.1, 0.1), 0.1, friction=0.2)]
    return pd.Scene(*parts)


def step_all_ways(sim: pd.Simulator, batch: int) -> None:
    """step, step_, rollout; reports; starts; forces; a stiffness and masses of each environment."""
    state = sim.rest_state(batch)
    state.velocities[..., 1] = -3.0 * state.positions[..., 0]
    forces = 0.1 * state.velocities
    sim(state)
    sim(state, forces, start="inertial", return_info=True)
    sim(state, start=state.positions + 0.001)
    sim.rollout(state, 3, 2, forces=forces, return_info=True)
    rows = torch.empty((batch, 6), dtype=torch.float64, device=state.positions.device)
    own = pd.State(*(t.clone() for t in state))
    sim.step_(own, info=rows)
    sim.set_material(
        stiffness=sim.stiffness.expand(batch, -1).contiguous(), masses=sim.masses.expand(batch, -1).contiguous()
    )
    after = sim(state)
    torch.cuda.synchronize()
    if not bool(after.positions.isfinite().all()):
        raise RuntimeError("a step has not stayed finite")


def fields(sim: pd.Simulator, batch: int) -> None:
    """Every field op, for one stiffness and for one of each environment."""
    x = sim.rest_state(batch).positions * 1.1
    d, plan = 0.01 * x, list(sim.plan.arrays)
    for w in (sim.stiffness, sim.stiffness.expand(batch, -1).contiguous()):
        ops.gradient(x, w, plan)
        ops.element_energy(x, w, plan)
        ops.hessian_product(x, d, w, plan)
        ops.element_energy_product(x, d, w, plan)
        for weighted in (False, True):
            ops.elastic_diagonal(w, plan, weighted=weighted)


def rotations(dtype: torch.dtype) -> None:
    """Common and degenerate matrices, in no number of whole warps."""
    matrices = torch.randn((77, 3, 3), generator=torch.Generator().manual_seed(0), dtype=dtype).cuda()
    matrices[5] = 0.0
    matrices[6] = float("nan")
    matrices[7] = -torch.eye(3)
    pd.nearest_rotation(matrices)
    ops.rotation_differential(matrices, matrices.flip(0).contiguous())


def in_many_patches(sim: pd.Simulator) -> Plan:
    """For the grid, with vertices of more patches than a row of senders holds."""
    arrays = compile_device_plan(sim.scene.values(), 36, PLAN_KERNELS.index("grid"), sim.dtype, progress=False)
    plan = Plan(arrays, DEVICE_PLAN_TABLE).to("cuda")
    if not bool((plan.slot_sender[:, 7] > 0).any()):
        raise RuntimeError("no vertex has more than seven patches")
    return plan


def levels(dtype: torch.dtype) -> int:
    """The multilevel solver: one block an environment, several, and several environments one after another.

    By levels, then directly.
    """
    small, large = (6, 2, 2), (14, 4, 4)
    ways = (
        ("lbfgs", False, small, 3, 0),
        ("lbfgs", True, large, 2, 0),
        ("momentum", True, small, 2, 0),
        ("lbfgs", True, small, 3, 1024),
        ("lbfgs", False, large, 2, 1024),
        ("corotated", True, small, 3, 0),
        ("corotated", False, large, 2, 1024),
    )
    usual = multilevel.MOST_DIRECT
    for outer, contacts, cells, batch, most_direct in ways:
        multilevel.MOST_DIRECT = most_direct
        built = scene(contacts=contacts, pieces=contacts, pins=True, cells=cells)
        solver = pd.Multilevel(outer)  # type: ignore[arg-type]
        options: dict[str, Any] = {"solver": solver, "tolerance": 1e-2 * contacts, "dtype": dtype}
        iterations = 5 if outer == "corotated" else 3  # the small problem is made after three
        sim = pd.Simulator(built, 1 / 60, iterations, progress=False, **options).to("cuda")
        step_all_ways(sim, batch)
        ops.precondition(sim.rest_state(batch).positions, list(sim.plan.arrays))
    multilevel.MOST_DIRECT = usual
    many = pd.Simulator(scene(contacts=False, pieces=False, pins=True), 1 / 60, 1, solver=pd.Multilevel(), dtype=dtype)
    many.to("cuda")(many.rest_state(300))
    torch.cuda.synchronize()
    return len(ways) + 1


def free_form(dtype: torch.dtype) -> int:
    """Every op of free-form patches and its adjoint, two poses at once."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    rng = np.random.default_rng(0)
    centres = torch.tensor(ball.vertices[::2])
    amplitudes = torch.tensor(0.02 * rng.choice([-1.0, 1.0], len(centres)))
    quadrics = pd.Quadrics.from_radii(amplitudes, centres, torch.full((len(centres),), 0.4, dtype=torch.float64))
    bases = (("flat", "base"), ("phong", "surface"))
    for base, measured_at in bases:
        mesh = pd.TriMesh.from_trimesh(ball)
        patches = pd.FreeFormPatches.from_mesh(mesh, quadrics, dtype=torch.float64, base=base, measured_at=measured_at)  # type: ignore[arg-type]
        patches = patches.to(device="cuda", dtype=dtype)
        q = patches.quadrics
        leaves = [t.requires_grad_() for t in (q.amplitudes, q.centres, q.factors)]
        body = pd.PatchBody(patches, stiffness=1e4, density=1000.0)
        sim = pd.Simulator(pd.Scene(body, pd.Gravity(), pd.Ground(-1.01)), 1 / 60, 3, dtype=dtype, progress=False)
        sim.to("cuda")
        state = sim(sim.rest_state(2))
        pose = body.pose(state.positions.requires_grad_())
        image = pd.PatchRays(patches).render(Camera((0.0, 0.6, 4.2), (0.0, 0.0, 0.0), 36.0), (9, 7), pose)
        inside = torch.tensor(rng.uniform(-1, 1, (77, 3)), dtype=dtype, device="cuda")
        number = torch.tensor(rng.integers(0, 80, 77), device="cuda")
        field = patches.field(inside, number)
        (image.color.sum() + patches.surface(patches.tessellate(3).samples, pose).points.sum() + field.sum()).backward()
        pd.PatchRays(patches).cast_field(2 * inside, -inside, far=4.0)
        if not all(bool(t.grad is not None and t.grad.isfinite().all()) for t in leaves):
            raise RuntimeError("a gradient has not stayed finite")
        torch.cuda.synchronize()
    return len(bases)


def run(kernels: Sequence[str]) -> int:
    """How many simulators have run."""
    count = 0
    flags = list(itertools.product((False, True), repeat=2))
    for kernel, dtype in itertools.product(kernels, (torch.float32, torch.float64)):
        if kernel == "levels":
            count += levels(dtype)
            continue
        if kernel == "patches":
            count += free_form(dtype)
            continue
        if kernel == "cluster" and properties_of(torch.device("cuda", 0)).cluster == 1:
            print("no clusters: this GPU has none (compute capability 9.0)")
            continue
        name, cells = compiled_for(kernel), CELLS.get(kernel, (6, 2, 2))
        for number, (contacts, pieces) in enumerate(flags):
            solver, tolerance = SOLVERS[number % len(SOLVERS)], 1e-2 if number % 2 else 0.0
            options = {"solver": solver, "tolerance": tolerance, "dtype": dtype, "kernel": name, "progress": False}
            built = scene(contacts=contacts, pieces=pieces, pins=True, cells=cells)
            sim = pd.Simulator(built, 1 / 60, 5, **options).to("cuda")  # type: ignore[arg-type]
            step_all_ways(sim, 3)
            if kernel == "stream" and dtype == torch.float32 and not contacts:
                many = pd.Simulator(built, 1 / 60, 5, **options).to("cuda")  # type: ignore[arg-type]
                # so many patches that blocks go from one to another
                many(many.rest_state(7 * properties_of(sim.device).multiprocessors // sim.plan.patches))
                count += 1
            count += 1
        fields(sim, 3)
        options = {"dtype": dtype, "kernel": name, "progress": False}
        if kernel == "stream":  # patches of several tetrahedra and vertices a thread
            with mock.patch.object(regimes, "_STREAM_TETS", {torch.float32: 2304, torch.float64: 960}):
                thin = scene(contacts=False, pieces=False, pins=False, cells=(19, 20, 1))
                large = pd.Simulator(thin, 1 / 60, 5, **options).to("cuda")  # type: ignore[arg-type]
            large(large.rest_state(2))
            count += 1
        built = scene(contacts=True, pieces=True, pins=False, cells=cells)
        free = pd.Simulator(built, 1 / 60, 5, **options)  # type: ignore[arg-type]
        step_all_ways(free.to("cuda"), 2)
        count += 1
        if kernel == "grid":
            sim.plan = in_many_patches(sim)
            step_all_ways(sim, 3)
            count += 1
        rotations(dtype)
    torch.cuda.synchronize()
    return count


# ---- controls


def change_plan(sim: pd.Simulator, name: str, change: Callable[[Tensor], Tensor]) -> None:
    """Puts another array into the plan."""
    rows = zip(sim.plan.table, sim.plan.arrays, strict=True)
    sim.plan = replace(sim.plan, arrays=tuple(change(array) if row.name == name else array for row, array in rows))


def without_last(array: Tensor) -> Tensor:
    """The size of part_slot is the only one that no other number of the plan tells: the ops take it as it comes."""
    short = array[:-1].clone()
    if short.numel() * short.element_size() % 256 == 0:  # allocations begin at multiples of it
        raise RuntimeError("what lies behind may be another tensor; take a scene of another size")
    return short


def into_one_place(corners: Tensor) -> Tensor:
    """Every corner that has an entry gets the first one: in the upper 16 bits, 65535 where there is none."""
    return torch.where(corners >> 16 == -1, corners, corners & 65535)


def plant(tool: str, kernel: str) -> None:
    """A step in which `tool` must find an error."""
    built = scene(contacts=False, pieces=True, pins=False)
    options: dict[str, Any] = {"solver": pd.Multilevel()} if kernel == "levels" else {"kernel": compiled_for(kernel)}
    sim = pd.Simulator(built, 1 / 60, 5, progress=False, **options).to("cuda")
    state = sim.rest_state(2)
    if tool == "memcheck":
        change_plan(sim, "part_slot", without_last)
    elif tool == "initcheck":
        state = pd.State(state.positions, torch.empty_like(state.velocities))
    else:
        change_plan(sim, "pair_corner", into_one_place)
    sim.step_(state)
    torch.cuda.synchronize()


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", nargs="+", choices=RUNS, default=RUNS)
    parser.add_argument("--plant", choices=("memcheck", "initcheck", "racecheck"), help="make an error; see above")
    options = parser.parse_args(words)
    if not torch.cuda.is_available():
        parser.error("torch finds no CUDA device")
    if options.plant:
        if len(options.kernel) != 1:
            parser.error("--plant wants one kernel: --kernel grid")
        if options.kernel == ["patches"]:
            parser.error("--plant makes its errors in a step: any kernel but patches")
        if options.plant != "racecheck" and os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING") != "1":
            parser.error("the tool sees single tensors with PYTORCH_NO_CUDA_MEMORY_CACHING=1 alone")
        plant(options.plant, *options.kernel)
        print(f"a step has run with an error in it; where {options.plant} has reported none, it sees none")
        return
    begin = time.perf_counter()
    count = run(options.kernel)
    print(f"{count} simulators have run in {time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main(sys.argv[1:])
