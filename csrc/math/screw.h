// Poses of rigid bodies, and the screw from one to another.
//
// The screw turns about one axis and slides along it at constant rates: exp(s xi) for a share s in
// [0, 1] of the displacement. A vertex moves on a helix; the chord between two poses would shrink a
// body that turns. With the turn phi about the origin and the rate v of the origin (Murray, Li and
// Sastry 1994, section 2.3):
//
//   rotation(s) = exp(s [phi]) rotation(0),    origin(s) = origin(0) + V(s phi) s v
//   V(phi) = int_0^1 exp(s [phi]) ds
//          = 1 + (1 - cos a) / a^2 [phi] + (a - sin a) / a^3 [phi]^2,    a = |phi|
//   V^-1(phi) = 1 - [phi] / 2 + (1 - a / 2 cot(a / 2)) / a^2 [phi]^2
#pragma once
#include "math/mat.h"

namespace pd::inline PD_TARGET {

PD_HD float sine(float a) { return sinf(a); }
PD_HD double sine(double a) { return sin(a); }
PD_HD float cosine(float a) { return cosf(a); }
PD_HD double cosine(double a) { return cos(a); }
PD_HD float arc_tangent(float y, float x) { return atan2f(y, x); }
PD_HD double arc_tangent(double y, double x) { return atan2(y, x); }

// sin a / a
template <class T>
PD_HD T sine_ratio(T a) {
  return a != T(0) ? sine(a) / a : T(1);
}

// Unit quaternion w + axis.
template <class T>
struct Quaternion {
  T w;
  Vec3<T> axis;
};

template <class T>
PD_HD Quaternion<T> operator*(const Quaternion<T>& a, const Quaternion<T>& b) {
  return {multiply_subtract(a.w, b.w, dot(a.axis, b.axis)),
          multiply_add(a.w, b.axis, multiply_add(b.w, a.axis, cross(a.axis, b.axis)))};
}

// The rotation vector of the smaller turn, up to pi.
template <class T>
PD_HD Vec3<T> rotation_vector(const Quaternion<T>& q) {
  const T sign = q.w < T(0) ? T(-1) : T(1);
  const T size = square_root(dot(q.axis, q.axis));
  const T angle = T(2) * arc_tangent(size, sign * q.w);
  return (sign * (size > T(0) ? angle / size : T(2))) * q.axis;
}

// V(phi) u. Below `series_angle` series replace the quotients of differences, which would cancel.
constexpr double series_angle = 0.1;  // rad

template <class T>
PD_HD Vec3<T> mean_rotated(const Vec3<T>& turn, const Vec3<T>& u) {
  const T square = dot(turn, turn), angle = square_root(square);
  const T half = sine_ratio(T(0.5) * angle);
  const T first = T(0.5) * half * half;
  const T series = multiply_add(
      square,
      multiply_add(square, multiply_add(square, T(-1.0 / 362880), T(1.0 / 5040)), T(-1.0 / 120)),
      T(1.0 / 6));
  const T second = angle > T(series_angle) ? (angle - sine(angle)) / (square * angle) : series;
  const Vec3<T> across = cross(turn, u);
  return multiply_add(second, cross(turn, across), multiply_add(first, across, u));
}

// V^-1(phi) u
template <class T>
PD_HD Vec3<T> unmean_rotated(const Vec3<T>& turn, const Vec3<T>& u) {
  const T square = dot(turn, turn), half = T(0.5) * square_root(square);
  const T series = multiply_add(
      square,
      multiply_add(square, multiply_add(square, T(1.0 / 1209600), T(1.0 / 30240)), T(1.0 / 720)),
      T(1.0 / 12));
  const T second =
      T(2) * half > T(series_angle) ? (T(1) - half * cosine(half) / sine(half)) / square : series;
  const Vec3<T> across = cross(turn, u);
  return multiply_add(second, cross(turn, across), subtract_product(u, T(0.5), across));
}

// Place [m] and orientation of a rigid body; w and axis are a unit quaternion.
template <class T>
struct Pose {
  Vec3<T> origin;
  T w;
  Vec3<T> axis;

  // The world position of a point of the body.
  PD_HD Vec3<T> place(const Vec3<T>& point) const {
    const Vec3<T> across = T(2) * cross(axis, point);
    return origin + (multiply_add(w, across, point) + cross(axis, across));
  }
};

// The screw of the smaller turn from one pose to another.
template <class T>
class Screw {
 public:
  PD_HD Screw(const Pose<T>& start, const Pose<T>& end) : start_(start), end_(end) {
    const Quaternion<T> to = {end.w, end.axis}, back = {start.w, -start.axis};
    turn_ = rotation_vector(to * back);
    rate_ = unmean_rotated(turn_, end.origin - start.origin);
  }

  // The pose after a share of the displacement. Both ends keep the bits of their poses.
  PD_HD Pose<T> at(T share) const {
    if (share <= T(0)) return start_;
    if (share >= T(1)) return end_;
    const Vec3<T> turn = share * turn_;
    const T half = T(0.5) * square_root(dot(turn, turn));
    const Quaternion<T> by = {cosine(half), (T(0.5) * sine_ratio(half)) * turn};
    const Quaternion<T> q = by * Quaternion<T>{start_.w, start_.axis};
    const T scale = T(1) / square_root(multiply_add(q.w, q.w, dot(q.axis, q.axis)));
    return {start_.origin + mean_rotated(turn, share * rate_), scale * q.w, scale * q.axis};
  }

 private:
  Pose<T> start_, end_;
  Vec3<T> turn_, rate_;
};

}  // namespace pd::inline PD_TARGET
