"""Tetrahedra on a face (csrc/effects/solid_face.h), as GPUs work on them: energy and forces are the reference's.

The header is compiled for the host, since the CPU's own kernels take tetrahedra one by one.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from runs import ULP

from torchpd.reference import nearest_rotation

ROOT = Path(__file__).resolve().parent.parent
COUNT = 400
# In: rest edges of corners 1 to 4 in a unit, unit^2 / det Dm and w V of both, five positions. Out: the five forces and
# the energy of both, and forces without it; then those of the first alone, which has four.
PROGRAM = """
#include "effects/solid.h"
#include <cstdio>
#include <initializer_list>

template <class T, int Count>
void run(const T* in, const pd::SolidGradient<true>& with, T* out) {
  pd::Vec3<T> edge[2 + Count], x[3 + Count], g[3 + Count];
  T factor[Count], weight[Count], energy = 0;
  const auto read = [&](int i) { return pd::Vec3<T>{in[i], in[i + 1], in[i + 2]}; };
  for (int c = 0; c < 2 + Count; ++c) edge[c] = read(3 * c);
  for (int e = 0; e < Count; ++e) factor[e] = in[12 + e], weight[e] = in[14 + e];
  for (int c = 0; c < 3 + Count; ++c) x[c] = read(16 + 3 * c);
  const T per_unit = sizeof(T) == 4 ? 1 << 28 : 1;
  const auto rest = pd::face_rest<T, Count>(edge, per_unit, factor);
  const auto write = [&] {
    for (const pd::Vec3<T>& force : g)
      for (T number : {force.x, force.y, force.z}) *out++ = number;
    *out++ = energy;
  };
  int told = 0;
  with.run_face(x, rest, weight, g, energy, [&](int e) { told = 10 * told + e + 1; });
  write();
  energy = told;
  pd::SolidGradient<false>{}.run_face(x, rest, weight, g, energy, [](int) {});
  write();
}

template <class T>
void run_all() {
  T in[31], out[2 * 16 + 2 * 13];
  while (std::fread(in, sizeof(T), 31, stdin) == 31) {
    run<T, 2>(in, {}, out);
    run<T, 1>(in, {}, out + 32);
    std::fwrite(out, sizeof(T), 58, stdout);
  }
}

int main(int count, char**) { count > 1 ? run_all<double>() : run_all<float>(); }
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shlex.split(os.environ.get("CXX", "c++"))
    if shutil.which(compiler[0]) is None:
        pytest.skip("there is no C++ compiler")
    folder = tmp_path_factory.mktemp("solid_face")
    (folder / "program.cpp").write_text(PROGRAM)
    flags = ["-std=c++20", "-O1", "-ffp-contract=off", "-I", str(ROOT / "csrc")]
    subprocess.run([*compiler, *flags, str(folder / "program.cpp"), "-o", str(folder / "program")], check=True)
    return folder / "program"


def turned(rng: np.random.Generator) -> NDArray[np.float64]:
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def shapes(kind: str, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rest positions and positions of five corners [COUNT, 5, 3], as float32 holds them."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0.3, 0.9, 0], [0.4, 0.3, 0.8], [0.5, 0.2, -0.7]])
    rest = rest + 0.1 * rng.standard_normal((COUNT, 5, 3))
    if kind == "flat at rest":
        rest[..., 2] *= 1e-3
    if kind == "wound the other way":
        rest[..., 2] *= -1.0
    rest = rest @ turned(rng).T
    strain = {"large strain": 0.5, "flat at rest": 2e-4}.get(kind, 0.05)
    x = rest + strain * rng.standard_normal(rest.shape)
    if kind == "inverted":
        x[..., 2] *= -1.0
    if kind == "pressed flat":
        x[..., 1] = 0.25
    return tuple(np.asarray(np.float32(y), dtype=np.float64) for y in (rest, x @ turned(rng).T))


def expected(
    rest: NDArray[np.float64], x: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], ...]:
    """Of a tetrahedron each: energy, forces on its corners, and how much of these a rounding makes, to first order."""
    Dm, Ds = (np.swapaxes(y[:, 1:] - y[:, :1], -1, -2) for y in (rest, x))
    inverse = np.linalg.inv(Dm)
    F = Ds @ inverse
    strain = F - nearest_rotation(F)
    forces = weight[:, None, None] * np.swapaxes(strain @ np.swapaxes(inverse, -1, -2), -1, -2)
    norm = lambda matrices: np.linalg.norm(matrices, axis=(-2, -1))  # noqa: E731
    # where F is off by d, R is by up to 2 d / (s_2 + s_3), s_3 with the sign of det F
    singular = np.linalg.svd(F, compute_uv=False)
    gap = singular[:, 1] + np.sign(np.linalg.det(F)) * singular[:, 2]
    size = weight * norm(inverse) * (norm(F) + 3.0**0.5) * (1.0 + 2.0 / gap)
    energy = 0.5 * weight * (strain**2).sum(axis=(-2, -1))
    return energy, np.concatenate([-forces.sum(axis=1, keepdims=True), forces], axis=1), norm(Dm) * norm(inverse) * size


