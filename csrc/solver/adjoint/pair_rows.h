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
// Both use inverses, whose products need no order, and go twice, which restores the digits that an
// inverse and rows that nearly repeat others cost. Patches of rows are factored apart.
#pragma once
#include "solver/adjoint/pair_memory.h"

namespace pd::inline PD_TARGET {

// Square of the sine of the angle to other rows, below which a row counts as one of their span.
template <class T>
constexpr double repeated_row = sizeof(T) == 4 ? 1e-6 : 1e-8;

// `Team`: as OneThread
template <class Team>
class PairRows {
 public:
  using Place = Vec3<double>;

  PD_HD PairRows(const Team& team, const PairMemory& memory, int nodes)
      : team_(team), m_(memory), nodes_(nodes) {}

  // Of rows that are there. `skewed`: B differs from C.
  PD_CALLED void factor(const PairFactors& factors, double tolerance, bool skewed) {
    f_ = factors;
    skewed_ = skewed;
    team_.each(m_.counts->rows, [&](int p) {
      double sum = 0;
      each_held(p, [&](int v, const Place& c) { sum += m_.inverse[v] * dot(c, c); });
      m_.whole[p] = m_.left[p] = sum;
      m_.as_pivot[p] = -1;
    });
    std::int64_t low = 0, square = 0;
    int pivots = 0;
    for (int n = 0; n < m_.counts->patches; ++n) {
      PairPatch patch = m_.patch[n];
      patch.low = low;
      patch.square = square;
      patch.first_pivot = pivots;
      patch.rank = choose(patch, tolerance);
      low += std::int64_t(patch.rank) * (patch.end - patch.begin);
      square += std::int64_t(patch.rank) * patch.rank;
      pivots += patch.rank;
      team_.each(patch.rank, [&](int k) { m_.of_patch[patch.first_pivot + k] = n; });
      team_.once([&] { m_.patch[n] = patch; });
      invert_lower(patch);
      if (skewed_) mix(patch);
    }
    team_.once([&] { m_.counts->pivots = pivots; });
  }

  // `read(node)`: of the field; `add(node, change)`: to it.
  template <class Read, class Add>
  PD_HD void project(const Read& read, const Add& add) const {
    PD_ROLLED
    for (int round = 0; round < 2; ++round) {
      weigh(read);
      upper(m_.turned, m_.sums);
      add_held(add, [](int) { return -1.0; });
    }
  }

  // `rounds`: 1 suffices for a direction of search, whose product shows what it is.
  template <class Read, class Add>
  PD_HD void slant(int rounds, const Read& read, const Add& add) const {
    if (!skewed_) return;  // moves off the rows
    PD_ROLLED
    for (int round = 0; round < rounds; ++round) {
      team_.each(m_.counts->rows, [&](int p) {
        const std::int64_t at = first_slot(p);
        double sum = 0;
        for (int s = 0; s < m_.slots; ++s)
          if (m_.moves[at + s] >= 0) sum += dot(m_.pushed[at + s], read(m_.moves[at + s]));
        m_.along[p] = sum;
      });
      lower_transposed(m_.along, m_.turned);
      squares(f_.mixed, m_.turned, m_.sums);
      add_held(add, [&](int v) { return -m_.inverse[v]; });
    }
  }

  // Finds the multipliers nu [rows] of all rows with C^T nu = field, of least square.
  template <class Read>
  PD_HD double* multipliers(const Read& read) {
    weigh(read);
    // from those of the independent rows: L (L^T L)^-1 L_r^-1 C_r D^-1 of the field
    grams();
    squares(f_.mixed, m_.turned, m_.sums);
    spread_to_rows();
    lower_transposed(m_.found, m_.sums);
    const int pivots = m_.counts->pivots;
    team_.each(pivots, [&](int n) { m_.turned[n] -= m_.sums[n]; });
    team_.each(m_.counts->rows, [&](int p) { m_.along[p] = m_.found[p]; });
    squares(f_.mixed, m_.turned, m_.sums);
    spread_to_rows();
    team_.each(m_.counts->rows, [&](int p) { m_.found[p] += m_.along[p]; });
    return m_.found;
  }

