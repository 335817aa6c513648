"""Runs every CUDA kernel once on tiny meshes, for NVIDIA's sanitizer, which makes a program a hundred times slower:

compute-sanitizer --tool memcheck python tools/sanitize.py          and racecheck, initcheck, synccheck
PYTORCH_NO_CUDA_MEMORY_CACHING=1 makes every tensor an allocation of its own, so that memcheck sees its end.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Sequence

import numpy as np
import torch

import torchpd as pd

KERNELS = ("block", "grid", "stream")
SOLVERS = (pd.Chebyshev(), pd.Jacobi(), pd.Chebyshev("classic", rho=0.9, delay=1))
ops = torch.ops.torchpd


def scene(*, contacts: bool, pieces: bool, pins: bool) -> pd.Scene:
    """Two bars, the second of which is free where pieces are wanted."""
    mesh = pd.shapes.box((0.6, 0.2, 0.2), (6, 2, 2))
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


def run(kernels: Sequence[str]) -> int:
    """How many simulators have run."""
    count = 0
    flags = list(itertools.product((False, True), repeat=2))
    for kernel, dtype in itertools.product(kernels, (torch.float32, torch.float64)):
        for number, (contacts, pieces) in enumerate(flags):
            solver, tolerance = SOLVERS[number % len(SOLVERS)], 1e-2 if number % 2 else 0.0
            options = {"solver": solver, "tolerance": tolerance, "dtype": dtype, "kernel": kernel, "progress": False}
            built = scene(contacts=contacts, pieces=pieces, pins=True)
            sim = pd.Simulator(built, 1 / 60, 5, **options).to("cuda")  # type: ignore[arg-type]
            step_all_ways(sim, 3)
            count += 1
        fields(sim, 3)
        options = {"dtype": dtype, "kernel": kernel, "progress": False}
        free = pd.Simulator(scene(contacts=True, pieces=True, pins=False), 1 / 60, 5, **options)  # type: ignore[arg-type]
        step_all_ways(free.to("cuda"), 2)
        count += 1
        rotations(dtype)
    torch.cuda.synchronize()
    return count


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", nargs="+", choices=KERNELS, default=KERNELS)
    options = parser.parse_args(words)
    if not torch.cuda.is_available():
        parser.error("torch finds no CUDA device")
    begin = time.perf_counter()
    count = run(options.kernel)
    print(f"{count} simulators have run in {time.perf_counter() - begin:.1f} s")


if __name__ == "__main__":
    main(sys.argv[1:])
