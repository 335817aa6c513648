"""Loading of the compiled module `torchpd._C`, and the error that names the fix."""

from __future__ import annotations

import importlib
from types import ModuleType

import torch  # noqa: F401  (first: the extension finds the libraries of torch in the process)

__all__ = ["BUILD_COMMAND", "extension_error", "load_extension"]

BUILD_COMMAND = "`make setup` in a checkout, or `pip install --no-build-isolation .`"


def load_extension() -> tuple[ModuleType | None, str]:
    """Load `torchpd._C`: the module and an empty reason, or None and the reason."""
    try:
        return importlib.import_module("torchpd._C"), ""
    except ImportError as error:
        return None, str(error)


def extension_error(name: str) -> ImportError:
    """Error for a name of the package that needs the extension."""
    reason = load_extension()[1]
    return ImportError(f"torchpd.{name} needs the compiled extension ({reason}): build it with {BUILD_COMMAND}")
