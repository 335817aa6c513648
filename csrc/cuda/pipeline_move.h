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
  const Stop& at = told(n);
  const Work w = work(at.environment);
  const Entries entries = entries_of(n);
  const int interior = at.interior, first_vertex = at.first_vertex;
  const int slots = at.slots, first_slot = at.first_slot;
  ThreadSums sums = no_sums<What>();
  const auto slot = [](int r) { return mover() + r * mover_threads; };
  const auto see_slot = [&](int s) { return see<What>(w, first_vertex + (s < interior ? s : 0)); };
  const auto visit_slot = [&](int s, const Vec3<T>& force, const auto& seen_there) {
    if (s < interior) {
      visit<What>(w, first_vertex + s, seen_there(), force, k_, sums);
    } else if (s < slots) {
      w.leave_force(place_of_force(at, s), force, round_);
    }
  };
  int row[moved];
  Vec3<T> force[moved];
  Seen seen[soon];
#pragma unroll
  for (int r = 0; r < moved; ++r)
    row[r] = slot(r) < slots ? w.plan.slot_row[first_slot + slot(r)] : 0;
#pragma unroll
  for (int r = 0; r < soon; ++r) seen[r] = see_slot(slot(r));
  bring_patch_near(n + 1);
  await(forces_ready, n);
  if (What == Visit::update_guarded && mover() < element_warps)
    sums.value[0] += energies_of(n)[mover()];
  // first what frees the half
#pragma unroll
  for (int r = 0; r < moved; ++r) force[r] = sum_entries_briefly<T>(entries, row[r]);
  const auto visit_late = [&](int s, const Vec3<T>& summed) {
    visit_slot(s, summed, [&] { return see_slot(s); });
  };
#pragma unroll 1
  for (int s = slot(moved); s < interior; s += mover_threads)
    visit_late(s, sum_entries_briefly<T>(entries, w.plan.slot_row[first_slot + s]));
  give(slots_ready, n);
#pragma unroll
  for (int r = 0; r < soon; ++r) visit_slot(slot(r), force[r], [&] { return seen[r]; });
#pragma unroll
  for (int r = soon; r < moved; ++r) visit_late(slot(r), force[r]);
  if (wants_sums<What>(w)) write_mover_sums(sums, n, w.sum_row(at.patch));
}

// Has what movers read of a patch brought into the L2 cache.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::bring_patch_near(unsigned n) const {
  const Stop& at = told(n);
  const Work w = work(at.environment);
  bring_near(w.v.before + at.first_vertex, at.interior, mover(), mover_threads);
  bring_near(w.v.target + at.first_vertex, at.interior, mover(), mover_threads);
  bring_near(w.plan.slot_row + at.first_slot, at.slots, mover(), mover_threads);
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
