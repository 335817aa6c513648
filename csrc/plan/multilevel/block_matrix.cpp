#include "plan/multilevel/block_matrix.h"

#include "threads/team.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>

namespace pd {

namespace {

// One row of a product in progress: its columns in order of appearance, and a dense block for each.
class RowSum {
 public:
  RowSum(std::int32_t columns, std::int64_t block) : place_(columns, -1), block_(block) {}

  double* at(std::int32_t column) {
    if (place_[column] < 0) {
      place_[column] = std::int32_t(column_.size());
      column_.push_back(column);
      value_.resize(value_.size() + block_, 0.0);
    }
    return value_.data() + place_[column] * block_;
  }

  // appends the row in ascending order and clears it
  void move_to(std::vector<std::int32_t>& column, std::vector<double>& value) {
    std::vector<std::int32_t>& ordered = ordered_;
    ordered = column_;
    std::sort(ordered.begin(), ordered.end());
    for (const std::int32_t c : ordered) {
      const double* from = value_.data() + place_[c] * block_;
      column.push_back(c);
      value.insert(value.end(), from, from + block_);
      place_[c] = -1;
    }
    column_.clear();
    value_.clear();
  }

 private:
  std::vector<std::int32_t> place_, column_, ordered_;
  std::vector<double> value_;
  std::int64_t block_;
};

// c += a b of blocks [h, k] and [k, w]
void add_product(const double* a, const double* b, int h, int k, int w, double* c) {
  for (int i = 0; i < h; ++i) {
    for (int j = 0; j < k; ++j) {
      const double f = a[i * k + j];
      for (int l = 0; l < w; ++l) c[i * w + l] += f * b[j * w + l];
    }
  }
}

// The rows made by one thread.
struct Part {
  std::vector<std::int32_t> length, column;
  std::vector<double> value;
};

}  // namespace

BlockMatrix multiply(const BlockMatrix& a, const BlockMatrix& b, int threads) {
  BlockMatrix c{a.height, b.width, a.rows, b.columns, {0}, {}, {}};
  std::vector<Part> parts(threads);
  run_team(threads, [&](const Team& team) {
    Part& part = parts[team.rank];
    RowSum sum(b.columns, c.block());
    for (std::int64_t row = team.begin(a.rows); row < team.end(a.rows); ++row) {
      const std::size_t before = part.column.size();
      for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
        const std::int32_t k = a.column[p];
        for (std::int32_t q = b.start[k]; q < b.start[k + 1]; ++q) {
          add_product(a.value.data() + p * a.block(), b.value.data() + q * b.block(), a.height,
                      a.width, b.width, sum.at(b.column[q]));
        }
      }
      sum.move_to(part.column, part.value);
      part.length.push_back(std::int32_t(part.column.size() - before));
    }
  });
  for (const Part& part : parts) {
    if (c.column.size() + part.column.size() > std::size_t(INT32_MAX))
      throw std::invalid_argument("a preconditioner may have up to 2^31 matrix entries a level");
    for (const std::int32_t length : part.length) c.start.push_back(c.start.back() + length);
    c.column.insert(c.column.end(), part.column.begin(), part.column.end());
    c.value.insert(c.value.end(), part.value.begin(), part.value.end());
  }
  return c;
}

Transposed transpose(const BlockMatrix& a) {
  Transposed t{{a.width, a.height, a.columns, a.rows, {}, {}, {}}, {}};
  t.matrix.start.assign(a.columns + 1, 0);
  for (const std::int32_t c : a.column) ++t.matrix.start[c + 1];
  std::partial_sum(t.matrix.start.begin(), t.matrix.start.end(), t.matrix.start.begin());
  std::vector<std::int32_t> next(t.matrix.start.begin(), t.matrix.start.end() - 1);
  t.matrix.column.resize(a.column.size());
  t.matrix.value.resize(a.value.size());
  t.from.resize(a.column.size());
  for (std::int32_t row = 0; row < a.rows; ++row) {
    for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
      const std::int32_t to = next[a.column[p]]++;
      t.matrix.column[to] = row;
      t.from[to] = p;
      for (int i = 0; i < a.height; ++i) {
        for (int j = 0; j < a.width; ++j)
          t.matrix.value[to * a.block() + j * a.height + i] =
              a.value[p * a.block() + i * a.width + j];
      }
    }
  }
  return t;
}

void apply(const BlockMatrix& a, const std::vector<double>& x, std::vector<double>& y,
           int threads) {
  y.assign(std::size_t(a.rows) * a.height, 0.0);
  run_team(threads, [&](const Team& team) {
    for (std::int64_t row = team.begin(a.rows); row < team.end(a.rows); ++row) {
      for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
        add_product(a.value.data() + p * a.block(), x.data() + std::int64_t(a.column[p]) * a.width,
                    a.height, a.width, 1, y.data() + row * a.height);
      }
    }
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
