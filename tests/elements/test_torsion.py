"""How much too stiff linear tets are in torsion, for docs/limits.md: as Saint-Venant has it, ends free to warp."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_cases import block
from scipy.sparse.linalg import spsolve
from small_strains import elastic_matrix

import torchpd as pd

LENGTH, SIDE, YOUNGS = 1.0, 0.2, 1e6
TORSION_CONSTANT = 0.140577 * SIDE**4  # of a square (Timoshenko and Goodier, Theory of Elasticity, section 109)


def relative_stiffness(mesh: pd.TetMesh) -> float:
    """Torque of a bar along x whose ends turn against each other, relative to G J theta / L with G = E / 2."""
    matrix = elastic_matrix(pd.Solid(mesh, youngs=YOUNGS))
    # a lattice reaches beyond the ends
    first, last = mesh.vertices[:, 0] < 1e-9 - LENGTH / 2, mesh.vertices[:, 0] > LENGTH / 2 - 1e-9
    held = np.zeros((len(first), 3), dtype=bool)
    held[first | last, 1:] = True
    held[0, 0] = True
    turned = np.zeros(held.shape)
    turned[last, 1], turned[last, 2] = -mesh.vertices[last, 2], mesh.vertices[last, 1]
    free, field = ~held.reshape(-1), turned.reshape(-1)
    field[free] = spsolve(matrix[free][:, free].tocsc(), -(matrix @ field)[free])
    torque = field @ matrix @ field  # by an angle of 1
    return float(torque / (0.5 * YOUNGS * TORSION_CONSTANT / LENGTH))


@pytest.mark.parametrize(("cells", "times"), [(1, 5.44), (2, 2.29), (4, 1.36), (8, 1.09)])
def test_a_box_is_as_much_too_stiff_as_the_limits_say(cells: int, times: float) -> None:
    box = pd.shapes.box((LENGTH, SIDE, SIDE), (5 * cells, cells, cells)).translated((-LENGTH / 2, -SIDE / 2, -SIDE / 2))
    assert relative_stiffness(box) == pytest.approx(times, abs=0.005)


@pytest.mark.parametrize(("cells", "times"), [(1, 2.37), (2, 1.41), (4, 1.12)])
def test_a_lattice_is_as_much_too_stiff_as_the_limits_say(cells: int, times: float) -> None:
    lattice = pd.tetrahedralize(block(LENGTH, SIDE, SIDE), cells=5 * cells)
    assert relative_stiffness(lattice) == pytest.approx(times, abs=0.005)
