"""`Contact(capacity="grow")`: steps of a simulator with room for all pairs, and what cannot step so is refused."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from body_scenes import THICKNESS, block, gravity, gripper, simulator

import torchpd as pd
from torchpd.simulation.state import chosen, joined


def stacked(capacity: Any) -> pd.Scene:
    """A cube falls on another one."""
    lower, upper = block(0.1, 2, (0.0, 0.05, 0.0)), block(0.1, 2, (0.013, 0.17, 0.009))
    return pd.Scene(lower, upper, gravity(), pd.Contact(friction=0.3, thickness=THICKNESS, capacity=capacity))


def small(sim: pd.Simulator, capacity: int = 4) -> pd.Simulator:
    """The same with room for few pairs, which it makes larger."""
    assert sim.body_contact is not None
    sim.body_contact = sim.body_contact.with_capacity(capacity)
    return sim


def starts(sim: pd.Simulator, batch: int) -> Any:
    state: Any = sim.rest_state(batch)
    speeds = torch.linspace(-1.0, -2.0, batch)[:, None].to(state.velocities)
    state.velocities[:, 27:, 1] = speeds
    return state


def same(one: Any, other: Any) -> bool:
    """The same bits, and no pair beyond the narrower history."""
    width = min(one.history.keys.shape[-1], other.history.keys.shape[-1])
    for state in (one, other):
        assert (state.history.keys[..., width:] == -1).all()
        assert not state.history.forces[..., width:, :].any()
    return all(
        torch.equal(a, b)
        for a, b in (
            (one.positions, other.positions),
            (one.velocities, other.velocities),
            (one.history.keys[..., :width], other.history.keys[..., :width]),
            (one.history.forces[..., :width, :], other.history.forces[..., :width, :]),
        )
    )


def test_states_of_different_widths() -> None:
    """`where` and `joined` widen the narrower one; a batch of none steps."""
    sim = small(simulator(stacked("grow"), 16))
    narrow: Any = sim.rest_state(2)
    one = starts(sim, 2)
    with pytest.warns(pd.SceneWarning, match="from now on"):
        one = sim.rollout(one, 8).state()
    assert narrow.history.keys.shape[-1] == 4 < one.history.keys.shape[-1]
    pick = torch.tensor([True, False])
    for mixed in (one.where(pick, narrow), narrow.where(~pick, one)):
        assert same(chosen(mixed, [0]), chosen(one, [0]))
        assert same(chosen(mixed, [1]), chosen(narrow, [1]))
    both = joined([narrow, one])
    assert same(chosen(both, [2, 3]), one)
    assert sim(sim.rest_state(0)).positions.shape == (0, 54, 3)


@pytest.mark.parametrize("batch", [1, 3])
def test_steps_are_those_with_room_for_all(batch: int, dtype: torch.dtype) -> None:
    """To the bit, in every step, in which pairs come up to 4, 8, 16 and more; each growth is said."""
    wide = simulator(stacked(5000), 16, dtype=dtype)
    grown = small(simulator(stacked("grow"), 16, dtype=dtype))
    one, other, widths, said = starts(wide, batch), starts(grown, batch), set(), 0
    for _ in range(8):
        one, info = wide(one, return_info=True)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            other, report = grown(other, return_info=True)
        said += sum("from now on" in str(warning.message) for warning in caught)
        assert same(one, other)
        for name, value in info._asdict().items():
            assert torch.equal(value, getattr(report, name)), name
        widths.add(other.history.keys.shape[-1])
    assert said >= 1
    assert max(widths) == grown.body_contact.plan.capacity > 16  # type: ignore[union-attr]
    assert len(widths) > 1 or batch > 1  # a fast environment needs them in the first step


def test_the_control_is_taken_back() -> None:
    sim = simulator(stacked(4), 16)
    state = starts(sim, 1)
    with pytest.warns(pd.SceneWarning, match=r'taken back.*or capacity="grow"'):
        state = sim.rollout(state, 8).state()
    _, info = sim(state, return_info=True)
    assert int(info.contact_overflow) > 0


def test_a_simulator_with_more_room_goes_on() -> None:
    """From the state of one whose capacity was exceeded, with the bits of a wide history; less room is refused."""
    few, many = simulator(stacked(4), 16), simulator(stacked(5000), 16)
    with pytest.warns(pd.SceneWarning, match="taken back"):
        narrow = few.rollout(starts(few, 2), 8).state()
    assert narrow.history.keys.shape == (2, 4)
    wide = starts(many, 2)._replace(positions=narrow.positions, velocities=narrow.velocities)
    many.check(narrow)
    after = many(narrow)
    assert same(after, many(wide))
    assert after.history.keys.shape == (2, 5000)
    assert many.contact_forces(narrow, after).pairs.counts.min() > 0
    for act in (few, few.check, few.step_):
        with pytest.raises(ValueError, match=r"keys .* at most 4 pairs.*got \[2, 5000\]; .*Contact\(capacity=5000\)"):
            act(after)
    with pytest.raises(ValueError, match=r"step_: history\.keys must have room for 5000 pairs.*got \[2, 4\]; call"):
        many.step_(narrow)


@pytest.mark.filterwarnings("ignore::torchpd.SceneWarning")
def test_rollouts_have_one_width() -> None:
    """Records before growth have room for as many pairs as later ones; a rollout goes on from any of them."""
    wide, grown = simulator(stacked(5000), 16), small(simulator(stacked("grow"), 16))
    one = wide.rollout(starts(wide, 2), 8, return_info=True)
    other = grown.rollout(starts(grown, 2), 8, return_info=True)
    for record in range(8):
        assert same(one.state(record), other.state(record))
    again = grown.rollout(other.state(2), 5)
    assert same(again.state(), other.state())
    narrow: Any = starts(small(simulator(stacked("grow"), 16)), 2)
    assert narrow.history.keys.shape == (2, 4)
    assert same(grown(narrow), other.state(0))  # of a simulator that has not grown
    fresh = small(simulator(stacked("grow"), 16))
    assert same(fresh(other.state(3)), other.state(4))  # of one that has
    assert fresh.body_contact.plan.capacity == other.history.keys.shape[-1]  # type: ignore[union-attr]


@pytest.mark.filterwarnings("ignore::torchpd.SceneWarning")
def test_gradients_and_forces() -> None:
    found = []
    for sim in (simulator(stacked(5000), 64), small(simulator(stacked("grow"), 64))):
        state = starts(sim, 1)
        speed = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
        state = state._replace(velocities=state.velocities * speed)
        for _ in range(3):
            last, state = state, sim(state)
        (gradient,) = torch.autograd.grad(state.positions[0, 27:, 1].mean(), speed)
        forces = sim.contact_forces(last, state)
        found.append((gradient, forces.between[sim.scene.bodies[1], sim.scene.bodies[0]].force.detach()))
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))
    assert float(found[0][1].norm()) > 0.0


@pytest.mark.filterwarnings("ignore::torchpd.SceneWarning")
def test_colliders_go_once() -> None:
    """A step that is taken again starts from the poses of before."""
    grown, wide = (gripper(0.8) for _ in range(2))
    sims = []
    for course, capacity in ((grown, "grow"), (wide, 5000)):
        parts: list[Any] = [*course.scene.bodies, *course.scene.colliders]
        contact = pd.Contact(friction=0.8, thickness=THICKNESS, capacity=capacity)  # type: ignore[arg-type]
        scene = pd.Scene(*parts, pd.Ground(0.0, friction=0.5), gravity(), contact)
        sims.append((replace(course, scene=scene), simulator(scene, 16)))
    small(sims[0][1])
    for (one, _), (other, _) in zip(*(course.steps(sim, 14) for course, sim in sims), strict=True):
        assert same(one, other)
        assert torch.equal(one.history.poses, other.history.poses)


def test_what_cannot_take_a_step_again_is_refused() -> None:
    sim = simulator(stacked("grow"), 4)
    state = sim.rest_state()
    with pytest.raises(RuntimeError, match=r'step_: Contact\(capacity="grow"\) .*give a number'):
        sim.step_(state)
    with pytest.raises(RuntimeError, match=r"must not be transformed by torch\.func or vmap"):
        torch.func.vmap(lambda x: sim(pd.HistoryState(x, *state[1:])).positions)(state.positions[None])
    with pytest.raises(Exception, match=r'Contact\(capacity="grow"\) must step eagerly, got torch.compile'):
        torch.compile(sim, fullgraph=True, backend="eager")(state)
    with pytest.raises(ValueError, match=r'capacity must be a whole number of pairs, "grow" or None, got \'all\''):
        pd.Contact(capacity="all")  # type: ignore[arg-type]
    wider: Any = state.history
    with pytest.raises(ValueError, match=r"history\.forces must be \[1, 9, 4\].* got \[1, 8, 4\]"):
        sim(pd.HistoryState(*state[:2], wider._replace(keys=wider.keys[:, :9], forces=wider.forces[:, :8])))


def test_it_is_kept_in_files(tmp_path: Path) -> None:
    sim = simulator(stacked("grow"), 4)
    assert f"up to {16 * 96} pairs in each environment, more when needed" in str(sim)
    sim.save(tmp_path / "sim.pt")
    loaded = pd.Simulator.load(tmp_path / "sim.pt")
    assert loaded.scene.contact.capacity == "grow"  # type: ignore[union-attr]
    assert loaded.body_contact.plan.grows  # type: ignore[union-attr]
