"""A small sound file, or several, of every format that is announced."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np
import trimesh

from torchpd import TetMesh, TriMesh
from torchpd.formats.registry import FORMATS
from torchpd.geometry import shapes

__all__ = ["Seed", "make_seeds"]

CELLS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [2, 0, 0]])


class Seed(NamedTuple):
    """A file, the class that reads it, and the files beside it that belong to it."""

    path: Path
    kind: type[TetMesh] | type[TriMesh]
    beside: tuple[Path, ...] = ()


def make_seeds(folder: Path) -> list[Seed]:
    """Files in subfolders of a folder; formats whose package is not installed are left out."""
    seeds: list[Seed] = []
    for number, suffix in enumerate(FORMATS):
        place = folder / f"{number}{suffix}"
        place.mkdir()
        seeds += _of_format(place, suffix)
    return seeds


def _of_format(place: Path, suffix: str) -> list[Seed]:
    surface = trimesh.creation.box((1.0, 2.0, 3.0))
    if suffix in (".obj", ".ply", ".stl", ".off", ".glb", ".gltf"):
        return _surfaces(place, suffix, surface)
    if suffix == ".3mf":
        return [Seed(_package(place / "a.3mf"), TriMesh)]
    if suffix.startswith(".usd"):
        return _stages(place, suffix)
    if suffix in (".vtk", ".vtu", ".msh", ".inp"):
        return _mixed(place, suffix) + _volumes(place, suffix)
    if suffix in _TEXTS:
        path = place / f"a{suffix}"
        path.write_text(_TEXTS[suffix])
        for name, text in _BESIDE.get(suffix, {}).items():
            (place / name).write_text(text)
        kind = TriMesh if suffix in (".vtp", ".pvtp", ".dae") else TetMesh
        return [Seed(path, kind, tuple(place / name for name in _BESIDE.get(suffix, {})))]
    return _volumes(place, suffix)


def _surfaces(place: Path, suffix: str, surface: trimesh.Trimesh) -> list[Seed]:
    if suffix == ".gltf":
        files = trimesh.exchange.gltf.export_gltf(surface)
        for name, data in files.items():
            (place / name).write_bytes(data)
        (place / "model.gltf").rename(place / "a.gltf")
        return [Seed(place / "a.gltf", TriMesh, tuple(place / name for name in files if name.endswith(".bin")))]
    surface.export(place / f"a{suffix}")
    if suffix == ".ply":
        (place / "b.ply").write_bytes(trimesh.exchange.ply.export_ply(surface, encoding="ascii"))
        mixed = b"".join(bytes([n]) + np.arange(n, dtype="<i4").tobytes() for n in (3, 4, 5))
        head = "ply\nformat binary_little_endian 1.0\nelement vertex 8\nproperty float x\nproperty float y\n"
        head += "property float z\nelement face 3\nproperty list uchar int vertex_indices\nend_header\n"
        (place / "c.ply").write_bytes(head.encode() + surface.vertices.astype("<f4").tobytes() + mixed)
    if suffix == ".stl":
        surface.export(place / "b.stl", file_type="stl_ascii")
    if suffix == ".obj":
        (place / "b.obj").write_text(
            "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 -2/3 -1/-1\n"
        )
    return [Seed(path, TriMesh) for path in sorted(place.iterdir())]


def _package(path: Path) -> Path:
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("_rels/.rels", f'<R><Relationship Target="/3D/a.model" Type="{kind}"/></R>')
        archive.writestr("3D/a.model", _MODEL)
    return path


def _stages(place: Path, suffix: str) -> list[Seed]:
    try:
        from pxr import Gf, Usd, UsdGeom, UsdUtils
    except ImportError:
        return []
    stage = Usd.Stage.CreateInMemory()
    mesh = UsdGeom.Mesh.Define(stage, "/top/mesh")
    mesh.CreatePointsAttr([tuple(point) for point in CELLS])
    mesh.CreateFaceVertexCountsAttr([4, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 3, 2, 1, 4, 5, 6])
    mesh.AddTranslateOp().Set((1, 2, 3))
    tets = UsdGeom.TetMesh.Define(stage, "/top/tets")
    tets.CreatePointsAttr([tuple(CELLS[k]) for k in (0, 1, 3, 4)])
    tets.CreateTetVertexIndicesAttr([Gf.Vec4i(0, 1, 2, 3)])
    path = place / f"a{suffix}"
    layer = place / "layer.usdc" if suffix == ".usdz" else path
    stage.GetRootLayer().Export(str(layer))
    if suffix == ".usdz":
        UsdUtils.CreateNewUsdzPackage(str(layer), str(path))
        layer.unlink()
    return [Seed(path, TriMesh), Seed(path, TetMesh)]


def _volumes(place: Path, suffix: str) -> list[Seed]:
    """What this package writes itself, from which it reads tets again."""
    box = shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    mesh = TetMesh(box.vertices, box.tets, regions=np.arange(len(box.tets)) % 2 + 1)
    path = place / ("a.b8.ugrid" if suffix == ".ugrid" else f"a{suffix}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mesh.to_file(path)
        except ModuleNotFoundError:
            return []
    files = sorted(place.glob(f"{path.stem.partition('.')[0]}.*"))
    return [Seed(path, TetMesh, tuple(file for file in files if file != path))]


def _mixed(place: Path, suffix: str) -> list[Seed]:
    """Cells of several kinds, in the versions and encodings that meshio writes."""
    blocks = [
        ("tetra", [[1, 2, 6, 8]]),
        ("hexahedron", [np.arange(8)]),
        ("triangle", [[0, 1, 2]]),
        ("quad", [[4, 5, 6, 7]]),
    ]
    mesh = meshio.Mesh(CELLS, blocks)
    ways: dict[str, dict[str, object]] = {
        ".vtk": {"vtk": {"binary": True}, "vtk42": {"binary": False}, "vtk51": {"binary": False}},
        ".vtu": {"vtu": {"binary": True, "compression": "zlib"}, "vtu ": {"binary": False}},
        ".msh": {"gmsh22": {"binary": False}, "gmsh": {"binary": True}},
        ".inp": {"abaqus": {}},
    }[suffix]
    seeds = []
    for number, (name, options) in enumerate(ways.items()):
        path = place / f"mixed{number}{suffix}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            chosen = meshio.Mesh(CELLS, blocks[:1]) if name == "gmsh" else mesh  # of which meshio writes one kind only
            meshio.write(path, chosen, file_format=name.strip(), **options)
        seeds.append(Seed(path, TetMesh, tuple(sorted(set(place.glob(f"mixed{number}*")) - {path}))))
    return seeds


_POINTS = "0 0 0 1 0 0 0 1 0 0 0 1"
_XDMF = (
    '<Xdmf Version="3.0"><Domain><Grid Name="a"><Geometry GeometryType="XYZ"><DataItem DataType="Float" Precision="8" '
    f'Dimensions="4 3" Format="XML">{_POINTS}</DataItem></Geometry><Topology TopologyType="Tetrahedron" '
    'NumberOfElements="1" NodesPerElement="4"><DataItem DataType="Int" Precision="8" Dimensions="1 4" Format="XML">'
    "0 1 2 3</DataItem></Topology></Grid></Domain></Xdmf>"
)
_MODEL = (
    '<model unit="meter"><resources><object id="1"><mesh><vertices><vertex x="0" y="0" z="0"/>'
    '<vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>'
    '</resources><build><item objectid="1" transform="1 0 0 0 1 0 0 0 1 5 6 7"/></build></model>'
)
_ARRAY = '<DataArray type="Float64" NumberOfComponents="3" format="ascii">{}</DataArray>'
_XML = '<VTKFile type="{}" version="1.0" byte_order="LittleEndian">{}</VTKFile>\n'
_TEXTS = {
    ".dae": '<COLLADA xmlns="c"><asset><unit meter="1"/></asset><library_geometries><geometry id="g"><mesh>'
    f'<source id="p"><float_array count="12">{_POINTS}</float_array><technique_common><accessor count="4" stride="3"/>'
    '</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
    '<polylist count="2"><input semantic="VERTEX" source="#v" offset="0"/><vcount>4 3</vcount><p>0 1 2 3 0 1 2</p>'
    '</polylist></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
    '<translate>1 2 3</translate><rotate>0 0 1 90</rotate><instance_geometry url="#g"/></node></visual_scene>'
    '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>',
    ".xdmf": _XDMF,
    ".xmf": _XDMF,
    ".tet": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nt 0 1 2 3\n",
    ".fem": "BEGIN BULK\nGRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,3,,0.,1.,0.\nGRID,4,,0.,0.,1.\n"
    "CTETRA,1,1,1,2,3,4\nENDDATA\n",
    ".vtp": _XML.format(
        "PolyData",
        '<PolyData><Piece NumberOfPoints="4" NumberOfPolys="1"><Points>' + _ARRAY.format(_POINTS) + "</Points><Polys>"
        '<DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3</DataArray>'
        '<DataArray type="Int64" Name="offsets" format="ascii">4</DataArray></Polys></Piece></PolyData>',
    ),
    ".pvtp": _XML.format("PPolyData", '<PPolyData><Piece Source="a.vtp"/></PPolyData>'),
    ".pvtu": _XML.format("PUnstructuredGrid", '<PUnstructuredGrid><Piece Source="a.vtu"/></PUnstructuredGrid>'),
}
_VTU = _XML.format(
    "UnstructuredGrid",
    '<UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="1"><Points>'
    + _ARRAY.format(_POINTS)
    + "</Points><Cells>"
    '<DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3</DataArray>'
    '<DataArray type="Int64" Name="offsets" format="ascii">4</DataArray>'
    '<DataArray type="UInt8" Name="types" format="ascii">10</DataArray></Cells></Piece></UnstructuredGrid>',
)
_BESIDE = {".pvtp": {"a.vtp": _TEXTS[".vtp"]}, ".pvtu": {"a.vtu": _VTU}}
