// Inputs of the maths of freeform patches: pointers and counts, without torch or CUDA.
//
// A task is a struct of inputs and outputs. `item(task, i)` computes the outputs of index i and
// writes nothing else. The items of a task therefore run in any order, on any device, to the same
// bits.
#pragma once
#include "math/mat.h"
#include "math/scalar.h"

#include <cstdint>

namespace pd::freeform {

using Index = std::int64_t;
using int32 = std::int32_t;

struct Lists {
#define X(name, width, rows, meaning) const int32* name = nullptr;
#include "freeform/lists.def"
#undef X
  Index patches = 0, vertices = 0, entries = 0, quadrics = 0, samples = 0;
};

struct Constraints {
#define X(name, width, rows, meaning) const int32* name = nullptr;
#include "freeform/constraints.def"
#undef X
  Index count = 0, points = 0;
};

// The surface at rest.
template <class T>
struct Base {
  const T* vertices = nullptr;   // [V, 3] m
  const T* directors = nullptr;  // [V, 3]
  T lift = 0;                    // 3/4 for Phong tessellation, 0 for flat patches
};

template <class T>
struct Ellipsoids {
  const T* amplitudes = nullptr;  // [Q] m
  const T* centres = nullptr;     // [Q, 3] m
  const T* factors = nullptr;     // [Q, 6] M00 M11 M22 M10 M20 M21, 1/m
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

PD_HD bool is_below(int32 index, Index count) { return index >= 0 && index < count; }

template <class T>
PD_HD T greater(const T& a, const T& b) {
  return b > a ? b : a;
}

template <class T>
PD_HD Vec3<T> load3(const T* from, Index row) {
  return {from[3 * row], from[3 * row + 1], from[3 * row + 2]};
}

template <class T>
PD_HD void store3(T* to, Index row, const Vec3<T>& a) {
  to[3 * row] = a.x;
  to[3 * row + 1] = a.y;
  to[3 * row + 2] = a.z;
}

template <class T>
PD_HD Mat3<T> load9(const T* from, Index row) {
  return {{load3(from, 3 * row), load3(from, 3 * row + 1), load3(from, 3 * row + 2)}};
}

template <class T>
PD_HD void store9(T* to, Index row, const Mat3<T>& a) {
  for (int r = 0; r < 3; ++r) store3(to, 3 * row + r, a.row[r]);
}

template <class T>
PD_HD Vec3<T> zero3() {
  return {T(0), T(0), T(0)};
}

template <class T>
PD_HD Mat3<T> zero9() {
  return {{zero3<T>(), zero3<T>(), zero3<T>()}};
}

template <class T>
PD_HD void add(Vec3<T>& to, const Vec3<T>& a) {
  to = to + a;
}

// to += s a
template <class T>
PD_HD void add(Vec3<T>& to, const T& s, const Vec3<T>& a) {
  to = multiply_add(s, a, to);
}

// to += s a b^T
template <class T>
PD_HD void add_outer(Mat3<T>& to, const T& s, const Vec3<T>& a, const Vec3<T>& b) {
  add(to.row[0], s * a.x, b);
  add(to.row[1], s * a.y, b);
  add(to.row[2], s * a.z, b);
}

// Each product is rounded, and products are added in pairs. If one weight is zero, swapping corners
// keeps the bits, so patches agree on their shared edge.
template <class T>
PD_HD Vec3<T> blend(const T (&weight)[3], const Vec3<T> (&of)[3]) {
  return (weight[0] * of[0] + weight[1] * of[1]) + weight[2] * of[2];
}

}  // namespace pd::freeform::inline PD_TARGET
