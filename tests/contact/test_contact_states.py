"""States of scenes with `Contact`: their history through all that takes a state, and the same bits everywhere."""

from __future__ import annotations

import copy
import io
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from body_scenes import THICKNESS, block, each, gripper, pose, simulator, slope
from runs import plan_of, settings_of

import torchpd as pd

ops = torch.ops.torchpd


def resting(dtype: torch.dtype = torch.float32, *, batch: int = 1) -> tuple[pd.Simulator, Any, pd.Scene]:
    """A gripped cube with forces, its simulator and scene."""
    course = gripper(0.8)
    sim = simulator(course.scene, 16, dtype=dtype)
    state: Any = sim.rest_state(batch)
    left, right = course.scene.colliders
    for _ in range(4):
        state = sim(state, targets={left: pose(0.013).to(dtype), right: pose(-0.013).to(dtype)})
    assert float(state.history.forces[..., 0].sum()) > 1.0
    return sim, state, course.scene


def parts_of(state: Any) -> list[torch.Tensor]:
    return [state.positions, state.velocities, *state.history]


def same(one: Any, other: Any) -> bool:
    return all(map(torch.equal, parts_of(one), parts_of(other)))


def test_the_state_at_rest() -> None:
    sim, _, scene = resting()
    state: Any = sim.rest_state(3)
    assert isinstance(state, pd.HistoryState)
    assert isinstance(state.history, pd.ContactHistory)
    count = 16 * len(sim.body_contact.plan.triangles)  # type: ignore[union-attr]
    poses, keys, forces, motion, flow = state.history
    assert torch.equal(poses, torch.tensor([1.0, 0, 0, 0]).repeat(3, 2, 1)[..., [1, 2, 3, 0, 1, 2, 3]])
    assert keys.shape == (3, count)
    assert keys.dtype == torch.int64
    assert bool((keys == -1).all())
    assert forces.shape == (3, count, 4)
    assert not forces.any()
    assert motion.shape == (3, 0, 6)
    assert flow.shape == (3, 0, 10)
    assert repr(state.history) == f"ContactHistory(batch=3, pairs={count}, float32, cpu)"
    assert len(scene.colliders) == 2


def test_a_state_moves_as_one() -> None:
    """`to` keeps keys whole; clone, detach and where take every part."""
    sim, state, _ = resting(batch=2)
    wide = state.to(torch.float64)
    assert [part.dtype for part in parts_of(wide)] == [torch.float64] * 3 + [torch.int64] + [torch.float64] * 3
    assert torch.equal(wide.history.keys, state.history.keys)
    assert same(wide.to(torch.float32), state)
    assert same(state.clone(), state)
    assert same(state.detach(), state)
    assert state.clone().history.keys.data_ptr() != state.history.keys.data_ptr()
    rest: Any = sim.rest_state()
    mixed = state.where(torch.tensor([False, True]), rest)
    for mine, theirs, found in zip(parts_of(state), parts_of(rest), parts_of(mixed), strict=True):
        assert torch.equal(found[1], mine[1])
        assert torch.equal(found[0], theirs[0])
    with pytest.raises(TypeError, match=r"where: other must be a HistoryState with a ContactHistory, got"):
        state.where(torch.tensor([False, True]), pd.HistoryState(*state[:2], pd.History(state.history.flow)))


def test_files_of_a_state() -> None:
    sim, state, _ = resting()
    file = io.BytesIO()
    torch.save({"state": state, "track": sim.rollout(state, 2)}, file)
    file.seek(0)
    loaded = torch.load(file)  # weights_only
    assert same(loaded["state"], state)
    assert isinstance(loaded["track"], pd.HistoryTrack)
    assert same(pickle.loads(pickle.dumps(state)), state)


def test_steps_in_place_and_rollouts() -> None:
    """rollout(9) is rollout(5), then rollout(4); step_ and forward agree; the track holds the history."""
    sim, state, scene = resting()
    left, _ = scene.colliders

    def targets(step: int) -> dict[Any, torch.Tensor]:
        return {left: pose(0.013, 0.001 * (step + 1)).float()}

    whole: Any = sim.rollout(state, 9, targets=targets, return_info=True)
    half: Any = sim.rollout(state, 5, targets=targets)
    rest: Any = sim.rollout(half.state(), 4, targets=targets, first=5)
    assert isinstance(whole, pd.HistoryTrack)
    assert same(rest.state(), whole.state())
    assert same(half.state(), whole.state(4))
    assert whole.info.contact_gap.shape == whole.info.held_back.shape == whole.info.contact_overflow.shape == (9, 1)
    kept, info = state.clone(), torch.zeros(1, 13, dtype=torch.float64)
    for step in range(9):
        sim.step_(kept, targets=targets(step), info=info)
    assert same(kept, whole.state())
    report = pd.Info.from_rows(info)
    for mine, theirs in zip(report, whole.info, strict=True):
        assert torch.equal(mine, theirs[-1]) or bool(mine.isnan().all() & theirs[-1].isnan().all())
    assert sim.rollout(state, 0).history.keys.shape == (0, *state.history.keys.shape)  # type: ignore[attr-defined]
    assert same(sim.rollout(state, 9, every=3, targets=targets).state(1), whole.state(5))


