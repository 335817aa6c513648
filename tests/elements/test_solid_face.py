"""Tetrahedra on a face (csrc/elements/solid_pair.h): energy and forces are the reference's.

The headers are compiled for the host, so that what a GPU runs is seen without one.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from programs import compiled
from runs import ULP

from torchpd.reference import nearest_rotation

Array = NDArray[np.float64]

COUNT = 400
# In: rest edges of corners 1 to 4 in a unit, unit^2 / det Dm and w V of both, five positions. Out: three times the five
# forces and the energy of both: with an energy, with one that is not wanted, without; then those of the first alone,
# its own once more in the way of the CPU, and those of both where corners are looked at one by one, with an energy and
# without.
PROGRAM = """
#include "elements/solid.h"
#include <cmath>
#include <cstdio>
#include <initializer_list>

template <class T, int Count>
struct Case {
  pd::Vec3<T> x[3 + Count], g[3 + Count];
  T weight[Count], energy = 0;
  pd::FaceRest<T, Count> rest;

  explicit Case(const T* in) {
    const auto read = [&](int i) { return pd::Vec3<T>{in[i], in[i + 1], in[i + 2]}; };
    pd::Vec3<T> edge[2 + Count];
    T factor[Count];
    for (int c = 0; c < 2 + Count; ++c) edge[c] = read(3 * c);
    for (int e = 0; e < Count; ++e) factor[e] = in[12 + e], weight[e] = in[14 + e];
    for (int c = 0; c < 3 + Count; ++c) x[c] = read(16 + 3 * c);
    rest = pd::face_rest<T, Count>(edge, sizeof(T) == 4 ? 1 << 28 : 1, factor);
  }
  T* write(T* out) const {
    for (const pd::Vec3<T>& force : g)
      for (T number : {force.x, force.y, force.z}) *out++ = number;
    *out++ = energy;
    return out;
  }
};

template <class T, int Count>
T* run(const T* in, T* out) {
  Case<T, Count> c(in);
  pd::SolidGradient<true>{}.run_face(c.x, c.rest, c.weight, c.g, c.energy);
  out = c.write(out);
  pd::SolidGradient<true>{false}.run_face(c.x, c.rest, c.weight, c.g, c.energy);
  out = c.write(out);
  pd::SolidGradient<false>{}.run_face(c.x, c.rest, c.weight, c.g, c.energy);
  return c.write(out);
}

// One tetrahedron as the CPU's functors see it.
template <class T>
struct One {
  using R = T;
  const pd::Vec3<T> (&x)[4];
  const pd::FaceRest<T, 1>& shape;
  T w;
  pd::Vec3<T> (&g)[4];
  T& energy;
  void corners(int, int, pd::Vec3<T> (&to)[4]) const { for (int c = 0; c < 4; ++c) to[c] = x[c]; }
  const pd::FaceRest<T, 1>& rest(int) const { return shape; }
  T weight(int) const { return w; }
  T& sum(int) const { return energy; }
  void add(int, const pd::Vec3<T> (&from)[4]) const { for (int c = 0; c < 4; ++c) g[c] = from[c]; }
};

template <class T>
T* run_one(const T* in, T* out) {
  Case<T, 1> c(in);
  pd::SolidGradient<true>{}.template run<1>(One<T>{c.x, c.rest, c.weight[0], c.g, c.energy});
  return c.write(out);
}

// Two tetrahedra whose corners are looked at one by one.
template <class T, bool Energy>
T* run_pair(const T* in, T* out) {
  Case<T, 2> c(in);
  const T factor[2] = {in[12], in[13]};
  int betweens = 0;
  pd::solid_pair_gradient<Energy, pd::Vec3<T>>(
      factor, c.weight, T(1) / (sizeof(T) == 4 ? 1 << 28 : 1), c.energy,
      [&](int n, pd::Vec3<T>& position, pd::Vec3<T>& rest) {
        position = c.x[n];
        rest = n == 0 ? pd::Vec3<T>{0, 0, 0}
                      : pd::Vec3<T>{in[3 * n - 3], in[3 * n - 2], in[3 * n - 1]};
      },
      [&](int n, const pd::Vec3<T>& force) { c.g[n] = force; }, [&] { ++betweens; });
  if (betweens != 1) c.energy = NAN;
  return c.write(out);
}

