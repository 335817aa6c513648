"""How many environments share a block (csrc/cuda/small_batch/block_shape.h), compiled for the host."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import NamedTuple

import pytest
from programs import compiled

# In: pairs, slots, batch, multiprocessors, shared memory of one and the most of a block, bytes of an environment.
PROGRAM = """
#include "cuda/small_batch/block_shape.h"
#include <cstdio>

int main() {
  long long n[7];
  const auto read = [&] {
    for (long long& number : n)
      if (std::scanf("%lld", &number) != 1) return false;
    return true;
  };
  while (read()) {
    const pd::SmallMesh mesh{int(n[0]), int(n[1])};
    const auto bytes = [&](int count) { return std::size_t(count * n[6]); };
    const pd::DeviceLimits limits{int(n[3]), std::size_t(n[4]), std::size_t(n[5])};
    const pd::SmallBatchShape shape = pd::small_batch_shape(mesh, n[2], limits, bytes);
    const long long most = pd::most_at_work(mesh, limits, bytes);
    std::printf("%d %d %d %lld\\n", shape.per_block, shape.threads, int(shape.few_registers), most);
  }
}
"""


class Asked(NamedTuple):
    pairs: int
    slots: int
    batch: int
    multiprocessors: int = 132
    shared: int = 233472  # of a multiprocessor of an H100,
    most: int = 232448  # and of a block
    each: int = 0  # bytes of an environment; 0: as of a bar

    @property
    def bytes(self) -> int:
        return self.each or 136 + 5 * 16 * self.slots + 6 * 16 * self.pairs + 4 * (self.pairs + 3 * self.slots)


class Shape(NamedTuple):
    per_block: int
    threads: int
    few_registers: bool


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(PROGRAM, tmp_path_factory.mktemp("several_shape"))


def told(program: Path, asked: list[Asked]) -> list[tuple[Shape, int]]:
    """Shapes, and how many environments are at work at most."""
    lines = [" ".join(map(str, (*a[:6], a.bytes))) for a in asked]
    words = subprocess.run([program], input="\n".join(lines), stdout=subprocess.PIPE, text=True, check=True).stdout
    found = [tuple(map(int, line.split())) for line in words.splitlines()]
    assert len(found) == len(asked)
    return [(Shape(per_block, threads, bool(few)), most) for per_block, threads, few, most in found]


def shapes(program: Path, asked: list[Asked]) -> list[Shape]:
    return [shape for shape, _ in told(program, asked)]


def test_every_small_mesh_has_a_shape_that_fits(program: Path) -> None:
    asked = [
        Asked(pairs, slots, batch, *gpu)
        for pairs in (1, 2, 31, 32, 33, 81, 96, 97, 144, 191, 192)
        for slots in (4, pairs // 2 + 4, 5 * pairs)
        for batch in (1, 2, 3, 4, 131, 132, 133, 1024, 2112, 8192, 1 << 20, 1 << 40)
        for gpu in ((132,), (108, 167936, 166912), (20, 102400, 101376))  # H100, A100, a laptop's
    ]
    fits = [a for a in asked if a.bytes <= a.most]
    assert len(fits) > 0.9 * len(asked)
    for a, (shape, most) in zip(fits, told(program, fits), strict=True):
        assert 1 <= shape.per_block <= min(4, a.batch), (a, shape)
        assert shape.threads % 32 == 0, (a, shape)
        assert 32 <= shape.threads <= 224, (a, shape)
        rounds = -(-shape.per_block * a.pairs // shape.threads)
        assert rounds <= (1 if shape.few_registers else 2), (a, shape)
        assert shape.per_block * a.bytes <= a.most, (a, shape)
        # no batch has more at work than memory is for
        threads = 768 if shape.few_registers else 640
        blocks = max(1, min(threads // shape.threads, 32, a.shared // (shape.per_block * a.bytes + 1024)))
        assert shape.per_block * blocks * a.multiprocessors <= most, (a, shape, most)


def test_shapes_on_an_h100(program: Path) -> None:
    """The fastest that was measured, of a bar of 64 vertices in few and in many environments, and of the smallest."""
    expected = {
        Asked(81, 64, 1): Shape(1, 96, few_registers=False),
        Asked(81, 64, 132): Shape(1, 96, few_registers=False),
        Asked(81, 64, 528): Shape(1, 96, few_registers=False),
        Asked(81, 64, 1024): Shape(1, 96, few_registers=True),
        Asked(81, 64, 8192): Shape(3, 128, few_registers=False),
        Asked(3, 8, 8192): Shape(4, 32, few_registers=False),
        Asked(192, 125, 1): Shape(1, 192, few_registers=False),
        Asked(192, 125, 8192): Shape(1, 192, few_registers=True),
    }
    assert dict(zip(expected, shapes(program, list(expected)), strict=True)) == expected


def test_blocks_share_no_more_than_they_must(program: Path) -> None:
    """As long as one wave is enough, fewer a block would leave some without any."""
    for batch in (2, 66, 131, 400, 800, 1000):
        for pairs in (3, 24, 81, 144):
            a = Asked(pairs, pairs, batch)
            (shape,) = shapes(program, [a])
            threads = 768 if shape.few_registers else 640
            blocks = 132 * min(threads // shape.threads, 32, a.shared // (shape.per_block * a.bytes + 1024))
            assert batch > blocks * (shape.per_block - 1), (a, shape)


def test_where_nothing_else_fits_one_block_does(program: Path) -> None:
    (one,) = told(program, [Asked(24, 27, 8192, shared=65536, most=65536, each=65536)])
    assert one[0].per_block == 1
    assert one[1] == 132


def test_memory_limits_how_many_share(program: Path) -> None:
    asked = [Asked(24, 27, 8192, each=each) for each in (2_000, 80_000, 200_000)]
    many, few, one = (shape.per_block for shape in shapes(program, asked))
    assert many == 4
    assert few <= 2
    assert one == 1
