"""States as files for ParaView: `.vtu`, an unstructured grid, and `.pvd`, a list of these with times.

    drop.pvd, drop_0000.vtu, drop_0001.vtu, ...

Points are the positions of one environment [m]. Cells are the tetrahedra of solids, the triangles of cloth, and lines
for segments of rods and for springs, in this order. Files have these fields, those of a kind where the scene has it:

    points  displacement      [m]
            velocity          [m/s]
            tie_force         [N], of ties, on both bodies
    cells   stress            of tetrahedra [Pa], nine numbers row by row, NaN in inverted ones
            von_mises         of tetrahedra [Pa], NaN in inverted ones; both absent where a solid has a strain limit
                              or law="volume"
            fibre_tension     of tetrahedra [Pa], the sum over their fibres
            plastic_strain    flow alpha of tetrahedra, 0 in elastic ones
            membrane_stress   of triangles [N/m], larger and smaller principal value, NaN in collapsed ones; absent
                              where a cloth has a strain limit
            tension           of lines [N]
            strain            of lines
            body              number of the body; -1 of springs
            region            of the mesh, 0 in meshes without; absent if no mesh has regions

A field is NaN in cells of other kinds.

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
from ..common.tables import EFFECT_ROWS
from ..plan.compiled import CompiledScene
from ..plan.material import check_environments, dims_of
from ..scene.effects import Solid
from ..scene.fibres import Fibres
from ..scene.part import Body
from ..scene.scene import Scene
from ..scene.springs import Springs
from .state import HistoryState, HistoryTrack, State, Track, named_state
from .stencil_readouts import forces_on_tied, has_membrane_stress, membrane_stress, tensions
from .stress import STRESS_ROWS, has_stress, plastic_strain, stress

__all__ = ["States", "write_vtu"]

States = State | HistoryState | Track | HistoryTrack | Sequence[State | HistoryState]
Fields = dict[str, NDArray[Any]]
Index = NDArray[np.int64]


def write_vtu(
    compiled: CompiledScene,
    check: Callable[[State | HistoryState], object],
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
    cells, labels = _cells(compiled.scene)
    count = sum(len(corners) for corners in cells.values())
    front = (batch,) if alone else (len(records), batch)
    points = _given("point_data", point_data, (*front, compiled.vertices), chosen)
    given = _given("cell_data", cell_data, (*front, count), chosen)
    files = [target] if alone else _numbered(target, len(records))
    instants = _instants(compiled.time_step, times, len(records))
    for number, (file, state) in enumerate(zip(files, records, strict=True)):
        own_points, found = _own_fields(compiled, state, chosen)
        own_cells = {name: _spread(cells, of, values) for name, (of, values) in found.items()}
        point_fields = _joined("point_data", own_points, points, number)
        cell_fields = _joined("cell_data", {**own_cells, **labels}, given, number)
        _write(file, state.positions[chosen], cells, point_fields, cell_fields)
    if not alone:
        target.write_text(_collection(files, instants), encoding="utf-8")
    return target


# ---- what is written


def _records(
    compiled: CompiledScene, check: Callable[[State | HistoryState], object], states: States
) -> tuple[list[State | HistoryState], bool]:
    """The states one by one, and whether a single one was given."""
    alone = False
    found: list[State | HistoryState]
    if isinstance(states, Track | HistoryTrack):
        found = [states.state(record) for record in range(len(states.positions))]
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
    names = {"stiffness", *(row.name for row in EFFECT_ROWS)} & compiled.named.keys()
    elastic = {name: compiled.named[name] for name in sorted(names)}
    check_environments("write_vtu: states", len(found[0][0]), elastic)
    return [named_state(state) for state in found], alone


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


def _cells(scene: Scene) -> tuple[dict[str, Index], Fields]:
    """Corners of the cells by meshio's kind, and the labels of their bodies and regions."""
    kinds: dict[str, list[Index]] = {"tetra": [], "triangle": [], "line": []}
    bodies: dict[str, list[Index]] = {kind: [] for kind in kinds}
    regions: dict[str, list[Index]] = {kind: [] for kind in kinds}

    def add(kind: str, corners: Index, body: int, region: Index | None) -> None:
        kinds[kind].append(corners)
        bodies[kind].append(np.full(len(corners), body))
        regions[kind].append(np.zeros(len(corners), dtype=np.int64) if region is None else region)

    starts = {id(body): scene.vertex_range(body).start for body in scene.bodies}
    numbers = {id(body): number for number, body in enumerate(scene.bodies)}
    for part in scene.parts:  # springs and rods in the order of their stencils
        if isinstance(part, Body):
            corners = part.elements + starts[id(part)]
            region = part.mesh.regions if isinstance(part, Solid) else None
            add({4: "tetra", 3: "triangle", 2: "line"}[corners.shape[1]], corners, numbers[id(part)], region)
        elif isinstance(part, Springs):
            add("line", part.pairs + np.array([starts[id(part.body)], starts[id(part.other)]]), -1, None)
    labels: Fields = {"body": np.concatenate([array for arrays in bodies.values() for array in arrays])}
    if any(solid.mesh.regions is not None for solid in scene.solids):
        labels["region"] = np.concatenate([array for arrays in regions.values() for array in arrays])
    return {kind: np.concatenate(corners) for kind, corners in kinds.items() if corners}, labels


