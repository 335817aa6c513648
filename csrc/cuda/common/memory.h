// Vector types in GPU memory, and cache and register hints for one thread.
#pragma once
#include "math/vec.h"

#include <cstdint>

// Kernels inline nearly everything: an out-of-line call keeps its objects in memory, not in
// registers.
#define PD_DEVICE __device__ __forceinline__
// For code that a kernel runs rarely on values or on data in memory. Inlined, it would take
// registers from the iterations.
#define PD_DEVICE_COLD __device__ __noinline__

namespace pd::inline PD_TARGET {

// A vertex: three components and a fourth value stored with them, for 16-byte loads and stores.
template <class T>
struct alignas(4 * sizeof(T) > 16 ? 16 : 4 * sizeof(T)) Quad {
  T x, y, z, w;
};

template <class T>
PD_HD Vec3<T> vec3(const Quad<T>& a) {
  return {a.x, a.y, a.z};
}

template <class T>
PD_HD Quad<T> quad(const Vec3<T>& a, T w = T(0)) {
  return {a.x, a.y, a.z, w};
}

// Hides a value from the optimiser, which would otherwise recompute it instead of keeping it in a
// register.
PD_DEVICE int in_register(int value) {
  asm volatile("" : "+r"(value));
  return value;
}
PD_DEVICE unsigned in_register(unsigned value) {
  asm volatile("" : "+r"(value));
  return value;
}
template <class Item>
PD_DEVICE const Item* in_register(const Item* value) {
  asm volatile("" : "+l"(value));
  return value;
}
PD_DEVICE float in_register(float value) {
  asm volatile("" : "+f"(value));
  return value;
}
PD_DEVICE double in_register(double value) {
  asm volatile("" : "+d"(value));
  return value;
}

// An arbitrary number that costs no instruction.
template <class T>
PD_DEVICE T undefined_number() {
  T any;
  if constexpr (sizeof(T) == 4) {
    asm volatile("" : "=f"(any));
  } else {
    asm volatile("" : "=d"(any));
  }
  return any;
}

// The given threads, by default all of the block, prefetch items into the L2 cache.
template <class Item>
PD_DEVICE void prefetch_to_l2(const Item* items, int count, int thread, int threads) {
  constexpr int line = 128 / sizeof(Item);
#pragma unroll 1
  for (int i = thread * line; i < count; i += threads * line)
    asm volatile("prefetch.global.L2 [%0];" ::"l"(items + i));
}
template <class Item>
PD_DEVICE void prefetch_to_l2(const Item* items, int count) {
  prefetch_to_l2(items, count, int(threadIdx.x), int(blockDim.x));
}

// The same prefetch as one bulk instruction of one thread (compute capability 9.0 and newer); older
// devices use `threads` threads.
template <class Item>
PD_DEVICE void bulk_prefetch_to_l2(const Item* items, int count, int thread, int threads) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  constexpr std::uintptr_t unit = 16;
  const auto begin = reinterpret_cast<std::uintptr_t>(items) / unit * unit;
  const auto end = reinterpret_cast<std::uintptr_t>(items + count) + unit - 1;
  if (thread == 0 && count > 0)
    asm volatile("cp.async.bulk.prefetch.L2.global [%0], %1;" ::"l"(begin),
                 "r"(unsigned((end - begin) / unit * unit)));
#else
  prefetch_to_l2(items, count, thread, threads);
#endif
}

template <class T>
PD_HD Vec3<T> read3(const T* p) {
  return {p[0], p[1], p[2]};
}

template <class T>
PD_HD void write3(T* p, const Vec3<T>& a) {
  p[0] = a.x;
  p[1] = a.y;
  p[2] = a.z;
}

}  // namespace pd::inline PD_TARGET
