"""Files of moving surfaces and films: what is read back is what was written."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pygltflib
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from pxr import Usd, UsdGeom

from torchpd.viewing.animation import write_film, write_surface
from torchpd.viewing.shading import SmoothSurface

Array = NDArray[np.float64]


def _motion(count: int) -> tuple[Array, NDArray[np.int64]]:
    """A box that shears and rises."""
    box = trimesh.creation.box()
    time = np.arange(count)[:, None, None] / 10.0
    frames = (
        np.asarray(box.vertices) + time * np.asarray(box.vertices)[:, :1] * [0.0, 1.0, 0.0] + time * [0.0, 0.0, 1.0]
    )
    return frames, np.asarray(box.faces)


def _numbers(document: pygltflib.GLTF2, accessor: int) -> NDArray[Any]:
    """The values of an accessor, straight from the binary chunk."""
    info = document.accessors[accessor]
    view = document.bufferViews[info.bufferView]
    kind = {5126: np.float32, 5125: np.uint32}[info.componentType]
    blob = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    values = np.frombuffer(blob, dtype=kind)
    assert values.size == info.count * {"SCALAR": 1, "VEC3": 3}[info.type]
    return values.reshape(-1, 3) if info.type == "VEC3" else values


@pytest.mark.parametrize("ending", [".usdc", ".usda", ".usd"])
def test_usd_holds_every_frame(tmp_path: Path, ending: str) -> None:
    frames, triangles = _motion(7)
    path = write_surface(tmp_path / f"motion{ending}", frames, triangles, frames_per_second=24.0)
    stage = Usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 6.0, 24.0)
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Scene/Body"))
    valid, reason = UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), len(mesh.GetPointsAttr().Get(0))
    )
    assert valid, reason
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    for time, frame in enumerate(frames):
        points = np.array(mesh.GetPointsAttr().Get(time))
        assert np.array_equal(points[corners], frame[triangles].reshape(-1, 3).astype(np.float32))
        assert len(np.array(mesh.GetNormalsAttr().Get(time))) == len(points)
        low_high = np.array(mesh.GetExtentAttr().Get(time))
        assert np.array_equal(low_high, [points.min(axis=0), points.max(axis=0)])


def test_glb_plays_every_frame(tmp_path: Path) -> None:
    frames, triangles = _motion(5)
    path = write_surface(tmp_path / "motion.glb", frames, triangles, frames_per_second=20.0)
    document = pygltflib.GLTF2().load(str(path))
    primitive = document.meshes[0].primitives[0]
    corners = _numbers(document, primitive.indices)
    base = _numbers(document, primitive.attributes.POSITION)
    targets = np.stack([_numbers(document, target["POSITION"]) for target in primitive.targets])
    sampler = document.animations[0].samplers[0]
    times = _numbers(document, sampler.input)
    weights = _numbers(document, sampler.output).reshape(len(times), len(targets))
    assert np.allclose(times, np.arange(5) / 20.0, atol=1e-7)
    for frame, weight in zip(frames, weights, strict=True):
        shown = base + np.tensordot(weight, targets, axes=1)
        # a difference and a sum of float32 numbers below 2
        assert np.abs(shown[corners] - frame[triangles].reshape(-1, 3)).max() < 4 * np.finfo(np.float32).eps
    between = base + np.tensordot((weights[2] + weights[3]) / 2.0, targets, axes=1)
    assert np.allclose(between[corners], ((frames[2] + frames[3]) / 2.0)[triangles].reshape(-1, 3), atol=1e-6)


def test_glb_states_the_bounds_of_its_positions(tmp_path: Path) -> None:
    frames, triangles = _motion(3)
    document = pygltflib.GLTF2().load(
        str(write_surface(tmp_path / "motion.glb", frames, triangles, frames_per_second=20.0))
    )
    primitive = document.meshes[0].primitives[0]
    for accessor in (primitive.attributes.POSITION, *(target["POSITION"] for target in primitive.targets)):
        values, info = _numbers(document, accessor), document.accessors[accessor]
        assert np.array_equal(values.min(axis=0), np.float32(info.min))
        assert np.array_equal(values.max(axis=0), np.float32(info.max))
    assert all(view.byteOffset % 4 == 0 for view in document.bufferViews)


def test_glb_thins_out_a_long_motion(tmp_path: Path) -> None:
    frames, triangles = _motion(50)
    path = write_surface(tmp_path / "motion.glb", frames, triangles, frames_per_second=10.0, keyframes=8)
    document = pygltflib.GLTF2().load(str(path))
    times = _numbers(document, document.animations[0].samplers[0].input)
    assert len(times) == 8
    assert (times[0], times[-1]) == (0.0, np.float32(4.9))
    split = len(SmoothSurface(frames[0], triangles).source)
    assert path.stat().st_size < 8 * split * 24 + 20_000


def test_glb_of_one_frame_is_a_still_surface(tmp_path: Path) -> None:
    frames, triangles = _motion(1)
    path = write_surface(tmp_path / "still.glb", frames, triangles, frames_per_second=1.0)
    loaded = trimesh.load(path, force="mesh")
    assert loaded.volume == pytest.approx(1.0, abs=1e-6)
    assert not pygltflib.GLTF2().load(str(path)).animations


def _film(count: int, height: int, width: int) -> list[NDArray[np.uint8]]:
    """A grey ramp over which a red square walks."""
    ramp = np.tile(np.linspace(60, 200, width).astype(np.uint8)[None, :, None], (height, 1, 3))
    images = [ramp.copy() for _ in range(count)]
    for number, image in enumerate(images):
        image[4:12, 4 + 2 * number : 12 + 2 * number] = [220, 40, 30]
    return images


def test_gif_keeps_time_and_colours(tmp_path: Path) -> None:
    images = _film(8, 33, 47)
    path = write_film(tmp_path / "film.gif", images, frames_per_second=30.0)
    film = Image.open(path)
    assert film.info["loop"] == 0
    milliseconds = 0
    for number, image in enumerate(images):
        film.seek(number)
        milliseconds += film.info["duration"]
        # half a step of a palette of 256 colours, and a dither about as high
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - image).mean() < 5.0
    assert film.n_frames == 8
    assert abs(milliseconds - 8000 / 30) <= 10  # the unit of a delay: those of the frames are not rounded one by one


def test_mp4_holds_every_picture(tmp_path: Path) -> None:
    images = _film(6, 65, 81)
    path = write_film(tmp_path / "film.mp4", images, frames_per_second=25.0)
    reader = imageio_ffmpeg.read_frames(str(path))
    facts = next(reader)
    assert facts["size"] == (80, 64)
    assert facts["fps"] == 25.0
    pictures = [np.frombuffer(data, dtype=np.uint8).reshape(64, 80, 3) for data in reader]
    assert len(pictures) == 6
    for picture, image in zip(pictures, images, strict=True):
        assert np.abs(picture.astype(int) - image[:64, :80]).mean() < 10.0  # H.264 with halved chroma


@pytest.mark.parametrize(
    ("name", "module", "package"),
    [("a.usdc", "pxr", "usd-core"), ("a.glb", "pygltflib", "pygltflib"), ("a.mp4", "imageio_ffmpeg", "imageio-ffmpeg")],
)
def test_missing_packages_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    frames, triangles = _motion(2)
    with pytest.raises(ModuleNotFoundError, match=rf"{package}: pip install torchpd\[demo\]"):  # noqa: PT012
        if name in ("a.usdc", "a.glb"):
            write_surface(tmp_path / name, frames, triangles, frames_per_second=1.0)
        else:
            write_film(tmp_path / name, _film(2, 16, 32), frames_per_second=1.0)


def test_bad_requests_are_named(tmp_path: Path) -> None:
    frames, triangles = _motion(2)
    with pytest.raises(ValueError, match=r"path .*got motion\.fbx"):
        write_surface(tmp_path / "motion.fbx", frames, triangles, frames_per_second=1.0)
    with pytest.raises(ValueError, match="frames_per_second > 0"):
        write_surface(tmp_path / "motion.glb", frames, triangles, frames_per_second=0.0)
    with pytest.raises(ValueError, match=r"path .*got film\.avi"):
        write_film(tmp_path / "film.avi", _film(1, 16, 32), frames_per_second=1.0)
    with pytest.raises(ValueError, match="all of one size"):
        write_film(tmp_path / "film.gif", [], frames_per_second=1.0)
    with pytest.raises(ValueError, match=r"frames_per_second .*got -1\.0"):
        write_film(tmp_path / "film.gif", _film(1, 16, 32), frames_per_second=-1.0)


@pytest.mark.parametrize("ending", [".glb", ".usdc"])
def test_folders_that_are_missing_are_made(tmp_path: Path, ending: str) -> None:
    frames, triangles = _motion(2)
    path = write_surface(tmp_path / "a" / f"b{ending}", frames, triangles, frames_per_second=24.0)
    assert path.stat().st_size > 0


def test_films_make_their_folder(tmp_path: Path) -> None:
    picture = np.zeros((16, 16, 3), dtype=np.uint8)
    assert write_film(tmp_path / "a" / "b.gif", [picture, picture], frames_per_second=10.0).is_file()


def test_a_track_of_several_environments_is_told_to_choose(tmp_path: Path) -> None:
    frames, triangles = _motion(2)
    with pytest.raises(ValueError, match=r"frames .*\[2, 1, 8, 3\].*frames\[:, 0\]"):
        write_surface(tmp_path / "b.glb", frames[:, None], triangles, frames_per_second=24.0)
