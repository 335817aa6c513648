// Contact with planes and balls: one vertex, projected after every iteration, with Coulomb friction.
//
// The diagonal D is one number a vertex, so Euclidean projection is projection in the metric of the iteration. `depth` is
// how far the free iterate went in; at the fixed point it is theta omega g_n / D, so that moving the vertex back against its
// slip by at most friction * depth is Coulomb's law |g_t| <= friction g_n. Friction has no energy: the guard's
// descent argument covers the normal part alone, and the guard looks less closely where there is friction.
//
// A ball acts as its tangent plane at the iterate that the step leaves from (`around`): the normal of the free iterate would
// make the fixed point depend on relaxation and acceleration.
#pragma once
#include "math/mat.h"
#include "math/scalar.h"

namespace pd::inline PD_TARGET {

template <class R>
struct Plane {
  Vec3<R> normal;
  R height, friction;
};

template <class R>
struct Ball {
  Vec3<R> center, motion;
  R radius, friction;
};

template <class R>
PD_HD R gap(const Plane<R>& plane, const Vec3<R>& x) {
  return dot(plane.normal, x) - plane.height;
}

template <class R>
PD_HD R gap(const Ball<R>& ball, const Vec3<R>& x) {
  const Vec3<R> d = x - ball.center;
  return square_root(dot(d, d)) - ball.radius;
}

template <class R>
PD_HD R penetration(const R& distance) {
  return select(distance < R(0), -distance, R(0));
}

// Away from the ball; upwards for a vertex at its very centre.
template <class R>
PD_HD Vec3<R> outward(const Ball<R>& ball, const Vec3<R>& x) {
  const Vec3<R> d = x - ball.center;
  const R length = square_root(dot(d, d));
  const auto defined = length > R(0);
  const R scale = R(1) / select(defined, length, R(1));
  return {scale * d.x, select(defined, scale * d.y, R(1)), scale * d.z};
}

// Pushes the displacement `u` out by `depth` along `normal`, then takes back slip against the surface.
template <class R>
PD_HD Vec3<R> push_out(const Vec3<R>& u, const Vec3<R>& normal, const R& depth, const R& friction,
                       const Vec3<R>& motion) {
  const Vec3<R> pushed = multiply_add(depth, normal, u);
  const Vec3<R> slip = pushed - motion;
  const Vec3<R> tangential = subtract_product(slip, dot(normal, slip), normal);
  const R length = square_root(dot(tangential, tangential));
  const R grip = lesser(R(1), friction * depth / select(length > R(0), length, R(1)));
  return subtract_product(pushed, grip, tangential);
}

// Of a normal, squared: what earlier ones leave of one that they span but for a thousandth.
constexpr double spanned = 1e-6;

// A projector without the part `left` that it leaves of a normal, by the reciprocal of that part's square.
template <class R>
PD_HD Mat3<R> take_off(const Mat3<R>& free, const Vec3<R>& left, const R& reciprocal) {
  return {{subtract_product(free.row[0], reciprocal * left.x, left),
           subtract_product(free.row[1], reciprocal * left.y, left),
           subtract_product(free.row[2], reciprocal * left.z, left)}};
}

// What a contact leaves of the directions `free`, a projector, to a vertex that it pushes out from `u`: not its normal, and
// nothing where friction takes back all slip.
template <class R>
PD_HD void take_directions(Mat3<R>& free, const Vec3<R>& u, const Vec3<R>& normal, const R& depth,
                           const R& friction, const Vec3<R>& motion) {
  const R none(0), one(1);
  const Vec3<R> slip = multiply_add(depth, normal, u) - motion;
  const Vec3<R> tangential = subtract_product(slip, dot(normal, slip), normal);
  const auto sticks = friction * depth > square_root(dot(tangential, tangential));
  const Vec3<R> left = free * normal;
  const R size = dot(left, left);
  const auto takes = depth > none && size > R(spanned);
  const R scale = select(takes, one / select(takes, size, one), none);
  const R kept = select(sticks, none, one);
  free = kept * take_off(free, left, scale);
}

// `x` is the vertex at the start of the step, `u` its displacement since then.
template <class R>
PD_HD Vec3<R> project(const Plane<R>& plane, const Vec3<R>& x, const Vec3<R>& u, const Vec3<R>&) {
  const R depth = penetration(gap(plane, x + u));
  return push_out(u, plane.normal, depth, plane.friction, {R(0), R(0), R(0)});
}

template <class R>
PD_HD Vec3<R> project(const Ball<R>& ball, const Vec3<R>& x, const Vec3<R>& u,
                      const Vec3<R>& around) {
  const Vec3<R> normal = outward(ball, x + around);
  const R depth = penetration(dot(normal, (x + u) - ball.center) - ball.radius);
  return push_out(u, normal, depth, ball.friction, ball.motion);
}

// All contacts of a scene, for one vertex after another.
template <class R>
struct Contacts {
  const Plane<R>* planes = nullptr;
  const Ball<R>* balls = nullptr;
  int plane_count = 0, ball_count = 0;

  PD_HD Vec3<R> project(const Vec3<R>& x, Vec3<R> u, const Vec3<R>& around) const {
    for (int i = 0; i < plane_count; ++i) u = pd::project(planes[i], x, u, around);
    for (int i = 0; i < ball_count; ++i) u = pd::project(balls[i], x, u, around);
    return u;
  }

  // Projector on the directions in which a vertex may go from a free iterate `u`, off the contacts that push it out.
  PD_HD Mat3<R> free_directions(const Vec3<R>& x, Vec3<R> u, const Vec3<R>& around) const {
    const R one(1), none(0);
    const Vec3<R> still = {none, none, none};
    Mat3<R> free = {{{one, none, none}, {none, one, none}, {none, none, one}}};
    for (int i = 0; i < plane_count; ++i) {
      const Plane<R>& p = planes[i];
      take_directions(free, u, p.normal, penetration(gap(p, x + u)), p.friction, still);
      u = pd::project(p, x, u, around);
    }
    for (int i = 0; i < ball_count; ++i) {
      const Ball<R>& b = balls[i];
      const Vec3<R> normal = outward(b, x + around);
      const R depth = penetration(dot(normal, (x + u) - b.center) - b.radius);
      take_directions(free, u, normal, depth, b.friction, b.motion);
      u = pd::project(b, x, u, around);
    }
    return free;
  }

  // the largest coefficient of any contact
  PD_HD R friction() const {
    R most(0);
    for (int i = 0; i < plane_count; ++i) most = -lesser(-most, -planes[i].friction);
    for (int i = 0; i < ball_count; ++i) most = -lesser(-most, -balls[i].friction);
    return most;
  }

  PD_HD R least_gap(const Vec3<R>& x) const {
    R least(HUGE_VAL);
    for (int i = 0; i < plane_count; ++i) least = lesser(least, gap(planes[i], x));
    for (int i = 0; i < ball_count; ++i) least = lesser(least, gap(balls[i], x));
    return least;
  }
};

}  // namespace pd::inline PD_TARGET