def test_plain_tuples_are_states() -> None:
    sim, state, _ = resting()
    wanted: Any = sim(state)
    for given in ((*state[:2], tuple(state.history)), [*state[:2], list(state.history)]):
        assert same(sim(given), wanted)  # type: ignore[call-overload]
        sim.step_(copy.deepcopy(given))  # type: ignore[arg-type]


def test_a_step_is_pure() -> None:
    """The same call twice has the same bits, and leaves its arguments alone."""
    sim, state, scene = resting()
    before, target = state.clone(), pose(0.014).float()
    one: Any = sim(state, targets={scene.colliders[0]: target})
    assert same(sim(state, targets={scene.colliders[0]: target}), one)
    assert same(before, state)
    assert torch.equal(target, pose(0.014).float())


def test_copies_of_a_simulator(tmp_path: Path) -> None:
    """Copied, pickled, saved and loaded ones take the same steps; one in another precision does not."""
    sim, state, _ = resting()
    wanted: Any = sim(state)
    sim.save(tmp_path / "contact.safetensors")
    others = [copy.deepcopy(sim), pickle.loads(pickle.dumps(sim)), pd.Simulator.load(tmp_path / "contact.safetensors")]
    for other in others:
        assert same(other(state), wanted)
        assert str(other) == str(sim)
    wide = copy.deepcopy(sim).to(torch.float64)
    after: Any = wide(state.to(torch.float64))
    assert after.positions.dtype == torch.float64
    assert torch.allclose(after.positions.float(), wanted.positions, atol=1e-5)


def _cubes(capacity: int | None = None) -> tuple[pd.Scene, torch.Tensor]:
    """Two cubes; in environment 1 the upper one falls onto the lower one, in the others both rest apart."""
    bodies = block(0.1, 2, (0.0, 0.0, 0.0)), block(0.1, 2, (0.01, 0.2, 0.02))
    contact = pd.Contact(self_contact=False, friction=0.5, thickness=THICKNESS, capacity=capacity)
    scene = pd.Scene(*bodies, contact)
    fast = torch.tensor(each(scene, (0.0, 0.0, 0.0), (0.0, -10.0, 0.0)), dtype=torch.float32)
    slow = torch.tensor(each(scene, (0.1, 0.0, 0.0), (0.1, 0.0, 0.0)), dtype=torch.float32)
    return scene, torch.stack([slow, fast, slow])


def one_of(state: Any, environment: int) -> Any:
    row = slice(environment, environment + 1)
    return pd.HistoryState(*(part[row] for part in state[:2]), pd.ContactHistory(*(part[row] for part in state[2])))


@pytest.mark.parametrize("batch", [3, 11])
def test_the_same_bits_alone_and_in_a_batch(batch: int) -> None:
    scene, velocities = _cubes()
    sim = simulator(scene, 16, dtype=torch.float32)
    state: Any = sim.rest_state(batch)
    state.velocities[:] = velocities[torch.arange(batch) % 3]
    before = torch.get_num_threads()
    try:
        ends = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            ends.append(sim.rollout(state, 4).state())
    finally:
        torch.set_num_threads(before)
    assert same(*ends)
    for environment in range(3):
        assert same(sim.rollout(one_of(state, environment), 4).state(), one_of(ends[0], environment))


def test_the_pairs_are_what_the_capacity_has_to_hold() -> None:
    """A capacity of just as many gives the bits of a large one, and one less lacks one."""

    def step(capacity: int) -> tuple[Any, pd.Info]:
        scene, velocities = _cubes(capacity)
        sim = simulator(scene, 16, dtype=torch.float32)
        state: Any = sim.rest_state(3)
        state.velocities[:] = velocities
        return sim(state, return_info=True)

    after, info = step(4000)
    assert info.contact_pairs[[0, 2]].tolist() == info.contact_searches[[0, 2]].tolist() == [0, 0]
    pairs = int(info.contact_pairs[1])
    assert pairs > 0
    assert int(info.contact_searches[1]) > 0
    exact, info = step(pairs)
    assert torch.equal(exact.positions, after.positions)
    assert not info.contact_overflow.any()
    with pytest.warns(pd.SceneWarning, match="Its step was taken back"):
        _, info = step(pairs - 1)
    assert info.contact_overflow.tolist() == [0, 1, 0]