 private:
  // Place `at` in the lower triangle of a matrix, counted row by row.
  struct Corner {
    int row, column;

    PD_HD explicit Corner(int at) : row(int((sqrt(8.0 * at + 1) - 1) / 2)) {
      column = at - row * (row + 1) / 2;
    }
  };

  template <class Visit>
  PD_HD void each_held(int p, const Visit& visit) const {
    const std::int64_t at = first_slot(p);
    for (int s = 0; s < m_.slots; ++s)
      if (m_.moves[at + s] >= 0) visit(m_.moves[at + s], m_.held[at + s]);
  }
  PD_HD std::int64_t first_slot(int p) const { return std::int64_t(m_.slots) * p; }
  PD_HD const PairPatch& patch_of(int pivot) const { return m_.patch[m_.of_patch[pivot]]; }
  PD_HD static int rows_of(const PairPatch& patch) { return patch.end - patch.begin; }

  // turned <- L_r^-1 C_r D^-1 field
  template <class Read>
  PD_HD void weigh(const Read& read) const {
    team_.each(m_.counts->pivots, [&](int n) {
      double sum = 0;
      each_held(m_.pivot[n],
                [&](int v, const Place& c) { sum += m_.inverse[v] * dot(c, read(v)); });
      m_.sums[n] = sum;
    });
    team_.dots(
        m_.counts->pivots,
        [&](int n) {
          const PairPatch& patch = patch_of(n);
          return DotProduct{square_row(f_.inverse_lower, patch, n), m_.sums + patch.first_pivot,
                            n - patch.first_pivot + 1};
        },
        [&](int n, double sum) { m_.turned[n] = sum; });
  }

  // to <- L_r^-T from
  PD_HD void upper(const double* from, double* to) const {
    team_.dots(
        m_.counts->pivots,
        [&](int n) {
          const PairPatch& patch = patch_of(n);
          const int own = n - patch.first_pivot;
          return DotProduct{square_row(f_.inverse_lower, patch, n) + own, from + n,
                            patch.rank - own};
        },
        [&](int n, double sum) { to[n] = sum; });
  }

  // to <- L^T from, a number of every row
  PD_HD void lower_transposed(const double* from, double* to) const {
    team_.dots(
        m_.counts->pivots,
        [&](int n) {
          const PairPatch& patch = patch_of(n);
          return DotProduct{column_of(patch, n - patch.first_pivot), from + patch.begin,
                            rows_of(patch)};
        },
        [&](int n, double sum) { to[n] = sum; });
  }

  // to <- the square matrix of every patch times from
  PD_HD void squares(double* of, const double* from, double* to) const {
    team_.dots(
        m_.counts->pivots,
        [&](int n) {
          const PairPatch& patch = patch_of(n);
          return DotProduct{square_row(of, patch, n), from + patch.first_pivot, patch.rank};
        },
        [&](int n, double sum) { to[n] = sum; });
  }

  // found <- L sums
  PD_HD void spread_to_rows() const {
    for (int n = 0; n < m_.counts->patches; ++n) {
      const PairPatch patch = m_.patch[n];
      team_.each(rows_of(patch), [&](int p) {
        double sum = 0;
        for (int k = 0; k < patch.rank; ++k)
          sum += column_of(patch, k)[p] * m_.sums[patch.first_pivot + k];
        m_.found[patch.begin + p] = sum;
      });
    }
  }

