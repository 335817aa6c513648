"""L-BFGS by inner products (`SecantPairs` of csrc/solver/multilevel/lbfgs.h): the direction of the dense update."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from programs import compiled

SIZE, PAIRS = 12, 11  # more pairs than are remembered

PROGRAM = f"""
#include "solver/multilevel/lbfgs.h"
#include <cstdio>
void read(double* to, int count) {{
  for (int k = 0; k < count; ++k)
    if (std::scanf("%lf", to + k) != 1) return;
}}
constexpr int size = {SIZE}, pairs = {PAIRS};
double dot(const double* a, const double* b) {{
  double sum = 0;
  for (int k = 0; k < size; ++k) sum += a[k] * b[k];
  return sum;
}}
int main() {{
  double s[pairs][size], y[pairs][size], g[size], m[size], with[pd::history], c[pd::history];
  read(s[0], pairs * size);
  read(y[0], pairs * size);
  read(g, size);
  read(m, size);
  pd::SecantPairs ring;
  for (int n = 0; n < pairs; ++n) {{
    for (int i = n < pd::history ? 0 : n - pd::history + 1; i <= n; ++i)
      ring.product[i % pd::history][n % pd::history] = dot(s[i], y[n]);
    ring.admit(n % pd::history, n != pairs - 2, dot(s[n], y[n]), dot(s[n], s[n]), dot(y[n], y[n]));
  }}
  const int newest = (pairs - 1) % pd::history;
  const auto number = [&](int place) {{ return pairs - 1 - (newest - place + pd::history) % pd::history; }};
  for (int i = 0; i < pd::history; ++i) ring.s_dot_g[i] = dot(s[number(i)], g);
  ring.first_loop(newest);
  double d[size];
  for (int k = 0; k < size; ++k) {{
    d[k] = g[k];
    for (int i = 0; i < pd::history; ++i) d[k] -= ring.alpha[i] * y[number(i)][k];
    d[k] *= m[k];
  }}
  for (int i = 0; i < pd::history; ++i) with[i] = dot(y[number(i)], d);
  const double own = dot(g, d);
  ring.second_loop(newest, with, c);
  for (int k = 0; k < size; ++k) {{
    for (int i = 0; i < pd::history; ++i) d[k] += c[i] * s[number(i)][k];
    std::printf("%.17g ", d[k]);
  }}
  std::printf("%.17g\\n", ring.slope(own, c));
}}
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(PROGRAM, tmp_path_factory.mktemp("lbfgs"))


@pytest.mark.parametrize("curvature", [None, -0.5, 0.0, 1e-14])
def test_direction_is_that_of_pairs_with_curvature(program: Path, curvature: float | None) -> None:
    """Of the last eight pairs, without one that may not count and those that have no curvature. It always descends."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((SIZE, SIZE))
    s = rng.standard_normal((PAIRS, SIZE))
    y = s @ (root @ root.T / SIZE + np.eye(SIZE))
    spoilt = () if curvature is None else (4, 7, 10)
    for number in spoilt:  # s.y becomes about that share of |s| |y|
        across = y[number] - s[number] * (s[number] @ y[number]) / (s[number] @ s[number])
        y[number] = across + (curvature or 0.0) * np.linalg.norm(across) * s[number] / np.linalg.norm(s[number])
    g, diagonal = rng.standard_normal(SIZE), rng.uniform(0.5, 2.0, SIZE)
    values = " ".join(f"{value:.17g}" for array in (s, y, g, diagonal) for value in array.ravel())
    out = subprocess.run([str(program)], input=values, capture_output=True, text=True, check=True).stdout
    *direction, slope = map(float, out.split())
    inverse = np.diag(diagonal)
    for number in range(PAIRS - 8, PAIRS):
        if number in spoilt or number == PAIRS - 2:
            continue
        inverse = _updated(inverse, s[number], y[number])
    # n u in each of sixteen updates, the conditions of which multiply to no more than 1e4
    np.testing.assert_allclose(direction, inverse @ g, rtol=0.0, atol=1e-10 * np.abs(inverse @ g).max())
    assert slope == pytest.approx(float(g @ inverse @ g), rel=1e-10)
    assert slope > 0.0


def _updated(inverse: NDArray[np.float64], s: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of BFGS (Nocedal and Wright 2006, eq. 6.17)."""
    rho = 1.0 / (s @ y)
    left = np.eye(len(s)) - rho * np.outer(s, y)
    return np.asarray(left @ inverse @ left.T + rho * np.outer(s, s))
