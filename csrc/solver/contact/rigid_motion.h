// The motion of colliders with a mass: free in a step, and what a step leaves of it.
//
// With the mass m, the centre of mass c, the rotation R and the angular momentum L about c, the free motion of a step is
//
//   c_goal = c + h V,   V = v + h (g + F / m);   Q = cay(u) R,   u = h J^-1 L_free,   L_free = L + h T.
//
// cay(u) turns about u by 2 atan(|u| / 2). J is the moment of inertia at the middle of that turn: the midpoint
// rule, which keeps L_free. A step ends at c' and cay(u) R (solver/contact/rigid.h). It leaves
//
//   v' = V + (c' - c_goal) / h,   L' = L_free - (1 + [u] / 2 + u u^T / 4) (L_free - J u / h).
//
// Once converged, m (v' - V) = h f and L' - L_free = h t, with the force f and the torque t of contact at the end.
//
// Each motion is one function of the numbers of a collider, for any type of numbers: dual ones give its derivatives.
#pragma once
#include "contact/motion_views.h"
#include "math/dual.h"
#include "math/rotation.h"
#include "solver/contact/rigid_turn.h"

namespace pd::inline PD_TARGET {

// The number of the first one with the derivative of the second.
PD_HD double with_derivative(double a, double) { return a; }
PD_HD Dual<double> with_derivative(const Dual<double>& a, const Dual<double>& b) {
  return {a.value, b.slope};
}
template <class R>
PD_HD Vec3<R> with_derivative(const Vec3<R>& a, const Vec3<R>& b) {
  return {with_derivative(a.x, b.x), with_derivative(a.y, b.y), with_derivative(a.z, b.z)};
}

// A^-1 b, refined once
template <class R>
PD_HD Vec3<R> solve(const Mat3<R>& a, const Vec3<R>& b) {
  const Mat3<R> c = cofactor(a);
  const R scale = R(1.0) / dot(a.row[0], c.row[0]);
  const Vec3<R> x = scale * (b * c);
  return x + scale * ((b - a * x) * c);
}

template <class R>
PD_HD Vec3<R> rotated(const Quaternion<R>& q, const Vec3<R>& a) {
  const Vec3<R> across = cross(q.axis, a);
  const R scale = R(2.0) / (q.w * q.w + dot(q.axis, q.axis));
  return a + scale * (q.w * across + cross(q.axis, across));
}
template <class R>
PD_HD Quaternion<R> inverse(const Quaternion<R>& q) {
  return {q.w, -q.axis};
}
template <class R>
PD_HD bool equal(const R* a, const R* b, int count) {
  using S = Still<R>;
  bool same = true;
  for (int n = 0; n < count; ++n) same = same && S::value(a[n]) == S::value(b[n]);
  return same;
}

// The constant numbers of a collider, `motion_bodies`.
template <class R>
struct RigidShape {
  R mass;
  Vec3<R> center;
  Mat3<R> inertia;

  PD_HD explicit RigidShape(const R* n)
      : mass(n[0]),
        center{n[1], n[2], n[3]},
        inertia{{{n[4], n[5], n[6]}, {n[5], n[7], n[8]}, {n[6], n[8], n[9]}}} {}

  // without one nothing moves freely
  PD_HD bool has_mass() const { return Still<R>::value(mass) > 0.0; }

