"""Simulations as one safetensors file, whose JSON metadata describes the tensors. Nothing in it is executed.

The file holds the scene as described, and the material of the simulator, so a loaded simulation takes the same steps
bit for bit. Tensors are named after their part: `part.0.youngs`, `mesh.0.tets`, `material.stiffness`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ..common.checks import check_target_file
from ..estimate.solver_choice import Choice
from ..geometry.embedding import Embedding
from ..geometry.mesh_checks import set_frozen
from ..geometry.tet_mesh import TetMesh, without_face_checks
from ..geometry.tri_mesh import TriMesh
from ..scene.cloth import Cloth
from ..scene.contact import Collider, Contact
from ..scene.effects import Damping, Gravity, Ground, Pin, Solid, Sphere
from ..scene.fibres import Fibres
from ..scene.loads import Pressure, Wind
from ..scene.part import Body
from ..scene.pins import PIN_HARD
from ..scene.plastic import Plastic
from ..scene.rod import Rod
from ..scene.scene import Part, Scene
from ..scene.solvers import Chebyshev, Jacobi, Multilevel, Newton, Solver
from ..scene.springs import Springs
from ..scene.tie import Tie
from ..version import __version__

__all__ = ["FORMAT_VERSION", "SavedSimulation", "load_simulation", "reading", "save_simulation"]

FORMAT_VERSION = 2
# arrays of format 1, in which hard pins have stiffness inf
_FIRST_ARRAYS = (
    "stiffness", "masses", "gravity", "damping", "pin_stiffness", "pin_targets", "planes", "spheres",
)  # fmt: skip
_KEY = "torchpd"  # of the metadata; others may add their own keys
_PARTS = (
    Solid, Cloth, Rod, Springs, Tie, Fibres, Pin, Pressure, Wind, Gravity, Ground, Sphere, Damping, Collider, Contact,
)  # fmt: skip
_KINDS: dict[str, type[Any]] = {kind.__name__: kind for kind in _PARTS}
_SOLVERS: dict[str, type[Solver]] = {kind.__name__: kind for kind in (Jacobi, Chebyshev, Multilevel, Newton)}
_BODIES = {"body", "other", "solid"}  # fields that hold a body of the scene
# fields that the first files of format 2 lack
_LATER = {
    "poisson",
    "averaging",
    "law",
    "strain_limit",
    "limit_stiffness",
    "stiffness_damping",
    "plastic",
    "mass",
    "inertia",
}
# inputs of a preconditioner, which with the mesh determine its bits
_REFERENCE = ("stiffness", "inertia")
_DTYPES = {str(dtype).removeprefix("torch."): dtype for dtype in (torch.float32, torch.float64)}

Record = dict[str, Any]


@dataclasses.dataclass(frozen=True, eq=False)
class SavedSimulation:
    """A simulation as values: the content of a file, and the inputs of `Simulator`."""

    scene: Scene
    settings: dict[str, Any]  # arguments of `Simulator` by name
    named_iterations: bool
    choice: Choice | None  # of solver="auto", which chooses again on another device
    material: dict[str, Tensor]  # arguments of `set_material` by name
    contact: dict[str, Tensor]  # friction and thickness of `Contact` by name
    parameters: list[str]  # those that are parameters
    trained: list[str]  # names of arrays that require a gradient
    reference: tuple[Tensor, Tensor] | None  # stiffness and inertia for which a preconditioner was made


def save_simulation(saved: SavedSimulation, path: str | Path) -> None:
    """Write scene, settings and material to one file.

    Args:
        saved: the simulation, with tensors on any device.
        path: of the file, usually ending in `.safetensors`; an existing one is replaced.
    """
    target = check_target_file(path)
    scene, settings = saved.scene, saved.settings
    met = [] if scene.contact is None else [body for body in scene.bodies if scene.contact.takes(body)]
    if any(body.contact_triangles() is not None for body in met):
        raise ValueError(
            "save: a PatchBody that takes part in Contact cannot be written, since the file keeps a Solid without its "
            "patches; write them by patches.save, and make the scene again"
        )
    meshes = _distinct_meshes(scene)
    tensors: dict[str, Tensor] = {}
    for number, mesh in enumerate(meshes):
        tensors.update(_tensors(f"mesh.{number}", _mesh_arrays(mesh)))
    for number, part in enumerate(scene.parts):
        tensors.update(_tensors(f"part.{number}", _part_arrays(part)))
    tensors.update({f"material.{name}": value.detach().cpu().contiguous() for name, value in saved.material.items()})
    tensors.update({name: value.detach().cpu().contiguous() for name, value in saved.contact.items()})
    if saved.reference is not None:
        reference = zip(_REFERENCE, saved.reference, strict=True)
        tensors.update({f"solver.{name}": value.cpu().contiguous() for name, value in reference})
    solver = settings["solver"]
    record: Record = {
        "format": FORMAT_VERSION,
        "written_by": f"torchpd {__version__}",
        **settings,
        "dtype": str(settings["dtype"]).removeprefix("torch."),
        "solver": {"kind": type(solver).__name__, **dataclasses.asdict(solver)},
        "named_iterations": saved.named_iterations,
        "choice": None if saved.choice is None else dataclasses.asdict(saved.choice),
        "meshes": [{"flipped": mesh.flipped} for mesh in meshes],
        "parts": [_part_record(part, scene, meshes) for part in scene.parts],
        "material": list(saved.material),
        "contact": list(saved.contact),
        "parameters": saved.parameters,
        "trained": saved.trained,
    }
    save_file(tensors, target, metadata={_KEY: json.dumps(record)})


def load_simulation(path: str | Path) -> SavedSimulation:
    """Read a file of `save_simulation`."""
    record, tensors = _read(Path(path))
    with reading(path):
        return _saved(record, tensors)


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Turn errors about the content of a file into errors that name the file as damaged."""
    try:
        yield
    except _MissingTensorError as missing:
        raise ValueError(f"{path} is damaged: the tensor {missing.args[0]!r} is missing") from None
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {type(error).__name__}: {error}") from error