def test_an_overflow_takes_the_step_back() -> None:
    """Of that environment alone; the others have the bits that they have alone. It is said once, with the need."""
    scene, velocities = _cubes(1)
    sim = simulator(scene, 16, dtype=torch.float32)
    state: Any = sim.rest_state(3)
    state.velocities[:] = velocities
    with pytest.warns(pd.SceneWarning, match=r"environment 1 has \d+ pairs .*Contact\(capacity=\d+\)"):
        after, info = sim(state, return_info=True)
    assert sim.body_contact is not None
    assert int(info.contact_overflow[1]) > 0
    assert info.contact_overflow[[0, 2]].tolist() == [0, 0]
    assert info.contact_gap.isnan().tolist() == [False, True, False]
    assert info.contact_pairs[1] == sim.body_contact.plan.capacity + info.contact_overflow[1]
    assert same(one_of(after, 1), one_of(state, 1))
    for environment in (0, 2):
        assert same(sim(one_of(state, environment)), one_of(after, environment))
        assert not torch.equal(after.positions[environment], state.positions[environment])
    sim(state)  # no second warning


def test_an_overflow_keeps_the_flow() -> None:
    """A plastic cube whose step is taken back has not flowed."""
    mesh = pd.shapes.box((0.1,) * 3, (2,) * 3)
    body = pd.Solid(mesh, youngs=1e5, density=1e3, plastic=pd.Plastic(yield_strain=0.01))
    scene = pd.Scene(body, block(0.1, 2, (0.06, 0.25, 0.07)), pd.Contact(thickness=THICKNESS, capacity=1))
    sim = simulator(scene, 16)
    state: Any = sim.rest_state()
    state.positions[:, :27, 1] *= 0.9  # it yields
    state.velocities[:, 27:, 1] = -10.0
    with pytest.warns(pd.SceneWarning, match="capacity"):
        after: Any = sim(state)
    assert same(after, state)
    roomy = simulator(pd.Scene(body, scene.bodies[1], pd.Contact(thickness=THICKNESS)), 16)
    rest: Any = roomy.rest_state()
    after = roomy(pd.HistoryState(*state[:2], rest.history))
    assert float(after.history.flow[..., 9].max()) > 0.0


def test_a_cold_start_forgets_forces() -> None:
    """Keys of -1: the state of one's own that the documentation describes."""
    course = slope(20.0, 0.5)
    sim = simulator(course.scene, 16)
    warm, _ = course.last(sim, 20)
    cold = pd.HistoryState(warm.positions, warm.velocities, sim.rest_state().history)  # type: ignore[attr-defined]
    speeds = [float(sim(state).velocities.norm(dim=-1).max()) for state in (warm, cold)]
    assert speeds[0] < 1e-4 < speeds[1]


def test_compiled_steps() -> None:
    sim, state, scene = resting()
    left, _ = scene.colliders

    def run(state: Any, target: torch.Tensor) -> Any:
        return sim(state, targets={left: target}, return_info=True)

    found, report = torch.compile(run, fullgraph=True, backend="aot_eager")(state, pose(0.014).float())
    after, info = run(state, pose(0.014).float())
    assert same(found, after)
    assert torch.equal(report.contact_gap, info.contact_gap)


def test_opcheck() -> None:
    sim, state, _ = resting(torch.float64, batch=2)
    assert sim.body_contact is not None
    history = [*state.history[:3]]
    arguments = (
        state.positions, state.velocities, None, history[0].clone(), history, sim.material(), plan_of(sim),
        sim.body_contact.arrays,
    )  # fmt: skip
    report = torch.library.opcheck(ops.contact_step.default, arguments, settings_of(sim))
    assert set(report.values()) == {"SUCCESS"}


def test_the_pose_of_a_target() -> None:
    """[7] is for all environments, [B, 7] for each; quaternions are normalised, and q and -q are one rotation."""
    sim, rest, scene = resting(batch=2)
    rest = sim.rest_state(2)
    left, right = scene.colliders
    turned = torch.tensor([0.001, 0.0, 0.0, 1.0, 0.0, 0.05, 0.0])
    after: Any = sim(rest, targets={left: 2.0 * turned * torch.tensor([0.5, 1, 1, 1, 1, 1, 1])})
    unit = turned[3:] / turned[3:].norm()
    assert torch.allclose(after.history.poses[:, 0, 3:], unit.expand(2, 4), atol=1e-6)
    assert torch.equal(after.history.poses[:, 1], rest.history.poses[:, 1])  # type: ignore[attr-defined]
    other = turned * torch.tensor([1.0, 1, 1, -1, -1, -1, -1])
    assert torch.equal(sim(rest, targets={left: other}).positions, after.positions)
    both = torch.stack([turned, pose(0.0).float()])
    after = sim(rest, targets={left: both, right: pose(-0.001).float()})
    assert torch.allclose(after.history.poses[:, 0, 0], torch.tensor([0.001, 0.0]), atol=1e-7)
    assert torch.allclose(after.history.poses[:, 1, 0], torch.tensor(-0.001), atol=1e-7)
