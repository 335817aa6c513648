"""Material that no step can work with is refused, with the name, the contract and what came."""

from __future__ import annotations

import math

import pytest
import torch
from small_scene import body, scene, small_simulator

import torchpd as pd
from torchpd.plan.material import named_arrays


@pytest.fixture(scope="module")
def sim() -> pd.Simulator:
    return small_simulator()


def test_set_material_is_checked(sim: pd.Simulator) -> None:
    before = [array.clone() for array in sim.material()]
    masses = sim.masses.detach().clone()
    masses[4:6] = -0.5
    sparse, unreal = torch.ones(48).to_sparse(), torch.ones(48, device="meta")
    for arrays, kind, message in (
        (
            {"youngs": 1e5},
            TypeError,
            r"no array 'youngs'; there are stiffness, masses.*; stiffness holds Young's modulus",
        ),
        (
            {"stiffness": torch.ones(3)},
            ValueError,
            r"stiffness must be \[48\], .* got \[3\]; .*scene: 48",
        ),
        ({"stiffness": torch.ones(48) > 0}, TypeError, r"stiffness .*got torch\.bool"),
        ({"stiffness": sparse}, TypeError, r"stiffness .*got torch\.sparse_coo on cpu"),
        ({"stiffness": unreal}, TypeError, r"stiffness .*got torch\.strided on meta"),
        ({"stiffness": 0.0}, ValueError, r"stiffness .* torch\.float32, got 0\.0 at \[0\] \(48 in"),
        ({"stiffness": 1e-60}, ValueError, r"stiffness .* torch\.float32, got 0\.0 at \[0\]"),
        ({"stiffness": math.inf}, ValueError, r"stiffness .* torch.float32, got inf at"),
        ({"masses": masses}, ValueError, r"masses .*, got -0\.5 at \[4\] \(2 in all\)"),
        ({"masses": masses.repeat(2, 1)}, ValueError, r"masses .*, got -0\.5 at \[0, 4\] \(4 in all"),
        ({"masses": math.nan}, ValueError, "masses must be finite .*, got nan at"),
        ({"gravity": -9.81}, ValueError, r"gravity must be \[3\], or with a batch in front, got one number, -9\.81$"),
        (
            {"planes": 1.0},
            ValueError,
            r"planes must be \[1, 5\], or with a batch in front, got one number, 1; .*scene: 1",
        ),
        ({"spheres": torch.tensor(0.5)}, ValueError, r"spheres must be \[1, 8\], .*, got one number, 0\.5;"),
        ({"pin_targets": 0.0}, ValueError, r"pin_targets must be \[3, 3\], .*, got one number, 0;"),
        (
            {"pin_stiffness": 0.0},
            ValueError,
            r"pin_stiffness is 0 at hard pins.* pin_hard=False.*; at \[0\] \(2 in all\)",
        ),
        ({"pin_stiffness": -1.0}, ValueError, r"pin_stiffness must be >= 0, .*, got -1"),
        ({"pin_stiffness": math.nan}, ValueError, r"pin_stiffness must be >= 0, .*, got nan"),
        (
            {"pin_stiffness": math.inf, "pin_hard": [True, False, True]},
            ValueError,
            r"pin_stiffness .* pin_hard is False, got inf; at \[1\] \(1 in all\)",
        ),
        ({"pin_hard": 1.0}, TypeError, r"pin_hard must be bool .*, got torch\.float32"),
        ({"pin_hard": "yes"}, TypeError, r"pin_hard .*got 'yes'"),
        ({"pin_hard": None}, TypeError, r"pin_hard .*got None"),
        ({"pin_hard": [True, False]}, ValueError, r"pin_hard .*, \[3\], .* got \[2\]; pins of the"),
        (
            {"pin_hard": torch.ones(2, 3) > 0, "masses": torch.ones(3, 27)},
            ValueError,
            r"arrays .* environments.*, got 3 environments in masses and 2 in pin_hard",
        ),
        ({"gravity": (0.0, math.nan, 0.0)}, ValueError, "gravity must be finite .*, got nan"),
        ({"damping": -1.0}, ValueError, r"damping must be >= 0 in torch\.float32, got -1\.0$"),
        (
            {"planes": torch.tensor([[0.0, 2.0, 0.0, 0.0, 0.0]])},
            ValueError,
            r"planes: the normal .*, got \[0\. 2\. 0\. 0\. 0\.\] at \[0\]",
        ),
        ({"planes": torch.tensor([[0.0, 1.0, 0.0, 0.0, -1.0]])}, ValueError, r"planes: friction .* must be >= 0"),
        ({"spheres": torch.zeros(1, 8)}, ValueError, r"spheres: the radius .* must be positive"),
    ):
        with pytest.raises(kind, match=f"^set_material: {message}"):
            sim.set_material(**arrays)  # type: ignore[arg-type]
    assert all(torch.equal(one, other) for one, other in zip(before, sim.material(), strict=True))


