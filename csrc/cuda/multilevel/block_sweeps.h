// Inverses of the dense matrices of solver/multilevel/pieces.h by a team of blocks, in double and in a fixed order.
//
// Sweep k turns entries of the blocks of piece k into those of minus the inverse (Goodnight 1979), S = A_kk:
//   A_kk = -S^-1,   A_ik = A_ik S^-1,   A_ij = A_ij - A_ik S^-1 A_kj
// Lower triangles alone are stored. A panel holds column k while its blocks change: [matrices, pieces, 6, 6].
#pragma once
#include "cuda/multilevel/pieces.h"

namespace pd::inline PD_TARGET {

// Rows of a triangle of `pieces` rows, first and last by turns, so that any two have pieces + 1 blocks.
struct TriangleBlock {
  int row, column;

  PD_DEVICE TriangleBlock(int number, int pieces) {
    const int fold = number / (pieces + 1), at = number % (pieces + 1);
    const bool late = at < pieces - fold;
    row = late ? pieces - 1 - fold : fold;
    column = late ? at : at - (pieces - fold);
  }
  PD_DEVICE int pair() const { return piece_pair(row, column); }
};

template <class T>
class BlockSweeps {
 public:
  PD_DEVICE BlockSweeps(int pieces, const PiecesMemory<T>& memory, BlockTeam& team,
                        PiecesControl<T>& control)
      : pieces_(pieces), m_(memory), team_(team), c_(control) {}

  PD_DEVICE double* panel(int k, int matrix) const {
    return m_.panel + std::int64_t(2 * (k & 1) + matrix) * pieces_ * piece_block;
  }

  // Replaces the first `matrices` of m_.block, whose first column is in the panel, by their inverses, times m_.scale on
  // both sides. Returns false if a pivot is not positive. Called by all threads of the team, after a barrier.
  PD_DEVICE bool invert(int matrices) const {
#pragma unroll 1
    for (int k = 0; k < pieces_; ++k) {
      if (!invert_pivots(k, matrices)) return false;
      sweep(k, matrices);
      team_.barrier();
    }
    rescale(matrices);
    team_.barrier();
    return true;
  }

 private:
  // S^-1, by a warp for each matrix, in every block
  PD_DEVICE bool invert_pivots(int k, int matrices) const {
    const int warp = threadIdx.x / warp_size;
    if (warp < matrices) {
      const bool positive =
          invert_block(panel(k, warp) + std::int64_t(k) * piece_block, c_.pivot[warp]);
      if (threadIdx.x % warp_size == 0) c_.positive[warp] = positive;
    }
    __syncthreads();
    return c_.positive[0] && (matrices == 1 || c_.positive[1]);
  }

  // Scalar sweeps, by one warp, of the lower triangle.
  PD_DEVICE static bool invert_block(const double* from, double* to) {
    constexpr int each = (piece_block + warp_size - 1) / warp_size;
    const int lane = threadIdx.x % warp_size;
    bool positive = true;
    for (int e = lane; e < piece_block; e += warp_size) {
      const int i = e / piece_modes, j = e % piece_modes;
      to[e] = from[i < j ? piece_modes * j + i : e];
    }
    __syncwarp();
#pragma unroll 1
    for (int k = 0; k < piece_modes; ++k) {
      const double pivot = to[(piece_modes + 1) * k], share = 1 / pivot;
      positive = positive && pivot > 0 && pivot < HUGE_VAL;
      double next[each];
#pragma unroll
      for (int n = 0; n < each; ++n) {
        const int e = min(lane + n * warp_size, piece_block - 1);
        const int i = e / piece_modes, j = e % piece_modes;
        const double left = to[piece_modes * i + k], right = to[piece_modes * k + j];
        next[n] = i == k && j == k ? -share
                  : i == k         ? share * right
                  : j == k         ? share * left
                                   : to[e] - share * (left * right);
      }
      __syncwarp();
#pragma unroll
      for (int n = 0; n < each; ++n) {
        if (lane + n * warp_size < piece_block) to[lane + n * warp_size] = next[n];
      }
      __syncwarp();
    }
    for (int e = lane; e < piece_block; e += warp_size) to[e] = -to[e];
    return positive;
  }

  // A thread for each row of a block.
  PD_DEVICE void sweep(int k, int matrices) const {
    const int rows = piece_pair(pieces_, 0) * piece_modes;
#pragma unroll 1
    for (int t = team_.thread(); t < matrices * rows; t += team_.threads()) {
      const int matrix = t / rows, r = t % piece_modes;
      sweep_row(k, matrix, TriangleBlock(t % rows / piece_modes, pieces_), r);
    }
  }

  PD_DEVICE void sweep_row(int k, int matrix, const TriangleBlock& at, int r) const {
    const double* column = panel(k, matrix);
    const double* pivot = c_.pivot[matrix];
    double* to = m_.block[matrix] + std::int64_t(at.pair()) * piece_block + piece_modes * r;
    const bool own = at.row == k;
    double left[piece_modes], value[piece_modes];  // row r of A_ik S^-1, or of S^-1
#pragma unroll
    for (int b = 0; b < piece_modes; ++b) left[b] = own ? pivot[piece_modes * r + b] : 0;
    if (!own) {
      const double* row = column + std::int64_t(at.row) * piece_block + piece_modes * r;
#pragma unroll
      for (int a = 0; a < piece_modes; ++a) {
        const double x = row[a];
#pragma unroll
        for (int b = 0; b < piece_modes; ++b) left[b] += x * pivot[piece_modes * a + b];
      }
    }
    if (at.column == k) {
#pragma unroll
      for (int b = 0; b < piece_modes; ++b) value[b] = own ? -left[b] : left[b];
    } else {
      const double* other = column + std::int64_t(at.column) * piece_block;
#pragma unroll
      for (int b = 0; b < piece_modes; ++b) {
        double sum = 0;
#pragma unroll
        for (int a = 0; a < piece_modes; ++a) sum += left[a] * other[piece_modes * b + a];
        value[b] = own ? sum : to[b] - sum;
      }
    }
#pragma unroll
    for (int b = 0; b < piece_modes; ++b) to[b] = value[b];
    store_next(k + 1, matrix, at, r, value);
  }

  // the column of the next sweep
  PD_DEVICE void store_next(int k, int matrix, const TriangleBlock& at, int r,
                            const double (&value)[piece_modes]) const {
    if (at.row != k && at.column != k) return;
    double* to = panel(k, matrix);
    if (at.column == k) {
      to += std::int64_t(at.row) * piece_block + piece_modes * r;
#pragma unroll
      for (int b = 0; b < piece_modes; ++b) to[b] = value[b];
    } else {
      to += std::int64_t(at.column) * piece_block + r;
#pragma unroll
      for (int b = 0; b < piece_modes; ++b) to[piece_modes * b] = value[b];
    }
  }

  PD_DEVICE void rescale(int matrices) const {
    const int count = piece_pair(pieces_, 0) * piece_block;
#pragma unroll 1
    for (int t = team_.thread(); t < matrices * count; t += team_.threads()) {
      const TriangleBlock at(t % count / piece_block, pieces_);
      const int e = t % piece_block;
      double& value = m_.block[t / count][std::int64_t(at.pair()) * piece_block + e];
      value *= -m_.scale[piece_modes * at.row + e / piece_modes] *
               m_.scale[piece_modes * at.column + e % piece_modes];
    }
  }

  int pieces_;
  const PiecesMemory<T>& m_;
  BlockTeam& team_;
  PiecesControl<T>& c_;
};

}  // namespace pd::inline PD_TARGET
