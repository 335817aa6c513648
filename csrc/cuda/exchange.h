// How a patch waits for what the other patches of its environment send.
#pragma once
#include "cuda/collect.h"
#include "plan/views.h"

namespace pd::inline PD_TARGET {

// A slot of the patch, and for shared ones where the patches' parts lie. A thread's first seat stays in its registers.
struct Seat {
  static constexpr int remembered = 8;
  int slot, row, begin, end;
  int sender[remembered];
};

// Both inline: nvcc 13.0 loses sums when two functions that hold 128-bit words are out of line (seen on an H100; with either
// one inline the bits are right).
//
// The parts of a shared vertex that its patches sent, in their order.
template <class T>
__device__ __forceinline__ Vec3<T> read_letters(const Word* box, const int32* shared_slot, Seat at,
                                                unsigned round) {
  constexpr int together = Seat::remembered;
  Vec3<T> sum = {T(0), T(0), T(0)};
  for (int first = at.begin; first < at.end; first += together) {
    const Word* from[together];
    Letter<T> letter[together];
#pragma unroll
    for (int j = 0; j < together; ++j) {
      if (first + j >= at.end) continue;
      const int slot = first == at.begin ? at.sender[j] : shared_slot[first + j];
      from[j] = box + std::int64_t(slot) * Letter<T>::words;
      letter[j].look(from[j]);
    }
#pragma unroll
    for (int j = 0; j < together; ++j) {
      if (first + j >= at.end) continue;
      while (!letter[j].arrived(round)) letter[j].look(from[j]);
      sum = sum + letter[j].vector();
    }
  }
  return sum;
}

// This lane's share of what the patches sent; several requests are under way at once.
template <class Op>
__device__ __forceinline__ double over_patches(const Word* box, int patches, unsigned round) {
  constexpr int together = 5;
  const Op op;
  double sum = Op::none;
  for (int first = threadIdx.x % warp_size; first < patches; first += together * warp_size) {
    Word word[together];
#pragma unroll
    for (int j = 0; j < together; ++j) {
      const int patch = first + j * warp_size;
      if (patch < patches) word[j] = look(box + patch * sums_count);
    }
#pragma unroll
    for (int j = 0; j < together; ++j) {
      const int patch = first + j * warp_size;
      if (patch >= patches) continue;
      while (word[j].tag != round) word[j] = look(box + patch * sums_count);
      sum = op(sum, __longlong_as_double((long long)word[j].value));
    }
  }
  return sum;
}

}  // namespace pd::inline PD_TARGET
