// The two layouts of SIMD lanes: the elements of one environment (Single), or W environments (Batch).
//
// Both give an environment the same bits: the same operations in the same order, grouped differently.
#pragma once
#include "math/pack.h"
#include "views/views.h"

#include <cstddef>

namespace pd::inline PD_TARGET {

constexpr int block_lanes = 16;  // elements of a block of the plan

template <class T>
constexpr int native_width = PD_VECTOR_BYTES / int(sizeof(T));

// x, y, z and an unused fourth number: one vertex, one vector register.
template <class T>
struct Quad {
  Pack<T, 4> q;

  PD_HD friend Quad operator+(const Quad& a, const Quad& b) { return {a.q + b.q}; }
  PD_HD friend Quad operator-(const Quad& a, const Quad& b) { return {a.q - b.q}; }
  PD_HD friend Quad operator*(T s, const Quad& a) { return {Pack<T, 4>(s) * a.q}; }
  PD_HD friend Quad multiply_add(T s, const Quad& a, const Quad& b) {
    return {multiply_add(Pack<T, 4>(s), a.q, b.q)};
  }
  PD_HD friend Quad multiply_add(const Quad& a, const Quad& b, const Quad& c) {
    return {multiply_add(a.q, b.q, c.q)};
  }
  PD_HD friend Quad subtract_product(const Quad& b, T s, const Quad& a) {
    return {subtract_product(b.q, Pack<T, 4>(s), a.q)};
  }
  PD_HD friend Quad select(bool take, const Quad& a, const Quad& b) { return take ? a : b; }
};

template <class T>
PD_HD Vec3<T> to_vec3(const Quad<T>& a) {
  return {a.q.v[0], a.q.v[1], a.q.v[2]};
}
template <class T>
PD_HD Quad<T> to_quad(T x, T y, T z) {
  return {typename Pack<T, 4>::Vector{x, y, z, T(0)}};
}

template <class T>
struct Single {
  using Scalar = T;
  using Real = T;         // one number of each environment
  using Value = Quad<T>;  // one vector of each environment
  using Wide = double;
  static constexpr int environments = 1;

  PD_HD static Vec3<Real> vec3(const Value& a) { return to_vec3(a); }
  PD_HD static Value value(const Vec3<Real>& a) { return to_quad(a.x, a.y, a.z); }
  PD_HD static Wide widen(Real a) { return double(a); }
  PD_HD static Real narrow(Wide a) { return T(a); }
  PD_HD static double lane(Wide a, int) { return a; }
  PD_HD static void set_lane(Real& a, int, T number) { a = number; }
  PD_HD static void set_lane(Value& a, int, T x, T y, T z) { a = to_quad(x, y, z); }
  PD_HD static Vec3<T> get_lane(const Value& a, int) { return to_vec3(a); }
};

template <class T, int W>
struct Batch {
  using Scalar = T;
  using Real = Pack<T, W>;
  using Value = Vec3<Pack<T, W>>;
  using Wide = Pack<double, W>;
  static constexpr int environments = W;

  PD_HD static Vec3<Real> vec3(const Value& a) { return a; }
  PD_HD static Value value(const Vec3<Real>& a) { return a; }
  PD_HD static Wide widen(Real a) { return convert<double>(a); }
  PD_HD static Real narrow(Wide a) { return convert<T>(a); }
  PD_HD static double lane(Wide a, int lane) { return a.v[lane]; }
  PD_HD static void set_lane(Real& a, int lane, T number) { a.v[lane] = number; }
  PD_HD static void set_lane(Value& a, int lane, T x, T y, T z) {
    a.x.v[lane] = x;
    a.y.v[lane] = y;
    a.z.v[lane] = z;
  }
  PD_HD static Vec3<T> get_lane(const Value& a, int lane) {
    return {a.x.v[lane], a.y.v[lane], a.z.v[lane]};
  }
};

}  // namespace pd::inline PD_TARGET
