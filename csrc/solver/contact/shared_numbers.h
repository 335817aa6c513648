// Numbers that several threads of an environment change at a time. The result depends on no order:
// counts, and the least or largest of numbers. On the host one thread runs alone.
#pragma once
#include "math/scalar.h"

#include <cstdint>

namespace pd::inline PD_TARGET {

// Adds one; returns the number before.
PD_HD int count_one(int* to) {
#if defined(__CUDA_ARCH__)
  return atomicAdd(to, 1);
#else
  return (*to)++;
#endif
}

// Whether it was 0; then it is 1.
PD_HD bool take_first(int* to) {
#if defined(__CUDA_ARCH__)
  return atomicExch(to, 1) == 0;
#else
  const bool first = *to == 0;
  *to = 1;
  return first;
#endif
}

PD_HD void lower(int* to, int value) {
#if defined(__CUDA_ARCH__)
  atomicMin(to, value);
#else
  if (value < *to) *to = value;
#endif
}
PD_HD void raise(int* to, int value) {
#if defined(__CUDA_ARCH__)
  atomicMax(to, value);
#else
  if (*to < value) *to = value;
#endif
}

// Numbers of any sign, none NaN: bits of positive ones are ordered as integers, of negative ones the
// other way round.
PD_HD void lower(float* to, float value) {
#if defined(__CUDA_ARCH__)
  const float own = value + 0.0f;  // no -0
  if (own >= 0.0f) {
    atomicMin(reinterpret_cast<int*>(to), __float_as_int(own));
  } else {
    atomicMax(reinterpret_cast<unsigned*>(to), __float_as_uint(own));
  }
#else
  if (value < *to) *to = value;
#endif
}
PD_HD void lower(double* to, double value) {
#if defined(__CUDA_ARCH__)
  const double own = value + 0.0;
  if (own >= 0.0) {
    atomicMin(reinterpret_cast<long long*>(to), __double_as_longlong(own));
  } else {
    atomicMax(reinterpret_cast<unsigned long long*>(to),
              static_cast<unsigned long long>(__double_as_longlong(own)));
  }
#else
  if (value < *to) *to = value;
#endif
}
PD_HD void raise(float* to, float value) {
#if defined(__CUDA_ARCH__)
  const float own = value + 0.0f;
  if (own >= 0.0f) {
    atomicMax(reinterpret_cast<int*>(to), __float_as_int(own));
  } else {
    atomicMin(reinterpret_cast<unsigned*>(to), __float_as_uint(own));
  }
#else
  if (*to < value) *to = value;
#endif
}
PD_HD void raise(double* to, double value) {
#if defined(__CUDA_ARCH__)
  const double own = value + 0.0;
  if (own >= 0.0) {
    atomicMax(reinterpret_cast<long long*>(to), __double_as_longlong(own));
  } else {
    atomicMin(reinterpret_cast<unsigned long long*>(to),
              static_cast<unsigned long long>(__double_as_longlong(own)));
  }
#else
  if (*to < value) *to = value;
#endif
}

// Joins the groups of two members, each named by its least member: `group` is a forest of links to lesser ones.
PD_HD void join(int* group, int a, int b) {
#if defined(__CUDA_ARCH__)
  while (a != b) {
    const int least = a < b ? a : b, most = a < b ? b : a;
    const int before = atomicMin(group + most, least);
    if (before == most) return;
    a = before;
    b = least;
  }
#else
  while (a != b) {
    const int least = a < b ? a : b, most = a < b ? b : a, before = group[most];
    if (least < before) group[most] = least;
    if (before == most) return;
    a = before;
    b = least;
  }
#endif
}
PD_HD int root_of(const int* group, int member) {
  while (group[member] != member) member = group[member];
  return member;
}

}  // namespace pd::inline PD_TARGET
