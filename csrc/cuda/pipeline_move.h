// Members of Pipeline that move the vertices of a patch.
#pragma once
#include "cuda/pipeline.h"

namespace pd::inline PD_TARGET {

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::move_vertices() const {
  // the entries of both halves are free
  for (unsigned n = 0; n < 2; ++n) give(slots_ready, n);
  bring_patch_near(0);
  await_kernel_before();
  // not before, see handoff.h
  if (mover() == 0) let_next_kernel_start();
#pragma unroll 1
  for (unsigned n = 0; told(n).blocks > 0; ++n) move_patch(n);
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::move_patch(unsigned n) const {
  const Stop at = told(n);
  const Work all = work();
  const Entries entries = entries_of(n);
  const int interior = at.interior, slots = at.slots;
  const unsigned first_vertex = at.vertex + unsigned(at.first_vertex);
  ThreadSums sums = no_sums<What>();
  const auto slot = [](int r) { return mover() + r * mover_threads; };
  const auto see_slot = [&](int s) {
    return see<What>(all, first_vertex + unsigned(s < interior ? s : 0));
  };
  int row[moved];
  Vec3<T> force[moved];
  Seen seen[moved];
#pragma unroll
  for (int r = 0; r < moved; ++r)
    row[r] = slot(r) < slots ? plan().slot_row[at.first_slot + slot(r)] : 0;
#pragma unroll
  for (int r = 0; r < soon; ++r) seen[r] = see_slot(slot(r));
  const double asked = work(at.environment).omega(k_);
  bring_patch_near(n + 1);
  await(forces_ready, n);
  if (What == Visit::update_guarded && mover() < element_warps)
    sums.value[0] += energies_of(n)[mover()];
  // first what frees the half
#pragma unroll
  for (int r = 0; r < moved; ++r) force[r] = sum_entries_briefly<T>(entries, row[r]);
  const T omega = T(asked);
#pragma unroll 1
  for (int s = slot(moved); s < interior; s += mover_threads)
    visit<What>(all, first_vertex + unsigned(s), see<What>(all, first_vertex + unsigned(s)),
                sum_entries_briefly<T>(entries, plan().slot_row[at.first_slot + s]), omega, sums);
  give(slots_ready, n);
  // on the way during the first visits
  unsigned place[moved];
#pragma unroll
  for (int r = 0; r < moved; ++r) {
    place[r] = slot(r) >= interior && slot(r) < slots ? place_of_force(at, slot(r)) : 0;
    if (r >= soon) seen[r] = see_slot(slot(r));
  }
#pragma unroll
  for (int r = 0; r < moved; ++r) {
    if (slot(r) < interior) {
      visit<What>(all, first_vertex + unsigned(slot(r)), seen[r], force[r], omega, sums);
    } else if (slot(r) < slots) {
      all.leave_force(place[r], force[r], round_);
    }
  }
  if (wants_sums<What>(all)) write_mover_sums(sums, n, work(at.environment).sum_row(at.patch));
}

// Has what movers read of a patch brought into the L2 cache, by one thread of each of three warps.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::bring_patch_near(unsigned n) const {
  const Stop at = told(n);
  const Work all = work();
  const unsigned first_vertex = at.vertex + unsigned(at.first_vertex);
  const auto near = [](const auto* items, int count, int warp) {
    bring_all_near(items, count, (mover() + mover_threads - warp_size * warp) % mover_threads,
                   mover_threads);
  };
  near(all.v.before + first_vertex, at.interior, 0);
  near(all.v.target + first_vertex, at.interior, 1);
  near(plan().slot_row + at.first_slot, at.slots, 2);
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::write_mover_sums(const ThreadSums& sums, unsigned n,
                                                   double* row) const {
  constexpr int warps = mover_threads / warp_size;
  // those who are ahead write the others while somebody still reads
  __shared__ double both[2][sums_count][warps];
  double (&warp_sum)[sums_count][warps] = both[n & 1];
  for (int i = 0; i < sums_count; ++i) {
    const double sum = across_warp(sums.value[i], Add{});
    if (mover() % warp_size == 0) warp_sum[i][mover() / warp_size] = sum;
  }
  meet_movers();
  if (mover() < sums_count) {
    double sum = 0;
    for (int i = 0; i < warps; ++i) sum += warp_sum[mover()][i];
    row[mover()] = sum;
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::meet_movers() {
  __syncwarp();
  asm volatile("bar.sync 1, %0;" ::"n"(mover_threads) : "memory");
}

}  // namespace pd::inline PD_TARGET