  // In world axes. Velocities are found by the matrix that gives the momentum of the next step: what rounding makes of
  // the rotation cancels, and does not add up.
  PD_HD Mat3<R> inertia_at(const Quaternion<R>& turn) const {
    const Mat3<R> half = {{rotated(turn, inertia.row[0]), rotated(turn, inertia.row[1]),
                           rotated(turn, inertia.row[2])}},
                  back = transpose(half);
    return {{rotated(turn, back.row[0]), rotated(turn, back.row[1]), rotated(turn, back.row[2])}};
  }
};

template <class R>
PD_HD Vec3<R> vector_of(const R* n) {
  return {n[0], n[1], n[2]};
}
template <class R>
PD_HD Quaternion<R> quaternion_of(const R* n) {
  return {n[0], vector_of(n + 1)};
}
template <class R>
PD_HD void put(const Vec3<R>& a, R* to) {
  to[0] = a.x, to[1] = a.y, to[2] = a.z;
}

// The half of the turn cay(u). Its length is not 1.
template <class R>
PD_HD Quaternion<R> half_of(const Vec3<R>& u) {
  return {R(1.0) + square_root(R(1.0) + R(0.25) * dot(u, u)), R(0.5) * u};
}

// The midpoint rule in the axes of the body at the start: J u - h half(u)^-1 L.
template <class R>
PD_HD Vec3<R> midpoint_error(const Mat3<R>& inertia, const Vec3<R>& impulse, const Vec3<R>& u) {
  return inertia * u - rotated(inverse(half_of(u)), impulse);
}

// Its derivative by u.
PD_HD Mat3<double> midpoint_slope(const Mat3<double>& inertia, const Vec3<double>& impulse,
                                  const Vec3<double>& u) {
  using R = Dual<double>;
  const auto still = [](const Vec3<double>& a) { return Vec3<R>{R(a.x), R(a.y), R(a.z)}; };
  const Mat3<R> j{{still(inertia.row[0]), still(inertia.row[1]), still(inertia.row[2])}};
  Vec3<double> column[3];
  for (int n = 0; n < 3; ++n) {
    Vec3<R> at = still(u);
    (n == 0 ? at.x : n == 1 ? at.y : at.z).slope = 1.0;
    const Vec3<R> error = midpoint_error(j, still(impulse), at);
    column[n] = {error.x.slope, error.y.slope, error.z.slope};
  }
  return from_columns(column[0], column[1], column[2]);
}

constexpr int midpoint_steps = 32, midpoint_halvings = 8;

// u of the midpoint rule by Newton's method, whose steps are halved where they do not lower the error in J^-1.
PD_CALLED inline Vec3<double> solve_midpoint(const Mat3<double>& inertia,
                                             const Vec3<double>& impulse) {
  const auto size = [&](const Vec3<double>& error) { return dot(error, solve(inertia, error)); };
  Vec3<double> u = solve(inertia, impulse), error = midpoint_error(inertia, impulse, u);
  double least = size(error);
  for (int step = 0; step < midpoint_steps && least > 0.0; ++step) {
    const Vec3<double> way = solve(midpoint_slope(inertia, impulse, u), error);
    double share = 1.0;
    int n = 0;
    for (; n < midpoint_halvings; ++n, share *= 0.5) {
      const Vec3<double> next = subtract_product(u, share, way),
                         left = midpoint_error(inertia, impulse, next);
      const double now = size(left);
      if (!(now < least)) continue;
      u = next, error = left, least = now;
      break;
    }
    if (n == midpoint_halvings) break;  // rounding
  }
  return u;
}

// The same with derivatives: one more step, whose matrix need not vary.
template <class R>
PD_HD Vec3<R> solve_midpoint(const Mat3<R>& inertia, const Vec3<R>& impulse) {
  using S = Still<R>;
  const auto plain = [](const Vec3<R>& a) {
    return Vec3<double>{S::value(a.x), S::value(a.y), S::value(a.z)};
  };
  const Mat3<double> j{{plain(inertia.row[0]), plain(inertia.row[1]), plain(inertia.row[2])}};
  const Vec3<double> u = solve_midpoint(j, plain(impulse));
  const Mat3<double> slope = midpoint_slope(j, plain(impulse), u);
  const auto number = [](const Vec3<double>& a) { return Vec3<R>{R(a.x), R(a.y), R(a.z)}; };
  const Mat3<R> matrix{{number(slope.row[0]), number(slope.row[1]), number(slope.row[2])}};
  return number(u) - solve(matrix, midpoint_error(inertia, impulse, number(u)));
}

// A unit quaternion turned by cay(u); without a turn the same bits.
template <class R>
PD_HD Quaternion<R> turned(const Vec3<R>& u, const Quaternion<R>& q) {
  using S = Still<R>;
  const Quaternion<R> made = Quaternion<R>{R(1.0), R(0.5) * u} * q;
  const R scale = R(1.0) / square_root(made.w * made.w + dot(made.axis, made.axis));
  const Quaternion<R> to = {scale * made.w, scale * made.axis};
  const bool turns = S::value(u.x) != 0.0 || S::value(u.y) != 0.0 || S::value(u.z) != 0.0;
  if (turns) return to;
  return {with_derivative(q.w, to.w), with_derivative(q.axis, to.axis)};
}

// The free motion of a step.
struct FreeMotionOfRigid {
  static constexpr int arrays = 5, inputs = 32, results = 3, outputs = 26;
  PD_HD static constexpr int width(int array) {
    constexpr int of[] = {motion_pose, motion_rates, motion_wrench, motion_gravity, motion_body};
    return of[array];
  }
  PD_HD static constexpr int result_width(int result) {
    constexpr int of[] = {motion_pose, motion_rates, motion_row};
    return of[result];
  }

