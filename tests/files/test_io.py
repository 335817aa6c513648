"""A simulation that was saved and loaded is the same simulation, and other files are refused in one sentence."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from sheets import sheet

import torchpd as pd
from torchpd.files.simulation_file import FORMAT_VERSION, load_simulation, save_simulation
from torchpd.scene.solvers import Solver


def everything() -> pd.Scene:
    """All kinds of parts; a mesh with a textured surface that two bodies share; a pin before its body."""
    rng = np.random.default_rng(0)
    coarse = pd.shapes.box((0.4, 0.2, 0.2), (4, 2, 2)).translated((0.0, 0.3, 0.0))
    corners = coarse.vertices[:3] + [0.01, 0.02, 0.03]
    surface = pd.TriMesh(corners, [[0, 1, 2]], uvs=rng.random((3, 2)))
    mesh = coarse.with_embedding(pd.embed(surface, coarse))
    soft = pd.Solid(
        mesh, youngs=10.0 ** rng.uniform(4, 5, len(mesh.tets)), density=rng.uniform(500, 900, len(mesh.tets))
    )
    return pd.Scene(
        pd.Pin(soft, [0, 5, 7]),
        pd.Gravity((0.1, -9.81, 0.0)),
        soft,
        pd.Solid(mesh, youngs=3e4, density=700.0),
        pd.Pin(soft, [1, 2], stiffness=[1e3, 2e3]),
        pd.Ground(height=0.31, normal=(0.1, 1.0, 0.3), friction=0.4),
        pd.Sphere((0.2, 0.2, 0.1), 0.15, friction=0.2),
        pd.Damping(0.3),
    )


def steps_of(sim: pd.Simulator, batch: int = 1) -> pd.Track:
    return sim.rollout(sim.rest_state(batch), 3, return_info=True)


def assert_same_bits(first: pd.Simulator, second: pd.Simulator, batch: int = 1) -> None:
    one, two = steps_of(first, batch), steps_of(second, batch)
    assert torch.equal(one.positions, two.positions)
    assert torch.equal(one.velocities, two.velocities)
    assert torch.equal(one.info.energy, two.info.energy)


SOLVERS = [
    pd.Chebyshev(),
    pd.Jacobi(relaxation=0.7, diagonal="plain"),
    pd.Chebyshev(schedule="classic", rho=0.9921, delay=7, relaxation=0.9),
    pd.Multilevel(),
    pd.Multilevel("momentum", relaxation=1.5),
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("solver", SOLVERS, ids=["guarded", "jacobi", "classic", "lbfgs", "momentum"])
def test_takes_the_same_steps(tmp_path: Path, solver: Solver, dtype: torch.dtype) -> None:
    sim = pd.Simulator(everything(), 1 / 70, 13, solver, dtype, tolerance=1e-7)
    sim.save(tmp_path / "sim.safetensors")
    loaded = pd.Simulator.load(tmp_path / "sim.safetensors")
    assert (loaded.time_step, loaded.iterations, loaded.tolerance, loaded.solver, loaded.dtype) == (
        sim.time_step,
        sim.iterations,
        sim.tolerance,
        sim.solver,
        dtype,
    )
    assert_same_bits(sim, loaded)


@pytest.mark.parametrize("number", [np.float32, np.float64, torch.tensor], ids=["float32", "float64", "tensor"])
def test_settings_of_a_solver_are_plain_numbers(tmp_path: Path, number: Callable[[float], Any]) -> None:
    for given, plain in (
        (pd.Chebyshev(rho=number(0.5), relaxation=number(1.25)), pd.Chebyshev(rho=0.5, relaxation=1.25)),
        (pd.Chebyshev("classic", 0.75, number(5)), pd.Chebyshev("classic", 0.75, 5)),
        (pd.Jacobi(number(0.5)), pd.Jacobi(0.5)),
        (pd.Multilevel("momentum", number(1.5)), pd.Multilevel("momentum", 1.5)),
    ):
        assert given == plain
        sim = pd.Simulator(everything(), solver=given)
        sim.save(tmp_path / "file")
        loaded = pd.Simulator.load(tmp_path / "file").solver
        assert loaded == plain
        assert {type(value) for value in vars(loaded).values()} == {type(value) for value in vars(given).values()}


def test_scene_comes_back(tmp_path: Path) -> None:
    sim = pd.Simulator(everything())
    sim.save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim").scene
    assert [type(part) for part in loaded.parts] == [type(part) for part in sim.scene.parts]
    assert loaded.parts[0].body is loaded.parts[2]
    for one, two in zip(sim.scene.parts, loaded.parts, strict=True):
        for field in dataclasses.fields(one):
            value = getattr(one, field.name)
            if not isinstance(value, pd.TetMesh | pd.Solid):
                np.testing.assert_array_equal(getattr(two, field.name), value)
    first, second = loaded.solids
    assert first.mesh is second.mesh


def test_bodies_of_every_kind_come_back(tmp_path: Path) -> None:
    """With the same stencils to the bit; parts may come before their bodies, and hold the loaded ones."""
    rng = np.random.default_rng(1)
    mesh = pd.shapes.box((0.4, 0.2, 0.2), (2, 1, 1))
    soft = pd.Solid(mesh, 1e5, poisson=0.3, averaging=rng.permutation(np.arange(12) // 4))
    pattern = sheet(cells=(2, 2))
    uvs = pattern[0][:, [0, 2]][pattern[1]] * 0.9
    shirt = pd.Cloth(
        pd.TriMesh(*pattern), rng.uniform(1e4, 1e5, 8), 1e-3, 0.2, rest_uv=uvs, warp=30.0, grain=(1.0, 2.0)
    )
    shell = pd.Cloth(pd.TriMesh(*pattern), 1e5, 1e-3, 0.2, bending=1e-4, rest_curvature="surface")
    rod = pd.Rod(rng.normal(size=(4, 3)), 1e6, 0.01, bending=0.0)
    written = pd.Scene(
        pd.Tie(rod, [0], soft, [[0.1, 0.1, 0.1]], stiffness=1e3), pd.Springs(rod, [[1, 0]], 50.0, other=shirt),
        pd.Pin(shell, [0, 1]), shirt, soft, rod, shell, pd.Fibres(soft, rng.normal(size=3), 1e4, tension_only=True),
        pd.Solid(mesh, 1e4),
    )  # fmt: skip
    pd.Simulator(everything()).save(tmp_path / "sim")
    save_simulation(dataclasses.replace(load_simulation(tmp_path / "sim"), scene=written), tmp_path / "sim")
    loaded = load_simulation(tmp_path / "sim").scene
    assert [type(part) for part in loaded.parts] == [type(part) for part in written.parts]
    assert (loaded.parts[0].body, loaded.parts[0].other, loaded.parts[7].solid) == (
        loaded.parts[5], loaded.parts[4], loaded.parts[4],
    )  # fmt: skip
    assert (loaded.parts[4].poisson == 0.3).all()
    assert (loaded.parts[8].poisson, loaded.parts[8].averaging) == (0.0, None)
    one, two = written.values(), loaded.values()
    np.testing.assert_array_equal(one.masses, two.masses)
    np.testing.assert_array_equal(one.tet_group, two.tet_group)
    for first, second in zip(one.stencils, two.stencils, strict=True):
        for name in ("corners", "gradients", "measure", "constants"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        for name, row in first.material.items():
            np.testing.assert_array_equal(row, second.material[name])


def test_contact_comes_back(tmp_path: Path) -> None:
    """With all its arrays to the bit; contact may come before what it names."""
    rigid = pd.shapes.box(cells=(1, 1, 1)).translated((2.0, 0.0, 0.0))
    solid, table = pd.Solid(pd.shapes.single_tet(), 1e5), pd.Collider(rigid, friction=0.2)
    sheet_of = pd.Cloth(pd.TriMesh(*sheet()).translated((0.0, 5.0, 0.0)), 1e5, 1e-3, 0.2)
    other, still = pd.Collider(table.mesh, pose=(-2.0, -2.0, -3.0, 0.3, -0.2, 0.7, 0.1)), {"self_contact": [solid]}
    for number, contact in enumerate(
        (
            pd.Contact(friction=0.3, thickness=1e-3, capacity=77, self_contact=False),
            pd.Contact(sheet_of, other, solid, table, friction={(table, solid): 0.7, (solid, solid): 0.1}, **still),
            pd.Contact(),
        )
    ):
        sim, path = pd.Simulator(pd.Scene(contact, table, solid, sheet_of, other)), tmp_path / f"{number}"
        sim.save(path)
        loaded = load_simulation(path).scene
        assert [type(part) for part in loaded.parts] == [type(part) for part in sim.scene.parts]
        one, two = sim.scene.values().contact, loaded.values().contact
        assert one is not None
        assert two is not None
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name), err_msg=field.name)


def test_regions_come_back(tmp_path: Path) -> None:
    box = pd.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    mesh = pd.TetMesh(box.vertices, box.tets, regions=[1, 1, 2, 2, 3, 3])
    pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e4))).save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim").scene.solids[0].mesh
    np.testing.assert_array_equal(loaded.regions, mesh.regions)


def test_mesh_and_surface_come_back(tmp_path: Path) -> None:
    vertices = pd.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    with pytest.warns(pd.MeshWarning):
        turned = pd.TetMesh(vertices.vertices, vertices.tets[:, [0, 1, 3, 2]])
    surface = pd.TriMesh(turned.vertices[:4] * 0.5, [[0, 1, 2], [1, 2, 3]], uvs=np.eye(4)[:, :2])
    mesh = turned.with_embedding(pd.embed(surface, turned))
    pd.Simulator(pd.Scene(pd.Solid(mesh, youngs=1e4))).save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim").scene.solids[0].mesh
    np.testing.assert_array_equal(loaded.vertices, mesh.vertices)
    np.testing.assert_array_equal(loaded.tets, mesh.tets)
    assert loaded.flipped == mesh.flipped == 6
    assert loaded.embedding is not None
    assert mesh.embedding is not None
    for name in ("tets", "weights", "corners"):
        np.testing.assert_array_equal(getattr(loaded.embedding, name), getattr(mesh.embedding, name))
    for name in ("vertices", "triangles", "uvs"):
        np.testing.assert_array_equal(getattr(loaded.embedding.surface, name), getattr(surface, name))


def test_material_of_every_environment_comes_back(tmp_path: Path) -> None:
    sim = pd.Simulator(everything(), iterations=8)
    generator = torch.Generator().manual_seed(0)
    each = 1.0 + torch.rand(3, 1, generator=generator)
    sim.set_material(stiffness=sim.stiffness * each, damping=torch.tensor([0.0, 0.5, 2.0]), gravity=(0.0, -3.0, 0.5))
    sim.stiffness.requires_grad_()
    sim.save(tmp_path / "sim")
    loaded = pd.Simulator.load(tmp_path / "sim")
    assert {name: value.requires_grad for name, value in loaded.named_parameters()} == {
        name: name == "stiffness" for name, _ in sim.named_parameters()
    }
    for name, value in sim.named_parameters():
        assert torch.equal(getattr(loaded, name), value), name
    with torch.no_grad():
        assert_same_bits(sim, loaded, batch=3)


def test_kernel_comes_back_and_older_files_have_none(file: Path) -> None:
    body = pd.Solid(pd.shapes.single_tet(), youngs=1e4)
    pd.Simulator(pd.Scene(body), kernel="cluster").save(file)
    assert pd.Simulator.load(file).kernel == "cluster"
    rewrite(file, lambda _, record: record.pop("kernel"))
    assert pd.Simulator.load(file).kernel == "auto"
    rewrite(file, lambda _, record: record.update(kernel="warp"))
    with pytest.raises(ValueError, match=r"damaged: .*kernel must be"):
        pd.Simulator.load(file)


def test_batch_comes_back_and_older_files_have_none(file: Path) -> None:
    """Files of before simulators had one said it with the choice of "auto"."""
    body = pd.Solid(pd.shapes.single_tet(), youngs=1e4)
    pd.Simulator(pd.Scene(body), solver="auto", batch=5).save(file)
    assert pd.Simulator.load(file).batch == 5
    for former, batch in ((1024, 1024), (1, None)):

        def age(_: object, record: dict[str, Any], former: int = former) -> None:
            record.pop("batch", None)
            record["choice"]["batch"] = former

        rewrite(file, age)
        loaded = pd.Simulator.load(file)
        assert loaded.batch == batch
        assert loaded.choice is not None


def test_older_files_have_no_preconditioner_of_gradients(file: Path) -> None:
    rewrite(file, lambda _, record: record.pop("adjoint"))
    assert pd.Simulator.load(file).adjoint == "solver"
    rewrite(file, lambda _, record: record.update(adjoint="cholesky"))
    with pytest.raises(ValueError, match=r"damaged: .*adjoint must be"):
        pd.Simulator.load(file)


def test_saving_what_was_loaded_gives_the_same_file(tmp_path: Path) -> None:
    pd.Simulator(everything(), iterations=3).save(tmp_path / "one")
    pd.Simulator.load(tmp_path / "one").save(tmp_path / "two")
    one, two = load_file(tmp_path / "one"), load_file(tmp_path / "two")
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A saved simulation of one tet held at one corner."""
    body = pd.Solid(pd.shapes.single_tet(), youngs=1e4)
    pd.Simulator(pd.Scene(body, pd.Pin(body, [0]), pd.Gravity())).save(tmp_path / "sim")
    return tmp_path / "sim"


