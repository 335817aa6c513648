"""The packages that torchpd uses: the required ones, and the optional ones with their purpose."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from typing import NamedTuple

__all__ = ["OPTIONAL", "REQUIRED", "Package", "is_installed", "missing_packages"]


class Package(NamedTuple):
    """A package that torchpd can use."""

    module: str
    pip_name: str
    purpose: str


REQUIRED = (
    Package("torch", "torch", ""),
    Package("numpy", "numpy", ""),
    Package("scipy", "scipy", ""),
    Package("trimesh", "trimesh", ""),
    Package("meshio", "meshio", ""),
    Package("safetensors", "safetensors", ""),
    Package("tqdm", "tqdm", ""),
)
OPTIONAL = (
    Package("mitsuba", "mitsuba", "pictures"),
    Package("pyoidn", "pyoidn", "pictures without grain"),
    Package("matplotlib", "matplotlib", "plots"),
    Package("plotly", "plotly", "reports of studies"),
    Package("jinja2", "jinja2", "reports of studies"),
    Package("threadpoolctl", "threadpoolctl", "times of studies"),
    Package("PIL", "pillow", "pictures"),
    Package("imageio_ffmpeg", "imageio-ffmpeg", "films"),
    Package("pygltflib", "pygltflib", "glTF files"),
    Package("pxr", "usd-core", "USD files"),
    Package("rtree", "rtree", "fits to meshes"),
    Package("pytetwild", "pytetwild", 'tetrahedralize(method="tetwild")'),
)


def is_installed(package: Package) -> bool:
    return importlib.util.find_spec(package.module) is not None


def missing_packages(packages: Iterable[Package]) -> list[Package]:
    """Those of the packages that cannot be imported."""
    return [package for package in packages if not is_installed(package)]
