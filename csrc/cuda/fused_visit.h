// Members of FusedRunner that visit the slots of a patch of a grid, and exchange forces meanwhile.
#pragma once
#include "cuda/fused.h"

namespace pd::inline PD_TARGET {

// Shared slots have the first seats.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE int FusedRunner<T, Touching, Loose, Kind, Near>::slot_of_seat(int seat) const {
  const int shared = patch_.shared();
  return seat < shared ? patch_.interior + seat : seat - shared;
}

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE int FusedRunner<T, Touching, Loose, Kind, Near>::row_of_seat(int seat) const {
  return seat == int(threadIdx.x) ? row_ : patch_.row(slot_of_seat(seat));
}

// rounds of this warp's threads for so many seats
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE int FusedRunner<T, Touching, Loose, Kind, Near>::rounds(int seats) const {
  const int threads = blockDim.x;
  return max(0, (seats - (int(threadIdx.x) - lane()) + threads - 1) / threads);
}

// In a visit the rounds without shared seats come first: letters are on the way meanwhile.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE int FusedRunner<T, Touching, Loose, Kind, Near>::seat_of_visit(int visit) const {
  const int waiting = rounds(patch_.shared()), all = rounds(patch_.slots);
  const int round = visit + waiting < all ? visit + waiting : visit + waiting - all;
  return int(threadIdx.x) + round * int(blockDim.x);
}

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::see(int seat) {
  if (seat >= patch_.slots) return;
  const int slot = slot_of_seat(seat);
  seen_ = v_.see(slot);
  at_ = {slot, row_of_seat(seat), vec3(origin_[slot])};
}

// Of a grid: the force on a shared vertex goes to the other patches.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::post(int seat,
                                                                 const Vec3<T>& force) const {
  const std::int64_t slot = patch_.first_slot + slot_of_seat(seat);
  Letter::post(letter_box() + slot * Letter::words, force, round_);
}

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::post_shared() {
  ++round_;
  for (int seat = threadIdx.x; seat < patch_.shared(); seat += blockDim.x)
    post(seat, sum_entries_soon<T>(entries_, row_of_seat(seat)));
  __syncwarp();
}

template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE Vec3<T> FusedRunner<T, Touching, Loose, Kind, Near>::read(int seat) const {
  const auto* senders = reinterpret_cast<const Senders*>(plan_.slot_sender);
  return read_letters<T>(letter_box(), senders, earlier_shared() + seat, seat < patch_.shared(),
                         round_);
}

// Of a far grid: what the first visited vertex knows of itself, asked for before the barrier, as the next one's before a visit.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::see_first() {
  see(seat_of_visit(0));
}

// What the guard wants to know of this iterate, before it is moved.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::leave_energy(bool owned) {
  if (owned) energy_ += seen_.energy();
  sums_.leave_early({energy_, 0, 0}, 1, Add{});
}

// A warp's rounds of seats without shared ones, then those whose letters have come meanwhile.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
template <bool MayStop, class Visit>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::visit_patch(const Visit& visit) {
  if (soon_ == patch_.pairs) post_shared();
  heed_late<MayStop>();
  if (finished_) return;
  const int shared = patch_.shared(), all = rounds(patch_.slots);
#pragma unroll 1
  for (int i = 0; i < all; ++i) {
    const int seat = seat_of_visit(i);
    const Seen seen = seen_;
    const Seat at = at_;
    if (i + 1 < all) see(seat_of_visit(i + 1));
    const bool here = seat < patch_.slots, sends = seat < shared;
    Vec3<T> force = sum_entries_soon<T>(entries_, here && !sends ? at.row : 0);
    if (seat - lane() < shared) {
      const Vec3<T> sum = read(seat);
      if (sends) force = sum;
    }
    if (here) visit(at, seen, force);
    __syncwarp();
  }
}

// The same where each thread has the one seat of its number. Warps wait as one, else lanes would go on one after another.
template <class T, bool Touching, bool Loose, Blocks Kind, bool Near>
template <bool MayStop, class Visit>
PD_DEVICE void FusedRunner<T, Touching, Loose, Kind, Near>::visit_seat(bool early,
                                                                       const Visit& visit) {
  ++round_;
  const int seat = threadIdx.x, shared = patch_.shared();
  // of the warp: any slots, any shared ones
  const bool here = seat - lane() < patch_.slots, waits = seat - lane() < shared;
  const bool sends = seat < shared;
  Vec3<T> force = {T(0), T(0), T(0)};
  if (here) {
    force = sum_entries_soon<T>(entries_, row_);
    if (sends) post(seat, force);
    see(seat);
  }
  if (early) leave_energy(seat < patch_.slots && at_.owned());
  __syncwarp();
  heed_late<MayStop>();
  if (finished_ || !here) return;
  if (waits) {
    const Vec3<T> sum = read(seat);
    if (sends) force = sum;
    __syncwarp();
  }
  if (seat < patch_.slots) visit(at_, seen_, force);
  __syncwarp();
}

}  // namespace pd::inline PD_TARGET
