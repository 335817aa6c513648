"""The same bits: alone or in a batch, on one thread or two, on every run; the same numbers on every instruction set."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cases import Case, beam, sliver_mesh
from runs import noise, simulator

import torchpd as pd
from torchpd.extension import load_extension
from torchpd.pins import hold_exactly

pytestmark = pytest.mark.usefixtures("poisoned")

ITEMS = 33


def scene() -> Case:
    """Slivers with hard and soft pins, drag, a ground and a ball with friction, and a free block in the air."""
    mesh, block = sliver_mesh((6, 3, 3)), pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
    body = pd.Solid(mesh, youngs=10.0 ** np.random.default_rng(0).uniform(4.0, 6.0, len(mesh.tets)))
    free = pd.Solid(pd.TetMesh(block.vertices + [0.0, 3.0, 0.0], block.tets), 1e5)
    parts = pd.Scene(
        body, free, pd.Pin(body, mesh.vertices[:, 0] < 0.05), pd.Pin(body, [60, 70], 1e4), pd.Gravity(),
        pd.Damping(1.0), pd.Ground(-0.01, friction=0.5), pd.Sphere((0.5, -0.1, 0.1), 0.1, friction=0.3),
    )  # fmt: skip
    rest = parts.values().rest_positions
    return Case(parts, rest, 0.0 * rest, 1.0 / 60.0)


def different_environments(sim: pd.Simulator, count: int = ITEMS) -> tuple[pd.State, torch.Tensor]:
    """Deformed, moving states and forces, no two alike; the generator makes item i the same for any count."""
    rest = sim.rest_state(count)
    noise = torch.from_numpy(np.random.default_rng(1).standard_normal((ITEMS, 3, sim.vertices, 3)))[:count]
    noise = noise.to(rest.positions)
    state = pd.State(rest.positions + 0.01 * noise[:, 0], noise[:, 1] - torch.tensor([0.0, 1.0, 0.0]).to(noise))
    return state, 0.1 * noise[:, 2]


def run(sim: pd.Simulator, state: pd.State, forces: torch.Tensor, items: Any = slice(None)) -> list[torch.Tensor]:
    """Everything that a step returns for some of the environments, as bits can be compared."""
    after, info = sim(pd.State(*(t[items] for t in state)), forces[items], return_info=True)
    return [*after, *info]


def assert_same_bits(found: list[torch.Tensor], expected: list[torch.Tensor]) -> None:
    for number, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert torch.equal(one, other), f"output {number}"
        assert not one.isnan().any(), f"output {number}"


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
@pytest.mark.parametrize("outer", ["corotated", "lbfgs", "momentum"])
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


def gradients(sim: pd.Simulator, state: pd.State, forces: torch.Tensor, items: slice) -> list[torch.Tensor]:
    """Of a loss of each environment: for what it starts from, and for material of its own."""
    names = ("gravity", "damping", "planes", "spheres")
    starts = [t[items].detach().clone().requires_grad_() for t in (*state, forces)]
    # as many rows as environments, the same ones
    own = [getattr(sim, name).detach().expand(len(starts[0]), *getattr(sim, name).shape).clone() for name in names]
    own = [t.requires_grad_() for t in own]
    given = pd.State(starts[0], starts[1]), starts[2]
    after = torch.func.functional_call(sim, dict(zip(names, own, strict=True)), given)
    weight = noise(state.positions, 5)[items]
    loss = (weight * after.positions).sum() + 0.01 * (weight * after.velocities).sum()
    return list(torch.autograd.grad(loss, starts + own))


def count_sliding(sim: pd.Simulator, state: pd.State, forces: torch.Tensor) -> torch.Tensor:
    """Vertices of each environment that slide against friction."""
    after = sim(state, forces).positions.detach()
    material = [array.detach() for array in sim.material()]
    *_, sliding = torch.ops.torchpd.adjoint_system(
        after, after, after, *state, forces, material, list(sim.plan.arrays), time_step=sim.time_step
    )
    return (sliding[..., 0, :] != 0.0).any(-1).sum(-1)


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


SUBPROCESS = """
import json, sys
import torch
sys.path[:0] = json.loads(sys.argv[1])
from test_determinism import different_environments, scene, simulator
from torchpd import _C
out = {"simd": _C.build_info()["simd"]}
for dtype in (torch.float32, torch.float64):
    sim = simulator(scene(), dtype, iterations=12)
    for batch in (1, 9):
        state, forces = different_environments(sim, batch)
        after = sim(state, forces)
        out[f"{dtype} {batch}"] = [after.velocities.double().flatten().tolist(), sim.energy(state).tolist()]
print(json.dumps(out))
"""


def results_with(simd: str) -> dict[str, Any]:
    paths = json.dumps([str(Path(__file__).parent), str(Path(pd.__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-c", SUBPROCESS, paths],
        env={**os.environ, "TORCHPD_SIMD": simd},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_instruction_sets_agree() -> None:
    extension, reason = load_extension()
    assert extension is not None, reason
    names = extension.build_info()["simd_available"]
    assert "portable" in names
    with ThreadPoolExecutor(len(names)) as together:
        results = dict(zip(names, together.map(results_with, names), strict=True))
    assert [results[name]["simd"] for name in names] == names
    widest = results[names[0]]
    for name in names[1:]:
        for key in widest.keys() - {"simd"}:
            # they fuse differently: rounding of some fifty operations an iteration, extrapolated 12 times (k^2)
            unit = 2.0**-24 if "float32" in key else 2.0**-53
            for one, other in zip(results[name][key], widest[key], strict=True):
                size = np.abs(other).max()
                assert np.abs(np.subtract(one, other)).max() <= 50 * 12**2 * unit * size, (name, key)
