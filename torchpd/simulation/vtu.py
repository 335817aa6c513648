"""States as files for ParaView: `.vtu`, an unstructured grid, and `.pvd`, a list of these with times.

    drop.pvd, drop_0000.vtu, drop_0001.vtu, ...

Points are the positions of one environment [m], cells its tetrahedra. Every file has these fields:

    points  displacement  [m]
            velocity      [m/s]
    cells   stress        [Pa], nine numbers row by row, NaN in inverted tetrahedra
            von_mises     [Pa], NaN in inverted tetrahedra
            body          number of the solid
            region        of the mesh, 0 in meshes without; absent if no mesh has regions

The caller may add fields, for example contact forces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..common.checks import as_array, check_finite, check_has_values, check_shape, check_target_file, check_whole
from ..plan.compiled import CompiledScene
from ..plan.material import check_environments
from ..scene.scene import Scene
from .state import State, Track
from .stress import stress

__all__ = ["States", "write_vtu"]

States = State | Track | Sequence[State]
Fields = dict[str, NDArray[Any]]


def write_vtu(
    compiled: CompiledScene,
    check: Callable[[State], object],
    path: str | Path,
    states: States,
    environment: int | None,
    times: Sequence[float] | None,
    point_data: Mapping[str, Any] | None,
    cell_data: Mapping[str, Any] | None,
) -> Path:
    """Implementation of `Simulator.write_vtu`; `check` refuses anything but a state."""
    check_has_values("write_vtu", compiled.device)
    target = check_target_file(path, "write_vtu")
    records, alone = _records(compiled, check, states)
    ending, what = (".vtu", "one state") if alone else (".pvd", "several states, each of which gets a .vtu beside it")
    if target.suffix.lower() != ending:
        raise ValueError(f"write_vtu: path must end in {ending} for {what}, got {target.name}")
    batch = len(records[0].positions)
    chosen = _chosen(environment, batch)
    tets, labels = _cells(compiled.scene)
    front = (batch,) if alone else (len(records), batch)
    points = _given("point_data", point_data, (*front, compiled.vertices), chosen)
    cells = _given("cell_data", cell_data, (*front, len(tets)), chosen)
    files = [target] if alone else _numbered(target, len(records))
    instants = _instants(compiled.time_step, times, len(records))
    for number, (file, state) in enumerate(zip(files, records, strict=True)):
        own_points, own_cells = _own_fields(compiled, state, chosen)
        point_fields = _joined("point_data", own_points, points, number)
        cell_fields = _joined("cell_data", {**own_cells, **labels}, cells, number)
        _write(file, state.positions[chosen], tets, point_fields, cell_fields)
    if not alone:
        target.write_text(_collection(files, instants), encoding="utf-8")
    return target


# ---- what is written


def _records(compiled: CompiledScene, check: Callable[[State], object], states: States) -> tuple[list[State], bool]:
    """The states one by one, and whether a single one was given."""
    alone = False
    if isinstance(states, Track):
        found = [State(x, v) for x, v in zip(states.positions, states.velocities, strict=True)]
    elif isinstance(states, (tuple, list)):
        alone = len(states) > 0 and isinstance(states[0], Tensor)
        found = [states] if alone else list(states)  # type: ignore[list-item]
    else:
        raise TypeError(f"write_vtu: states must be a State, a Track or a list of states, got {type(states).__name__}")
    if not found:
        raise ValueError("write_vtu: states must hold at least one record, got none")
    for state in found:
        check(state)
    batches = {len(state[0]) for state in found}
    if len(batches) != 1:
        raise ValueError(f"write_vtu: states must have one number of environments, got {sorted(batches)}")
    if 0 in batches:
        raise ValueError("write_vtu: states must have at least one environment, got none")
    check_environments("write_vtu: states", len(found[0][0]), {"stiffness": compiled.named["stiffness"]})
    return [State(*state) for state in found], alone


def _chosen(environment: int | None, batch: int) -> int:
    if environment is None and batch != 1:
        raise ValueError(f"write_vtu: environment must be given for states of {batch}, for example environment=0")
    number = check_whole("write_vtu: environment", environment or 0, minimum=0)
    if number >= batch:
        raise IndexError(f"write_vtu: environment must lie in 0..{batch - 1}, got {number}")
    return number


def _instants(time_step: float, times: Sequence[float] | None, count: int) -> list[float]:
    if times is None:
        return [(number + 1) * time_step for number in range(count)]
    instants = as_array("write_vtu: times", times, np.float64, for_picture=True)
    check_shape("write_vtu: times", instants, (count,), "one for each record [s]")
    check_finite("write_vtu: times", instants)
    found: list[float] = instants.tolist()
    return found


def _cells(scene: Scene) -> tuple[NDArray[np.int64], Fields]:
    """Tets [E, 4], and the labels of their bodies and regions."""
    meshes = [solid.mesh for solid in scene.solids]
    labels: Fields = {"body": np.repeat(np.arange(len(meshes)), [len(mesh.tets) for mesh in meshes])}
    if any(mesh.regions is not None for mesh in meshes):
        regions = [np.zeros(len(m.tets), dtype=np.int64) if m.regions is None else m.regions for m in meshes]
        labels["region"] = np.concatenate(regions)
    return scene.tets, labels


@torch.no_grad()
def _own_fields(compiled: CompiledScene, state: State, chosen: int) -> tuple[Fields, Fields]:
    """Fields of points and cells that every file has."""
    positions = state.positions[chosen]
    rest = positions.new_tensor(compiled.scene.rest_positions)
    stiffness = compiled.named["stiffness"].expand(len(state.positions), -1)[chosen]
    found = stress(compiled.scene, positions[None], stiffness)
    points = {"displacement": positions - rest, "velocity": state.velocities[chosen]}
    cells = {"stress": found.cauchy[0].flatten(1), "von_mises": found.von_mises[0]}
    return {k: v.cpu().numpy() for k, v in points.items()}, {k: v.cpu().numpy() for k, v in cells.items()}


def _given(owner: str, data: Mapping[str, Any] | None, lead: tuple[int, ...], chosen: int) -> Fields:
    """Given fields of the chosen environment [T, n, k], with T = 1 for fields that all records share."""
    found: Fields = {}
    for name, value in (data or {}).items():
        label = f"write_vtu: {owner}[{name!r}]"
        array, count = as_array(label, value, for_picture=True), lead[-1]
        if array.shape[: len(lead)] == lead:
            array = array.take(chosen, axis=len(lead) - 2)
            array = array if len(lead) == 3 else array[None]
        elif array.shape[:1] == (count,):
            array = array[None]
        else:
            raise ValueError(f"{label} must be {[*lead, '...']} or {[count, '...']} for all, got {list(array.shape)}")
        array = array.reshape(len(array), count, -1) if array.ndim > 3 else array
        # meshio does not escape names
        found[escape(str(name), {'"': "&quot;", "\n": "&#10;"})] = (
            array.astype(np.uint8) if array.dtype == np.bool_ else array
        )
    return found


def _joined(owner: str, own: Fields, given: Fields, record: int) -> Fields:
    if twice := sorted(own.keys() & given.keys()):
        raise ValueError(f"write_vtu: {owner} must not name {twice[0]!r}, which every file has; give it another name")
    return {**own, **{name: values[record if len(values) > 1 else 0] for name, values in given.items()}}


# ---- files


def _numbered(target: Path, count: int) -> list[Path]:
    digits = max(4, len(str(count - 1)))
    return [target.with_name(f"{target.stem}_{number:0{digits}}.vtu") for number in range(count)]


def _write(file: Path, positions: Tensor, tets: NDArray[np.int64], points: Fields, cells: Fields) -> None:
    import meshio

    corners = positions.detach().cpu().numpy()
    mesh = meshio.Mesh(
        corners, [("tetra", tets)], point_data=points, cell_data={name: [values] for name, values in cells.items()}
    )
    mesh.write(file, file_format="vtu")


def _collection(files: Sequence[Path], instants: Sequence[float]) -> str:
    """Text of a .pvd: file names relative to it, and times [s]."""
    rows = [
        f'    <DataSet timestep="{instant!r}" group="" part="0" file={quoteattr(file.name)}/>'
        for file, instant in zip(files, instants, strict=True)
    ]
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">',
            "  <Collection>",
            *rows,
            "  </Collection>",
            "</VTKFile>",
            "",
        ]
    )
