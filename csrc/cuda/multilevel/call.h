// Arguments and memory layout of the multilevel kernel.
#pragma once
#include "cuda/multilevel/lbfgs_pairs.h"
#include "cuda/multilevel/pieces.h"
#include "cuda/multilevel/v_cycle.h"
#include "cuda/stream/kernels.h"

namespace pd::inline PD_TARGET {

// Sums over the vertices at a trial u. dots_energy: the shared vertices' energy and work against
// friction; energy_noise covers their rounding in T. dots_sy, dots_sg: s_j . y and s_j . g of every
// secant pair j, the newest included. dots_s_residual: s . g with the residual g of the iterate.
// dots_change, dots_displacement: |u - iterate|^2 and |u - target|^2. dots_yy: |y|^2.
// dots_free_change: squared change of the free directions at contacts.
constexpr int dots_energy = 0, dots_sy = 2, dots_sg = dots_sy + history;
constexpr int dots_s_residual = dots_sg + history, dots_change = dots_s_residual + 1;
constexpr int dots_displacement = dots_change + 1, dots_yy = dots_displacement + 1;
constexpr int dots_free_change = dots_yy + 1, trial_dots = dots_free_change + 1;
constexpr int most_sums = trial_dots;  // of any pass
constexpr int most_chunks = 640;       // whose sums every block reduces
// Threads per block. A block has a multiprocessor to itself; for meshes of one patch, two blocks
// share one. Each thread has enough registers for all of its loads in flight.
constexpr int multilevel_threads = 512, small_multilevel_threads = 256;
constexpr int small_multilevel_blocks = 2;
constexpr int multilevel_warps = multilevel_threads / warp_size;

// Device memory of the teams.
template <class T>
struct MultilevelMemory {
  Quad<T>*iterate, *residual, *trial_residual;  // [teams, vertices]
  Quad<T>*s, *y;                                // [teams, history, vertices], with L-BFGS
  Mat3<T>*free, *trial_free;  // [teams, vertices], with contacts, as are the next four
  Quad<T>*gradient, *trial_gradient, *friction, *trial_friction;
  CycleMemory<T> cycle;        // [teams, ...]
  PiecesMemory<T> pieces;      // [teams, ...], with a coarse space
  double* chunk_dots;          // [teams, 2, most_sums, chunks], double-buffered
  double* patch_sums;          // [teams, patches, sums_count]
  RatioRange* ranges;          // [teams, 2, blocks, ranges_count], double-buffered
  MaterialMismatch* mismatch;  // [batch]
  unsigned* counter;           // [teams], zero at the launch
};

template <class T>
struct MultilevelCall {
  StreamCall<T> stream;
  MultilevelMemory<T> memory;
  int teams, blocks;          // blocks of a team
  std::size_t shared_cycle;   // offset of the cycle's fields in shared memory; 0: in device memory
  std::size_t shared_pieces;  // offset of PiecesControl in shared memory; 0: none

  PD_HD const DevicePlan<T>& plan() const { return stream.step.plan; }
  // Warps per chunk of vertices, a divisor of the warps of a block. It is 1 for small blocks, since
  // a patch has fewer slots than most_chunks warps have lanes. The plan alone decides, so that the
  // bits do not depend on the number of blocks.
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

// State of a block in shared memory; its first thread updates it.
struct MultilevelControl {
  LineSearch outer;
  SecantPairs pairs;
  double total[most_sums];
  double factor[history];  // coefficients of s_j in the direction
  // of passes; also the cycle's partial sums
  alignas(16) double warp_dot[multilevel_warps][most_sums];
  bool accepted, done;
};

// The arrays of one team, but for those of pieces.
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
  m.chunk_dots += std::int64_t(team) * 2 * call.chunks() * most_sums;
  m.patch_sums += std::int64_t(team) * call.plan().patches * sums_count;
  m.ranges += std::int64_t(team) * 2 * call.blocks * ranges_count;
  return m;
}

}  // namespace pd::inline PD_TARGET