def rewrite(file: Path, change: Callable[..., object]) -> None:
    """Save the file again after a change of its tensors and its record."""
    with safe_open(file, framework="pt") as opened:
        record = json.loads(opened.metadata()["torchpd"])
    tensors = load_file(file)
    change(tensors, record)
    save_file(tensors, file, metadata={"torchpd": json.dumps(record)})


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"file: .*nothing"):
        pd.Simulator.load(tmp_path / "nothing")
    with pytest.raises(IsADirectoryError, match=f"save: path must name a file, got the folder {tmp_path}"):
        pd.Simulator(everything()).save(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        pd.Simulator(everything()).save(tmp_path / "nowhere" / "sim")


def test_files_of_others_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("a sentence that is long enough to be read as a header")
    with pytest.raises(ValueError, match=r"text .*safetensors"):
        pd.Simulator.load(tmp_path / "text")
    save_file({"weight": torch.zeros(2)}, tmp_path / "network")
    with pytest.raises(ValueError, match=r"metadata .*'torchpd'$"):
        pd.Simulator.load(tmp_path / "network")
    save_file({"weight": torch.zeros(2)}, tmp_path / "broken", metadata={"torchpd": "{"})
    with pytest.raises(ValueError, match="damaged: its metadata 'torchpd' cannot be read"):
        pd.Simulator.load(tmp_path / "broken")


def test_newer_format_is_refused(file: Path) -> None:
    rewrite(file, lambda _, record: record.update(format=FORMAT_VERSION + 1, written_by="torchpd 99.0"))
    with pytest.raises(ValueError, match=rf"format {FORMAT_VERSION + 1}, written by torchpd 99\.0.*install a newer"):
        pd.Simulator.load(file)


@pytest.mark.parametrize("name", ["mesh.0.tets", "part.0.youngs", "part.1.vertices", "material.stiffness"])
def test_missing_tensor_is_named(file: Path, name: str) -> None:
    rewrite(file, lambda tensors, _: tensors.pop(name))
    with pytest.raises(ValueError, match=f"damaged: the tensor '{name}' is missing"):
        pd.Simulator.load(file)


def test_impossible_values_are_reported(file: Path) -> None:
    rewrite(file, lambda tensors, _: tensors.update({"mesh.0.tets": torch.tensor([[0, 1, 2, 9]])}))
    with pytest.raises(ValueError, match=r"damaged: .*TetMesh\.tets"):
        pd.Simulator.load(file)


def test_incomplete_record_is_reported(file: Path) -> None:
    rewrite(file, lambda _, record: record.pop("time_step"))
    with pytest.raises(ValueError, match="damaged: KeyError: 'time_step'"):
        pd.Simulator.load(file)


def test_saves_over_the_file_that_it_came_from(file: Path) -> None:
    sim = pd.Simulator.load(file)
    before = steps_of(sim)
    sim.set_material(stiffness=2e4)
    sim.save(file)
    after = steps_of(pd.Simulator.load(file))
    assert not torch.equal(before.positions, after.positions)
    assert torch.equal(after.positions, steps_of(sim).positions)
