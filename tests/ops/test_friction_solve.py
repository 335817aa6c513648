"""Which corrections of BiCGStab the friction adjoint adds (`FrictionSolve` of csrc/solver/adjoint/friction.h)."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from programs import compiled

PROGRAM = """
#include "solver/adjoint/friction.h"
#include <cstdio>
int main() {
  double scale, tolerance, square;
  int products;
  if (std::scanf("%lf %lf %d", &scale, &tolerance, &products) != 3) return 1;
  pd::FrictionSolve solve(nullptr, scale);
  solve.begin(products, 1 << 20);
  while (std::scanf("%lf", &square) == 1) {
    const bool added = solve.accept(square, tolerance);
    std::printf("%d %.17g %d\\n", added, solve.error, solve.stage == pd::FrictionStage::first);
  }
}
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(PROGRAM, tmp_path_factory.mktemp("friction_solve"))


@pytest.mark.parametrize(
    ("residuals", "products", "goes_on"),
    [
        ([1.0, 0.25, 0.0625], 4, [True, True, True]),
        ([1.0, 2.0], 4, [True, False]),  # worse: not added
        ([1.0, 0.75], 4, [True, False]),  # better, but not by half
        ([1.0, float("nan")], 4, [True, False]),
        ([1.0, 2**-20], 4, [True, False]),  # within ten tolerances
        ([1.0], 0, [False]),  # no products left
    ],
)
def test_a_correction_is_added_where_it_lowers_the_residual(
    program: Path, residuals: list[float], products: int, goes_on: list[bool]
) -> None:
    """The error is the least residual so far, relative to the right side; another cycle follows while it halves."""
    scale = 4.0
    numbers = [scale, 1e-6, products, *((scale * residual) ** 2 for residual in residuals)]
    command = [str(program)]
    text = " ".join(map(str, numbers))
    out = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    least = float("inf")
    for residual, more, line in zip(residuals, goes_on, out.splitlines(), strict=True):
        added, error, again = line.split()
        assert (added == "1") == (residual < least)
        least = min(least, residual)
        assert (float(error), again == "1") == (least, more)