def test_a_state_dict_of_another_scene_is_refused_in_its_own_name() -> None:
    solid = pd.Solid(pd.shapes.box((1.0, 1.0, 1.0), (1, 1, 1)), 1e5)
    other = pd.Simulator(pd.Scene(solid, *(part for part in scene().parts if isinstance(part, pd.Gravity))), 1 / 60, 2)
    sim = small_simulator()
    before = [array.clone() for array in sim.material()]
    with pytest.raises(ValueError, match=r"^Simulator\.load_state_dict: stiffness .*got \[6\]; tetr"):
        sim.load_state_dict(other.state_dict())
    assert all(torch.equal(one, other) for one, other in zip(before, sim.material(), strict=True))
    two = {**sim.state_dict(), "masses": sim.masses.repeat(2, 1), "gravity": sim.gravity.repeat(3, 1)}
    with pytest.raises(ValueError, match=r"^Simulator\.load_state_dict: arrays .*got 2 environments"):
        sim.load_state_dict(two)


@pytest.mark.parametrize("assign", [False, True])
def test_a_state_dict_is_loaded_whole_or_not_at_all(assign: bool) -> None:
    sim = small_simulator()
    before = [array.clone() for array in sim.material()]
    for wrong, kind, message in (
        (torch.tensor(5.0), ValueError, r"stiffness .*got \[\]"),
        (5.0, TypeError, "stiffness .*got float"),
        (before[0].numpy(), TypeError, "stiffness .*got ndarray"),
    ):
        whole = {**sim.state_dict(), "masses": 2.0 * sim.masses, "stiffness": wrong}
        with pytest.raises(kind, match=rf"^Simulator\.load_state_dict: {message}"):
            sim.load_state_dict(whole, assign=assign)
        with pytest.raises(RuntimeError, match=message):
            torch.nn.ModuleDict({"sim": sim}).load_state_dict(
                {f"sim.{name}": array for name, array in whole.items()}, assign=assign
            )
        assert all(torch.equal(one, other) for one, other in zip(before, sim.material(), strict=True))


def test_one_number_is_for_what_has_one_each() -> None:
    sim = small_simulator()
    sim.set_material(stiffness=2e4, masses=torch.tensor(0.5), damping=0.25, pin_stiffness=1e3)
    for name, number in (("stiffness", 2e4), ("masses", 0.5), ("damping", 0.25), ("pin_stiffness", 1e3)):
        assert bool((getattr(sim, name) == number).all())


@pytest.mark.parametrize("name", ["stiffness", "masses", "damping", "pin_stiffness"])
@pytest.mark.parametrize("count", [3, 48])
def test_one_number_for_each_environment(name: str, count: int) -> None:
    """[B, 1], also for as many environments as the scene has tetrahedra."""
    sim = small_simulator()
    numbers = torch.arange(1.0, count + 1.0)
    sim.set_material(**{name: numbers[:, None]})
    rows = {"stiffness": 48, "masses": 27, "pin_stiffness": 3}
    wanted = numbers[:, None].expand(count, rows[name]) if name in rows else numbers
    assert torch.equal(getattr(sim, name).detach(), wanted)
    assert len(sim.rest_state().positions) == count


