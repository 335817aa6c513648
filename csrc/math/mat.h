// Three-by-three matrices, row-major, over a scalar or a SIMD pack.
#pragma once
#include "math/vec.h"

namespace pd::inline PD_TARGET {

template <class R>
struct Mat3 {
  Vec3<R> row[3];
};

template <class R>
PD_HD Mat3<R> operator-(const Mat3<R>& a, const Mat3<R>& b) {
  return {{a.row[0] - b.row[0], a.row[1] - b.row[1], a.row[2] - b.row[2]}};
}

template <class R>
PD_HD Mat3<R> operator*(const R& s, const Mat3<R>& a) {
  return {{s * a.row[0], s * a.row[1], s * a.row[2]}};
}

template <class R>
PD_HD Vec3<R> operator*(const Mat3<R>& a, const Vec3<R>& b) {
  return {dot(a.row[0], b), dot(a.row[1], b), dot(a.row[2], b)};
}

// b^T A as a row
template <class R>
PD_HD Vec3<R> operator*(const Vec3<R>& b, const Mat3<R>& a) {
  return multiply_add(b.z, a.row[2], multiply_add(b.y, a.row[1], b.x * a.row[0]));
}

template <class R>
PD_HD Mat3<R> operator*(const Mat3<R>& a, const Mat3<R>& b) {
  return {{a.row[0] * b, a.row[1] * b, a.row[2] * b}};
}

template <class R>
PD_HD Mat3<R> from_columns(const Vec3<R>& a, const Vec3<R>& b, const Vec3<R>& c) {
  return {{{a.x, b.x, c.x}, {a.y, b.y, c.y}, {a.z, b.z, c.z}}};
}

template <class R>
PD_HD Mat3<R> transpose(const Mat3<R>& a) {
  return from_columns(a.row[0], a.row[1], a.row[2]);
}

template <class R>
PD_HD R frobenius(const Mat3<R>& a, const Mat3<R>& b) {
  return (dot(a.row[0], b.row[0]) + dot(a.row[1], b.row[1])) + dot(a.row[2], b.row[2]);
}

template <class Mask, class R>
PD_HD Vec3<R> select(const Mask& take, const Vec3<R>& a, const Vec3<R>& b) {
  return {select(take, a.x, b.x), select(take, a.y, b.y), select(take, a.z, b.z)};
}

template <class Mask, class R>
PD_HD Mat3<R> select(const Mask& take, const Mat3<R>& a, const Mat3<R>& b) {
  return {{select(take, a.row[0], b.row[0]), select(take, a.row[1], b.row[1]),
           select(take, a.row[2], b.row[2])}};
}

template <class R>
PD_HD R determinant(const Mat3<R>& a) {
  return dot(a.row[0], cross(a.row[1], a.row[2]));
}

template <class R>
PD_HD Mat3<R> cofactor(const Mat3<R>& a) {
  return {{cross(a.row[1], a.row[2]), cross(a.row[2], a.row[0]), cross(a.row[0], a.row[1])}};
}

}  // namespace pd::inline PD_TARGET
