"""Free-form patch bodies of the source paper's size in motion: simulated, tessellated, rendered and timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from tqdm.auto import tqdm

from ..api.patches import FreeFormPatches
from ..api.simulator import Simulator
from ..freeform.body import PatchBody
from ..freeform.continuity import PatchContinuity, measure_continuity
from ..freeform.quadrics import Quadrics
from ..freeform.tessellation import tessellate
from ..geometry.tri_mesh import TriMesh
from ..plan.placement import find_device
from ..scene.effects import Damping, Gravity, Ground, Pin
from ..scene.scene import Scene
from ..viewing.animation import write_surface
from ..viewing.render import Picture, Studio, contact_sheet
from .demo import TIME_STEP, DemoOptions, check_packages

__all__ = ["PAPER_SCENES", "PatchScene", "PreparedScene", "run_patch_demo"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class PreparedScene(NamedTuple):
    """A body in its scene, and the targets of its grips at the end of a step."""

    body: PatchBody
    scene: Scene
    targets: Callable[[int], dict[Pin, Tensor]] | None


class PatchScene(NamedTuple):
    """A scene with as many patches and quadrics as one of Vyatkin and Dolgovesov (2023), and its time on a GTX 470."""

    name: str
    patches: int
    quadrics: int
    milliseconds: float  # per frame, of the paper
    frames_per_second: float  # of the paper
    build: Callable[[int, float, int, torch.device], PreparedScene]  # quadrics, stiffness [Pa], steps

    def prepare(self, *, stiffness: float, steps: int, device: torch.device | str = "cpu") -> PreparedScene:
        """Build the body and its scene; `stiffness` is st [Pa], `steps` the length of the motion."""
        return self.build(self.quadrics, stiffness, steps, torch.device(device))


class _Run(NamedTuple):
    """Result of one scene."""

    scene: PatchScene
    body: PatchBody
    seconds: tuple[float, float]  # simulation and surface, per frame
    residual: float
    continuity: tuple[PatchContinuity, PatchContinuity]  # at rest and at the end
    frames: Array  # [1 + steps, n, 3]
    triangles: Index


def spindle(rings: int, sectors: int, *, length: float, radius: float, power: float) -> TriMesh:
    """A surface of revolution about x with 2 rings sectors triangles; power 2 is an ellipsoid, more flattens it."""
    along = (
        -np.cos(np.pi * np.arange(1, rings + 1) / (rings + 1)) if power <= 2 else np.linspace(-1, 1, rings + 2)[1:-1]
    )
    width = radius * (1.0 - np.abs(along) ** power) ** (1.0 / 2.0)
    turn = 2.0 * np.pi * (np.arange(sectors)[None] + 0.5 * (np.arange(rings) % 2)[:, None]) / sectors
    x = np.broadcast_to(0.5 * length * along[:, None], turn.shape)
    around = np.stack([x, width[:, None] * np.cos(turn), width[:, None] * np.sin(turn)], axis=-1).reshape(-1, 3)
    poles = np.array([[-0.5 * length, 0.0, 0.0], [0.5 * length, 0.0, 0.0]])
    ring, sector = (a.ravel() for a in np.meshgrid(np.arange(rings - 1), np.arange(sectors), indexing="ij"))
    odd, after = ring % 2, (sector + 1) % sectors
    a, b = ring * sectors + sector, ring * sectors + after
    c, d = a + sectors, b + sectors
    # each ring is rotated by half a sector against the last: this makes the diagonal the shorter one
    first = np.where(odd[:, None], np.stack([a, d, b], 1), np.stack([a, c, b], 1))
    second = np.where(odd[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    start, end, last = rings * sectors, rings * sectors + 1, (rings - 1) * sectors
    k, following = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    caps = [np.stack([np.full(sectors, start), k, following], 1),
            np.stack([np.full(sectors, end), last + following, last + k], 1)]  # fmt: skip
    triangles = np.concatenate([first, second, *caps])[:, ::-1]
    return TriMesh(np.concatenate([around, poles]), triangles)


def sheet(columns: int, rows: int, *, length: float, width: float) -> TriMesh:
    """A rectangle in the plane y = 0 with 2 columns rows triangles, facing up."""
    x, z = np.meshgrid(np.linspace(0.0, length, columns + 1), np.linspace(-0.5, 0.5, rows + 1) * width, indexing="ij")
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    triangles = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return TriMesh(np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1), triangles)


def scattered(mesh: TriMesh, count: int, *, height: float, seed: int) -> Quadrics:
    """Random quadrics over a surface, about an edge wide; bumps and dents up to `height` of their radius."""
    rng = np.random.default_rng(seed)
    corners = mesh.vertices[mesh.triangles]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(area), size=count, p=area / area.sum())
    centres = np.einsum("nk,nkd->nd", rng.dirichlet((1.0, 1.0, 1.0), count), corners[chosen])
    radii = edge * rng.uniform(0.5, 0.9, (count, 3))
    amplitudes = height * radii.mean(axis=1) * rng.uniform(-1.0, 1.0, count)
    return Quadrics.from_radii(*(torch.tensor(a, dtype=torch.float32) for a in (amplitudes, centres, radii)))


def _body(mesh: TriMesh, quadrics: Quadrics, device: torch.device, stiffness: float, **options: object) -> PatchBody:
    patches = FreeFormPatches.from_mesh(mesh, quadrics, base="phong").to(device)
    return PatchBody(patches, stiffness, **options)  # type: ignore[arg-type]


def _rotation(angle: float, axis: int) -> Array:
    """The rotation by an angle about an axis."""
    return np.asarray(Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix())


def _progress(step: int, steps: int) -> float:
    """Fraction of the motion: 0 to 1 over the first three quarters of the steps, then 1."""
    return min(1.0, (step + 1) / (0.75 * steps))


def _held(body: PatchBody, mask: NDArray[np.bool_]) -> tuple[Pin, Array]:
    pin = Pin(body, mask)
    return pin, np.asarray(body.mesh.vertices[pin.vertices])


def _twist(quadrics: int, stiffness: float, steps: int, device: torch.device) -> PreparedScene:
    """A flat, rounded bar, gripped at both ends; one grip makes half a turn."""
    mesh = spindle(30, 20, length=1.2, radius=0.2, power=8.0).scaled((1.0, 1.0, 0.4)).translated((0.0, 0.35, 0.0))
    body = _body(mesh, scattered(mesh, quadrics, height=0.2, seed=1), device, stiffness)
    x = body.mesh.vertices[:, 0]
    wall, (grip, rest) = Pin(body, x < -0.5), _held(body, x > 0.5)
    middle = np.array([0.0, 0.35, 0.0])

    def targets(step: int) -> dict[Pin, Tensor]:
        moved = (rest - middle) @ _rotation(np.pi * _progress(step, steps), 0).T + middle
        return {grip: torch.tensor(moved, dtype=torch.float32, device=device)}

    return PreparedScene(body, Scene(body, wall, grip, Damping(2.0)), targets)


def _bend(quadrics: int, stiffness: float, steps: int, device: torch.device) -> PreparedScene:
    """A sheet whose far end follows arcs of constant curvature."""
    length, most = 1.0, np.radians(150.0)
    mesh = sheet(25, 20, length=length, width=0.8)
    body = _body(mesh, scattered(mesh, quadrics, height=0.2, seed=2), device, stiffness, apex="prism", thickness=0.04)
    x = body.mesh.vertices[:, 0]
    wall, (grip, rest) = Pin(body, x < 0.05), _held(body, x > length - 0.05)

    def targets(step: int) -> dict[Pin, Tensor]:
        angle = most * _progress(step, steps)
        end = length / angle * np.array([np.sin(angle), 1.0 - np.cos(angle), 0.0])
        moved = (rest - [length, 0.0, 0.0]) @ _rotation(angle, 2).T + end
        return {grip: torch.tensor(moved, dtype=torch.float32, device=device)}

    return PreparedScene(body, Scene(body, wall, grip, Damping(2.0)), targets)


def _drop(quadrics: int, stiffness: float, _steps: int, device: torch.device) -> PreparedScene:
    """A ball that falls on the ground, with a fifth of the others' stiffness."""
    mesh = (
        spindle(10, 10, length=0.6, radius=0.3, power=2.0).transformed(_rotation(0.9, 2)).translated((0.0, 0.75, 0.0))
    )
    body = _body(mesh, scattered(mesh, quadrics, height=0.25, seed=3), device, 0.2 * stiffness)
    return PreparedScene(body, Scene(body, Gravity(), Ground(friction=0.5)), None)


