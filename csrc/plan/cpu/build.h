// Turns a tetrahedral mesh into the arrays of views/cpu_plan.def: patches, orders, gathers, rest matrices.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

namespace pd {

struct MeshPlan {
  std::vector<std::int32_t> vertex_order, tet_order, patch_block, patch_vertex, patch_slot,
      slot_vertex, shared_start, shared_slot;
  std::vector<double> tet_rest, tet_volume, tet_bound;
  std::vector<std::int16_t> tet_corner;
};

// `positions` [vertices, 3] at rest and `tets` [count, 4] with positive volume are checked by the caller. `progress`
// is called with the fraction done now and then.
MeshPlan build_plan(const double* positions, std::int64_t vertices, const std::int64_t* tets,
                    std::int64_t count, int patch_size,
                    const std::function<void(double)>& progress);

}  // namespace pd
