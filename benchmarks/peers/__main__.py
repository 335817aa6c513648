"""One step of a body or a cloth in Newton's solvers, in MuJoCo's flex, and here: error against time.

All have the same mesh, lumped masses, density, Young's modulus, gravity, time step 1/30 s and start; the Poisson ratio
is 0 where the method allows it. A method is judged by the distance from its own converged solution,
|u - u*| / |u_0 - u*| with u_0 = h v for all. Differences of the material therefore do not count; the distance from this
library's solution stands beside it.

VBD and XPBD take one step with n iterations, as this library does. u* of VBD is the minimum of its energy in float64;
its own longest run agrees with that to the rounding of float32. u* of XPBD is its longest run, if that has settled.
MuJoCo has no iterations: it and this library take the same 1/30 s in n steps, and u* has the most steps.

Cloth has no contact with itself. Its step is 1/60 s, in VBD and Style3D. Style3D's forces have no energy: u* is
where they balance, by Newton's method in float64.

Newton and MuJoCo are optional: pip install newton warp-lang mujoco. Missing ones are reported and left out.
Measured cases are kept: an interrupted run resumes.

    python -m benchmarks.peers --cells 3 5 8 12 --youngs 1e4 1e5 1e6 1e7 --out benchmarks/results/peers-cpu.json
    python -m benchmarks.peers --device cuda --cells 3 5 8 12 --out benchmarks/results/peers-cuda.json
    python -m benchmarks.peers --mesh bunny.mesh
    python -m benchmarks.peers --cells --cloth hanging folded --out benchmarks/results/peers-cloth-cpu.json
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from tqdm.auto import tqdm

import torchpd as pd
from torchpd.common.provenance import describe_run
from torchpd.scene.solvers import Solver

from . import converged, mujoco_flex, newton_physics, ours, style3d
from .problem import Array, Method, MissingPackageError, Problem, Sheet, beam, folded, from_file, hanging
from .report import draw, table

GOALS = (1e-1, 1e-2, 1e-3)
LONGEST = 4096  # iterations of a method
LONGEST_OF_CLOTH = 4 * LONGEST
# substeps of a frame; the last gives the converged solution
SUBSTEPS = {
    "torchpd, substeps": [2**k for k in range(10)],
    "MuJoCo flex, substeps": [2**k for k in range(10)],
}
CLOTH: dict[str, Callable[[float], Problem]] = {"hanging": hanging, "folded": folded}
SETTLED = 1e-2  # relative change over the second half of a longest run
Row = dict[str, Any]
Answer = tuple[Array, float]  # u* and its remaining residual, or the change of the last doubling


def _own_end(method: Method, longest: int) -> Answer:
    """The method's solution after `longest` iterations, and its change over the second half of them."""
    half, end = method.run(longest // 2), method.run(longest)
    change = float(np.linalg.norm(end - half) / max(np.linalg.norm(end), 1e-300))
    if not change < SETTLED:
        raise RuntimeError(f"does not settle: the answers of {longest // 2} and {longest} differ by {change:.1g}")
    return end, change


def _solvers(problem: Problem, device: str) -> dict[str, Callable[[], tuple[Method, Answer]]]:
    """Methods of one implicit Euler step, each with its own converged solution."""

    def neo_hookean() -> tuple[Method, Answer]:
        method = newton_physics.vbd(problem, device)
        if isinstance(problem, Sheet):
            return method, converged.minimise(problem, converged.of_sheet(problem), method.run(LONGEST))
        density = converged.stable_neo_hookean(problem.youngs / 2.0, 0.0)
        return method, converged.minimise(problem, converged.of_tetrahedra(problem, density))

    def constraints() -> tuple[Method, Answer]:
        method = newton_physics.xpbd(problem, device)
        return method, _own_end(method, 4 * LONGEST if len(problem.mesh.vertices) < 1000 else LONGEST)

    def springs() -> tuple[Method, Answer]:
        assert isinstance(problem, Sheet)
        method = newton_physics.style3d(problem, device)
        return method, style3d.balance(problem, exact[0])

    def ours_by(solver: Solver, dtype: torch.dtype = torch.float32) -> tuple[Method, Answer]:
        method = ours.step(problem, device, solver, f"torchpd {type(solver).__name__}", dtype)
        # a folded sheet has several minima: each solver has its own
        own = isinstance(problem, Sheet) and not isinstance(solver, pd.Chebyshev)
        return method, ours.converged(problem, solver) if own else exact

    exact = ours.converged(problem)
    if isinstance(problem, Sheet):
        return {
            "torchpd Chebyshev": lambda: ours_by(pd.Chebyshev()),
            "torchpd Chebyshev, float64": lambda: ours_by(pd.Chebyshev(), torch.float64),
            "torchpd Multilevel": lambda: ours_by(pd.Multilevel("lbfgs")),
            "Newton VBD": neo_hookean,
            "Newton Style3D": springs,
        }
    return {
        "torchpd Chebyshev": lambda: ours_by(pd.Chebyshev()),
        "torchpd Multilevel": lambda: ours_by(pd.Multilevel()),
        "Newton VBD": neo_hookean,
        "Newton XPBD": constraints,
    }


def _frames(problem: Problem, device: str) -> dict[str, Callable[[], tuple[Method, Answer]]]:
    """Methods whose accuracy depends on the time step only."""

    def judged(name: str, make: Callable[[Problem, str], Method]) -> tuple[Method, Answer]:
        method, most = make(problem, device), SUBSTEPS[name][-1]
        return method, _own_end(method, most)

    makers = (ours.substeps, mujoco_flex.flex)
    return {name: partial(judged, name, make) for name, make in zip(SUBSTEPS, makers, strict=True)}


def measure(problem: Problem, name: str, method: Method, end: Answer, counts: list[int], seconds: float) -> Row:
    """Errors and times at growing counts, until the last goal or a run of `seconds`."""
    exact, left = end
    points = []
    for count in counts:
        found = method.run(count)
        took = method.milliseconds(count)
        reached = problem.error(found, exact)
        points.append({"count": count, "milliseconds": took, "error": reached})
        if reached <= 0.5 * GOALS[-1] or took > 1e3 * seconds:
            break
    return {"method": name, "left_of_converged": left, "note": method.note, "points": points}


def run_problem(problem: Problem, options: argparse.Namespace, known: dict[str, Row]) -> list[Row]:
    """A row for every method; missing or refused methods keep a row with the reason."""
    longest = LONGEST_OF_CLOTH if isinstance(problem, Sheet) else LONGEST
    iterations = [2**k for k in range(int(np.log2(longest)) + 1)]
    cases = {name: (make, iterations) for name, make in _solvers(problem, options.device).items()}
    if len(problem.mesh.vertices) <= options.frames and not isinstance(problem, Sheet):
        cases.update({name: (make, SUBSTEPS[name][:-2]) for name, make in _frames(problem, options.device).items()})
    rows = []
    for name, (make, counts) in cases.items():
        if name in known:
            rows.append(known[name])
            continue
        rows.append(_measured(problem, name, make, counts, options))
    return rows


def _ours(problem: Problem, name: str, device: str) -> Array:
    """This library's solution for a method's problem: the converged step, or the frame with the most substeps."""
    if name in SUBSTEPS:
        return ours.substeps(problem, device).run(SUBSTEPS["torchpd, substeps"][-1])
    return ours.converged(problem)[0]


def _measured(
    problem: Problem,
    name: str,
    make: Callable[[], tuple[Method, Answer]],
    counts: list[int],
    options: argparse.Namespace,
) -> Row:
    try:
        method, end = make()
    except (RuntimeError, ValueError) as reason:  # the latter from Multilevel, which does not take cloth on a GPU
        tqdm.write(f"{problem.name}, {problem.youngs:g} {problem.unit}, {name}: {reason}")
        return {
            "method": name,
            "refused": str(reason),
            "missing": isinstance(reason, MissingPackageError),
            "points": [],
        }
    row = measure(problem, name, method, end, counts, options.seconds)
    return {**row, "own_answer_from_ours": problem.error(end[0], _ours(problem, name, options.device))}


def versions() -> dict[str, str]:
    """Versions of the installed simulators; missing ones are named."""

    def ask(package: ModuleType) -> dict[str, str]:
        try:
            found: dict[str, str] = package.versions()
        except MissingPackageError as reason:
            print(reason)
            return {}
        return found

    return {**ask(newton_physics), **ask(mujoco_flex)}


def main(words: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--cells", type=int, nargs="*", default=[3, 5], help="cells of beams: 3 5 8 12 have 256 to 10309 vertices"
    )
    parser.add_argument("--mesh", nargs="*", default=[], help="tetrahedral meshes, besides the beams")
    parser.add_argument("--cloth", nargs="*", choices=CLOTH, default=[], help="sheets of 961 vertices")
    parser.add_argument("--youngs", type=float, nargs="*", default=[1e4, 1e5, 1e6, 1e7], help="Young's moduli [Pa]")
    parser.add_argument(
        "--membrane", type=float, nargs="*", default=[1e3, 1e4], help="Young's modulus times thickness of cloth [N/m]"
    )
    parser.add_argument(
        "--seconds", type=float, default=5.0, help="time limit of a run, after which a method stops (%(default)g)"
    )
    parser.add_argument(
        "--frames", type=int, default=1000, help="most vertices for a comparison of substeps (%(default)s)"
    )
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (%(default)s)")
    parser.add_argument("--out", type=Path, help="output file (JSON)")
    parser.add_argument("--figure", type=Path, help="picture file of the errors against time")
    options = parser.parse_args(words)
    torch.set_num_threads(options.threads)
    stored = json.loads(options.out.read_text())["rows"] if options.out and options.out.exists() else []
    rows = {(row["problem"], row["youngs"]): row for row in stored}
    peers = versions()
    run = describe_run(
        shlex.join(["python", "-m", "benchmarks.peers", *words]), torch.device(options.device), options.threads
    )
    run["versions"].update(peers)
    sources = [*(lambda youngs, c=cells: beam(c, youngs) for cells in options.cells),
               *(lambda youngs, p=path: from_file(p, youngs) for path in options.mesh)]  # fmt: skip
    cases = [(make, youngs) for make in sources for youngs in options.youngs]
    cases += [(CLOTH[name], youngs) for name in options.cloth for youngs in options.membrane]
    for make, youngs in tqdm(cases, desc="problems", unit="problem"):
        problem = make(youngs)
        known = {
            m["method"]: m for m in rows.get((problem.name, youngs), {}).get("methods", []) if not m.get("missing")
        }
        rows[problem.name, youngs] = {
            "problem": problem.name, "vertices": len(problem.mesh.vertices), "elements": len(problem.body().elements),
            "youngs": youngs, "unit": problem.unit, "methods": run_problem(problem, options, known),
        }  # fmt: skip
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps({"schema": 1, **run, "rows": list(rows.values())}, indent=1) + "\n")
    print(table(list(rows.values()), GOALS))
    if options.figure:
        draw(list(rows.values()), options.figure)


if __name__ == "__main__":
    main(sys.argv[1:])
