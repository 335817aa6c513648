#include "plan/multilevel/fine_matrix.h"

#include "plan/mesh/rest_shape.h"
#include "threads/team.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

namespace pd {

namespace {

// Tetrahedra around each internal vertex.
BlockMatrix incidence(const MultilevelScene& s, const std::vector<std::int32_t>& internal) {
  BlockMatrix corners{1, 1, std::int32_t(s.count), std::int32_t(s.vertices), {}, {}, {}};
  corners.start.resize(s.count + 1);
  for (std::int64_t t = 0; t <= s.count; ++t) corners.start[t] = std::int32_t(4 * t);
  for (std::int64_t i = 0; i < 4 * s.count; ++i) corners.column.push_back(internal[s.tets[i]]);
  corners.value.resize(corners.column.size());
  return transpose(corners).matrix;
}

// One row of A: inertia, plus w V grad N_i . grad N_j of every adjacent tetrahedron.
struct Row {
  std::vector<std::pair<std::int32_t, double>> entry;
  double bound = 0;
};

void assemble_row(const MultilevelScene& s, const std::vector<std::int32_t>& internal,
                  const BlockMatrix& around, const Mask& held, std::int32_t i, Row& row) {
  row.entry.clear();
  row.bound = s.inertia[s.vertex_order[i]];
  row.entry.emplace_back(i, row.bound);
  for (std::int32_t p = around.start[i]; p < around.start[i + 1]; ++p) {
    const std::int64_t t = around.column[p];
    const std::int64_t* corner = s.tets + 4 * t;
    const Rest rest = rest_of(s.positions, {corner[0], corner[1], corner[2], corner[3]});
    std::array<std::array<double, 3>, 4> gradient{};
    int own = 0;
    for (int c = 0; c < 3; ++c) {
      for (int k = 1; k < 4; ++k) {
        gradient[k][c] = rest.inverse[3 * (k - 1) + c];
        gradient[0][c] -= gradient[k][c];
      }
    }
    for (int k = 0; k < 4; ++k) own = internal[corner[k]] == i ? k : own;
    const double weight = s.stiffness[t] * rest.volume;
    for (int k = 0; k < 4; ++k) {
      double dot = 0;
      for (int c = 0; c < 3; ++c) dot += gradient[own][c] * gradient[k][c];
      if (k == own) row.bound += rest.bound * weight * dot;
      if (!held[internal[corner[k]]]) row.entry.emplace_back(internal[corner[k]], weight * dot);
    }
  }
  // equal columns stay in the order of their tetrahedra, so that sums do not depend on the sort
  std::stable_sort(row.entry.begin(), row.entry.end(),
                   [](const auto& a, const auto& b) { return a.first < b.first; });
}

}  // namespace

FineMatrix assemble(const MultilevelScene& s, int threads) {
  const std::int32_t n = std::int32_t(s.vertices);
  FineMatrix fine{{1, 1, n, n, {0}, {}, {}}, std::vector<double>(n, 0.0), Mask(n, 0)};
  std::vector<std::int32_t> internal(n);
  for (std::int32_t i = 0; i < n; ++i) {
    internal[s.vertex_order[i]] = i;
    fine.held[i] = !std::isfinite(s.inertia[s.vertex_order[i]]);
  }
  const BlockMatrix around = incidence(s, internal);
  std::vector<BlockMatrix> parts(threads);
  run_team(threads, [&](const Team& team) {
    BlockMatrix& part = parts[team.rank];
    Row row;
    for (std::int64_t i = team.begin(n); i < team.end(n); ++i) {
      if (!fine.held[i]) {
        assemble_row(s, internal, around, fine.held, std::int32_t(i), row);
        fine.bound[i] = row.bound;
        const std::size_t first = part.column.size();
        for (const auto& [column, value] : row.entry) {
          if (part.column.size() > first && part.column.back() == column) {
            part.value.back() += value;
          } else {
            part.column.push_back(column);
            part.value.push_back(value);
          }
        }
      }
      part.start.push_back(std::int32_t(part.column.size()));
    }
  });
  for (const BlockMatrix& part : parts) {
    const std::int32_t before = fine.matrix.start.back();
    for (std::size_t i = 1; i < part.start.size(); ++i)
      fine.matrix.start.push_back(before + part.start[i]);
    fine.matrix.column.insert(fine.matrix.column.end(), part.column.begin(), part.column.end());
    fine.matrix.value.insert(fine.matrix.value.end(), part.value.begin(), part.value.end());
  }
  return fine;
}

}  // namespace pd
