"""Text of `print(sim)`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from .. import _C
from ..common.checks import NO_VALUES
from ..common.tables import KINDS, MULTILEVEL_TABLE
from ..estimate.convergence import FAR_TOO_FEW, forecast, has_contacts, is_bound
from ..plan.cpu_plan import quoted_choices
from ..plan.kernel_choice import shared_bytes
from ..plan.placement import step_bytes
from ..plan.preconditioner import has_preconditioner
from ..scene.cloth import Cloth
from ..scene.fibres import Fibres
from ..scene.part import Body
from ..scene.rod import Rod
from ..scene.scene import Scene
from ..scene.solvers import Chebyshev, Multilevel, Newton, Solver
from ..scene.springs import Springs
from ..scene.tie import Tie

if TYPE_CHECKING:
    from ..accuracy.tuning_result import TuningResult
    from ..plan.contact_plan import ContactPlan
    from ..plan.cpu_plan import Plan
    from ..simulation.stepper import Stepper

__all__ = ["contact_bytes", "describe", "workspace_bytes"]

# cost of an effect that only changes the weights and targets, which every vertex has anyway
_FOLDED = "part of the vertex weights: no cost per iteration"

# cost of stencils
_LOCAL = "a local step each per iteration"

# kinds of stencils of solids
_OF_SOLIDS = {
    "solid_limit": "strain limits",
    "volume": 'law "volume"',
    "damper": "stiffness-proportional damping",
    "plastic": "plastic flow",
}

_ANY_BATCH = 2**31 - 1
_MODES = 6  # of a piece of the coarse space of Multilevel("lbfgs"), see csrc/solver/multilevel/pieces.h


def _solver_line(sim: Stepper) -> str:
    settings = sim.solver.settings()
    name = "Jacobi"
    if isinstance(sim.solver, Chebyshev):
        name = f"Chebyshev {sim.solver.schedule}"
    if isinstance(sim.solver, Multilevel):
        name = f"Multilevel {sim.solver.outer}"
    if isinstance(sim.solver, Newton):
        name = "Newton"
    stop = f"at most {sim.iterations}" if sim.tolerance else f"{sim.iterations}"
    rho = f", rho {settings['rho']:g}" if settings["rho"] else ""
    diagonal = "weighted" if settings["weighted"] else "plain"
    tolerance = f", tolerance {sim.tolerance:g}" if sim.tolerance else ""
    return (
        f"solver: {name}: {stop} iterations, relaxation {settings['relaxation']:g}, {diagonal} diagonal{rho}{tolerance}"
    )


def _expectation_lines(sim: Stepper) -> list[str]:
    """The reason for the choice of "auto", and the error expected of the iterations."""
    lines = [] if sim.choice is None else [f"chosen because {sim.choice.why}"]
    scene = sim.compiled
    expected = forecast(scene)
    if expected is not None:
        left = expected.error(sim.iterations)
        verdict = f"; {sim.iterations} leave about {left:.1g}: far too few" if left > FAR_TOO_FEW else ""
        hardest = " when a stiff body lands" if has_contacts(scene) else " in the worst case"
        hardest = hardest if is_bound(scene) else ""
        counts = " and ".join(f"{error:g} after {expected.words(error)}" for error in (1e-2, 1e-3))
        buckles = any(isinstance(body, (Cloth, Rod)) for body in sim.scene.bodies)
        # compressed parts have a smaller second derivative than inertia alone, which no weight knows
        verdict += "; more where cloth or rods buckle" if buckles and not is_bound(scene) else ""
        lines.append(f"expected{hardest}: an error of {counts} iterations, estimated from the weights{verdict}")
        if sim.tolerance and expected.iterations(sim.tolerance) > sim.iterations:
            words = expected.words(sim.tolerance)
            lines.append(
                f"tolerance {sim.tolerance:g} needs {words} iterations: few steps will reach it in {sim.iterations}"
            )
    return lines


def _tuning_lines(sim: Stepper, result: TuningResult | None) -> list[str]:
    if result is None:
        return []
    stale = "" if result.matches(sim) else "; no longer valid, since settings have changed"
    return [f"tuned: {result}{stale}"]


def _preconditioner_lines(sim: Stepper) -> list[str]:
    """Levels and bytes of the matrix of `Multilevel`, or of gradients."""
    plan = sim.plan
    if not has_preconditioner(plan.arrays):
        return []
    whose = "" if isinstance(sim.solver, Multilevel | Newton) else " of gradients"
    _, _, nodes, _, _, below, direct, *_ = plan.level_sizes.tolist()
    steps = [f"{plan.vertices} vertices", *(f"{count} nodes" for count in (nodes, below) if count)]
    solved = "solved directly" if direct else "the last solved directly"
    own = sum(array.numel() * array.element_size() for array in plan.arrays[-len(MULTILEVEL_TABLE) :])
    return [f"preconditioner{whose}: {' > '.join(steps)}, {solved}; {own:,} B of the plan"]


def _effect_lines(sim: Stepper) -> list[str]:
    scene = sim.scene
    lines = [*_body_lines(scene), *_stencil_lines(scene)]
    if any(solid.mesh.fill is not None for solid in scene.solids):
        lines.append(
            "fill: stiffness and masses are multiplied by the fill of each tetrahedron (mesh.fill), unless set"
        )
    lines += _pin_lines(sim)
    if bool((sim.gravity != 0).any()):
        lines.append(f"gravity: {_FOLDED}")
    if bool((sim.damping != 0).any()):
        lines.append(f"damping: {_FOLDED}")
    if scene.pressures:
        lines.append(f"pressures: {len(scene.pressures)}, forces of a step: no cost per iteration")
    if scene.wind is not None:
        lines.append("wind: forces of a step: no cost per iteration")
    if scene.grounds:
        lines.append(f"grounds: {len(scene.grounds)}, one projection per vertex and iteration each")
    if scene.spheres:
        lines.append(f"spheres: {len(scene.spheres)}, one projection per vertex and iteration each")
    if sim.body_contact is not None:
        plan = sim.body_contact.plan
        rigid, taking = len(plan.poses), len(np.unique(plan.body[plan.edges[:, 0]]))
        moved = sum(of is not None for of in plan.rigid)
        masses = f", {moved} of them with a mass" if moved else ""
        lines.append(
            f"contact: {taking - rigid} bodies, {rigid} colliders{masses} ({len(plan.triangles)} triangles, "
            f"{len(plan.edges)} edges), thickness {plan.thickness:.3g} m, up to {plan.capacity} pairs in each "
            f"environment{', more when needed' if plan.grows else ''}"
        )
    return lines


def _body_lines(scene: Scene) -> list[str]:
    lines = []
    elastic = scene.elastic_solids
    if elastic:
        tets = sum(len(solid.mesh.tets) for solid in elastic)
        lines.append(f"solids: {len(elastic)} ({tets} tetrahedra), one local step per iteration")
    groups = [
        solid.averaging_groups
        for solid in scene.elastic_solids
        if not isinstance(solid.poisson, float) and solid.law == "corotated"
    ]
    if groups:
        most = max(int(np.bincount(numbers).max()) for numbers in groups)
        count = sum(int(numbers.max()) + 1 for numbers in groups)
        lines.append(f"Poisson's ratio: {count} groups of up to {most} tetrahedra share a volume strain")
    for kind, name in _OF_SOLIDS.items():
        own = (group for solid in scene.solids for group in solid.stencils(lambda body: 0))
        count = sum(len(group) for group in own if group.kind == kind)
        if count:
            lines.append(f"{name}: {count} tetrahedra, {_LOCAL}")
    sheets = [body for body in scene.bodies if isinstance(body, Cloth)]
    if sheets:
        words = {"triangle": "triangles", "hinge": "hinges", "thread": "threads", "cloth_limit": "strain limits"}
        sizes = _sizes_of(sheets, words)
        lines.append(f"cloth: {len(sheets)} ({sizes}), {_LOCAL}")
    rods = [body for body in scene.bodies if isinstance(body, Rod)]
    if rods:
        sizes = _sizes_of(rods, {"spring": "segments", "hinge": "bends"})
        lines.append(f"rods: {len(rods)} ({sizes}), {_LOCAL}")
    return lines


def _stencil_lines(scene: Scene) -> list[str]:
    """Springs, ties and fibres."""
    lines = []
    for name, part, kind in (("springs", Springs, "spring"), ("ties", Tie, "tie"), ("fibres", Fibres, "fibre")):
        own = [one for one in scene.parts if isinstance(one, part)]
        if own:
            count = sum(len(group) for one in own for group in one.stencils(lambda body: 0) if group.kind == kind)
            lines.append(f"{name}: {count}, {_LOCAL}")
    return lines


def _sizes_of(bodies: Sequence[Body], words: Mapping[str, str]) -> str:
    """Numbers of stencils of some bodies by kind, in words."""
    counts = dict.fromkeys(words, 0)
    for group in (group for body in bodies for group in body.stencils(lambda body: 0)):
        counts[group.kind] = counts.get(group.kind, 0) + len(group)
    return ", ".join(f"{count} {words.get(kind, kind)}" for kind, count in counts.items() if count)


def _pin_lines(sim: Stepper) -> list[str]:
    """Hard pins and springs, those of every environment first."""
    rows = sim.pin_hard.expand(1, -1) if sim.pin_hard.dim() == 1 else sim.pin_hard
    always, ever = int(rows.all(0).sum()), int(rows.any(0).sum())
    lines = []
    if always:
        lines.append(f"hard pins: {always} fixed vertices: no cost per iteration")
    if ever > always:
        lines.append(f"pins that are hard in some environments only: {ever - always}, springs in the others")
    if soft := rows.shape[1] - ever:
        lines.append(f"soft pins: {soft} springs, {_FOLDED}")
    return lines


def _pass_line(sim: Stepper) -> str:
    plan = sim.plan
    shared = len(plan.shared_start) - 1
    patches = f"{plan.patches} patch{'es' * (plan.patches > 1)}"
    second = f" and one over {shared} vertices that patches share" if shared else ""
    return (
        f"an iteration is one pass over {patches}{second}; "
        "with 8 or more environments, SIMD lanes run over environments"
    )


_LAUNCHES = {
    "block": "one thread block per environment, or several small ones, all iterations in one launch",
    "cluster": "a cluster of thread blocks, one for each patch, all iterations in one launch",
    "grid": "a thread block for each patch, all iterations in one launch",
    "stream": "a thread block for each patch, launches for every iteration",
}
_LEVEL_LAUNCHES = "some thread blocks per environment, all iterations in one launch"


def _kernel_lines(sim: Stepper) -> list[str]:
    plan = sim.plan
    kernel = str(plan.kernel)
    block = shared_bytes(plan, sim.planes.shape[-2], sim.spheres.shape[-2])
    patches = f"{plan.patches} patch{'es' * (plan.patches > 1)}, {int(plan.patch_pairs.sum())} pairs of tetrahedra"
    shared = f"{plan.size('shared')} vertices that patches share"
    if kernel == "cluster":
        copies = int((plan.pair_tet < -1).sum()), plan.size("slots") - plan.vertices
        shared = "{} copies of tetrahedra and {} of vertices".format(*copies)
    launches = _LEVEL_LAUNCHES if plan.for_multilevel else _LAUNCHES[kernel]
    others = quoted_choices([name for name in _LAUNCHES if name != kernel])
    if kernel == "block" and sim.batch is None:
        others = others.replace('"cluster"', '"cluster", faster for a few environments (batch=1)')
    # kernels whose plan is the same for every batch
    fixed = sim.kernel in ("cluster", "stream") and not plan.for_multilevel
    batch = f"; for a batch of {sim.batch}" if sim.batch and not fixed else ""
    asked = "" if has_preconditioner(plan.arrays) else f"; Simulator(..., kernel=...) can select {others}"
    return [
        f"kernel {kernel}: {launches}",
        f"mesh: {patches}, {shared}, {block:,} B of shared memory per thread block",
        f"why {kernel}: {plan.why}{batch}{asked}",
    ]


def workspace_bytes(plan: Plan, real: int, solver: Solver) -> int:
    """Memory of a CPU step for one environment [B], besides plan, material and states; `real` bytes a number."""
    # five vectors of four numbers, two weights, and the slots of patches
    numbers = 22 * plan.vertices + 8 * len(plan.slot_vertex)
    if not isinstance(solver, Multilevel | Newton):
        return real * numbers
    # four vectors of an iteration, four of a V-cycle, and eight L-BFGS pairs, whose place Newton takes for its own
    momentum = isinstance(solver, Multilevel) and solver.outer == "momentum"
    numbers += 4 * plan.vertices * (8 + (0 if momentum else 16))
    if momentum:
        return real * numbers
    if isinstance(solver, Newton):
        numbers += _hessian_numbers(plan)
    # the coarse space: two vectors, and two dense matrices of all pieces
    pieces = int(plan.level_sizes[7])
    return real * (numbers + 8 * plan.vertices) + 8 * 2 * (_MODES * pieces) ** 2


def _hessian_numbers(plan: Plan) -> int:
    """Numbers of the Hessians of Newton: rotation, twists and tension of a tetrahedron, a triangle of a stencil's."""
    numbers = 20 * plan.tet_order.numel()
    if any(row.name == "stencil_block" for row in plan.table):
        rows = [3 * kind.columns for kind in KINDS.values()]
        each = [rows[kind] * (rows[kind] + 1) // 2 for kind in plan.stencil_block[:, 0].tolist()]
        numbers += plan.stencil_order.shape[1] * sum(each)
    return numbers


def contact_bytes(plan: ContactPlan, real: int) -> int:
    """Memory of `Contact` for one environment [B]: its history, and the pairs and places of a step."""
    history = plan.capacity * (8 + 4 * real) + 7 * len(plan.poses) * real
    # a pair twice, as found and as listed, its places in the lists of four vertices, and the force of the last step
    pairs = plan.capacity * (2 * (32 + 24 * real) + 16 + 8 + 4 * real)
    return history + pairs + len(plan.rest) * 24 * real


def _step_bytes(sim: Stepper, real: int) -> str:
    """Text about the memory of a step, besides plan, material and states."""
    plan = sim.plan
    if plan.kernel is None:
        contact = 0 if sim.body_contact is None else contact_bytes(sim.body_contact.plan, real)
        return f"{workspace_bytes(plan, real, sim.solver) + contact:,} B per environment during a step"
    scene = sim.compiled
    batch = scene.environments
    each = -(-step_bytes(scene, plan, batch, sim.device) // batch)
    taken = f"{each:,} B per environment during a step{f' of {batch:,}' if batch > 1 else ''}"
    if plan.kernel == "stream" or (scene.has_stencils and batch > 1):
        return taken  # each of them may have numbers of its own stencils
    # only environments that run at the same time take memory
    return f"{taken}, at most {step_bytes(scene, plan, _ANY_BATCH, sim.device):,} B in all"


def describe(sim: Stepper, result: TuningResult | None) -> str:
    """Lines of `print(sim)`: sizes, solver, effects, passes, memory."""
    plan = sim.plan
    material = sum(array.numel() * array.element_size() for array in sim.material())
    real = torch.finfo(sim.dtype).bits // 8
    where = f"{sim.device} ({_C.build_info()['simd']})" if sim.device.type == "cpu" else str(sim.device)
    lines = [
        f"{plan.vertices} vertices, time step {sim.time_step:.6g} s, {sim.dtype} on {where}",
        _solver_line(sim),
    ]
    if sim.device.type == "meta":
        return "\n  ".join([*lines, NO_VALUES])
    lines += [
        *_expectation_lines(sim),
        *_tuning_lines(sim, result),
        *_preconditioner_lines(sim),
        *_effect_lines(sim),
        *([_pass_line(sim)] if plan.kernel is None else _kernel_lines(sim)),
        f"memory: plan {plan.bytes:,} B, material {material:,} B, {_step_bytes(sim, real)}",
    ]
    return "\n  ".join(lines)
