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

namespace pd::inline PD_TARGET {

template <class R>
struct Plane {
  Vec3<R> normal;
  R height, friction;
};

template <class R>
struct Sphere {
  Vec3<R> center, motion;
  R radius, friction;
};

template <class R>
PD_HD R gap(const Plane<R>& plane, const Vec3<R>& x) {
  return dot(plane.normal, x) - plane.height;
}

template <class R>
PD_HD R gap(const Sphere<R>& sphere, const Vec3<R>& x) {
  const Vec3<R> d = x - sphere.center;
  return square_root(dot(d, d)) - sphere.radius;
}

// Penetration depth; a NaN stays NaN, so that it shows.
template <class R>
PD_HD R penetration(const R& distance) {
  const R none(0);
  return select(distance < none, -distance, select(distance > none, none, distance));
}

// Outward unit normal of a sphere; the y axis for a vertex at its very centre.
template <class R>
PD_HD Vec3<R> outward(const Sphere<R>& sphere, const Vec3<R>& x) {
  const Vec3<R> d = x - sphere.center;
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
  const R friction_bound = friction * depth;
  const auto has_friction = touches && !(friction_bound <= none);
  if (!any(has_friction)) return pushed;
  const Vec3<R> slip = tangential(pushed - motion, normal);
  const R length = square_root(dot(slip, slip));
  const R friction_scale = lesser(friction_bound / select(length > none, length, R(1)), R(1));
  return select(has_friction, subtract_product(pushed, friction_scale, slip), pushed);
}

// Squared part of a unit normal that earlier normals do not span; below it the normal counts as dependent.
constexpr double dependent_normal = 1e-6;
// Where friction takes back more than this share of a slip, it resists the rotation of the slip more than the body
// does.
constexpr double stiff_friction = 0.1;

// Removes `off`, the projected part of a normal, from a projector; `reciprocal` is 1 / |off|^2.
template <class R>
PD_HD Mat3<R> project_off(const Mat3<R>& free, const Vec3<R>& off, const R& reciprocal) {
  return {{subtract_product(free.row[0], reciprocal * off.x, off),
           subtract_product(free.row[1], reciprocal * off.y, off),
           subtract_product(free.row[2], reciprocal * off.z, off)}};
}

// The directions that contacts leave to a vertex.
template <class R>
struct ContactProjector {
  Mat3<R> free;  // projector on the free directions
  Vec3<R> slip;  // slip that friction takes back
};

// A contact that moves a vertex out by `depth`, if that is more than 0.
template <class R>
struct Penetration {
  Vec3<R> normal;
  R depth, friction;
  Vec3<R> motion;

  PD_HD Vec3<R> push_out(const Vec3<R>& u) const {
    return pd::push_out(u, normal, depth, friction, motion);
  }
  PD_HD Vec3<R> slip(const Vec3<R>& u) const { return tangential(u - motion, normal); }

  // Removes the directions of this contact from `projector`: its normal, and all directions where friction takes back
  // all slip. Friction resists the rotation of a slip like a spring of stiffness force / slip. Where that spring is
  // stiff only the direction of the slip stays free. `u` is the free iterate.
  PD_HD void remove_from(ContactProjector<R>& projector, const Vec3<R>& u) const {
    const R none(0), one(1);
    const Vec3<R> displacement = slip(multiply_add(depth, normal, u));
    const R length = square_root(dot(displacement, displacement)),
            friction_bound = friction * depth;
    const R share = one / select(length > none, length, one);
    projector.slip =
        multiply_add(lesser(one, friction_bound * share), displacement, projector.slip);
    const Vec3<R> off = projector.free * normal;
    const R size = dot(off, off);
    const auto takes = depth > none && size > R(dependent_normal);
    projector.free =
        project_off(projector.free, off, select(takes, one / select(takes, size, one), none));
    const Vec3<R> along = projector.free * (share * displacement);
    const R rest = dot(along, along);
    const auto slides = rest > R(dependent_normal) && !(friction_bound > length);
    const R kept = select(slides, one / select(slides, rest, one), none);
    const auto resists = friction_bound > R(stiff_friction) * length && friction_bound > none;
    const R along_row[3] = {kept * along.x, kept * along.y, kept * along.z};
    for (int a = 0; a < 3; ++a) {
      const Vec3<R> row = projector.free.row[a], line = along_row[a] * along;
      projector.free.row[a] = select(resists, line, row);
    }
  }