  // Adds factor(v) times C_r^T sums.
  template <class Add, class Factor>
  PD_HD void add_held(const Add& add, const Factor& factor) const {
    team_.each(nodes_, [&](int v) {
      if (!(m_.inverse[v] > 0)) return;
      Place sum = {0, 0, 0};
      bool some = false;
      for (int n = m_.start[v]; n < m_.start[v + 1]; ++n) {
        const int item = m_.entry[n] / m_.slots, s = m_.entry[n] % m_.slots;
        for (int p = m_.first[item]; p < m_.end[item]; ++p) {
          if (m_.as_pivot[p] < 0) continue;
          sum = sum + m_.sums[m_.as_pivot[p]] * m_.held[first_slot(p) + s];
          some = true;
        }
      }
      if (some) add(v, factor(v) * sum);
    });
  }

  PD_HD double* column_of(const PairPatch& patch, int k) const {
    return f_.low + patch.low + std::int64_t(k) * rows_of(patch);
  }
  // of pivot n
  PD_HD static double* square_row(double* of, const PairPatch& patch, int n) {
    return of + patch.square + std::int64_t(n - patch.first_pivot) * patch.rank;
  }

  // Row p D^-1 C_q^T
  PD_HD double coupled(int p, int q) const {
    const std::int64_t of_p = first_slot(p), of_q = first_slot(q);
    double sum = 0;
    for (int b = 0; b < m_.slots; ++b) {
      const int node = m_.moves[of_q + b];
      for (int a = 0; a < m_.slots; ++a) {
        if (node >= 0 && m_.moves[of_p + a] == node)
          sum += dot(m_.held[of_p + a], m_.inverse[node] * m_.held[of_q + b]);
      }
    }
    return sum;
  }

  // The columns of L by the largest share that is left of a row. Returns the rank.
  PD_HD int choose(const PairPatch& patch, double tolerance) const {
    const int rows = rows_of(patch), begin = patch.begin;
    for (int rank = 0;; ++rank) {
      const Largest next = team_.largest(rows, tolerance, [&](int p) {
        const double whole = m_.whole[begin + p];
        return whole > 0 ? m_.left[begin + p] / whole : 0.0;
      });
      if (next.index < 0) return rank;
      const int best = next.index;
      const double scale = 1 / sqrt(m_.left[begin + best]);
      double* const column = column_of(patch, rank);
      team_.each(rank, [&](int k) { m_.column[k] = column_of(patch, k)[best]; });
      team_.strips(rows, [&](int first, auto width) {
        double own[width];
        for (int u = 0; u < width; ++u) own[u] = coupled(begin + first + u, begin + best);
        const double* other = column_of(patch, 0) + first;
        for (int k = 0; k < rank; ++k, other += rows) {
          const double by = m_.column[k];
          for (int u = 0; u < width; ++u) own[u] -= by * other[u];
        }
        for (int u = 0; u < width; ++u) column[first + u] = scale * own[u];
      });
      team_.each(rows, [&](int p) {
        m_.left[begin + p] = p == best ? 0.0 : m_.left[begin + p] - column[p] * column[p];
      });
      team_.once([&] {
        m_.pivot[patch.first_pivot + rank] = begin + best;
        m_.as_pivot[begin + best] = patch.first_pivot + rank;
      });
    }
  }

  // L_r^-1, column by column
  PD_HD void invert_lower(const PairPatch& patch) const {
    const int rank = patch.rank;
    double *const to = f_.inverse_lower + patch.square, *const lower = f_.mixed + patch.square;
    team_.grid(rank, rank, [&](int i, int k) {
      lower[std::int64_t(i) * rank + k] =
          column_of(patch, k)[m_.pivot[patch.first_pivot + i] - patch.begin];
    });
    team_.strips(rank, [&](int first, auto width) {
      for (int i = first; i < rank; ++i) {
        const double* const of = lower + std::int64_t(i) * rank;
        double own[width];
        for (int u = 0; u < width; ++u) own[u] = i == first + u ? 1.0 : 0.0;
        for (int k = first; k < i; ++k) {
          const double* const other = to + std::int64_t(k) * rank + first;
          for (int u = 0; u < width; ++u) own[u] -= of[k] * other[u];
        }
        for (int u = 0; u < width; ++u) to[std::int64_t(i) * rank + first + u] = own[u] / of[i];
      }
    });
    team_.grid(rank, rank, [&](int i, int j) {
      if (i < j) to[std::int64_t(i) * rank + j] = to[std::int64_t(j) * rank + i];
    });
  }

