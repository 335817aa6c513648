// A contact as an envelope: its force grows from that of the present iterate with the stiffness D of the iteration.
//
// With the gap, the slip along the surface since the start of the step, and the forces l0 (normal) and t0 (tangential) at
// the iterate, for a fixed radius r of friction:
//   e = max(0, l0 - D gap)^2 / (2 D) + huber_r(t0 - D slip) / D,   huber_r(b) = |b|^2 / 2 if |b| <= r, else r |b| - r^2 / 2
// e is convex. It is what remains of D / 2 |p|^2 once the contact has pushed its vertex by p = (f - f0) / D, f = l n + t.
// With min(1, r / |b|) D as tangential stiffness, its quadratic model is an upper bound: Newton's step does not overshoot
// where friction begins to hold.
#pragma once
#include "contact/plane_sphere.h"

namespace pd::inline PD_TARGET {

// Force of a contact on a vertex at the present iterate, and the radius of friction, which lags behind friction times l.
template <class V, class R>
struct ContactForce {
  V force;
  R radius;
};

template <class W, class R>
PD_HD Vec3<W> widened(const Vec3<R>& a) {
  return {convert<double>(a.x), convert<double>(a.y), convert<double>(a.z)};
}

// A contact at some displacement of its vertex.
template <class W>
struct Surface {
  Vec3<W> normal;
  W gap;
  Vec3<W> slip;
};

template <class W>
struct Envelope {
  W stiffness, normal_anchor;
  Vec3<W> tangent_anchor;

  // `force`: of the contact at the iterate; `normal`: along which it is split
  PD_HD Envelope(const W& stiffness, const Vec3<W>& force, const Vec3<W>& normal)
      : stiffness(stiffness), normal_anchor(dot(force, normal)) {
    normal_anchor = select(normal_anchor > W(0.0), normal_anchor, W(0.0));
    tangent_anchor = tangential(force, normal);
  }

  PD_HD W normal_force(const W& gap) const {
    const W force = subtract_product(normal_anchor, stiffness, gap);
    return select(force > W(0.0), force, W(0.0));
  }

  // b = t0 - D slip, and the share of it that the radius leaves
  struct Rub {
    Vec3<W> pull;
    W square, share;
  };

  PD_HD Rub rub(const Vec3<W>& slip, const W& radius) const {
    const W none(0.0);
    if (!any(radius > none)) return {{none, none, none}, none, none};
    const Vec3<W> pull = subtract_product(tangent_anchor, stiffness, slip);
    const W square = dot(pull, pull), size = square_root(square);
    const W cut = radius / select(size > W(0.0), size, W(1.0));
    return {pull, square, select(size < radius, W(1.0), cut)};
  }

  // the force at the iterate
  PD_HD Vec3<W> anchor(const Vec3<W>& normal) const {
    return multiply_add(normal_anchor, normal, tangent_anchor);
  }

  // e, times D
  PD_HD W energy(const Surface<W>& at, const W& radius) const {
    const W normal = normal_force(at.gap);
    const Rub r = rub(at.slip, radius);
    const W huber = r.share * (W(1.0) - W(0.5) * r.share) * r.square;
    return multiply_add(W(0.5) * normal, normal, huber);
  }

