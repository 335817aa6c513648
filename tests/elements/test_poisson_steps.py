"""Steps of solids with Poisson's ratio: exact cases, iterations, gradients and material."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from cases import beam_mesh, beam_tip, box

import torchpd as pd
from torchpd.scene import Scene
from torchpd.scene.effects import Gravity, Pin, Solid
from torchpd.scene.solvers import Solver

TIME_STEP = 1.0 / 30.0
FALL = (0.0, -9.8, 0.0)
# converged step of the swinging beam without averaging: mean of the x = 1 face [m], E* [J]; independent prototype
KNOWN = {
    (1e5, 0.3): ((0.9774019721, -0.2054170812, 0.1003131148), 13.1941209022),
    (1e5, 0.45): ((0.9773636587, -0.2051780154, 0.1004013304), 13.6292909797),
    (1e6, 0.3): ((0.9627906799, -0.1820217096, 0.1008414258), 37.4949486691),
    (1e6, 0.45): ((0.9634005398, -0.1787967183, 0.1023433305), 42.4101395319),
}
# iterations to an error of 1e-1, 1e-2 and 1e-3 from the inertial start
KNOWN_CHEBYSHEV = {(1e5, 0.3): (44, 109, 172), (1e6, 0.45): (445, 730, 846)}
KNOWN_LBFGS = {(1e5, 0.45): (13, 23, 46), (1e6, 0.3): (12, 18, 41)}


def swinging(
    youngs: float, poisson: float, averaging: int = 1, dtype: torch.dtype = torch.float64
) -> tuple[Scene, pd.State]:
    """The beam of `helpers.cases`, x = 0 held and v_y = -10 x^2."""
    mesh = beam_mesh()
    body = Solid(mesh, youngs=youngs, poisson=poisson, averaging=averaging, density=1000.0)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    state = pd.State(torch.tensor(mesh.vertices[None], dtype=dtype), torch.tensor(velocities[None], dtype=dtype))
    return Scene(body, Pin(body, np.arange(36)), Gravity(FALL)), state


def bar(poisson: float, averaging: int = 1, youngs: float = 1e5, both: bool = False) -> tuple[Scene, pd.TetMesh]:
    """1 x 0.2 x 0.2 m of 240 tetrahedra, held at x = 0, and with `both` at x = 1."""
    mesh = pd.TetMesh(*box((1.0, 0.2, 0.2), (10, 2, 2)))
    body = Solid(mesh, youngs=youngs, poisson=poisson, averaging=averaging, density=1000.0)
    x = mesh.vertices[:, 0]
    held = np.flatnonzero((x < 1e-9) | (both & (x > 1.0 - 1e-9)))
    return Scene(body, Pin(body, held), Gravity(FALL)), mesh


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("youngs", "poisson"), KNOWN)
def test_converged_beam(youngs: float, poisson: float, dtype: torch.dtype) -> None:
    scene, state = swinging(youngs, poisson, dtype=dtype)
    after, info = pd.Simulator(scene, TIME_STEP, 500, pd.Multilevel(), dtype)(state, start="inertial", return_info=True)
    tip, energy = KNOWN[youngs, poisson]
    double = dtype == torch.float64
    np.testing.assert_allclose(
        after.positions[0, beam_tip()].double().mean(0), tip, atol=1e-6 if double else 2e-5, rtol=0
    )
    # the inertia of held vertices, 0.0427 J, is no part of E*
    assert abs(info.energy.item() - energy) <= (1e-6 if double else 2e-5) * energy


@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["chebyshev", "multilevel"])
@pytest.mark.parametrize("averaging", [1, 2, 4])
def test_same_bits_alone_and_in_a_batch(averaging: int, solver: Solver) -> None:
    """Seven and nineteen environments: one after another, and side by side in lanes."""
    dtype = torch.float32
    scene, state = swinging(1e5, 0.45, averaging, dtype)
    sim = pd.Simulator(scene, TIME_STEP, 12, solver, dtype)
    alone = sim(state)
    for batch in (7, 19):
        scale = torch.linspace(0.0, 2.0, batch, dtype=dtype)
        scale[3] = 1.0
        many = pd.State(state.positions.repeat(batch, 1, 1), state.velocities * scale[:, None, None])
        together = sim(many)
        assert torch.equal(together.positions[3], alone.positions[0])
        assert torch.equal(together.velocities[3], alone.velocities[0])


def test_environments_of_unlike_poisson_ratios() -> None:
    """Each environment has the bits of a simulator with its own ratio, in lanes too."""
    scene, state = swinging(1e5, 0.3, 4, torch.float32)
    sim = pd.Simulator(scene, TIME_STEP, 10, pd.Chebyshev(), torch.float32)
    ratios = torch.linspace(0.0, 0.45, 9)
    sim.set_material(poisson=ratios[:, None])
    together = sim(pd.State(*(array.repeat(9, 1, 1) for array in state)))
    for number in (0, 4, 8):
        sim.set_material(poisson=float(ratios[number]))
        assert torch.equal(sim(state).positions[0], together.positions[number])


@pytest.mark.parametrize(
    ("solver", "known"),
    [(pd.Chebyshev(), KNOWN_CHEBYSHEV), (pd.Multilevel(), KNOWN_LBFGS)],
    ids=["chebyshev", "lbfgs"],
)
def test_iterations(solver: Solver, known: dict[tuple[float, float], tuple[int, int, int]]) -> None:
    """Within a fifth of those that an independent prototype needs."""
    for (youngs, poisson), counts in known.items():
        scene, state = swinging(youngs, poisson)
        sim = pd.Simulator(scene, TIME_STEP, 500, pd.Multilevel(), torch.float64)
        solved = sim(state, start="inertial").positions
        sim.solver = solver
        first = state.positions + TIME_STEP * state.velocities + TIME_STEP**2 * torch.tensor(FALL)
        first[:, :36] = state.positions[:, :36]
        for count, error in zip(counts, (1e-1, 1e-2, 1e-3), strict=True):
            found = []
            for share in (1.02, 1.08, 1.14, 1.2):  # errors of Chebyshev rise again after a restart
                sim.iterations = math.ceil(share * count)
                found.append((sim(state, start="inertial").positions - solved).norm() / (first - solved).norm())
            assert min(found) <= error, (youngs, poisson, count, found)


def test_capped_box() -> None:
    """A box pulled to 1.6 and widened by 1.3 at its end: 24 of 240 elements reach the cap."""
    scene, mesh = bar(0.45, both=True)
    targets = torch.tensor(mesh.vertices[scene.pins[0].vertices])
    far = targets[:, 0] > 0.5
    targets[far] = (targets[far] - torch.tensor([1.0, 0.1, 0.1])) * torch.tensor([1.0, 1.3, 1.3]) + torch.tensor(
        [1.6, 0.1, 0.1], dtype=torch.float64
    )
    sim = pd.Simulator(scene, TIME_STEP, 600, pd.Multilevel(), torch.float64)
    state = pd.State(torch.tensor(mesh.vertices[None]), torch.zeros(1, len(mesh.vertices), 3, dtype=torch.float64))
    after, info = sim(state, targets=targets, return_info=True)
    for place, known in (
        ((0.5, 0.1, 0.1), (0.6348349910, 0.0910681638, 0.0996792692)),
        ((0.5, 0.0, 0.0), (0.6345501489, 0.0121974829, 0.0210733600)),
    ):
        vertex = np.abs(mesh.vertices - np.array(place)).sum(1).argmin()
        np.testing.assert_allclose(after.positions[0, vertex], known, atol=1e-6, rtol=0)
    assert abs(info.energy.item() - 2225.854545) <= 1e-6 * 2225.854545


@pytest.mark.parametrize(
    ("youngs", "poisson", "tip", "by_youngs", "by_poisson"),
    [
        (1e5, 0.3, -0.203292618, 8.39533660e-8, 2.51543787e-3),
        (1e6, 0.45, -0.157223687, 3.30077765e-8, 3.53152235e-1),
    ],
)
def test_gradients_of_a_step(youngs: float, poisson: float, tip: float, by_youngs: float, by_poisson: float) -> None:
    """Mean y of the free end and its derivatives by E and nu, from an independent prototype."""
    scene, mesh = bar(poisson, youngs=youngs)
    velocities = np.zeros_like(mesh.vertices)
    velocities[:, 1] = -10.0 * mesh.vertices[:, 0] ** 2
    sim = pd.Simulator(scene, TIME_STEP, 600, pd.Multilevel(), torch.float64)
    rows = {name: getattr(sim, name).requires_grad_() for name in ("stiffness", "poisson")}
    after = sim(pd.State(torch.tensor(mesh.vertices[None]), torch.tensor(velocities[None])), start="inertial")
    y = after.positions[0, mesh.vertices[:, 0] > 1.0 - 1e-9, 1].mean()
    assert abs(y.item() - tip) <= 1e-9
    E, nu = torch.autograd.grad(y, list(rows.values()))
    assert abs(E.sum().item() / by_youngs - 1.0) <= 1e-7
    assert abs(nu.sum().item() / by_poisson - 1.0) <= 1e-7


@pytest.mark.parametrize("averaging", [2, 4])
def test_gradients_of_groups(averaging: int) -> None:
    """Against differences of steps of one element's E and nu, in one of two environments of unlike material."""
    scene, mesh = bar(0.4, averaging)
    sim = pd.Simulator(scene, TIME_STEP, 400, pd.Multilevel(), torch.float64)
    rng = np.random.default_rng(0)
    youngs = torch.tensor(1e5 * rng.uniform(0.5, 2.0, (2, 240)))
    ratios = torch.tensor(rng.uniform(0.1, 0.45, (2, 240)))
    sim.set_material(stiffness=youngs, poisson=ratios)
    at_rest = torch.tensor(mesh.vertices).repeat(2, 1, 1)
    state = pd.State(at_rest, torch.zeros_like(at_rest))
    pull = torch.zeros_like(at_rest)
    pull[:, mesh.vertices[:, 0] > 1.0 - 1e-9] = torch.tensor([50.0, -20.0, 0.0], dtype=torch.float64)
    weights = torch.tensor(rng.normal(size=at_rest.shape))

    def loss() -> torch.Tensor:
        return (sim(state, forces=pull).positions * weights).sum()

    rows = {name: getattr(sim, name).requires_grad_() for name in ("stiffness", "poisson")}
    found = dict(zip(rows, torch.autograd.grad(loss(), list(rows.values())), strict=True))
    for name, step in (("stiffness", 10.0), ("poisson", 1e-4)):
        for tet in (3, 100):
            ends = []
            for sign in (1, -1):
                with torch.no_grad():
                    rows[name][1, tet] += sign * step
                    ends.append(loss().item())
                    rows[name][1, tet] -= sign * step
            difference = (ends[0] - ends[1]) / (2.0 * step)
            assert abs(difference - found[name][1, tet].item()) <= 1e-6 * found[name].abs().max().item()


def test_material_that_the_scene_lacks_is_refused() -> None:
    sim = pd.Simulator(swinging(1e5, 0.0)[0])
    with pytest.raises(TypeError, match=r"no array 'poisson'.*Solid\(poisson=\)"):
        sim.set_material(poisson=0.3)


def test_poisson_out_of_range_and_of_two_signs_is_refused() -> None:
    sim = pd.Simulator(bar(0.3, 4)[0])
    with pytest.raises(ValueError, match=r"poisson must be in \(-1, 0.495\).*0.495"):
        sim.set_material(poisson=0.495)
    both = torch.full((240,), 0.3)
    both[17] = -0.1
    with pytest.raises(ValueError, match="poisson must have one sign in each group"):
        sim.set_material(poisson=both)
    sim.set_material(poisson=-0.2)
