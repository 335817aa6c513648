"""Run every CUDA kernel on tiny meshes for NVIDIA's sanitizer, which slows a program a hundredfold:

compute-sanitizer --tool memcheck python tools/sanitize.py          and racecheck, initcheck, synccheck
PYTORCH_NO_CUDA_MEMORY_CACHING=1 gives every tensor its own allocation, so that memcheck sees its end.

Mesh and device decide which instantiation of a kernel runs. `--list`, without a sanitizer, profiles which ones ran, and
exits with 1 if one of benchmarks/results/cuda-registers.csv did not. The scenes are chosen for an H100.

Silence of a tool counts only if it would report an error. `--plant TOOL` makes one that TOOL must report. It runs each
kernel in its own process, since memcheck ends the process in which it finds an error:

PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool memcheck --error-exitcode 86 \\
    python tools/sanitize.py --plant memcheck --kernel grid             must exit with 86, whatever else it prints

memcheck    an array of the plan lacks its last number, or a patch ends behind its list: a kernel reads past the end
initcheck   the initial velocities of a step, or the amplitudes of the patches, are uninitialised
racecheck   all pairs of a patch write their forces to the same shared memory; the ops of free-form patches use no
            shared memory and have no such error
synccheck has no planted error: no argument makes the threads of a block diverge.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
import time
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from cuda_check import kernel_name
from sanitize_plants import (  # noqa: F401  (some for tests)
    behind_list,
    plant,
    planted_scene,
    why_not_plant,
    without_last,
)
from sanitize_scenes import (
    BAR,
    DTYPES,
    KERNEL_CASES,
    KERNELS,
    ball_of_patches,
    bar,
    compiled_for,
    known_as,
    samples_everywhere,
    scene,
)
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

import torchpd as pd
from torchpd.common.gpu import properties_of
from torchpd.common.tables import DEVICE_PLAN_TABLE, MATERIAL_TABLE
from torchpd.plan import KERNELS as PLAN_KERNELS
from torchpd.plan import Plan
from torchpd.plan import preconditioner as multilevel
from torchpd.plan.gpu_plan import compile_device_plan
from torchpd.viewing.render import Camera

TABLE = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "cuda-registers.csv"
SOLVERS = (pd.Chebyshev(), pd.Jacobi(), pd.Chebyshev("classic", rho=0.9, delay=1))
RUNS = (*KERNELS, "levels", "patches")  # plus the kernels of the multilevel solver and of free-form patches
ops = torch.ops.torchpd


def step_all_ways(sim: pd.Simulator, batch: int) -> None:
    """Run step, step_ and rollout; reports, starts, forces; stiffness and masses per environment."""
    state = sim.rest_state(batch)
    state.velocities[..., 1] = -3.0 * state.positions[..., 0]
    forces = 0.1 * state.velocities
    sim(state)
    sim(state, forces, start="inertial", return_info=True)
    sim(state, start=state.positions + 0.001)
    sim.rollout(state, 3, 2, forces=forces, return_info=True)
    rows = torch.empty((batch, 7), dtype=torch.float64, device=state.positions.device)
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
    """Run every field op, for one stiffness and for one per environment."""
    x = sim.rest_state(batch).positions * 1.1
    d, plan = 0.01 * x, list(sim.plan.arrays)
    one, *rest = sim.material()
    for material in ([one, *rest], [one.expand(batch, -1).contiguous(), *rest]):
        ops.gradient(x, material, plan)
        ops.element_energy(x, material, plan)
        ops.hessian_product(x, d, material, plan)
        ops.element_energy_product(x, d, material, plan)
        for weighted in (False, True):
            ops.elastic_diagonal(material, plan, weighted=weighted)
        solve(sim, batch, material)


def solve(sim: pd.Simulator, batch: int, material: list[torch.Tensor]) -> None:
    """Conjugate gradients without contacts, with contacts and with sliding, from the first and the second iteration."""
    x, plan = sim.rest_state(batch).positions * 1.1, list(sim.plan.arrays)
    diagonal = ops.elastic_diagonal(material, plan, weighted=True)
    inertia, inverse = 0.1 * diagonal, 1.0 / (1.1 * diagonal)
    active = torch.full((batch, 4), -1.0, dtype=torch.float64, device=x.device)
    projector = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape, 3)
    sliding = 0.1 * x.unsqueeze(-2).expand(*x.shape[:2], 5, 3).contiguous()
    for held in (None, projector):
        vectors = [torch.empty_like(x), 0.01 * x, torch.empty_like(x), active.clone()]
        for iterations in (2, 1):
            ops.conjugate_gradients_(
                *vectors, x, inertia, inverse, held, material, plan, tolerance=0.0, iterations=iterations
            )
    ops.conjugate_gradients(x, 0.01 * x, inertia, inverse, projector, material, plan, sliding, tolerance=1e-2)


def adjoint(sim: pd.Simulator, batch: int) -> None:
    """Kernels around the adjoint solve, with a scene's contacts and without."""
    x, plan, h = sim.rest_state(batch).positions, list(sim.plan.arrays), sim.time_step
    d, error = 0.01 * x, torch.zeros(batch, dtype=torch.float64, device=x.device)
    material = [array.detach() for array in sim.material()]
    # a scene without further effects has only the first rows
    rows = zip(MATERIAL_TABLE, material, strict=False)
    freed = [t[..., :0, :] if row.name in ("planes", "spheres") else t for row, t in rows]
    for arrays, forces in ((material, d), (material, None), (freed, None)):
        right, _, _, *held = ops.adjoint_system(d, d, x + d, x, d, forces, arrays, plan, time_step=h)
        ops.contact_gradients(d, d, d, d, x + d, x, d, forces, arrays, plan, time_step=h)
        contacts = (d, d, *held) if arrays is material else ()
        ops.adjoint_result(right, error, d, arrays, *contacts, time_step=h)


