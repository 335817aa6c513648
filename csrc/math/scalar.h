// The functions that the physics headers need of a number, for float and double. Packs bring their own.
#pragma once
#include "math/config.h"

#include <cfloat>
#include <cmath>

namespace pd::inline PD_TARGET {

PD_HD float square_root(float a) { return sqrtf(a); }
PD_HD double square_root(double a) { return sqrt(a); }
PD_HD float absolute(float a) { return fabsf(a); }
PD_HD double absolute(double a) { return fabs(a); }
// a b + c, c - a b and a b - c, rounded once where the processor can. Fusion is explicit, and the compiler must not
// fuse by itself. Its choice depends on the surroundings, and every path has to produce the same bits.
#if defined(PD_NO_FMA)
PD_HD float multiply_add(float a, float b, float c) { return a * b + c; }
PD_HD double multiply_add(double a, double b, double c) { return a * b + c; }
#else
PD_HD float multiply_add(float a, float b, float c) { return fmaf(a, b, c); }
PD_HD double multiply_add(double a, double b, double c) { return fma(a, b, c); }
#endif
PD_HD float subtract_product(float c, float a, float b) { return multiply_add(-a, b, c); }
PD_HD double subtract_product(double c, double a, double b) { return multiply_add(-a, b, c); }
PD_HD float multiply_subtract(float a, float b, float c) { return multiply_add(a, b, -c); }
PD_HD double multiply_subtract(double a, double b, double c) { return multiply_add(a, b, -c); }

// Reciprocals and square roots of numbers that are neither tiny nor huge, to the last bit or two. The rough ones
// serve Newton's method, which corrects itself. A GPU's instructions flush numbers beyond 1e-38 and 1e38 to 0 and
// infinity.
#if defined(__CUDA_ARCH__)
PD_HD float reciprocal(float a) {
  float r;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
  return r;
}
PD_HD float rough_square_root(float a) {
  float r;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
  return r;
}
#else
PD_HD float reciprocal(float a) { return 1.0f / a; }
PD_HD float rough_square_root(float a) { return sqrtf(a); }
#endif
PD_HD double reciprocal(double a) { return 1.0 / a; }
PD_HD double rough_square_root(double a) { return sqrt(a); }
PD_HD float rough_reciprocal(float a) { return reciprocal(a); }
PD_HD double rough_reciprocal(double a) { return reciprocal(a); }

PD_HD float exponential(float a) { return expf(a); }
PD_HD double exponential(double a) { return exp(a); }
PD_HD float logarithm(float a) { return logf(a); }
PD_HD double logarithm(double a) { return log(a); }
// exp(a) - 1
PD_HD float exponential_less_one(float a) { return expm1f(a); }
PD_HD double exponential_less_one(double a) { return expm1(a); }

PD_HD float lesser(float a, float b) { return b < a ? b : a; }
PD_HD double lesser(double a, double b) { return b < a ? b : a; }
PD_HD float select(bool take, float a, float b) { return take ? a : b; }
PD_HD double select(bool take, double a, double b) { return take ? a : b; }
PD_HD bool any(bool a) { return a; }
template <class To>
PD_HD To convert(float a) {
  return To(a);
}
template <class To>
PD_HD To convert(double a) {
  return To(a);
}

template <class T>
PD_HD constexpr T epsilon() {
  return sizeof(T) == 4 ? T(FLT_EPSILON) : T(DBL_EPSILON);
}
template <class T>
PD_HD constexpr T smallest() {
  return sizeof(T) == 4 ? T(FLT_MIN) : T(DBL_MIN);
}
template <class T>
PD_HD constexpr T biggest() {
  return sizeof(T) == 4 ? T(FLT_MAX) : T(DBL_MAX);
}

// The scalar type of a pack: float for Pack<float, 16>.
template <class R>
struct ScalarOf {
  using type = typename R::scalar;
};
template <>
struct ScalarOf<float> {
  using type = float;
};
template <>
struct ScalarOf<double> {
  using type = double;
};
template <class R>
using scalar_of = typename ScalarOf<R>::type;

}  // namespace pd::inline PD_TARGET
