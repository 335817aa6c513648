"""CPU benchmark scenes as data, with their goals."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

import torchpd as pd

TIME_STEP = 1 / 60  # s
YOUNGS = 1e5  # Pa
DENSITY = 1000.0  # kg/m^3

# The goals are for two threads of an AVX-512 core with 78 G float32 multiply-adds per second (4.9 G instructions of 16
# lanes). A run scales them by the rate of the same loop in its own process.
GOAL_THREADS = 2
GOAL_MULTIPLY_ADDS_PER_SECOND = 78e9  # per thread


@dataclass(frozen=True)
class Goal:
    """Goals in tet-iterations per second."""

    least: float
    aim: float


@dataclass(frozen=True)
class BenchScene:
    """Copies of a bar of 1 x 0.2 x 0.2 m that is held at one end, swings, and bends by its weight."""

    name: str
    cells: tuple[int, int, int]  # six tets each
    batch: int = 1
    iterations: int = 64
    goals: dict[str, Goal] = field(default_factory=dict)  # by precision

    def build(self) -> pd.Scene:
        """The scene of one environment."""
        mesh = pd.shapes.box((1.0, 0.2, 0.2), self.cells)
        bar = pd.Solid(mesh, youngs=YOUNGS, density=DENSITY)
        return pd.Scene(bar, pd.Pin(bar, mesh.vertices[:, 0] == 0.0), pd.Gravity((0.0, -9.81, 0.0)))

    def start(self, sim: pd.Simulator) -> pd.State:
        """At rest, with velocities v_y = -3 x^2, so that rotations are not trivial."""
        positions, velocities = sim.rest_state(self.batch)
        velocities[..., 1] = -3.0 * positions[..., 0] ** 2
        return pd.State(positions, velocities)


def _goals(float32: tuple[float, float], float64: tuple[float, float]) -> dict[str, Goal]:
    return {
        str(dtype).removeprefix("torch."): Goal(least * 1e6, aim * 1e6)
        for dtype, (least, aim) in ((torch.float32, float32), (torch.float64, float64))
    }


SCENES = (
    BenchScene("1k", (21, 3, 3), goals=_goals((90, 150), (80, 100))),
    BenchScene("10k", (26, 8, 8), goals=_goals((120, 200), (80, 100))),
    BenchScene("100k", (60, 17, 17), goals=_goals((120, 200), (80, 100))),
    BenchScene("1M", (140, 35, 34), iterations=16, goals=_goals((100, 180), (80, 100))),
    BenchScene("batch-32", (13, 3, 3), batch=32, goals=_goals((280, 450), (170, 220))),
    BenchScene("batch-256", (13, 3, 3), batch=256, goals=_goals((280, 450), (170, 220))),
)

# takes seconds in all, only to check that everything runs: the numbers mean nothing
QUICK_SCENES = (
    BenchScene("tiny", (4, 1, 1), iterations=4, goals=_goals((1, 2), (1, 2))),
    BenchScene("tiny-batch", (4, 1, 1), batch=9, iterations=4),
)
