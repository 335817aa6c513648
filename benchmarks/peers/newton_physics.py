"""Newton (newton-physics, on Warp): SolverVBD, SolverXPBD, SolverStyle3D; on the CPU (one thread) or a GPU (a graph).

VBD has the stable Neo-Hookean energy. At Poisson ratio 0 (mu = E / 2, lambda = 0) it agrees with this library's for
small strain. XPBD has two constraints per tetrahedron, tr(F^T F) - 3 and det F - 1. They resist shear to second order
only and need lambda > 0, so no setting gives this library's material; here lambda = mu.

Cloth at Poisson ratio 0: VBD's membrane is the stable Neo-Hookean one, its bending the squared dihedral angle with
kb L / A per edge of length L and triangles of total area A. Style3D has springs along the two axes and against their
shear, and the bending of this library, with kb / 3. Both agree with this library's cloth for small strain and angles.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpd.study.scenes import DENSITY

from .problem import AREA_DENSITY, Method, MissingPackageError, Problem, Sheet
from .timing import fastest

Array = NDArray[np.float64]
_RELAXATION = 0.1  # of XPBD: the default 0.9 diverges on these meshes; 0.3 diverges or converges elsewhere


def packages() -> tuple[Any, Any]:
    try:
        import newton
        import warp
    except ImportError as error:
        raise MissingPackageError(f"Newton is left out: {error}; pip install newton warp-lang") from error
    warp.config.log_level = warp.LOG_WARNING if hasattr(warp, "LOG_WARNING") else warp.config.log_level
    return newton, warp


def versions() -> dict[str, str]:
    newton, warp = packages()
    return {"newton": newton.__version__, "warp": warp.__version__}


def neo_hookean_cloth(builder: Any, problem: Sheet, body: dict[str, Any]) -> None:
    builder.add_cloth_mesh(
        **body, density=AREA_DENSITY, tri_ke=problem.youngs / 2.0, tri_ka=0.0, tri_kd=0.0, edge_kd=0.0
    )  # fmt: skip
    edges, vertices = np.array(builder.edge_indices), problem.mesh.vertices
    inner = (edges[:, :2] >= 0).all(axis=1)
    first, second, begin, end = np.moveaxis(vertices[edges], 1, 0)
    areas = sum(np.linalg.norm(np.cross(end - begin, corner - begin), axis=1) for corner in (first, second)) / 2.0
    bend = np.where(inner, problem.bending * np.linalg.norm(end - begin, axis=1) / areas, 0.0)
    builder.edge_bending_properties = [(float(stiffness), 0.0) for stiffness in bend]


def _style3d_cloth(builder: Any, problem: Sheet, body: dict[str, Any]) -> None:
    newton, warp = packages()
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    newton.solvers.style3d.add_cloth_mesh(
        builder, **body, density=AREA_DENSITY,
        panel_verts=[warp.vec2(float(z), float(x)) for x, _, z in problem.mesh.vertices],
        tri_aniso_ke=warp.vec3(problem.youngs, problem.youngs, problem.youngs / 2.0),
        edge_aniso_ke=warp.vec3(0.0, 0.0, 0.0), tri_kd=0.0, edge_kd=0.0,
    )  # fmt: skip
    builder.edge_bending_properties = [(problem.bending / 3.0, 0.0)] * len(builder.edge_indices)


def _model(problem: Problem, device: str, lame: float, add: Callable[..., None]) -> Any:
    newton, warp = packages()
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=problem.gravity)
    body = {
        "pos": warp.vec3(0.0, 0.0, 0.0), "rot": warp.quat_identity(), "scale": 1.0, "vel": warp.vec3(0.0, 0.0, 0.0),
        "vertices": [warp.vec3(*map(float, vertex)) for vertex in problem.mesh.vertices],
        "indices": problem.body().elements.reshape(-1).tolist(),
        "particle_radius": 1e-6,  # a larger one makes the vertices of a mesh collide with each other
    }  # fmt: skip
    if isinstance(problem, Sheet):
        add(builder, problem, body)
    else:
        builder.add_soft_mesh(
            **body, density=DENSITY, k_mu=problem.youngs / 2.0, k_lambda=lame, k_damp=0.0, add_surface_mesh_edges=False
        )  # fmt: skip
    for vertex in problem.held:
        builder.particle_mass[vertex] = 0.0
        builder.particle_flags[vertex] &= ~int(newton.ParticleFlags.ACTIVE)
    builder.color()
    return builder.finalize(device=device)


def _method(
    problem: Problem, device: str, name: str, note: str, lame: float, add: Callable[..., None] = neo_hookean_cloth
) -> Method:
    newton, warp = packages()
    model = _model(problem, device, lame, add)
    before, after, control = model.state(), model.state(), model.control()
    positions = problem.start.astype(np.float32)
    start = [
        warp.array(array.astype(np.float32), dtype=warp.vec3, device=device)
        for array in (positions, problem.velocities)
    ]
    solvers: dict[int, Any] = {}

    def make(iterations: int) -> Any:
        if name == "Newton XPBD":
            return newton.solvers.SolverXPBD(model, iterations=iterations, soft_body_relaxation=_RELAXATION)
        if name == "Newton VBD":
            return newton.solvers.SolverVBD(model, iterations=iterations, particle_enable_self_contact=False)
        config = newton.solvers.SolverStyle3D.Config(iterations=iterations)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints how long it takes
            found = newton.solvers.SolverStyle3D(model, config=config)
        found.collision = None
        return found

    def solver(iterations: int) -> Any:
        if iterations not in solvers:
            solvers.clear()
            solvers[iterations] = make(iterations)
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


def style3d(problem: Sheet, device: str) -> Method:
    """Projective dynamics with 10 iterations of conjugate gradients, the default, in each of its own."""
    note = "10 iterations of conjugate gradients in each; forces without an energy"
    return _method(problem, device, "Newton Style3D", note, 0.0, _style3d_cloth)
