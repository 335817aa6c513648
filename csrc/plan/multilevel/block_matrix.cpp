#include "plan/multilevel/block_matrix.h"

#include "threads/team.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <stdexcept>

namespace pd {

namespace {

constexpr int width = 4;  // of the right factor of a product

// c += a b of blocks [H, K] and [K, 4]; a^T is stored if `Transposed`.
template <int H, int K, bool Transposed>
void add_product(const double* a, const double* b, double* __restrict c) {
  for (int i = 0; i < H; ++i) {
    for (int j = 0; j < K; ++j) {
      const double f = a[Transposed ? j * H + i : i * K + j];
      for (int l = 0; l < width; ++l) c[i * width + l] += f * b[j * width + l];
    }
  }
}

// Rows of a left factor: the columns of their entries, and their blocks, counted in `value`.
struct Left {
  std::int32_t rows;
  const std::vector<std::int32_t>&start, &column;
  const std::vector<double>& value;
  const std::int32_t* block;  // null: their own numbers
};

template <int H, int K, bool Transposed>
BlockMatrix product(const Left& a, const BlockMatrix& b, int threads) {
  BlockMatrix c{H, width, a.rows, b.columns, {}, {}, {}};
  sum_rows(c, 0.0, threads, [&a, &b](std::int32_t row, RowSum& sum) {
    const std::int32_t *const column = b.column.data(), *const start = b.start.data();
    const double* const value = b.value.data();
    const std::int32_t end = a.start[row + 1];
    for (std::int32_t p = a.start[row]; p < end; ++p) {
      const std::int64_t number = Transposed ? a.block[p] : p;
      std::array<double, H * K> block;
      std::copy_n(a.value.data() + number * H * K, H * K, block.begin());
      const std::int32_t k = a.column[p], last = start[k + 1];
      for (std::int32_t q = start[k]; q < last; ++q) {
        add_product<H, K, Transposed>(block.data(), value + std::int64_t(q) * K * width,
                                      sum.at(column[q]));
      }
    }
  });
  return c;
}

}  // namespace

void join_rows(BlockMatrix& m, std::vector<MatrixRows>& batches, int threads) {
  m.start.assign(1, 0);
  std::vector<std::int64_t> first;
  std::int64_t count = 0;
  for (const MatrixRows& rows : batches) {
    first.push_back(count);
    count += std::ssize(rows.column);
    if (count > INT32_MAX)
      throw std::invalid_argument("a preconditioner may have up to 2^31 matrix entries a level");
    for (const std::int32_t length : rows.length) m.start.push_back(m.start.back() + length);
  }
  m.column.resize(count);
  m.value.resize(count * m.block());
  for_rows(std::ssize(batches), threads, [&](std::int64_t b) {
    const MatrixRows rows = std::move(batches[b]);
    std::ranges::copy(rows.column, m.column.begin() + first[b]);
    std::ranges::copy(rows.value, m.value.begin() + first[b] * m.block());
  });
}

BlockMatrix multiply(const BlockMatrix& a, const BlockMatrix& b, int threads) {
  const Left left{a.rows, a.start, a.column, a.value, nullptr};
  return a.height == 1 ? product<1, 1, false>(left, b, threads)
                       : product<4, 4, false>(left, b, threads);
}

Transposed transpose(const BlockMatrix& a) {
  Transposed t;
  t.start.assign(a.columns + 1, 0);
  for (const std::int32_t c : a.column) ++t.start[c + 1];
  std::partial_sum(t.start.begin(), t.start.end(), t.start.begin());
  std::vector<std::int32_t> next(t.start.begin(), t.start.end() - 1);
  t.column.resize(a.column.size());
  t.from.resize(a.column.size());
  for (std::int32_t row = 0; row < a.rows; ++row) {
    for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
      const std::int32_t to = next[a.column[p]]++;
      t.column[to] = row;
      t.from[to] = p;
    }
  }
  return t;
}

BlockMatrix multiply_transposed(const BlockMatrix& a, const Transposed& transposed,
                                const BlockMatrix& b, int threads) {
  const Left left{a.columns, transposed.start, transposed.column, a.value, transposed.from.data()};
  return a.height == 1 ? product<4, 1, true>(left, b, threads)
                       : product<4, 4, true>(left, b, threads);
}

void apply(const BlockMatrix& a, const std::vector<double>& x, std::vector<double>& y,
           int threads) {
  y.resize(std::size_t(a.rows) * a.height);
  for_rows(a.rows, threads, [&](std::int64_t row) {
    std::array<double, 4> sum{};
    for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
      const double* block = a.value.data() + p * a.block();
      const double* own = x.data() + std::int64_t(a.column[p]) * a.width;
      for (int i = 0; i < a.height; ++i) {
        for (int j = 0; j < a.width; ++j) sum[i] += block[i * a.width + j] * own[j];
      }
    }
    std::copy_n(sum.begin(), a.height, y.begin() + row * a.height);
  });
}

// Written out, because a library's sums, and with them the bits of every step, would depend on the number of threads.
// Right-looking elimination of [A | I], four pivots at a time for the cache.
std::vector<double> inverse_cholesky_factor(std::vector<double> matrix, int n, int threads) {
  constexpr int strip = 4;
  std::vector<double> inverse(std::size_t(n) * n, 0.0);
  double* a = matrix.data();
  double* x = inverse.data();
  for (int i = 0; i < n; ++i) x[std::int64_t(i) * n + i] = 1.0;
  // row `i` less its part along the finished row `k`
  const auto eliminate = [&](std::int64_t k, std::int64_t i) {
    const double f = a[k * n + i];
    for (std::int64_t j = i; j < n; ++j) a[i * n + j] -= f * a[k * n + j];
    for (std::int64_t j = 0; j <= k; ++j) x[i * n + j] -= f * x[k * n + j];
  };
  run_team(std::min(threads, n / 64 + 1), [&](const Team& team) {
    for (int first = 0; first < n; first += strip) {
      const int end = std::min(first + strip, n);
      if (team.rank == 0) {
        for (std::int64_t k = first; k < end; ++k) {
          const double scale = 1.0 / std::sqrt(a[k * n + k]);
          for (std::int64_t j = k; j < n; ++j) a[k * n + j] *= scale;
          for (std::int64_t j = 0; j <= k; ++j) x[k * n + j] *= scale;
          for (std::int64_t i = k + 1; i < end; ++i) eliminate(k, i);
        }
      }
      team.barrier();
      for (std::int64_t i = end + team.rank; i < n; i += team.size) {
        for (std::int64_t k = first; k < end; ++k) eliminate(k, i);
      }
      team.barrier();
    }
  });
  std::vector<double> packed;
  packed.reserve(std::size_t(n) * (n + 1) / 2);
  for (std::int64_t i = 0; i < n; ++i) packed.insert(packed.end(), x + i * n, x + i * n + i + 1);
  return packed;
}

}  // namespace pd
