"""Pictures of moving surfaces without a display: a small studio for Mitsuba's scalar path tracer.

Lengths in m, y up, angles in degrees, colours linear RGB in 0..1, images uint8 [H, W, 3] in sRGB.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.checks import as_array, check_finite, check_scalar, check_shape, check_vector, optional_module
from ..common.warn import warn_user
from .shading import SmoothSurface

__all__ = ["CORAL", "Camera", "Studio", "contact_sheet", "frame_camera", "render"]

Array = NDArray[np.float64]
Radiance = NDArray[np.float32]
Index = NDArray[np.int64]
Picture = NDArray[np.uint8]
Color = tuple[float, float, float]

CORAL: Color = (0.72, 0.10, 0.04)
_FLOOR: Color = (0.41, 0.53, 0.60)
_KEY_LIGHT: Color = (12.0, 11.4, 10.6)  # radiance of the soft box, warm
_SKY: Color = (0.61, 0.625, 0.66)  # radiance of the surrounding sky, cool
_ROWS = 16  # image rows rendered at a time, so that they stay in the cache
_MARGIN = 16  # pixels
_PAPER, _INK = (255, 255, 255), (62, 64, 70)


@dataclass(frozen=True)
class Camera:
    """An upright pinhole camera."""

    origin: Color  # m
    target: Color  # m, at the centre of the picture
    fov: float  # vertical field of view, degrees

    def __post_init__(self) -> None:
        forward = check_vector("Camera.target", self.target) - check_vector("Camera.origin", self.origin)
        if not float(np.hypot(forward[0], forward[2])) > 1e-9 * float(np.linalg.norm(forward)):
            raise ValueError(
                f"Camera: origin and target must differ horizontally, as the camera is upright, got {self.origin} and "
                f"{self.target}; move one of them sideways a little"
            )
        if not 0.0 < check_scalar("Camera.fov", self.fov) < 180.0:
            raise ValueError(f"Camera.fov must lie between 0 and 180 degrees, got {self.fov}")

    def rays(self, size: tuple[int, int]) -> Array:
        """Unit directions [H, W, 3] through the pixel centres."""
        width, height = size
        forward = np.array(self.target) - np.array(self.origin)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        slope = np.tan(np.radians(self.fov) / 2.0)
        x = (2.0 * (np.arange(width) + 0.5) / width - 1.0) * slope * width / height
        y = (1.0 - 2.0 * (np.arange(height) + 0.5) / height) * slope
        across, upwards = forward + x[:, None] * right, y[:, None] * np.cross(right, forward)
        rays = np.empty((height, width, 3))
        for top in range(0, height, _ROWS):
            rows = slice(top, top + _ROWS)
            a, b, c = (across[:, k] + upwards[rows, k, None] for k in range(3))
            length = np.sqrt(a * a + b * b + c * c)
            for k, component in enumerate((a, b, c)):
                np.divide(component, length, out=rays[rows, :, k])
        return rays


def _view_axes(azimuth: float, elevation: float) -> Array:
    """Rows right, up, forward of a camera that looks at the origin from this direction."""
    turn, lift = np.radians(azimuth), np.radians(elevation)
    forward = -np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
    right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
    return np.stack([right, np.cross(right, forward), forward])


def frame_camera(
    points: Any,
    *,
    azimuth: float = 25.0,
    elevation: float = 20.0,
    fov: float = 24.0,
    aspect: float = 4.0 / 3.0,
    margin: float = 0.07,
) -> Camera:
    """The nearest camera in the given direction that has every point in its picture.

    Args:
        points: [..., 3] m, all points to show, for example the vertices of all frames of a motion.
        azimuth: of the camera around the vertical [degrees], 0 on the +z side, 90 on the +x side.
        elevation: of the camera above the horizontal [degrees], in -90..90 exclusive.
        fov: vertical field of view [degrees].
        aspect: width / height of the picture.
        margin: fraction of the picture left free at each border.
    """
    seen = as_array("points", points, np.float64, for_picture=True).reshape(-1, 3)
    check_finite("points", seen)
    if len(seen) == 0:
        raise ValueError("points must hold at least one point, got none")
    if not -90.0 < elevation < 90.0:
        raise ValueError(f"elevation must lie between -90 and 90 degrees, got {elevation}")
    axes = _view_axes(azimuth, elevation)
    x, y, depth = axes @ seen.T
    slope = (1.0 - 2.0 * margin) * np.tan(np.radians(fov) / 2.0)

    # a point is in the picture when |x - x_eye| <= slope (depth - depth_eye): the tightest pair of planes per axis
    eye = np.zeros(3)
    depths = []
    for axis, (offset, opening) in enumerate(((x, slope * aspect), (y, slope))):
        upper, lower = np.max(offset - opening * depth), np.max(-offset - opening * depth)
        eye[axis] = (upper - lower) / 2.0
        depths.append(-(upper + lower) / (2.0 * opening))
    distance = max(float(np.ptp(seen, axis=0).max()), 1e-6)
    eye[2] = min(*depths, float(depth.min()) - 0.1 * distance)
    origin = axes.T @ eye
    middle = origin + (depth.mean() - eye[2]) * axes[2]
    return Camera(_triple(origin), _triple(middle), fov)


class Studio:
    """Camera, lights and floor around one surface, placed for all of its motion.

    >>> studio = Studio(frames, triangles)           # frames [T, n, 3]
    >>> image = studio.render(frames[10])            # uint8 [360, 480, 3]

    Args:
        frames: [T, n, 3] or [n, 3] m, positions of the surface's vertices; the first frame decides the creases.
        triangles: [m, 3] vertex numbers.
        ground: height of the floor [m]; None puts it below the lowest vertex of all frames.
        camera: None frames the whole motion.
        color: reflectance of the surface, [3] or one for each vertex [n, 3].
        size: width and height of the pictures [pixels].
        samples: light paths per pixel, rounded up to a square; a denoiser removes the remaining noise.
    """

    def __init__(
        self,
        frames: Any,
        triangles: Any,
        *,
        ground: float | None = 0.0,
        camera: Camera | None = None,
        color: Color | Array = CORAL,
        size: tuple[int, int] = (480, 360),
        samples: int = 9,
    ) -> None:
        motion = as_array("frames", frames, np.float64, for_picture=True)
        motion = motion[None] if motion.ndim == 2 else motion
        check_shape("frames", motion, (None, None, 3), "positions [m] in every frame")
        check_finite("frames", motion)
        if motion.size == 0:
            raise ValueError(f"frames must hold at least one vertex, got {list(motion.shape)}")
        if min(*size, samples) < 1:
            raise ValueError(f"size and samples must be at least 1, got {size} and {samples}")
        self.surface = SmoothSurface(motion[0], triangles)
        self._count = motion.shape[1]
        self.size, self.samples = size, samples
        colors = as_array("color", color, np.float64)
        if colors.ndim == 1:
            colors = np.broadcast_to(colors, (self._count, 3)) if colors.shape == (3,) else colors
        check_shape("color", colors, (self._count, 3), "linear RGB of the surface [3] or of each vertex")
        self.color = colors[self.surface.source]
        self.low, self.high = motion.min(axis=(0, 1)), motion.max(axis=(0, 1))
        self.ground = float(self.low[1]) if ground is None else check_scalar("ground", ground)
        self.camera = camera or frame_camera(motion, aspect=size[0] / size[1])

    def render(self, vertices: Any) -> Picture:
        """Render one frame [n, 3] m; equal inputs give equal bits."""
        frame = as_array("vertices", vertices, np.float64, for_picture=True)
        check_shape("vertices", frame, (self._count, 3), "positions of the vertices that the studio was made for [m]")
        check_finite("vertices", frame)
        positions = self.surface.split(frame)
        normals = self.surface.normals_seen_from(np.array(self.camera.origin), positions)
        with _mitsuba() as mi:
            scene = mi.load_dict(self._scene(mi, positions, normals))
            radiance = np.array(mi.render(scene, spp=self.samples))
        return _to_srgb(_denoise(radiance))

    def _radius(self) -> float:
        return max(float(np.linalg.norm(self.high - self.low)) / 2.0, 1e-6)

    def _scene(self, mi: Any, positions: Array, normals: Array) -> dict[str, Any]:
        """The Mitsuba scene; distances scale with the motion, directions follow the camera."""
        radius, middle = self._radius(), (self.low + self.high) / 2.0
        middle[1] = self.ground
        sight = np.array(self.camera.target) - np.array(self.camera.origin)
        ahead = np.array([sight[0], 0.0, sight[2]]) / max(float(np.hypot(sight[0], sight[2])), 1e-12)
        side = np.cross(ahead, [0.0, 1.0, 0.0])
        soft_box = middle + radius * (-1.5 * side - 0.9 * ahead + np.array([0.0, 3.6, 0.0]))
        hung = mi.ScalarTransform4f().look_at(origin=soft_box.tolist(), target=middle.tolist(), up=[0, 1, 0])
        material = {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": 0.32,
            "specular": 0.5,
            "clearcoat": 0.5,
            "clearcoat_gloss": 0.85,
        }
        # two-sided, because an open surface shows both sides
        bsdf = {"type": "twosided", "material": material}
        body = _mesh(mi, positions, self.surface.triangles, normals, self.color, bsdf)
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "camera": self._sensor(mi),
            "body": body,
            "floor": {**self._floor(mi), "bsdf": {"type": "diffuse", "reflectance": _rgb(_FLOOR)}},
            "key light": {
                "type": "rectangle",
                "to_world": hung.scale(0.9 * radius),
                "emitter": {"type": "area", "radiance": _rgb(_KEY_LIGHT)},
            },
            "sky": {"type": "constant", "radiance": _rgb(_SKY)},
        }

    def _floor(self, mi: Any) -> dict[str, Any]:
        """A floor that fills every picture from above."""
        radius, middle = self._radius(), (self.low + self.high) / 2.0
        level = mi.ScalarTransform4f().translate([middle[0], self.ground, middle[2]]).rotate([1, 0, 0], -90.0)
        return {"type": "rectangle", "to_world": level.scale(400.0 * radius)}

    def _sensor(self, mi: Any) -> dict[str, Any]:
        origin, target, radius = list(self.camera.origin), list(self.camera.target), self._radius()
        return {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0]),
            "fov": self.camera.fov,
            "fov_axis": "y",
            "near_clip": 1e-3 * radius,
            "far_clip": 1e4 * radius,
            "film": {
                "type": "hdrfilm",
                "width": self.size[0],
                "height": self.size[1],
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},  # pixels share no samples: the denoiser needs independent noise
            },
            "sampler": {"type": "stratified"},
        }


def render(vertices: Any, triangles: Any, **options: Any) -> Picture:
    """Render one picture of a surface at rest; `options` are those of `Studio`. For a motion use one `Studio`."""
    return Studio(vertices, triangles, **options).render(vertices)


def contact_sheet(
    images: Sequence[Picture],
    *,
    columns: int = 4,
    captions: Sequence[str] | None = None,
    path: str | Path | None = None,
    gap: int = 8,
) -> Picture:
    """Place images of one size side by side on white, row by row, with captions in their lower left corners.

    Args:
        images: uint8 [H, W, 3] each.
        columns: images per row.
        captions: one per image.
        path: also write the sheet to this file; the suffix decides the format.
        gap: pixels between the images and around them.
    """
    if not images or any(image.shape != images[0].shape for image in images):
        raise ValueError("images must be at least one, all of one size")
    if captions is not None and len(captions) != len(images):
        raise ValueError(f"captions must be one per image ({len(images)}), got {len(captions)}")
    optional_module("PIL", "Pillow", "contact sheets")
    from PIL import Image, ImageDraw, ImageFont

    height, width = images[0].shape[:2]
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + gap) + gap), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=max(11, height // 20))
    for number, image in enumerate(images):
        left, top = gap + (number % columns) * (width + gap), gap + (number // columns) * (height + gap)
        sheet.paste(Image.fromarray(image), (left, top))
        if captions is not None:
            inset = height // 28
            draw.text((left + inset, top + height - inset), captions[number], fill=_INK, font=font, anchor="ls")
    if path is not None:
        sheet.save(path)
    return np.asarray(sheet)


def _denoise(radiance: Radiance) -> Radiance:
    """Remove the noise of few light paths by Intel's Open Image Denoise, if installed."""
    try:
        from pyoidn import denoise
    except ImportError:
        warn_user("pictures stay noisy without pyoidn: pip install pyoidn, or raise samples")
        return radiance
    wide = np.pad(
        radiance, (*2 * ((_MARGIN, _MARGIN),), (0, 0)), mode="symmetric"
    )  # without a margin the denoiser leaves a seam at the edges
    return np.asarray(denoise(wide, hdr=True)[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN])


