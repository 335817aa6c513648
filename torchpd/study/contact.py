"""What accuracy costs where bodies meet: error, gap and momentum of a step against its time, and the path of a motion.

Five scenes: two cubes hit each other, a block slides on a plate, three cubes stand on each other, a cloth falls over a
ball, and plates squeeze a cube. Every row takes one step and the whole motion with as many iterations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ..accuracy.candidates import DEFAULT_ITERATIONS
from ..accuracy.error import settled_steps
from ..api.simulator import Simulator
from ..geometry import shapes
from ..scene.cloth import Cloth
from ..scene.contact import Collider, Contact
from ..scene.effects import Gravity, Solid
from ..scene.scene import Part, Scene
from ..simulation.state import HistoryState
from .bench import Bench, elements_of, precision_name, row_statuses
from .results_log import Array, Row

__all__ = ["CONTACT_SCENES", "ContactScene", "contact_rows", "momentum_error"]

TIME_STEP = 1 / 60  # s
_CONVERGED = 1024  # iterations of the motion that others are compared with
_STEPS = 60  # of a motion: one second

Targets = dict[Part, Tensor]


@dataclass(frozen=True)
class ContactScene:
    """A scene in which bodies meet. One step of it is studied after `steps_before` steps."""

    parts: Callable[[], Sequence[Part]]
    steps_before: int
    speeds: tuple[tuple[float, float, float], ...] = ()  # of the first bodies at the start, m/s
    closing: float = 0.0  # way of each of the last two colliders, down and up, within the first half of the motion, m

    def simulator(self, dtype: torch.dtype, iterations: int) -> Simulator:
        """A new simulator of the scene."""
        return Simulator(Scene(*self.parts()), TIME_STEP, iterations, dtype=dtype, batch=1, progress=False)

    def start(self, sim: Simulator) -> HistoryState:
        """The state at the start of the motion."""
        state = cast(HistoryState, sim.rest_state())
        for body, speed in zip(sim.scene.bodies, self.speeds, strict=False):
            state.velocities[..., sim.scene.vertex_range(body), :] = torch.tensor(speed).to(state.velocities)
        return state

    def targets(self, sim: Simulator, step: int) -> Targets | None:
        """Poses of the colliders that move, at the end of a step."""
        if not self.closing:
            return None
        way = self.closing * min(1.0, 2.0 * (step + 1) / _STEPS)
        heights = zip(sim.scene.colliders[-2:], (-way, way), strict=True)
        return {part: torch.tensor([0, y, 0, 1.0, 0, 0, 0], dtype=sim.dtype, device=sim.device) for part, y in heights}


def _cube(youngs: float, place: tuple[float, float, float], cells: int = 3, side: float = 0.1) -> Solid:
    mesh = shapes.box((side,) * 3, (cells,) * 3).translated(place)
    return Solid(mesh, youngs=youngs, density=1000.0)


def _plate(height: float, side: float = 0.8) -> Collider:
    return Collider(shapes.sheet((side, side), (4, 4)).translated((0.0, height, 0.0)))


def _meet() -> Sequence[Part]:
    return _cube(1e5, (-0.11, 0.0, 0.0)), _cube(1e5, (0.01, 0.02, 0.01)), Contact(friction=0.3, thickness=1e-3)


def _slide() -> Sequence[Part]:
    body = _cube(1e5, (-0.05, 0.001, -0.05))
    return body, _plate(0.0), Contact(friction=0.4, thickness=1e-3), Gravity()


def _stack() -> Sequence[Part]:
    bodies = [_cube(1e6, (-0.05, 0.001 + 0.101 * number, -0.05)) for number in range(3)]
    return *bodies, _plate(0.0), Contact(friction=0.5, thickness=1e-3), Gravity()


def _drape() -> Sequence[Part]:
    mesh = shapes.sheet((0.4, 0.4), (16, 16)).translated((0.0, 0.13, 0.0))
    cloth = Cloth(mesh, 1e5, 1e-3, 0.2, bending=1e-5)
    ball = Collider(shapes.sphere(0.1))
    return cloth, ball, Contact(friction=0.3, thickness=2e-3), Gravity()


def _squeeze() -> Sequence[Part]:
    low, high = _plate(-0.055, 0.3), _plate(0.055, 0.3)
    return _cube(1e5, (-0.05, -0.05, -0.05)), high, low, Contact(friction=0.5, thickness=1e-3)


CONTACT_SCENES: dict[str, ContactScene] = {
    "two cubes hit": ContactScene(_meet, 1, ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))),
    "a block slides": ContactScene(_slide, 10, ((2.0, 0.0, 0.0),)),
    "three cubes in a stack": ContactScene(_stack, 2),
    "a cloth over a ball": ContactScene(_drape, 12),
    "a cube between plates": ContactScene(_squeeze, _STEPS // 2, closing=0.02),
}


def momentum_error(sim: Simulator, state: HistoryState, after: HistoryState, targets: Targets | None = None) -> float:
    """Momentum that a step of free bodies changed without a force from outside, as a share of all forces.

    |sum m a + sum F| / (sum |m a| + sum |F|), with m a = m (v' - v) / h - m g of vertices, and F [N] on colliders.
    """
    masses = sim.masses.double().reshape(-1, 1)
    pushes = masses * ((after.velocities[0] - state.velocities[0]).double() / sim.time_step - sim.gravity.double())
    on_colliders = sim.contact_forces(state, after, targets=targets).on_colliders[0, :, :3].double()
    whole = float(pushes.norm(dim=1).sum() + on_colliders.norm(dim=1).sum())
    return float((pushes.sum(0) + on_colliders.sum(0)).norm()) / whole if whole > 0.0 else 0.0


@torch.no_grad()
def contact_rows(bench: Bench, name: str, counts: list[int], *, steps: int = _STEPS) -> list[Row]:
    """A step of a scene in float32 at several iteration counts, against its converged step in float64.

    `error` is that of the step, with friction. `more` has `gap`, the least distance over the thickness, `momentum`, see
    `momentum_error`, `crosses`, 0 or 1 by exact signs, and `path`. That is the largest distance of a vertex from the
    motion of 1024 iterations, over the largest displacement.
    """
    scene = CONTACT_SCENES[name]
    sim = scene.simulator(torch.float32, _CONVERGED).to(bench.device)
    states, paths = _motion(scene, sim, steps)
    before = min(scene.steps_before, steps - 1)
    state, targets = states[before], scene.targets(sim, before)
    exact = settled_steps(sim, state, targets=targets)[0]
    rows = []
    for count in counts:
        sim.iterations = count
        after, info = sim(state, targets=targets, return_info=True)
        error = exact.position_error((after.velocities[0] * sim.time_step).double().cpu().numpy())
        timing = bench.time(lambda: sim(state, targets=targets))
        _, own = _motion(scene, sim, steps)
        more = {
            "gap": float(info.contact_gap[0]),
            "momentum": momentum_error(sim, state, after, targets),
            "crosses": float(_crosses(sim, after)),
            "path": _distance(own, paths),
        }
        rows.append(
            Row(
                axis="contact", method=name, precision=precision_name(sim.dtype), iterations=count, local_steps=count,
                time_step=sim.time_step, vertices=sim.vertices, tets=elements_of(exact), error=error,
                uncertainty=exact.uncertainty, residual=float(info.residual[0]),
                status=row_statuses([error], exact.uncertainty)[0], default=count == DEFAULT_ITERATIONS,
                more=more, **timing.columns(),
            )
        )  # fmt: skip
    return rows


def _motion(scene: ContactScene, sim: Simulator, steps: int) -> tuple[list[HistoryState], Array]:
    """All states of a motion, and its positions [steps + 1, V, 3] m."""
    states = [scene.start(sim)]
    for step in range(steps):
        states.append(sim(states[-1], targets=scene.targets(sim, step)))
    return states, np.stack([state.positions[0].double().cpu().numpy() for state in states])


def _distance(path: Array, exact: Array) -> float:
    """The largest distance of a vertex between two motions, over its largest displacement in the second."""
    away = float(np.linalg.norm(path - exact, axis=2).max()) / float(np.linalg.norm(exact - exact[0], axis=2).max())
    return away if math.isfinite(away) else math.inf


def _crosses(sim: Simulator, state: HistoryState) -> bool:
    try:
        sim.check(state)
    except ValueError:
        return True
    return False
