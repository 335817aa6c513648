"""Effects and scenes that make no sense are refused, with the name, the contract and what came."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from small_scene import body

import torchpd as pd


def test_effects_are_checked() -> None:
    solid = body()
    for make, kind, message in (
        (lambda: pd.Solid("mesh", 1e5), TypeError, r"Solid: mesh must be a TetMesh, got str; .*tetrahedralize"),
        (lambda: pd.Solid(solid.mesh, 0.0), ValueError, r"Solid\.youngs must be positive \[Pa\], got 0\.0 at 0"),
        (lambda: pd.Solid(solid.mesh, [1.0]), ValueError, r"Solid\.youngs must be \[48\] .* got \[1\]"),
        (lambda: pd.Solid(solid.mesh, 1e5, math.nan), ValueError, r"Solid\.density must be finite"),
        (lambda: pd.Pin(solid, []), ValueError, r"Pin\.vertices must name at least one vertex"),
        (lambda: pd.Pin(solid, np.zeros(27, bool)), ValueError, r"Pin\.vertices must name at least one vertex"),
        (lambda: pd.Pin(solid, [27]), IndexError, r"Pin\.vertices must lie in 0\.\.26 .* got 27"),
        (lambda: pd.Pin(solid, [-1]), IndexError, r"Pin\.vertices must lie in 0\.\.26"),
        (lambda: pd.Pin(solid, [1, 1]), ValueError, r"Pin\.vertices must not name a vertex twice"),
        (lambda: pd.Pin(solid, [0.5]), ValueError, r"Pin\.vertices must be integers"),
        (lambda: pd.Pin(solid, np.ones(5, bool)), ValueError, r"Pin\.vertices must be \[27\]"),
        (lambda: pd.Pin(solid, [1], -1.0), ValueError, r"Pin\.stiffness must be positive \[N/m\]"),
        (lambda: pd.Pin(solid, [1], [1.0, 2.0]), ValueError, r"Pin\.stiffness must be \[1\]"),
        (lambda: pd.Pin("solid", [1]), TypeError, r"Pin: solid must be a Solid"),
        (lambda: pd.Gravity((0.0, 1.0)), ValueError, r"Gravity\.vector must be \[3\]"),
        (lambda: pd.Gravity((0.0, math.inf, 0.0)), ValueError, r"Gravity\.vector must be finite"),
        (lambda: pd.Ground(math.nan), ValueError, r"Ground\.height must be finite"),
        (lambda: pd.Ground(normal=(0, 0, 0)), ValueError, r"Ground\.normal must not be the zero vector"),
        (lambda: pd.Ground(friction=-0.1), ValueError, r"Ground\.friction must be >= 0, got -0\.1"),
        (lambda: pd.Sphere((0, 0), 1.0), ValueError, r"Sphere\.center must be \[3\]"),
        (lambda: pd.Sphere((0, 0, 0), 0.0), ValueError, r"Sphere\.radius must be positive \[m\], got 0"),
        (lambda: pd.Sphere((0, 0, 0), 1.0, -1.0), ValueError, r"Sphere\.friction must be >= 0"),
        (lambda: pd.Damping(-1.0), ValueError, r"Damping\.rate must be >= 0, got -1"),
        (lambda: pd.Damping("fast"), TypeError, r"Damping\.rate must hold real numbers"),
    ):
        with pytest.raises(kind, match=message):
            make()  # type: ignore[no-untyped-call]


def test_scenes_are_checked() -> None:
    solid, other = body(), body()
    for parts, kind, message in (
        ((), ValueError, "Scene needs at least one body"),
        ((pd.Gravity(),), ValueError, "Scene needs at least one body"),
        (([solid, pd.Gravity()],), TypeError, r"got list; pass them one by one, Scene\(\*parts\)"),
        ((solid, "gravity"), TypeError, "Scene: parts are bodies and effects of torchpd, got str"),
        ((solid, solid), ValueError, "the same part is given twice"),
        ((solid, pd.Gravity(), pd.Gravity()), ValueError, "at most one Gravity, got 2"),
        ((solid, pd.Damping(1.0), pd.Damping(1.0)), ValueError, "at most one Damping, got 2"),
        ((solid, pd.Pin(other, [0])), ValueError, "holds a Solid that is not a part of this scene"),
        ((solid, pd.Pin(solid, [0, 1]), pd.Pin(solid, [1, 2])), ValueError, "two pins hold the same vertex"),
        ((solid, other, pd.Pin(other, [3]), pd.Pin(other, [3])), ValueError, "two pins hold the same vertex"),
    ):
        with pytest.raises(kind, match=message):
            pd.Scene(*parts)  # type: ignore[arg-type]
    both = pd.Scene(solid, other, pd.Pin(solid, [0, 1]), pd.Pin(other, [1, 2]))  # numbers are those of a body
    with pytest.raises(ValueError, match="not a part of the scene"):
        both.vertex_range(body())
    with pytest.raises(ValueError, match="not a part of the scene"):
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
