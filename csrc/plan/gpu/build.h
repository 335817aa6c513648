// Compiles the elements of a scene into the arrays of views/gpu_plan.def, gpu_stencils.def and gpu_step_rows.def: patches,
// pairs, stencils, rows, gather lists and rest shapes.
#pragma once

#include "plan/mesh/elements.h"
#include "views/views.h"

#include <cstdint>
#include <functional>
#include <vector>

namespace pd {

// The tables as vectors. The caller adds pins: pin_vertex and vertex_pin are empty, and sizes counts
// no pins.
struct DeviceMeshPlan {
  using real = double;
#define X(name, type, width, rows, meaning) std::vector<type> name;
#include "views/gpu_plan.def"
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
#undef X
};

// Builds the plan. `piece` [vertices]: the connected piece without pins of each vertex, or -1. `kernel`: as in
// DeviceKernel. `fixed`: for float32. `progress` is called with the fraction done.
//
// The caller checks all inputs and 1 <= patches <= elements; for a cluster, also patches <= vertices
// and patches <= most_cluster_blocks. Only the kernels block and stream take stencils. Throws std::invalid_argument
// when a patch exceeds a 16-bit count, and std::overflow_error when the plan exceeds a 32-bit count.
DeviceMeshPlan build_device_plan(const MeshElements& elements, int patches, int kernel, bool fixed,
                                 const std::int32_t* piece,
                                 const std::function<void(double)>& progress);

}  // namespace pd
