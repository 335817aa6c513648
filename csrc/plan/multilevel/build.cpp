#include "plan/multilevel/build.h"

#include "plan/multilevel/aggregate.h"
#include "plan/multilevel/block_matrix.h"
#include "plan/multilevel/fine_matrix.h"
#include "plan/multilevel/pieces.h"
#include "plan/multilevel/prolongation.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <numeric>
#include <utility>

namespace pd {

namespace {

constexpr int most_coarse_nodes = 256;              // 1024 unknowns of the dense level
constexpr std::int32_t most_of_two_levels = 12000;  // two levels serve up to so many free vertices
constexpr double fine_smoothing = 1.14, middle_smoothing = 1.333;  // omega of I - omega D^-1 A
constexpr double weakest_coupling = 0.02;  // relative to the scaled blocks of middle nodes
constexpr double coarse_shift = 1e-12;  // relative to the diagonal: above the rounding of a pivot

// Diagonal of a matrix of square blocks.
std::vector<double> diagonal(const BlockMatrix& a) {
  std::vector<double> d(std::size_t(a.rows) * a.height, 0.0);
  for (std::int32_t row = 0; row < a.rows; ++row) {
    for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
      if (a.column[p] != row) continue;
      for (int i = 0; i < a.height; ++i)
        d[std::size_t(row) * a.height + i] = a.value[p * a.block() + i * a.width + i];
    }
  }
  return d;
}

// Edges of a matrix: Frobenius norms of its blocks, scaled by the diagonal, where larger than `least`.
std::vector<Coupling> couplings(const BlockMatrix& a, const std::vector<double>& d,
                                const std::vector<std::array<double, 3>>& centre, double least,
                                int threads) {
  const auto for_couplings = [&](std::int64_t row, auto work) {
    for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
      const std::int32_t column = a.column[p];
      if (column <= row) continue;
      double sum = 0;
      for (int i = 0; i < a.height; ++i) {
        for (int j = 0; j < a.width; ++j) {
          const double v = a.value[p * a.block() + i * a.width + j];
          const double scale =
              d[std::size_t(row) * a.height + i] * d[std::size_t(column) * a.width + j];
          if (scale > 0) sum += v * v / scale;
        }
      }
      if (sum > least * least) work(column, sum);
    }
  };
  std::vector<std::int64_t> place(std::size_t(a.rows) + 1, 0);
  for_rows(a.rows, threads, [&](std::int64_t row) {
    for_couplings(row, [&](std::int32_t, double) { ++place[row + 1]; });
  });
  std::partial_sum(place.begin(), place.end(), place.begin());
  std::vector<Coupling> found(place.back());
  for_rows(a.rows, threads, [&](std::int64_t row) {
    for_couplings(row, [&](std::int32_t column, double sum) {
      double square = 0;
      for (int c = 0; c < 3; ++c) {
        const double side = centre[row][c] - centre[column][c];
        square += side * side;
      }
      found[place[row]++] = {std::int32_t(row), column, std::sqrt(sum), std::sqrt(square)};
    });
  });
  return found;
}

// 1 / (lambda_max diag A), with lambda_max of diag(A)^-1 A from power iteration plus 5 %; 0 where there is no
// function.
std::vector<double> scaled_inverse(const BlockMatrix& a, int threads) {
  const std::vector<double> d = diagonal(a);
  std::vector<double> x(d.size()), y;
  std::uint32_t state = 1;
  for (std::size_t i = 0; i < x.size(); ++i) {
    state = state * 1664525u + 1013904223u;  // any start that is no eigenvector will do
    x[i] = d[i] > 0 ? double(state) / 4294967296.0 - 0.5 : 0;
  }
  double largest = 1;
  for (int step = 0; step < 30; ++step) {
    // lambda = |D^-1 A x| / |x| in the metric of D
    double before = 0, after = 0;
    apply(a, x, y, threads);
    for (std::size_t i = 0; i < x.size(); ++i) {
      const double next = d[i] > 0 ? y[i] / d[i] : 0;
      before += d[i] * x[i] * x[i];
      after += d[i] * next * next;
      x[i] = next;
    }
    if (!(before > 0) || !(after > 0)) break;
    largest = std::sqrt(after / before);
    for (double& v : x) v /= std::sqrt(after);
  }
  std::vector<double> inverse(d.size());
  for (std::size_t i = 0; i < d.size(); ++i)
    inverse[i] = d[i] > 0 ? 1 / (1.05 * largest * d[i]) : 0;
  return inverse;
}

