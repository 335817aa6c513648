// Members of FusedRunner that update the slots of a grid's patch while halo messages are in flight.
#pragma once
#include "cuda/fused/runner.h"

namespace pd::inline PD_TARGET {

// Items are numbered with shared slots first.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE int FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::slot_of_item(
    int item) const {
  const int shared = patch_.shared();
  return item < shared ? patch_.interior + item : item - shared;
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE int FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::row_of_item(
    int item) const {
  return item == int(threadIdx.x) ? row_ : patch_.row(slot_of_item(item));
}

// Rounds that this warp needs for `items` items.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE int FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::rounds(
    int items) const {
  const int threads = blockDim.x;
  return max(0, (items - (int(threadIdx.x) - lane()) + threads - 1) / threads);
}

// Rounds without shared slots come first, while messages are in flight.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE int FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                          HasStencils>::item_of_visit(int visit) const {
  const int waiting = rounds(patch_.shared()), all = rounds(patch_.slots);
  const int round = visit + waiting < all ? visit + waiting : visit + waiting - all;
  return int(threadIdx.x) + round * int(blockDim.x);
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::load_item(
    int item) {
  if (item >= patch_.slots) return;
  const int slot = slot_of_item(item);
  loaded_ = v_.load(slot);
  item_ = {slot, row_of_item(item), vec3(origin_[slot])};
}

// Grid: sends the force on a shared vertex to the other patches.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::send_force(
    int item, const Vec3<T>& force) const {
  const std::int64_t slot = patch_.first_slot + slot_of_item(item);
  HaloMessage::send(mailbox() + slot * HaloMessage::words, force, round_);
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::send_shared_forces() {
  ++round_;
  for (int item = threadIdx.x; item < patch_.shared(); item += blockDim.x)
    send_force(item, sum_entries_by_8<T>(entries_, row_of_item(item)));
  __syncwarp();
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE Vec3<T> FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                              HasStencils>::receive_force(int item) const {
  const auto* senders = reinterpret_cast<const Senders*>(plan_.slot_sender);
  return receive_forces<T>(mailbox(), senders, earlier_shared() + item, item < patch_.shared(),
                           round_);
}

// Grid without InShared: loads the first item before the barrier; each later item is loaded during
// the visit before it.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::prefetch_first() {
  load_item(item_of_visit(0));
}

// Contributes the energy of the current iterate, which the schedule's guard needs before the
// update.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::store_energy(bool owned) {
  if (owned) energy_ += loaded_.energy();
  sums_.store_partial_early({energy_, 0, 0}, 1, Add{});
}

// Visits the interior rounds of a warp, then the shared ones, whose messages have arrived
// meanwhile.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
template <bool MayStop, class Visit>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::visit_items(
    const Visit& visit) {
  if (outer_pairs_ == patch_.pairs) send_shared_forces();
  read_control_late<MayStop>();
  if (finished_) return;
  const int shared = patch_.shared(), all = rounds(patch_.slots);
#pragma unroll 1
  for (int i = 0; i < all; ++i) {
    const int item = item_of_visit(i);
    const LoadedVertex loaded = loaded_;
    const WorkItem at = item_;
    if (i + 1 < all) load_item(item_of_visit(i + 1));
    const bool here = item < patch_.slots, sends = item < shared;
    Vec3<T> force = sum_entries_by_8<T>(entries_, here && !sends ? at.row : 0);
    if (item - lane() < shared) {
      const Vec3<T> sum = receive_force(item);
      if (sends) force = sum;
    }
    if (here) visit(at, loaded, force);
    __syncwarp();
  }
}

// The same with one item per thread. A warp waits as one, since its lanes would otherwise continue
// one after another.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
template <bool MayStop, class Visit>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                           HasStencils>::visit_one_item(bool early, const Visit& visit) {
  ++round_;
  const int item = threadIdx.x, shared = patch_.shared();
  // whether the warp has any slots, and any shared slots
  const bool here = item - lane() < patch_.slots, waits = item - lane() < shared;
  const bool sends = item < shared;
  Vec3<T> force = {T(0), T(0), T(0)};
  if (here) {
    force = sum_entries_by_8<T>(entries_, row_);
    if (sends) send_force(item, force);
    load_item(item);
  }
  if (early) store_energy(item < patch_.slots && item_.owned());
  __syncwarp();
  read_control_late<MayStop>();
  if (finished_ || !here) return;
  if (waits) {
    const Vec3<T> sum = receive_force(item);
    if (sends) force = sum;
    __syncwarp();
  }
  if (item < patch_.slots) visit(item_, loaded_, force);
  __syncwarp();
}

}  // namespace pd::inline PD_TARGET
