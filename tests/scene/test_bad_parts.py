"""Effects and scenes that make no sense are refused, with the name, the contract and what came."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch
from sheets import cloth, surface
from small_scene import body

import torchpd as pd
from torchpd.common.warn import SceneWarning
from torchpd.simulation.notices import warn_of_scene
from torchpd.simulation.state_checks import report_resolution


def test_effects_are_checked() -> None:
    solid = body()
    for make, kind, message in (
        (lambda: pd.Solid("mesh", 1e5), TypeError, "Solid: mesh .*got str; .*tetrahedralize"),
        (lambda: pd.Solid(solid.mesh, 0.0), ValueError, r"Solid\.youngs .*got 0\.0 at 0"),
        (lambda: pd.Solid(solid.mesh, [1.0]), ValueError, r"Solid\.youngs .*got \[1\]"),
        (lambda: pd.Solid(solid.mesh, 1e5, math.nan), ValueError, r"Solid\.density .*got nan"),
        (lambda: pd.Pin(solid, []), ValueError, r"Pin\.vertices .*got none"),
        (lambda: pd.Pin(solid, np.zeros(27, bool)), ValueError, r"Pin\.vertices .*got none"),
        (lambda: pd.Pin(solid, [27]), IndexError, r"Pin\.vertices .*got 27"),
        (lambda: pd.Pin(solid, [-1]), IndexError, r"Pin\.vertices .*got -1"),
        (lambda: pd.Pin(solid, [1, 1]), ValueError, r"Pin\.vertices .*got 1 twice"),
        (lambda: pd.Pin(solid, [0.5]), ValueError, r"Pin\.vertices .*got float64 \[1\]"),
        (lambda: pd.Pin(solid, np.ones(5, bool)), ValueError, r"Pin\.vertices .*got \[5\]"),
        (lambda: pd.Pin(solid, [1], -1.0), ValueError, r"Pin\.stiffness .*got -1\.0"),
        (lambda: pd.Pin(solid, [1], [1.0, 2.0]), ValueError, r"Pin\.stiffness .*got \[2\]"),
        (lambda: pd.Pin("solid", [1]), TypeError, r"Pin\.body .*got str"),
        (lambda: pd.Gravity((0.0, 1.0)), ValueError, r"Gravity\.vector .*got \[2\]"),
        (lambda: pd.Gravity((0.0, math.inf, 0.0)), ValueError, r"Gravity\.vector .*got inf"),
        (lambda: pd.Ground(math.nan), ValueError, r"Ground\.height .*got nan"),
        (lambda: pd.Ground(normal=(0, 0, 0)), ValueError, r"Ground\.normal .*got \[0, 0, 0\]"),
        (lambda: pd.Ground(friction=-0.1), ValueError, r"Ground\.friction .*got -0\.1"),
        (lambda: pd.Sphere((0, 0), 1.0), ValueError, r"Sphere\.center .*got \[2\]"),
        (lambda: pd.Sphere((0, 0, 0), 0.0), ValueError, r"Sphere\.radius .*got 0"),
        (lambda: pd.Sphere((0, 0, 0), 1.0, -1.0), ValueError, r"Sphere\.friction .*got -1\.0"),
        (lambda: pd.Damping(-1.0), ValueError, r"Damping\.rate .*got -1"),
        (lambda: pd.Damping("fast"), TypeError, r"Damping\.rate .*got <U4"),
    ):
        with pytest.raises(kind, match=message):
            make()  # type: ignore[no-untyped-call]


def test_scenes_are_checked() -> None:
    solid, other = body(), body()
    for parts, kind, message in (
        ((), ValueError, "Scene .*got none"),
        ((pd.Gravity(),), ValueError, "Scene .*got none"),
        (([solid, pd.Gravity()],), TypeError, r"got list; pass them one by one, Scene\(\*parts\)"),
        ((solid, "gravity"), TypeError, "Scene: parts are bodies and effects of torchpd, got str"),
        ((solid, solid), ValueError, "got the same Solid twice"),
        ((solid, pd.Gravity(), pd.Gravity()), ValueError, "at most one Gravity, got 2"),
        ((solid, pd.Damping(1.0), pd.Damping(1.0)), ValueError, "at most one Damping, got 2"),
        ((solid, pd.Pin(other, [0])), ValueError, "the body of a Pin must be a part of this scene"),
        (
            (solid, pd.Pin(solid, [0, 1]), pd.Pin(solid, [1, 2])),
            ValueError,
            "pins must hold different vertices, got two at 1",
        ),
        (
            (solid, other, pd.Pin(other, [3]), pd.Pin(other, [3])),
            ValueError,
            "pins must hold different vertices, got two at ",
        ),
    ):
        with pytest.raises(kind, match=message):
            pd.Scene(*parts)  # type: ignore[arg-type]
    both = pd.Scene(solid, other, pd.Pin(solid, [0, 1]), pd.Pin(other, [1, 2]))  # numbers are those of a body
    with pytest.raises(ValueError, match="must be a part of the scene, got another one"):
        both.vertex_range(body())
    with pytest.raises(ValueError, match="must be a part of the scene, got another one"):
        both.pin_range(pd.Pin(solid, [3]))


def test_parts_keep_their_values() -> None:
    solid = body()
    for part, name in ((pd.Pin(solid, [0]), "stiffness"), (pd.Sphere((0, 0, 0), 1.0), "radius"), (solid, "youngs")):
        before = getattr(part, name)
        with pytest.raises(dataclasses.FrozenInstanceError, match=f"cannot assign to field '{name}'"):
            setattr(part, name, 3.0)
        with pytest.raises(dataclasses.FrozenInstanceError, match=f"cannot delete field '{name}'"):
            delattr(part, name)
        assert getattr(part, name) is before


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_short_floats_are_numbers_too(kind: torch.dtype) -> None:
    solid = body()
    short = torch.tensor([0.5, -2.0, 0.25], dtype=kind)
    assert pd.Gravity(short).vector.tolist() == [0.5, -2.0, 0.25]
    assert pd.Solid(solid.mesh, torch.tensor(1024.0, dtype=kind)).youngs.tolist() == [1024.0] * 48
    grid = torch.tensor(solid.mesh.vertices * 40, dtype=kind)  # 0, 4, 8
    assert np.array_equal(pd.TetMesh(grid, solid.mesh.tets).vertices, grid.double().numpy())


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (50.1, r"50\.1 m long, .* of 0\.001 to 50 m .* mesh\.scaled\(0\.001\) if these are millimetres"),
        (9.9e-4, r"0\.00099 m long, .* mesh\.scaled\(1000\) if"),
    ],
)
def test_bodies_that_are_hardly_in_metres_are_said(size: float, words: str) -> None:
    mesh = pd.shapes.single_tet().scaled(size / np.ptp(pd.shapes.single_tet().vertices, axis=0).max())
    with pytest.warns(pd.MeshWarning, match=f"Solid: the mesh is {words}") as said:
        pd.Solid(mesh, 1e5)
    assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for factor in (0.99, 1.02):
            inside = mesh.scaled(factor)
            if 1e-3 <= factor * size <= 50.0:
                pd.Solid(inside, 1e5)
        pd.Solid(mesh.translated((1e4, 0.0, 0.0)).scaled(1.0 / size), 1e5)
        # the length of each piece counts, not how far apart they are
        one = mesh.scaled(1.0 / size)
        apart = np.vstack([one.vertices, one.vertices + 60.0])
        pd.Solid(pd.TetMesh(apart, [[0, 1, 2, 3], [4, 5, 6, 7]]), 1e5)


def test_positions_that_float32_cannot_resolve_are_said() -> None:
    """Next to 1e6 float32 goes by 1/16, next to 500 by 3.1e-5, which is 6.1e-5 of an edge of 1/2."""

    def scene(offset: float) -> pd.Scene:
        return pd.Scene(
            pd.Solid(body().mesh.scaled(1.0 / np.ptp(body().mesh.vertices)).translated((0, offset, 0)), 1e5)
        )

    words = r"Simulator: 1e\+06 m from the origin .* to 0\.062 m, 0\.12 of the shortest .* \(48 of 48 tets"
    with pytest.warns(UserWarning, match=words) as said:
        pd.Simulator(scene(1e6))
    assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pd.Simulator(scene(500.0))
        sim = pd.Simulator(scene(1e6), dtype=torch.float64)
    with pytest.warns(UserWarning, match=words):
        sim.to(torch.float32)
    # of two bodies the one that is far away; a large one near the origin has edges as large
    with pytest.warns(UserWarning, match=r"\(48 of 96 tets"):
        pd.Simulator(pd.Scene(*scene(0.0).parts, *scene(1e6).parts))


def test_springs_ties_and_fibres_are_checked() -> None:
    solid, other = body(), pd.Solid(body().mesh.translated((0.2, 0.0, 0.0)), 1e5)
    for make, kind, message in (
        (lambda: pd.Springs("solid", [[0, 1]], 1.0), TypeError, r"Springs\.body .*got str"),
        (lambda: pd.Springs(solid, [[0, 1]], 1.0, other=3), TypeError, r"Springs\.other .*got int"),
        (lambda: pd.Springs(solid, [], 1.0), ValueError, r"Springs\.pairs .*got none"),
        (lambda: pd.Springs(solid, [0, 1], 1.0), ValueError, r"Springs\.pairs must be \[n, 2\] .*got \[2\]"),
        (lambda: pd.Springs(solid, [[0.0, 1.0]], 1.0), TypeError, r"Springs\.pairs .*got float64"),
        (lambda: pd.Springs(solid, [[0, 1], [0, 27]], 1.0), IndexError, r"0\.\.26 .*other\), got 27 at \[1, 1\]"),
        (lambda: pd.Springs(solid, [[-1, 1]], 1.0, other=other), IndexError, r"of body\), got -1 at \[0, 0\]"),
        (lambda: pd.Springs(solid, [[0, 1], [2, 2]], 1.0), ValueError, r"Springs\.pairs .*got \[2, 2\] at 1"),
        (lambda: pd.Springs(solid, [[0, 1]], 0.0), ValueError, r"Springs\.stiffness .*got 0\.0"),
        (lambda: pd.Springs(solid, [[0, 1]], [1.0, 2.0]), ValueError, r"Springs\.stiffness .*got \[2\]"),
        (lambda: pd.Springs(solid, [[0, 1]], 1.0, -0.1), ValueError, r"Springs\.rest_length .*got -0\.1"),
        (lambda: pd.Tie("solid", [0], solid, stiffness=1.0), TypeError, r"Tie\.body .*got str"),
        (lambda: pd.Tie(solid, [0], "solid", stiffness=1.0), TypeError, r"Tie\.other .*got str"),
        (lambda: pd.Tie(solid, [27], other, stiffness=1.0), IndexError, r"Tie\.vertices .*got 27"),
        (lambda: pd.Tie(solid, [], other, stiffness=1.0), ValueError, r"Tie\.vertices .*got none"),
        (lambda: pd.Tie(solid, [18], other, stiffness=0.0), ValueError, r"Tie\.stiffness .*got 0\.0"),
        (lambda: pd.Tie(solid, [18], other, [0, 0, 0], stiffness=1.0), ValueError, r"Tie\.points .*got \[3\]"),
        (lambda: pd.Tie(solid, [18], other, [[0, 0, math.nan]], stiffness=1.0), ValueError, r"Tie\.points .*got nan"),
        (lambda: pd.Tie(solid, [5], solid, stiffness=1.0), ValueError, r"tied to itself, got vertex 5 .*\(1 in all\)"),
        (lambda: pd.Fibres("solid", (1, 0, 0), 1.0), TypeError, r"Fibres\.solid .*got str"),
        (lambda: pd.Fibres(solid, (1, 0), 1.0), ValueError, r"Fibres\.direction .*got \[2\]"),
        (lambda: pd.Fibres(solid, (0, 0, 0), 1.0), ValueError, r"Fibres\.direction .*zero, got \[0\.0, 0\.0, 0\.0\]"),
        (lambda: pd.Fibres(solid, (1, 0, math.inf), 1.0), ValueError, r"Fibres\.direction .*got inf"),
        (lambda: pd.Fibres(solid, (1, 0, 0), -1.0), ValueError, r"Fibres\.stiffness .*got -1\.0"),
        (lambda: pd.Fibres(solid, (1, 0, 0), 1.0, 1.1), ValueError, r"Fibres\.contraction .*got 1\.1"),
        (lambda: pd.Fibres(solid, (1, 0, 0), 1.0, activation=-0.1), ValueError, r"Fibres\.activation .*got -0\.1"),
        (lambda: pd.Fibres(solid, (1, 0, 0), 1.0, activation=[0.5]), ValueError, r"Fibres\.activation .*got \[1\]"),
        (lambda: pd.Fibres(solid, (1, 0, 0), 1.0, tension_only="no"), TypeError, r"Fibres\.tension_only .*got 'no'"),
        (lambda: pd.Fibres(solid, (1, 0, 0), 1.0, tets=[48]), IndexError, r"Fibres\.tets .*\(tetrahedra .*got 48"),
        (lambda: pd.Fibres(solid, (1, 0, 0), 1.0, tets=np.zeros(48, bool)), ValueError, r"Fibres\.tets .*got none"),
    ):
        with pytest.raises(kind, match=message):
            make()  # type: ignore[no-untyped-call]


def test_rods_are_checked() -> None:
    line = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 4)
    for changed, kind, message in (
        ({"polyline": line[:1]}, ValueError, r"Rod\.polyline .*at least two vertices, got 1"),
        ({"polyline": line[:, :2]}, ValueError, r"Rod\.polyline must be \[n, 3\] .*got \[4, 2\]"),
        ({"polyline": line * math.nan}, ValueError, r"Rod\.polyline must be finite, got nan"),
        ({"polyline": line[[0, 1, 1, 2]]}, ValueError, r"Rod\.polyline: neighbours .*got \[0\.3.*\] at 1 and 2"),
        ({"youngs": 0.0}, ValueError, r"Rod\.youngs .*got 0\.0"),
        ({"radius": [0.1, 0.1]}, ValueError, r"Rod\.radius must be \[3\] .*got \[2\]"),
        ({"density": -1.0}, ValueError, r"Rod\.density .*got -1\.0"),
        ({"bending": -1.0}, ValueError, r"Rod\.bending .*got -1\.0"),
        ({"bending": [1.0]}, ValueError, r"Rod\.bending must be \[2\] .*inner vertex .*got \[1\]"),
        ({"rest_curvature": "straight"}, ValueError, r"Rod\.rest_curvature .*got 'straight'"),
    ):
        with pytest.raises(kind, match=message):
            pd.Rod(**{"polyline": line, "youngs": 1e6, "radius": 0.01, **changed})
    with pytest.warns(pd.MeshWarning, match=r"Rod: the polyline is 300 m long, .*pass polyline \* 0\.001 if"):
        pd.Rod(300.0 * line, 1e6, 0.01)


def test_parts_of_other_bodies_are_refused() -> None:
    solid, other = body(), body()
    for part in (
        pd.Springs(solid, [[0, 1]], 1.0, other=other),
        pd.Tie(other, [0], solid, stiffness=1.0),
        pd.Fibres(other, (1, 0, 0), 1.0),
    ):
        kind = type(part).__name__
        with pytest.raises(ValueError, match=f"Scene: the body of a {kind} must be a part of this scene, got another"):
            pd.Scene(solid, part)


def test_the_former_name_of_the_body_of_a_pin() -> None:
    solid = body()
    with pytest.warns(DeprecationWarning, match="Pin: solid is now called body"):
        pin = pd.Pin(solid=solid, vertices=[0])
    with pytest.warns(DeprecationWarning, match=r"Pin\.solid is now called body"):
        assert pin.solid is solid
    assert pin.body is solid
    with pytest.raises(TypeError, match="Pin has no argument 'solid'"):
        pd.Pin(vertices=[0], body=solid, solid=solid)


def test_thin_bodies_and_small_spheres_are_said() -> None:
    """Edges of a sheet of 4 x 4 cells are 0.25 m along the sides and 0.354 m across."""
    sheet = cloth()
    with pytest.warns(SceneWarning, match=r"sphere of radius 0\.3 m may meet edges .* of up to 0\.354 m") as said:
        warn_of_scene(pd.Scene(sheet, pd.Sphere((0, -1, 0), 1.0), pd.Sphere((0, -1, 0), 0.3)))
    assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_scene(pd.Scene(sheet, pd.Sphere((0, -1, 0), 0.36)))
        warn_of_scene(pd.Scene(body(), pd.Sphere((0, -1, 0), 0.01)))
    # with Contact surfaces of solids are expected to meet it
    with pytest.warns(SceneWarning, match=r"radius 0\.01 m may meet edges of Solid .*Collider.*sphere\(0\.01\)"):
        warn_of_scene(pd.Scene(body(), pd.Sphere((0, -1, 0), 0.01), pd.Contact()))


def test_sheets_that_float32_cannot_resolve_are_said() -> None:
    far = pd.Scene(body(), cloth(surface().translated((0.0, 1e5, 0.0))))  # spacing of 1/128, edges of 1/4
    with pytest.warns(UserWarning, match=r"0\.031 of the shortest edge of an element there \(32 of 80 elements"):
        report_resolution(far, torch.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report_resolution(far, torch.float64)
        report_resolution(pd.Scene(cloth()), torch.float32)
