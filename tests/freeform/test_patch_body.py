"""Bodies of free-form patches: exact energies, rigid motions alone cost nothing, the surface follows the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from patch_cases import F64, ball, patches_on, sheet, torus, triangle

import torchpd as pd
from torchpd.freeform.constraints import skeleton, volumes
from torchpd.geometry.visibility import depths, is_blocked
from torchpd.reference import elements, gradient_operator

Array = NDArray[np.float64]
SOLVERS = [pd.Chebyshev(), pd.Chebyshev(schedule="classic", rho=0.9), pd.Jacobi(), pd.Multilevel()]


def body_of(mesh: pd.TriMesh, apex: str, **options: object) -> pd.PatchBody:
    return pd.PatchBody(patches_on(mesh), 1e4, 1000.0, apex=apex, **options)


def flat_sheet(cells: int = 4) -> pd.TriMesh:
    return pd.TriMesh(sheet(cells).vertices * [1.0, 1.0, 0.0], sheet(cells).triangles)


def at_rest(body: pd.PatchBody) -> torch.Tensor:
    return torch.tensor(body.mesh.vertices)[None]


def elastic_energy(body: pd.PatchBody, positions: Array) -> float:
    sim = pd.Simulator(pd.Scene(body), dtype=F64)
    state = pd.State(torch.tensor(positions)[None], torch.zeros(1, *positions.shape, dtype=F64))
    return float(sim.energy(state.positions))


def stiffnesses(body: pd.PatchBody) -> Array:
    """Eigenvalues of the linearised energy, sum v |sym grad u|^2, over the largest, ascending."""
    vertices, tets = body.mesh.vertices, body.mesh.tets
    shape = elements(vertices, tets)
    G = gradient_operator(shape.shape_gradients, tets, len(vertices)).toarray().reshape(len(tets), 3, -1)  # [E, j, V]
    gradient = np.einsum("ejv,ik->eijvk", G, np.eye(3)).reshape(len(tets), 3, 3, -1)  # d u_i / d x_j
    strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2)) * np.sqrt(shape.volumes)[:, None, None, None]
    rows = strain.reshape(-1, strain.shape[-1])
    values = np.linalg.eigvalsh(rows.T @ rows)
    return np.asarray(values / values[-1])


# ---- energies worked by hand


def corner_tet() -> pd.PatchBody:
    """The corner of the unit cube, as one of the constraints of a prism of thickness one under the unit triangle."""
    surface = triangle()
    return pd.PatchBody(pd.FreeFormPatches.from_mesh(surface, dtype=F64), 1.0, apex="prism", thickness=1.0)


@pytest.mark.parametrize(
    ("stretch", "energy"),
    [((2.0, 1.0, 1.0), 1.0), ((-1.0, 1.0, 1.0), 4.0), ((0.0, 1.0, 1.0), 1.0), ((1.0, 1.0, 1.0), 0.0)],
)
def test_energy_is_st_v_of_the_distance_from_a_rotation(stretch: tuple[float, ...], energy: float) -> None:
    # a corner tet of v = 1/6 has energies 1/6 and 2/3 under diag(2, 1, 1) and diag(-1, 1, 1): 1 and 4 per st v. The
    # prism has v = 1/2 in all. An unsigned polar factor would take the reflection for a rotation, of energy 0
    body = corner_tet()
    assert body.mesh.quality().volumes == pytest.approx([1 / 6] * 3, abs=1e-15)
    assert elastic_energy(body, body.mesh.vertices * stretch) == pytest.approx(0.5 * energy, abs=1e-14)


@pytest.mark.parametrize(("stretch", "energy"), [(1.0, 0.0), (2.0, 1 / 6), (-1.0, 2 / 3)])
def test_energy_of_one_constraint(stretch: float, energy: float) -> None:
    # the patch stays and the corner of the second layer under vertex 2 moves along their edge: G = diag(1, 1, stretch)
    body = corner_tet()
    own = [row for row in body.mesh.tets.tolist() if len({0, 1, 2} & set(row)) == 3]
    assert own == [[1, 0, 2, 5]]
    solid = pd.Solid(pd.TetMesh(body.mesh.vertices[[0, 1, 2, 5]], [[1, 0, 2, 3]]), youngs=body.youngs[:1])
    moved = solid.mesh.vertices.copy()
    moved[3] = moved[2] + stretch * (moved[3] - moved[2])
    sim = pd.Simulator(pd.Scene(solid), dtype=F64)
    assert float(sim.energy(torch.tensor(moved)[None])) == pytest.approx(energy, abs=1e-15)


def test_stiffness_and_mass_are_of_patches_and_body() -> None:
    st = np.linspace(1.0, 2.0, 80)
    body = pd.PatchBody(patches_on(ball()), st, 700.0)
    assert np.array_equal(body.youngs, 2.0 * st)
    assert float((body.density * body.mesh.quality().volumes).sum()) == pytest.approx(
        700.0 * ball().volume(), rel=1e-12
    )
    many = pd.PatchBody(patches_on(ball(2)), np.linspace(1.0, 2.0, 320), 700.0)  # several apexes: there is a filling
    assert np.array_equal(many.youngs[:320], 2.0 * np.linspace(1.0, 2.0, 320))
    assert (many.patch_of[320:] == -1).all()
    assert many.youngs[320:] == pytest.approx(3.0)
    assert float((many.density * many.mesh.quality().volumes).sum()) == pytest.approx(700 * ball(2).volume(), rel=1e-12)


# ---- what the constraints resist


@pytest.mark.parametrize(
    ("mesh", "apex", "apexes"),
    [
        (ball(0), "skeleton", 1),
        (ball(1), "skeleton", 1),
        (ball(2), "skeleton", 5),
        (torus(), "skeleton", 4),
        (flat_sheet(), "prism", 25),
        (sheet(), "prism", 16),
        (ball(1), "prism", 42),
    ],
    ids=["icosahedron", "icosphere-80", "icosphere-320", "torus", "flat sheet", "wavy sheet", "shell"],
)
def test_rigid_motions_alone_cost_nothing(mesh: pd.TriMesh, apex: str, apexes: int) -> None:
    body = body_of(mesh, apex)
    assert body.apexes == apexes
    values = stiffnesses(body)
    assert values[5] < 1e-12  # n u of the eigenvalue solver, n up to 500
    assert values[6] > 1e-4


def test_apexes_of_their_own_would_not_resist_bending() -> None:
    # the control: with a private apex for each patch a flat sheet has 6 + (V - 3) zero modes
    surface = flat_sheet()
    own = surface.vertices[surface.triangles].mean(axis=1) - [0.0, 0.0, 0.3]
    tets = np.column_stack([surface.triangles[:, [0, 2, 1]], 25 + np.arange(32)])
    body = pd.Solid(pd.TetMesh(np.concatenate([surface.vertices, own]), tets), 1e4)
    values = stiffnesses(body)  # type: ignore[arg-type]
    assert int((values < 1e-12).sum()) == 6 + (25 - 3)


def test_constraints_of_a_skeleton_fill_the_body() -> None:
    for mesh in (ball(2), torus()):
        made = skeleton(mesh.vertices, mesh.triangles)
        size = volumes(made.points, made.tets)
        assert made.share == pytest.approx(1.0, abs=1e-3)
        assert size.min() >= 1e-3 * size[: len(mesh.triangles)].mean()
        assert np.bincount(made.tets[: len(mesh.triangles), 3]).max() <= 80


def test_apexes_lie_inside_where_the_body_is_not_convex() -> None:
    body = body_of(torus(), "skeleton")
    apexes = body.mesh.vertices[48:]
    assert (np.abs(np.hypot(np.hypot(apexes[:, 0], apexes[:, 1]) - 1.0, apexes[:, 2])) < 0.4).all()


def sag(body: pd.Solid) -> float:
    """How far a sheet of 2 m that is held along one end hangs down at a tenth of the weight [m]."""
    held = pd.Pin(body, body.mesh.vertices[:, 0] < -0.99)
    scene = pd.Scene(body, held, pd.Gravity((0.0, 0.0, -0.981)), pd.Damping(5.0))
    sim = pd.Simulator(scene, 0.2, 200, pd.Multilevel(), dtype=F64, progress=False)
    track = sim.rollout(sim.rest_state(), 40)
    return -float(track.positions[-1, 0, :81, 2].min())


def test_a_sheet_resists_bending() -> None:
    # a plate sags by 3 rho g L^4 / (2 E t^2). One linear element across the thickness is too stiff, never too soft
    surface, youngs = flat_sheet(8), 1e7
    patches = pd.FreeFormPatches.from_mesh(surface, dtype=F64)
    sags = {t: sag(pd.PatchBody(patches, 0.5 * youngs, 1000.0, apex="prism", thickness=t)) for t in (0.4, 0.2)}
    for thickness, found in sags.items():
        plate = 1.5 * 981.0 * 2.0**4 / (youngs * thickness**2)
        assert plate / 6.0 < found < plate
    assert sags[0.2] > 2.0 * sags[0.4]
    # the control: with apexes of their own patches are a membrane, which hangs down
    own = surface.vertices[surface.triangles].mean(axis=1) - [0.0, 0.0, 0.2]
    tets = np.column_stack([surface.triangles[:, [0, 2, 1]], 81 + np.arange(128)])
    assert sag(pd.Solid(pd.TetMesh(np.concatenate([surface.vertices, own]), tets), youngs)) > 0.5


def compliance(body: pd.PatchBody, along: int) -> float:
    """How far the end of a sheet along x gives way per newton along an axis, for small motions [m/N].

    The energy st v |G - R|^2 is then st v |sym grad u|^2.
    """
    points, tets = body.mesh.vertices, body.mesh.tets
    edges = np.stack([points[tets[:, k]] - points[tets[:, 0]] for k in (1, 2, 3)], axis=2)
    inner = np.linalg.inv(edges)
    slopes = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)  # of the four barycentric coordinates
    # |sym G|^2 = (G : G + G : G^T) / 2, G = sum_k u_k (x) slopes_k
    blocks = np.einsum("eix,ejx,ab->eiajb", slopes, slopes, np.eye(3)) + np.einsum("eib,eja->eiajb", slopes, slopes)
    blocks *= volumes(points, tets)[:, None, None, None, None]
    rows = (3 * tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    stiffness = np.zeros((points.size, points.size))
    np.add.at(stiffness, (rows[:, :, None], rows[:, None, :]), blocks.reshape(-1, 12, 12))
    free = np.flatnonzero(np.repeat(points[:, 0] > 1e-9, 3))
    end = np.flatnonzero(points[:, 0] > points[:, 0].max() - 1e-9)
    force = np.zeros(points.size)
    force[3 * end + along] = 1.0 / len(end)
    moved = np.zeros(points.size)
    moved[free] = np.linalg.solve(stiffness[np.ix_(free, free)], force[free])
    return float(moved[3 * end + along].mean())


@pytest.mark.parametrize("slenderness", [1.0, 2.0, 4.0, 8.0])
def test_how_much_a_cantilever_of_prisms_bends(slenderness: float) -> None:
    """As PatchBody says beside the closed forms L^3 / (3 E I) and L / (E A), of E = 2 st: to 2 %, the digits given."""
    cell, length, width = 1.0 / 16.0, 1.0, 0.25
    x, y = (a.ravel() for a in np.meshgrid(np.arange(17) * cell, np.arange(5) * cell, indexing="ij"))
    corner = np.arange(85).reshape(17, 5)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    patches = pd.FreeFormPatches.from_mesh(pd.TriMesh(np.stack([x, y, 0 * x], axis=1), triangles), dtype=F64)
    thickness = cell / slenderness
    body = pd.PatchBody(patches, 1.0, 1000.0, apex="prism", thickness=thickness)
    bending = length**3 / (3.0 * 2.0 * width * thickness**3 / 12.0)
    assert bending / compliance(body, 2) == pytest.approx(3.1 + 1.24 * slenderness**2, rel=0.02)
    assert length / (2.0 * width * thickness) / compliance(body, 0) == pytest.approx(1.0, abs=0.02)


def test_an_inverted_body_turns_back() -> None:
    body = body_of(ball(), "skeleton")
    sim = pd.Simulator(pd.Scene(body, pd.Damping(5.0)), 1 / 30, 128, dtype=F64)
    state = sim.rest_state()
    inverted = state.positions.clone()
    inverted[:, -1] = 3.0 * inverted[:, 0] - 2.0 * inverted[:, -1]  # the apex passes through the patches at vertex 0
    before = volumes(inverted[0].numpy(), body.mesh.tets)
    assert (before < 0.0).sum() >= 3
    after = sim.rollout(pd.State(inverted, state.velocities), 60).positions[-1, 0]
    assert volumes(after.numpy(), body.mesh.tets) == pytest.approx(body.mesh.quality().volumes, rel=1e-2)


# ---- in scenes


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: f"{type(s).__name__}-{getattr(s, 'schedule', '')}")
@pytest.mark.parametrize("apex", ["skeleton", "prism"])
def test_every_solver_takes_it(solver: object, apex: str) -> None:
    body = body_of(ball(), apex)
    low = float(body.mesh.bounds[0, 1])
    scene = pd.Scene(body, pd.Gravity(), pd.Ground(low - 0.01, friction=0.5))
    sim = pd.Simulator(scene, 1 / 60, 32, solver, dtype=F64, progress=False)  # type: ignore[arg-type]
    track = sim.rollout(sim.rest_state(3), 12, return_info=True)
    assert bool(track.positions.isfinite().all())
    assert torch.equal(track.positions[:, 0], track.positions[:, 2])
    assert float(track.positions[..., 1].min()) >= low - 0.01 - 1e-9
    assert float(track.info.residual.max()) < 0.3


def test_pins_address_the_vertices_of_the_patches() -> None:
    patches = patches_on(ball())
    body = pd.PatchBody(patches, 1e4)
    other = pd.Solid(pd.shapes.single_tet(), youngs=1e4)
    pin = pd.Pin(body, [0, 7])
    scene = pd.Scene(other, body, pin, pd.Gravity())
    sim = pd.Simulator(scene, dtype=F64)
    goal = patches.vertices[[0, 7]] + torch.tensor([0.0, 0.1, 0.0])
    state = sim(sim.rest_state(), targets={pin: goal})
    pose = body.pose(state.positions[:, scene.vertex_range(body)])
    assert torch.allclose(pose.positions[0, [0, 7]], goal, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"positions .*got \[1, 47, 3\]; take positions"):
        body.pose(state.positions)


def test_it_is_saved_as_the_solid_that_it_is(tmp_path: Path) -> None:
    body = body_of(ball(), "skeleton")
    sim = pd.Simulator(pd.Scene(body, pd.Pin(body, [0]), pd.Gravity()), dtype=F64)
    sim.save(tmp_path / "sim.safetensors")
    again = pd.Simulator.load(tmp_path / "sim.safetensors")
    assert type(again.scene.solids[0]) is pd.Solid
    assert torch.equal(again(again.rest_state()).positions, sim(sim.rest_state()).positions)


# ---- the surface


@pytest.mark.parametrize(
    ("mesh", "apex"), [(ball(), "skeleton"), (torus(), "skeleton"), (sheet(), "prism"), (ball(), "prism")]
)
def test_affine_motion_carries_the_surface_along(mesh: pd.TriMesh, apex: str) -> None:
    body = body_of(mesh, apex)
    samples = body.patches.tessellate(3).samples
    G = torch.tensor([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.4, 1.1]], dtype=F64)
    moved = body.patches.surface(samples, body.pose(at_rest(body) @ G.T + 0.5)).points[0]
    expected = body.patches.surface(samples).points @ G.T + 0.5
    assert float((moved - expected).abs().max()) < 1e-14  # a few roundings of numbers up to 4


def test_a_simulated_fall_carries_the_surface_along() -> None:
    body = body_of(ball(), "skeleton")
    sim = pd.Simulator(pd.Scene(body, pd.Gravity((0.0, -9.81, 0.0))), 1 / 60, 200, pd.Multilevel(), dtype=F64)
    track = sim.rollout(sim.rest_state(), 10)
    fallen = -9.81 / 3600 * 55  # g h^2 (1 + ... + 10), implicit Euler
    samples = body.patches.tessellate(2).samples
    moved = body.patches.surface(samples, body.pose(track.positions[-1])).points[0]
    expected = body.patches.surface(samples).points + torch.tensor([0.0, fallen, 0.0])
    assert float((moved - expected).abs().max()) < 1e-9


def test_mesh_in_a_pose_stays_closed() -> None:
    body = body_of(torus(), "skeleton")
    x = at_rest(body)
    twisted = x + 0.3 * torch.sin(3.0 * x[..., [1, 2, 0]])
    mesh = body.patches.mesh(3, body.pose(twisted)).to_trimesh()
    assert mesh.is_watertight
    assert mesh.euler_number == 0


@pytest.mark.parametrize(("mesh", "apex"), [(ball(0), "skeleton"), (sheet(2), "prism")])
def test_gradients_through_the_pose(mesh: pd.TriMesh, apex: str) -> None:
    body = body_of(mesh, apex)
    samples = body.patches.tessellate(2).samples
    rng = np.random.default_rng(0)
    x = at_rest(body).repeat(2, 1, 1) + torch.tensor(0.05 * rng.standard_normal((2, len(body.mesh.vertices), 3)))

    def points(positions: torch.Tensor) -> torch.Tensor:
        return body.patches.surface(samples, body.pose(positions)).points

    assert torch.autograd.gradcheck(points, (x.requires_grad_(),), eps=1e-6, atol=1e-7)


def test_gradients_through_step_and_surface() -> None:
    # of the height of the surface after a step, with respect to the stiffness: against central differences
    body = body_of(ball(0), "skeleton")
    scene = pd.Scene(body, pd.Gravity(), pd.Pin(body, [0]))
    sim = pd.Simulator(scene, 1 / 30, 400, pd.Multilevel(), dtype=F64)
    samples = body.patches.tessellate(2).samples
    start = sim.rest_state()
    start = pd.State(start.positions * 1.1, start.velocities)

    def height(scale: float) -> torch.Tensor:
        sim.set_material(stiffness=torch.full_like(sim.stiffness, 2e4 * scale))
        sim.stiffness.requires_grad_()
        sim.stiffness.grad = None
        return body.patches.surface(samples, body.pose(sim(start).positions)).points[..., 1].mean()

    height(1.0).backward()
    gradient = float(sim.stiffness.grad.sum())
    with torch.no_grad():
        slope = float(height(1 + 1e-4) - height(1 - 1e-4)) / (2 * 2e4 * 1e-4)
    assert gradient == pytest.approx(slope, rel=1e-4)


def test_gradient_of_the_layer_is_the_adjoint() -> None:
    body = body_of(sheet(), "prism")
    x = torch.randn(2, body.apexes, 3, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(body._layer, (x,))
    assert torch.autograd.gradgradcheck(body._layer, (x,))
    expected = x[:, body.patches.triangles.long()].mean(2)
    assert torch.equal(body._layer(x), expected)


# ---- errors


def test_errors_name_contract_and_fix() -> None:
    with pytest.raises(ValueError, match=r"closed .*got 12 .*apex='prism'"):
        pd.PatchBody(patches_on(sheet()), 1e4)
    inside_out = pd.TriMesh(ball().vertices, ball().triangles[:, ::-1])
    with pytest.raises(ValueError, match=r"got .*-3\.\d+ m\^3"):
        pd.PatchBody(pd.FreeFormPatches.from_mesh(inside_out), 1e4)
    with pytest.raises(TypeError, match=r"patches .*got TriMesh"):
        pd.PatchBody(ball(), 1e4)
    patches = patches_on(ball())
    with pytest.raises(ValueError, match=r"PatchBody\.stiffness .*got \[3\]"):
        pd.PatchBody(patches, np.ones(3))
    with pytest.raises(ValueError, match=r"PatchBody\.stiffness .*got -1"):
        pd.PatchBody(patches, -1.0)
    with pytest.raises(ValueError, match=r"PatchBody\.density .*got 0\.0"):
        pd.PatchBody(patches, 1.0, 0.0)
    with pytest.raises(ValueError, match="thickness is for apex='prism'"):
        pd.PatchBody(patches, 1.0, thickness=0.1)
    with pytest.raises(ValueError, match=r"apex .*got 'ghost'"):
        pd.PatchBody(patches, 1.0, apex="ghost")
    with pytest.raises(ValueError, match=r"PatchBody\.thickness .*got 0\.0"):
        pd.PatchBody(patches, 1.0, apex="prism", thickness=0.0)
    body = pd.PatchBody(patches, 1.0)
    with pytest.raises(TypeError, match=r"positions .*got torch\.float32"):
        body.pose(at_rest(body).float())


def test_flat_constraints_are_refused_by_name() -> None:
    # a layer thicker than the radius of the ball is inside out
    with pytest.raises(ValueError, match=r"0\.001 .*got .*patch \d+ .*thickness"):
        pd.PatchBody(patches_on(ball()), 1e4, apex="prism", thickness=1.5)
    # two patches without thickness between them
    double = pd.TriMesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1e-9]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    )
    directors = torch.tensor([[0.0, 0.0, 1.0]]).repeat(4, 1)
    flat = pd.FreeFormPatches(
        torch.tensor(double.vertices).float(), torch.tensor(double.triangles), directors=directors
    )
    with pytest.raises(ValueError, match=r"constraints .*got .* under patch 0 .*take apex='prism'"):
        pd.PatchBody(flat, 1e4)


# ---- who sees whom


def test_depth_of_a_cube_and_what_blocks_the_view() -> None:
    cube = pd.TriMesh.from_trimesh(trimesh.creation.box((1.0, 2.0, 3.0)))
    corners = cube.vertices[cube.triangles]
    starts = np.array([[-0.5, 0.3, 0.2], [0.1, -1.0, 0.2]])
    assert depths(starts, np.array([[1.0, 0, 0], [0, 1.0, 0]]), corners) == pytest.approx([1.0, 2.0], abs=1e-14)
    ends = starts + np.array([[0.9, 0.1, 0.0], [0.0, 2.5, 0.0]])
    assert is_blocked(starts, ends, corners).tolist() == [False, True]


def test_depths_do_not_depend_on_the_place_of_the_body() -> None:
    mesh = ball(2)
    corners = mesh.vertices[mesh.triangles]
    middles = corners.mean(axis=1)
    here = depths(middles, -middles / np.linalg.norm(middles, axis=1, keepdims=True), corners)
    assert here == pytest.approx(np.full(320, 2.0), abs=0.05)
    away = depths(middles + 1e7, -middles / np.linalg.norm(middles, axis=1, keepdims=True), corners + 1e7)
    assert away == pytest.approx(here, abs=1e-6)  # rounding of 1e7, times the slope of a facet


@pytest.mark.parametrize(
    ("radius", "sections", "own"), [(0.1, (24, 4), False), (0.03, (16, 3), True)], ids=["more apexes", "their own"]
)
def test_patches_that_see_no_shared_apex_get_another(radius: float, sections: tuple[int, int], own: bool) -> None:
    # inside a thin ring one sees no further than arccos((1 - r) / (1 + r)) in either direction
    mesh = trimesh.creation.torus(1.0, radius, major_sections=sections[0], minor_sections=sections[1])
    ring = pd.TriMesh.from_trimesh(mesh)
    body = pd.PatchBody(pd.FreeFormPatches.from_mesh(ring), 1e4)
    count = len(ring.triangles)
    apex = body.mesh.tets[:count, 3]
    corners = ring.vertices[ring.triangles]
    assert not is_blocked(corners.mean(axis=1), body.mesh.vertices[apex], corners).any()
    assert bool((np.bincount(apex)[len(ring.vertices) :] == 1).any()) == own
    assert body.mesh.quality().pieces == 1
