// The directions that loaded pairs leave to the bodies, of one environment, in double.
//
// Row p says that C_p moves nothing, and column B_p is the direction of its force. Both are scaled by
// the square root of the step of p in the sweeps of a solver (contact/pairs/multiplier.h), so that
// multipliers change by C q from those that a step began with. Rows repeat each other where faces
// lie on faces. A pivoted Cholesky factor S = C D^-1 C^T = L L^T, which ends at its rank, names
// independent rows r. With them
//
//   project   r - C_r^T (C_r D^-1 C_r^T)^-1 C_r D^-1 r             the part of r off all rows
//   slant     y - D^-1 C_r^T (L^T B^T D^-1 C_r^T)^-1 L^T B^T y     moves with L^T B^T l = 0
//
// Rows that share no vertex, directly or through others, are factored apart.
#pragma once
#include "math/vec.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

namespace pd::inline PD_TARGET {

// Square of the sine of the angle to other rows, below which a row counts as one of their span.
template <class T>
constexpr double repeated_row = sizeof(T) == 4 ? 1e-6 : 1e-8;

struct PairRow {
  int vertex[4];                    // -1: does not move
  Vec3<double> held[4], pushed[4];  // C and B
};

class PairRows {
 public:
  // Rows among so many vertices.
  void clear(int vertices) {
    rows_.clear();
    patches_.clear();
    skewed_ = false;
    inverse_.assign(vertices, 0.0);
  }
  // `skewed`: B differs from C
  void add(const PairRow& row, bool skewed) {
    rows_.push_back(row);
    skewed_ = skewed_ || skewed;
  }
  double& inverse(int vertex) { return inverse_[vertex]; }  // 1 / D
  bool skewed() const { return skewed_; }

  void factor(double tolerance) {
    index();
    find_patches();
    for (Patch& patch : patches_) factor(patch, tolerance);
  }

  // `read(vertex)`: of the field; `add(vertex, change)`: to it. Twice, since rows that nearly repeat others cost digits.
  template <class Read, class Add>
  void project(const Read& read, const Add& add) {
    for (int round = 0; round < 2; ++round) project_once(read, add);
  }

  template <class Read, class Add>
  void slant(const Read& read, const Add& add) {
    for (const Patch& patch : patches_) {
      const std::size_t rank = patch.pivots.size();
      sums_.assign(rank, 0.0);
      for (std::size_t p = 0; p < patch.rows.size(); ++p) {
        const PairRow& row = rows_[patch.rows[p]];
        double along = 0;
        for (int a = 0; a < 4; ++a)
          if (row.vertex[a] >= 0) along += dot(row.pushed[a], read(row.vertex[a]));
        const double* const low = patch.low.data() + p * rank;
        for (std::size_t j = 0; j < rank; ++j) sums_[j] += along * low[j];
      }
      solve_mixed(patch, sums_);
      for (std::size_t j = 0; j < rank; ++j)
        each_held(rows_[patch.rows[patch.pivots[j]]],
                  [&](int v, const Vec3<double>& c) { add(v, (-sums_[j] * inverse_[v]) * c); });
    }
  }

  // The multipliers nu of all rows with C^T nu = field, of least square.
  template <class Read>
  std::vector<double> multipliers(const Read& read) {
    std::vector<double> found(rows_.size(), 0.0);
    for (const Patch& patch : patches_) {
      const std::size_t rank = patch.pivots.size();
      sums_.clear();
      for (int p : patch.pivots) sums_.push_back(weighted(rows_[patch.rows[p]], read));
      solve(patch, sums_);
      // from those of the independent rows: L (L^T L)^-1 L_r^T
      std::vector<double> spread(rank, 0.0), gram(rank * rank, 0.0);
      for (std::size_t i = 0; i < rank; ++i)
        for (std::size_t j = 0; j <= i; ++j) spread[j] += patch.lower[i * rank + j] * sums_[i];
      for (std::size_t p = 0; p < patch.rows.size(); ++p) {
        const double* const low = patch.low.data() + p * rank;
        for (std::size_t i = 0; i < rank; ++i)
          for (std::size_t j = 0; j < rank; ++j) gram[i * rank + j] += low[i] * low[j];
      }
      std::vector<int> order;
      decompose(gram, rank, order);
      solve_decomposed(gram, order, spread);
      for (std::size_t p = 0; p < patch.rows.size(); ++p)
        for (std::size_t j = 0; j < rank; ++j)
          found[patch.rows[p]] += patch.low[p * rank + j] * spread[j];
    }
    return found;
  }

