"""A poncho from a sewing pattern falls on a ball. Prints what the ball carries, and how far the cloth is stretched."""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from scipy.spatial import Delaunay

import torchpd as tpd
from torchpd.viewing.render import CORAL, render

WIDTH, LENGTH, NECK, SLOPE = 1.1, 0.55, 0.12, 0.3  # m, m, radius [m], fall of the shoulders over their length
BALL, RADIUS = (0.0, 0.75, 0.0), 0.25  # m


def pattern(edge: float) -> tuple[tpd.TriMesh, np.ndarray]:
    """Two panels that lie flat over the ball, sewn along sloping shoulders, and their rest shape [F, 3, 2] m."""
    half = WIDTH / 2
    turn = np.linspace(0.0, np.pi, 1 + round(np.pi * NECK / edge))
    corners = np.array([(-NECK, 0.0), (-half, 0.0), (-half, LENGTH), (half, LENGTH), (half, 0.0), (NECK, 0.0)])
    sides = [np.linspace(a, b, 1 + round(np.linalg.norm(b - a) / edge))[1:] for a, b in pairwise(corners)]
    row, place = np.mgrid[1 : int(LENGTH / edge) * 2, -int(half / edge) : int(half / edge) + 1].reshape(2, -1)
    inner = edge * np.stack([place + 0.5 * (row % 2), 0.75**0.5 * row], axis=1)
    inner += np.random.default_rng(0).uniform(-0.15, 0.15, inner.shape) * edge  # no direction of the mesh is preferred
    free = (abs(inner[:, 0]) < half - 0.6 * edge) & (abs(inner[:, 1] - LENGTH / 2) < LENGTH / 2 - 0.6 * edge)
    inner = inner[free & (np.hypot(*inner.T) > NECK + 0.6 * edge)]
    points = np.concatenate([NECK * np.stack([np.cos(turn), np.sin(turn)], axis=1), *sides[:-1], sides[-1][:-1], inner])
    triangles = Delaunay(points).simplices
    triangles = triangles[np.hypot(*points[triangles].mean(axis=1).T) > NECK]

    # flat over the ball the shoulders meet at z = 0; as they are cut, they fall towards the sides
    x, z = points.T
    front = np.stack([x, np.full(len(x), BALL[1] + RADIUS + 0.02), z], axis=1)
    cut = np.stack([x, z + SLOPE * abs(x) * (1.0 - z / LENGTH)], axis=1)[triangles]
    both = np.concatenate([front, front * (1.0, 1.0, -1.0)])
    welded, vertex = np.unique(both, axis=0, return_inverse=True)  # one vertex where the shoulders are sewn
    triangles = vertex[np.concatenate([triangles[:, ::-1], triangles + len(points)])]
    return tpd.TriMesh(welded, triangles), np.concatenate([cut[:, ::-1], cut * (1.0, -1.0)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=150, help="of 1/60 s")
    parser.add_argument("--edge", type=float, default=0.025, help="length of the mesh's edges [m]")
    parser.add_argument("--out", type=Path, help="picture file (PNG) of the end")
    options = parser.parse_args()

    surface, rest = pattern(options.edge)
    poncho = tpd.Cloth(surface, youngs=2e5, thickness=5e-4, area_density=0.3, bending=4e-5, rest_uv=rest)
    ball = tpd.Sphere(BALL, RADIUS, friction=0.4)
    scene = tpd.Scene(poncho, ball, tpd.Gravity(), tpd.Damping(2.0))
    sim = tpd.Simulator(scene, 1 / 60, iterations=300, tolerance=1e-3)
    start = sim.rest_state()
    before = sim.rollout(start, options.steps - 1, progress=True).state()
    state = sim(before)

    carried = sim.contact_forces(before, state).bodies[poncho].force[0, 1]
    print(f"weight {float(sim.masses.sum()) * 9.81:.3f} N, of which the ball carries {float(carried):.3f} N")
    strains = [sim.membrane_stress(moment)[poncho].strain for moment in (start, state)]  # Green's, against the pattern
    flat, worn = (((1.0 + 2.0 * torch.linalg.eigvalsh(strain)[..., 1]).sqrt() - 1.0).mean() for strain in strains)
    print(f"mean stretch of the cloth: {100 * float(flat):.2f} % flat, {100 * float(worn):.2f} % on the ball")
    if options.out:
        # edges of the cloth are chords of the ball: it is drawn smaller, so that they stay outside
        head = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS - options.edge**2 / (2.0 * RADIUS))
        stand = head.apply_translation(BALL) + trimesh.creation.cylinder(0.03, segment=[(0.0, 0.0, 0.0), BALL])
        both = trimesh.Trimesh(state.positions[0], surface.triangles, process=False) + stand
        colors = np.repeat([CORAL, (0.15, 0.15, 0.15)], [len(surface.vertices), len(stand.vertices)], axis=0)
        image = render(both.vertices, both.faces, color=colors, size=(640, 480), samples=64)
        Image.fromarray(image).save(options.out)


if __name__ == "__main__":
    main()
