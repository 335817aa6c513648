// Shared memory that the kernels of a plan ask for: known without a GPU, because it decides which kernel a plan is for.
#pragma once
#include <cstddef>

namespace pd {

constexpr std::size_t fused_control_bytes = 1024;

// position and u of every slot, an entry for every corner of a pair; planes and balls as numbers of five and eight
constexpr std::size_t fused_shared_bytes(std::size_t real, std::size_t slots, std::size_t entries,
                                         std::size_t planes, std::size_t balls) {
  return fused_control_bytes + real * (8 * slots + 4 * entries + 5 * planes + 8 * balls);
}

// what a pass keeps beside: three sums of up to 32 warps
constexpr std::size_t pass_static_bytes = 3 * 32 * sizeof(double);

// the same with all that the iterations of the multilevel solver keep
constexpr std::size_t outer_static_bytes = 7168;

// `fields` vectors of every slot
constexpr std::size_t pass_shared_bytes(std::size_t real, std::size_t slots, std::size_t entries,
                                        std::size_t fields) {
  return real * 4 * (fields * slots + entries);
}

}  // namespace pd