 private:
  struct Patch {
    std::vector<int> rows, pivots;  // numbers of all rows, and places of the independent ones there
    std::vector<double> low, lower,
        mixed;               // L [rows, rank], L_r and L^T B^T D^-1 C_r^T [rank, rank]
    std::vector<int> order;  // rows of the decomposed `mixed`
  };

  template <class Visit>
  static void each_held(const PairRow& row, const Visit& visit) {
    for (int a = 0; a < 4; ++a)
      if (row.vertex[a] >= 0) visit(row.vertex[a], row.held[a]);
  }

  // C_p D^-1 of a field
  template <class Read>
  double weighted(const PairRow& row, const Read& read) const {
    double sum = 0;
    each_held(row, [&](int v, const Vec3<double>& c) { sum += inverse_[v] * dot(c, read(v)); });
    return sum;
  }

  // Rows and corners of every vertex, in the order of the rows.
  void index() {
    start_.assign(inverse_.size() + 1, 0);
    for (const PairRow& row : rows_)
      for (int v : row.vertex)
        if (v >= 0) ++start_[v + 1];
    for (std::size_t v = 0; v < inverse_.size(); ++v) start_[v + 1] += start_[v];
    entry_.resize(start_.back());
    std::vector<int> at(start_.begin(), start_.end() - 1);
    for (int p = 0; p < int(rows_.size()); ++p)
      for (int a = 0; a < 4; ++a)
        if (rows_[p].vertex[a] >= 0) entry_[at[rows_[p].vertex[a]]++] = 4 * p + a;
  }

  void find_patches() {
    place_.assign(rows_.size(), -1);
    for (int first = 0; first < int(rows_.size()); ++first) {
      if (place_[first] >= 0) continue;
      Patch patch;
      place_[first] = 0;
      patch.rows.push_back(first);
      for (std::size_t next = 0; next < patch.rows.size(); ++next) {
        for (int v : rows_[patch.rows[next]].vertex) {
          for (int n = v < 0 ? 0 : start_[v]; v >= 0 && n < start_[v + 1]; ++n) {
            const int row = entry_[n] / 4;
            if (place_[row] >= 0) continue;
            place_[row] = 0;
            patch.rows.push_back(row);
          }
        }
      }
      std::sort(patch.rows.begin(), patch.rows.end());
      for (std::size_t p = 0; p < patch.rows.size(); ++p) place_[patch.rows[p]] = int(p);
      patches_.push_back(std::move(patch));
    }
  }

  // Adds (row D^-1 C_q^T) of all rows of the patch to a column, by C or by B.
  void couple(const PairRow& q, bool pushed, double* column) const {
    each_held(q, [&](int v, const Vec3<double>& c) {
      const Vec3<double> moved = inverse_[v] * c;
      for (int n = start_[v]; n < start_[v + 1]; ++n) {
        const PairRow& row = rows_[entry_[n] / 4];
        const int a = entry_[n] % 4;
        column[place_[entry_[n] / 4]] += dot(pushed ? row.pushed[a] : row.held[a], moved);
      }
    });
  }

  void factor(Patch& patch, double tolerance) const {
    const std::size_t count = patch.rows.size();
    std::vector<double> whole(count), left(count);
    for (std::size_t p = 0; p < count; ++p) {
      double sum = 0;
      each_held(rows_[patch.rows[p]],
                [&](int v, const Vec3<double>& c) { sum += inverse_[v] * dot(c, c); });
      whole[p] = left[p] = sum;
    }
    std::vector<std::vector<double>> columns;
    for (;;) {
      double largest = tolerance;
      int best = -1;
      for (std::size_t p = 0; p < count; ++p) {
        if (!(left[p] > largest * whole[p])) continue;
        largest = left[p] / whole[p];
        best = int(p);
      }
      if (best < 0) break;
      std::vector<double> column(count, 0.0);
      couple(rows_[patch.rows[best]], false, column.data());
      for (const auto& other : columns) {
        const double by = other[best];
        for (std::size_t p = 0; p < count; ++p) column[p] -= by * other[p];
      }
      const double scale = 1 / std::sqrt(left[best]);
      for (std::size_t p = 0; p < count; ++p) {
        column[p] *= scale;
        left[p] -= column[p] * column[p];
      }
      left[best] = 0;
      patch.pivots.push_back(best);
      columns.push_back(std::move(column));
    }
    const std::size_t rank = columns.size();
    patch.low.resize(count * rank);
    patch.lower.resize(rank * rank);
    for (std::size_t j = 0; j < rank; ++j) {
      for (std::size_t p = 0; p < count; ++p) patch.low[p * rank + j] = columns[j][p];
      for (std::size_t i = 0; i < rank; ++i)
        patch.lower[i * rank + j] = columns[j][patch.pivots[i]];
    }
    if (skewed_) mix(patch);
  }

