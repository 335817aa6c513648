// Cuts a mesh into patches and numbers its vertices by them: the first half of both plans.
#pragma once

#include "plan/mesh/elements.h"

#include <cstdint>
#include <span>
#include <vector>

namespace pd {

// Elements patch by patch, ascending in each.
struct Partition {
  std::vector<std::int32_t> elements;  // numbers of MeshElements
  std::vector<std::int64_t> start;     // first of each patch, and the end

  int patches() const { return int(start.size()) - 1; }
  std::span<const std::int32_t> patch(int p) const {
    return {elements.data() + start[p], elements.data() + start[p + 1]};
  }
};

// Recursive coordinate bisection into patches of nearly equal size: a multiple of `grain`, but for the last.
// Up to count / grain patches, rounded up.
Partition partition_mesh(const MeshElements& elements, std::int64_t patches, std::int64_t grain);

// Which vertices are interior to one patch and which are shared, and their internal numbers.
struct Numbering {
  std::vector<std::uint8_t> is_shared;     // user's numbers
  std::vector<std::int32_t> internal;      // user's number -> internal number
  std::vector<std::int32_t> vertex_order;  // internal number -> user's number
  std::vector<std::int32_t>
      patch_vertex;  // first interior vertex of each patch; the last entry is the first shared one

  bool is_inside(std::int64_t patch, std::int64_t vertex) const {
    const std::int32_t number = internal[vertex];
    return number >= patch_vertex[patch] && number < patch_vertex[patch + 1];
  }
};

Numbering number_vertices(const Partition& mesh, const MeshElements& elements);

// For every shared vertex its slots, in patch order.
struct SharedSlots {
  std::vector<std::int32_t> start, slot;
};

SharedSlots link_shared(const std::vector<std::int32_t>& slot_vertex, std::int32_t first_shared,
                        std::int64_t vertices);

}  // namespace pd
