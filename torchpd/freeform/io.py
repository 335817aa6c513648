"""Free-form patches as files: one safetensors file, with the meaning of its tensors as JSON in the metadata."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..common.checks import check_target_file
from ..version import __version__
from .quadrics import Quadrics
from .surface import PatchSurface

__all__ = ["PATCHES_FORMAT_VERSION", "load_patches", "save_patches"]

Surface = TypeVar("Surface", bound=PatchSurface)

PATCHES_FORMAT_VERSION = 1
_KEY = "torchpd.patches"  # metadata key; others may add their own


def save_patches(patches: PatchSurface, path: str | Path) -> None:
    """Write base, quadrics and options; reading recomputes the lists."""
    target = check_target_file(path)
    quadrics = patches.quadrics
    tensors = {
        "vertices": patches.vertices,
        "triangles": patches.triangles,
        "directors": patches.directors,
        "quadrics.amplitudes": quadrics.amplitudes,
        "quadrics.centres": quadrics.centres,
        "quadrics.factors": quadrics.factors,
    }
    record = {
        "format": PATCHES_FORMAT_VERSION,
        "written_by": f"torchpd {__version__}",
        "base": patches.base,
        "measured_at": patches.measured_at,
        "thickness": patches.thickness,
    }
    # safetensors refuses tensors that share memory: clone them
    values = {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}
    save_file(values, target, metadata={_KEY: json.dumps(record)})


def load_patches(path: str | Path, kind: type[Surface]) -> Surface:
    """Read a file of `save_patches`, on the CPU, as an instance of `kind`."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"no such file of patches: {file}")
    try:
        with safe_open(file, framework="pt") as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{file} holds no patches: not a safetensors file ({error})") from None
    if _KEY not in metadata:
        raise ValueError(f"{file} holds no patches that FreeFormPatches.save wrote: its metadata has no {_KEY!r}")
    try:
        record = json.loads(metadata[_KEY])
        version = int(record["format"])
        if version > PATCHES_FORMAT_VERSION:
            raise ValueError(
                f"format {version}, written by {record.get('written_by', 'a newer torchpd')}; torchpd {__version__} "
                f"reads formats up to {PATCHES_FORMAT_VERSION}: install a newer torchpd"
            )
        quadrics = Quadrics(*(tensors[f"quadrics.{name}"] for name in ("amplitudes", "centres", "factors")))
        return kind(
            tensors["vertices"],
            tensors["triangles"].to(torch.int64),
            quadrics,
            directors=tensors["directors"],
            base=record["base"],
            measured_at=record["measured_at"],
            thickness=record["thickness"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} is damaged or of another version: {error}") from error
