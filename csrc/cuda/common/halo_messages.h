// How a patch waits for the halo messages of the other patches of its environment.
#pragma once
#include "cuda/common/reductions.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// One row of slot_sender.
struct alignas(16) Senders {
  static constexpr int in_flight = 7;
  int32 slot[in_flight], more;
};

// Sums the forces that all patches of a shared vertex sent, in patch order; returns zero for lanes
// that are not `here`.
//
// A warp waits as one. If lanes continued as soon as their own words arrived, the warp would run
// all later code lane by lane.
//
// Both functions are inline: nvcc 13.0 loses sums when two out-of-line functions hold 128-bit
// words. An H100 showed this error; with either function inline the bits are right.
template <class T>
PD_DEVICE Vec3<T> receive_forces(const TaggedWord* mailbox, const Senders* rows, int row, bool here,
                                 unsigned round) {
  Vec3<T> sum = {T(0), T(0), T(0)};
  bool goes_on = here;
  do {
    Senders senders = {{-1, -1, -1, -1, -1, -1, -1}, 0};
    if (goes_on) senders = rows[row];
    // reload all messages when one is missing: to keep the others, the warp would have to wait for
    // them one by one
    HaloMessage<T> message[Senders::in_flight];
    bool missing;
    do {
#pragma unroll
      for (int j = 0; j < Senders::in_flight; ++j)
        message[j].load(mailbox + senders.slot[j] * HaloMessage<T>::words, senders.slot[j] >= 0);
      missing = false;
#pragma unroll
      for (int j = 0; j < Senders::in_flight; ++j)
        missing |= senders.slot[j] >= 0 & !message[j].arrived(round);
    } while (__any_sync(full_warp, missing));
#pragma unroll
    for (int j = 0; j < Senders::in_flight; ++j) sum = sum + message[j].vector();
    row = senders.more;
    goes_on = row > 0;
  } while (__any_sync(full_warp, goes_on));
  return sum;
}

// Reduces this lane's share of the patches' messages; several loads are in flight at once.
template <class Op>
PD_DEVICE double reduce_over_patches(const TaggedWord* mailbox, int patches, unsigned round) {
  constexpr int in_flight = 5;
  const Op op;
  double sum = Op::identity;
  for (int first = 0; first < patches; first += in_flight * warp_size) {
    const auto patch = [&](int j) { return first + j * warp_size + int(threadIdx.x) % warp_size; };
    TaggedWord word[in_flight];
    bool missing;
    do {
#pragma unroll
      for (int j = 0; j < in_flight; ++j)
        word[j] = load_tagged(mailbox + patch(j) * sums_count, patch(j) < patches);
      missing = false;
#pragma unroll
      for (int j = 0; j < in_flight; ++j) missing |= patch(j) < patches & word[j].tag != round;
    } while (__any_sync(full_warp, missing));
#pragma unroll
    for (int j = 0; j < in_flight; ++j) {
      if (patch(j) < patches) sum = op(sum, __longlong_as_double((long long)word[j].value));
    }
  }
  return sum;
}

}  // namespace pd::inline PD_TARGET
