"""Runs every CUDA kernel on tiny meshes, for NVIDIA's sanitizer, which makes a program a hundred times slower:

compute-sanitizer --tool memcheck python tools/sanitize.py          and racecheck, initcheck, synccheck
PYTORCH_NO_CUDA_MEMORY_CACHING=1 makes every tensor an allocation of its own, so that memcheck sees its end.

Mesh and device decide which instantiation of a kernel runs. `--list`, without a sanitizer, has the profiler say which
ran, and exits with 1 where one of benchmarks/results/cuda-registers.csv did not. The scenes are chosen for an H100.

That a tool reports nothing says something if it would report an error. `--plant TOOL` makes one that TOOL must report,
for each kernel in a process of its own, since memcheck ends the one in which it finds something:

PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool memcheck --error-exitcode 86 \\
    python tools/sanitize.py --plant memcheck --kernel grid             has to exit with 86, whatever else it prints

memcheck    an array of the plan lacks its last number, or a patch ends behind its list: a kernel reads behind it
initcheck   nobody has written the velocities that a step starts with, or the amplitudes of the patches
racecheck   all pairs of a patch leave their forces in the same place of shared memory; the ops of free-form patches
            have no shared memory, so there is none for them
For synccheck there is none: the threads of a block part for no argument.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
import trimesh
from cuda_check import kernel_name
from torch import Tensor
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

import torchpd as pd
from torchpd import multilevel, regimes
from torchpd.device_plan import compile_device_plan
from torchpd.gpu import properties_of
from torchpd.plan import KERNELS as PLAN_KERNELS
from torchpd.plan import Plan
from torchpd.render import Camera
from torchpd.tables import DEVICE_PLAN_TABLE, MATERIAL_TABLE

TABLE = Path(__file__).resolve().parent.parent / "benchmarks" / "results" / "cuda-registers.csv"
DTYPES = (torch.float32, torch.float64)
SOLVERS = (pd.Chebyshev(), pd.Jacobi(), pd.Chebyshev("classic", rho=0.9, delay=1))
ops = torch.ops.torchpd


def bar(*cells: int) -> pd.TetMesh:
    """Of cells of 10 cm."""
    return pd.shapes.box(0.1 * np.array(cells), cells)


def cones(subdivisions: int) -> pd.TetMesh:
    """A ball whose tetrahedra share its centre: the patch that owns it has all of them, and few other vertices."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    corners = np.column_stack([np.zeros(len(sphere.faces), dtype=np.int64), sphere.faces + 1])
    return pd.TetMesh(0.1 + 0.1 * np.concatenate([np.zeros((1, 3)), sphere.vertices]), corners)


def crumbs(count: int) -> pd.TetMesh:
    """Tetrahedra that share no vertex: many slots for little work."""
    corners = 0.01 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    place = 0.02 * np.column_stack(np.unravel_index(np.arange(count), (9, 9, 9)))
    return pd.TetMesh((place[:, None] + corners).reshape(-1, 3), np.arange(4 * count).reshape(-1, 4))


class Way(NamedTuple):
    """What a kernel runs with: a mesh, and constants of torchpd.regimes that decide how many patches there are."""

    mesh: pd.TetMesh
    constants: dict[str, Any]


