// Turns a tetrahedral mesh into the arrays of device.def: patches, pairs, gathers, rest matrices.
#pragma once

#include "plan/views.h"

#include <cstdint>
#include <functional>
#include <vector>

namespace pd {

// The table as vectors. What pins decide is the caller's: pin_vertex and vertex_pin are empty, sizes says no pins.
struct DeviceMeshPlan {
  using real = double;
#define X(name, type, width, rows, meaning) std::vector<type> name;
#include "plan/device.def"
#undef X
};

// `positions` [vertices, 3] at rest, `tets` [count, 4] with positive volume, `piece` [vertices] without pins that a vertex
// moves with, -1: pinned, `kernel` as in DeviceKernel, `fixed`: for float32. All checked by the caller, and that
// 1 <= patches <= count, of a cluster also <= vertices and <= most_cluster_blocks. Throws std::invalid_argument when a patch has
// more numbers than 16 bits can count, std::overflow_error when all of them have more than 32 bits can. `progress` hears the
// fraction done now and then.
DeviceMeshPlan build_device_plan(const double* positions, std::int64_t vertices,
                                 const std::int64_t* tets, std::int64_t count, int patches,
                                 int kernel, bool fixed, const std::int32_t* piece,
                                 const std::function<void(double)>& progress);

}  // namespace pd
