// Three-vectors over a scalar or a SIMD pack.
#pragma once
#include "math/scalar.h"

namespace pd::inline PD_TARGET {

template <class R>
struct Vec3 {
  R x, y, z;
};

template <class R>
PD_HD Vec3<R> operator+(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}

template <class R>
PD_HD Vec3<R> operator-(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}

template <class R>
PD_HD Vec3<R> operator-(const Vec3<R>& a) {
  return {-a.x, -a.y, -a.z};
}

template <class R>
PD_HD Vec3<R> operator*(const R& s, const Vec3<R>& a) {
  return {s * a.x, s * a.y, s * a.z};
}

template <class R>
PD_HD R dot(const Vec3<R>& a, const Vec3<R>& b) {
  return multiply_add(a.z, b.z, multiply_add(a.y, b.y, a.x * b.x));
}

// s a + b
template <class R>
PD_HD Vec3<R> multiply_add(const R& s, const Vec3<R>& a, const Vec3<R>& b) {
  return {multiply_add(s, a.x, b.x), multiply_add(s, a.y, b.y), multiply_add(s, a.z, b.z)};
}

// b - s a
template <class R>
PD_HD Vec3<R> subtract_product(const Vec3<R>& b, const R& s, const Vec3<R>& a) {
  return {subtract_product(b.x, s, a.x), subtract_product(b.y, s, a.y),
          subtract_product(b.z, s, a.z)};
}

// a b + c, component by component
template <class R>
PD_HD Vec3<R> multiply_add(const Vec3<R>& a, const Vec3<R>& b, const Vec3<R>& c) {
  return {multiply_add(a.x, b.x, c.x), multiply_add(a.y, b.y, c.y), multiply_add(a.z, b.z, c.z)};
}

template <class R>
PD_HD Vec3<R> cross(const Vec3<R>& a, const Vec3<R>& b) {
  return {multiply_subtract(a.y, b.z, a.z * b.y), multiply_subtract(a.z, b.x, a.x * b.z),
          multiply_subtract(a.x, b.y, a.y * b.x)};
}

// a b - c d to about one rounding, however much of it cancels (Kahan; Jeannerod, Louvet and Muller 2013)
template <class R>
PD_HD R difference_of_products(const R& a, const R& b, const R& c, const R& d) {
  const R product = c * d;
  return multiply_subtract(a, b, product) + subtract_product(product, c, d);
}

template <class R>
PD_HD Vec3<R> exact_cross(const Vec3<R>& a, const Vec3<R>& b) {
  return {difference_of_products(a.y, b.z, a.z, b.y), difference_of_products(a.z, b.x, a.x, b.z),
          difference_of_products(a.x, b.y, a.y, b.x)};
}

}  // namespace pd::inline PD_TARGET
