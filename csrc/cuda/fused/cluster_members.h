// Members of FusedRunner for a patch of a cluster. The patch owns its interior vertices and
// receives the positions of the others.
#pragma once
#include "cuda/fused/runner.h"

namespace pd::inline PD_TARGET {

// Of all patches that compute a tetrahedron, one counts its energy.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE bool FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::counts(
    int number, T tet_energy) const {
  if (OnePerThread || number == int(threadIdx.x)) return counts_;
  return !(tet_energy == T(0)) && counts_energy(number);
}
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE bool FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                           HasStencils>::counts_energy(int number) const {
  const PairPlace place = place_of(patch_, min(number / 2, patch_.pairs - 1));
  return plan_.pair_tet[place.in(2) + number % 2 * pair_lanes] >= 0;
}

// Origin of the positions: the same for all patches of a cluster, since they exchange positions.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE Vec3<T>
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::anchor_of_step() {
  if constexpr (!Clustered) return vec3(v_.x[0]);
  if (just_loaded_) {
    just_loaded_ = false;
    return control_.anchor;
  }
  cluster_barrier();
  const SharedAddress first = at_block(shared_address(v_.x), 0);
  T anchor[3];
  for (int c = 0; c < 3; ++c) anchor[c] = read_shared(first + c * int(sizeof(T)), T(0));
  cluster_barrier();  // the vertex moves after this barrier
  return read3(anchor);
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::wait_for_positions() {
  if (waited_ != round_) halo_.wait(round_);
  waited_ = round_;
}

// Loads the iterate into registers, where it stays during the iterations.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::load_iterate() {
  const int own = OwnHalo::vertex();
  if (own >= patch_.interior) return;
  loaded_ = v_.load(own);
  item_ = {own, row_, vec3(origin_[own])};
  in_registers_ = true;
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::store_iterate() {
  if (in_registers_ && is_first()) {
    v_.set(item_.slot, loaded_.u);
    v_.set_before(item_.slot, loaded_.before);
  }
  in_registers_ = false;
}

// Sends own vertices that something other than an iteration has moved.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::send_positions() {
  __syncthreads();
  wait_for_positions();
  ++round_;
  moved_ = false;
  if (has_own()) {
    const int own = min(OwnHalo::vertex(), patch_.interior - 1);
    halo_.send(vec3(origin_[own]) + vec3(v_.u[own]), round_);
  }
}

// Cluster variant of iterate(). It ends without a barrier; the next iteration begins by waiting for
// positions. Data that warps write before the barrier and read after it is double-buffered by the
// parity of the iteration.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
template <bool Stops>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::iterate_own(
    int k) {
  const bool guard = set_.schedule == ScheduleKind::guarded && k % guard_period == 0;
  if (moved_) {
    send_positions();
    load_iterate();
  }
  if (Stops && pending_ && in_leading_warp()) sums_.send(Add{});
  energy_ = guard && is_first() ? loaded_.energy() : 0;
  wait_for_positions();
  energy_ += double(each_element(SolidGradient<true>{guard}));
  if (guard && !Stops) energies_[threadIdx.x] = energy_;
  if (Stops) first_ = second_ = 0;
  if (in_leading_warp()) {
    if (Stops && pending_) apply_sums();
    if (is_leader()) {
      control_.omega_by_parity[k % 2] = k == 0 ? control_.omega : next_omega_;
      // computed early, while other warps are busy, although the energy may still change it
      next_omega_ = T(control_.progress.schedule.next(k + 1));
      if (!control_.progress.done) ++control_.progress.used;
    }
  }
  __syncthreads();
  if (Stops && control_.progress.done) {
    finished_ = true;
    pending_ = false;
    return;
  }
  const Quad<T>* const entries = entries_of_round();
  ++round_;
  if (has_own()) {
    const T omega = control_.omega_by_parity[k % 2];
    const Vec3<T> force = OwnHalo::sum_entries(entries, row_);
    if (Stops && is_first()) second_ = loaded_.square_of_displacement();
    const Vec3<T> next = loaded_.next(contacts_, force, theta_, omega);
    halo_.send(item_.origin + next, round_);
    if (Stops && is_first()) {
      const Vec3<T> change = next - loaded_.u;
      first_ = double(dot(change, change));
    }
    loaded_.before = loaded_.u;
    loaded_.u = next;
  }
  if (Stops) sums_.store_partial({energy_, first_, second_}, sums_count, Add{});
  if (in_leading_warp()) {
    if (!Stops && guard) {
      sums_.gather(energies_, Add{});
      sums_.send(Add{});
    } else if (!Stops && pending_) {
      const Schedule& schedule = control_.progress.schedule;
      const int before = schedule.restarts;
      apply_sums();
      // after a restart, omega is independent of earlier iterations, so it is computed again
      if (is_leader() && schedule.restarts > before)
        next_omega_ = T(control_.progress.schedule.next(k + 1));
    }
  }
  guarding_ = guard;
  pending_ = guard || Stops;
  if (Stops) __syncthreads();
}

// Cluster variant of pass(), for visits that move no vertex.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
template <class Element, class Visit>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::pass_own(
    const Element& element, const Visit& visit) {
  if (moved_) send_positions();
  wait_for_positions();
  energy_ = double(each_element(element));
  first_ = second_ = 0;
  __syncthreads();
  if (!has_own()) return;
  const Vec3<T> force = OwnHalo::sum_entries(entries_of_round(), row_);
  if (is_first()) {
    const int own = OwnHalo::vertex();
    visit({own, row_, vec3(origin_[own])}, v_.load(own), force);
  }
  __syncwarp();
}

}  // namespace pd::inline PD_TARGET
