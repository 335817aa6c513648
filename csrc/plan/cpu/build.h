// Turns the elements of a scene into the arrays of views/cpu_plan.def and views/cpu_stencils.def: patches, orders,
// gathers, rest shapes.
#pragma once

#include "plan/mesh/elements.h"

#include <cstdint>
#include <functional>
#include <vector>

namespace pd {

struct MeshPlan {
  std::vector<std::int32_t> vertex_order, tet_order, patch_block, patch_vertex, patch_slot,
      slot_vertex, shared_start, shared_slot;
  std::vector<double> tet_rest, tet_volume, tet_bound;
  std::vector<std::int16_t> tet_corner;
  std::vector<std::int32_t> stencil_block, patch_stencil, stencil_order, stencil_row;
  std::vector<double> stencil_measure, stencil_bound, stencil_stored;
  std::vector<std::int16_t> stencil_corner;
  std::int32_t stencil_numbers = 0;  // rows of 16 numbers of a step
};

// The caller checks the elements. `progress` is called with the fraction done now and then.
MeshPlan build_plan(const MeshElements& elements, int patch_size,
                    const std::function<void(double)>& progress);

}  // namespace pd
