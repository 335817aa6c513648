// Compiles a tetrahedral mesh into the arrays of views/gpu_plan.def: patches, pairs, gather lists and rest
// shapes.
#pragma once

#include "views/views.h"

#include <cstdint>
#include <functional>
#include <vector>

namespace pd {

// The table as vectors. The caller adds pins: pin_vertex and vertex_pin are empty, and sizes counts
// no pins.
struct DeviceMeshPlan {
  using real = double;
#define X(name, type, width, rows, meaning) std::vector<type> name;
#include "views/gpu_plan.def"
#undef X
};

// Builds the plan. `positions` [vertices, 3]: rest positions. `tets` [count, 4]: tetrahedra of
// positive volume. `piece` [vertices]: the connected piece without pins of each vertex, or -1.
// `kernel`: as in DeviceKernel. `fixed`: for float32. `progress` is called with the fraction done.
//
// The caller checks all inputs and 1 <= patches <= count; for a cluster, also patches <= vertices
// and patches <= most_cluster_blocks. Throws std::invalid_argument when a patch exceeds a 16-bit
// count, and std::overflow_error when the plan exceeds a 32-bit count.
DeviceMeshPlan build_device_plan(const double* positions, std::int64_t vertices,
                                 const std::int64_t* tets, std::int64_t count, int patches,
                                 int kernel, bool fixed, const std::int32_t* piece,
                                 const std::function<void(double)>& progress);

}  // namespace pd
