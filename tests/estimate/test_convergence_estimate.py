"""Forecasts of iterations against linear problems whose spectrum is known, and against steps that are carried out."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from cases import sliver_mesh

import torchpd as pd
from torchpd.accuracy.error import exact_steps
from torchpd.estimate.convergence import Forecast, Spectrum, UnsolvedWarning, forecast, is_uneven, spectrum_of
from torchpd.geometry.mesh_quality import smallest_dihedral


def beam(youngs: float, cells: int = 3, **options: Any) -> pd.Simulator:
    mesh = pd.shapes.box((1.0, 0.2, 0.2), (5 * cells, cells, cells))
    body = pd.Solid(mesh, youngs=youngs)
    scene = pd.Scene(body, pd.Pin(body, mesh.vertices[:, 0] == 0.0), pd.Gravity())
    return pd.Simulator(scene, 1 / 30, dtype=torch.float64, progress=False, **{"iterations": 64, **options})


def swinging(sim: pd.Simulator) -> pd.State:
    state = sim.rest_state()
    state.velocities[..., 1] = -10.0 * state.positions[..., 0] ** 2
    return state


def test_the_spectrum_bounds_the_smallest_eigenvalue() -> None:
    """Of D^-1 A, from the dense matrix of the reference."""
    from torchpd.reference import step_problem

    sim = beam(1e5, 2)
    x, v = (part[0].numpy() for part in swinging(sim))
    problem = step_problem(sim.scene.values(), x, v, sim.time_step)
    free = problem.free
    half = torch.tensor(problem.weighted_diagonal[free]).rsqrt()
    matrix = torch.tensor(problem.matrix[free][:, free].toarray())
    smallest = float(torch.linalg.eigvalsh(half[:, None] * matrix * half)[0])
    found = spectrum_of(sim.compiled)
    assert found is not None
    assert found.least <= found.slow <= smallest
    # the lowest mode bends, which costs it little elastic energy; a body without pins has exactly the mean of a / D
    assert found.least > 0.3 * smallest


def test_the_worst_environment_counts() -> None:
    sim = beam(1e4)
    soft = spectrum_of(sim.compiled)
    sim.set_material(stiffness=sim.stiffness * torch.tensor([1.0, 100.0, 1.0])[:, None])
    both = spectrum_of(sim.compiled)
    assert soft is not None
    assert both is not None
    # mu = a / (a + stiffness part)
    assert both.least == pytest.approx(soft.least / (soft.least + 100.0 * (1.0 - soft.least)), rel=1e-6)


def test_a_tolerance_beyond_the_iterations_is_said() -> None:
    expected = forecast(beam(1e6, 5, iterations=64).compiled)
    assert expected is not None
    text = repr(beam(1e6, 5, iterations=64, tolerance=1e-3))
    assert f"tolerance 0.001 needs {expected.words(1e-3)} iterations: few steps will reach it in 64" in text
    assert "asks for" not in repr(beam(1e6, 5, iterations=expected.iterations(1e-3), tolerance=1e-3))
    assert "asks for" not in repr(beam(1e6, 5, iterations=64))


@pytest.mark.parametrize("least", [1e-1, 1e-3])
def test_rates_are_those_of_the_textbook(least: float) -> None:
    """Jacobi: 1 - theta mu. Chebyshev: (1 - sqrt(1 - rho^2)) / rho. Both lose one decade in ln 10 / -ln rate."""
    sim, spectrum = beam(1e5), Spectrum(least, least)
    plain = forecast(sim.compiled, pd.Jacobi(), spectrum)
    assert plain is not None
    assert plain.rate == pytest.approx(-math.log(1.0 - least))
    fast = forecast(sim.compiled, pd.Chebyshev(relaxation=1.0), spectrum)
    rho = 1.0 - least
    assert fast is not None
    assert fast.rate == pytest.approx(-math.log((1.0 - math.sqrt(1.0 - rho**2)) / rho))
    assert fast.iterations(1e-2) == math.ceil(math.log(100.0) / fast.rate)
    assert fast.error(fast.iterations(1e-2)) <= 1e-2 < fast.error(fast.iterations(1e-2) - 1)
    # momentum for another radius than the true one: slower, with less as with more
    for wrong in (1.0 - 4.0 * least, 1.0 - 0.1 * least):
        other = forecast(sim.compiled, pd.Chebyshev("classic", rho=wrong, diagonal="weighted"), spectrum)
        assert other is not None
        assert other.rate < fast.rate


@pytest.mark.parametrize("youngs", [1e4, 1e5, 1e6])
@pytest.mark.parametrize("solver", [pd.Chebyshev(), pd.Multilevel()], ids=["Chebyshev", "Multilevel"])
def test_a_step_takes_about_what_was_forecast(youngs: float, solver: Any) -> None:
    """Nine of ten random scenes took 0.3 to 1.4 times as many; the errors of a beam go down by decades in between."""
    sim = beam(youngs, solver=solver)
    state = swinging(sim)
    exact = exact_steps(sim, state)[0]
    expected = forecast(sim.compiled)
    assert expected is not None
    count = expected.iterations(1e-3)
    errors = []
    for sim.iterations in (count // 4, 2 * count):
        errors.append(exact.errors_of(sim(state).velocities[0].numpy() * sim.time_step).position)
    assert errors[0] > 1e-3 > errors[1]


def test_nothing_is_said_where_nothing_is_known() -> None:
    sim = beam(1e5)
    assert forecast(sim.compiled, pd.Jacobi(diagonal="plain")) is None
    assert forecast(sim.compiled, pd.Chebyshev("classic", rho=0.9)) is None
    solid = pd.Solid(pd.shapes.single_tet(), 1e5)
    held = pd.Simulator(pd.Scene(solid, pd.Pin(solid, [0, 1, 2, 3])))
    assert spectrum_of(held.compiled) is None
    assert "expected:" not in repr(held)
    assert spectrum_of(beam(1e5).to("meta").compiled) is None


def test_multilevel_does_not_care_about_the_mesh() -> None:
    """The same body, 3.4 times as fine: Chebyshev needs about so many times more, Multilevel the same."""
    coarse, fine = beam(1e6, 3), beam(1e6, 10)
    for solver, least, most in ((pd.Chebyshev(), 3.0, 3.8), (pd.Multilevel(), 0.93, 1.07)):
        rates = [expected.rate for sim in (coarse, fine) if (expected := forecast(sim.compiled, solver)) is not None]
        assert least < rates[0] / rates[1] < most


def test_contacts_are_expected_to_take_multilevel_two_roots_of_what_chebyshev_takes() -> None:
    """With slivers a seventh of it, if that is more; all of it with friction, and without a small problem."""
    even, slivers = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2)), sliver_mesh()

    def needed(solver: pd.Chebyshev | pd.Multilevel, *contacts: Any, mu: float = 1e-3, mesh: Any = even) -> float:
        sim = pd.Simulator(pd.Scene(pd.Solid(mesh, 1e6), *contacts), iterations=1)
        expected = forecast(sim.compiled, solver, Spectrum(mu, mu))
        assert expected is not None
        return math.log(1e3) / expected.rate

    smooth, rough = pd.Ground(), pd.Sphere((0.0, -1.0, 0.0), 1.0, friction=0.1)
    plain = needed(pd.Chebyshev())
    assert needed(pd.Multilevel()) < plain / 3
    assert needed(pd.Chebyshev(), smooth, rough) == plain
    # their relaxations differ
    for solver, contact in (
        (pd.Multilevel("momentum"), smooth),
        (pd.Multilevel("momentum"), rough),
        (pd.Multilevel(), rough),
    ):
        assert needed(solver, contact) == pytest.approx(plain, rel=0.05)
    assert needed(pd.Multilevel(), smooth, rough) == pytest.approx(plain, rel=0.05)
    stiff = needed(pd.Chebyshev(), mu=1e-5)
    assert needed(pd.Multilevel(), smooth, mu=1e-5) == pytest.approx(2 * stiff**0.5, rel=0.05)
    assert needed(pd.Multilevel(), smooth, mu=1e-5, mesh=slivers) == pytest.approx(stiff / 7, rel=0.05)
    soft = needed(pd.Chebyshev(), mu=1e-2)
    assert soft < 196
    for mesh in (even, slivers):
        assert needed(pd.Multilevel(), smooth, mu=1e-2, mesh=mesh) == pytest.approx(2 * soft**0.5, rel=0.05)


@pytest.mark.parametrize(("degrees", "sliver"), [(4.9, True), (5.1, False)])
def test_a_sliver_has_an_angle_below_five_degrees(degrees: float, sliver: bool) -> None:
    """A face over the x axis that leans to the plane of x and y; alone or beside a box."""
    lean = math.radians(degrees)
    tip = [0.3, 0.5 * math.cos(lean), 0.5 * math.sin(lean)]
    flat = pd.TetMesh([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], tip], [[0, 1, 2, 3]])
    box = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
    assert smallest_dihedral(flat.vertices, flat.tets) == pytest.approx(lean, abs=1e-12)
    assert smallest_dihedral(box.vertices, box.tets) == box.quality().min_dihedral.min()
    for meshes in ([flat], [box, flat]):
        sim = pd.Simulator(pd.Scene(*(pd.Solid(mesh, 1e6) for mesh in meshes)), iterations=1, progress=False)
        assert [is_uneven(sim.compiled) for _ in range(2)] == [sliver, sliver]


def test_a_body_of_very_different_stiffness_is_uneven() -> None:
    """Of any environment, and after `set_material`; two bodies may differ."""
    mesh = pd.shapes.box((0.2, 0.2, 0.2), (2, 2, 2))
    soft, stiff = (pd.Solid(mesh, youngs) for youngs in (1e4, 1e6))
    sim = pd.Simulator(pd.Scene(soft, stiff), iterations=1, progress=False)
    assert not is_uneven(sim.compiled)
    factor = torch.ones(2, sim.stiffness.shape[-1])
    for most, uneven in ((29.0, False), (31.0, True)):
        factor[1, -1] = most
        sim.set_material(stiffness=factor * sim.stiffness.new_tensor([1e4]))
        assert is_uneven(sim.compiled) == uneven


def test_what_may_be_hard_to_multilevel_is_no_warning() -> None:
    """Most steps on contacts take it a tenth of that."""
    scene = pd.Scene(pd.Solid(pd.shapes.box((0.2, 0.2, 0.2), (4, 4, 4)), 1e8), pd.Gravity(), pd.Ground())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pd.Simulator(scene, 1 / 60, solver=pd.Multilevel(), progress=False)
    with pytest.warns(UnsolvedWarning):
        pd.Simulator(scene, 1 / 60, progress=False)


def test_a_default_that_is_far_too_small_is_said_once_and_printed() -> None:
    def compiled(**options: Any) -> list[warnings.WarningMessage]:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            beam(1e6, 5, **options)
        return said

    (warning,) = compiled(iterations=None)
    assert warning.category is UnsolvedWarning
    assert warning.filename == __file__
    assert "the default of 64 iterations leaves a relative error of about 0.3" in str(warning.message)
    # who names a number has decided; 64 of Multilevel are plenty; a tolerance does not make 64 more
    for options in ({}, {"tolerance": 1e-4}, {"iterations": None, "solver": pd.Multilevel()}):
        assert compiled(**options) == []
    (limited,) = compiled(iterations=None, tolerance=1e-4)
    assert "the default of 64 iterations" in str(limited.message)
    assert "64 leave about 0.3: far too few" in repr(beam(1e6, 5))
    assert "far too few" not in repr(beam(1e4, 5))


def test_an_error_is_never_reached_before_the_first_iteration() -> None:
    assert Forecast(100.0).iterations(0.5) == 1
    assert Forecast(1.0).error(0) == 1.0
