"""Gradients preconditioned by a multilevel matrix beside any solver: `Simulator(adjoint="multilevel")`."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from runs import noise, same_bits
from torch import Tensor

import torchpd as pd
from torchpd.plan.preconditioner import has_preconditioner, stored_reference

pytestmark = pytest.mark.usefixtures("poisoned")

MESH = pd.shapes.box((0.4, 0.2, 0.2), (4, 2, 2))


def simulator(adjoint: str = "multilevel", *, mesh: pd.TetMesh = MESH, **options: Any) -> pd.Simulator:
    """A block on rough ground, in float64, some of its vertices held by hard pins and some by soft ones."""
    block = pd.Solid(mesh, 2e4, density=1000.0)
    x, y, _ = mesh.vertices.T
    hard, soft = pd.Pin(block, (x > 0.35) & (y > 0.15)), pd.Pin(block, x < 0.05, stiffness=30.0)
    scene = pd.Scene(block, hard, soft, pd.Gravity(), pd.Damping(0.5), pd.Ground(0.0, friction=0.3))
    settings = {"iterations": 3000, "tolerance": 1e-14, "dtype": torch.float64, **options}
    return pd.Simulator(scene, 1 / 60, adjoint=adjoint, **settings)


def motion(sim: pd.Simulator, batch: int = 3) -> pd.State:
    """The lower side slides."""
    state = sim.rest_state(batch)
    state.velocities[..., 0] = (0.5 * (0.4 - state.positions[..., 0])).to(sim.dtype)
    return state


def gradients(sim: pd.Simulator, state: pd.State) -> list[Tensor]:
    """For velocities and what the material has of numbers."""
    velocities = state.velocities.clone().requires_grad_()
    for name in ("stiffness", "masses", "pin_targets", "planes"):
        getattr(sim, name).requires_grad_()
    inputs = [velocities, sim.stiffness, sim.masses, sim.pin_targets, sim.planes]
    after = sim(pd.State(state.positions, velocities))
    weight = noise(state.positions)
    return list(torch.autograd.grad((weight * after.positions).sum() + (after.velocities**2).sum(), inputs))


def assert_alike(found: list[Tensor], wanted: list[Tensor], error: float = 1e-8) -> None:
    for one, other in zip(found, wanted, strict=True):
        assert float((one - other).norm()) <= error * float(other.norm())


def own_material(sim: pd.Simulator) -> None:
    """Of three environments, over a decade of stiffness."""
    factor = torch.tensor([[0.3], [1.0], [3.0]], dtype=torch.float64)
    sim.set_material(stiffness=factor * sim.stiffness, masses=sim.masses * (2.0 - 0.3 * factor))


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own"])
def test_gradients_and_steps_are_those_of_the_diagonal(own: bool) -> None:
    """With friction that slides, hard and soft pins; the step does not know of the matrix."""
    plain, sim = simulator("solver"), simulator()
    assert has_preconditioner(sim.plan.arrays)
    assert not has_preconditioner(plain.plan.arrays)
    if own:
        own_material(plain)
        own_material(sim)
    state = motion(sim)
    with torch.no_grad():
        assert same_bits(sim(state), plain(state))
    assert_alike(gradients(sim, state), gradients(plain, state))


def products(sim: pd.Simulator, state: pd.State) -> int:
    """Of the Hessian in conjugate gradients to a residual of 1e-5, by one iteration after another."""
    material = [array.detach() for array in sim.material()]
    after = sim(state).positions
    right, inertia, inverse, projector, *_ = torch.ops.torchpd.adjoint_system(
        noise(after), 0.0 * after, after, *state, None, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    solution, residual, direction = torch.zeros_like(right), right.clone(), torch.zeros_like(right)
    progress = torch.full((len(right), 4), -1.0, dtype=torch.float64)
    for done in range(1000):
        if not bool((progress[:, 2] != 0.0).any()):
            return done
        torch.ops.torchpd.conjugate_gradients_(
            solution, residual, direction, progress, after, inertia, inverse, projector, material,
            list(sim.plan.arrays), tolerance=1e-5, iterations=1,
        )  # fmt: skip
    raise AssertionError("not solved in 1000 products")


def test_it_takes_fewer_products() -> None:
    mesh = pd.shapes.box((0.4, 0.2, 0.2), (24, 12, 12))
    counts = {}
    for adjoint in ("solver", "multilevel"):
        sim = simulator(adjoint, mesh=mesh, iterations=600, tolerance=0.0)
        sim.set_material(stiffness=1e6)
        sim.prepare_solver()
        counts[adjoint] = products(sim, motion(sim, 1))
    assert 0 < 5 * counts["multilevel"] <= counts["solver"]


def test_it_is_made_when_it_is_set_and_stays_with_any_solver() -> None:
    sim = simulator("solver")
    assert sim.adjoint == "solver"
    sim.adjoint = "multilevel"
    made = sim.plan
    assert has_preconditioner(made.arrays)
    sim.solver = pd.Multilevel()
    assert sim.plan is made
    sim.adjoint = "solver"
    assert sim.plan is made
    sim.solver = pd.Chebyshev()
    assert not has_preconditioner(sim.plan.arrays)
    sim.adjoint, sim.solver = "multilevel", "auto"
    assert has_preconditioner(sim.plan.arrays)
    assert has_preconditioner(copy.deepcopy(sim).plan.arrays)
    text = str(sim)
    sim.adjoint = "solver"
    assert ("preconditioner of gradients:" in text) != isinstance(sim.solver, pd.Multilevel)
    assert "of gradients" not in str(sim)


def test_it_follows_the_material() -> None:
    """By itself where other pins hold; where stiffness changes when it is asked to."""
    sim, plain = simulator(), simulator("solver")
    state, made = motion(sim), sim.plan
    hard = torch.zeros_like(sim.pin_hard)
    hard[:2] = True
    for one in (sim, plain):
        one.set_material(pin_hard=hard)
    assert sim.plan is not made
    assert int(stored_reference(sim.plan.arrays)[1].isinf().sum()) == 2
    assert_alike(gradients(sim, state), gradients(plain, state))
    for one in (sim, plain):
        one.pin_hard.fill_(False)  # an optimiser's, or a policy's
        one.set_material(stiffness=3.0 * one.stiffness.detach())
    assert_alike(gradients(sim, state), gradients(plain, state))
    assert not bool(stored_reference(sim.plan.arrays)[1].isinf().any())
    sim.prepare_solver()
    torch.testing.assert_close(stored_reference(sim.plan.arrays)[0], sim.stiffness.detach())
    assert_alike(gradients(sim, state), gradients(plain, state))


def test_files_and_precisions_keep_it(tmp_path: Path) -> None:
    sim = simulator()
    sim.set_material(stiffness=3.0 * sim.stiffness)  # not what the matrix was made of
    state = motion(sim)
    wanted = gradients(sim, state)
    sim.save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim")
    assert loaded.adjoint == "multilevel"
    assert all(map(torch.equal, stored_reference(loaded.plan.arrays), stored_reference(sim.plan.arrays)))
    for other in (loaded, copy.deepcopy(sim)):
        assert all(torch.equal(one, two) for one, two in zip(gradients(other, state), wanted, strict=True))
    single = sim.to(torch.float32)
    assert has_preconditioner(single.plan.arrays)
    assert single.plan.dtype == torch.float32
    assert (single.adjoint, has_preconditioner(single.to("meta").plan.arrays)) == ("multilevel", True)


def test_other_values_are_refused_and_change_nothing() -> None:
    sim = simulator()
    made = sim.plan
    for value in ("diagonal", None, True):
        with pytest.raises(ValueError, match=f'adjoint must be "solver" or "multilevel", got {value!r}'):
            sim.adjoint = value
    with pytest.raises(ValueError, match=r"adjoint .*got 'cholesky'"):
        simulator("cholesky")
    assert (sim.adjoint, sim.plan) == ("multilevel", made)
