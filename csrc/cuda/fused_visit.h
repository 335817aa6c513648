// Members of FusedRunner that visit the slots of one of several patches, and exchange forces meanwhile.
#pragma once
#include "cuda/fused.h"

namespace pd::inline PD_TARGET {

// All slots a first time: forces on shared vertices are sent, others visited. Then the shared ones again, whose forces
// have come meanwhile. One loop, for one copy of the code. What a vertex knows of itself is asked for before the wait.
template <class T, bool Touching, Blocks Kind>
template <class Visit>
PD_DEVICE void FusedRunner<T, Touching, Kind>::visit_patch(const Visit& visit) {
  ++round_;
  Word* box = letter_box();
  const auto* senders = reinterpret_cast<const Senders*>(plan_.slot_sender);
  const int begin = int(threadIdx.x) - lane(), step = blockDim.x, shared = patch_.shared();
  bool again = false;
  for (int from = begin; from < (again ? shared : patch_.slots);) {
    const int seat = from + lane();
    const bool sends = seat < shared, mine = again ? sends : !sends && seat < patch_.slots;
    const int slot = slot_of_seat(seat < patch_.slots ? seat : 0);
    const int row = row_of_seat(seat < patch_.slots ? seat : 0);
    const Seen seen = v_.see(slot);
    const Seat at = {slot, row >= 0, vec3(origin_[slot])};
    Vec3<T> force;
    if (again) {
      force = read_letters<T>(box, senders, earlier_shared() + seat, sends, round_);
    } else {
      force = sum_entries(entries_, row);
      if (sends)
        Letter::post(box + std::int64_t(patch_.first_slot + slot) * Letter::words, force, round_);
    }
    if (mine) visit(at, seen, force);
    __syncwarp();
    from += step;
    if (!again && from >= patch_.slots) {
      again = true;
      from = begin;
    }
  }
}

// The same in a cluster, where each thread has the one seat of its number, and keeps what it has read while it waits.
template <class T, bool Touching, Blocks Kind>
template <class Visit>
PD_DEVICE void FusedRunner<T, Touching, Kind>::visit_seat(const Visit& visit) {
  ++round_;
  const int seat = threadIdx.x, shared = patch_.shared();
  if (seat == 0) mail_.expect(round_);
  const bool here = seat < patch_.slots, sends = seat < shared;
  Seen seen;
  Seat at;
  if (here) {
    const int slot = slot_of_seat(seat);
    seen = v_.see(slot);
    at = {slot, row_ >= 0, vec3(origin_[slot])};
  }
  Vec3<T> force = sum_entries(entries_, row_);
  if (sends) {
    mail_.send(force, round_);
    force = mail_.receive(round_);
  }
  if (here) visit(at, seen, force);
  __syncwarp();
}

}  // namespace pd::inline PD_TARGET
