"""Pictures: the camera sees the whole motion, surfaces appear where they are, the same input gives the same bits."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from torchpd.viewing.render import Camera, Studio, contact_sheet, frame_camera, render

Array = NDArray[np.float64]


def _ball(center: tuple[float, float, float], radius: float) -> tuple[Array, NDArray[np.int64]]:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return np.asarray(ball.vertices) + center, np.asarray(ball.faces)


def _in_picture(camera: Camera, points: Array, aspect: float) -> Array:
    """Coordinates in the picture [n, 2], its borders at -1 and 1."""
    forward = np.array(camera.target) - np.array(camera.origin)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    seen = points - np.array(camera.origin)
    slope = np.tan(np.radians(camera.fov) / 2.0) * (seen @ forward)
    return np.stack([seen @ right / (slope * aspect), seen @ np.cross(right, forward) / slope], axis=1)


def _reddish(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return image[..., 0] > image[..., 2].astype(int) + 20


@pytest.mark.parametrize(
    ("azimuth", "elevation", "aspect"), [(0.0, 0.0, 1.0), (25.0, 20.0, 4 / 3), (200.0, -60.0, 0.5)]
)
def test_camera_frames_all_points_tightly(azimuth: float, elevation: float, aspect: float) -> None:
    points = np.random.default_rng(1).normal(size=(200, 3)) * [3.0, 1.0, 0.5] + [10.0, 0.0, -4.0]
    camera = frame_camera(points, azimuth=azimuth, elevation=elevation, aspect=aspect, margin=0.1)
    extent = np.abs(_in_picture(camera, points, aspect)).max(axis=0)
    assert extent.max() == pytest.approx(0.8, abs=1e-9)  # 1 - 2 margin in the direction that decides


def test_camera_rays_pass_through_the_pixels() -> None:
    camera = Camera((1.0, 2.0, 5.0), (0.0, 0.5, 0.0), 30.0)
    rays = camera.rays((8, 6))
    places = _in_picture(camera, np.array(camera.origin) + 7.0 * rays.reshape(-1, 3), 8 / 6).reshape(6, 8, 2)
    columns, rows = (2.0 * np.arange(8) + 1.0) / 8 - 1.0, 1.0 - (2.0 * np.arange(6) + 1.0) / 6
    assert np.abs(places - np.stack(np.meshgrid(columns, rows), axis=2)).max() < 1e-12


def test_surface_appears_where_it_is() -> None:
    center = (0.4, 0.9, -0.2)
    vertices, triangles = _ball(center, 0.06)
    camera = Camera((1.0, 1.2, 4.0), (0.0, 0.5, 0.0), 30.0)
    image = render(vertices, triangles, camera=camera, size=(80, 60), samples=4)
    rows, columns = np.nonzero(_reddish(image))
    x, y = _in_picture(camera, np.array([center]), 80 / 60)[0]
    # the ball covers about four pixels across: the middle of its pixels is right to a good pixel
    assert abs(columns.mean() + 0.5 - 40.0 * (1.0 + x)) < 1.5
    assert abs(rows.mean() + 0.5 - 30.0 * (1.0 - y)) < 1.5


def test_picture_shows_light_shadow_and_colour_and_repeats() -> None:
    vertices, triangles = _ball((0.0, 0.5, 0.0), 0.5)
    studio = Studio(vertices, triangles, size=(96, 72), samples=4)
    image = studio.render(vertices)
    assert image.shape == (72, 96, 3)
    assert image.dtype == np.uint8
    body = _reddish(image)
    assert 0.1 < body.mean() < 0.7
    assert image[~body].std() > 5.0  # the floor carries a shadow and a gradient of light
    assert (image == 255).mean() < 0.01
    assert np.array_equal(image, studio.render(vertices))


def test_every_vertex_may_have_its_colour() -> None:
    """The left box is red, the right one blue, although their vertices are split at creases."""
    left, right = (trimesh.creation.box().apply_translation((x, 0.5, 0.0)) for x in (-0.7, 0.7))
    points, both = np.concatenate([left.vertices, right.vertices]), np.concatenate([left.faces, right.faces + 8])
    color = np.repeat([(0.8, 0.05, 0.05), (0.05, 0.05, 0.8)], 8, axis=0)
    camera = frame_camera(points, azimuth=0.0)
    image = render(points, both, color=color, camera=camera, size=(64, 48), samples=4).astype(int)
    more_red = image[..., 0] - image[..., 2]
    assert more_red[24, 20] > 60
    assert more_red[24, 44] < -60
    with pytest.raises(ValueError, match=r"color.*\[7, 3\]"):
        Studio(points, both, color=color[:7])


def test_floor_lies_below_the_lowest_vertex_of_all_frames() -> None:
    vertices, triangles = _ball((0.0, 0.5, 0.0), 0.5)
    assert Studio([vertices, vertices - [0.0, 0.25, 0.0]], triangles, ground=None).ground == pytest.approx(-0.25)


def test_variant_of_the_caller_comes_back() -> None:
    mitsuba = pytest.importorskip("mitsuba")
    vertices, triangles = _ball((0.0, 0.5, 0.0), 0.5)
    mitsuba.set_variant("scalar_spectral")
    render(vertices, triangles, size=(8, 6), samples=1)
    assert mitsuba.variant() == "scalar_spectral"
    mitsuba.set_variant("scalar_rgb")


def test_contact_sheet_places_every_image(tmp_path: Path) -> None:
    images = [np.full((20, 30, 3), 40 * number, dtype=np.uint8) for number in range(5)]
    sheet = contact_sheet(images, columns=3, gap=4, path=tmp_path / "sheet.png")
    assert sheet.shape == (2 * 24 + 4, 3 * 34 + 4, 3)
    for number, image in enumerate(images):
        top, left = 4 + number // 3 * 24, 4 + number % 3 * 34
        assert np.array_equal(sheet[top : top + 20, left : left + 30], image)
    assert (sheet[28:48, 72:102] == 255).all()  # no sixth image
    assert np.array_equal(np.asarray(Image.open(tmp_path / "sheet.png")), sheet)


def test_captions_are_written_into_the_images() -> None:
    images = [np.full((90, 120, 3), 200, dtype=np.uint8)] * 2
    sheet = contact_sheet(images, columns=2, captions=["", "0.50 s"])
    assert (sheet[8:98, 8:128] == 200).all()
    assert (sheet[60:98, 136:180] < 150).any()


def test_missing_mitsuba_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    vertices, triangles = _ball((0.0, 0.5, 0.0), 0.5)
    with pytest.raises(ModuleNotFoundError, match=r"pip install torchpd\[demo\]"):
        render(vertices, triangles)


def test_grain_is_filtered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error of four light paths per pixel is halved."""
    vertices, triangles = _ball((0.0, 0.5, 0.0), 0.5)
    many, few = (render(vertices, triangles, size=(96, 72), samples=samples) for samples in (144, 4))
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.warns(UserWarning, match="pip install pyoidn"):
        raw = render(vertices, triangles, size=(96, 72), samples=4)
    filtered, unfiltered = (np.sqrt(np.mean((image.astype(float) - many) ** 2)) for image in (few, raw))
    assert filtered < unfiltered / 2.0


def test_bad_requests_are_named() -> None:
    vertices, triangles = _ball((0.0, 0.5, 0.0), 0.5)
    with pytest.raises(ValueError, match=r"elevation .*got 90\.0"):
        frame_camera(vertices, elevation=90.0)
    with pytest.raises(ValueError, match=r"points .*got none"):
        frame_camera(np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"frames .*got \[1, 2, 2\]"):
        Studio(np.zeros((2, 2)), triangles)
    with pytest.raises(ValueError, match="size and samples"):
        Studio(vertices, triangles, samples=0)
    with pytest.raises(ValueError, match=r"vertices .*got \[161, 3\]"):
        Studio(vertices, triangles).render(vertices[:-1])
    with pytest.raises(ValueError, match="all of one size"):
        contact_sheet([])
    with pytest.raises(ValueError, match=r"captions .*got 2"):
        contact_sheet([np.zeros((4, 4, 3), dtype=np.uint8)], captions=["a", "b"])