template <class T>
void run_all() {
  T in[31], out[5 * 16 + 4 * 13];
  while (std::fread(in, sizeof(T), 31, stdin) == 31) {
    T* const end = run_one(in, run<T, 1>(in, run<T, 2>(in, out)));
    run_pair<T, false>(in, run_pair<T, true>(in, end));
    std::fwrite(out, sizeof(T), 132, stdout);
  }
}

int main(int count, char**) { count > 1 ? run_all<double>() : run_all<float>(); }
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(PROGRAM, tmp_path_factory.mktemp("solid_face"))


class Found(NamedTuple):
    """Of pairs and of their first tetrahedra alone: forces [COUNT, corners, 3] and energies, by run."""

    forces: list[Array]
    energies: list[Array]


def run(program: Path, dtype: torch.dtype, rest: Array, x: Array, factor: Array, weight: Array) -> tuple[Found, Found]:
    """`rest`, `x` [COUNT, 5, 3]; `factor` is 1 / det Dm and `weight` w V, of both [COUNT, 2]."""
    unit = 2.0**-28 if dtype == torch.float32 else 1.0  # as plans have them
    numbers = [(rest[:, 1:] - rest[:, :1]).reshape(COUNT, -1) / unit, factor * unit**2, weight, x.reshape(COUNT, -1)]
    real: Any = np.float32 if dtype == torch.float32 else np.float64
    told = subprocess.run(
        [program, *(["double"] if dtype == torch.float64 else [])],
        input=np.concatenate(numbers, axis=-1).astype(real).tobytes(), stdout=subprocess.PIPE, check=True,
    ).stdout  # fmt: skip
    runs = np.split(np.frombuffer(told, real).reshape(COUNT, 132), [16, 32, 48, 61, 74, 87, 100, 116], axis=-1)
    found = Found([r[:, :-1].reshape(COUNT, -1, 3) for r in runs], [r[:, -1] for r in runs])
    pairs = [*range(3), *range(7, 9)]
    return (
        Found([found.forces[i] for i in pairs], [found.energies[i] for i in pairs]),
        Found(found.forces[3:7], found.energies[3:7]),
    )


def turned(rng: np.random.Generator) -> Array:
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return np.asarray(q * np.sign(np.linalg.det(q)))


KINDS = ["near rest", "large strain", "inverted", "pressed flat", "flat", "needle", "wound the other way", "alone"]


