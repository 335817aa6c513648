// Dual numbers a + b e, e^2 = 0: a value and its derivative along one direction (forward-mode differentiation). R is
// a scalar or a SIMD pack.
#pragma once
#include "math/scalar.h"

namespace pd::inline PD_TARGET {

template <class R>
struct Dual {
  using scalar = scalar_of<R>;

  R value, slope;

  Dual() = default;
  PD_HD Dual(scalar a) : value(a), slope(scalar(0)) {}
  PD_HD Dual(const R& a, const R& b) : value(a), slope(b) {}

  PD_HD friend Dual operator+(const Dual& a, const Dual& b) {
    return {a.value + b.value, a.slope + b.slope};
  }
  PD_HD friend Dual operator-(const Dual& a, const Dual& b) {
    return {a.value - b.value, a.slope - b.slope};
  }
  PD_HD friend Dual operator-(const Dual& a) { return {-a.value, -a.slope}; }
  PD_HD friend Dual operator*(const Dual& a, const Dual& b) {
    return {a.value * b.value, multiply_add(a.value, b.slope, a.slope * b.value)};
  }
  PD_HD friend Dual operator/(const Dual& a, const Dual& b) {
    const R quotient = a.value / b.value;
    return {quotient, subtract_product(a.slope, quotient, b.slope) / b.value};
  }
  PD_HD friend auto operator<(const Dual& a, const Dual& b) { return a.value < b.value; }
  PD_HD friend auto operator<=(const Dual& a, const Dual& b) { return a.value <= b.value; }
  PD_HD friend auto operator>(const Dual& a, const Dual& b) { return a.value > b.value; }

  PD_HD friend Dual multiply_add(const Dual& a, const Dual& b, const Dual& c) { return a * b + c; }
  PD_HD friend Dual subtract_product(const Dual& c, const Dual& a, const Dual& b) {
    return c - a * b;
  }
  PD_HD friend Dual multiply_subtract(const Dual& a, const Dual& b, const Dual& c) {
    return a * b - c;
  }
  // the slope is zero where the number is
  PD_HD friend Dual square_root(const Dual& a) {
    const scalar none(0), two(2);
    const R root = square_root(a.value);
    return {root, select(R(none) < root, a.slope / (R(two) * root), R(none))};
  }
  PD_HD friend Dual exponential(const Dual& a) {
    const R value = exponential(a.value);
    return {value, value * a.slope};
  }
  PD_HD friend Dual logarithm(const Dual& a) { return {logarithm(a.value), a.slope / a.value}; }
  PD_HD friend Dual lesser(const Dual& a, const Dual& b) { return select(b < a, b, a); }

  template <class Mask>
  PD_HD friend Dual select(const Mask& take, const Dual& a, const Dual& b) {
    return {select(take, a.value, b.value), select(take, a.slope, b.slope)};
  }
};

// Numbers that do not vary where others do: their values, and back as dual numbers without slopes.
template <class R>
struct Still {
  using Value = R;
  PD_HD static const R& value(const R& a) { return a; }
  PD_HD static const R& number(const R& a) { return a; }
  static constexpr bool varies = false;
};
template <class R>
struct Still<Dual<R>> {
  using Value = R;
  PD_HD static const R& value(const Dual<R>& a) { return a.value; }
  PD_HD static Dual<R> number(const R& a) { return {a, R(scalar_of<R>(0))}; }
  static constexpr bool varies = true;
};

}  // namespace pd::inline PD_TARGET
