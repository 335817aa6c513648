// Shared memory that the kernels of a plan ask for: known without a GPU, because it decides which kernel a plan is for.
#pragma once
#include <cstddef>
#include <cstdint>

namespace pd {

constexpr std::size_t fused_control_bytes = 1024;

// `bytes` and what fills them up to a multiple of 16
constexpr std::size_t aligned(std::size_t bytes) { return (bytes + 15) / 16 * 16; }

// one vector of every slot in four numbers, or two in six (cuda/slots.h)
constexpr std::size_t slots_bytes(std::size_t real, std::size_t slots, std::size_t vectors) {
  return vectors == 1 ? 4 * real * slots : aligned(6 * real * slots);
}

// With one patch position and u of every slot, with `many` position and rest position; an entry for every corner of a pair;
// planes and balls as numbers of five and eight.
constexpr std::size_t fused_shared_bytes(std::size_t real, bool many, std::size_t slots,
                                         std::size_t entries, std::size_t planes,
                                         std::size_t balls) {
  return fused_control_bytes + (many ? slots_bytes(real, slots, 2) : 8 * real * slots) +
         real * (4 * entries + 5 * planes + 8 * balls);
}

// A cluster of blocks: the most that one has, and what each keeps for sums (cuda/cluster_sums.h).
constexpr std::size_t most_cluster_blocks = 16;
constexpr std::size_t cluster_sums_bytes =
    2 * sizeof(std::uint64_t) + 2 * most_cluster_blocks * 3 * sizeof(double);

// what each keeps for letters (cuda/mail.h); `seats`: shared slots
constexpr std::size_t mail_bytes(std::size_t real, std::size_t seats, std::size_t patches) {
  return 2 * sizeof(std::uint64_t) + 8 * real * seats * patches +
         aligned(sizeof(std::uint16_t) * seats * patches);
}

// all of a block's in a cluster, which also has x, velocity, target, u, before and origin of every slot there
constexpr std::size_t cluster_shared_bytes(std::size_t real, std::size_t fused_bytes,
                                           std::size_t slots, std::size_t seats,
                                           std::size_t patches) {
  return aligned(fused_bytes) + cluster_sums_bytes + mail_bytes(real, seats, patches) +
         6 * 4 * real * slots;
}

// Threads of a block that has one of several patches, and whether the patch is so small that each thread has one slot at
// most, and in float32 one tetrahedron; of float64 there are too few threads for that. Blocks of a cluster have such patches.
constexpr std::size_t most_patch_threads(std::size_t real) { return real == 4 ? 512 : 256; }
constexpr bool near_once(std::size_t real) { return real == 4; }
constexpr bool is_near(std::size_t real, std::size_t slots, std::size_t pairs,
                       std::size_t threads) {
  return slots <= threads && (!near_once(real) || 2 * pairs <= threads);
}

// what a pass keeps beside: three sums of up to 32 warps
constexpr std::size_t pass_static_bytes = 3 * 32 * sizeof(double);

// the same with all that the iterations of the multilevel solver keep
constexpr std::size_t outer_static_bytes = 4608;

// `fields` vectors of every slot, one or two
constexpr std::size_t pass_shared_bytes(std::size_t real, std::size_t slots, std::size_t entries,
                                        std::size_t fields) {
  return slots_bytes(real, slots, fields) + 4 * real * entries;
}

}  // namespace pd