  PD_HD Vec3<W> force(const Surface<W>& at, const W& radius) const {
    const Rub r = rub(at.slip, radius);
    return multiply_add(normal_force(at.gap), at.normal, r.share * r.pull);
  }
};

// Sums over the contacts of a body: of their energies before and after a motion, of the second derivative and the force by
// the twist after it, and of the squares of friction l - r and of r.
struct ContactSums {
  static constexpr int before = 0, after = 1, matrix = 2, force = 23, lag = 29, radius = 30,
                       count = 31;
  // the lower triangle, row by row
  PD_HD static constexpr int at(int row, int column) {
    return matrix + row * (row + 1) / 2 + column;
  }
};

// What a contact adds: its energies before and after a motion, friction l - r and r, and after it the force, and the stiffness
// `across` (1 - n n^T) + `along` n n^T. `arm`: of its vertex, for the twist; n = `normal`.
template <class W>
struct ContactTerms {
  W before, after, lag, radius;
  Vec3<W> arm, normal, force;
  W across, along;
};

// Adds J^T k J and J^T f, J the displacement of the vertex by a twist.
template <class W>
PD_HD void add_terms(W (&sum)[ContactSums::count], const ContactTerms<W>& of) {
  using S = ContactSums;
  sum[S::before] = sum[S::before] + of.before;
  sum[S::after] = sum[S::after] + of.after;
  sum[S::lag] = multiply_add(of.lag, of.lag, sum[S::lag]);
  sum[S::radius] = multiply_add(of.radius, of.radius, sum[S::radius]);
  const Vec3<W> moment = cross(of.arm, of.force), lever = cross(of.arm, of.normal);
  const W f[6] = {of.force.x, of.force.y, of.force.z, moment.x, moment.y, moment.z};
  const W n[6] = {of.normal.x, of.normal.y, of.normal.z, lever.x, lever.y, lever.z};
  const W none(0.0), square = dot(of.arm, of.arm), r[3] = {of.arm.x, of.arm.y, of.arm.z};
  // arm x
  const W x[3][3] = {{none, -r[2], r[1]}, {r[2], none, -r[0]}, {-r[1], r[0], none}};
  const W more = of.along - of.across;
  for (int i = 0; i < 6; ++i) {
    sum[S::force + i] = sum[S::force + i] + f[i];
    const W scaled = more * n[i];
    for (int j = 0; j <= i; ++j) {
      const W plain = i < 3    ? (i == j ? of.across : none)
                      : j < 3  ? of.across * x[i - 3][j]
                      : i == j ? of.across * (square - r[i - 3] * r[i - 3])
                               : -(of.across * (r[i - 3] * r[j - 3]));
      sum[S::at(i, j)] = multiply_add(scaled, n[j], sum[S::at(i, j)] + plain);
    }
  }
}

// A vertex of a body that moves, in double: its position at the start of the step, its displacement at the iterate, 1 / D.
template <class W>
struct CoarseVertex {
  Vec3<W> x, u;
  W inverse;  // 0: a pin holds it

