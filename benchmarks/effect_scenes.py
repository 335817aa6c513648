"""Scenes of `accuracy_by_kind.py`: solids with a Poisson ratio, cloth, a rod, and several kinds together.

A further scene is one entry of `EFFECT_SCENES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from iteration_by_kind import sheet

import torchpd as pd
from torchpd.scene.solvers import Solver

GRAVITY = (0.0, -9.8, 0.0)


@dataclass(frozen=True)
class EffectScene:
    """A scene, the time step, and the motion before the step that is studied."""

    title: str
    scene: Callable[[], pd.Scene]
    time_step: float  # s
    start: Callable[[pd.State], None]  # changes the state of rest
    steps_before: int = 0  # nearly converged steps from there

    def simulator(self, dtype: torch.dtype, iterations: int | None, solver: Solver | str | None = None) -> pd.Simulator:
        """A simulator of the scene on the CPU; Chebyshev without a solver."""
        return pd.Simulator(self.scene(), self.time_step, iterations, solver, dtype, progress=False)

    @torch.no_grad()
    def state(self, iterations: int = 1024) -> pd.State:
        """The state before the studied step, in float64 as rounded to float32."""
        sim = self.simulator(torch.float64, iterations)
        state = sim.rest_state()
        self.start(state)
        for _ in range(self.steps_before):
            state = sim(state)
        return state.to(torch.float32).to(torch.float64)


def _beam(poisson: float) -> EffectScene:
    """The beam of `python -m torchpd study beam`, at 1e5 Pa."""

    def scene() -> pd.Scene:
        mesh = pd.shapes.box((1.0, 0.2, 0.2), (25, 5, 5))
        body = pd.Solid(mesh, youngs=1e5, poisson=poisson)
        return pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity(GRAVITY))

    def start(state: pd.State) -> None:
        state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2

    return EffectScene(f"beam, 1e5 Pa, nu = {poisson:g}", scene, 1 / 30, start)


def _cloth(stiffness: float) -> EffectScene:
    """A sheet of 31 x 31 vertices that falls from the horizontal, held at two corners: it folds."""

    def scene() -> pd.Scene:
        body = pd.Cloth(sheet((30, 30)), stiffness / 1e-3, 1e-3, 0.2, poisson=0.0, bending=1e-6)
        return pd.Scene(body, pd.Pin(body, [0, 30]), pd.Gravity(GRAVITY))

    return EffectScene(f"cloth, {stiffness:g} N/m", scene, 1 / 60, lambda state: None, steps_before=24)


def _rod_scene() -> pd.Scene:
    body = pd.Rod(np.linspace((0.0, 1.0, 0.0), (1.0, 1.0, 0.0), 41), youngs=1e7, radius=5e-3)
    return pd.Scene(body, pd.Pin(body, [0, 1]), pd.Gravity(GRAVITY))


def _mixed_scene() -> pd.Scene:
    """A sheet that hangs along x from an edge, and pulls a bar with fibres that is tied to the other edge."""
    cloth = pd.Cloth(sheet((20, 20)), 1e6, 1e-3, 0.2, bending=1e-5)
    bar = pd.shapes.box((0.1, 0.1, 1.0), (2, 2, 20)).translated((1.0, -0.05, 0.0))
    body = pd.Solid(bar, youngs=1e5, density=100.0, poisson=0.3)
    edge = cloth.surface.vertices[:, 0]
    return pd.Scene(
        cloth, body, pd.Fibres(body, (0.0, 0.0, 1.0), stiffness=1e5), pd.Tie(cloth, edge == 1.0, body, stiffness=1e3),
        pd.Pin(cloth, edge == 0.0), pd.Gravity((9.8, 0.0, 0.0)),
    )  # fmt: skip


def _draped_scene() -> pd.Scene:
    """A sheet, its middle tied to the top of a cube with fibres. The corners fall, and it buckles over the edges."""
    cube = pd.shapes.box((0.4, 0.4, 0.4), (6, 6, 6))
    body = pd.Solid(cube, youngs=1e5, poisson=0.3)
    cloth = pd.Cloth(sheet((20, 20)).translated((-0.3, 0.4, -0.3)), 1e6, 1e-3, 0.2, bending=1e-5)
    middle = (np.abs(cloth.surface.vertices[:, ::2] - 0.2) < 0.15).all(1)
    return pd.Scene(
        body, cloth, pd.Fibres(body, (0.0, 1.0, 0.0), stiffness=1e5), pd.Tie(cloth, middle, body, stiffness=1e3),
        pd.Pin(body, cube.vertices[:, 1] == 0.0), pd.Gravity(GRAVITY),
    )  # fmt: skip


def _plastic_scene() -> pd.Scene:
    """A bar that is thrown sideways so hard that it yields near its held end."""
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (20, 4, 4))
    body = pd.Solid(mesh, youngs=1e6, poisson=0.3, plastic=pd.Plastic(yield_strain=0.02))
    return pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity(GRAVITY))


def _thrown(state: pd.State) -> None:
    state.velocities[..., 1] = -2.0 * state.positions[..., 0] ** 2


def _flung(state: pd.State) -> None:
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2


def _swung(state: pd.State) -> None:
    state.velocities[..., 1] = 2.0 * state.positions[..., 0] ** 2


def _pushed(state: pd.State) -> None:
    state.velocities[..., 0] = 2.0 * state.positions[..., 1] ** 2


EFFECT_SCENES = {
    "beam 0": _beam(0.0),
    "beam 0.3": _beam(0.3),
    "beam 0.45": _beam(0.45),
    "plastic": EffectScene("bar that yields, 1e6 Pa, nu = 0.3", _plastic_scene, 1 / 60, _flung, steps_before=4),
    "cloth 1e3": _cloth(1e3),
    "cloth 1e4": _cloth(1e4),
    "rod": EffectScene("rod, 1e7 Pa", _rod_scene, 1 / 60, _thrown, steps_before=4),
    "mixed": EffectScene("cloth tied to a bar with fibres", _mixed_scene, 1 / 60, _swung, steps_before=8),
    "draped": EffectScene("cloth that buckles over a cube", _draped_scene, 1 / 60, _pushed, steps_before=8),
}
