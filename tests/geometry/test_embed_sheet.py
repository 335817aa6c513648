"""A surface embedded in a sheet follows its motion, on its closest points."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from sheets import surface

import torchpd as pd


def test_a_finer_sheet_follows_an_affine_motion_exactly() -> None:
    coarse, fine = surface(cells=(3, 4)), surface(cells=(17, 13))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        embedding = pd.embed(fine, coarse)
    A, b = np.random.default_rng(0).normal(size=(3, 3)), np.array([1.0, 2.0, 3.0])
    moved = embedding.apply(coarse.vertices @ A.T + b)
    np.testing.assert_allclose(moved, fine.vertices @ A.T + b, atol=1e-13)
    assert embedding.weights.min() >= 0.0
    assert not embedding.weights[:, 3].any()
    assert embedding.tets.max() < len(coarse.triangles)
    tensors = embedding.apply(torch.from_numpy(coarse.vertices @ A.T + b)[None])
    np.testing.assert_allclose(tensors[0].numpy(), moved, atol=1e-15)


def test_what_lies_off_the_sheet_is_drawn_on_it_and_reported() -> None:
    coarse = surface(cells=(4, 4))
    near, off = surface(cells=(3, 3)).translated((0.0, 0.03, 0.0)), surface(cells=(3, 3)).translated((0.0, 0.04, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        embedding = pd.embed(near, coarse)  # a tenth of the longest edge is 0.035 m
    np.testing.assert_allclose(embedding.apply(coarse.vertices), near.vertices * [1.0, 0.0, 1.0], atol=1e-13)
    with pytest.warns(pd.MeshWarning, match=r"16 of 16 surface vertices lie off the sheet, up to 0\.04 m"):
        pd.embed(off, coarse)


def test_other_meshes_are_refused() -> None:
    with pytest.raises(TypeError, match=r"mesh must be a TetMesh, or a TriMesh such as cloth\.surface, got ndarray"):
        pd.embed(surface(), np.zeros((3, 3)))  # type: ignore[arg-type]
