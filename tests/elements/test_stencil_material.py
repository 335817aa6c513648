"""Material of cloth, rods, springs, ties and fibres: shapes, environments, checks, transformations of a step."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from runs import noise
from sheets import cloth
from torch import Tensor

import torchpd as pd

NAMES = {
    "membrane_youngs": 32, "membrane_poisson": 32, "thickness": 32, "bending": 42, "rest_curvature": 42,
    "spring_stiffness": 5, "rest_length": 5, "tie_stiffness": 1, "fibre_stiffness": 6, "fibre_length": 6,
    "thread_stiffness": 32,
}  # fmt: skip


def everything(dtype: torch.dtype = torch.float64) -> pd.Simulator:
    """A sheet of 32 triangles with 40 hinges, two of them curved, a rod of 3 segments, springs, a tie and fibres."""
    solid = pd.Solid(pd.shapes.box((1, 0.3, 0.3), (1, 1, 1)), 1e5)
    sheet = cloth(bending=1e-3, rest_curvature=0.1 * (np.arange(40) < 2), warp=20.0, grain=(1.0, 0.0, 0.0))
    rod = pd.Rod(np.linspace((0.0, 1, 0), (1, 1, 0), 4), 1e6, 1e-2)
    parts = (
        pd.Springs(rod, [[0, 2], [3, 1]], 50.0, other=sheet),
        pd.Tie(sheet, [0], solid, [[0.1, 0.1, 0.1]], stiffness=30.0),
        pd.Fibres(solid, (1, 0, 0), 1e4, activation=0.2),
        pd.Pin(solid, [0, 1, 2]),
        pd.Gravity(),
    )
    return pd.Simulator(pd.Scene(sheet, solid, rod, *parts), 1 / 60, 30, dtype=dtype, progress=False)


def moving(sim: pd.Simulator, batch: int) -> pd.State:
    x, v = sim.rest_state(batch)
    return pd.State(x + 0.01 * noise(x, 1), 0.1 * noise(v, 2))


def test_a_scene_has_the_arrays_of_its_kinds() -> None:
    sim = everything()
    assert {name: len(getattr(sim, name)) for name in sim.material_names[-len(NAMES) :]} == NAMES
    assert not any(parameter.requires_grad for parameter in sim.parameters())


@pytest.mark.parametrize("name", NAMES)
def test_each_environment_steps_with_its_own(name: str) -> None:
    """One number, [rows], [B, 1] and [B, rows] give the bits of environments that are alone."""
    sim, count = everything(), NAMES[name]
    state = moving(sim, 3)
    own = getattr(sim, name).detach().clone()
    factors = torch.tensor([0.8, 1.0, 1.1], dtype=torch.float64)
    rows = factors[:, None] * (own.mean() + 0.01) * torch.linspace(0.9, 1.0, count, dtype=torch.float64)
    changes = []
    for batched, alone in ((rows, rows.unbind()), (rows[:, :1], [float(row[0]) for row in rows])):
        sim.set_material(**{name: batched})
        assert getattr(sim, name).shape == (3, count)
        whole = sim(state)
        changes.append(whole.positions)
        for number, value in enumerate(alone):
            sim.set_material(**{name: value})
            assert getattr(sim, name).shape == (count,)
            one = sim(pd.State(*(part[number : number + 1] for part in state)))
            assert torch.equal(whole.positions[number], one.positions[0])
    sim.set_material(**{name: own})
    assert not any(torch.equal(positions, sim(state).positions) for positions in changes)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"membrane_youngs": 0.0}, "membrane_youngs must be positive"),
        ({"membrane_poisson": 1.0}, r"membrane_poisson must be in \(-1, 1\)"),
        ({"thickness": -1e-3}, "thickness must be positive"),
        ({"bending": -1.0}, "bending must be >= 0"),
        ({"bending": math.inf}, "bending must be finite"),
        ({"spring_stiffness": torch.ones(4)}, r"spring_stiffness must be \[5\].*got \[4\]; springs of the scene: 5"),
        ({"bending": torch.ones(2, 4)}, r"bending must be \[42\].*got \[2, 4\]; hinges of the scene: 42"),
        ({"tie_stiffness": -2.0}, "tie_stiffness must be >= 0"),
        ({"fibre_length": math.nan}, "fibre_length must be finite"),
        ({"poisson": 0.3}, r"no array 'poisson'.*every elastic solid has poisson=0.0"),
        ({"activation": 0.3}, r"no array 'activation'.*targets"),
        ({"area_density": 0.3}, r"no array 'area_density'.*masses"),
    ],
)
def test_what_no_step_can_use_is_refused(arrays: dict[str, Any], message: str) -> None:
    sim = everything(torch.float32)
    before = [array.clone() for array in sim.material()]
    with pytest.raises((ValueError, TypeError), match=message):
        sim.set_material(**arrays)
    assert all(map(torch.equal, before, sim.material()))


def test_an_array_that_the_scene_lacks_is_refused() -> None:
    sim = pd.Simulator(pd.Scene(cloth(bending=0.0)))
    with pytest.raises(TypeError, match=r"no array 'tie_stiffness'.*the scene has no tie"):
        sim.set_material(tie_stiffness=1.0)
    with pytest.raises(TypeError, match=r"no array 'bending'.*the scene has no hinge"):
        sim.set_material(bending=1.0)
    flat = pd.Simulator(pd.Scene(cloth(bending=1e-3)), progress=False)
    with pytest.raises(TypeError, match=r"no array 'rest_curvature'.*give a Cloth or a Rod another"):
        flat.set_material(rest_curvature=1.0)


def test_functional_call_vmap_and_rollout_give_the_bits_of_loops() -> None:
    sim = everything()
    state = moving(sim, 2)
    names = ("membrane_youngs", "spring_stiffness", "fibre_length", "rest_curvature")
    rows = [getattr(sim, name).detach() * torch.tensor([[0.9], [1.0], [1.2]], dtype=torch.float64) for name in names]

    def step(x: Tensor, *given: Tensor) -> Tensor:
        after: pd.State = torch.func.functional_call(sim, dict(zip(names, given, strict=True)), (pd.State(x, 0 * x),))
        return after.positions

    mapped = torch.vmap(step, in_dims=(None, *[0] * len(names)))(state.positions, *rows)
    for number in range(3):
        assert torch.equal(mapped[number], step(state.positions, *(array[number] for array in rows)))
    track = sim.rollout(state, 3)
    for number in range(3):
        state = sim(state)
        assert torch.equal(track.positions[number], state.positions)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_of_a_step_by_every_array(name: str) -> None:
    """Central differences of a sum of positions, with steps that are solved."""
    sim = everything()
    sim.iterations = 1500
    if name == "rest_curvature":
        sim.set_material(rest_curvature=0.5)  # a flat hinge has no first derivative by its curvature
    state = moving(sim, 1)
    array = getattr(sim, name).detach().clone().requires_grad_()
    weights = noise(state.positions, 3)

    def read(array: Tensor) -> Tensor:
        after: pd.State = torch.func.functional_call(sim, {name: array}, (state,))
        return (weights * after.positions).sum()

    (gradient,) = torch.autograd.grad(read(array), array)
    direction = noise(array.detach(), 4)
    size = 1e-4 * float(array.detach().abs().max())
    with torch.no_grad():
        difference = (read(array + size * direction) - read(array - size * direction)) / (2.0 * size)
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=1e-4)


def test_trained_rows_of_every_body_are_saved(tmp_path: Path) -> None:
    sim = everything(torch.float32)
    sim.set_material(bending=torch.tensor([[1e-3], [2e-3]]), rest_length=0.9, fibre_stiffness=2e4)
    sim.membrane_youngs.data *= torch.linspace(0.9, 1.1, 32)
    sim.membrane_youngs.requires_grad_()
    sim.save(tmp_path / "all.safetensors")
    loaded = pd.Simulator.load(tmp_path / "all.safetensors")
    for name in sim.material_names:
        assert torch.equal(getattr(sim, name), getattr(loaded, name)), name
        assert getattr(sim, name).requires_grad == getattr(loaded, name).requires_grad
    assert [type(part) for part in loaded.scene.parts] == [type(part) for part in sim.scene.parts]
    state = moving(sim, 2)
    one, other = sim.rollout(state, 3), loaded.rollout(state, 3)
    assert torch.equal(one.positions, other.positions)
    assert torch.equal(one.velocities, other.velocities)
