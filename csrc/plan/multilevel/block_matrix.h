// Sparse matrices of small dense blocks, for the levels of a preconditioner. In double, on the CPU.
#pragma once

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

// a b. Every row adds up in the same order for any number of threads.
BlockMatrix multiply(const BlockMatrix& a, const BlockMatrix& b, int threads);

// The transposed matrix, and the place of each of its blocks in `a`.
struct Transposed {
  BlockMatrix matrix;
  std::vector<std::int32_t> from;
};

Transposed transpose(const BlockMatrix& a);

// y = a x
void apply(const BlockMatrix& a, const std::vector<double>& x, std::vector<double>& y, int threads);

// Inverse of the lower Cholesky factor of a symmetric positive definite matrix [n, n], row by row up to the diagonal.
std::vector<double> inverse_cholesky_factor(std::vector<double> matrix, int n, int threads);

}  // namespace pd
