"""Files for ParaView, read back by meshio and as XML."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
import torch
from cases import box
from runs import noise, small
from sheets import cloth

import torchpd as pd


def two_bodies() -> pd.Simulator:
    vertices, tets = box((0.1, 0.1, 0.1), (1, 1, 1))
    regions = np.arange(6) // 3
    bodies = pd.Solid(pd.TetMesh(vertices, tets, regions=regions), 1e4), pd.Solid(pd.TetMesh(vertices + 1.0, tets), 1e4)
    return pd.Simulator(pd.Scene(*bodies, pd.Gravity()), progress=False)


def test_a_state(tmp_path: Path) -> None:
    sim, state = small(torch.float64, batch=3)
    after = sim(state)
    contacts = sim.contact_forces(state, after)
    ground, *_ = contacts.colliders.values()
    path = tmp_path / "one.vtu"
    points = {"contact_force": contacts.force, "touches": ground.touches, "mass": sim.masses}
    written = sim.write_vtu(path, after, environment=1, point_data=points, cell_data={"youngs": sim.stiffness})
    assert written == path
    mesh, found = meshio.read(path), sim.stress(after)
    assert np.array_equal(mesh.points, after.positions[1].numpy())
    assert np.array_equal(mesh.cells_dict["tetra"], sim.scene.solids[0].mesh.tets)
    expected = {
        "displacement": after.positions[1] - sim.rest_positions,
        "velocity": after.velocities[1],
        "contact_force": contacts.force[1],
        "touches": ground.touches[1].to(torch.uint8),
        "mass": sim.masses,
    }
    assert mesh.point_data.keys() == expected.keys()
    assert all(np.array_equal(mesh.point_data[name], value.detach().numpy()) for name, value in expected.items())
    cells = {name: values[0] for name, values in mesh.cell_data.items()}
    assert cells.keys() == {"stress", "von_mises", "body", "youngs"}
    assert np.array_equal(cells["stress"], found.cauchy[1].flatten(1), equal_nan=True)
    assert np.array_equal(cells["von_mises"], found.von_mises[1], equal_nan=True)
    assert np.array_equal(cells["youngs"], sim.stiffness)


def test_stiffness_of_each_environment_is_that_of_the_file(tmp_path: Path) -> None:
    sim, state = small(torch.float64, batch=3)
    sim.set_material(stiffness=sim.stiffness * torch.tensor([1.0, 2.0, 3.0]).double()[:, None])
    sim.write_vtu(tmp_path / "one.vtu", state, environment=2)
    found = meshio.read(tmp_path / "one.vtu").cell_data["von_mises"][0]
    assert np.array_equal(found, sim.stress(state).von_mises[2], equal_nan=True)


@pytest.mark.parametrize("kind", ["track", "list"])
def test_a_motion(tmp_path: Path, kind: str) -> None:
    """A file for each record, and one that has their names and times; bodies and regions are in there."""
    sim = two_bodies()
    track = sim.rollout(sim.rest_state(), 4, every=2)
    states: Any = track if kind == "track" else [track.state(0), track.state(1)]
    field = noise(torch.zeros(2, 1, 12))
    path = tmp_path / "fall & rise.pvd"
    sim.write_vtu(path, states, times=[0.5, 0.25], cell_data={"own": field, "number": np.arange(12)})
    (collection,) = ElementTree.parse(path).getroot()
    rows = [row.attrib for row in collection]
    assert [float(row["timestep"]) for row in rows] == [0.5, 0.25]
    assert [row["file"] for row in rows] == ["fall & rise_0000.vtu", "fall & rise_0001.vtu"]
    for number, row in enumerate(rows):
        mesh = meshio.read(tmp_path / row["file"])
        cells = {name: values[0] for name, values in mesh.cell_data.items()}
        assert np.array_equal(mesh.points, track.positions[number, 0])
        assert np.array_equal(mesh.point_data["velocity"], track.velocities[number, 0])
        assert cells["body"].tolist() == [0] * 6 + [1] * 6
        assert cells["region"].tolist() == [0, 0, 0, 1, 1, 1] + [0] * 6
        assert np.array_equal(cells["own"], field[number, 0])
        assert np.array_equal(cells["number"], np.arange(12))
    sim.write_vtu(path, states)
    (collection,) = ElementTree.parse(path).getroot()
    assert [float(row.get("timestep", "")) for row in collection] == [sim.time_step, 2 * sim.time_step]


def test_names_of_fields_may_have_any_letters(tmp_path: Path) -> None:
    sim, name = two_bodies(), 'f < "g" & h'
    sim.write_vtu(tmp_path / "a.vtu", sim.rest_state(), point_data={name: np.zeros(16)})
    root = ElementTree.parse(tmp_path / "a.vtu").getroot()
    assert name in [array.get("Name") for array in root.iter("DataArray")]


REFUSED: dict[str, tuple[str, dict[str, Any], type[Exception], str]] = {
    "ending": ("a.pvd", {}, ValueError, r"path .*got a\.pvd"),
    "folder": ("none/a.vtu", {}, FileNotFoundError, "there is no folder"),
    "which": ("a.vtu", {"batch": 2}, ValueError, "environment=0"),
    "no such": ("a.vtu", {"environment": 1}, IndexError, "environment .*got 1"),
    "nobody": ("a.vtu", {"batch": 0}, ValueError, "at least one environment"),
    "shape": ("a.vtu", {"point_data": {"f": torch.zeros(3)}}, ValueError, r"point_data\['f'\] must be \[1, 16"),
    "name": ("a.vtu", {"point_data": {"velocity": torch.zeros(16)}}, ValueError, "'velocity', which every file has"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case: str, tmp_path: Path) -> None:
    name, options, kind, words = REFUSED[case]
    sim = two_bodies()
    state = sim.rest_state(options.pop("batch", 1))
    with pytest.raises(kind, match=words):
        sim.write_vtu(tmp_path / name, state, **options)
    assert list(tmp_path.iterdir()) == []


def test_what_is_refused_of_a_motion(tmp_path: Path) -> None:
    sim = two_bodies()
    track = sim.rollout(sim.rest_state(), 2)
    for states, options, words in (
        (track, {"times": [1.0]}, r"times .*got \[1\]"),
        ([], {}, "at least one record"),
        ([sim.rest_state(1), sim.rest_state(2)], {}, r"states .*got \[1, 2\]"),
    ):
        with pytest.raises(ValueError, match=words):
            sim.write_vtu(tmp_path / "a.pvd", states, **options)
    with pytest.raises(ValueError, match=r"path .*got a\.vtu"):
        sim.write_vtu(tmp_path / "a.vtu", track)
    with pytest.raises(TypeError, match=r"states .*got Tensor"):
        sim.write_vtu(tmp_path / "a.vtu", track.positions)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"state .*got Tensor"):
        sim.write_vtu(tmp_path / "a.pvd", [track.state(), track.positions[1]])  # type: ignore[list-item]
    assert list(tmp_path.iterdir()) == []


def test_cells_of_all_bodies(tmp_path: Path) -> None:
    """Tetrahedra, triangles and lines have their own fields, NaN in the others, and meshio reads them back."""
    vertices, tets = box((0.2, 0.1, 0.1), (2, 1, 1))
    solid = pd.Solid(pd.TetMesh(vertices, tets), 1e4)
    sheet = cloth()
    rod = pd.Rod(np.linspace((0.0, 1, 0), (1, 1, 0), 4), 1e6, 0.01)
    tie = pd.Tie(sheet, [0], solid, [[0.05, 0.05, 0.05]], stiffness=30.0)
    springs = pd.Springs(rod, [[0, 2], [3, 1]], 10.0, other=sheet)
    fibres = [pd.Fibres(solid, (1, 0, 0), 1e3, activation=0.5, tets=chosen) for chosen in ([1, 2], [2, 5])]
    sim = pd.Simulator(pd.Scene(springs, sheet, rod, tie, *fibres, solid), dtype=torch.float64, progress=False)
    sim.set_material(membrane_youngs=torch.tensor([[1e5], [2e5]]), spring_stiffness=torch.tensor([[5.0], [7.0]]))
    state = sim.rest_state()
    state.positions.add_(0.02 * noise(state.positions))
    own = np.arange(len(tets) + len(sheet.elements) + 5)
    sim.write_vtu(tmp_path / "all.vtu", state, environment=1, cell_data={"own": own})
    mesh = meshio.read(tmp_path / "all.vtu")
    assert [block.type for block in mesh.cells] == ["tetra", "triangle", "line"]
    starts = {body: sim.scene.vertex_range(body).start for body in sim.scene.bodies}
    pairs = springs.pairs + np.array([starts[rod], starts[sheet]])
    corners = [
        tets + starts[solid],
        sheet.elements + starts[sheet],
        np.concatenate([pairs, rod.elements + starts[rod]]),
    ]
    assert all(np.array_equal(block.data, wanted) for block, wanted in zip(mesh.cells, corners, strict=True))
    assert mesh.cell_data.keys() == {
        "stress", "von_mises", "fibre_tension", "membrane_stress", "tension", "strain", "body", "own",
    }  # fmt: skip
    of_kind = {"stress": 0, "von_mises": 0, "fibre_tension": 0, "membrane_stress": 1, "tension": 2, "strain": 2}
    for name, kind in of_kind.items():
        assert [bool(np.isnan(values).any()) for values in mesh.cell_data[name]] == [k != kind for k in range(3)]
    assert [np.unique(values).tolist() for values in mesh.cell_data["body"]] == [[2], [0], [-1, 1]]
    assert np.array_equal(np.concatenate(mesh.cell_data["own"]), own)
    tensions = sim.tensions(state)
    lines = torch.cat([tensions[springs].tension[1], tensions[rod].tension[1]])
    assert np.array_equal(mesh.cell_data["tension"][2], lines)
    assert np.array_equal(mesh.cell_data["membrane_stress"][1], sim.membrane_stress(state)[sheet].principal[1])
    muscle = np.zeros(len(tets))
    for part in fibres:
        muscle[part.tets] += tensions[part].tension[1].numpy()
    assert np.array_equal(mesh.cell_data["fibre_tension"][0], muscle)
    force = mesh.point_data["tie_force"]
    pulled = sim.reactions(state, state).ties[tie].force[1, 0].numpy()
    assert np.array_equal(force[starts[sheet]], pulled)
    assert np.allclose(force[starts[solid] :].sum(axis=0), -pulled, rtol=1e-12)
    with pytest.raises(ValueError, match=f"must be .*{len(own)}"):
        sim.write_vtu(tmp_path / "all.vtu", state, environment=1, cell_data={"own": own[:-1]})


def test_cells_of_a_sheet_alone(tmp_path: Path) -> None:
    sim = pd.Simulator(pd.Scene(cloth()), progress=False)
    sim.write_vtu(tmp_path / "one.vtu", sim.rest_state())
    mesh = meshio.read(tmp_path / "one.vtu")
    assert mesh.cell_data.keys() == {"membrane_stress", "body"}
