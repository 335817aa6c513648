// Members of Pipeline that update the vertices of a patch.
#pragma once
#include "cuda/stream/pipeline.h"

namespace pd::inline PD_TARGET {

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::update_vertices() const {
  // the entries of both halves start free
  for (unsigned n = 0; n < 2; ++n) arrive(slots_ready, n);
  prefetch_patch(0);
  wait_for_previous_kernel();
  // only after the wait, see kernel_overlap.h
  if (updater() == 0) launch_dependents();
#pragma unroll 1
  for (unsigned n = 0; scheduled(n).blocks > 0; ++n) update_patch(n);
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::update_patch(unsigned n) const {
  const ScheduledPatch at = scheduled(n);
  const Work all = work();
  const Entries entries = entries_of(n);
  const int interior = at.interior, slots = at.slots;
  const unsigned first_vertex = at.vertex + unsigned(at.first_vertex);
  ThreadSums sums = no_sums<What>();
  const auto slot = [](int r) { return updater() + r * updater_threads; };
  const auto load_slot = [&](int s) {
    return load_vertex<What>(all, first_vertex + unsigned(s < interior ? s : 0));
  };
  int row[updated];
  Vec3<T> force[updated];
  LoadedVertex loaded[updated];
#pragma unroll
  for (int r = 0; r < updated; ++r)
    row[r] = slot(r) < slots ? plan().slot_row[at.first_slot + slot(r)] : 0;
#pragma unroll
  for (int r = 0; r < prefetched; ++r) loaded[r] = load_slot(slot(r));
  const double loaded_omega = work(at.environment).omega(k_);
  prefetch_patch(n + 1);
  wait(forces_ready, n);
  if (What == Visit::update_guarded && updater() < element_warps)
    sums.value[0] += energies_of(n)[updater()];
  // first everything that frees this half of shared memory
#pragma unroll
  for (int r = 0; r < updated; ++r) force[r] = sum_entries_compact<T>(entries, row[r]);
  const T omega = T(loaded_omega);
#pragma unroll 1
  for (int s = slot(updated); s < interior; s += updater_threads)
    visit<What>(all, first_vertex + unsigned(s), load_vertex<What>(all, first_vertex + unsigned(s)),
                sum_entries_compact<T>(entries, plan().slot_row[at.first_slot + s]), omega, sums);
  arrive(slots_ready, n);
  // loads overlap with the first visits
  unsigned place[updated];
#pragma unroll
  for (int r = 0; r < updated; ++r) {
    place[r] = slot(r) >= interior && slot(r) < slots ? place_of_force(at, slot(r)) : 0;
    if (r >= prefetched) loaded[r] = load_slot(slot(r));
  }
#pragma unroll
  for (int r = 0; r < updated; ++r) {
    if (slot(r) < interior) {
      visit<What>(all, first_vertex + unsigned(slot(r)), loaded[r], force[r], omega, sums);
    } else if (slot(r) < slots) {
      all.store_force(place[r], force[r], round_);
    }
  }
  if (wants_sums<What>(all)) write_updater_sums(sums, n, work(at.environment).sum_row(at.patch));
}

// Prefetches an updater's inputs of a patch into the L2 cache, by one thread of each of three
// warps.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::prefetch_patch(unsigned n) const {
  const ScheduledPatch at = scheduled(n);
  const Work all = work();
  const unsigned first_vertex = at.vertex + unsigned(at.first_vertex);
  const auto prefetch = [](const auto* items, int count, int warp) {
    bulk_prefetch_to_l2(items, count,
                        (updater() + updater_threads - warp_size * warp) % updater_threads,
                        updater_threads);
  };
  prefetch(all.v.before + first_vertex, at.interior, 0);
  prefetch(all.v.target + first_vertex, at.interior, 1);
  prefetch(plan().slot_row + at.first_slot, at.slots, 2);
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::write_updater_sums(const ThreadSums& sums, unsigned n,
                                                     double* row) const {
  constexpr int warps = updater_threads / warp_size;
  // double buffer: warps that are ahead write one half while others still read the other
  __shared__ double by_parity[2][sums_count][warps];
  double (&warp_sum)[sums_count][warps] = by_parity[n & 1];
  for (int i = 0; i < sums_count; ++i) {
    const double sum = warp_reduce(sums.value[i], Add{});
    if (updater() % warp_size == 0) warp_sum[i][updater() / warp_size] = sum;
  }
  sync_updaters();
  if (updater() < sums_count) {
    double sum = 0;
    for (int i = 0; i < warps; ++i) sum += warp_sum[updater()][i];
    row[updater()] = sum;
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::sync_updaters() {
  __syncwarp();
  asm volatile("bar.sync 1, %0;" ::"n"(updater_threads) : "memory");
}

}  // namespace pd::inline PD_TARGET