def shapes(kind: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """Rest positions and positions of five corners [COUNT, 5, 3], as float32 holds them."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0.3, 0.9, 0], [0.4, 0.3, 0.8], [0.5, 0.2, -0.7]])
    rest = rest + 0.1 * rng.standard_normal((COUNT, 5, 3))
    if kind == "alone":
        rest[:, 4] = rest[:, 3]
    if kind == "flat":
        rest[..., 2] *= 1e-3
    if kind == "needle":  # small angle at corner 0
        rest[:, 2] = 0.9 * rest[:, 1] + 1e-3 * rest[:, 2]
    if kind == "wound the other way":
        rest[..., 2] *= -1.0
    rest = rest @ turned(rng).T
    strain = {"large strain": 0.5, "flat": 2e-4, "needle": 2e-4}.get(kind, 0.05)
    x = rest + strain * rng.standard_normal(rest.shape)
    if kind == "alone":
        x[:, 4] = x[:, 3]
    if kind == "inverted":
        x[..., 2] *= -1.0
    if kind == "pressed flat":
        x[..., 1] = 0.25
    return tuple(np.asarray(np.float32(y), dtype=np.float64) for y in (rest, x @ turned(rng).T))


class Expected(NamedTuple):
    """Of a tetrahedron each: its energy and forces, and what a rounding makes of the strain and of forces."""

    energy: Array
    forces: Array
    strain_error: Array
    force_error: Array


def expected(rest: Array, x: Array, weight: Array) -> Expected:
    """To first order, with k = |Dm| |Dm^-1|: a rounding of edges or rest shapes makes k roundings of F, which turn R.

    Where F is off by d, R is by up to 2 d / (s_2 + s_3), s_3 with the sign of det F.
    """
    Dm, Ds = (np.swapaxes(y[:, 1:] - y[:, :1], -1, -2) for y in (rest, x))
    inverse = np.linalg.inv(Dm)
    F = Ds @ inverse
    strain = F - nearest_rotation(F)
    forces = weight[:, None, None] * np.swapaxes(strain @ np.swapaxes(inverse, -1, -2), -1, -2)
    energy = 0.5 * weight * (strain**2).sum(axis=(-2, -1))

    def norm(matrices: Array) -> Array:
        return np.asarray(np.linalg.norm(matrices, axis=(-2, -1)))

    singular = np.linalg.svd(F, compute_uv=False)
    gap = singular[:, 1] + np.sign(np.linalg.det(F)) * singular[:, 2]
    strain_error = norm(Dm) * norm(inverse) * (norm(F) + 3.0**0.5) * (1.0 + 2.0 / gap)
    forces = np.concatenate([-forces.sum(axis=1, keepdims=True), forces], axis=1)
    return Expected(energy, forces, strain_error, weight * norm(inverse) * strain_error)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_energies_and_forces_are_those_of_the_reference(kind: str, dtype: torch.dtype, program: Path) -> None:
    """To 15 roundings: two of edges, five of the rest shape, three of F, four of F - R and one of its weight."""
    rng = np.random.default_rng(3)
    rest, x = shapes(kind, rng)
    weight = rng.uniform(0.5, 2.0, (COUNT, 2)) * [1.0, kind != "alone"]
    corners = ([0, 1, 2, 3], [0, 1, 2, 4])
    determinants = [np.linalg.det(rest[:, c][:, 1:] - rest[:, :1]) for c in corners]
    pair, alone = run(program, dtype, rest, x, 1.0 / np.stack(determinants, axis=-1), weight)

    u = 15 * ULP[dtype]
    one, other = (expected(rest[:, c], x[:, c], w) for c, w in zip(corners, weight.T, strict=True))
    both = np.concatenate([one.forces[:, :3] + other.forces[:, :3], one.forces[:, 3:], other.forces[:, 3:]], axis=1)
    for found, forces, parts in ((pair, both, [one, other]), (alone, one.forces, [one])):
        limit = u * sum(part.force_error for part in parts)
        for run_forces in found.forces:
            assert (np.linalg.norm(run_forces - forces, axis=-1).max(axis=-1) <= limit).all()
        # w (strain + d)^2 / 2 for a strain that is off by d
        off = [(u * part.strain_error, w) for part, w in zip(parts, weight.T, strict=False)]
        most = sum(np.sqrt(2 * w * part.energy) * d + 0.5 * w * d**2 for part, (d, w) in zip(parts, off, strict=True))
        for energy in found.energies[::3]:
            assert (np.abs(energy - sum(part.energy for part in parts)) <= most).all()
        # strains that nobody wants the energy of are not made
        np.testing.assert_array_equal(found.forces[1], found.forces[2])
        # nobody adds to it any more
        for energy in found.energies[1:3]:
            np.testing.assert_array_equal(energy, found.energies[0])
    np.testing.assert_array_equal(pair.energies[4], 0.0)


@pytest.mark.parametrize("second", [0.0, 1.0], ids=["no edge", "along the first"])
def test_a_face_that_collapses_in_float32_stays_finite(second: float, program: Path) -> None:
    """Its corners may round to a line in the units of a patch, though the volume in float64 is more than none."""
    rest = np.tile([[0.0, 0, 0], [0.5, 0, 0], [0.0, 0, 0], [0.1, 0.2, 0.7], [0.2, 0.1, -0.4]], (COUNT, 1, 1))
    rest[:, 2, 0] = 0.25 * second
    x = rest + np.random.default_rng(2).standard_normal(rest.shape)
    for found in run(program, torch.float32, rest, x, np.full((COUNT, 2), 1e12), np.full((COUNT, 2), 1e-13)):
        assert all(np.isfinite(array).all() for array in (*found.forces, *found.energies))