def test_one_dimension_counts_elements() -> None:
    """[n] is of n elements, whatever the number of environments, and [1] is of all; a scene of one element agrees."""
    sim = small_simulator()
    sim.set_material(stiffness=torch.arange(1.0, 49.0))
    assert sim.stiffness.shape == (48,)
    sim.set_material(stiffness=torch.tensor([2.0]))
    assert torch.equal(sim.stiffness.detach(), torch.full((48,), 2.0))
    tet = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    single = pd.Simulator(pd.Scene(pd.Solid(pd.TetMesh(tet, [[0, 1, 2, 3]]), 1e5)), 1 / 60, 2)
    with pytest.raises(ValueError, match=r"stiffness must be \[1\], .*, got \[3\]"):
        single.set_material(stiffness=torch.ones(3))
    single.set_material(stiffness=torch.ones(3, 1))
    assert single.stiffness.shape == (3, 1)


@pytest.mark.parametrize("name", ["stiffness", "damping"])
def test_files_have_whole_arrays(name: str) -> None:
    """Loading expands nothing: a file with another shape is a file of another scene."""
    sim = small_simulator()
    before = [array.clone() for array in sim.material()]
    with pytest.raises(ValueError, match=rf"load_state_dict: {name} must be .*, got \[3, 1\]"):
        sim.load_state_dict({**sim.state_dict(), name: torch.ones(3, 1)})
    assert all(torch.equal(one, other) for one, other in zip(before, sim.material(), strict=True))


def test_material_that_rounds_to_nothing_is_refused() -> None:
    thin = pd.Scene(pd.Solid(body().mesh, youngs=1e-60))
    with pytest.raises(ValueError, match=r"^Simulator: stiffness .*got 0\.0 at"):
        pd.Simulator(thin)
    pd.Simulator(thin, iterations=1, dtype=torch.float64)


def test_batches_of_the_material_must_agree() -> None:
    """Those that come with each other and with those that stay; nothing is replaced otherwise."""
    sim, shared = small_simulator(), small_simulator()

    def batch(name: str, count: int) -> dict[str, torch.Tensor]:
        own = getattr(shared, name)
        return {name: own.expand(count, *own.shape)}

    for arrays, message in (
        (batch("stiffness", 2) | batch("masses", 3), r"got 2 environments in stiffness and 3 in masses"),
        (
            batch("damping", 1) | batch("gravity", 2) | batch("planes", 3),
            r"got 2 environments in gravity and 3 in planes",
        ),
    ):
        before = named_arrays(sim)
        with pytest.raises(ValueError, match=message):
            sim.set_material(**arrays)
        assert all(before[name] is array for name, array in named_arrays(sim).items())
    sim.set_material(**batch("stiffness", 2))
    with pytest.raises(ValueError, match=r"got 2 environments in stiffness \(kept\) and 3 in masses"):
        sim.set_material(**batch("masses", 3))
    assert sim.masses.dim() == 1
    # one for all, or all of them anew, will do
    sim.set_material(**batch("masses", 1))
    sim.set_material(**batch("stiffness", 3), **batch("masses", 3))
    sim(sim.rest_state(3))


def test_what_is_no_material_is_refused(sim: pd.Simulator) -> None:
    for value in ("soft", None, [[1.0], [1.0, 2.0]], {}):
        with pytest.raises(TypeError, match=r"set_material: stiffness .*got"):
            sim.set_material(stiffness=value)  # type: ignore[arg-type]
    for loaded in (None, "file.pt", 3):
        with pytest.raises(TypeError, match=r"load_state_dict: state_dict .*mapping .*, got"):
            sim.load_state_dict(loaded)  # type: ignore[arg-type]
