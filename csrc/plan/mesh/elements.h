// The elements of a scene as the plans cut them: tetrahedra of solids, then stencils of other kinds.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace pd {

// Stencils of one kind, see elements/stencil.h; the arrays are the caller's.
struct StencilGroup {
  int kind = 0, corners = 0, dims = 0, constants = 0;
  int numbers = 0;  // of a step, for each stencil
  std::int64_t count = 0;
  const std::int64_t* corner = nullptr;  // [count, corners]
  const double* gradient = nullptr;      // [count, corners, dims] g_a
  const double* measure = nullptr;       // [count] V
  const double* constant = nullptr;      // [count, constants]
};

struct MeshElements {
  const double* positions = nullptr;  // [vertices, 3] at rest
  std::int64_t vertices = 0;
  const std::int64_t* tets = nullptr;  // [tet_count, 4], of positive volume
  std::int64_t tet_count = 0;
  std::vector<StencilGroup> groups = {};  // in the order of elements/kinds.def

  std::int64_t count() const {
    std::int64_t sum = tet_count;
    for (const StencilGroup& group : groups) sum += group.count;
    return sum;
  }

  // vertices of an element: tetrahedra are counted first, then the groups
  std::span<const std::int64_t> corners(std::int64_t element) const {
    if (element < tet_count) return {tets + 4 * element, 4};
    element -= tet_count;
    std::size_t g = 0;
    while (element >= groups[g].count) element -= groups[g++].count;
    return {groups[g].corner + element * groups[g].corners, std::size_t(groups[g].corners)};
  }
};

}  // namespace pd