def rotations(dtype: torch.dtype) -> None:
    """Common and degenerate matrices, not a multiple of the warp size."""
    matrices = torch.randn((77, 3, 3), generator=torch.Generator().manual_seed(0), dtype=dtype).cuda()
    matrices[5] = 0.0
    matrices[6] = float("nan")
    matrices[7] = -torch.eye(3)
    pd.nearest_rotation(matrices)
    ops.rotation_differential(matrices, matrices.flip(0).contiguous())


def in_many_patches(sim: pd.Simulator) -> Plan:
    """A plan for the grid, with vertices in more patches than a row of senders holds."""
    arrays = compile_device_plan(sim.scene.values(), 48, PLAN_KERNELS.index("grid"), sim.dtype, progress=False)
    plan = Plan(arrays, DEVICE_PLAN_TABLE).to("cuda")
    if not bool((plan.slot_sender[:, 7] > 0).any()):
        raise RuntimeError("no vertex has more than seven patches")
    return plan


def levels(dtype: torch.dtype) -> int:
    """Run the multilevel solver: one block per environment, several, and several environments in sequence.

    First by levels, then directly.
    """
    small, large = BAR, bar(14, 4, 4)
    ways = (
        ("lbfgs", False, small, 3, 0),
        ("lbfgs", True, large, 2, 0),
        ("momentum", True, small, 2, 0),
        ("lbfgs", True, small, 3, 1024),
        ("lbfgs", False, large, 2, 1024),
    )
    for outer, contacts, mesh, batch, most_direct in ways:
        built = scene(mesh, contacts=contacts, pieces=contacts, pins=True)
        solver = pd.Multilevel(outer)  # type: ignore[arg-type]
        options: dict[str, Any] = {"solver": solver, "tolerance": 1e-2 * contacts, "dtype": dtype}
        iterations = 5 if outer == "lbfgs" else 3  # the coarse problem is built after three
        with mock.patch.object(multilevel, "MOST_DIRECT", most_direct):
            sim = pd.Simulator(built, 1 / 60, iterations, progress=False, **options).to("cuda")
            step_all_ways(sim, batch)
            ops.precondition(sim.rest_state(batch).positions, list(sim.plan.arrays))
            solve(sim, batch, sim.material())
    built = scene(BAR, contacts=False, pieces=False, pins=True)
    many = pd.Simulator(built, 1 / 60, 1, solver=pd.Multilevel(), dtype=dtype, progress=False)
    many.to("cuda")(many.rest_state(300))
    solve(many, 300, many.material())
    torch.cuda.synchronize()
    return len(ways) + 1


