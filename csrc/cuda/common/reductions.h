// Reductions over a warp, a block and the blocks of an environment, in a fixed order, and tagged
// messages.
#pragma once
#include "cuda/common/memory.h"

#include <cstdint>

namespace pd::inline PD_TARGET {

constexpr unsigned full_warp = 0xffffffff;
constexpr int warp_size = 32;
constexpr int sums_count = 3;  // values per reduction

struct Add {
  static constexpr double identity = 0;
  PD_HD double operator()(double a, double b) const { return a + b; }
};
struct Min {
  static constexpr double identity = HUGE_VAL;
  PD_HD double operator()(double a, double b) const { return b < a ? b : a; }
};

// Butterfly reduction. All lanes get the same bits: both partners of an exchange combine the same
// two numbers.
template <class Op>
PD_DEVICE double warp_reduce(double value, Op op) {
#pragma unroll
  for (int distance = warp_size / 2; distance > 0; distance /= 2) {
    value = op(value, __shfl_xor_sync(full_warp, value, distance));
  }
  return value;
}

// Several sums in one butterfly; their dependency chains overlap.
template <int Count>
PD_DEVICE void warp_reduce_sums(double (&value)[Count]) {
#pragma unroll
  for (int distance = warp_size / 2; distance > 0; distance /= 2) {
#pragma unroll
    for (int n = 0; n < Count; ++n) value[n] += __shfl_xor_sync(full_warp, value[n], distance);
  }
}

// Warp sums of many values, each written by one lane. The first two exchanges leave each lane one
// value of four, which takes a third of the exchanges of separate butterflies.
template <int Count, class T>
PD_DEVICE void write_warp_sums(const T (&value)[Count], double* to) {
  const int lane = int(threadIdx.x) % warp_size;
  const bool high = lane & 16, odd = lane & 8;
  const auto half = [](bool upper, T a, T b, int distance) {
    const T keep = upper ? b : a, give = upper ? a : b;
    return keep + __shfl_xor_sync(full_warp, give, distance);
  };
#pragma unroll
  for (int first = 0; first < Count; first += 4) {
    T four[4];
#pragma unroll
    for (int n = 0; n < 4; ++n)
      four[n] = first + n < Count ? value[min(first + n, Count - 1)] : T(0);
    T sum = half(odd, half(high, four[0], four[2], 16), half(high, four[1], four[3], 16), 8);
#pragma unroll
    for (int distance = 4; distance > 0; distance /= 2)
      sum += __shfl_xor_sync(full_warp, sum, distance);
    const int own = first + 2 * high + odd;
    if (lane % 8 == 0 && own < Count) to[own] = double(sum);
  }
}

// Sixteen bytes that one instruction stores or loads: a matching tag guarantees that the value
// belongs to the same round.
struct alignas(16) TaggedWord {
  std::uint64_t value, tag;
};

PD_DEVICE void store_tagged(TaggedWord* to, TaggedWord word) {
  asm volatile(
      "{.reg .b128 t; mov.b128 t, {%1, %2}; st.relaxed.gpu.global.b128 [%0], t;}" ::"l"(to),
      "l"(word.value), "l"(word.tag)
      : "memory");
}

// Loads the word if `wanted`, else returns zeros. The load is predicated without a branch, so
// consecutive loads overlap.
PD_DEVICE TaggedWord load_tagged(const TaggedWord* from, bool wanted) {
  TaggedWord word;
  asm volatile(
      "{.reg .b128 t; .reg .b64 none; .reg .pred p; setp.ne.b32 p, %3, 0; mov.b64 none, 0; "
      "mov.b128 t, {none, none}; @p ld.relaxed.gpu.global.b128 t, [%2]; mov.b128 {%0, %1}, t;}"
      : "=l"(word.value), "=l"(word.tag)
      : "l"(from), "r"(int(wanted))
      : "memory");
  return word;
}

// A tagged halo message, a vector with a tag: one word in float32, three words in float64.
template <class T>
struct HaloMessage;

template <>
struct HaloMessage<float> {
  static constexpr int words = 1;
  TaggedWord word;

  PD_DEVICE static void send(TaggedWord* to, const Vec3<float>& a, unsigned tag) {
    const auto bits = [](float f) { return std::uint64_t(__float_as_uint(f)); };
    store_tagged(to, {bits(a.x) | bits(a.y) << 32, bits(a.z) | std::uint64_t(tag) << 32});
  }
  PD_DEVICE void load(const TaggedWord* from, bool wanted) { word = load_tagged(from, wanted); }
  PD_DEVICE bool arrived(unsigned tag) const { return unsigned(word.tag >> 32) == tag; }
  PD_DEVICE Vec3<float> vector() const {
    return {__uint_as_float(unsigned(word.value)), __uint_as_float(unsigned(word.value >> 32)),
            __uint_as_float(unsigned(word.tag))};
  }
};

template <>
struct HaloMessage<double> {
  static constexpr int words = 3;
  TaggedWord word[3];

  PD_DEVICE static void send(TaggedWord* to, const Vec3<double>& a, unsigned tag) {
    const double numbers[3] = {a.x, a.y, a.z};
    for (int c = 0; c < 3; ++c)
      store_tagged(to + c, {std::uint64_t(__double_as_longlong(numbers[c])), tag});
  }
  PD_DEVICE void load(const TaggedWord* from, bool wanted) {
    for (int c = 0; c < 3; ++c) word[c] = load_tagged(from + c, wanted);
  }
  PD_DEVICE bool arrived(unsigned tag) const {
    return word[0].tag == tag && word[1].tag == tag && word[2].tag == tag;
  }
  PD_DEVICE Vec3<double> vector() const {
    const auto number = [](const TaggedWord& w) {
      return __longlong_as_double((long long)w.value);
    };
    return {number(word[0]), number(word[1]), number(word[2])};
  }
};

}  // namespace pd::inline PD_TARGET