  // D, or 0
  PD_HD W stiffness() const {
    const auto moves = inverse > W(0.0);
    return select(moves, W(1.0) / select(moves, inverse, W(1.0)), W(0.0));
  }
};

template <class W>
PD_HD Surface<W> surface_at(const Plane<W>& plane, const Vec3<W>& x, const Vec3<W>& u) {
  return {plane.normal, gap(plane, x + u), tangential(u, plane.normal)};
}

template <class W>
PD_HD Surface<W> surface_at(const Sphere<W>& sphere, const Vec3<W>& x, const Vec3<W>& u) {
  const Vec3<W> normal = outward(sphere, x + u);
  return {normal, gap(sphere, x + u), tangential(u - sphere.motion, normal)};
}

template <class W>
PD_HD Surface<W> before_pushes(const Surface<W>& at, const Vec3<W>& pushes) {
  return {at.normal, at.gap - dot(at.normal, pushes), at.slip - tangential(pushes, at.normal)};
}

// Calls visit(n, plane or sphere in double) for contact n.
template <class W, class R, class Visit>
PD_HD void each_contact(const Contacts<R>& contacts, const Visit& visit) {
  for (int i = 0; i < contacts.plane_count; ++i) {
    const Plane<R>& p = contacts.planes[i];
    visit(i,
          Plane<W>{widened<W>(p.normal), convert<double>(p.height), convert<double>(p.friction)});
  }
  for (int i = 0; i < contacts.sphere_count; ++i) {
    const Sphere<R>& s = contacts.spheres[i];
    visit(contacts.plane_count + i,
          Sphere<W>{widened<W>(s.center), widened<W>(s.motion), convert<double>(s.radius),
                    convert<double>(s.friction)});
  }
}

// Calls visit(n, plane or sphere, how far the contacts after it push the vertex at the iterate). The projection goes from one
// contact to the next, so each has its gap and slip before the pushes of those after it.
template <class W, class R, class Forces, class Visit>
PD_HD void each_contact_in_turn(const Contacts<R>& contacts, const W& inverse, const Forces& forces,
                                const Visit& visit) {
  const W none(0.0);
  const int count = contacts.plane_count + contacts.sphere_count;
  Vec3<W> later = {none, none, none};
  for (int n = 1; n < count; ++n) later = later + forces.force(n);
  each_contact<W>(contacts, [&](int n, const auto& shape) {
    if (n > 0) later = later - forces.force(n);
    visit(n, shape, inverse * later);
  });
}

// Keeps the forces with which the contacts stop a plain iteration at `free`.
template <class R, class W, class Forces>
PD_HD void keep_forces(const Contacts<R>& contacts, const CoarseVertex<W>& v, const Vec3<W>& free,
                       const Forces& forces) {
  const W none(0.0);
  Vec3<W> at = free;
  each_contact<W>(contacts, [&](int n, const auto& shape) {
    const Vec3<W> next = project(shape, v.x, at, v.u), way = next - at;
    const Vec3<W> force = (any(dot(way, way) > none) ? v.stiffness() : none) * way;
    const W normal = dot(force, surface_at(shape, v.x, v.u).normal);
    forces.set(n, force, select(normal > none, shape.friction * normal, none));
    at = next;
  });
}

// Of these forces: sum |f0|^2 / (2 D), which Phi has more than the energy.
template <class R, class W, class Forces>
PD_HD W anchor_energy(const Contacts<R>& contacts, const CoarseVertex<W>& v, const Forces& forces) {
  W square(0.0);
  for (int n = 0; n < contacts.plane_count + contacts.sphere_count; ++n)
    square = square + dot(forces.force(n), forces.force(n));
  return W(0.5) * v.inverse * square;
}

// Whether the envelope of a contact is more than 0 anywhere: without a force at the iterate, where the gap is negative.
template <class W>
PD_HD bool touches(const W& gap, const Vec3<W>& force, const W& radius) {
  const W none(0.0);
  return any(gap < none) || any(radius + dot(force, force) > none);
}

// How far the contacts push a vertex once its body has moved, one after another: (f - f0) / D.
template <class R, class W, class Forces>
PD_HD Vec3<W> push_of(const Contacts<R>& contacts, const CoarseVertex<W>& v, const Forces& forces) {
  const W none(0.0);
  Vec3<W> push = {none, none, none};
  each_contact_in_turn<W>(
      contacts, v.inverse, forces, [&](int n, const auto& shape, const Vec3<W>& later) {
        const Surface<W> at = before_pushes(surface_at(shape, v.x, v.u + push), later);
        const Vec3<W> force = forces.force(n);
        const W radius = forces.radius(n);
        if (!touches(at.gap, force, radius)) return;
        const Envelope<W> envelope(v.stiffness(), force, at.normal);
        push = push + v.inverse * (envelope.force(at, radius) - envelope.anchor(at.normal));
      });
  return push;
}

// What a round asks of a body's vertices, per environment: the accepted motion and the trial. `renews`: the share by which
// radii move toward friction l.
template <class W>
struct CoarseTrial {
  Mat3<W> turn_before, turn_after;  // R - 1
  Vec3<W> center, shift_before, shift_after;
  W renews;  // 1, 0.5 or 0
};

// Calls add(whether a contact of a vertex adds anything, what it adds: a function).
template <class R, class W, class Forces, class Add>
PD_HD void each_contact_term(const Contacts<R>& contacts, const CoarseVertex<W>& v,
                             const CoarseTrial<W>& trial, const Forces& forces, const Add& add) {
  const Vec3<W> arm = (v.x + v.u) - trial.center, way = trial.turn_after * arm;
  const Vec3<W> first = v.u + (trial.turn_before * arm + trial.shift_before);
  const Vec3<W> then = v.u + (way + trial.shift_after);
  const W none(0.0);
  each_contact_in_turn<W>(
      contacts, v.inverse, forces, [&](int n, const auto& shape, const Vec3<W>& later) {
        const Surface<W> before = before_pushes(surface_at(shape, v.x, first), later),
                         after = before_pushes(surface_at(shape, v.x, then), later);
        // by the normal of before, so that both energies are of one function
        const Surface<W> there = {before.normal, after.gap,
                                  before.slip + tangential(then - first, before.normal)};
        const Vec3<W> force = forces.force(n);
        const W last_radius = forces.radius(n);
        const W least = select(before.gap < after.gap, before.gap, after.gap);
        add(touches(least, force, last_radius), [&] {
          const W stiffness = v.stiffness();
          const Envelope<W> old(stiffness, force, before.normal),
              now(stiffness, force, after.normal);
          const W normal = now.normal_force(after.gap);
          ContactTerms<W> terms;
          terms.before = v.inverse * old.energy(before, last_radius);
          terms.after = v.inverse * old.energy(there, last_radius);
          const W free = select(v.inverse > none, W(1.0), none);
          const W radius =
              multiply_add(trial.renews, shape.friction * normal - last_radius, last_radius);
          forces.set_radius(n, radius);
          terms.lag = free * (shape.friction * normal - radius);
          terms.radius = free * radius;
          const auto rub = now.rub(after.slip, radius);
          terms.arm = arm + way;
          terms.normal = after.normal;
          terms.force = free * multiply_add(normal, after.normal, rub.share * rub.pull);
          terms.across = rub.share * stiffness;
          terms.along = select(normal > none, stiffness, none);
          return terms;
        });
      });
}

}  // namespace pd::inline PD_TARGET