  void mix(Patch& patch) const {
    const std::size_t count = patch.rows.size(), rank = patch.pivots.size();
    patch.mixed.assign(rank * rank, 0.0);
    std::vector<double> column(count);
    for (std::size_t j = 0; j < rank; ++j) {
      std::fill(column.begin(), column.end(), 0.0);
      couple(rows_[patch.rows[patch.pivots[j]]], true, column.data());
      for (std::size_t p = 0; p < count; ++p) {
        if (column[p] == 0.0) continue;
        for (std::size_t i = 0; i < rank; ++i)
          patch.mixed[i * rank + j] += column[p] * patch.low[p * rank + i];
      }
    }
    decompose(patch.mixed, rank, patch.order);
  }

  template <class Read, class Add>
  void project_once(const Read& read, const Add& add) {
    for (const Patch& patch : patches_) {
      sums_.clear();
      for (int p : patch.pivots) sums_.push_back(weighted(rows_[patch.rows[p]], read));
      solve(patch, sums_);
      for (std::size_t j = 0; j < patch.pivots.size(); ++j)
        each_held(rows_[patch.rows[patch.pivots[j]]],
                  [&](int v, const Vec3<double>& c) { add(v, -sums_[j] * c); });
    }
  }

  // sums <- (L_r L_r^T)^-1 sums
  static void solve(const Patch& patch, std::vector<double>& sums) {
    const std::size_t rank = sums.size();
    const double* const l = patch.lower.data();
    for (std::size_t i = 0; i < rank; ++i) {
      for (std::size_t j = 0; j < i; ++j) sums[i] -= l[i * rank + j] * sums[j];
      sums[i] /= l[i * rank + i];
    }
    for (std::size_t i = rank; i-- > 0;) {
      sums[i] /= l[i * rank + i];
      for (std::size_t j = 0; j < i; ++j) sums[j] -= l[i * rank + j] * sums[i];
    }
  }

  static void solve_mixed(const Patch& patch, std::vector<double>& sums) {
    solve_decomposed(patch.mixed, patch.order, sums);
  }

  // LU factors with partial pivoting, in place.
  static void decompose(std::vector<double>& a, std::size_t size, std::vector<int>& order) {
    order.resize(size);
    for (std::size_t i = 0; i < size; ++i) order[i] = int(i);
    for (std::size_t k = 0; k < size; ++k) {
      std::size_t best = k;
      for (std::size_t i = k + 1; i < size; ++i)
        if (std::abs(a[i * size + k]) > std::abs(a[best * size + k])) best = i;
      if (best != k) {
        std::swap_ranges(&a[k * size], &a[k * size] + size, &a[best * size]);
        std::swap(order[k], order[best]);
      }
      for (std::size_t i = k + 1; i < size; ++i) {
        const double by = a[i * size + k] /= a[k * size + k];
        for (std::size_t j = k + 1; j < size; ++j) a[i * size + j] -= by * a[k * size + j];
      }
    }
  }

  static void solve_decomposed(const std::vector<double>& a, const std::vector<int>& order,
                               std::vector<double>& sums) {
    const std::size_t size = order.size();
    const std::vector<double> given = sums;
    for (std::size_t i = 0; i < size; ++i) {
      sums[i] = given[order[i]];
      for (std::size_t j = 0; j < i; ++j) sums[i] -= a[i * size + j] * sums[j];
    }
    for (std::size_t i = size; i-- > 0;) {
      for (std::size_t j = i + 1; j < size; ++j) sums[i] -= a[i * size + j] * sums[j];
      sums[i] /= a[i * size + i];
    }
  }

  std::vector<PairRow> rows_;
  std::vector<Patch> patches_;
  std::vector<double> inverse_;     // [vertices]
  std::vector<int> start_, entry_;  // of the vertices: 4 row + corner
  std::vector<int> place_;          // of every row in its patch
  std::vector<double> sums_;
  bool skewed_ = false;
};

}  // namespace pd::inline PD_TARGET
