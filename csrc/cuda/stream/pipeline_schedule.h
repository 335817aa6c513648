// Members of Pipeline that build the schedule of a block.
#pragma once
#include "cuda/stream/pipeline.h"

namespace pd::inline PD_TARGET {

// Adds schedule entries from `first` on, by one warp; converged environments are skipped.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::extend_schedule(unsigned first) const {
  __syncwarp();
  ScheduleCursor next = schedule_cursor();
  const int lane = loader(), patches = plan().patches, stride = int(gridDim.x);
  const bool own = call_.step.material.stiffness.stride != 0;
  int found = 0;
  while (found < int(schedule_chunk)) {
    const int item = next.item + lane * stride;
    const int environment = item / patches, patch = item - environment * patches;
    const bool there = environment < call_.step.batch;
    const unsigned goes_on =
        __ballot_sync(full_warp, there && !skips<What>(work(there ? environment : 0)));
    const int rank = found + __popc(goes_on & ((1u << lane) - 1));
    const bool mine = (goes_on >> lane & 1) && rank < int(schedule_chunk);
    ScheduledPatch s{};
    if (mine) {
      s.environment = environment;
      s.patch = patch;
      s.vertex = unsigned(environment) * unsigned(plan().vertices);
      s.slot = unsigned(environment) * unsigned(plan().slots);
      s.place = unsigned(environment) * unsigned(call_.places());
      s.first_vertex = plan().patch_vertex[patch];
      s.interior = plan().patch_vertex[patch + 1] - s.first_vertex;
      s.first_slot = plan().patch_slot[patch];
      s.slots = plan().patch_slot[patch + 1] - s.first_slot;
      s.first_place = s.first_slot - s.first_vertex - s.interior;
      s.first_block = plan().patch_block[patch];
      s.blocks = plan().patch_block[patch + 1] - s.first_block;
      s.weights = own ? unsigned(environment) * unsigned(plan().blocks) : 0;
      s.unit = plan().patch_unit[patch];
      s.patch_weight = work(environment).patch_weight[patch];
    }
    // guarded passes keep first_warp at zero, so that energies are summed in the same order in any
    // batch
    if (What == Visit::update) {
      int until = s.blocks;
#pragma unroll
      for (int distance = 1; distance < warp_size; distance *= 2) {
        const int before = __shfl_up_sync(full_warp, until, distance);
        if (lane >= distance) until += before;
      }
      s.first_warp = (next.first_warp + until - s.blocks) % element_warps;
      next.first_warp =
          (next.first_warp + __shfl_sync(full_warp, until, warp_size - 1)) % element_warps;
    }
    if (mine) scheduled(first + unsigned(rank)) = s;
    found += __popc(goes_on);
    if (!__any_sync(full_warp, there)) {
      if (found + lane < int(schedule_chunk))
        scheduled(first + unsigned(found + lane)) = ScheduledPatch{};
      break;
    }
    next.item =
        __reduce_max_sync(full_warp, mine || found < int(schedule_chunk) ? item : 0) + stride;
  }
  if (lane == 0) schedule_cursor() = next;
}

}  // namespace pd::inline PD_TARGET
