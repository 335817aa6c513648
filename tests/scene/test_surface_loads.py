"""Pressure and wind on surfaces: closed forms, derivatives, bits and checks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from sheets import cloth, surface
from torch import Tensor

import torchpd as pd
from torchpd import Pressure, SurfaceLoads, Wind
from torchpd.scene.loads import enclosed_volume

EXACT = 1e-12


def octahedron(scale: float = 0.3) -> pd.TriMesh:
    points = scale * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    return pd.TriMesh(points, [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])


def hollow() -> pd.Solid:
    """A cube of 0.3 m without its middle third."""
    mesh = pd.shapes.box((0.3, 0.3, 0.3), (3, 3, 3))
    inner = (np.abs(mesh.vertices[mesh.tets].mean(axis=1) - 0.15) < 0.05).all(axis=1)
    return pd.Solid(pd.TetMesh(mesh.vertices, mesh.tets[~inner], drop_unreferenced=False), 1e5)


def forces(*parts: Any, positions: Tensor | None = None, velocities: Tensor | None = None, **options: Any) -> Tensor:
    loads_of = [part for part in parts if isinstance(part, Pressure | Wind)]
    scene = pd.Scene(*(part for part in parts if not isinstance(part, Pressure | Wind)))
    rest = torch.tensor(scene.rest_positions)[None]
    positions = rest if positions is None else positions
    velocities = torch.zeros_like(positions) if velocities is None else velocities
    given = {"masses": torch.tensor(scene.values().masses), "time_step": 1e-9, **options}
    return SurfaceLoads(scene, loads_of, torch.float64).forces(positions, velocities, **given)


def moved(scene: pd.Scene, batch: int, scale: float = 0.02) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(6)
    rest = scene.rest_positions
    x, v = (rng.normal(scale=size, size=(batch, *rest.shape)) for size in (scale, 1.0))
    return torch.tensor(rest + x), torch.tensor(v)


def test_a_constant_pressure_is_p_times_the_gradient_of_the_volume() -> None:
    """Also off the rest shape; its sum and torque are zero, as of any closed surface."""
    body = cloth(octahedron())
    load = Pressure(body, 700.0)
    x, _ = moved(pd.Scene(body), 3)
    found = forces(body, load, positions=x)
    corners = x.requires_grad_()[:, body.surface.triangles.copy()]
    volume = torch.einsum("bfi,bfi->b", corners[:, :, 0], torch.linalg.cross(corners[:, :, 1], corners[:, :, 2])) / 6.0
    (gradient,) = torch.autograd.grad(volume.sum(), x)
    torch.testing.assert_close(found, 700.0 * gradient, rtol=1e-11, atol=1e-11)
    size = found.abs().max()
    assert found.sum(1).abs().max() < EXACT * size
    assert torch.linalg.cross(x, found).sum(1).abs().max() < 1e-11 * size


def test_a_gas_has_an_energy() -> None:
    """-(p0 + pa) V0 log V + pa V, whose gradient the forces are; at rest the overpressure is p0."""
    body = cloth(octahedron())
    load = Pressure(body, 2e3, gas=True, ambient=1e5)
    triangles = body.surface.triangles.copy()
    rest = enclosed_volume(body.surface.vertices, triangles)
    assert rest == pytest.approx(4.0 / 3.0 * 0.3**3, rel=EXACT)
    x, _ = moved(pd.Scene(body), 2)
    corners = x.requires_grad_()[:, triangles]
    volume = torch.einsum("bfi,bfi->b", corners[:, :, 0], torch.linalg.cross(corners[:, :, 1], corners[:, :, 2])) / 6.0
    energy = -1.02e5 * rest * volume.log() + 1e5 * volume
    (gradient,) = torch.autograd.grad(energy.sum(), x)
    found = forces(body, load, positions=x.detach())
    torch.testing.assert_close(found, -gradient, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(forces(body, load), forces(body, Pressure(body, 2e3)), rtol=1e-10, atol=1e-10)
    flat = x.detach() * torch.tensor([1.0, 1.0, 1e-5], dtype=torch.float64)
    assert forces(body, load, positions=flat).isfinite().all()


def test_the_cavity_of_a_solid_is_pushed_apart() -> None:
    """0.1 m wide: the vertices of each side get p A in all, those of the outer surface nothing."""
    body = hollow()
    found = forces(body, Pressure(body, 1e3))[0]
    x = torch.tensor(body.mesh.vertices)
    for axis in range(3):
        for side, sign in ((0.1, -1.0), (0.2, 1.0)):
            there = (x[:, axis] - side).abs() < 1e-9
            assert float(found[there, axis].sum()) == pytest.approx(sign * 10.0, rel=EXACT)
    outer = ((x < 0.05) | (x > 0.25)).any(1)
    assert not found[outer].any()


def test_wind_pushes_along_the_normal() -> None:
    """rho c / 2 A (u . n)^2 n: all of it across the wind, cos^2 of it when inclined, nothing in its plane."""
    sheet = cloth(surface(size=(1.0, 0.5), cells=(2, 2)))
    full = 0.5 * 1.2 * 1.1 * 0.5 * 8.0**2
    for velocity, expected in (((0, 8, 0), 1.0), ((0, -8, 0), -1.0), ((8, 0, 0), 0.0), ((0, 4, 48**0.5), 0.25)):
        found = forces(sheet, Wind(velocity, drag=1.1))[0].sum(0)
        np.testing.assert_allclose(found, [0.0, expected * full, 0.0], atol=1e-9 * full)
    carried = torch.tensor([0.0, 8.0, 0.0], dtype=torch.float64).expand(1, 9, 3)
    assert not forces(sheet, Wind((0, 8, 0)), velocities=carried).any()


def test_wind_meets_a_solid_from_one_side_and_no_rod() -> None:
    body = pd.Solid(pd.shapes.box((0.2, 0.3, 0.4), (1, 1, 1)), 1e5)
    rod = pd.Rod([[0, 2, 0], [1, 2, 0]], 1e6, 0.01)
    found = forces(rod, body, Wind((0.0, 0.0, 5.0), drag=1.0, density=2.0))[0]
    assert not found[:2].any()
    x = torch.tensor(body.mesh.vertices)
    np.testing.assert_allclose(found[2:].sum(0), [0.0, 0.0, 0.2 * 0.3 * 25.0], atol=1e-12)
    assert not found[2:][x[:, 2] > 0.1].any()
    with pytest.raises(ValueError, match="Wind: the scene must have a Cloth or a Solid, got none"):
        SurfaceLoads(pd.Scene(rod), [Wind((1, 0, 0))])


def test_wind_never_turns_the_motion_around() -> None:
    """h push / m of 500: one step from rest takes a free sheet to 500 / 501 of the speed of the wind."""
    sheet = cloth(surface(cells=(3, 3)), area_density=0.01)
    speed = 0.01 * 500.0 / (0.5 * 1.2 * 1.2 * 1.0)
    masses = torch.tensor(sheet.masses())
    push = forces(sheet, Wind((0, speed, 0)), time_step=1.0)[0]
    np.testing.assert_allclose(push.sum(0)[1] / masses.sum(), speed * 500.0 / 501.0, rtol=EXACT)


def test_derivatives_by_finite_differences() -> None:
    body = cloth(octahedron())
    gas, wind = Pressure(body, 2e3, gas=True, ambient=1e3), Wind((3.0, 1.0, 0.5))
    scene = pd.Scene(body)
    loads, masses = SurfaceLoads(scene, [gas, wind], torch.float64), torch.tensor(scene.values().masses)
    x, v = moved(scene, 2)
    pascals = torch.tensor([2e3, -50.0], dtype=torch.float64)
    air = torch.tensor([[3.0, 1.0, 0.5], [-1.0, 4.0, 2.0]], dtype=torch.float64)

    def call(x: Tensor, v: Tensor, masses: Tensor, pascals: Tensor, air: Tensor) -> Tensor:
        return loads.forces(x, v, masses, 0.01, {gas: pascals, wind: air})

    inputs = [one.clone().requires_grad_() for one in (x, v, masses, pascals, air)]
    assert torch.autograd.gradcheck(call, inputs)
    assert torch.autograd.gradgradcheck(call, inputs)


def test_same_bits_alone_and_in_a_batch() -> None:
    """Forces and derivatives, in float32."""
    body, sheet = hollow(), cloth(surface(cells=(5, 4)))
    scene = pd.Scene(body, sheet)
    loads = SurfaceLoads(scene, [Pressure(body, 1e3, gas=True), Wind((3.0, 1.0, 0.5))])
    masses = torch.tensor(scene.values().masses, dtype=torch.float32)
    x, v = (one.float() for one in moved(scene, 7))

    def both(x: Tensor, v: Tensor) -> list[Tensor]:
        x, v = x.clone().requires_grad_(), v.clone().requires_grad_()
        out = loads.forces(x, v, masses, 0.01)
        return [out.detach(), *torch.autograd.grad(out.square().sum(), (x, v))]

    whole = both(x, v)
    for environment in range(7):
        alone = both(x[environment, None], v[environment, None])
        for one, other in zip(whole, alone, strict=True):
            assert torch.equal(one[environment, None], other)


def test_inputs_of_a_step_replace_those_of_the_parts() -> None:
    body = cloth(octahedron())
    load, wind = Pressure(body, 1.0), Wind((0.0, 0.0, 0.0))
    given = {load: torch.tensor(700.0, dtype=torch.float64)}
    torch.testing.assert_close(forces(body, load, loads=given), forces(body, Pressure(body, 700.0)))
    blown = {wind: torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)}
    torch.testing.assert_close(forces(body, wind, loads=blown), forces(body, Wind((1.0, 2.0, 3.0))))
    for inputs, kind, message in (
        ({load: 1.0}, TypeError, r"Pressure \(pascals\) must be a tensor .*got float"),
        ({load: torch.zeros(2).double()}, ValueError, r"Pressure \(pascals\) must be \[\] or \[1\], got \[2\]"),
        ({wind: torch.zeros(3)}, TypeError, r"Wind \(velocity\) must be torch\.float64 .*got torch\.float32"),
        ({wind: torch.zeros(2, 3).double()}, ValueError, r"Wind \(velocity\) must be \[3\] or \[1, 3\], got \[2, 3\]"),
        ({Wind((1, 0, 0)): torch.zeros(3)}, ValueError, "this Wind is none of the parts"),
    ):
        with pytest.raises(kind, match=message):
            forces(body, load, wind, loads=inputs)


def test_loads_are_checked() -> None:
    closed, rod = cloth(octahedron()), pd.Rod([[0, 0, 0], [1, 0, 0]], 1e6, 0.01)
    turned = cloth(pd.TriMesh(octahedron().vertices, octahedron().triangles[:, ::-1]))
    twisted = octahedron().triangles.copy()
    twisted[0] = twisted[0, ::-1]
    full = pd.Solid(pd.shapes.box((0.2, 0.3, 0.4), (1, 1, 1)), 1e5)
    for make, kind, message in (
        (lambda: Pressure("balloon", 1.0), TypeError, r"Pressure\.body .*got str"),
        (lambda: Pressure(rod, 1.0), TypeError, r"Pressure\.body .*got Rod"),
        (lambda: Pressure(full, 1.0), ValueError, r"Pressure\.triangles .*without a cavity, got None"),
        (lambda: Pressure(cloth(), 1.0), ValueError, r"must be closed, .*got the edge \[\d+, \d+\] \(16 in all\)"),
        (lambda: Pressure(cloth(pd.TriMesh(octahedron().vertices, twisted)), 1.0), ValueError, "must be closed"),
        (lambda: Pressure(turned, 1.0), ValueError, r"positive volume, got -0\.036 m\^3"),
        (lambda: Pressure(closed, np.nan), ValueError, r"Pressure\.pascals .*got nan"),
        (lambda: Pressure(closed, 1.0, gas=1.0), TypeError, r"Pressure\.gas .*got 1\.0"),
        (lambda: Pressure(closed, 1.0, ambient=-1.0), ValueError, r"Pressure\.ambient .*got -1\.0"),
        (lambda: Pressure(closed, 1.0, triangles=[[0, 1, 9]]), IndexError, r"Pressure\.triangles .*got \[0, 1, 9\]"),
        (lambda: Wind((1.0, 0.0)), ValueError, r"Wind\.velocity .*got \[2\]"),
        (lambda: Wind((1, 0, 0), drag=-1.0), ValueError, r"Wind\.drag .*got -1\.0"),
        (lambda: Wind((1, 0, 0), density=0.0), ValueError, r"Wind\.density .*got 0\.0"),
    ):
        with pytest.raises(kind, match=message):
            make()  # type: ignore[no-untyped-call]
    given = Pressure(full, 1.0, triangles=full.mesh.boundary())
    assert len(given.triangles) == 12
    with pytest.raises(ValueError, match="body must be a part of the scene, got another one"):
        SurfaceLoads(pd.Scene(cloth()), [Pressure(closed, 1.0)])
    with pytest.raises(TypeError, match="SurfaceLoads: parts must be Pressure or Wind, got Gravity"):
        SurfaceLoads(pd.Scene(closed), [pd.Gravity()])
