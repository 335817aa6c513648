// Shared memory of a plan's kernels. It is known without a GPU, because it decides which kernel a plan is for.
#pragma once
#include "views/views.h"

#include <cstddef>
#include <cstdint>

namespace pd {

constexpr std::size_t fused_control_bytes = 1024;

// Upper bound of environments per multiprocessor for choosing a block's shape.
constexpr int most_environments = 1 << 20;

// Largest mesh whose environments share blocks, in float32 with kernel block (cuda/small_batch/runner.h).
constexpr int most_sharing_pairs = 192;

// `bytes` rounded up to a multiple of 16
constexpr std::size_t aligned(std::size_t bytes) { return (bytes + 15) / 16 * 16; }

// one vector of every slot as four numbers, or two vectors as six (cuda/common/slots.h)
constexpr std::size_t slots_bytes(std::size_t real, std::size_t slots, std::size_t vectors) {
  return vectors == 1 ? 4 * real * slots : aligned(6 * real * slots);
}

// One patch keeps position and u of every slot, `many` patches only position. Both keep an entry for every corner of
// a pair, and the rows of planes and spheres.
constexpr std::size_t fused_shared_bytes(std::size_t real, bool many, std::size_t slots,
                                         std::size_t entries, std::size_t planes,
                                         std::size_t spheres) {
  return fused_control_bytes + slots_bytes(real, slots, 1) * (many ? 1 : 2) +
         real * (4 * entries + planes_numbers * planes + spheres_numbers * spheres);
}

// Most blocks of a cluster, and the memory of each block for sums (cuda/common/cluster_sums.h).
constexpr std::size_t most_cluster_blocks = 16;
constexpr std::size_t cluster_sums_bytes =
    2 * sizeof(std::uint64_t) + 2 * most_cluster_blocks * 3 * sizeof(double);

// positions of other blocks (cuda/fused/halo.h), double-buffered over two iterations, like entries
constexpr std::size_t halo_bytes(std::size_t real, std::size_t slots) {
  return 2 * sizeof(std::uint64_t) + 2 * 4 * real * slots;
}

// energies: one of every thread
constexpr std::size_t cluster_energy_bytes = 512 * sizeof(double);

// The part before x, velocity, target, u, before and origin of a block's own vertices, which follow.
constexpr std::size_t cluster_vertices_begin(std::size_t real, std::size_t slots,
                                             std::size_t entries, std::size_t planes,
                                             std::size_t spheres) {
  return fused_control_bytes + cluster_sums_bytes + cluster_energy_bytes + halo_bytes(real, slots) +
         aligned(real * (2 * 4 * entries + planes_numbers * planes + spheres_numbers * spheres));
}
constexpr std::size_t cluster_shared_bytes(std::size_t real, std::size_t slots, std::size_t entries,
                                           std::size_t interior, std::size_t planes,
                                           std::size_t spheres) {
  return cluster_vertices_begin(real, slots, entries, planes, spheres) + 6 * 4 * real * interior;
}

// Threads of a block with one of several patches.
//
// A patch is near if each thread has at most one slot, and in float32 one tetrahedron; float64 has too few threads
// for that.
constexpr std::size_t most_patch_threads(std::size_t real) { return real == 4 ? 512 : 256; }
constexpr bool near_once(std::size_t real) { return real == 4; }
constexpr bool is_near(std::size_t real, std::size_t slots, std::size_t pairs,
                       std::size_t threads) {
  return slots <= threads && (!near_once(real) || 2 * pairs <= threads);
}

// Lanes of a cluster's block for each own vertex (cuda/fused/halo.h): eight if there are threads for them anyway, else
// four. A block has no more threads than those, and one warp that only leads.
constexpr std::size_t whole_warps(std::size_t threads) { return (threads + 31) / 32 * 32; }
constexpr std::size_t halo_lanes(std::size_t real, std::size_t pairs, std::size_t interior) {
  const std::size_t all = near_once(real) ? whole_warps(2 * pairs) : most_patch_threads(real) - 32;
  return 8 * interior <= all ? 8 : 4;
}
constexpr std::size_t cluster_threads(std::size_t real, std::size_t pairs, std::size_t interior) {
  const std::size_t own = halo_lanes(real, pairs, interior) * interior;
  const std::size_t tets = near_once(real) ? 2 * pairs : std::size_t(0);
  return whole_warps(own > tets ? own : tets) + 32;
}

// static memory of a pass: three sums of up to 32 warps
constexpr std::size_t pass_static_bytes = 3 * 32 * sizeof(double);

// static memory of the multilevel solver's iterations
constexpr std::size_t outer_static_bytes = 5120;

// memory for `fields` vectors of every slot, one or two
constexpr std::size_t pass_shared_bytes(std::size_t real, std::size_t slots, std::size_t entries,
                                        std::size_t fields) {
  return slots_bytes(real, slots, fields) + 4 * real * entries;
}

// One of the two halves of a pipeline's shared memory (cuda/stream/pipeline.h): position and rest position of every slot,
// then entries of three numbers. A fourth would reduce the cache.
constexpr int pipeline_slots = 1024;  // of a patch, at most
constexpr std::size_t pipeline_half_bytes(std::size_t real, std::size_t slots,
                                          std::size_t entries) {
  return slots_bytes(real, slots, 2) + aligned(3 * real * entries);
}

// Memory of the multilevel solver's coarse space, which follows that of a pass. While it is made, warps use the latter,
// up to 16 of them.
constexpr std::size_t pieces_bytes = 11264;
constexpr std::size_t piece_scratch_numbers = 32;
constexpr std::size_t pieces_offset(std::size_t pass_bytes) {
  constexpr std::size_t scratch = 16 * piece_scratch_numbers * sizeof(double);
  return aligned(pass_bytes < scratch ? scratch : pass_bytes);
}

// shared memory of a block, with a plan for the multilevel solver
constexpr std::size_t outer_shared_bytes(std::size_t real, std::size_t slots, std::size_t entries) {
  return pieces_offset(pass_shared_bytes(real, slots, entries, 2)) + pieces_bytes +
         outer_static_bytes;
}

}  // namespace pd
