"""Newton (newton-physics, on Warp): SolverVBD and SolverXPBD, on the CPU (one thread) or a GPU (a CUDA graph).

VBD has the stable Neo-Hookean energy. At Poisson ratio 0 (mu = E / 2, lambda = 0) it agrees with this library's for
small strain. XPBD has two constraints per tetrahedron, tr(F^T F) - 3 and det F - 1. They resist shear to second order
only and need lambda > 0, so no setting gives this library's material; here lambda = mu.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpd.study.scenes import DENSITY

from .problem import GRAVITY, Method, MissingPackageError, Problem
from .timing import fastest

Array = NDArray[np.float64]
_RELAXATION = 0.1  # of XPBD: the default 0.9 diverges on these meshes; 0.3 diverges or converges elsewhere


def _packages() -> tuple[Any, Any]:
    try:
        import newton
        import warp
    except ImportError as error:
        raise MissingPackageError(f"Newton is left out: {error}; pip install newton warp-lang") from error
    warp.config.log_level = warp.LOG_WARNING if hasattr(warp, "LOG_WARNING") else warp.config.log_level
    return newton, warp


def versions() -> dict[str, str]:
    newton, warp = _packages()
    return {"newton": newton.__version__, "warp": warp.__version__}


def _model(problem: Problem, device: str, lame: float) -> Any:
    newton, warp = _packages()
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, GRAVITY, 0.0))
    builder.add_soft_mesh(
        pos=warp.vec3(0.0, 0.0, 0.0), rot=warp.quat_identity(), scale=1.0, vel=warp.vec3(0.0, 0.0, 0.0),
        vertices=[warp.vec3(*map(float, vertex)) for vertex in problem.mesh.vertices],
        indices=problem.mesh.tets.reshape(-1).tolist(), density=DENSITY, k_mu=problem.youngs / 2.0, k_lambda=lame,
        k_damp=0.0, add_surface_mesh_edges=False,
        particle_radius=1e-6,  # a larger one makes the vertices of a mesh collide with each other
    )  # fmt: skip
    for vertex in problem.held:
        builder.particle_mass[vertex] = 0.0
        builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
    builder.color()
    return builder.finalize(device=device)


def _method(problem: Problem, device: str, name: str, note: str, lame: float) -> Method:
    newton, warp = _packages()
    model = _model(problem, device, lame)
    before, after, control = model.state(), model.state(), model.control()
    positions = problem.mesh.vertices.astype(np.float32)
    start = [
        warp.array(array.astype(np.float32), dtype=warp.vec3, device=device)
        for array in (positions, problem.velocities)
    ]
    solvers: dict[int, Any] = {}

    def solver(iterations: int) -> Any:
        if iterations not in solvers:
            solvers.clear()
            solvers[iterations] = (
                newton.solvers.SolverXPBD(model, iterations=iterations, soft_body_relaxation=_RELAXATION)
                if name == "Newton XPBD"
                else newton.solvers.SolverVBD(model, iterations=iterations, particle_enable_self_contact=False)
            )
        return solvers[iterations]

    def step(iterations: int) -> None:
        warp.copy(before.particle_q, start[0])
        warp.copy(before.particle_qd, start[1])
        solver(iterations).step(before, after, control, None, problem.time_step)

    def run(iterations: int) -> Array:
        step(iterations)
        return np.asarray(after.particle_q.numpy().astype(np.float64) - positions.astype(np.float64))

    def milliseconds(iterations: int) -> float:
        if device != "cuda":
            return fastest(lambda: step(iterations), device)
        with warp.ScopedCapture(device=device) as capture:
            step(iterations)
        return fastest(lambda: warp.capture_launch(capture.graph), device, lambda: warp.synchronize_device(device))

    return Method(name, run, milliseconds, note)


def vbd(problem: Problem, device: str) -> Method:
    """Vertex Block Descent (Chen et al. 2024), without its optional acceleration, which Newton lacks."""
    return _method(problem, device, "Newton VBD", "stable Neo-Hookean, equal to ours for small strain", 0.0)


def xpbd(problem: Problem, device: str) -> Method:
    """Extended position based dynamics (Macklin et al. 2016)."""
    return _method(problem, device, "Newton XPBD", f"relaxation {_RELAXATION}", problem.youngs / 2.0)
