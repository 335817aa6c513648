"""Steps with strain limits, the volume law and stiffness-proportional damping; |x - x*| against Newton's solution.

Known tips come from an independent float64 prototype, converged to 1e-12.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import torch
from cases import beam, beam_tip
from runs import displacement, rounded_problem, simulator, state_of, tensor_of
from simd_steps import alone_and_in_a_batch, own_simd, results_with
from stretch_cases import KINDS, LIMITED_BEAM, VOLUME_BEAM, limited_beam, small_body, volume_beam

import torchpd as pd
from torchpd.reference.solvers import newton, relative_error

pytestmark = pytest.mark.usefixtures("poisoned")
HELPERS = Path(__file__).resolve().parents[1] / "helpers"


@pytest.mark.parametrize("stiffness", LIMITED_BEAM)
def test_known_limited_beam(stiffness: float) -> None:
    """E* is without the inertia of the held vertices."""
    case = limited_beam(stiffness)
    tip, energy = LIMITED_BEAM[stiffness]
    sim = simulator(case, torch.float64, iterations={1e6: 900, 1e7: 2000}[stiffness])
    after, info = sim(state_of(case, sim), return_info=True)
    np.testing.assert_allclose(after.positions[0, beam_tip()].mean(0), tip, atol=1e-6)
    assert float(info.energy) == pytest.approx(energy, rel=1e-6)


def test_known_volume_beam() -> None:
    case = volume_beam()
    sim = simulator(case, torch.float64, iterations=1500)
    after = sim(state_of(case, sim), start="inertial")
    np.testing.assert_allclose(after.positions[0, beam_tip()].mean(0), VOLUME_BEAM, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_converges_to_the_reference(kind: str, dtype: torch.dtype) -> None:
    """In float32 what is left is the rounding of positions of 0.4 m, over the displacement."""
    case = small_body(kind)
    problem = rounded_problem(case, dtype)
    first = problem.first_iterate("velocity")
    u = newton(problem, first)
    sim = simulator(case, dtype, iterations=3000)
    after, info = sim(state_of(case, sim), return_info=True)
    assert relative_error(displacement(sim, after), u, first) < {torch.float64: 1e-8, torch.float32: 1e-4}[dtype]
    assert float(info.energy) == pytest.approx(problem.energy(u), rel={torch.float64: 1e-9, torch.float32: 1e-3}[dtype])
    assert float(info.residual) < {torch.float64: 1e-7, torch.float32: 1e-3}[dtype]


@pytest.mark.parametrize("start", ["random", "collapsed", "mirrored", "stretched"])
@pytest.mark.parametrize("kind", KINDS)
def test_energy_never_rises_from_hard_starts(kind: str, start: str, dtype: torch.dtype) -> None:
    case = small_body(kind)
    x = case.positions
    guess = {
        "random": np.random.default_rng(0).uniform(0.0, 1.0, x.shape),
        "collapsed": np.zeros_like(x),
        "mirrored": x * [1.0, -1.0, 1.0],
        "stretched": 5.0 * x,
    }[start]
    sim = simulator(case, dtype, solver=pd.Jacobi(relaxation=1.9))
    energies = []
    for sim.iterations in (0, 1, 2, 3, 5, 8, 13, 21, 34):
        _, info = sim(state_of(case, sim), start=tensor_of(guess, sim, 1), return_info=True)
        energies.append(float(info.energy))
    falls = -np.diff(energies)
    assert np.isfinite(energies).all()
    assert (falls >= -8 * torch.finfo(dtype).eps * np.abs(energies[:-1])).all()


@pytest.mark.parametrize("kind", ["volume", "solid_limit"])
def test_guarded_chebyshev_descends_from_hard_starts(kind: str) -> None:
    case = small_body(kind)
    guess = np.random.default_rng(0).uniform(0.0, 1.0, case.positions.shape)
    problem = rounded_problem(case, torch.float64)
    sim = simulator(case, torch.float64, iterations=3000)
    after, info = sim(state_of(case, sim), start=tensor_of(guess, sim, 1), return_info=True)
    assert float(info.residual) < 1e-5
    assert float(info.energy) < 1.001 * problem.energy(problem.first_iterate(guess))
    assert torch.isfinite(after.positions).all()


def test_a_rigid_rotation_of_the_start_feels_no_damping() -> None:
    """The start is the rest shape turned about z; the gradient at any state is that without damping, turned."""
    case = small_body("damper", held=False)
    sim = simulator(case, torch.float64)
    turn = torch.tensor(np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0])
    turn = turn * torch.linalg.det(turn)
    rest = sim.rest_positions[None]
    gradient = torch.ops.torchpd.damping_gradient
    material, plan = sim.material(), list(sim.plan.arrays)
    for start, after in ((rest, rest @ turn), (rest @ turn, rest)):
        forces = gradient(after, start, material, plan, time_step=sim.time_step)
        assert float(forces.abs().max()) < 1e-10  # of 2 mu beta / h A = 2e4 N
    stretched = 1.01 * rest
    one, other = (gradient(stretched, start, material, plan, time_step=0.1) for start in (rest, rest @ turn))
    torch.testing.assert_close(one, other, atol=1e-9, rtol=1e-9)


def test_damping_takes_energy_and_keeps_momentum() -> None:
    """A free bar that is stretched and let go: its vibration dies, its linear and angular momentum stay."""
    mesh = small_body("damper").scene.solids[0].mesh
    still = replace(
        small_body("damper"), positions=mesh.vertices * [1.2, 1.0, 1.0], velocities=np.zeros_like(mesh.vertices)
    )
    left = []
    for seconds in (0.0, 0.02):
        body = pd.Solid(mesh, 1e5, stiffness_damping=seconds)
        sim = simulator(replace(still, scene=pd.Scene(body)), torch.float64, iterations=200)
        sim.time_step = 1.0 / 240.0
        state = sim.rollout(state_of(still, sim), 24).state()
        left.append(float(sim.energy(state)))
        momentum = (sim.masses[:, None] * state.velocities[0]).sum(0)
        assert float(momentum.abs().max()) < 1e-8
    assert left[1] < 0.05 * left[0]


@pytest.mark.parametrize("simd", sorted({own_simd(), "avx2"}))
def test_same_bits_alone_and_in_a_batch(simd: str) -> None:
    """19 environments fill packs of environments and leave lanes over; alone, packs hold elements."""
    if simd not in pd._C.build_info()["simd_available"]:
        pytest.skip(f"this machine has no {simd}")
    assert all(results_with(simd, alone_and_in_a_batch))


def test_a_scene_without_them_is_as_before() -> None:
    """Their arguments at their defaults change nothing of a scene: no stencils, no rows of the material."""
    plain = beam(1e5)
    values = plain.scene.values()
    assert values.stencils == ()
    assert values.stiffness_damping is None
    sim = simulator(plain, torch.float32, iterations=2)
    assert len(sim.material()) == 8


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_simulator_comes_back(kind: str, tmp_path: Path) -> None:
    case = small_body(kind)
    sim = simulator(case, torch.float64, iterations=8)
    sim.save(tmp_path / "sim.safetensors")
    other = pd.Simulator.load(tmp_path / "sim.safetensors")
    state = state_of(case, sim)
    assert torch.equal(sim(state).positions, other(state).positions)


def test_rows_by_name_and_environment() -> None:
    """A limit as one row for all, and as another one in each environment; damping by a number per environment."""
    case = small_body("solid_limit")
    sim = simulator(case, torch.float64, iterations=30)
    state = state_of(case, sim, 2)
    rows = sim.solid_limit.detach().clone()
    wide = rows.clone()
    wide[:, 1] = 1.5
    sim.set_material(solid_limit=torch.stack([rows, wide]))
    both = sim(state).positions
    for item, row in enumerate((rows, wide)):
        sim.set_material(solid_limit=row)
        assert torch.equal(sim(pd.State(*(t[item : item + 1] for t in state))).positions[0], both[item])
    assert not torch.equal(both[0], both[1])
    with pytest.raises(ValueError, match=r"solid_limit: lo \(column 0\) must be in \[0, 1\].*got 1\.1"):
        sim.set_material(solid_limit=rows + torch.tensor([1.1 - 0.97, 0.0, 0.0], dtype=torch.float64))
    with pytest.raises(TypeError, match=r"no cloth has a strain_limit.*Cloth\(strain_limit=\)"):
        sim.set_material(cloth_limit=rows)
    with pytest.raises(TypeError, match=r"stiffness_damping=0.0.*Solid\(stiffness_damping=\)"):
        sim.set_material(stiffness_damping=0.1)
    damped = simulator(small_body("damper"), torch.float64, iterations=30)
    damped.set_material(stiffness_damping=torch.tensor([[0.0], [0.1]], dtype=torch.float64))
    pair = damped(state_of(small_body("damper"), damped, 2)).positions
    assert not torch.equal(pair[0], pair[1])


def test_damping_where_none_is_compiled_in() -> None:
    damped, plain = (pd.Solid(MESH.translated((i, 0.0, 0.0)), 1e5, stiffness_damping=0.1 * (1 - i)) for i in range(2))
    sim = pd.Simulator(pd.Scene(plain, damped), progress=False)
    count = len(MESH.tets)
    sim.set_material(stiffness_damping=torch.tensor([0.0] * count + [0.2] * count))
    with pytest.raises(ValueError, match=rf"stiffness_damping must be 0 .* without it, got another .* at 0 \({count}"):
        sim.set_material(stiffness_damping=0.1)


MESH = small_body("solid_limit").scene.solids[0].mesh


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (
            {"strain_limit": (1.05, 0.95)},
            r"Solid.strain_limit must have a least stretch in \[0, 1\].*got \[1.05, 0.95\]",
        ),
        ({"strain_limit": (0.9,)}, r"Solid.strain_limit.*\[96, 2\].*pair per tetrahedron"),
        ({"limit_stiffness": 1e6}, r"Solid.limit_stiffness acts beyond a strain_limit, got it without"),
        ({"strain_limit": (0.9, 1.1), "limit_stiffness": -1.0}, r"Solid.limit_stiffness must be positive.*-1"),
        ({"law": "neo-hookean"}, r'Solid.law must be "corotated" or "volume", got \'neo-hookean\''),
        ({"law": "volume"}, r'Solid.poisson must be positive for law="volume".*got 0'),
        ({"stiffness_damping": -0.1}, r"Solid.stiffness_damping must be >= 0 \[s\], got -0.1"),
    ],
)
def test_arguments_are_checked(options: dict[str, Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        pd.Solid(MESH, 1e5, **options)


def test_default_stiffness_beyond_a_limit() -> None:
    """30 times Young's modulus, or youngs thickness of a sheet; partly empty tetrahedra in proportion."""
    body = pd.Solid(MESH, 1e5, strain_limit=(0.9, 1.1))
    (group,) = body.stencils(lambda _: 0)
    np.testing.assert_allclose(group.material["solid_limit"], [[0.9, 1.1, 3e6]] * len(MESH.tets), rtol=1e-15)
    surface = small_body("cloth_limit").scene.bodies[0].mesh
    sheet = pd.Cloth(surface, 2e5, 1e-3, 0.2, strain_limit=(0.0, 1.1))
    np.testing.assert_allclose(sheet.limit_stiffness, 30.0 * 200.0)


