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
constexpr int dots_energy = 0, dots_with = 2, dots_pulled = dots_with + history;
constexpr int dots_back = dots_pulled + history, dots_change = dots_back + 1;
constexpr int dots_way = dots_change + 1, dots_turn = dots_way + 1;
constexpr int dots_held = dots_turn + 1, outer_dots = dots_held + 1;
constexpr int most_sums = outer_dots > turning_modes ? outer_dots : turning_modes;  // of any pass
constexpr int most_chunks = 640;  // of vertices, whose sums every block adds up
// Threads of a block: a multiprocessor each, but for meshes of one patch, of which two share it. Few enough that each has the
// registers for what it asks of memory at once.
constexpr int outer_threads = 512, small_outer_threads = 256;
constexpr int small_outer_blocks = 2;
constexpr int outer_warps = outer_threads / warp_size;

// Device memory of the teams.
template <class T>
struct OuterMemory {
  Quad<T>*base, *pull, *fresh;  // [teams, vertices]
  Quad<T>*s, *y;                // [teams, history, vertices], with pairs
  Mat3<T>*free, *fresh_free;    // [teams, vertices], with contacts, as are the next four
  Quad<T>*gradient, *fresh_gradient, *friction, *fresh_friction;
  CycleMemory<T> cycle;            // [teams, ...]
  CorotationMemory<T> corotation;  // [teams, ...], with its small problem
  double* chunk_dots;              // [teams, 2, most_sums, chunks], passes alternate
  double* patch_sums;              // [teams, patches, sums_count]
  Range* ranges;                   // [teams, 2, blocks, ranges_count], rounds alternate
  Misfit* misfit;                  // [batch]
  unsigned* counter;               // [teams], zero at the launch
};

template <class T>
struct OuterCall {
  StreamCall<T> stream;
  OuterMemory<T> memory;
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
    return outer_warps;
  }
  PD_HD static int chunks_of(int count, int warps) {
    return (count + warps * warp_size - 1) / (warps * warp_size);
  }
  PD_HD int chunks() const { return chunks_of(plan().vertices, warps_of_chunk()); }
};

static_assert(small_outer_threads % (most_parts * warp_size) == 0 &&
              outer_threads % (most_parts * warp_size) == 0);

// In shared memory: what all threads of a block go by; its first thread decides.
struct OuterControl {
  Outer outer;
  Pairs pairs;
  double total[most_sums];
  double factor[history];                               // of the pairs' ways in the direction
  alignas(16) double warp_dot[outer_warps][most_sums];  // of passes; parts of the cycle's
  bool accepted, done;
};

// The arrays of one team.
template <class T>
PD_DEVICE OuterMemory<T> of_team(const OuterCall<T>& call, int team) {
  OuterMemory<T> m = call.memory;
  const std::int64_t n = call.plan().vertices, at = team * n;
  for (Quad<T>** array :
       {&m.base, &m.pull, &m.fresh, &m.gradient, &m.fresh_gradient, &m.friction, &m.fresh_friction})
    *array += at;
  m.s += history * at;
  m.y += history * at;
  m.free += at;
  m.fresh_free += at;
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
