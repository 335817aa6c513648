"""Warnings point at the line of the user, however many frames of torchpd and of torch lie between."""

from __future__ import annotations

import _thread
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import meshio
import numpy as np
import pytest
import torch
import trimesh

import torchpd as pd

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
ONE_MORE = np.vstack([[[9.0, 9.0, 9.0]], CORNERS])
LOOSE = np.vstack([CORNERS, CORNERS * [1.0, 1.0, -1.0]])
BALL = trimesh.creation.icosphere(subdivisions=1)


def bar(iterations: int) -> pd.Simulator:
    solid = pd.Solid(pd.shapes.box((1.0, 0.2, 0.2), (4, 1, 1)), 1e5)
    return pd.Simulator(pd.Scene(solid, pd.Pin(solid, [0, 1]), pd.Gravity()), 1 / 30, iterations)


def crumpled(*, compiled: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions far from an equilibrium, where the Hessian is not positive, and a loss after one iteration."""
    sim = bar(1)
    x = 0.02 * torch.randn(2, sim.vertices, 3, generator=torch.Generator().manual_seed(5))

    def loss(positions: torch.Tensor) -> torch.Tensor:
        return sim(pd.State(positions, torch.zeros_like(x))).positions.sum()

    return x.requires_grad_(), (torch.compile(loss, backend="aot_eager") if compiled else loss)(x)


def swung() -> None:
    sim = bar(1)
    state = sim.rest_state()
    state.velocities[..., 1] = state.positions[..., 0]
    sim.tune(state, error=1e-6, most=1)


def copied() -> None:
    sim = bar(1)
    sim.set_material(stiffness=sim.stiffness * torch.ones((), requires_grad=True))


def from_file() -> None:
    file = Path("one.mesh")
    meshio.write(file, meshio.Mesh(ONE_MORE, [("tetra", np.array([[1, 2, 3, 4]]))]))
    pd.TetMesh.from_file(file)


def described() -> None:
    pd.Gravity(torch.tensor([0.0, -9.81, 0.0], requires_grad=True))


CALLS: dict[str, Callable[[], object]] = {
    "turned": lambda: pd.TetMesh(CORNERS, [[0, 2, 1, 3]]),
    "flat": lambda: pd.TetMesh(CORNERS, [[0, 1, 1, 3], [0, 1, 2, 3]], drop_degenerate=True),
    "unused": lambda: pd.TetMesh(ONE_MORE, [[1, 2, 3, 4]], drop_unreferenced=True),
    "repeated": lambda: pd.TriMesh(CORNERS[:3], [[0, 0, 1], [0, 1, 2]], drop_degenerate=True),
    "file": from_file,
    "surface": lambda: pd.tetrahedralize(
        trimesh.Trimesh(BALL.vertices, [*BALL.faces, [0, 0, 1]], process=False), cells=3
    ),
    "unmerged": lambda: pd.TetMesh(LOOSE, [[0, 1, 2, 3], [4, 6, 5, 7]]),
    "sheet": lambda: pd.tetrahedralize(pd.TriMesh(CORNERS[:3], [[0, 1, 2]]), cells=2),
    "outside": lambda: pd.embed(pd.TriMesh(CORNERS[:3] + 5.0, [[0, 1, 2]]), pd.shapes.single_tet()),
    "large": lambda: pd.Solid(pd.shapes.single_tet(100.0), 1e5),
    "far away": lambda: pd.Simulator(pd.Scene(pd.Solid(pd.shapes.single_tet().translated((1e5, 0.0, 0.0)), 1e5))),
    "few iterations": lambda: pd.Simulator(pd.Scene(pd.Solid(pd.shapes.box((2.0, 0.1, 0.1), (40, 2, 2)), 1e8)), 1 / 30),
    "copied": copied,
    "described": described,
    "tuned": swung,
    "backward": lambda: crumpled()[1].backward(),
    "compiled": lambda: crumpled(compiled=True)[1].backward(),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_warning_names_the_line_that_called(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code = CALLS[name].__code__
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        CALLS[name]()
    (warning,) = said
    lines = {line for _, _, line in code.co_lines()}
    assert (warning.filename, warning.lineno in lines) == (__file__, True)


def test_without_a_line_of_the_user_a_warning_names_its_own() -> None:
    """As in the threads in which autograd works for GPUs."""
    x, loss = crumpled()
    done = threading.Event()
    x.register_post_accumulate_grad_hook(lambda _: done.set())
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        _thread.start_new_thread(loss.backward, ())
        assert done.wait(60)
    (warning,) = said
    assert Path(warning.filename).name == "adjoint.py"
