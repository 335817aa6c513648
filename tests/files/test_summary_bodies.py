"""`print(sim)` lists every kind of body with its elements, and "auto" takes Chebyshev for thin ones."""

from __future__ import annotations

import numpy as np
from sheets import cloth

import torchpd as pd


def rod() -> pd.Rod:
    return pd.Rod(np.linspace((0.0, 2, 0), (1, 2, 0), 6), 1e6, 1e-2)


def test_every_kind_is_listed_with_its_elements() -> None:
    sheet, line, solid = cloth(warp=20.0, grain=(1, 0, 0)), rod(), pd.Solid(pd.shapes.box((1, 1, 1), (1, 1, 1)), 1e5)
    parts = {
        "cloth: 1 (32 triangles, 40 hinges, 32 threads)": (sheet,),
        "rods: 1 (5 segments, 4 bends)": (line,),
        "solids: 1 (6 tetrahedra)": (solid,),
        "springs: 2": (pd.Springs(solid, [[0, 1], [1, 2]], 5.0),),
        "ties: 1": (pd.Tie(line, [0], sheet, [[0.0, 0, 0]], stiffness=1.0),),
        "fibres: 8": (pd.Fibres(solid, (0, 1, 0), 1e3), pd.Fibres(solid, (0, 1, 0), 1e3, tets=[0, 1])),
    }
    text = str(pd.Simulator(pd.Scene(*(part for some in parts.values() for part in some))))
    for words in parts:
        assert f"{words}, " in text, words
    text = str(pd.Simulator(pd.Scene(cloth(bending=0.0))))
    assert "cloth: 1 (32 triangles), a local step" in text
    for word in ("solids:", "rods:", "springs:", "ties:", "fibres:", "Poisson", "hinges", "threads"):
        assert word not in text, word


def test_groups_that_share_a_volume_strain_are_listed() -> None:
    mesh = pd.shapes.box((1, 1, 1), (1, 1, 1))
    solid = pd.Solid(mesh, 1e5, poisson=0.4, averaging=np.array([0, 0, 0, 1, 1, 2]))
    assert "Poisson's ratio: 3 groups of up to 3 tetrahedra" in str(pd.Simulator(pd.Scene(solid)))


def test_auto_takes_chebyshev_for_thin_bodies() -> None:
    for body in (cloth(youngs=1e7), rod()):
        sim = pd.Simulator(pd.Scene(body, pd.Gravity()), solver="auto")
        assert isinstance(sim.solver, pd.Chebyshev)
        assert sim.choice is not None
        assert "other elements than plain tetrahedra may stall Multilevel" in sim.choice.why


def test_contact_is_listed_with_its_bodies() -> None:
    solid = pd.Solid(pd.shapes.box((1, 1, 1), (1, 1, 1)).translated((0, 2, 0)), 1e5)
    table = pd.Collider(pd.shapes.box((1, 1, 1), (1, 1, 1)).translated((0, -3, 0)))
    text = str(pd.Simulator(pd.Scene(solid, cloth(), table, pd.Contact(solid, table))))
    assert "contact: 1 bodies, 1 colliders (24 triangles, 36 edges)" in text
    assert "contact" not in str(pd.Simulator(pd.Scene(solid, cloth())))