BAR = bar(6, 2, 2)
SMALL, LARGE = dict.fromkeys(DTYPES, 24), {torch.float32: 2304, torch.float64: 960}
# The smallest that were found for all instantiations. "far" is a grid whose patches have several tetrahedra and several
# vertices a thread, "large" a stream of such patches, and of one with more slots than a pipeline counts. "several" is
# "block" in float32 of meshes so small that many environments share blocks.
WAYS = {
    # of several small ones a block: of each one with few registers, two of two rounds, two of one
    "several": (Way(bar(4, 2, 2), {}), Way(BAR, {}), Way(bar(2, 2, 2), {})),
    # all vertex arrays are in shared memory; not all: in float32, in float64
    "block": (Way(bar(9, 2, 2), {}), Way(bar(40, 1, 1), {}), Way(bar(4, 2, 2), {})),
    # four lanes a vertex, in few threads and in many; eight, in few and in many
    "cluster": (
        Way(bar(4, 2, 2), {"_CLUSTER_EACH": 60}),
        Way(bar(4, 4, 2), {"_CLUSTER_EACH": 150}),
        Way(cones(1), {"_CLUSTER_EACH": 10}),
        Way(cones(2), {"_CLUSTER_EACH": 40}),
    ),
    "grid": (Way(BAR, {"_GRID_TETS": 8}),),
    "far": (Way(bar(99, 1, 1), {"_GRID_TETS": 594}),),
    "stream": (
        Way(BAR, {"_STREAM_TETS": SMALL}),
        Way(crumbs(9), {"_STREAM_TETS": SMALL}),  # more parts of pieces than a block has warps that move them
    ),
    "large": (Way(bar(19, 20, 1), {"_STREAM_TETS": LARGE}), Way(crumbs(129), {"_STREAM_TETS": LARGE})),
}
KERNELS = tuple(WAYS)
RUNS = (*KERNELS, "levels", "patches")  # and what the multilevel solver runs with, and the ops of free-form patches


@contextmanager
def compiled_for(kernel: str, way: Way) -> Iterator[str]:
    """The name that a simulator knows one of KERNELS by, which meanwhile has the patches of a way."""
    with mock.patch.dict(vars(regimes), way.constants):
        yield {"far": "grid", "large": "stream", "several": "block"}.get(kernel, kernel)


def scene(mesh: pd.TetMesh, *, contacts: bool, pieces: bool, pins: bool) -> pd.Scene:
    """Two bodies, the second of which is free where pieces are wanted, and tips on the ground."""
    tilt = np.array([[0.96, 0.28, 0.0], [-0.28, 0.96, 0.0], [0.0, 0.0, 1.0]])
    places = (mesh.vertices, mesh.vertices @ tilt + [0.0, 0.0, 1.5])
    bodies = [pd.Solid(pd.TetMesh(vertices, mesh.tets), 1e5) for vertices in places]
    held = bodies[:1] if pieces else bodies
    parts: list[pd.scene.Part] = [*bodies, pd.Gravity(), pd.Damping(0.5)]
    if pins:
        for body in held:
            parts += [pd.Pin(body, np.arange(9)), pd.Pin(body, len(mesh.vertices) - np.arange(1, 3), 1e3)]
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
        solve(sim, batch, w)


def solve(sim: pd.Simulator, batch: int, stiffness: torch.Tensor) -> None:
    """Conjugate gradients without contacts, with them and with what slides, from the first iteration and the second."""
    x, plan = sim.rest_state(batch).positions * 1.1, list(sim.plan.arrays)
    diagonal = ops.elastic_diagonal(stiffness, plan, weighted=True)
    inertia, inverse = 0.1 * diagonal, 1.0 / (1.1 * diagonal)
    active = torch.full((batch, 4), -1.0, dtype=torch.float64, device=x.device)
    projector = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape, 3)
    sliding = 0.1 * x.unsqueeze(-2).expand(*x.shape[:2], 5, 3).contiguous()
    for held, slides in ((None, None), (projector, None), (projector, sliding)):
        vectors = [torch.empty_like(x), 0.01 * x, torch.empty_like(x), active.clone()]
        for iterations in (2, 1):
            ops.conjugate_gradients_(
                *vectors, x, inertia, inverse, held, stiffness, plan, slides, tolerance=0.0, iterations=iterations
            )


def adjoint(sim: pd.Simulator, batch: int) -> None:
    """What stands around the solve, for a scene's contacts and without them."""
    x, plan, h = sim.rest_state(batch).positions, list(sim.plan.arrays), sim.time_step
    d, error = 0.01 * x, torch.zeros(batch, dtype=torch.float64, device=x.device)
    material = [array.detach() for array in sim.material()]
    names = [row.name for row in MATERIAL_TABLE]
    freed = [t[..., :0, :] if name in ("planes", "spheres") else t for name, t in zip(names, material, strict=True)]
    for arrays, forces in ((material, d), (material, None), (freed, None)):
        right, _, _, *held = ops.adjoint_system(d, d, x + d, x, d, forces, arrays, plan, time_step=h)
        contacts = (d, d, *held) if arrays is material else ()
        ops.adjoint_result(right, error, d, sim.masses, sim.damping, *contacts, time_step=h)


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
    arrays = compile_device_plan(sim.scene.values(), 48, PLAN_KERNELS.index("grid"), sim.dtype, progress=False)
    plan = Plan(arrays, DEVICE_PLAN_TABLE).to("cuda")
    if not bool((plan.slot_sender[:, 7] > 0).any()):
        raise RuntimeError("no vertex has more than seven patches")
    return plan


