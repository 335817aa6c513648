// Launches of block teams, each with one environment at a time, and the team's preconditioner
// memory.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/runtime.h"
#include "cuda/multilevel/v_cycle.h"
#include "views/arena.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

template <class T>
PD_HD void arrange(Arena& arena, const Levels<T>& levels, int teams, CycleMemory<T>& m) {
  const std::int64_t middle = levels.has_middle() ? 4 * std::int64_t(levels.fine_nodes) : 0;
  const std::int64_t coarse = levels.coarse_unknowns(), below = levels.direct ? 0 : 1;
  const auto place = [&](LevelFields<T>& f, std::int64_t size) {
    for (Quad<T>** array : {&f.right, &f.z}) arena.place(*array, teams * size);
    for (Quad<T>** array : {&f.residual, &f.initial}) arena.place(*array, teams * size * below);
  };
  place(m.fine, levels.vertices);
  place(m.middle, middle);
  arena.place(m.coarse_half, teams * coarse);
  for (Quad<T>** array : {&m.coarse_in, &m.coarse_out}) arena.place(*array, teams * coarse * below);
}

// Blocks per environment and concurrent environments. The bits do not depend on either.
struct Teams {
  int count, blocks;

  Teams(std::int64_t batch, int resident, int useful)
      : count(int(std::clamp<std::int64_t>(batch, 1, resident))),
        blocks(std::clamp(resident / count, 1, useful)) {}
};

// The number of blocks that speeds up the preconditioner, for blocks of `threads` threads.
template <class T>
int useful_blocks(const Levels<T>& levels, int threads) {
  const auto blocks = [&](int each) { return (levels.vertices + each - 1) / each; };
  if (levels.direct) return blocks(threads / warp_size);
  // for fewer vertices, one block finishes before several blocks could synchronise
  return levels.vertices <= 4 * threads ? 1 : blocks(threads);
}

// A cooperative launch: the blocks wait for each other, so all must be resident.
template <class Call>
void launch_teams(const void* kernel, Call& call, unsigned* counter, int threads,
                  std::size_t shared, cudaStream_t stream) {
  void* arguments[] = {&call};
  check(cudaMemsetAsync(counter, 0, call.teams * sizeof(unsigned), stream));
  check(cudaLaunchCooperativeKernel(kernel, dim3(call.teams * call.blocks), dim3(threads),
                                    arguments, shared, stream));
}

}  // namespace pd::inline PD_TARGET
