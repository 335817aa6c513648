// Contact of a vertex with planes and spheres by projection after every iteration, with Coulomb friction.
//
// The diagonal D is one number a vertex, so Euclidean projection is projection in the metric of the iteration.
// `depth` is the penetration of the free iterate; at the fixed point it is theta omega g_n / D. Moving the vertex
// back against its slip by at most friction * depth is then Coulomb's law |g_t| <= friction g_n. Friction has no
// energy: the guard's descent argument covers the normal part alone, and its slack is larger where there is friction.
//
// A sphere acts as its tangent plane at the iterate that the step leaves from (`around`). The normal at the free
// iterate would make the fixed point depend on relaxation and acceleration.
#pragma once
#include "math/mat.h"
#include "math/scalar.h"

#include <limits>

namespace pd::inline PD_TARGET {

// A vertex lies on a contact when its gap is at most this share of the displacement.
constexpr double lies_within = 0.01;

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

// Penetration depth; a NaN stays NaN, so that it shows.
template <class R>
PD_HD R penetration(const R& distance) {
  const R none(0);
  return select(distance < none, -distance, select(distance > none, none, distance));
}

// Outward unit normal of a sphere; the y axis for a vertex at its very centre.
template <class R>
PD_HD Vec3<R> outward(const Ball<R>& ball, const Vec3<R>& x) {
  const Vec3<R> d = x - ball.center;
  const R length = square_root(dot(d, d));
  const auto defined = length > R(0);
  const R scale = R(1) / select(defined, length, R(1));
  return {scale * d.x, select(defined, scale * d.y, R(1)), scale * d.z};
}

template <class R>
PD_HD Vec3<R> tangential(const Vec3<R>& slip, const Vec3<R>& normal) {
  return subtract_product(slip, dot(normal, slip), normal);
}

// Moves the displacement `u` out by `depth` along `normal`, then takes back slip against the surface. Both early
// returns leave every lane the bits that it would have without them.
template <class R>
PD_HD Vec3<R> push_out(const Vec3<R>& u, const Vec3<R>& normal, const R& depth, const R& friction,
                       const Vec3<R>& motion) {
  const R none(0);
  const auto touches = !(depth <= none);
  if (!any(touches)) return u;
  const Vec3<R> pushed = select(touches, multiply_add(depth, normal, u), u);
  const R rub = friction * depth;
  const auto rubs = touches && !(rub <= none);
  if (!any(rubs)) return pushed;
  const Vec3<R> slip = tangential(pushed - motion, normal);
  const R length = square_root(dot(slip, slip));
  const R grip = lesser(rub / select(length > none, length, R(1)), R(1));
  return select(rubs, subtract_product(pushed, grip, slip), pushed);
}

// Gap to a sphere after a `displacement`. It is at most 0 where the vertex lies on the sphere and its lift-off is
// below friction * slip. A force within the friction cone could then prevent that displacement.
template <class R>
PD_HD R left_by(const Ball<R>& ball, const R& friction, const Vec3<R>& x, const Vec3<R>& way) {
  using T = scalar_of<R>;
  const Vec3<R> normal = outward(ball, x);
  const R across = dot(normal, way), size = square_root(dot(way, way));
  const R rounding =
      R(4 * std::numeric_limits<T>::epsilon()) * (square_root(dot(x, x)) + ball.radius);
  const auto lies = !(gap(ball, x) > multiply_add(R(T(lies_within)), size, rounding));
  const Vec3<R> along = subtract_product(way, across, normal);
  const R lift = subtract_product(across, friction, square_root(dot(along, along)));
  const R after = gap(ball, x + way);
  return select(lies, lesser(after, lift), after);
}

// Squared part of a unit normal that earlier normals do not span; below it the normal counts as dependent.
constexpr double spanned = 1e-6;
// Where friction takes back more than this share of a slip, it resists the rotation of the slip more than the body
// does.
constexpr double stiff_grip = 0.1;

// Removes `off`, the projected part of a normal, from a projector; `reciprocal` is 1 / |off|^2.
template <class R>
PD_HD Mat3<R> take_off(const Mat3<R>& free, const Vec3<R>& off, const R& reciprocal) {
  return {{subtract_product(free.row[0], reciprocal * off.x, off),
           subtract_product(free.row[1], reciprocal * off.y, off),
           subtract_product(free.row[2], reciprocal * off.z, off)}};
}

// The directions that contacts leave to a vertex.
template <class R>
struct Leeway {
  Mat3<R> free;   // projector on the free directions
  Vec3<R> taken;  // slip that friction takes back
};

// A contact that moves a vertex out by `depth`, if that is more than 0.
template <class R>
struct Push {
  Vec3<R> normal;
  R depth, friction;
  Vec3<R> motion;

  PD_HD Vec3<R> out(const Vec3<R>& u) const { return push_out(u, normal, depth, friction, motion); }
  PD_HD Vec3<R> slip(const Vec3<R>& u) const { return tangential(u - motion, normal); }