def levels(dtype: torch.dtype) -> int:
    """The multilevel solver: one block an environment, several, and several environments one after another.

    By levels, then directly.
    """
    small, large = BAR, bar(14, 4, 4)
    ways = (
        ("lbfgs", False, small, 3, 0),
        ("lbfgs", True, large, 2, 0),
        ("momentum", True, small, 2, 0),
        ("lbfgs", True, small, 3, 1024),
        ("lbfgs", False, large, 2, 1024),
        ("corotated", True, small, 3, 0),
        ("corotated", False, large, 2, 1024),
    )
    for outer, contacts, mesh, batch, most_direct in ways:
        built = scene(mesh, contacts=contacts, pieces=contacts, pins=True)
        solver = pd.Multilevel(outer)  # type: ignore[arg-type]
        options: dict[str, Any] = {"solver": solver, "tolerance": 1e-2 * contacts, "dtype": dtype}
        iterations = 5 if outer == "corotated" else 3  # the small problem is made after three
        with mock.patch.object(multilevel, "MOST_DIRECT", most_direct):
            sim = pd.Simulator(built, 1 / 60, iterations, progress=False, **options).to("cuda")
            step_all_ways(sim, batch)
            ops.precondition(sim.rest_state(batch).positions, list(sim.plan.arrays))
            solve(sim, batch, sim.stiffness)
    built = scene(BAR, contacts=False, pieces=False, pins=True)
    many = pd.Simulator(built, 1 / 60, 1, solver=pd.Multilevel(), dtype=dtype, progress=False)
    many.to("cuda")(many.rest_state(300))
    solve(many, 300, many.stiffness)
    torch.cuda.synchronize()
    return len(ways) + 1