// L^-1 of a matrix L L^T, row by row up to the diagonal; the rows of held vertices are zero.
std::vector<double> coarse_factor(const BlockMatrix& a, const Mask& held, int threads) {
  const int n = a.rows * a.height;
  std::vector<double> dense(std::size_t(n) * n, 0.0);
  for (std::int32_t row = 0; row < a.rows; ++row) {
    for (std::int32_t p = a.start[row]; p < a.start[row + 1]; ++p) {
      for (int i = 0; i < a.height; ++i) {
        for (int j = 0; j < a.width; ++j)
          dense[(std::size_t(row) * a.height + i) * n + std::size_t(a.column[p]) * a.width + j] =
              a.value[p * a.block() + i * a.width + j];
      }
    }
  }
  for (int i = 0; i < n; ++i) {
    double& d = dense[std::size_t(i) * n + i];
    d = d > 0 ? d * (1 + coarse_shift) : 1;
  }
  std::vector<double> factor = inverse_cholesky_factor(std::move(dense), n, threads);
  for (std::int64_t i = 0; i < std::ssize(held); ++i) {
    if (held[i]) std::fill_n(factor.begin() + i * (i + 1) / 2, i + 1, 0.0);
  }
  return factor;
}

// Rest positions in internal order, and the affine functions on them, scaled to the size of one.
struct Affine {
  std::vector<std::array<double, 3>> position;
  std::vector<double> candidates;  // [vertices, 4]
};

Affine affine(const MultilevelScene& s) {
  Affine result;
  result.position.reserve(s.elements.vertices);
  result.candidates.reserve(node_functions * s.elements.vertices);
  std::array<double, 3> low{}, high{};
  for (std::int64_t i = 0; i < s.elements.vertices; ++i) {
    const double* x = s.elements.positions + 3 * std::int64_t(s.vertex_order[i]);
    result.position.push_back({x[0], x[1], x[2]});
    for (int c = 0; c < 3; ++c) {
      low[c] = i ? std::min(low[c], x[c]) : x[c];
      high[c] = i ? std::max(high[c], x[c]) : x[c];
    }
  }
  const double size = std::max({high[0] - low[0], high[1] - low[1], high[2] - low[2]});
  for (const auto& x : result.position) {
    result.candidates.push_back(1);
    for (int c = 0; c < 3; ++c)
      result.candidates.push_back((x[c] - 0.5 * (low[c] + high[c])) / size);
  }
  return result;
}

std::vector<std::array<double, 3>> mean_positions(
    const std::vector<std::array<double, 3>>& position, const Aggregates& groups) {
  std::vector<std::array<double, 3>> mean(groups.count, {0, 0, 0});
  std::vector<int> count(groups.count, 0);
  for (std::size_t i = 0; i < position.size(); ++i) {
    if (groups.of[i] < 0) continue;
    ++count[groups.of[i]];
    for (int c = 0; c < 3; ++c) mean[groups.of[i]][c] += position[i][c];
  }
  for (std::size_t g = 0; g < mean.size(); ++g) {
    for (double& x : mean[g]) x /= count[g];
  }
  return mean;
}

// The nodes below the middle level.
Aggregates group_nodes(const BlockMatrix& matrix,
                       const std::vector<std::array<double, 3>>& position, int threads) {
  const Graph graph = coupling_graph(
      matrix.rows, couplings(matrix, diagonal(matrix), position, weakest_coupling, threads));
  const int wanted = std::clamp(matrix.rows / 8, 1, most_coarse_nodes);
  return limited(aggregate(graph, Mask(matrix.rows, 0), wanted, most_coarse_nodes, threads),
                 most_coarse_nodes);
}

using Numbers = std::vector<std::int32_t>;

void store(BlockMatrix& matrix, Numbers& start, Numbers& column, std::vector<double>& value) {
  start = std::move(matrix.start);
  column = std::move(matrix.column);
  value = std::move(matrix.value);
}

// Stores the transposed prolongation: with the places of its values in the other, or with the `values` themselves.
void store_nodes(Coarsening& step, bool values, Numbers& start, Numbers& row, Numbers& from,
                 std::vector<double>& value, int threads) {
  if (values) {
    const std::int64_t block = step.prolongation.block();
    value.resize(step.prolongation.value.size());
    for_rows(std::ssize(step.restriction.from), threads, [&](std::int64_t e) {
      std::copy_n(step.prolongation.value.begin() + step.restriction.from[e] * block, block,
                  value.begin() + e * block);
    });
  } else {
    from = std::move(step.restriction.from);
  }
  start = std::move(step.restriction.start);
  row = std::move(step.restriction.column);
}

// A small mesh has no levels, but the inverse factor of its matrix.
void store_direct(MultilevelTables& t, FineMatrix& fine, int threads) {
  t.level_sizes[level_direct] = 1;
  t.coarse_factor = coarse_factor(fine.matrix, fine.held, threads);
  t.fine_prolongation_start.assign(std::size_t(fine.matrix.rows) + 1, 0);
  t.fine_node_start = {0};
  store(fine.matrix, t.fine_start, t.fine_column, t.fine_value);
}

// Whether the nodes of the free vertices need a level between them and the dense one.
bool needs_middle(const Graph& graph, const Mask& held, std::int32_t free) {
  return free > most_of_two_levels || connected_components(graph, held) > most_coarse_nodes;
}

