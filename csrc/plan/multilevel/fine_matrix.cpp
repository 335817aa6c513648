#include "plan/multilevel/fine_matrix.h"

#include "plan/mesh/rest_shape.h"
#include "plan/mesh/stencils.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <span>
#include <utility>

namespace pd {

namespace {

// Elements around each internal vertex, ascending.
struct Incidence {
  std::vector<std::int64_t> start;
  std::vector<std::int32_t> element;
};

Incidence incidence(const MeshElements& elements, const std::vector<std::int32_t>& internal) {
  // a corner without a share may repeat another
  const auto for_corners = [&](auto work) {
    for (std::int64_t e = 0; e < elements.count(); ++e) {
      const std::span<const std::int64_t> corners = elements.corners(e);
      for (auto v = corners.begin(); v != corners.end(); ++v) {
        if (std::find(corners.begin(), v, *v) == v) work(e, internal[*v]);
      }
    }
  };
  Incidence around{std::vector<std::int64_t>(internal.size() + 1, 0), {}};
  for_corners([&](std::int64_t, std::int32_t v) { ++around.start[v + 1]; });
  std::partial_sum(around.start.begin(), around.start.end(), around.start.begin());
  around.element.resize(around.start.back());
  std::vector<std::int64_t> next(around.start.begin(), around.start.end() - 1);
  for_corners([&](std::int64_t e, std::int32_t v) { around.element[next[v]++] = std::int32_t(e); });
  return around;
}

// One element: its vectors g_a and their measure.
struct Element {
  std::array<std::array<double, 3>, 5> gradient{};
  double measure;
};

Element tetrahedron(const MeshElements& elements, std::int64_t tet) {
  const RestShape rest = rest_shape(elements.positions, elements.tet(tet));
  Element made{{}, rest.volume};
  std::ranges::copy(rest.gradients(), made.gradient.begin());
  return made;
}

// The stencil of an element that is no tetrahedron: its group, and its number there.
std::pair<const StencilGroup*, std::int64_t> stencil_at(const MeshElements& elements,
                                                        std::int64_t element) {
  element -= elements.tet_count;
  const StencilGroup* group = elements.groups.data();
  while (element >= group->count) element -= (group++)->count;
  return {group, element};
}

Element stencil(const MeshElements& elements, std::int64_t element) {
  const auto [group, s] = stencil_at(elements, element);
  Element made{{}, group->measure[s]};
  for (int k = 0; k < group->corners; ++k) {
    for (int c = 0; c < group->dims; ++c)
      made.gradient[k][c] = group->gradient[(s * group->corners + k) * group->dims + c];
  }
  return made;
}

// l_e of every element.
std::vector<double> bounds(const MeshElements& elements, int threads) {
  std::vector<double> bound(elements.count());
  constexpr std::int64_t several = bound_lanes;
  for_rows((elements.tet_count + several - 1) / several, threads, [&](std::int64_t number) {
    const std::int64_t first = several * number, last = elements.tet_count - 1;
    std::array<RestShape, bound_lanes> shapes;
    for (std::int64_t i = 0; i < several; ++i)
      shapes[i] = rest_shape(elements.positions, elements.tet(std::min(first + i, last)));
    const std::array<double, bound_lanes> found = tet_bounds(shapes);
    std::copy_n(found.begin(), std::min(several, elements.tet_count - first),
                bound.begin() + first);
  });
  for (std::int64_t e = elements.tet_count; e < elements.count(); ++e) {
    const auto [group, s] = stencil_at(elements, e);
    bound[e] = stencil_bound(*group, s);
  }
  return bound;
}

class Assembly {
 public:
  Assembly(const MultilevelScene& scene, int threads)
      : scene_(scene),
        internal_(scene.elements.vertices),
        held_(internal_.size()),
        bound_(bounds(scene.elements, threads)) {
    for (std::size_t i = 0; i < internal_.size(); ++i) {
      internal_[scene.vertex_order[i]] = std::int32_t(i);
      held_[i] = !std::isfinite(scene.inertia[scene.vertex_order[i]]);
    }
    around_ = incidence(scene.elements, internal_);
  }

  const Mask& held() const { return held_; }

  // Row `i` of A: inertia, plus w V g_i . g_j of every adjacent element. Returns its weighted diagonal.
  double fill(std::int32_t i, RowSum& row) const {
    if (held_[i]) return 0;
    double weighted = scene_.inertia[scene_.vertex_order[i]];
    *row.at(i) += weighted;
    for (std::int64_t p = around_.start[i]; p < around_.start[i + 1]; ++p) {
      const std::int64_t e = around_.element[p];
      const std::span<const std::int64_t> corner = scene_.elements.corners(e);
      const auto& [gradient, measure] = e < scene_.elements.tet_count
                                            ? tetrahedron(scene_.elements, e)
                                            : stencil(scene_.elements, e);
      const double weight = scene_.stiffness[e] * measure;
      // a vertex without a share may repeat another corner, and then stands twice
      for (std::size_t own = 0; own < corner.size(); ++own) {
        if (internal_[corner[own]] != i) continue;
        for (std::size_t k = 0; k < corner.size(); ++k) {
          double dot = 0;
          for (int c = 0; c < 3; ++c) dot += gradient[own][c] * gradient[k][c];
          if (k == own) weighted += bound_[e] * weight * dot;
          const std::int32_t column = internal_[corner[k]];
          if (!held_[column]) *row.at(column) += weight * dot;
        }
      }
    }
    return weighted;
  }

 private:
  const MultilevelScene& scene_;
  std::vector<std::int32_t> internal_;  // user's number -> internal number
  Mask held_;
  std::vector<double> bound_;
  Incidence around_;
};

}  // namespace

FineMatrix assemble(const MultilevelScene& scene, int threads) {
  const std::int32_t n = std::int32_t(scene.elements.vertices);
  const Assembly rows(scene, threads);
  FineMatrix fine{{1, 1, n, n, {}, {}, {}}, std::vector<double>(n), rows.held()};
  sum_rows(fine.matrix, -0.0, threads,
           [&](std::int32_t row, RowSum& sum) { fine.bound[row] = rows.fill(row, sum); });
  return fine;
}

}  // namespace pd
