"""Moving surfaces as files that common viewers play, and pictures as films.

Lengths in m, y up, times in s, colours linear RGB in 0..1, images uint8 [H, W, 3].
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .checks import as_array, check_finite, check_scalar, check_shape
from .shading import SmoothSurface

__all__ = ["write_film", "write_surface"]

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Color = tuple[float, float, float]

_ROUGHNESS = 0.4
_DITHER = 6.0  # of 255: about what separates neighbouring colours of a palette made for a smooth background
_GLTF_FLOAT, _GLTF_UINT = 5126, 5125
_GLTF_VERTICES, _GLTF_INDICES = 34962, 34963


def write_surface(
    path: str | Path,
    frames: Any,
    triangles: Any,
    *,
    frames_per_second: float,
    color: Color = (0.72, 0.10, 0.04),
    keyframes: int = 61,
) -> Path:
    """Write a moving surface; the ending of `path` decides the format.

    `.usdc`, `.usda`, `.usd`: points with one time sample per frame (Blender, Houdini, usdview, Omniverse); needs
    usd-core. `.glb`: glTF morph targets, one per key frame and linear in between (browsers, Blender); every key
    frame takes 24 bytes per vertex, so a long motion is thinned out to `keyframes` of its frames.

    Args:
        path: of the file; an existing one is replaced, a folder that is missing is made.
        frames: [T, n, 3] positions.
        triangles: [m, 3] vertex numbers.
        frames_per_second: of `frames`, in simulated time.
        color: of the surface.
        keyframes: most key frames that a .glb may hold, at least 2.
    """
    target = _output(path, (".usdc", ".usda", ".usd", ".glb"))
    motion = as_array("frames", frames, np.float64, for_picture=True)
    if motion.ndim == 4:
        raise ValueError(
            f"frames must be [n, n, 3] (positions [m] in every frame), got {list(motion.shape)}, those of several "
            "environments; choose one: frames[:, 0]"
        )
    check_shape("frames", motion, (None, None, 3), "positions [m] in every frame")
    check_finite("frames", motion)
    rate = check_scalar("frames_per_second", frames_per_second)
    if len(motion) == 0 or rate <= 0.0 or keyframes < 2:
        raise ValueError(
            "write_surface needs at least one frame, frames_per_second > 0 and keyframes >= 2, "
            f"got {len(motion)}, {rate} and {keyframes}"
        )
    surface = SmoothSurface(motion[0], triangles)
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.suffix.lower() == ".glb":
        chosen = np.unique(np.linspace(0, len(motion) - 1, min(keyframes, len(motion))).round().astype(int))
        target.write_bytes(_glb(surface, motion[chosen], chosen / rate, color))
    else:
        _write_usd(target, surface, motion, rate, color)
    return target


def write_film(path: str | Path, images: Sequence[Picture], *, frames_per_second: float) -> Path:
    """Write pictures as a film: `.gif` (needs Pillow; plays for ever) or `.mp4` (H.264; needs imageio-ffmpeg).

    Args:
        path: of the file; an existing one is replaced, a folder that is missing is made.
        images: of one size.
        frames_per_second: of the film.
    """
    target = _output(path, (".gif", ".mp4"))
    rate = check_scalar("frames_per_second", frames_per_second)
    if len(images) == 0 or any(image.shape != images[0].shape for image in images):
        raise ValueError("images must be at least one, all of one size")
    if rate <= 0.0:
        raise ValueError(f"frames_per_second must be positive, got {rate}")
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.suffix.lower() == ".gif":
        _write_gif(target, images, rate)
    else:
        _write_mp4(target, images, rate)
    return target


def _output(path: str | Path, endings: tuple[str, ...]) -> Path:
    target = Path(path)
    if target.suffix.lower() not in endings:
        raise ValueError(f"path must end in {', '.join(endings)}, got {target.name}")
    return target


def _write_usd(path: Path, surface: SmoothSurface, motion: Array, rate: float, color: Color) -> None:
    """One mesh with time-sampled points, normals and extent; one time code per frame."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt
    except ImportError:
        raise ModuleNotFoundError("USD files need usd-core: pip install torchpd[demo]") from None
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(motion) - 1)
    root = UsdGeom.Xform.Define(stage, "/Scene")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/Scene/Body")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(surface.triangles), 3, dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.triangles.astype(np.int32).ravel()))
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*color)])
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
    for time, positions in enumerate(surface.split(motion)):
        points.Set(Vt.Vec3fArray.FromNumpy(positions.astype(np.float32)), time)
        normals.Set(Vt.Vec3fArray.FromNumpy(surface.normals(positions).astype(np.float32)), time)
        corners = np.stack([positions.min(axis=0), positions.max(axis=0)])
        extent.Set(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)), time)

    material = UsdShade.Material.Define(stage, "/Scene/Plastic")
    shader = UsdShade.Shader.Define(stage, "/Scene/Plastic/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(_ROUGHNESS)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError(f"usd-core cannot write {path}")


class _GlbBuffer:
    """The binary chunk of a .glb, with the views and accessors that describe it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Append numbers, [n] or [n, 3]; the number of their accessor."""
        kind, code = (np.uint32, _GLTF_UINT) if array.dtype.kind in "iu" else (np.float32, _GLTF_FLOAT)
        values = np.ascontiguousarray(array, dtype=kind)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": code,
            "count": len(values),
            "type": "VEC3" if values.ndim == 2 else "SCALAR",
        }
        if target is not None:
            view["target"] = target
        if bounds:
            accessor["min"] = np.atleast_1d(values.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(values.max(axis=0)).tolist()
        self.data += values.tobytes()
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_shape(self, positions: Array, normals: Array) -> dict[str, int]:
        return {
            "POSITION": self.add(positions, target=_GLTF_VERTICES, bounds=True),
            "NORMAL": self.add(normals, target=_GLTF_VERTICES),
        }


def _glb(surface: SmoothSurface, motion: Array, times: Array, color: Color) -> bytes:
    """A binary glTF 2.0: the first key frame is the shape, each later one a morph target of differences to it."""
    buffer = _GlbBuffer()
    shapes = surface.split(motion)
    first, first_normals = shapes[0], surface.normals(shapes[0])
    primitive: dict[str, Any] = {
        "indices": buffer.add(surface.triangles.reshape(-1), target=_GLTF_INDICES),
        "attributes": buffer.add_shape(first, first_normals),
        "material": 0,
    }
    mesh: dict[str, Any] = {"name": "body", "primitives": [primitive]}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "torchpd"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "body", "mesh": 0}],
        "meshes": [mesh],
        "materials": [
            {
                "name": "plastic",
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*color, 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": _ROUGHNESS,
                },
            }
        ],
    }
    if len(shapes) > 1:
        primitive["targets"] = [
            buffer.add_shape(shape - first, surface.normals(shape) - first_normals) for shape in shapes[1:]
        ]
        mesh["weights"] = [0.0] * (len(shapes) - 1)
        # at key frame k target k - 1 alone counts; linear weights in between are linear positions
        weights = np.eye(len(shapes))[:, 1:]
        sampler = {
            "input": buffer.add(times, bounds=True),
            "output": buffer.add(weights.reshape(-1)),
            "interpolation": "LINEAR",
        }
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        document["animations"] = [{"name": "motion", "samplers": [sampler], "channels": [channel]}]
    document["bufferViews"], document["accessors"] = buffer.views, buffer.accessors
    document["buffers"] = [{"byteLength": len(buffer.data)}]

    # container: magic, version, length, then the chunks JSON (padded by spaces) and BIN, both of whole words
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(buffer.data)
    header = struct.pack("<4sII", b"glTF", 2, length)
    return b"".join(
        [header, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(buffer.data), b"BIN\0"),
         bytes(buffer.data)]
    )  # fmt: skip