# ---- writing


def _distinct_meshes(scene: Scene) -> list[TetMesh]:
    """Every mesh once, although bodies may share it."""
    return list({id(solid.mesh): solid.mesh for solid in scene.solids}.values())


def _mesh_arrays(mesh: TetMesh) -> dict[str, NDArray[Any]]:
    arrays = {"vertices": mesh.vertices, "tets": mesh.tets}
    optional = {"fill": mesh.fill, "regions": mesh.regions}
    arrays.update({name: array for name, array in optional.items() if array is not None})
    if mesh.embedding is not None:
        surface = mesh.embedding.surface
        arrays["embedding.tets"] = mesh.embedding.tets
        arrays["embedding.weights"] = mesh.embedding.weights
        arrays["surface.vertices"] = surface.vertices
        arrays["surface.triangles"] = surface.triangles
        if surface.uvs is not None:
            arrays["surface.uvs"] = surface.uvs
    return arrays


def _fields(part: Part) -> dict[str, Any]:
    kind = next(kind for kind in _KINDS.values() if isinstance(part, kind))  # a body of patches as the Solid it is
    return {field.name: getattr(part, field.name) for field in dataclasses.fields(kind)}


def _part_arrays(part: Part) -> dict[str, NDArray[Any]]:
    """The fields of a part that are arrays; those of a surface by its name and theirs."""
    arrays = {}
    for name, value in _fields(part).items():
        if isinstance(value, np.ndarray):
            arrays[name] = value
        elif isinstance(value, TriMesh):
            own = {"vertices": value.vertices, "triangles": value.triangles, "uvs": value.uvs}
            arrays.update({f"{name}.{key}": array for key, array in own.items() if array is not None})
        elif isinstance(value, Plastic):
            own = {field.name: getattr(value, field.name) for field in dataclasses.fields(Plastic)}
            arrays.update({f"{name}.{key}": array for key, array in own.items() if array is not None})
    return arrays