def free_form(dtype: torch.dtype) -> int:
    """Run every op of free-form patches and its adjoint, with two poses."""
    rng = np.random.default_rng(0)
    bases = (("flat", "base"), ("phong", "surface"))
    for base, measured_at in bases:
        patches = ball_of_patches(base=base, measured_at=measured_at).to(device="cuda", dtype=dtype)
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
        (image.color.sum() + patches.surface(samples_everywhere(patches), pose).points.sum() + field.sum()).backward()
        pd.PatchRays(patches).cast_field(2 * inside, -inside, far=4.0)
        if not all(bool(t.grad is not None and t.grad.isfinite().all()) for t in leaves):
            raise RuntimeError("a gradient has not stayed finite")
        torch.cuda.synchronize()
    return len(bases)


def every_way(kernel: str, dtype: torch.dtype) -> int:
    """Run all instantiations of a kernel of KERNELS; all effects of a step with the first mesh."""
    count = 0
    flags = list(enumerate(itertools.product((False, True), repeat=2)))
    options: dict[str, Any] = {"dtype": dtype, "kernel": known_as(kernel), "progress": False}
    for case in KERNEL_CASES[kernel]:
        with compiled_for(kernel, case):
            # contacts of held bodies only here: other meshes use the kernels of free bodies
            for number, (contacts, pieces) in flags if case is KERNEL_CASES[kernel][0] else flags[:2] + flags[3:]:
                solver, tolerance = SOLVERS[number % len(SOLVERS)], 1e-2 if number % 2 else 0.0
                built = scene(case.mesh, contacts=contacts, pieces=pieces, pins=True)
                sim = pd.Simulator(built, 1 / 60, 5, solver=solver, tolerance=tolerance, **options).to("cuda")
                step_all_ways(sim, 3)
                count += 1
                if kernel == "stream" and dtype == torch.float32 and not contacts:
                    # enough patches that a block takes several and finds the next in turns
                    many = pd.Simulator(built, 1 / 60, 5, solver=solver, tolerance=tolerance, **options).to("cuda")
                    many(many.rest_state(70 * properties_of(sim.device).multiprocessors // sim.plan.patches))
                    count += 1
        fields(sim, 3)
        adjoint(sim, 3)
    if kernel == "block":
        # its block has a multiprocessor to itself, and several slots per thread
        mesh = bar(9, 9, 9) if dtype == torch.float32 else bar(6, 6, 6)
        fields(pd.Simulator(pd.Scene(pd.Solid(mesh, 1e5)), 1 / 60, **options).to("cuda"), 2)
    if kernel == "grid":
        # its vertices are in several parts in the adjoint's solve
        fields(pd.Simulator(pd.Scene(pd.Solid(bar(11, 9, 9), 1e5)), 1 / 60, **options).to("cuda"), 2)
    with compiled_for(kernel, KERNEL_CASES[kernel][0]):
        free = scene(KERNEL_CASES[kernel][0].mesh, contacts=True, pieces=True, pins=False)
        step_all_ways(pd.Simulator(free, 1 / 60, 5, **options).to("cuda"), 2)
    if kernel == "grid":
        built = scene(BAR, contacts=True, pieces=True, pins=True)
        with compiled_for(kernel, KERNEL_CASES[kernel][0]):
            many = pd.Simulator(built, 1 / 60, 5, solver=SOLVERS[0], tolerance=1e-2, **options).to("cuda")
        many.plan = in_many_patches(many)
        step_all_ways(many, 3)
        count += 1
    return count + 1


def large_patches(dtype: torch.dtype) -> int:
    """Run one step of each mesh."""
    for case in KERNEL_CASES["large"]:
        with compiled_for("large", case) as name:
            built = scene(case.mesh, contacts=False, pieces=False, pins=False)
            sim = pd.Simulator(built, 1 / 60, 5, dtype=dtype, kernel=name, progress=False).to("cuda")
        sim(sim.rest_state(2))
    return len(KERNEL_CASES["large"])


def several_environments(dtype: torch.dtype) -> int:
    """Few environments, and enough to share blocks on an H100. In float64 they never share."""
    if dtype == torch.float64:
        return 0
    count = 0
    for case, (contacts, pieces) in itertools.product(
        KERNEL_CASES["several"], ((False, False), (False, True), (True, True))
    ):
        built = scene(case.mesh, contacts=contacts, pieces=pieces, pins=True)
        for solver, tolerance in ((SOLVERS[0], 0.0), (SOLVERS[0], 1e-2), (SOLVERS[1 + count % 2], 0.0)):
            options: dict[str, Any] = {"solver": solver, "tolerance": tolerance, "progress": False}
            sim = pd.Simulator(built, 1 / 60, 5, kernel="block", **options).to("cuda")
            # the last block has fewer environments than the others
            many = sim.rest_state(6 * properties_of(sim.device).multiprocessors + 7)
            sim(many, return_info=not tolerance)
            if tolerance == 0.0:
                step_all_ways(sim, 3)
            count += 1
    # some blocks take further environments when done
    sim.set_material(stiffness=sim.stiffness[0], masses=sim.masses[0])
    sim(sim.rest_state(40 * properties_of(sim.device).multiprocessors + 3))
    return count + 1


def run(kernel: str) -> int:
    """Run all of a kernel in both precisions; returns the number of simulators."""
    if kernel == "cluster" and properties_of(torch.device("cuda", 0)).cluster == 1:
        print("no clusters: this GPU has none (compute capability 9.0)")
        return 0
    special = {"levels": levels, "patches": free_form, "large": large_patches, "several": several_environments}
    count = 0
    for dtype in DTYPES:
        count += special[kernel](dtype) if kernel in special else every_way(kernel, dtype)
        rotations(dtype)
    torch.cuda.synchronize()
    return count


# ---- which instantiations run


def plain(name: str) -> str:
    """The name of a kernel without arguments and blanks, which demanglers place differently."""
    return "".join(kernel_name(name).split())


def expected_kernels(*, clusters: bool) -> set[str]:
    """All kernels of the table."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        names = {plain(row["kernel"]) for row in csv.DictReader(file)}
    return {name for name in names if clusters or not ("::fused_step<" in name and "::Blocks)1," in name)}


def launches(seen: profile) -> Counter[str]:
    """Launches of this library's kernels."""
    names = (plain(event.name) for event in seen.events() if event.device_type == DeviceType.CUDA)
    return Counter(name for name in names if name.startswith("pd::"))


def report_missing(ran: Counter[str], expected: set[str]) -> bool:
    """Print and return whether exactly the expected kernels ran."""
    for name, times in sorted(ran.items()):
        print(f"{times:7} {name}")
    missing, unknown = sorted(expected - ran.keys()), sorted(ran.keys() - expected)
    for name in missing:
        print(f"never ran: {name}")
    for name in unknown:
        print(f"not in {TABLE.name}: {name}; tools/cuda_check.py --table makes it anew")
    print(f"{len(expected) - len(missing)} of {len(expected)} kernels have run")
    return not missing and not unknown


# ---- the program


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", nargs="+", choices=RUNS, default=RUNS)
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--plant", choices=("memcheck", "initcheck", "racecheck"), help="plant an error; see above")
    only.add_argument("--list", action="store_true", help="list the kernels that run; fail if one never does")
    options = parser.parse_args(words)
    if not torch.cuda.is_available():
        parser.error("torch finds no CUDA device")
    if options.plant:
        if refusal := why_not_plant(options.plant, options.kernel):
            parser.error(refusal)
        plant(options.plant, *options.kernel)
        print(f"a kernel has run with an error in it; where {options.plant} has reported none, it sees none")
        return 0
    ran: Counter[str] = Counter()
    for kernel in options.kernel:
        begin = time.perf_counter()
        with profile(activities=[ProfilerActivity.CUDA]) if options.list else nullcontext() as seen:
            count = run(kernel)
        print(f"{kernel}: {count} simulators in {time.perf_counter() - begin:.1f} s", flush=True)
        if seen is not None:
            ran += launches(seen)
    if not options.list:
        return 0
    clusters = properties_of(torch.device("cuda", 0)).cluster > 1
    return 0 if report_missing(ran, expected_kernels(clusters=clusters)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