def _to_srgb(radiance: Radiance) -> Picture:
    """Convert linear radiance to sRGB; values above 0.7 are compressed towards white instead of clipped."""
    linear = np.maximum(radiance, 0.0)
    linear = np.where(linear > 0.7, 1.0 - 0.3 * np.exp(-(linear - 0.7) / 0.3), linear)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1.0 / 2.4) - 0.055)
    return (255.0 * encoded + 0.5).astype(np.uint8)


def _mesh(mi: Any, positions: Array, triangles: Index, normals: Array, colors: Array, bsdf: dict[str, Any]) -> Any:
    """A Mitsuba mesh with smooth normals and a colour for each vertex."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("body", len(positions), len(triangles), has_vertex_normals=True, props=properties)
    mesh.add_attribute("vertex_color", 3, colors.astype(np.float32).ravel())
    buffers = mi.traverse(mesh)
    buffers["vertex_positions"] = positions.astype(np.float32).ravel()
    buffers["vertex_normals"] = normals.astype(np.float32).ravel()
    buffers["faces"] = triangles.astype(np.uint32).ravel()
    buffers.update()
    return mesh


def _rgb(color: Sequence[float] | Array) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(channel) for channel in color]}


def _triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


@contextmanager
def _mitsuba() -> Iterator[Any]:
    """Mitsuba in its scalar variant (no LLVM or GPU needed); restores the caller's variant afterwards."""
    mitsuba = optional_module("mitsuba", "Mitsuba", "pictures")
    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    try:
        yield mitsuba
    finally:
        if before is not None:
            mitsuba.set_variant(before)
