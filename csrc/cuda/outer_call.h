// What the kernel of the multilevel solver is given, and what it keeps where.
#pragma once
#include "cuda/corotation.h"
#include "cuda/cycle.h"
#include "cuda/pairs.h"
#include "cuda/stream.h"

namespace pd::inline PD_TARGET {

// Sums of a pass over the vertices at a trial u: what the shared ones have of the energy and of work against friction, in the
// precision of the simulation, whose rounding the judgement allows for; s_j . y and s_j . g of the pairs j, the newest one too;
// s . g of that with g at the base; |u - base|^2, |u|^2 from the target, |y|^2, and how much what contacts leave free differs.
constexpr int dots_energy = 0, dots_sy = 2, dots_sg = dots_sy + history;
constexpr int dots_s_residual = dots_sg + history, dots_change = dots_s_residual + 1;
constexpr int dots_displacement = dots_change + 1, dots_yy = dots_displacement + 1;
constexpr int dots_free_change = dots_yy + 1, trial_dots = dots_free_change + 1;
constexpr int most_sums = trial_dots > turning_modes ? trial_dots : turning_modes;  // of any pass
constexpr int most_chunks = 640;  // of vertices, whose sums every block adds up
// Threads of a block: a multiprocessor each, but for meshes of one patch, of which two share it. Few enough that each has the
// registers for what it asks of memory at once.
constexpr int multilevel_threads = 512, small_multilevel_threads = 256;
constexpr int small_multilevel_blocks = 2;
constexpr int multilevel_warps = multilevel_threads / warp_size;

// Device memory of the teams.
template <class T>
struct MultilevelMemory {
  Quad<T>*iterate, *residual, *trial_residual;  // [teams, vertices]
  Quad<T>*s, *y;                                // [teams, history, vertices], with pairs
  Mat3<T>*free, *trial_free;  // [teams, vertices], with contacts, as are the next four
  Quad<T>*gradient, *trial_gradient, *friction, *trial_friction;
  CycleMemory<T> cycle;            // [teams, ...]
  CorotationMemory<T> corotation;  // [teams, ...], with its small problem
  double* chunk_dots;              // [teams, 2, most_sums, chunks], passes alternate
  double* patch_sums;              // [teams, patches, sums_count]
  Range* ranges;                   // [teams, 2, blocks, ranges_count], rounds alternate
  Misfit* misfit;                  // [batch]
  unsigned* counter;               // [teams], zero at the launch
};

template <class T>
struct MultilevelCall {
  StreamCall<T> stream;
  MultilevelMemory<T> memory;
  int teams, blocks;         // blocks of a team
  std::size_t shared_cycle;  // where the cycle's fields stand in shared memory; 0: in device memory
  std::size_t shared_corotation;  // where a CorotationControl stands there; 0: nowhere

  PD_HD const DevicePlan<T>& plan() const { return stream.step.plan; }
  // Warps whose vertices are added up together, a divisor of those of a block: one where the block is small, since a patch
  // has fewer slots than most_chunks warps have lanes. The plan alone decides, so that an environment gives the same bits
  // whatever the number of blocks.
  PD_HD int warps_of_chunk() const {
    for (int warps : {1, 2, 4, 8}) {
      if (chunks_of(plan().vertices, warps) <= most_chunks) return warps;
    }
    return multilevel_warps;
  }
  PD_HD static int chunks_of(int count, int warps) {
    return (count + warps * warp_size - 1) / (warps * warp_size);
  }
  PD_HD int chunks() const { return chunks_of(plan().vertices, warps_of_chunk()); }
};

static_assert(small_multilevel_threads % (most_parts * warp_size) == 0 &&
              multilevel_threads % (most_parts * warp_size) == 0);

// In shared memory: what all threads of a block go by; its first thread decides.
struct MultilevelControl {
  Outer outer;
  Pairs pairs;
  double total[most_sums];
  double factor[history];                                    // of the pairs' ways in the direction
  alignas(16) double warp_dot[multilevel_warps][most_sums];  // of passes; parts of the cycle's
  bool accepted, done;
};

// The arrays of one team.
template <class T>
PD_DEVICE MultilevelMemory<T> of_team(const MultilevelCall<T>& call, int team) {
  MultilevelMemory<T> m = call.memory;
  const std::int64_t n = call.plan().vertices, at = team * n;
  for (Quad<T>** array : {&m.iterate, &m.residual, &m.trial_residual, &m.gradient,
                          &m.trial_gradient, &m.friction, &m.trial_friction})
    *array += at;
  m.s += history * at;
  m.y += history * at;
  m.free += at;
  m.trial_free += at;
  m.cycle = cycle_of_team(call.plan().levels, m.cycle, team);
  CorotationMemory<T>& c = m.corotation;
  c.arm += at;
  c.numbers += turning_groups * at;
  c.images += turning_groups * at;
  c.products += std::int64_t(team) * turning_chunks(int(n)) * 2 * turning_products;
  c.strains += std::int64_t(team) * call.plan().patches * turning_pairs;
  c.totals += std::int64_t(team) * turning_totals;
  c.springs += std::int64_t(team) * turning_chunks(int(n)) * turning_entries;
  m.chunk_dots += std::int64_t(team) * 2 * call.chunks() * most_sums;
  m.patch_sums += std::int64_t(team) * call.plan().patches * sums_count;
  m.ranges += std::int64_t(team) * 2 * call.blocks * ranges_count;
  return m;
}

}  // namespace pd::inline PD_TARGET