def _part_record(part: Part, scene: Scene, meshes: list[TetMesh]) -> Record:
    """The fields of a part that are no arrays: numbers and None as they are, other parts and meshes by number."""

    def number_of(part: Any) -> int:
        return next(number for number, other in enumerate(scene.parts) if other is part)

    record: Record = {"kind": next(name for name, kind in _KINDS.items() if isinstance(part, kind))}
    for name, value in _fields(part).items():
        if isinstance(value, TetMesh):
            record[name] = next(number for number, mesh in enumerate(meshes) if mesh is value)
        elif isinstance(value, Body):
            record["solid" if isinstance(part, Pin) else name] = number_of(value)
        elif isinstance(part, Pin) and name == "stiffness":
            record["hard"] = value is None
        elif isinstance(value, tuple):
            record[name] = [number_of(one) for one in value]
        elif isinstance(value, Mapping):
            record[name] = [[number_of(one), number_of(other), item] for (one, other), item in value.items()]
        elif value is None or isinstance(value, bool | int | float | str):
            record[name] = value
    return record


def _tensors(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Iterator[tuple[str, Tensor]]:
    for name, array in arrays.items():
        yield f"{prefix}.{name}", torch.tensor(array, device="cpu")


# ---- reading


class _MissingTensorError(Exception):
    """The metadata names a tensor that the file lacks."""


class _Tensors:
    """The tensors of a file, by name."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self._tensors = tensors

    def has(self, name: str) -> bool:
        return name in self._tensors

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._tensors:
            raise _MissingTensorError(name)
        return self._tensors[name]

    def array(self, name: str) -> NDArray[Any]:
        """A copy, because tensors may be mapped into the file, which may be overwritten later."""
        return self[name].numpy().copy()


def _read(path: Path) -> tuple[Record, _Tensors]:
    if not path.is_file():
        raise FileNotFoundError(f"no such simulation file: {path}")
    try:
        with safe_open(path, framework="pt") as file:
            record = _record(path, file.metadata())
            return record, _Tensors({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is not a simulation: not a safetensors file ({error})") from None


def _record(path: Path, metadata: Mapping[str, str] | None) -> Record:
    if not metadata or _KEY not in metadata:
        raise ValueError(f"{path} is not a simulation that Simulator.save wrote: its metadata has no {_KEY!r}")
    try:
        record = json.loads(metadata[_KEY])
        version = int(record["format"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: its metadata {_KEY!r} cannot be read ({error})") from None
    if version > FORMAT_VERSION:
        writer = record.get("written_by", "a newer torchpd")
        raise ValueError(
            f"{path} has format {version}, written by {writer}; torchpd {__version__} reads formats up to "
            f"{FORMAT_VERSION}: install a newer torchpd"
        )
    return dict(record)


def _saved(record: Record, tensors: _Tensors) -> SavedSimulation:
    choice = dict(record.get("choice") or {})
    former = choice.pop("batch", 1)  # older files have the batch here
    meshes = [_mesh(number, mesh, tensors) for number, mesh in enumerate(record["meshes"])]
    settings = {
        "time_step": record["time_step"],
        "iterations": record["iterations"],
        "solver": _solver(record["solver"]),
        "dtype": _DTYPES[record["dtype"]],
        "tolerance": record["tolerance"],
        "kernel": record.get("kernel", "auto"),  # older files have no kernel
        "batch": record.get("batch", former if former > 1 else None),
        "adjoint": record.get("adjoint", "solver"),
    }
    # arrays that the file lacks keep the scene's values
    material = {name: tensors[f"material.{name}"] for name in record.get("material", _FIRST_ARRAYS)}
    if "pin_stiffness" in material:
        material.setdefault(PIN_HARD, material["pin_stiffness"].isinf())
    reference = None
    if isinstance(settings["solver"], Multilevel | Newton) or settings["adjoint"] == "multilevel":
        stiffness, inertia = (tensors[f"solver.{name}"] for name in _REFERENCE)
        reference = stiffness, inertia
    return SavedSimulation(
        scene=Scene(*_parts(record["parts"], meshes, tensors)),
        settings=settings,
        named_iterations=record.get("named_iterations", True),  # absent in older files
        choice=Choice(**choice) if choice else None,
        material=material,
        contact={name: tensors[name] for name in record.get("contact", ())},  # absent in older files
        parameters=record.get("parameters", []),
        trained=record["trained"],
        reference=reference,
    )


def _solver(record: Record) -> Solver:
    return _SOLVERS[record["kind"]](**{name: value for name, value in record.items() if name != "kind"})


def _mesh(number: int, record: Record, tensors: _Tensors) -> TetMesh:
    prefix = f"mesh.{number}"
    fill, regions = (
        tensors.array(f"{prefix}.{name}") if tensors.has(f"{prefix}.{name}") else None for name in ("fill", "regions")
    )
    mesh = without_face_checks(tensors.array(f"{prefix}.vertices"), tensors.array(f"{prefix}.tets"), fill, regions)
    # tets that were flipped when the mesh was made are upright in the file
    set_frozen(mesh, flipped=record["flipped"])
    if not tensors.has(f"{prefix}.embedding.tets"):
        return mesh
    surface = _surface(f"{prefix}.surface", tensors)
    tets = tensors.array(f"{prefix}.embedding.tets")
    weights = tensors.array(f"{prefix}.embedding.weights")
    return mesh.with_embedding(Embedding(surface, tets, weights, mesh.tets[tets], len(mesh.vertices)))


def _surface(prefix: str, tensors: _Tensors) -> TriMesh:
    uvs = tensors.array(f"{prefix}.uvs") if tensors.has(f"{prefix}.uvs") else None
    return TriMesh(tensors.array(f"{prefix}.vertices"), tensors.array(f"{prefix}.triangles"), uvs=uvs)


def _parts(records: list[Record], meshes: list[TetMesh], tensors: _Tensors) -> list[Part]:
    """The parts in their order; a pin, a spring or contact may come before its body."""
    parts: dict[int, Part] = {}
    for bodies in (True, False):
        for number, record in enumerate(records):
            if issubclass(_KINDS[record["kind"]], Body | Collider) == bodies:
                parts[number] = _part(number, record, meshes, parts, tensors)
    return [parts[number] for number in range(len(records))]


def _part(number: int, record: Record, meshes: list[TetMesh], parts: Mapping[int, Part], tensors: _Tensors) -> Part:
    kind = _KINDS[record["kind"]]
    fields = {name: value for name, value in record.items() if name not in ("kind", "hard")}
    if kind is Contact:
        return _contact(fields, parts)
    if kind is Solid:
        fields["mesh"] = meshes[record["mesh"]]
    if kind is Pin:
        fields["body"] = fields.pop("solid")
    for name in _BODIES.intersection(fields):
        fields[name] = parts[fields[name]]
    for field in dataclasses.fields(kind):
        if field.name in fields or (field.name == "stiffness" and record.get("hard", False)):
            continue
        whole = f"part.{number}.{field.name}"
        if tensors.has(f"{whole}.triangles"):
            fields[field.name] = _surface(whole, tensors)
        elif tensors.has(f"{whole}.yield_strain"):
            names = [one.name for one in dataclasses.fields(Plastic) if tensors.has(f"{whole}.{one.name}")]
            fields[field.name] = Plastic(**{name: tensors.array(f"{whole}.{name}") for name in names})
        elif tensors.has(whole) or field.name not in _LATER:
            fields[field.name] = tensors.array(whole)
    part: Part = kind(**fields)
    if isinstance(part, Ground):
        # normalising again might change the last bit
        set_frozen(part, normal=fields["normal"])
    return part


def _contact(fields: Record, parts: Mapping[int, Part]) -> Part:
    bodies: list[Any] = [parts[number] for number in fields.pop("bodies")]
    for name, value in fields.items():
        if isinstance(value, list):
            fields[name] = [parts[number] for number in value] if name == "self_contact" else {
                (parts[one], parts[other]): item for one, other, item in value
            }  # fmt: skip
    return Contact(*bodies, **fields)