def ball_of_patches(**options: Any) -> pd.FreeFormPatches:
    """Free-form patches, in float64 as they are made."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    centres = torch.tensor(ball.vertices[::2])
    amplitudes = torch.tensor(0.02 * np.random.default_rng(0).choice([-1.0, 1.0], len(centres)))
    quadrics = pd.Quadrics.from_radii(amplitudes, centres, torch.full((len(centres),), 0.4, dtype=torch.float64))
    mesh = pd.TriMesh.from_trimesh(ball)
    return pd.FreeFormPatches.from_mesh(mesh, quadrics, dtype=torch.float64, **options)


def samples_everywhere(patches: pd.FreeFormPatches) -> pd.PatchSamples:
    """On the edges of the patches and inside of each, of the last one too."""
    return patches.tessellate(3).samples


def free_form(dtype: torch.dtype) -> int:
    """Every op of free-form patches and its adjoint, two poses at once."""
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
    """All instantiations of a kernel of KERNELS; everything that a step can have with the first mesh."""
    count = 0
    flags = list(enumerate(itertools.product((False, True), repeat=2)))
    for way in WAYS[kernel]:
        with compiled_for(kernel, way) as name:
            options: dict[str, Any] = {"dtype": dtype, "kernel": name, "progress": False}
            # of the others all but contacts of bodies that are held, which have the kernels of loose ones
            for number, (contacts, pieces) in flags if way is WAYS[kernel][0] else flags[:2] + flags[3:]:
                solver, tolerance = SOLVERS[number % len(SOLVERS)], 1e-2 if number % 2 else 0.0
                built = scene(way.mesh, contacts=contacts, pieces=pieces, pins=True)
                sim = pd.Simulator(built, 1 / 60, 5, solver=solver, tolerance=tolerance, **options).to("cuda")
                step_all_ways(sim, 3)
                count += 1
                if kernel == "stream" and dtype == torch.float32 and not contacts:
                    # so many patches that blocks go from one to another, and know of the next by turns
                    many = pd.Simulator(built, 1 / 60, 5, solver=solver, tolerance=tolerance, **options).to("cuda")
                    many(many.rest_state(70 * properties_of(sim.device).multiprocessors // sim.plan.patches))
                    count += 1
        fields(sim, 3)
        adjoint(sim, 3)
    if kernel == "block":
        # whose block has a multiprocessor to itself, and several slots a thread
        mesh = bar(9, 9, 9) if dtype == torch.float32 else bar(6, 6, 6)
        fields(pd.Simulator(pd.Scene(pd.Solid(mesh, 1e5)), 1 / 60, **options).to("cuda"), 2)
    if kernel == "grid":
        # whose vertices are several parts in the adjoint's solve
        fields(pd.Simulator(pd.Scene(pd.Solid(bar(11, 9, 9), 1e5)), 1 / 60, **options).to("cuda"), 2)
    with compiled_for(kernel, WAYS[kernel][0]):
        free = scene(WAYS[kernel][0].mesh, contacts=True, pieces=True, pins=False)
        step_all_ways(pd.Simulator(free, 1 / 60, 5, **options).to("cuda"), 2)
    if kernel == "grid":
        sim.plan = in_many_patches(sim)
        step_all_ways(sim, 3)
        count += 1
    return count + 1


def large_patches(dtype: torch.dtype) -> int:
    """One step of each mesh."""
    for way in WAYS["large"]:
        with compiled_for("large", way) as name:
            built = scene(way.mesh, contacts=False, pieces=False, pins=False)
            sim = pd.Simulator(built, 1 / 60, 5, dtype=dtype, kernel=name, progress=False).to("cuda")
        sim(sim.rest_state(2))
    return len(WAYS["large"])


def several_environments(dtype: torch.dtype) -> int:
    """Few of them, and as many as share blocks on an H100. In float64 none do."""
    if dtype == torch.float64:
        return 0
    count = 0
    for way, (contacts, pieces) in itertools.product(WAYS["several"], ((False, False), (False, True), (True, True))):
        built = scene(way.mesh, contacts=contacts, pieces=pieces, pins=True)
        for solver, tolerance in ((SOLVERS[0], 0.0), (SOLVERS[0], 1e-2), (SOLVERS[1 + count % 2], 0.0)):
            options: dict[str, Any] = {"solver": solver, "tolerance": tolerance, "progress": False}
            sim = pd.Simulator(built, 1 / 60, 5, kernel="block", **options).to("cuda")
            # the last block has fewer than the others
            many = sim.rest_state(6 * properties_of(sim.device).multiprocessors + 7)
            sim(many, return_info=not tolerance)
            if tolerance == 0.0:
                step_all_ways(sim, 3)
            count += 1
    # some blocks have others once they are done
    sim.set_material(stiffness=sim.stiffness[0], masses=sim.masses[0])
    sim(sim.rest_state(40 * properties_of(sim.device).multiprocessors + 3))
    return count + 1


def run(kernel: str) -> int:
    """How many simulators have run, in both precisions."""
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
    """The name of a kernel without what it takes, and without blanks, which demanglers set in different places."""
    return "".join(kernel_name(name).split())


def expected_kernels(*, clusters: bool) -> set[str]:
    """All of the table."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        names = {plain(row["kernel"]) for row in csv.DictReader(file)}
    return {name for name in names if clusters or not ("::fused_step<" in name and "::Blocks)1," in name)}


def launches(seen: profile) -> Counter[str]:
    """Of our kernels."""
    names = (plain(event.name) for event in seen.events() if event.device_type == DeviceType.CUDA)
    return Counter(name for name in names if name.startswith("pd::"))


def say_what_ran(ran: Counter[str], expected: set[str]) -> bool:
    """Whether all did that are expected to, and no others."""
    for name, times in sorted(ran.items()):
        print(f"{times:7} {name}")
    missing, unknown = sorted(expected - ran.keys()), sorted(ran.keys() - expected)
    for name in missing:
        print(f"never ran: {name}")
    for name in unknown:
        print(f"not in {TABLE.name}: {name}; tools/cuda_check.py --table makes it anew")
    print(f"{len(expected) - len(missing)} of {len(expected)} kernels have run")
    return not missing and not unknown