@pytest.mark.parametrize("kind", ["solid_limit", "volume", "damper"])
def test_reactions_balance_the_forces_of_a_solved_step(kind: str) -> None:
    """The gradient of the objective, damping included, is the force of the pins."""
    case = small_body(kind)
    sim = simulator(case, torch.float64, iterations=800)
    state = state_of(case, sim)
    after = sim(state)
    forces = sim.contact_forces(state, after)
    assert float(forces.residual.abs().max()) < 1e-8 * float(sim.reactions(state, after).force.abs().max())


def test_readouts_without_a_formula_refuse() -> None:
    for kind in ("solid_limit", "volume"):
        sim = simulator(small_body(kind), torch.float64)
        with pytest.raises(ValueError, match=r'stress: every solid must have law="corotated" and no strain_limit'):
            sim.stress(sim.rest_state(1))
    sim = simulator(small_body("cloth_limit"), torch.float64)
    with pytest.raises(ValueError, match="membrane_stress: every cloth must have no strain_limit"):
        sim.membrane_stress(sim.rest_state(1))
    damped = simulator(small_body("damper"), torch.float64)
    assert damped.stress(damped.rest_state(1)).cauchy.isfinite().all()


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("solid_limit", "strain limits: 96 tetrahedra, a local step each per iteration"),
        ("cloth_limit", "24 strain limits"),
        ("volume", 'law "volume": 96 tetrahedra, a local step each per iteration'),
        ("damper", "stiffness-proportional damping: 96 tetrahedra, a local step each per iteration"),
    ],
)
def test_print_names_them(kind: str, line: str) -> None:
    assert line in repr(simulator(small_body(kind), torch.float32))


def test_files_for_paraview(tmp_path: Path) -> None:
    for kind in KINDS:
        sim = simulator(small_body(kind), torch.float32, iterations=2)
        sim.write_vtu(tmp_path / f"{kind}.vtu", sim.rest_state(1))
        written = meshio.read(tmp_path / f"{kind}.vtu")
        assert len(written.points) == sim.vertices
        assert sum(len(cells.data) for cells in written.cells) >= max(1, sim.stiffness.shape[-1])