// Stores the fine level; returns the matrix of the next.
BlockMatrix add_fine_level(MultilevelTables& t, BlockMatrix& matrix, const BlockMatrix& tentative,
                           bool folded, int threads) {
  Coarsening step = coarsen(matrix, t.fine_inverse, fine_smoothing, tentative, threads);
  if (folded) fold(step, matrix, t.fine_inverse, threads);
  t.level_sizes[level_fine_prolongations] = step.prolongation.start.back();
  t.level_sizes[level_fine_nodes] = tentative.columns;
  store(matrix, t.fine_start, t.fine_column, t.fine_value);
  store_nodes(step, folded, t.fine_node_start, t.fine_node_row, t.fine_node_prolongation,
              t.fine_node_weight, threads);
  store(step.prolongation, t.fine_prolongation_start, t.fine_prolongation_node,
        t.fine_prolongation_weight);
  return std::move(step.coarse);
}

// The same for the middle level, nodes at `position` with candidates [nodes, 4, 4].
BlockMatrix add_middle_level(MultilevelTables& t, BlockMatrix matrix,
                             const std::vector<std::array<double, 3>>& position,
                             const std::vector<double>& candidates, bool folded, int threads) {
  t.middle_inverse = scaled_inverse(matrix, threads);
  const Aggregates groups = group_nodes(matrix, position, threads);
  const Tentative last = tentative(candidates, node_functions, groups, threads);
  Coarsening step = coarsen(matrix, t.middle_inverse, middle_smoothing, last.prolongation, threads);
  if (folded) fold(step, matrix, t.middle_inverse, threads);
  t.level_sizes[level_middle_entries] = matrix.start.back();
  t.level_sizes[level_middle_prolongations] = step.prolongation.start.back();
  t.level_sizes[level_middle_nodes] = groups.count;
  store(matrix, t.middle_start, t.middle_column, t.middle_value);
  store_nodes(step, folded, t.middle_node_start, t.middle_node_row, t.middle_node_prolongation,
              t.middle_node_weight, threads);
  store(step.prolongation, t.middle_prolongation_start, t.middle_prolongation_node,
        t.middle_prolongation_weight);
  return std::move(step.coarse);
}

// What does not depend on the levels.
void store_reference(MultilevelTables& t, const MultilevelScene& scene, const FineMatrix& fine) {
  t.fine_inverse.resize(fine.bound.size());
  std::ranges::transform(fine.bound, t.fine_inverse.begin(),
                         [](double bound) { return bound > 0 ? 1 / bound : 0; });
  t.reference_stiffness.assign(scene.stiffness, scene.stiffness + scene.elements.count());
  t.reference_inertia.reserve(scene.elements.vertices);
  for (std::int64_t i = 0; i < scene.elements.vertices; ++i)
    t.reference_inertia.push_back(scene.inertia[scene.vertex_order[i]]);
  t.level_sizes.assign(level_size_count, 0);
  t.level_sizes[level_fine_entries] = fine.matrix.start.back();
}

}  // namespace

MultilevelTables build_multilevel(const MultilevelScene& scene, int threads,
                                  const std::function<void(double)>& progress) {
  MultilevelTables t;
  FineMatrix fine = assemble(scene, threads);
  progress(0.2);
  store_reference(t, scene, fine);
  const Affine rest = affine(scene);
  const Graph graph = coupling_graph(
      fine.matrix.rows, couplings(fine.matrix, diagonal(fine.matrix), rest.position, 0, threads));
  Pieces pieces = cut_pieces(fine, graph, t.reference_inertia, threads);
  t.level_sizes[level_pieces] = pieces.count;
  t.piece_of = std::move(pieces.of);
  t.piece_weight = std::move(pieces.weight);
  if (scene.elements.vertices <= scene.most_direct) {
    store_direct(t, fine, threads);
    progress(1.0);
    return t;
  }
  const auto free = std::int32_t(std::count(fine.held.begin(), fine.held.end(), 0));
  const bool middle = needs_middle(graph, fine.held, free);
  const std::int32_t nodes = std::max(1, free / (free < 1000 ? 15 : 30));
  const std::int32_t most = middle ? free : most_coarse_nodes;
  const Aggregates groups = aggregate(graph, fine.held, std::min(nodes, most), most, threads);
  progress(0.5);
  const Tentative first = tentative(rest.candidates, 1, groups, threads);
  BlockMatrix coarse = add_fine_level(t, fine.matrix, first.prolongation, scene.folded, threads);
  progress(0.7);
  if (middle) {
    coarse = add_middle_level(t, std::move(coarse), mean_positions(rest.position, groups),
                              first.reduced, scene.folded, threads);
  }
  progress(0.8);
  t.coarse_factor = coarse_factor(coarse, {}, threads);
  progress(1.0);
  return t;
}

}  // namespace pd
