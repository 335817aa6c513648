"""The same bits: alone or in a batch, on one thread or two, on every run; the same numbers on every instruction set."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from cases import beam
from environments import ITEMS, assert_same_bits, count_sliding, different_environments, gradients, run, scene
from runs import simulator
from simd_steps import fields, results_with

import torchpd as pd
from torchpd.common.extension import load_extension
from torchpd.scene.pins import hold_exactly

pytestmark = pytest.mark.usefixtures("poisoned")


@pytest.mark.parametrize(("iterations", "tolerance"), [(28, 0.0), (1300, 0.3)], ids=["all iterations", "soft stop"])
@pytest.mark.parametrize("batch", [2, 7, 8, ITEMS])
def test_an_item_does_not_feel_its_batch(
    batch: int, iterations: int, tolerance: float, dtype: torch.dtype, device: torch.device
) -> None:
    sim = simulator(scene(), dtype, device, iterations=iterations, tolerance=tolerance)
    state, forces = different_environments(sim)
    together = run(sim, state, forces, slice(batch))
    for item in {0, batch // 2, batch - 1}:
        alone = run(sim, state, forces, slice(item, item + 1))
        assert_same_bits([t[item : item + 1] for t in together], alone)
    if tolerance and batch == ITEMS:
        assert len(together[4].unique()) > 1  # environments stopped after different numbers of iterations


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("column", "sick"), [(1, 1e12), (2, np.inf), (2, np.nan)])
@pytest.mark.parametrize("outer", ["lbfgs", "momentum"])
@pytest.mark.parametrize("batch", [3, 17])
def test_environments_do_not_feel_one_that_is_lost(
    batch: int, outer: Any, column: int, sick: float, dtype: torch.dtype, device: torch.device
) -> None:
    """Energies may be numbers where forces are none: no memory of these may reach another environment."""
    body = pd.Solid(pd.shapes.box((0.2, 0.1, 0.1), (2, 1, 1)), youngs=3e4)
    parts = pd.Scene(body, pd.Pin(body, [4]), pd.Gravity(), pd.Ground(-1e-4, friction=0.2))
    sim = pd.Simulator(parts, iterations=12, solver=pd.Multilevel(outer), dtype=dtype).to(device)
    state = sim.rest_state(batch)
    state = pd.State(state.positions, state.velocities + 0.1)
    planes = sim.planes.detach().repeat(batch, 1, 1)
    sound = torch.func.functional_call(sim, {"planes": planes}, (state,))
    planes[1, 0, column] = sick
    found = torch.func.functional_call(sim, {"planes": planes}, (state,))
    others = torch.arange(batch) != 1
    assert_same_bits([t[others] for t in found], [t[others] for t in sound])


@pytest.mark.filterwarnings("ignore:torchpd. the adjoint")
@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
def test_gradients_of_an_item_do_not_feel_its_batch(solver: Any, dtype: torch.dtype, device: torch.device) -> None:
    """Some slide against friction, and are solved for by another method; some do not."""
    iterations = 60 if isinstance(solver, pd.Multilevel) else 400
    sim = simulator(scene(), dtype, device, iterations=iterations, solver=solver)
    state, forces = different_environments(sim, 9)
    state.velocities[..., 0] += 1.0
    state.velocities[5, :, 1] = 5.0
    assert len(count_sliding(sim, state, forces).bool().unique()) == 2
    together = gradients(sim, state, forces, slice(9))
    for item in (0, 5, 8):
        alone = gradients(sim, state, forces, slice(item, item + 1))
        assert_same_bits([t[item : item + 1] for t in together], alone)
    assert_same_bits(gradients(sim, state, forces, slice(9)), together)


def test_order_of_the_batch_does_not_matter(dtype: torch.dtype, device: torch.device) -> None:
    sim = simulator(scene(), dtype, device, iterations=20)
    state, forces = different_environments(sim)
    order = torch.from_numpy(np.random.default_rng(2).permutation(ITEMS)).to(device)
    assert_same_bits(run(sim, state, forces, order), [t[order] for t in run(sim, state, forces)])


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(("name", "batch"), [("scene", 1), ("scene", 3), ("scene", 20), ("beam", 1), ("beam", 9)])
def test_threads_and_runs_do_not_matter(name: str, batch: int, dtype: torch.dtype, device: torch.device) -> None:
    sim = simulator(scene() if name == "scene" else beam(1e5), dtype, device, iterations=20)
    # what two threads share, and on the beam sums of many parts, whose order shows in the energy
    assert device.type != "cpu" or sim.plan.patches >= (2 if name == "scene" else 4)
    state, forces = different_environments(sim, batch)
    energy = sim.energy(state)
    two = run(sim, state, forces)
    for _ in range(5):
        assert_same_bits(run(sim, state, forces), two)
    torch.set_num_threads(1)
    assert_same_bits(run(sim, state, forces), two)
    assert torch.equal(sim.energy(state), energy)


def test_rollout_of_an_item_does_not_feel_its_batch(dtype: torch.dtype, device: torch.device) -> None:
    sim = simulator(scene(), dtype, device, iterations=8)
    state, forces = different_environments(sim)
    together = sim.rollout(state, 5, forces=forces)
    alone = sim.rollout(pd.State(*(t[9:10] for t in state)), 5, forces=forces[9:10])
    assert torch.equal(together.positions[:, 9], alone.positions[:, 0])
    assert torch.equal(together.velocities[:, 9], alone.velocities[:, 0])


@pytest.mark.parametrize("batch", [2, 9])
def test_material_of_an_environment_is_that_of_its_own_simulator(
    batch: int, dtype: torch.dtype, device: torch.device
) -> None:
    case = scene()
    sim = simulator(case, dtype, device, iterations=32)
    state, forces = different_environments(sim, batch)
    factor = torch.linspace(0.5, 2.0, batch, dtype=dtype, device=device)
    shift = torch.arange(3 * batch, dtype=dtype, device=device).reshape(batch, 3) * 0.01
    varied: dict[str, torch.Tensor] = {
        # soft enough that the schedule of each environment has a radius of its own, and comes to its limit
        "stiffness": 3e-4 * sim.stiffness * factor[:, None],
        "masses": sim.masses * factor.flip(0)[:, None],
        "gravity": sim.gravity + shift,
        "damping": sim.damping * factor,
        "pin_stiffness": hold_exactly(sim.pin_stiffness * factor[:, None], sim.pin_hard),
        "pin_targets": sim.pin_targets + shift[:, None],
        "planes": sim.planes + factor[:, None, None] * torch.tensor([0, 0, 0, 0.01, 0.1]).to(sim.planes),
        "spheres": sim.spheres + factor[:, None, None] * torch.tensor([0.01, 0, 0, 0.02, 0.1, 0, 0, 0]).to(sim.spheres),
    }
    sim.set_material(**varied)
    together = run(sim, state, forces)
    single = simulator(case, dtype, device, iterations=32)
    for item in range(batch):
        single.set_material(**{name: value[item] for name, value in varied.items()})
        assert_same_bits([t[item : item + 1] for t in together], run(single, state, forces, slice(item, item + 1)))
    assert not torch.equal(together[0][0], together[0][1])
    assert len(pd.Info(*together[2:]).rho.unique()) == batch


def test_instruction_sets_agree() -> None:
    extension, reason = load_extension()
    assert extension is not None, reason
    names = extension.build_info()["simd_available"]
    assert "portable" in names
    with ThreadPoolExecutor(len(names)) as together:
        results = dict(zip(names, together.map(lambda name: results_with(name, fields), names), strict=True))
    widest = results[names[0]]
    for name in names[1:]:
        for key in widest:
            # they fuse differently: rounding of some fifty operations an iteration, extrapolated 12 times (k^2)
            unit = 2.0**-24 if "float32" in key else 2.0**-53
            for one, other in zip(results[name][key], widest[key], strict=True):
                size = np.abs(other).max()
                assert np.abs(np.subtract(one, other)).max() <= 50 * 12**2 * unit * size, (name, key)