def _write_gif(path: Path, images: Sequence[Picture], rate: float) -> None:
    """One palette for all frames, from a dozen of them: separate palettes flicker."""
    try:
        from PIL import Image
    except ImportError:
        raise ModuleNotFoundError("GIF files need Pillow: pip install torchpd[demo]") from None
    sample = np.concatenate(images[:: max(1, len(images) // 12)])
    palette = Image.fromarray(sample).quantize(256, method=Image.Quantize.MEDIANCUT)
    pictures = [Image.fromarray(_dither(image)).quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # GIF counts time in 1/100 s: rounding the instants instead of the delays keeps the whole film in time
    instants = np.round(np.arange(len(images) + 1) * 100.0 / rate)
    delays = (10 * np.maximum(np.diff(instants), 2)).astype(int).tolist()  # browsers slow down a delay below 2
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=delays, loop=0, optimize=False)


def _dither(image: Picture) -> Picture:
    """Adds one fine pattern to every frame, which hides the steps of the palette; error diffusion would shimmer."""
    bayer = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16.0 - 15.0 / 32.0
    height, width = image.shape[:2]
    pattern = np.tile(bayer, (-(-height // 4), -(-width // 4)))[:height, :width, None]
    return np.clip(np.round(image + _DITHER * pattern), 0, 255).astype(np.uint8)


def _write_mp4(path: Path, images: Sequence[Picture], rate: float) -> None:
    """H.264 with halved chroma, which every browser plays; an odd last row or column is left out for it."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise ModuleNotFoundError("MP4 files need imageio-ffmpeg: pip install torchpd[demo]") from None
    height, width = (length - length % 2 for length in images[0].shape[:2])
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=rate, codec="libx264", quality=8, macro_block_size=1, pix_fmt_out="yuv420p"
    )
    writer.send(None)
    for image in images:
        writer.send(np.ascontiguousarray(image[:height, :width]))
    writer.close()
