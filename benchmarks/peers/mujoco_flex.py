"""MuJoCo's flex on the CPU: Saint Venant-Kirchhoff, one linearly implicit step (integrator "discrete").

It has no iterations to spend on accuracy; the time step is its only parameter. The comparison therefore covers the same
time in n substeps. Masses are lumped as in this library.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .problem import GRAVITY, Method, MissingPackageError, Problem
from .timing import fastest

Array = NDArray[np.float64]
_WARNED: list[str] = []


def _package() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise MissingPackageError(f"MuJoCo is left out: {error}; pip install mujoco") from error
    mujoco.set_mju_user_warning(_WARNED.append)
    if not hasattr(mujoco.mjtIntegrator, "mjINT_DISCRETE"):
        raise MissingPackageError(
            f'MuJoCo is left out: {mujoco.__version__} has no integrator "discrete"; pip install "mujoco>=3.13"'
        )
    return mujoco


def versions() -> dict[str, str]:
    return {"mujoco": _package().__version__}


def _words(numbers: NDArray[Any]) -> str:
    return " ".join(map(repr, numbers.reshape(-1).tolist()))


def flex(problem: Problem, device: str) -> Method:
    """The body as a flex with one vertex per body; n substeps."""
    mujoco = _package()
    if device != "cpu":
        raise MissingPackageError("MuJoCo is left out: its flex is compared on the CPU only")
    masses = problem.scene().values().masses
    xml = f"""<mujoco><option gravity="0 {GRAVITY} 0" integrator="discrete"><flag contact="disable"/></option>
<size memory="4G"/><worldbody><flexcomp name="body" type="direct" dim="3" mass="{masses.sum()}" radius="1e-4"
point="{_words(problem.mesh.vertices)}" element="{_words(problem.mesh.tets)}">
<elasticity young="{problem.youngs}" poisson="0" damping="0"/>
<contact selfcollide="none" contype="0" conaffinity="0"/><pin id="{_words(problem.held)}"/>
</flexcomp></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    free = np.setdiff1d(np.arange(len(masses)), problem.held)
    bodies = model.flex_vertbodyid[free]
    model.body_mass[bodies] = masses[free]
    mujoco.mj_setConst(model, data)
    columns = model.body_dofadr[bodies][:, None] + np.arange(3)

    def start(count: int) -> None:
        model.opt.timestep = problem.time_step / count
        mujoco.mj_resetData(model, data)
        data.qvel[columns] = problem.velocities[free]

    def substeps(count: int) -> None:
        start(count)
        for _ in range(count):
            mujoco.mj_step(model, data)

    def run(count: int) -> Array:
        _WARNED.clear()
        substeps(count)
        if any("bad" in warning.lower() or "unstable" in warning.lower() for warning in _WARNED):
            return np.full_like(problem.velocities, np.nan)
        moved = np.zeros_like(problem.velocities)
        moved[free] = data.qpos[columns]
        return moved

    return Method("MuJoCo flex", run, lambda count: fastest(lambda: substeps(count), device))
