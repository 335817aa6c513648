// M of solver/multilevel/lbfgs.h: a symmetric V-cycle, or A^-1 where the plan says so (Levels::direct).
//
// With the smoother S before and after, the prolongation P, and B in place of the coarser matrix, a cycle is
//   S r + S (r - A S r) + (I - S A) P B P^T (I - A S) r.
// The first two terms do not depend on the coarser level. With F = (I - S A) P as prolongation a GPU computes them
// meanwhile: there the phases that wait for one another make the length of a cycle (cuda/multilevel/v_cycle.h). The CPU uses P.
#pragma once
#include "math/scalar.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// Chebyshev's polynomial of degree 2 for eigenvalues of D^-1 A in [1/4, 1], from zero (Saad 2003, algorithm 12.1):
//   w = first / D r,   z = keep w + second / D (r - A w)
struct Smoother {
  static constexpr double centre = 0.625, half_width = 0.375;
  static constexpr double ratio = half_width / centre, next = 1 / (2 / ratio - ratio);
  static constexpr double first = 1 / centre, keep = 1 + next * ratio,
                          second = 2 * next / half_width;
};

// A matrix level with B unknowns a row and axis, and its prolongation from four functions of each coarse node.
template <int B, class T>
struct Level {
  int rows, nodes;
  const int32 *start, *column;
  const T *value, *inverse;
  const int32 *prolongation_start, *prolongation_node;
  const T* prolongation_weight;
  const int32 *node_start, *node_row, *node_prolongation;
  const T* node_weight;
};

template <class T>
PD_HD Level<1, T> fine_level(const Levels<T>& l) {
  return {l.vertices,
          l.fine_nodes,
          l.fine_start,
          l.fine_column,
          l.fine_value,
          l.fine_inverse,
          l.fine_prolongation_start,
          l.fine_prolongation_node,
          l.fine_prolongation_weight,
          l.fine_node_start,
          l.fine_node_row,
          l.fine_node_prolongation,
          l.fine_node_weight};
}

template <class T>
PD_HD Level<4, T> middle_level(const Levels<T>& l) {
  return {l.fine_nodes,
          l.middle_nodes,
          l.middle_start,
          l.middle_column,
          l.middle_value,
          l.middle_inverse,
          l.middle_prolongation_start,
          l.middle_prolongation_node,
          l.middle_prolongation_weight,
          l.middle_node_start,
          l.middle_node_row,
          l.middle_node_prolongation,
          l.middle_node_weight};
}

// Partial sums of a row, used in turn, because each addition waits for the last one of its chain.
constexpr int row_chains = 4;

template <class Value>
PD_HD Value sum_chains(const Value (&sum)[row_chains]) {
  return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

// A x, one row: number p goes to chain p mod 4. One environment and batched get the same bits.
template <class Real, class T, class Value>
PD_HD Value row_product(const Level<1, T>& level, const Value* x, int row) {
  const int32 end = level.start[row + 1];
  int32 p = level.start[row];
  Value sum[row_chains] = {};
  const auto add = [&](int c, int32 at, T a) {
    sum[c] = multiply_add(Real(a), x[level.column[at]], sum[c]);
  };
  for (; p + row_chains < end; p += row_chains) {
    for (int c = 0; c < row_chains; ++c) add(c, p + c, level.value[p + c]);
  }
  constexpr bool batched = sizeof(Real) > sizeof(T);
  if constexpr (batched) {
    for (int c = 0; p + c < end; ++c) add(c, p + c, level.value[p + c]);
  } else if (p < end) {
    // always four steps, because branches on the remainder are mispredicted; zeros change no finite sum
    for (int c = 0; c < row_chains; ++c) {
      const int32 at = p + c < end ? p + c : end - 1;
      add(c, at, p + c < end ? level.value[at] : T(0));
    }
  }
  return sum_chains(sum);
}

// sum -= A x, one row
template <class Real, class T, class Value>
PD_HD void subtract_row(const Level<1, T>& level, const Value* x, int row, Value (&sum)[1]) {
  sum[0] = sum[0] - row_product<Real>(level, x, row);
}
template <class Real, int B, class T, class Value>
PD_HD void subtract_row(const Level<B, T>& level, const Value* x, int row, Value (&sum)[B]) {
  for (int32 p = level.start[row]; p < level.start[row + 1]; ++p) {
    const Value* from = x + std::int64_t(level.column[p]) * B;
    const T* a = level.value + std::int64_t(p) * B * B;
    for (int i = 0; i < B; ++i) {
      for (int j = 0; j < B; ++j) sum[i] = subtract_product(sum[i], Real(a[i * B + j]), from[j]);
    }
  }
}

// sum += P x, one row
template <class Real, int B, class T, class Value>
PD_HD void add_prolongation(const Level<B, T>& level, const Value* x, int row, Value (&sum)[B]) {
  for (int32 p = level.prolongation_start[row]; p < level.prolongation_start[row + 1]; ++p) {
    const Value* from = x + std::int64_t(level.prolongation_node[p]) * 4;
    const T* weight = level.prolongation_weight + std::int64_t(p) * B * 4;
    for (int i = 0; i < B; ++i) {
      for (int j = 0; j < 4; ++j) sum[i] = multiply_add(Real(weight[i * 4 + j]), from[j], sum[i]);
    }
  }
}
template <class Real, class T, class Value>
PD_HD void add_prolongation(const Level<1, T>& level, const Value* x, int row, Value (&sum)[1]) {
  Value part[row_chains] = {};
  for (int32 p = level.prolongation_start[row]; p < level.prolongation_start[row + 1]; ++p) {
    const Value* from = x + std::int64_t(level.prolongation_node[p]) * 4;
    const T* weight = level.prolongation_weight + std::int64_t(p) * 4;
    for (int j = 0; j < 4; ++j) part[j] = multiply_add(Real(weight[j]), from[j], part[j]);
  }
  sum[0] = sum[0] + sum_chains(part);
}

// sum += P^T x, the four functions of one node
template <class Real, int B, class T, class Value>
PD_HD void add_restriction(const Level<B, T>& level, const Value* x, int node, Value (&sum)[4]) {
  for (int32 p = level.node_start[node]; p < level.node_start[node + 1]; ++p) {
    const Value* from = x + std::int64_t(level.node_row[p]) * B;
    const T* weight = level.prolongation_weight + std::int64_t(level.node_prolongation[p]) * B * 4;
    for (int i = 0; i < B; ++i) {
      for (int j = 0; j < 4; ++j) sum[j] = multiply_add(Real(weight[i * 4 + j]), from[i], sum[j]);
    }
  }
}

}  // namespace pd::inline PD_TARGET
