// How a patch waits for what the other patches of its environment send.
#pragma once
#include "cuda/collect.h"
#include "plan/views.h"

namespace pd::inline PD_TARGET {

// One row of slot_sender.
struct alignas(16) Senders {
  static constexpr int together = 7;
  int32 slot[together], more;
};

// Warps wait as one: lanes that went on as soon as their own words came would do everything after it one by one.
//
// Both inline: nvcc 13.0 loses sums when two functions that hold 128-bit words are out of line (seen on an H100; with either
// one inline the bits are right).
//
// The parts of a shared vertex that its patches sent, in their order; zero for lanes that are not `here`.
template <class T>
PD_DEVICE Vec3<T> read_letters(const Word* box, const Senders* rows, int row, bool here,
                               unsigned round) {
  Vec3<T> sum = {T(0), T(0), T(0)};
  bool goes_on = here;
  do {
    Senders senders = {{-1, -1, -1, -1, -1, -1, -1}, 0};
    if (goes_on) senders = rows[row];
    // all letters again where one is missing: kept ones would have to be waited for one by one
    Letter<T> letter[Senders::together];
    bool waits;
    do {
#pragma unroll
      for (int j = 0; j < Senders::together; ++j)
        letter[j].look(box + senders.slot[j] * Letter<T>::words, senders.slot[j] >= 0);
      waits = false;
#pragma unroll
      for (int j = 0; j < Senders::together; ++j)
        waits |= senders.slot[j] >= 0 & !letter[j].arrived(round);
    } while (__any_sync(whole_warp, waits));
#pragma unroll
    for (int j = 0; j < Senders::together; ++j) sum = sum + letter[j].vector();
    row = senders.more;
    goes_on = row > 0;
  } while (__any_sync(whole_warp, goes_on));
  return sum;
}

// This lane's share of what the patches sent; several requests are under way at once.
template <class Op>
PD_DEVICE double over_patches(const Word* box, int patches, unsigned round) {
  constexpr int together = 5;
  const Op op;
  double sum = Op::none;
  for (int first = 0; first < patches; first += together * warp_size) {
    const auto patch = [&](int j) { return first + j * warp_size + int(threadIdx.x) % warp_size; };
    Word word[together];
    bool waits;
    do {
#pragma unroll
      for (int j = 0; j < together; ++j)
        word[j] = look(box + patch(j) * sums_count, patch(j) < patches);
      waits = false;
#pragma unroll
      for (int j = 0; j < together; ++j) waits |= patch(j) < patches & word[j].tag != round;
    } while (__any_sync(whole_warp, waits));
#pragma unroll
    for (int j = 0; j < together; ++j) {
      if (patch(j) < patches) sum = op(sum, __longlong_as_double((long long)word[j].value));
    }
  }
  return sum;
}

}  // namespace pd::inline PD_TARGET
