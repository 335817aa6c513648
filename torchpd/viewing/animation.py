"""Write moving surfaces for common viewers, and pictures as films.

Lengths in m, y up, times in s, colours linear RGB in 0..1, images uint8 [H, W, 3].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_scalar, check_shape, optional_module
from .shading import SmoothSurface

__all__ = ["write_film", "write_surface"]

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Color = tuple[float, float, float]

_ROUGHNESS = 0.4
# One palette for all frames, since separate ones flicker. An ordered dither pattern hides its steps; error diffusion
# would shimmer.
_PALETTE = "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=bayer:bayer_scale=4"
# by suffix: factor of the picture's sides, largest frame rate [1/s], and options for ffmpeg
_FILMS: dict[str, tuple[int, float, dict[str, Any]]] = {
    ".gif": (1, 50.0, {"codec": "gif", "pix_fmt_out": "pal8", "output_params": ["-filter_complex", _PALETTE]}),
    ".mp4": (2, math.inf, {"codec": "libx264", "pix_fmt_out": "yuv420p", "quality": 8}),  # every browser plays it
}


def write_surface(
    path: str | Path,
    frames: Any,
    triangles: Any,
    *,
    frames_per_second: float,
    color: Color = (0.72, 0.10, 0.04),
    keyframes: int = 61,
) -> Path:
    """Write a moving surface; the suffix of `path` decides the format.

    `.usdc`, `.usda`, `.usd`: points with one time sample per frame (Blender, Houdini, usdview, Omniverse); needs
    usd-core. `.glb`: glTF morph targets, one per key frame and linear in between (browsers, Blender); needs pygltflib.
    Every key frame takes 24 bytes per vertex, so a long motion is thinned to `keyframes` of its frames.

    Args:
        path: the file; an existing one is replaced, a missing folder is created.
        frames: [T, n, 3] positions [m].
        triangles: [m, 3] vertex numbers.
        frames_per_second: frame rate of `frames` in simulated time [1/s].
        color: of the surface.
        keyframes: most key frames in a .glb, at least 2.
    """
    target = _output(path, (".usdc", ".usda", ".usd", ".glb"))
    motion = as_array("frames", frames, np.float64, for_picture=True)
    if motion.ndim == 4:
        raise ValueError(
            f"frames must be [n, n, 3], positions [m] of one environment in every frame, got {list(motion.shape)}; "
            "choose one environment: frames[:, 0]"
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
        _write_glb(target, surface, motion[chosen], chosen / rate, color)
    else:
        _write_usd(target, surface, motion, rate, color)
    return target


def write_film(path: str | Path, images: Sequence[Picture], *, frames_per_second: float) -> Path:
    """Write pictures as a film: `.gif`, which repeats, or `.mp4` (H.264). Needs imageio-ffmpeg.

    Args:
        path: the file; an existing one is replaced, a missing folder is created.
        images: pictures of one size; an .mp4 drops an odd last row or column.
        frames_per_second: frame rate of the film; a .gif plays at most 50, since browsers slow down faster ones.
    """
    target = _output(path, tuple(_FILMS))
    rate = check_scalar("frames_per_second", frames_per_second)
    if len(images) == 0 or any(image.shape != images[0].shape for image in images):
        raise ValueError("images must be at least one, all of one size")
    if rate <= 0.0:
        raise ValueError(f"frames_per_second must be positive, got {rate}")
    ffmpeg = optional_module("imageio_ffmpeg", "imageio-ffmpeg", "films")
    target.parent.mkdir(parents=True, exist_ok=True)
    unit, most, options = _FILMS[target.suffix.lower()]
    height, width = (length - length % unit for length in images[0].shape[:2])
    writer = ffmpeg.write_frames(
        str(target), (width, height), fps=min(rate, most), macro_block_size=1, ffmpeg_log_level="error", **options
    )
    writer.send(None)
    for image in images:
        writer.send(np.ascontiguousarray(image[:height, :width]))
    writer.close()
    return target


def _output(path: str | Path, endings: tuple[str, ...]) -> Path:
    target = Path(path)
    if target.suffix.lower() not in endings:
        raise ValueError(f"path must end in {', '.join(endings)}, got {target.name}")
    return target


def _write_usd(path: Path, surface: SmoothSurface, motion: Array, rate: float, color: Color) -> None:
    """One mesh with time-sampled points, normals and extent; one time code per frame."""
    optional_module("pxr", "usd-core", "USD files")
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

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


def _write_glb(path: Path, surface: SmoothSurface, motion: Array, times: Array, color: Color) -> None:
    """A binary glTF 2.0: the first key frame is the shape, each later one a morph target of differences to it."""
    gltf = optional_module("pygltflib", "pygltflib", "glTF files")
    data = bytearray()
    views: list[Any] = []
    accessors: list[Any] = []

    def add(array: NDArray[Any], target: int | None = None) -> int:
        """Append an array [n] or [n, 3] to the buffer; returns the index of its accessor."""
        kind, code = (np.uint32, gltf.UNSIGNED_INT) if array.dtype.kind in "iu" else (np.float32, gltf.FLOAT)
        values = np.ascontiguousarray(array, dtype=kind)
        bounds = {name: np.atleast_1d(end).tolist() for name, end in (("min", values.min(0)), ("max", values.max(0)))}
        shape = gltf.VEC3 if values.ndim == 2 else gltf.SCALAR
        accessors.append(
            gltf.Accessor(bufferView=len(views), componentType=code, count=len(values), type=shape, **bounds)
        )
        views.append(gltf.BufferView(buffer=0, byteOffset=len(data), byteLength=values.nbytes, target=target))
        data.extend(values.tobytes())
        return len(views) - 1

    def add_shape(positions: Array, normals: Array) -> Any:
        return gltf.Attributes(POSITION=add(positions, gltf.ARRAY_BUFFER), NORMAL=add(normals, gltf.ARRAY_BUFFER))

    shapes = surface.split(motion)
    normals = [surface.normals(shape) for shape in shapes]
    body = gltf.Primitive(
        indices=add(surface.triangles.reshape(-1), gltf.ELEMENT_ARRAY_BUFFER),
        attributes=add_shape(shapes[0], normals[0]),
        targets=[add_shape(x - shapes[0], n - normals[0]) for x, n in zip(shapes[1:], normals[1:], strict=True)],
        material=0,
    )
    plastic = gltf.PbrMetallicRoughness(baseColorFactor=[*color, 1.0], metallicFactor=0.0, roughnessFactor=_ROUGHNESS)
    document = gltf.GLTF2(
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[gltf.Node(mesh=0)],
        meshes=[gltf.Mesh(primitives=[body], weights=[0.0] * (len(shapes) - 1))],
        materials=[gltf.Material(pbrMetallicRoughness=plastic, doubleSided=True, alphaCutoff=None)],
    )
    if len(shapes) > 1:
        # at key frame k only target k - 1 has weight; linear weights in between give linear positions
        sampler = gltf.AnimationSampler(input=add(times), output=add(np.eye(len(shapes))[:, 1:].reshape(-1)))
        target = gltf.AnimationChannelTarget(node=0, path="weights")
        channel = gltf.AnimationChannel(sampler=0, target=target)
        document.animations = [gltf.Animation(samplers=[sampler], channels=[channel])]
    document.bufferViews, document.accessors = views, accessors
    document.buffers = [gltf.Buffer(byteLength=len(data))]
    document.set_binary_blob(bytes(data))
    document.save_binary(path)