  template <class R>
  PD_HD static void find(const R* in, double time_step, R* out) {
    const R* const pose = in;
    const R *const motion = pose + motion_pose, *const wrench = motion + motion_rates,
                   *const gravity = wrench + motion_wrench, *const body = gravity + motion_gravity;
    R *const rates = out + motion_pose, *const row = rates + motion_rates;
    const RigidShape<R> of(body);
    if (!of.has_mass()) {
      for (int n = 0; n < motion_pose; ++n) out[n] = pose[n];
      for (int n = motion_pose; n < outputs; ++n) out[n] = R(0.0);
      return;
    }
    const R h(time_step), per_square(1.0 / (time_step * time_step));
    const Quaternion<R> begin = quaternion_of(pose + 3);
    const Vec3<R> arm = rotated(begin, of.center), force = vector_of(wrench),
                  torque = vector_of(wrench + 3) - cross(arm, force);
    const Vec3<R> velocity =
        vector_of(motion) + h * (vector_of(gravity) + (R(1.0) / of.mass) * force);
    const Vec3<R> momentum = of.inertia_at(begin) * vector_of(motion + 3) + h * torque;
    // the half of a turn is the same in both axes
    const Vec3<R> own = solve_midpoint(of.inertia, h * rotated(inverse(begin), momentum));
    const Mat3<R> inertia = of.inertia_at(begin * half_of(own));
    const Quaternion<R> end = turned(h * solve(inertia, momentum), begin);
    put(vector_of(pose) + (h * velocity + (arm - rotated(end, of.center))), out);
    out[3] = end.w;
    put(end.axis, out + 4);
    put(velocity, rates);
    put(momentum, rates + 3);
    row[0] = per_square * of.mass;
    put(of.center, row + 1);
    put(per_square * inertia.row[0], row + 4);
    row[7] = per_square * inertia.row[1].y, row[8] = per_square * inertia.row[1].z;
    row[9] = per_square * inertia.row[2].z;
    put(R(1.0 / time_step) * momentum, row + 10);
  }
};

// What a step leaves of it: velocities of the centre of mass and angular ones.
struct MotionAfterStep {
  static constexpr int arrays = 6, inputs = 50, results = 1, outputs = 6;
  PD_HD static constexpr int width(int array) {
    constexpr int of[] = {motion_pose, motion_pose, motion_rates,
                          motion_row,  motion_pose, motion_body};
    return of[array];
  }
  PD_HD static constexpr int result_width(int) { return motion_rates; }

  template <class R>
  PD_HD static void find(const R* in, double time_step, R* out) {
    const R* const before = in;
    const R *const goal = before + motion_pose, *const rates = goal + motion_pose,
                   *const row = rates + motion_rates, *const pose = row + motion_row,
                   *const body = pose + motion_pose;
    const RigidShape<R> of(body);
    if (!of.has_mass()) {
      for (int n = 0; n < outputs; ++n) out[n] = R(0.0);
      return;
    }
    const R h(time_step);
    const Quaternion<R> end = quaternion_of(pose + 3);
    Vec3<R> left = (vector_of(pose) - vector_of(goal)) +
                   (rotated(end, of.center) - rotated(quaternion_of(goal + 3), of.center));
    const Vec3<R> u = turn_between(quaternion_of(before + 3), end), momentum = vector_of(rates + 3);
    const Mat3<R> inertia{
        {{row[4], row[5], row[6]}, {row[5], row[7], row[8]}, {row[6], row[8], row[9]}}};
    Vec3<R> taken = h * torque_after(u, inertia, R(1.0 / time_step) * momentum);
    if (equal(pose, goal, motion_pose)) {  // to the bit where nothing was in the way
      const R none(0.0);
      left = with_derivative(Vec3<R>{none, none, none}, left);
      taken = with_derivative(Vec3<R>{none, none, none}, taken);
    }
    put(vector_of(rates) + R(1.0 / time_step) * left, out);
    put(solve(of.inertia_at(end), momentum - taken), out + 3);
  }
};

// The numbers of one collider of a call, and where they go.
template <class Motion, class T, class R>
PD_HD void read_motion(const RigidMotionCall<T>& call, std::int64_t row, R* in) {
  const std::int64_t environment = row / call.colliders, collider = row % call.colliders;
  for (int a = 0, n = 0; a < Motion::arrays; ++a) {
    const MotionArray<T>& from = call.in[a];
    const T* const at = from.data + environment * from.of_environment + collider * from.of_collider;
    for (int k = 0; k < Motion::width(a); ++k, ++n)
      in[n] = R(from.data ? double(at[k * from.of_number]) : 0.0);
  }
}

template <class Motion, class T>
PD_HD void find_motion(const RigidMotionCall<T>& call, std::int64_t row) {
  double in[Motion::inputs], out[Motion::outputs];
  read_motion<Motion>(call, row, in);
  Motion::find(in, call.time_step, out);
  for (int a = 0, n = 0; a < Motion::results; ++a) {
    T* const to = call.out[a] + row * Motion::result_width(a);
    for (int k = 0; k < Motion::result_width(a); ++k, ++n) to[k] = T(out[n]);
  }
}

// The derivative of the product of the results with gradients, by one of the numbers.
template <class Motion, class T>
PD_HD void differentiate_motion(const RigidMotionCall<T>& call, std::int64_t row, int number) {
  Dual<double> in[Motion::inputs], out[Motion::outputs];
  read_motion<Motion>(call, row, in);
  in[number].slope = 1.0;
  Motion::find(in, call.time_step, out);
  double sum = 0.0;
  for (int a = 0, n = 0; a < Motion::results; ++a) {
    const T* const gradient = call.gradient[a] + row * Motion::result_width(a);
    for (int k = 0; k < Motion::result_width(a); ++k, ++n)
      sum += double(gradient[k]) * out[n].slope;
  }
  call.out[0][row * Motion::inputs + number] = T(sum);
}

}  // namespace pd::inline PD_TARGET