  // `next` without its slip, where that slip is opposite to the slip of the free iterate `u`: friction stops it
  // there.
  PD_HD Vec3<R> stop_slip(const Vec3<R>& next, const Vec3<R>& u) const {
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
PD_HD Vec3<R> project(const Sphere<R>& sphere, const Vec3<R>& x, const Vec3<R>& u,
                      const Vec3<R>& around) {
  const Vec3<R> normal = outward(sphere, x + around);
  const R depth = penetration(dot(normal, (x + u) - sphere.center) - sphere.radius);
  return push_out(u, normal, depth, sphere.friction, sphere.motion);
}

// All contacts of a scene, for one vertex after another.
template <class R>
struct Contacts {
  const Plane<R>* planes = nullptr;
  const Sphere<R>* spheres = nullptr;
  int plane_count = 0, sphere_count = 0;

  PD_HD Vec3<R> project(const Vec3<R>& x, Vec3<R> u, const Vec3<R>& around) const {
    for (int i = 0; i < plane_count; ++i) u = pd::project(planes[i], x, u, around);
    for (int i = 0; i < sphere_count; ++i) u = pd::project(spheres[i], x, u, around);
    return u;
  }

  // The free directions of a vertex whose free iterate is `u`.
  PD_HD ContactProjector<R> contact_projector(const Vec3<R>& x, const Vec3<R>& u,
                                              const Vec3<R>& around) const {
    const R one(1), none(0);
    ContactProjector<R> projector = {{{{one, none, none}, {none, one, none}, {none, none, one}}},
                                     {none, none, none}};
    each(x, u, around, [&](const Penetration<R>& contact, const Vec3<R>& from) {
      contact.remove_from(projector, from);
      return contact.push_out(from);
    });
    return projector;
  }

  // Projects a trial `next` out of the contacts; slip ends where friction stops it. `u` is the free iterate.
  PD_HD Vec3<R> project_trial(const Vec3<R>& x, const Vec3<R>& u, const Vec3<R>& around,
                              const Vec3<R>& next) const {
    Vec3<R> stopped = next;
    each(x, u, around, [&](const Penetration<R>& contact, const Vec3<R>& from) {
      stopped = contact.stop_slip(stopped, from);
      return contact.push_out(from);
    });
    return each(x, stopped, around, [](const Penetration<R>& contact, const Vec3<R>& at) {
      return multiply_add(contact.depth, contact.normal, at);
    });
  }

  PD_HD bool exist() const { return plane_count + sphere_count > 0; }

  // the largest coefficient of any contact
  PD_HD R friction() const {
    R most(0);
    for (int i = 0; i < plane_count; ++i) most = -lesser(-most, -planes[i].friction);
    for (int i = 0; i < sphere_count; ++i) most = -lesser(-most, -spheres[i].friction);
    return most;
  }

 private:
  // Applies visit(contact, u) to u for one contact after another. A contact without penetration could only change the
  // sign of a zero.
  template <class Visit>
  PD_HD Vec3<R> each(const Vec3<R>& x, Vec3<R> u, const Vec3<R>& around, const Visit& visit) const {
    const R none(0);
    const auto apply = [&](const Penetration<R>& contact) {
      if (any(!(contact.depth <= none))) u = visit(contact, u);
    };
    for (int i = 0; i < plane_count; ++i) {
      const Plane<R>& p = planes[i];
      apply({p.normal, penetration(gap(p, x + u)), p.friction, {none, none, none}});
    }
    for (int i = 0; i < sphere_count; ++i) {
      const Sphere<R>& b = spheres[i];
      const Vec3<R> normal = outward(b, x + around);
      apply(
          {normal, penetration(dot(normal, (x + u) - b.center) - b.radius), b.friction, b.motion});
    }
    return u;
  }
};

}  // namespace pd::inline PD_TARGET