@pytest.mark.parametrize(
    "kind", ["near rest", "large strain", "inverted", "pressed flat", "flat at rest", "wound the other way"]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_energies_and_forces_are_those_of_the_reference(kind: str, dtype: torch.dtype, program: Path) -> None:
    """To 15 roundings, of edges, rest shape, F, R, strain and force, times the condition numbers of Dm and of R."""
    rng = np.random.default_rng(3)
    rest, x = shapes(kind, rng)
    weight = rng.uniform(0.5, 2.0, (COUNT, 2))
    corners = ([0, 1, 2, 3], [0, 1, 2, 4])
    Dm = [np.swapaxes(rest[:, c][:, 1:] - rest[:, :1], -1, -2) for c in corners]
    unit = 2.0**-28 if dtype == torch.float32 else 1.0  # as plans have them
    edges, determinants = (
        (rest[:, 1:] - rest[:, :1]).reshape(COUNT, -1),
        np.stack([np.linalg.det(d) for d in Dm], axis=-1),
    )
    numbers = [edges / unit, unit**2 / determinants, weight, x.reshape(COUNT, -1)]
    real: Any = np.float32 if dtype == torch.float32 else np.float64
    told = subprocess.run(
        [program, *(["double"] if dtype == torch.float64 else [])],
        input=np.concatenate(numbers, axis=-1).astype(real).tobytes(), stdout=subprocess.PIPE, check=True,
    ).stdout  # fmt: skip
    pair, plain, alone, alone_plain = np.split(np.frombuffer(told, real).reshape(COUNT, 58), [16, 32, 45], axis=-1)

    rounding = 15 * ULP[dtype]
    (e, g, size), (other_e, other_g, other_size) = (
        expected(rest[:, c], x[:, c], w) for c, w in zip(corners, weight.T, strict=True)
    )
    both = np.concatenate([g[:, :3] + other_g[:, :3], g[:, 3:], other_g[:, 3:]], axis=1)
    for found, wanted, limit in ((pair, both, size + other_size), (alone, g, size)):
        difference = np.linalg.norm(found[:, :-1].reshape(wanted.shape) - wanted, axis=-1).max(axis=-1)
        assert (difference <= rounding * limit).all()
    # the strain is off by so much, and the energy by that times the strain, and by its square
    for found, energy, weights, limit in (
        (pair, e + other_e, weight.max(axis=-1), size + other_size),
        (alone, e, weight[:, 0], size),
    ):
        off = rounding * limit
        assert (np.abs(found[:, -1] - energy) <= off * np.sqrt(energy / weights) * 4 + off**2).all()
    np.testing.assert_array_equal(plain[:, -1], 12)  # told of both apexes in turn
    np.testing.assert_array_equal(alone_plain[:, -1], 1)
    for with_energy, without in ((pair, plain), (alone, alone_plain)):
        difference = np.abs(with_energy[:, :-1] - without[:, :-1]).max(axis=-1)
        assert (difference <= rounding * (size + other_size)).all()
