#include "plan/multilevel/fine_matrix.h"

#include "plan/mesh/rest_shape.h"
#include "plan/mesh/stencils.h"
#include "threads/team.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <span>
#include <utility>

namespace pd {

namespace {

// Elements around each internal vertex.
BlockMatrix incidence(const MultilevelScene& s, const std::vector<std::int32_t>& internal) {
  const std::int64_t count = s.elements.count();
  BlockMatrix corners{1, 1, std::int32_t(count), std::int32_t(s.elements.vertices), {0}, {}, {}};
  for (std::int64_t e = 0; e < count; ++e) {
    const std::size_t first = corners.column.size();
    for (const std::int64_t v : s.elements.corners(e)) {
      const auto own = corners.column.begin() + std::ptrdiff_t(first);
      // a corner without a share may repeat another
      if (std::find(own, corners.column.end(), internal[v]) == corners.column.end())
        corners.column.push_back(internal[v]);
    }
    corners.start.push_back(std::int32_t(corners.column.size()));
  }
  corners.value.resize(corners.column.size());
  return transpose(corners).matrix;
}

// One element: its vectors g_a, their measure and l_e.
struct Element {
  std::array<std::array<double, 3>, 5> gradient{};
  double measure, bound;
};

Element tetrahedron(const MeshElements& elements, std::span<const std::int64_t> corner) {
  const Rest rest = rest_of(elements.positions, {corner[0], corner[1], corner[2], corner[3]});
  Element made{{}, rest.volume, rest.bound};
  for (int c = 0; c < 3; ++c) {
    for (int k = 1; k < 4; ++k) {
      made.gradient[k][c] = rest.inverse[3 * (k - 1) + c];
      made.gradient[0][c] -= made.gradient[k][c];
    }
  }
  return made;
}

Element stencil(const MeshElements& elements, std::int64_t element) {
  element -= elements.tet_count;
  std::size_t g = 0;
  while (element >= elements.groups[g].count) element -= elements.groups[g++].count;
  const StencilGroup& group = elements.groups[g];
  Element made{{}, group.measure[element], stencil_bound(group, element)};
  for (int k = 0; k < group.corners; ++k) {
    for (int c = 0; c < group.dims; ++c)
      made.gradient[k][c] = group.gradient[(element * group.corners + k) * group.dims + c];
  }
  return made;
}

// One row of A: inertia, plus w V g_i . g_j of every adjacent element.
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
    const std::int64_t e = around.column[p];
    const std::span<const std::int64_t> corner = s.elements.corners(e);
    const Element element =
        e < s.elements.tet_count ? tetrahedron(s.elements, corner) : stencil(s.elements, e);
    const auto& gradient = element.gradient;
    const double weight = s.stiffness[e] * element.measure;
    // a vertex without a share may repeat another corner, and then stands twice
    for (std::size_t own = 0; own < corner.size(); ++own) {
      if (internal[corner[own]] != i) continue;
      for (std::size_t k = 0; k < corner.size(); ++k) {
        double dot = 0;
        for (int c = 0; c < 3; ++c) dot += gradient[own][c] * gradient[k][c];
        if (k == own) row.bound += element.bound * weight * dot;
        if (!held[internal[corner[k]]]) row.entry.emplace_back(internal[corner[k]], weight * dot);
      }
    }
  }
  // equal columns stay in the order of their tetrahedra, so that sums do not depend on the sort
  std::stable_sort(row.entry.begin(), row.entry.end(),
                   [](const auto& a, const auto& b) { return a.first < b.first; });
}

}  // namespace

FineMatrix assemble(const MultilevelScene& s, int threads) {
  const std::int32_t n = std::int32_t(s.elements.vertices);
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