  // The inverse of L^T B^T D^-1 C_r^T.
  PD_HD void mix(const PairPatch& patch) const {
    const int rank = patch.rank;
    double* const to = f_.mixed + patch.square;
    for (int i = 0; i < rank; ++i) {
      const double* const column = column_of(patch, i);
      // B L of this column
      team_.each(nodes_, [&](int v) {
        Place sum = {0, 0, 0};
        for (int n = m_.start[v]; n < m_.start[v + 1]; ++n) {
          const int item = m_.entry[n] / m_.slots, s = m_.entry[n] % m_.slots;
          if (m_.first[item] < patch.begin || m_.first[item] >= patch.end) break;
          for (int p = m_.first[item]; p < m_.end[item]; ++p)
            sum = sum + column[p - patch.begin] * m_.pushed[first_slot(p) + s];
        }
        m_.field[v] = sum;
      });
      team_.each(rank, [&](int j) {
        double sum = 0;
        each_held(m_.pivot[patch.first_pivot + j],
                  [&](int v, const Place& c) { sum += m_.inverse[v] * dot(m_.field[v], c); });
        to[std::int64_t(i) * rank + j] = sum;
      });
    }
    invert(to, rank);
  }

  // The inverses of L^T L, in the place of the mixed ones.
  PD_HD void grams() const {
    for (int n = 0; n < m_.counts->patches; ++n) {
      const PairPatch patch = m_.patch[n];
      const int rank = patch.rank;
      double* const to = f_.mixed + patch.square;
      team_.dots(
          std::int64_t(rank) * (rank + 1) / 2,
          [&](int at) {
            const Corner of(at);
            return DotProduct{column_of(patch, of.row), column_of(patch, of.column),
                              rows_of(patch)};
          },
          [&](int at, double sum) {
            const Corner of(at);
            to[std::int64_t(of.row) * rank + of.column] = sum;
            to[std::int64_t(of.column) * rank + of.row] = sum;
          });
      invert(to, rank);
    }
  }

  // Inverts a matrix in its place by Gauss and Jordan's elimination with partial pivoting.
  PD_CALLED void invert(double* a, int size) const {
    for (int k = 0; k < size; ++k) {
      const auto row = [&](int i) { return a + std::int64_t(i) * size; };
      const Largest found =
          team_.largest(size - k, -1.0, [&](int i) { return absolute(row(k + i)[k]); });
      const int best = found.index < 0 ? k : k + found.index;
      team_.each(size, [&](int j) {
        const double own = row(k)[j];
        row(k)[j] = row(best)[j];
        if (best != k) row(best)[j] = own;
      });
      const double by = 1 / row(k)[k];
      team_.once([&] { m_.order[k] = best; });
      team_.each(size, [&](int i) { m_.column[i] = row(i)[k]; });
      team_.each(size, [&](int j) { row(k)[j] = by * (j == k ? 1.0 : row(k)[j]); });
      team_.grid(size, size, [&](int i, int j) {
        if (i != k) row(i)[j] = (j == k ? 0.0 : row(i)[j]) - m_.column[i] * row(k)[j];
      });
    }
    team_.each(size, [&](int i) {
      double* const row = a + std::int64_t(i) * size;
      for (int k = size; k-- > 0;) {
        const double own = row[k];
        row[k] = row[m_.order[k]];
        row[m_.order[k]] = own;
      }
    });
  }

  const Team& team_;
  const PairMemory& m_;
  int nodes_;
  PairFactors f_{};
  bool skewed_ = false;
};

}  // namespace pd::inline PD_TARGET
