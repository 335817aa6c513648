"""Smooth surfaces: normals are shared where the surface bends gently and split where it has an edge."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from torchpd.viewing.shading import SmoothSurface


def test_box_keeps_its_edges() -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    surface = SmoothSurface(box.vertices, box.faces)
    assert len(surface.source) == 24  # three normals at each of eight corners
    normals = surface.normals(surface.split(np.asarray(box.vertices)))
    corners = normals[surface.triangles]
    expected = np.asarray(box.face_normals)[:, None]
    assert np.abs(corners - expected).max() < 1e-12  # flat faces: exact up to rounding


def test_sphere_is_smooth() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    surface = SmoothSurface(sphere.vertices, sphere.faces)
    assert len(surface.source) == len(sphere.vertices)
    split = surface.split(np.asarray(sphere.vertices))
    # at a vertex of a closed fan, directions to the neighbours are symmetric up to the square of the edge length
    longest = float(sphere.edges_unique_length.max())
    assert np.abs(surface.normals(split) - split).max() < longest**2


def test_doubled_vertices_do_not_make_a_seam() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    soup = np.asarray(sphere.vertices)[sphere.faces].reshape(-1, 3)
    surface = SmoothSurface(soup, np.arange(len(soup)).reshape(-1, 3))
    assert len(surface.source) == len(sphere.vertices)


def test_split_stays_when_the_surface_folds() -> None:
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    surface = SmoothSurface(sheet, [[0, 2, 1], [0, 3, 2]])
    assert len(surface.source) == 4
    folded = surface.split(sheet + [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 1, 0]])
    assert np.allclose(np.linalg.norm(surface.normals(folded), axis=1), 1.0, atol=1e-12)


def test_flat_triangles_have_a_normal() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    surface = SmoothSurface(line, [[0, 1, 2]])
    assert np.array_equal(surface.normals(surface.split(line)), np.tile([0.0, 1.0, 0.0], (3, 1)))


def test_normals_face_an_eye_that_sees_their_triangles() -> None:
    coarse = trimesh.creation.icosphere(subdivisions=1)
    surface = SmoothSurface(coarse.vertices, coarse.faces)
    split = surface.split(np.asarray(coarse.vertices))
    eye = np.array([0.3, 0.5, 4.0])
    towards = (eye - split) / np.linalg.norm(eye - split, axis=1, keepdims=True)
    seen_faces = np.einsum("ij,ij->i", coarse.face_normals, eye - coarse.triangles[:, 0]) > 0.0
    seen = np.unique(surface.triangles[seen_faces])
    plain, bent = surface.normals(split), surface.normals_seen_from(eye, split)
    assert (np.einsum("ij,ij->i", plain, towards)[seen] < 0.0).any()  # what the bending is for
    assert (np.einsum("ij,ij->i", bent, towards)[seen] > 0.0).all()
    facing = np.einsum("ij,ij->i", plain, towards) > 0.1
    assert np.abs(bent - plain)[facing].max() < 1e-15


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        ([[0.0, 0, 0]], [[0, 1, 2]], r"triangles .*got 0\.\.2"),
        ([[0.0, 0, np.nan]], [[0, 0, 0]], "vertices .*got nan"),
        ([[0.0, 0, 0]], [[0.0, 0.0, 0.0]], r"triangles .*got float64 \[1, 3\]"),
        ([[0.0, 0]], [[0, 0, 0]], r"vertices .*got \[1, 2\]"),
    ],
)
def test_bad_surfaces_are_named(vertices: list[list[float]], triangles: list[list[int]], message: str) -> None:
    with pytest.raises((ValueError, IndexError), match=message):
        SmoothSurface(vertices, triangles)
