// Sparse matrices of small dense blocks, for the levels of a preconditioner. In double, on the CPU.
#pragma once

#include "threads/team.h"

#include <algorithm>
#include <cstdint>
#include <vector>

namespace pd {

// Block compressed rows; the blocks are [height, width], row by row, and ascend by column in a row.
struct BlockMatrix {
  int height = 1, width = 1;
  std::int32_t rows = 0, columns = 0;  // of blocks
  std::vector<std::int32_t> start = {0}, column;
  std::vector<double> value;

  std::int64_t block() const { return std::int64_t(height) * width; }
};

// Rows of a matrix, one after the other.
struct MatrixRows {
  std::vector<std::int32_t> length, column;
  std::vector<double> value;
};

// One row in progress: its columns in order of appearance, and a dense block for each.
class RowSum {
 public:
  // Blocks of `block` numbers start at `zero`; -0.0 keeps the sign of a first zero.
  RowSum(std::int32_t columns, std::int64_t block, double zero)
      : place_(columns, -1), value_(block), block_(block), zero_(zero) {}

  // The block of a column, until the next call.
  double* at(std::int32_t column) {
    std::int32_t& place = place_[column];
    if (place < 0) {
      place = std::int32_t(column_.size());
      column_.push_back(column);
      if (std::ssize(column_) * block_ > std::ssize(value_)) value_.resize(2 * value_.size());
      std::fill_n(value_.data() + place * block_, block_, zero_);
    }
    return value_.data() + place * block_;
  }

  // Appends the row in ascending order and clears it.
  void move_to(MatrixRows& rows) {
    std::sort(column_.begin(), column_.end());
    for (const std::int32_t column : column_) {
      const double* from = value_.data() + place_[column] * block_;
      rows.value.insert(rows.value.end(), from, from + block_);
      place_[column] = -1;
    }
    rows.column.insert(rows.column.end(), column_.begin(), column_.end());
    rows.length.push_back(std::int32_t(column_.size()));
    column_.clear();
  }

 private:
  std::vector<std::int32_t> place_, column_;
  std::vector<double> value_;
  std::int64_t block_;
  double zero_;
};

// Calls work(row) for every row.
template <class Work>
void for_rows(std::int64_t rows, int threads, Work work) {
  run_team(threads, [&](const Team& team) {
    for (std::int64_t row = team.begin(rows); row < team.end(rows); ++row) work(row);
  });
}

// Joins the rows of `batches` in `m`. Throws std::invalid_argument for more entries than 32 bits count.
void join_rows(BlockMatrix& m, std::vector<MatrixRows>& batches, int threads);

// Makes the rows of `m`: fill(row, sum) adds up each one.
template <class Fill>
void sum_rows(BlockMatrix& m, double zero, int threads, Fill fill) {
  constexpr std::int64_t batch = 2048;
  std::vector<MatrixRows> batches((m.rows + batch - 1) / batch);
  run_team(threads, [&](const Team& team) {
    RowSum sum(m.columns, m.block(), zero);
    for (std::int64_t b = team.begin(std::ssize(batches)); b < team.end(std::ssize(batches)); ++b) {
      for (std::int64_t row = b * batch; row < std::min<std::int64_t>(m.rows, (b + 1) * batch);
           ++row) {
        fill(std::int32_t(row), sum);
        sum.move_to(batches[b]);
      }
    }
  });
  join_rows(m, batches, threads);
}

// a b, a of square blocks of 1 or 4, b of width 4. Every row adds up in the same order for any number of threads.
BlockMatrix multiply(const BlockMatrix& a, const BlockMatrix& b, int threads);

// The rows of a transposed matrix: the columns, and the places of their blocks in the matrix itself.
struct Transposed {
  std::vector<std::int32_t> start, column, from;
};

Transposed transpose(const BlockMatrix& a);

// a^T b, a and b of height 1 or 4 and width 4.
BlockMatrix multiply_transposed(const BlockMatrix& a, const Transposed& transposed,
                                const BlockMatrix& b, int threads);

// y = a x, blocks of height up to 4
void apply(const BlockMatrix& a, const std::vector<double>& x, std::vector<double>& y, int threads);

// Inverse of the lower Cholesky factor of a symmetric positive definite matrix [n, n], row by row up to the diagonal.
std::vector<double> inverse_cholesky_factor(std::vector<double> matrix, int n, int threads);

}  // namespace pd
