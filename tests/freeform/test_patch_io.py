"""Files of free-form patches: the same bits back, and errors that say what is wrong with a file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from patch_cases import KIND_NAMES, KINDS, patches_on, samples_on
from safetensors.torch import load_file, save_file

import torchpd as pd


@pytest.mark.parametrize("kind", KINDS, ids=KIND_NAMES)
def test_there_and_back(kind: tuple[str, str], tmp_path: Path, device: torch.device, dtype: torch.dtype) -> None:
    one = patches_on(kind=kind, device=device, dtype=dtype)
    one.save(tmp_path / "patches.safetensors")
    two = pd.FreeFormPatches.load(tmp_path / "patches.safetensors")
    assert repr(two) == repr(one)
    assert two.thickness == one.thickness
    here = one.to("cpu")
    for name in ("triangles", "vertices", "directors"):
        assert torch.equal(getattr(here, name), getattr(two, name))
    for name in ("amplitudes", "centres", "factors"):
        assert torch.equal(getattr(here.quadrics, name), getattr(two.quadrics, name))
    for first, second in zip(here.heights(samples_on(here)), two.heights(samples_on(two)), strict=True):
        assert torch.equal(first, second)


def test_what_requires_a_gradient_is_saved(tmp_path: Path) -> None:
    one = patches_on()
    trained = pd.Quadrics(*(t.requires_grad_() for t in vars(one.quadrics).values()))
    one.with_quadrics(trained).save(tmp_path / "trained")
    assert torch.equal(pd.FreeFormPatches.load(tmp_path / "trained").quadrics.factors, trained.factors)


def test_errors(tmp_path: Path) -> None:
    file = tmp_path / "patches.safetensors"
    patches = patches_on()
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        patches.save(tmp_path / "none" / "patches")
    with pytest.raises(IsADirectoryError, match="save: path must name a file, got the folder"):
        patches.save(tmp_path)
    with pytest.raises(FileNotFoundError, match="no such file of patches"):
        pd.FreeFormPatches.load(file)
    file.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"no patches: .*safetensors"):
        pd.FreeFormPatches.load(file)
    save_file({"a": torch.zeros(1)}, file)
    with pytest.raises(ValueError, match=r"metadata .*'torchpd\.patches'"):
        pd.FreeFormPatches.load(file)

    patches.save(file)
    tensors = load_file(file)
    record = {"format": 1, "base": "flat", "measured_at": "base", "thickness": 0.0}

    def write(change: dict[str, object], leave_out: str = "") -> None:
        kept = {name: t for name, t in tensors.items() if name != leave_out}
        save_file(kept, file, metadata={"torchpd.patches": json.dumps({**record, **change})})

    write({"format": 2, "written_by": "torchpd 9"})
    with pytest.raises(ValueError, match=r"format 2, .*torchpd 9; .*install"):
        pd.FreeFormPatches.load(file)
    write({}, "quadrics.factors")
    with pytest.raises(ValueError, match=r".*version: 'quadrics.factors'"):
        pd.FreeFormPatches.load(file)
    write({"base": "round"})
    with pytest.raises(ValueError, match=r"base .*got 'round'"):
        pd.FreeFormPatches.load(file)