PAPER_SCENES = (
    PatchScene("twist", 1200, 3832, 27.0, 37.0, _twist),
    PatchScene("bend", 1000, 3484, 26.0, 38.0, _bend),
    PatchScene("drop", 200, 664, 20.0, 49.0, _drop),
)


def run_patch_demo(options: DemoOptions) -> str:
    """Write a picture and moving surfaces of the three scenes to `options.out`; returns the report to print."""
    check_packages()
    device = find_device(options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    level = 2 if options.quick else 4
    runs = [_simulate(scene, options, device, level) for scene in PAPER_SCENES]
    files, drawing = [options.out / "patches.png"], _draw(runs, options)
    for run in runs:
        path = options.out / f"{run.scene.name}.glb"
        files.append(write_surface(path, run.frames, run.triangles, frames_per_second=1 / TIME_STEP, keyframes=25))
    return _report(runs, options, level, drawing, files)


def _simulate(scene: PatchScene, options: DemoOptions, device: torch.device, level: int) -> _Run:
    prepared = scene.prepare(stiffness=0.5 * options.youngs, steps=options.steps, device=device)
    body = prepared.body
    sim = Simulator(prepared.scene, TIME_STEP, options.iterations, batch=1).to(device)
    start = sim.rest_state()
    sim.rollout(start, 2, targets=prepared.targets)  # the first steps also allocate their workspace
    begin = _synchronised_time(device)
    track = sim.rollout(start, options.steps, targets=prepared.targets, return_info=True, progress=True)
    simulated = _synchronised_time(device) - begin
    positions = torch.cat([start.positions[None], track.positions])
    if not bool(positions.isfinite().all()):
        raise ValueError("positions must stay finite, got inf or NaN in the motion; try a larger --youngs")
    grid = tessellate(body.patches, level)
    with torch.no_grad():
        heights = body.patches.heights(grid.samples)  # constant in the material
        body.patches.surface(grid.samples, body.pose(positions[0]), heights=heights)
        begin = _synchronised_time(device)
        frames = [body.patches.surface(grid.samples, body.pose(x), heights=heights).points for x in positions]
        surfaced = _synchronised_time(device) - begin
        continuity = measure_continuity(body.patches), measure_continuity(body.patches, body.pose(positions[-1]))
    return _Run(
        scene,
        body,
        (simulated / options.steps, surfaced / len(positions)),
        float(track.info.residual.amax()),
        continuity,
        torch.cat(frames).double().cpu().numpy(),
        grid.triangles.cpu().numpy(),
    )


def _synchronised_time(device: torch.device) -> float:
    """Time [s] after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _draw(runs: list[_Run], options: DemoOptions) -> list[float]:
    """Render one row of pictures per scene; returns the seconds per picture of each."""
    columns, size, samples = (3, (240, 180), 4) if options.quick else (4, (480, 360), 9)
    pictures: list[Picture] = []
    captions: list[str] = []
    seconds = []
    with tqdm(total=columns * len(runs), desc="pictures", unit="picture", leave=False) as bar:
        for run in runs:
            studio = Studio(run.frames, run.triangles, ground=None, size=size, samples=samples)
            begin = time.perf_counter()
            for number in np.linspace(0, len(run.frames) - 1, columns).round().astype(int):
                pictures.append(studio.render(run.frames[number]))
                captions.append(f"{run.scene.name}, {run.scene.patches} patches, {number * TIME_STEP:.2f} s")
                bar.update(1)
            seconds.append((time.perf_counter() - begin) / columns)
    contact_sheet(pictures, columns=columns, captions=captions, path=options.out / "patches.png")
    return seconds


def _report(runs: list[_Run], options: DemoOptions, level: int, drawing: list[float], files: list[Path]) -> str:
    head = ["scene", "patches", "quadrics", "constraints", "triangles", "simulation ms", "surface ms", "frames/s",
            "paper ms", "paper frames/s", "residual", "picture s"]  # fmt: skip
    rows = [head]
    for run, picture in zip(runs, drawing, strict=True):
        simulated, surfaced = run.seconds
        rows.append(
            [run.scene.name, f"{len(run.body.patches.triangles):,}", f"{len(run.body.patches.quadrics):,}",
             f"{len(run.body.mesh.tets):,}", f"{len(run.triangles):,}", f"{1e3 * simulated:.2f}",
             f"{1e3 * surfaced:.2f}", f"{1 / (simulated + surfaced):.0f}", f"{run.scene.milliseconds:.0f}",
             f"{run.scene.frames_per_second:.0f}", f"{run.residual:.1e}", f"{picture:.1f}"]
        )  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.rjust, row, widths)) for row in rows]
    where = f"cpu with threads: {torch.get_num_threads()}" if options.device == "cpu" else options.device
    lines += [
        "",
        f"On {where}, in float32: {options.steps} frames of {options.iterations} iterations, {level} segments an edge.",
        "Residual: the worst of all frames. Frames/s: simulation and surface, without the pictures, which are path",
        "traced. The paper: whole frames on a GTX 470, other bodies with as many patches and perturbation functions.",
        "",
        "across the edges of patches, at rest and at the end:",
    ]
    for run in runs:
        rest, end = run.continuity
        lines.append(
            f"  {run.scene.name}: gap {rest.gap:.1e}, {end.gap:.1e} m; crease angle mean {rest.mean_angle:.1f}, "
            f"{end.mean_angle:.1f}, largest {rest.largest_angle:.1f}, {end.largest_angle:.1f} degrees"
        )
    return "\n".join([*lines, "", "written:", *(f"  {file}" for file in files)])
