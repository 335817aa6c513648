"""Loading with assign=True, as a part of another module, and files of torch.export."""

from __future__ import annotations

import io

import pytest
import torch

import torchpd as pd


def simulator(cells: int = 2, **options: object) -> pd.Simulator:
    mesh = pd.shapes.box((0.2, 0.1, 0.1), (cells, 1, 1))
    scene = pd.Scene(pd.Solid(mesh, 1e5, 1000.0), pd.Gravity(), pd.Ground(-0.05))
    return pd.Simulator(scene, 1 / 60, 8, progress=False, **options)  # type: ignore[arg-type]


class Policy(torch.nn.Module):
    def __init__(self, cells: int = 2) -> None:
        super().__init__()
        self.net = torch.nn.Linear(2, 2)
        self.sim = simulator(cells)

    def forward(self, state: pd.State) -> pd.State:
        after: pd.State = self.sim(state)
        return after


@pytest.mark.parametrize("part", [False, True])
def test_assigned_arrays_can_be_swapped_back(part: bool) -> None:
    """What was there before stays as it was, for whoever keeps it."""
    module = Policy() if part else simulator()
    sim = module.sim if part else module
    kept = module.state_dict()
    other = {name: 7.0 * array if "stiffness" in name else array.clone() for name, array in kept.items()}
    module.load_state_dict(other, assign=True)
    assert float(sim.stiffness[0]) == 7e5
    module.load_state_dict(kept, assign=True)
    assert float(sim.stiffness[0]) == 1e5


def test_assigned_arrays_may_be_of_a_batch() -> None:
    sim, other = simulator(), simulator()
    other.set_material(stiffness=other.stiffness * torch.tensor([[1.0], [2.0]]))
    with_batch = other.state_dict()
    sim.load_state_dict(with_batch, assign=True)
    assert sim.stiffness.shape == (2, 12)
    assert sim.stiffness.data_ptr() == with_batch["stiffness"].data_ptr()
    assert len(sim(sim.rest_state()).positions) == 2


def test_assigned_arrays_must_be_of_the_same_kind() -> None:
    sim = simulator()
    before = {name: array.clone() for name, array in sim.state_dict().items()}
    double = {name: array.double() for name, array in before.items()}
    with pytest.raises(TypeError, match=r"stiffness .*got torch\.float64"):
        sim.load_state_dict(double, assign=True)
    sim.load_state_dict(double)
    assert all(torch.equal(array, before[name]) for name, array in sim.state_dict().items())


@pytest.mark.parametrize("assign", [False, True])
def test_a_part_that_does_not_fit_is_named_among_torchs_errors(assign: bool) -> None:
    policy, other = Policy(2), Policy(3)
    before = policy.sim.stiffness.clone()
    numbers = other.state_dict()
    del numbers["net.bias"]
    with pytest.raises(RuntimeError, match=r"(?s)Policy.*net\.bias.*sim: .*stiffness must be \[12\], .*got \[18\]"):
        policy.load_state_dict(numbers, assign=assign)
    assert torch.equal(policy.sim.stiffness, before)


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["plain", "levels"])
def test_an_exported_step_is_saved_and_loaded(solver: pd.scene.solvers.Solver) -> None:
    policy = Policy()
    policy.sim = simulator(solver=solver)
    state = policy.sim.rest_state(2)
    state.velocities[..., 0] = state.positions[..., 1]
    file = io.BytesIO()
    torch.export.save(torch.export.export(policy, (state,)), file)
    file.seek(0)
    after = torch.export.load(file).module()(state)
    assert isinstance(after, pd.State)
    assert torch.equal(after.positions, policy(state).positions)