# ---- controls


def change_plan(sim: pd.Simulator, name: str, change: Callable[[Tensor], Tensor]) -> None:
    """Puts another array into the plan."""
    rows = zip(sim.plan.table, sim.plan.arrays, strict=True)
    sim.plan = replace(sim.plan, arrays=tuple(change(array) if row.name == name else array for row, array in rows))


def ends_alone(array: Tensor) -> Tensor:
    """The array, of a size that lets nothing begin at its end."""
    if array.numel() * array.element_size() % 256 == 0:  # allocations begin at multiples of it
        raise RuntimeError("what lies behind may be another tensor; take a scene of another size")
    return array


def without_last(array: Tensor) -> Tensor:
    """The size of part_slot is the only one that no other number of the plan tells: the ops take it as it comes."""
    return ends_alone(array[:-1].clone())


def into_one_place(corners: Tensor) -> Tensor:
    """Every corner that has an entry gets the first one: in the upper 16 bits, 65535 where there is none."""
    return torch.where(corners >> 16 == -1, corners, corners & 65535)


def behind_list(patches: pd.FreeFormPatches) -> pd.FreeFormPatches:
    """The last patch has an entry more than there are."""
    names = dict(zip(("triangles", "patch_start", "entry_quadric"), patches.lists, strict=False))
    ends_alone(names["entry_quadric"])
    names["patch_start"][-1] += 1
    return patches


def plant_in_patches(tool: str) -> None:
    """Heights in which `tool` must find an error."""
    patches = ball_of_patches().to("cuda")
    samples = samples_everywhere(patches)
    if tool == "memcheck":
        patches = behind_list(patches)
    else:
        q = patches.quadrics
        unwritten = replace(q, amplitudes=torch.empty_like(q.amplitudes))
        patches = patches.with_quadrics(unwritten, keep_lists=True)
    patches.heights(samples)


def planted_scene(kernel: str) -> pd.Scene:
    """Of a mesh that is not so small that a block has one warp, which has nobody to race with."""
    mesh = WAYS[kernel][0].mesh if kernel in ("block", "far", "large") else BAR
    return scene(mesh, contacts=False, pieces=True, pins=False)


def plant_in_step(tool: str, kernel: str) -> None:
    """A step in which `tool` must find an error."""
    with compiled_for(kernel, Way(BAR, {}) if kernel == "levels" else WAYS[kernel][0]) as name:
        options: dict[str, Any] = {"solver": pd.Multilevel()} if kernel == "levels" else {"kernel": name}
        sim = pd.Simulator(planted_scene(kernel), 1 / 60, 5, progress=False, **options).to("cuda")
    state = sim.rest_state(2)
    if tool == "memcheck":
        change_plan(sim, "part_slot", without_last)
    elif tool == "initcheck":
        state = pd.State(state.positions, torch.empty_like(state.velocities))
    else:
        change_plan(sim, "pair_corner", into_one_place)
    sim.step_(state)


def plant(tool: str, kernel: str) -> None:
    """An error that `tool` must find."""
    if kernel == "patches":
        plant_in_patches(tool)
    else:
        plant_in_step(tool, kernel)
    torch.cuda.synchronize()


# ---- the program


def why_not_plant(tool: str, kernels: Sequence[str]) -> str:
    """What keeps an error from being made; empty where nothing does."""
    if len(kernels) != 1:
        return "--plant wants one kernel: --kernel grid"
    if tool == "racecheck" and kernels[0] == "patches":
        return "the ops of free-form patches have no shared memory that racecheck could look at"
    if tool != "racecheck" and os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING") != "1":
        return "the tool sees single tensors with PYTORCH_NO_CUDA_MEMORY_CACHING=1 alone"
    return ""


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", nargs="+", choices=RUNS, default=RUNS)
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--plant", choices=("memcheck", "initcheck", "racecheck"), help="make an error; see above")
    only.add_argument("--list", action="store_true", help="say which kernels run, and whether any never does")
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
    return 0 if say_what_ran(ran, expected_kernels(clusters=clusters)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