  // Removes the directions of this contact from `projector`: its normal, and all directions where friction takes back
  // all slip. Friction resists the rotation of a slip like a spring of stiffness force / slip. Where that spring is
  // stiff only the direction of the slip stays free. `u` is the free iterate.
  PD_HD void take(Leeway<R>& left, const Vec3<R>& u) const {
    const R none(0), one(1);
    const Vec3<R> way = slip(multiply_add(depth, normal, u));
    const R length = square_root(dot(way, way)), rub = friction * depth;
    const R share = one / select(length > none, length, one);
    left.taken = multiply_add(lesser(one, rub * share), way, left.taken);
    const Vec3<R> off = left.free * normal;
    const R size = dot(off, off);
    const auto takes = depth > none && size > R(spanned);
    left.free = take_off(left.free, off, select(takes, one / select(takes, size, one), none));
    const Vec3<R> along = left.free * (share * way);
    const R rest = dot(along, along);
    const auto slides = rest > R(spanned) && !(rub > length);
    const R kept = select(slides, one / select(slides, rest, one), none);
    const auto resists = rub > R(stiff_grip) * length && rub > none;
    const R along_row[3] = {kept * along.x, kept * along.y, kept * along.z};
    for (int a = 0; a < 3; ++a) {
      const Vec3<R> row = left.free.row[a], line = along_row[a] * along;
      left.free.row[a] = select(resists, line, row);
    }
  }

  // `next` without its slip, where that slip is opposite to the slip of the free iterate `u`: friction stops it
  // there.
  PD_HD Vec3<R> stop(const Vec3<R>& next, const Vec3<R>& u) const {
    const R none(0);
    const auto stops = friction * depth > none && !(dot(slip(next), slip(u)) > none);
    return subtract_product(next, select(stops, R(1), none), slip(next));
  }
};

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

  // The free directions of a vertex whose free iterate is `u`.
  PD_HD Leeway<R> leeway(const Vec3<R>& x, const Vec3<R>& u, const Vec3<R>& around) const {
    const R one(1), none(0);
    Leeway<R> left = {{{{one, none, none}, {none, one, none}, {none, none, one}}},
                      {none, none, none}};
    each(x, u, around, [&](const Push<R>& push, const Vec3<R>& from) {
      push.take(left, from);
      return push.out(from);
    });
    return left;
  }

  // Projects a trial `next` out of the contacts; slip ends where friction stops it. `u` is the free iterate.
  PD_HD Vec3<R> land(const Vec3<R>& x, const Vec3<R>& u, const Vec3<R>& around,
                     const Vec3<R>& next) const {
    Vec3<R> stopped = next;
    each(x, u, around, [&](const Push<R>& push, const Vec3<R>& from) {
      stopped = push.stop(stopped, from);
      return push.out(from);
    });
    return each(x, stopped, around, [](const Push<R>& push, const Vec3<R>& at) {
      return multiply_add(push.depth, push.normal, at);
    });
  }

  // the largest coefficient of any contact
  PD_HD R friction() const {
    R most(0);
    for (int i = 0; i < plane_count; ++i) most = -lesser(-most, -planes[i].friction);
    for (int i = 0; i < ball_count; ++i) most = -lesser(-most, -balls[i].friction);
    return most;
  }

  PD_HD bool has_several() const { return plane_count + ball_count > 1; }

  // The smallest gap to all spheres, and to the planes from `first` on.
  PD_HD R least_gap(const Vec3<R>& x, int first) const {
    R least(HUGE_VAL);
    for (int i = first; i < plane_count; ++i) least = lesser(least, gap(planes[i], x));
    for (int i = 0; i < ball_count; ++i) least = lesser(least, gap(balls[i], x));
    return least;
  }

  // The same after a `displacement`. `settled`: friction may hold the vertex (remaining_gap). A single sphere holds
  // by friction only what it pushes.
  PD_HD R least_left(const Vec3<R>& x, const Vec3<R>& way, int first, bool settled) const {
    if (!settled) return least_gap(x + way, first);
    R least(HUGE_VAL);
    for (int i = first; i < plane_count; ++i) least = lesser(least, gap(planes[i], x + way));
    for (int i = 0; i < ball_count; ++i) {
      const R friction = has_several() ? balls[i].friction : R(0);
      least = lesser(least, left_by(balls[i], friction, x, way));
    }
    return least;
  }

 private:
  // Applies visit(contact, u) to u for one contact after another. A contact without penetration could only change the
  // sign of a zero.
  template <class Visit>
  PD_HD Vec3<R> each(const Vec3<R>& x, Vec3<R> u, const Vec3<R>& around, const Visit& visit) const {
    const R none(0);
    const auto meet = [&](const Push<R>& push) {
      if (any(!(push.depth <= none))) u = visit(push, u);
    };
    for (int i = 0; i < plane_count; ++i) {
      const Plane<R>& p = planes[i];
      meet({p.normal, penetration(gap(p, x + u)), p.friction, {none, none, none}});
    }
    for (int i = 0; i < ball_count; ++i) {
      const Ball<R>& b = balls[i];
      const Vec3<R> normal = outward(b, x + around);
      meet({normal, penetration(dot(normal, (x + u) - b.center) - b.radius), b.friction, b.motion});
    }
    return u;
  }
};

}  // namespace pd::inline PD_TARGET