def _spread(cells: Mapping[str, Index], kind: str, values: NDArray[Any]) -> NDArray[Any]:
    """Values of all cells, NaN in those of other kinds."""
    whole = np.full((sum(map(len, cells.values())), *values.shape[1:]), np.nan, dtype=values.dtype)
    start = 0
    for name, corners in cells.items():
        if name == kind:
            whole[start : start + len(corners)] = values
        start += len(corners)
    return whole


@torch.no_grad()
def _own_fields(
    compiled: CompiledScene, state: State | HistoryState, chosen: int
) -> tuple[Fields, dict[str, tuple[str, NDArray[Any]]]]:
    """Fields of points that files have, and those of cells with the kind that has them."""
    scene, positions = compiled.scene, state.positions[chosen]
    named = dict(compiled.named)
    if isinstance(state, HistoryState):
        named["flow"] = state.history.flow
    material = {name: _of_environment(name, array, chosen) for name, array in named.items()}
    rest = positions.new_tensor(scene.rest_positions)
    points = {"displacement": positions - rest, "velocity": state.velocities[chosen]}
    cells: dict[str, tuple[str, Tensor]] = {}
    if scene.solids and has_stress(scene):
        given = {name: material[name] for name in STRESS_ROWS if name in material}
        rows = {name: row for name, row in given.items() if name == "stiffness" or row.numel() > 0}
        found = stress(scene, positions[None], rows)
        cells["stress"] = "tetra", found.cauchy[0].flatten(1)
        cells["von_mises"] = "tetra", found.von_mises[0]
    if isinstance(state, HistoryState) and state.history.flow.shape[-2]:
        flows = plastic_strain(scene, state.history.flow[chosen][None])
        none = [positions.new_zeros(len(solid.mesh.tets)) for solid in scene.solids]
        own = [flows[solid][0] if solid in flows else zeros for solid, zeros in zip(scene.solids, none, strict=True)]
        cells["plastic_strain"] = "tetra", torch.cat(own)
    sheets = membrane_stress(scene, positions[None], material) if has_membrane_stress(scene) else {}
    if sheets:
        cells["membrane_stress"] = "triangle", torch.cat([sheet.principal[0] for sheet in sheets.values()])
    pulls = tensions(scene, positions[None], material)
    if lines := [pull for part, pull in pulls.items() if not isinstance(part, Fibres)]:
        cells["tension"] = "line", torch.cat([line.tension[0] for line in lines])
        cells["strain"] = "line", torch.cat([line.strain[0] for line in lines])
    if scene.fibres:
        cells["fibre_tension"] = "tetra", _on_tets(scene, {part: pulls[part].tension[0] for part in scene.fibres})
    if (pulled := forces_on_tied(scene, positions[None].cpu(), material)) is not None:
        points["tie_force"] = pulled[0]
    return (
        {name: values.cpu().numpy() for name, values in points.items()},
        {name: (kind, values.cpu().numpy()) for name, (kind, values) in cells.items()},
    )


def _of_environment(name: str, array: Tensor, chosen: int) -> Tensor:
    batched = array.dim() > dims_of(name)
    return array[chosen if len(array) > 1 else 0] if batched else array


def _on_tets(scene: Scene, tensions_of: Mapping[Fibres, Tensor]) -> Tensor:
    """Sums over the fibres of each tetrahedron [E]."""
    counts = [len(solid.mesh.tets) for solid in scene.solids]
    starts = dict(zip(scene.solids, np.cumsum([0, *counts[:-1]]), strict=True))
    total = torch.zeros(sum(counts), dtype=next(iter(tensions_of.values())).dtype)
    for part, tension in tensions_of.items():
        total[torch.from_numpy(part.tets + starts[part.solid])] += tension.cpu()  # each tetrahedron once
    return total


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


def _write(file: Path, positions: Tensor, cells: Mapping[str, Index], points: Fields, fields: Fields) -> None:
    import meshio

    ends = np.cumsum([len(corners) for corners in cells.values()])[:-1]
    by_kind = {name: np.split(values, ends) for name, values in fields.items()}
    corners = positions.detach().cpu().numpy()
    mesh = meshio.Mesh(corners, list(cells.items()), point_data=points, cell_data=by_kind)
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
