// How a patch waits for what the other patches of its environment send.
#pragma once
#include "cuda/collect.h"
#include "plan/views.h"

namespace pd::inline PD_TARGET {

// One row of slot_sender.
struct alignas(16) Senders {
  static constexpr int in_flight = 7;
  int32 slot[in_flight], more;
};

// Warps wait as one: lanes that went on as soon as their own words came would do everything after it one by one.
//
// Both inline: nvcc 13.0 loses sums when two functions that hold 128-bit words are out of line (seen on an H100; with either
// one inline the bits are right).
//
// The parts of a shared vertex that its patches sent, in their order; zero for lanes that are not `here`.
template <class T>
PD_DEVICE Vec3<T> receive_forces(const TaggedWord* mailbox, const Senders* rows, int row, bool here,
                                 unsigned round) {
  Vec3<T> sum = {T(0), T(0), T(0)};
  bool goes_on = here;
  do {
    Senders senders = {{-1, -1, -1, -1, -1, -1, -1}, 0};
    if (goes_on) senders = rows[row];
    // all letters again where one is missing: kept ones would have to be waited for one by one
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

// This lane's share of what the patches sent; several requests are under way at once.
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
