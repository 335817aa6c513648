"""The demo: fills a mesh, drops it, simulates and renders it, and measures the solver's error."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm.auto import tqdm

from ..api.simulator import Simulator
from ..common.packages import OPTIONAL, missing_packages
from ..formats.bodies import holds_body
from ..geometry import shapes
from ..geometry.tet_mesh import TetMesh
from ..geometry.tetrahedralize import tetrahedralize
from ..geometry.tri_mesh import TriMesh
from ..plan.placement import find_device
from ..scene.contact import Contact
from ..scene.effects import Gravity, Ground, Solid
from ..scene.scene import Scene
from ..simulation.state import State, Track
from ..study.convergence import SolvedAlreadyError, compare_solvers, plot_convergence
from ..viewing.animation import write_film, write_surface
from ..viewing.render import Studio, contact_sheet

__all__ = ["DemoOptions", "check_packages", "run_demo"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

TIME_STEP = 1 / 60  # s
DROP_HEIGHT = 0.25  # m below the lowest vertex
_DRAWING = ("mitsuba", "PIL", "imageio_ffmpeg", "pxr", "matplotlib")


@dataclass(frozen=True)
class DemoOptions:
    """Options of `python -m torchpd demo`."""

    mesh: Path | None = None  # surface or tetrahedral mesh; None takes shapes.octopus()
    cells: int = 24  # lattice cells along the longest side; ignored for a tetrahedral mesh
    steps: int = 120  # of 1/60 s
    youngs: float = 3e4  # Pa
    iterations: int = 64  # per step
    device: str = "cpu"
    out: Path = Path("out")
    quick: bool = False  # fewer and smaller pictures


class _Pictures(NamedTuple):
    """Settings of the pictures."""

    sheet_frames: int
    sheet_columns: int
    sheet_size: tuple[int, int]
    sheet_samples: int
    film_size: tuple[int, int]
    film_samples: int
    film_every: int  # steps between two pictures of the film


_GOOD = _Pictures(12, 4, (480, 360), 9, (400, 300), 4, 2)
_QUICK = _Pictures(6, 3, (240, 180), 9, (160, 120), 4, 6)


class _Motion(NamedTuple):
    """Result of the simulation."""

    start: State
    track: Track
    seconds: float  # wall time
    frames: Array  # [1 + steps, n, 3] m of the drawn surface, the start first
    triangles: Index  # of the drawn surface


def run_demo(options: DemoOptions) -> str:
    """Write pictures, films and the convergence plot to `options.out`; returns the report to print."""
    check_packages()
    device = find_device(options.device)
    name = options.mesh.name if options.mesh else "octopus"
    mesh = _place_body(_load(options.mesh), options.cells)
    parts = (Solid(mesh, youngs=options.youngs, density=1000.0), Gravity(), Ground(friction=0.5))
    plain = sim = Simulator(Scene(*parts), TIME_STEP, iterations=options.iterations, batch=1).to(device)
    if options.mesh is None and device.type == "cpu":  # arms meet each other and the head
        sim = Simulator(Scene(*parts, Contact(friction=0.3)), TIME_STEP, iterations=options.iterations, batch=1)
    options.out.mkdir(parents=True, exist_ok=True)

    motion = _simulate(sim, mesh, options.steps)
    hardest = int(motion.track.info.energy[:, 0].argmax())
    files = _draw(motion, hardest, options.out, _QUICK if options.quick else _GOOD)
    plot = _study(f"{name}, {len(mesh.tets):,} tets", plain, motion, hardest, options)
    files += [plot] if plot else []
    return _report(name, mesh, sim, motion, files)


def check_packages() -> None:
    """Refuse missing drawing packages before the work, not after it."""
    missing = missing_packages(package for package in OPTIONAL if package.module in _DRAWING)
    if missing:
        names = ", ".join(package.pip_name for package in missing)
        raise ModuleNotFoundError(f"demo needs {names}, not installed: pip install torchpd[demo]")


def _load(path: Path | None) -> TetMesh | TriMesh:
    if path is None:
        return shapes.octopus()
    return TetMesh.from_file(path) if holds_body("demo", path) else TriMesh.from_file(path)


def _place_body(shape: TetMesh | TriMesh, cells: int) -> TetMesh:
    """Scale to one metre, tilt so that the body lands on an edge and bends, and lift it above the ground."""
    low, high = shape.bounds
    # about z, then x, then y (towards the camera)
    tilt = Rotation.from_euler("zxy", [25.0, 20.0, 25.0], degrees=True).as_matrix()
    placed = shape.translated(-(low + high) / 2.0).scaled(1.0 / float((high - low).max())).transformed(tilt)
    mesh = placed if isinstance(placed, TetMesh) else tetrahedralize(placed, cells=cells, progress=True)
    # parts that a lattice would join at a vertex alone have one each there, and would touch at rest
    return mesh.merged().translated((0.0, DROP_HEIGHT - float(mesh.bounds[0, 1]), 0.0))


def _simulate(sim: Simulator, mesh: TetMesh, steps: int) -> _Motion:
    start = sim.rest_state()
    sim.step_(start.clone())  # the first step also allocates its workspace
    begin = time.perf_counter()
    track = sim.rollout(start, steps, return_info=True, progress=True)
    seconds = time.perf_counter() - begin  # includes the wait for a GPU: the rollout ends with a copy
    positions = torch.cat([start.positions, track.positions[:, 0]]).double().cpu().numpy()
    if not np.isfinite(positions).all():
        raise ValueError("positions must stay finite, got inf or NaN in the motion; try a larger --youngs")
    if mesh.embedding is None:
        return _Motion(start, track, seconds, positions, mesh.boundary())
    return _Motion(start, track, seconds, mesh.embedding.apply(positions), mesh.embedding.surface.triangles)


def _study(body_name: str, sim: Simulator, motion: _Motion, hardest: int, options: DemoOptions) -> Path | None:
    """Plot the convergence in the step with the highest objective, where elastic and impact energy add up."""
    before = motion.start if hardest == 0 else motion.track.state(hardest - 1)
    try:
        curves = compare_solvers(sim, State(*before[:2]), iterations=128 if options.quick else 256, progress=True)
    except SolvedAlreadyError:
        return None  # too few steps to reach the ground: the body only falls
    title = f"{body_name}, the step of highest energy (t = {hardest * TIME_STEP:.2f} s)"
    return plot_convergence(curves, options.out / "convergence.png", title=title, mark=options.iterations)


def _draw(motion: _Motion, hardest: int, out: Path, pictures: _Pictures) -> list[Path]:
    """Render the hardest step at once, then contact sheet, moving surface and films."""
    frames, triangles = motion.frames, motion.triangles
    # the floor is drawn at the lowest point of the surface: the lattice around it touches the ground a little earlier
    sheet_studio, film_studio = (
        Studio(frames, triangles, ground=None, size=size, samples=samples)
        for size, samples in (
            (pictures.sheet_size, pictures.sheet_samples),
            (pictures.film_size, pictures.film_samples),
        )
    )
    first = out / "picture.png"
    contact_sheet([sheet_studio.render(frames[hardest + 1])], columns=1, path=first)
    print(f"first picture: {first}", flush=True)
    chosen = np.unique(np.linspace(0, len(frames) - 1, pictures.sheet_frames).round().astype(int))
    shown = range(0, len(frames), pictures.film_every)
    with tqdm(total=len(chosen) + len(shown), desc="pictures", unit="picture", leave=False) as bar:
        sheet, film = [], []
        for number in chosen:
            sheet.append(sheet_studio.render(frames[number]))
            bar.update(1)
        for number in shown:
            film.append(film_studio.render(frames[number]))
            bar.update(1)
    captions = [f"{number * TIME_STEP:.2f} s" for number in chosen]
    contact_sheet(sheet, columns=pictures.sheet_columns, captions=captions, path=out / "contact_sheet.png")
    rate = 1.0 / TIME_STEP
    return [
        first,
        out / "contact_sheet.png",
        *(
            write_film(out / f"animation{e}", film, frames_per_second=rate / pictures.film_every)
            for e in (".gif", ".mp4")
        ),
        *(write_surface(out / f"animation{e}", frames, triangles, frames_per_second=rate) for e in (".glb", ".usdc")),
    ]


def _report(name: str, mesh: TetMesh, sim: Simulator, motion: _Motion, files: list[Path]) -> str:
    steps = len(motion.track.positions)
    milliseconds = 1e3 * motion.seconds / steps
    rows = [
        ("mesh", name),
        ("vertices", f"{len(mesh.vertices):,}"),
        ("tets", f"{len(mesh.tets):,}"),
        ("device", str(sim.device)),
        ("contact", "ground" if sim.scene.contact is None else "ground, and with itself"),
        ("steps", f"{steps} of {1e3 * TIME_STEP:.1f} ms"),
        ("iterations", f"{sim.iterations} a step"),
        ("time per step", f"{milliseconds:.2f} ms"),
        ("real-time factor", f"{1e3 * TIME_STEP / milliseconds:.1f}"),
        ("final residual", f"{float(motion.track.info.residual[-1, 0]):.1e}"),
    ]
    width = max(len(key) for key, _ in rows)
    table = [f"{key:<{width}}  {value}" for key, value in rows]
    return "\n".join([*table, "", "written:", *(f"  {file}" for file in files)])
