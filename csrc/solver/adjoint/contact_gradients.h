// Gradients of the loss by the parameters of contacts: dL/dp = -l . dr/dp - lambda . dgap/dp for planes and spheres.
// See solver/adjoint/friction.h for the system. The gaps are n_k . x' - height or |x' - center| - radius. Their
// multipliers balance the part of the loss gradient off the tangential directions,
//
//   lambda_k = m_k . q,   q = dL/dx' + dL/dv' / h - H l,   m_k dual to the normals: m_k . n_j = 1 for k = j, else 0.
//
// Normals rotate with a plane's own normal and with a sphere's center. The table gives the factor of that rotation,
// with n the normal and y, d, Q and kappa as there. w is the displacement relative to the contact, P w = s, and pi_k
// = m_k . r the normal force of contact k. The term lambda x' is that of planes alone:
//
//   sticking by friction    (n . w) q - lambda x'; on a sphere it ends at center + R (x + m - center) / |x + m - center|
//   sliding or smooth       pi y + mu^2 pi (d . l) d + kappa (n . w) Q y - lambda x'
//   several contacts        pi_k l - lambda_k x', and the rotation of the edge of two planes
#pragma once
#include "solver/adjoint/system.h"

namespace pd::inline PD_TARGET {

template <class T, class P>
class ContactGradients {
 public:
  PD_HD ContactGradients(const ContactGradientsCall<T, P>& call, const AdjointVertex<T, P>& vertex)
      : call_(call), vertex_(vertex) {}

  PD_HD void give() {
    const T weight = vertex_.inertia(vertex_.spring());
    const HeldVertex<T> held = vertex_.hold(weight, [&](const ContactAt<T>& contact) {
      // three normals span all others, but for rounding
      if (count_ < 3) by_[count_++] = contact;
    });
    const Vec3<T> l = vertex_.read(call_.multiplier);
    // a failed environment has a NaN l, and touches nothing
    clear(T(0) * ((l.x + l.y) + l.z));
    if (count_ == 0) return;
    // H keeps, in all directions, the curvature term that several contacts let through
    const T inertia = weight - (count_ > 1 ? held.curvature : T(0));
    const Vec3<T> q = subtract_product(vertex_.asked() - vertex_.read(call_.elastic), inertia, l);
    count_ == 1 ? give_one(held, l, q) : give_several(held, l, q);
  }

 private:
  PD_HD T* plane(int number) const {
    return call_.planes + planes_numbers * (at() * call_.step.material.planes_count + number);
  }
  PD_HD T* sphere(int number) const {
    return call_.spheres + spheres_numbers * (at() * call_.step.material.spheres_count + number);
  }
  PD_HD std::int64_t at() const {
    return vertex_.environment * call_.step.plan.vertices + vertex_.vertex;
  }
  PD_HD bool is_plane(const ContactAt<T>& contact) const {
    return contact.number < call_.step.material.planes_count;
  }

  PD_HD void clear(T none) const {
    const Material<T>& m = call_.step.material;
    for (int n = 0; call_.planes && n < planes_numbers * m.planes_count; ++n) plane(0)[n] = none;
    for (int n = 0; call_.spheres && n < spheres_numbers * m.spheres_count; ++n)
      sphere(0)[n] = none;
  }

  // Writes the columns of a contact; a sphere has its center where a plane has its normal.
  PD_HD void write(const ContactAt<T>& contact, const Vec3<T>& first, T offset, T friction,
                   const Vec3<T>& motion) const {
    if (!(is_plane(contact) ? call_.planes : call_.spheres)) return;
    T* const to = is_plane(contact) ? plane(contact.number)
                                    : sphere(contact.number - call_.step.material.planes_count);
    static_assert(planes_height == spheres_radius && planes_friction == spheres_friction);
    to[0] = first.x;
    to[1] = first.y;
    to[2] = first.z;
    to[planes_height] = offset;
    to[planes_friction] = friction;
    if (is_plane(contact)) return;
    to[spheres_motion] = motion.x;
    to[spheres_motion + 1] = motion.y;
    to[spheres_motion + 2] = motion.z;
  }

  // `turning`: the tangential factor of the rotation of its normal.
  PD_HD void write_turning(const HeldVertex<T>& held, const ContactAt<T>& contact,
                           const Vec3<T>& turning, T lambda, T friction,
                           const Vec3<T>& motion) const {
    const Vec3<T>& n = contact.normal;
    const Vec3<T> first = is_plane(contact)
                              ? tangential(subtract_product(turning, lambda, held.position), n)
                              : subtract_product(lambda * n, contact.curved, turning);
    write(contact, first, lambda, friction, motion);
  }

  PD_HD void give_one(const HeldVertex<T>& held, const Vec3<T>& l, const Vec3<T>& q) const {
    const ContactAt<T>& by = by_[0];
    const Vec3<T>& n = by.normal;
    const Vec3<T> w = held.moved - by.motion, none = {T(0), T(0), T(0)};
    const T lambda = dot(n, q), along = dot(n, w), push = dot(n, held.residual);
    if (held.stuck) {
      const Vec3<T> rest = tangential(q, n), carried = held.carried * rest;
      if (is_plane(by)) return write_turning(held, by, along * q, lambda, T(0), none);
      return write(by, multiply_add(lambda, n, rest - carried), lambda, T(0), carried);
    }
    const Vec3<T> y = tangential(l, n), slip = tangential(w, n);
    const T slipped = square_root(dot(slip, slip));
    // on a smooth surface at rest, rounding alone would decide the direction of slip
    const bool slides = by.friction > T(0) || !held.holds(slipped, push);
    const Vec3<T> d = (slipped > T(0) && slides ? T(1) / slipped : T(0)) * slip;
    const T back = dot(d, l), rub = by.friction * push;
    // across is the third direction, times the square root of kappa
    const Vec3<T>& across = held.slides[slide_across];
    const Vec3<T> turned = dot(across, l) * across;
    const Vec3<T> turning =
        multiply_add(push, y, multiply_add(by.friction * rub * back, d, along * turned));
    write_turning(held, by, turning, lambda, -push * back, turned);
  }

  // Along the edge of two planes a vertex may slide against friction; all else is smooth here, as in HeldVertex.
  PD_HD void give_several(const HeldVertex<T>& held, const Vec3<T>& l, const Vec3<T>& q) const {
    const bool edge = count_ == 2 && held.curvature == T(0);
    const Vec3<T> c = cross(by_[0].normal, by_[1].normal);
    const T size = square_root(dot(c, c));
    // the rotation of the edge, which is the only direction of the slip
    Vec3<T> turns = {T(0), T(0), T(0)}, d = turns;
    T rub(0);
    if (edge && !held.stuck) {
      const Vec3<T> slip = held.projector * held.moved;
      const T slipped = square_root(dot(slip, slip));
      if (slipped > T(0)) d = (T(1) / slipped) * slip;
      for (int k = 0; k < 2; ++k)
        rub = multiply_add(by_[k].friction, dot(dual(k), held.residual), rub);
      const T way = dot(d, c) < T(0) ? -rub : rub;
      turns = (way / size) * subtract_product(l, dot(d, l), d);
    } else if (edge) {
      turns = (dot(c, q) / (size * size)) * held.moved;
    }
    for (int k = 0; k < count_; ++k) {
      const ContactAt<T>& by = by_[k];
      const Vec3<T> m = dual(k);
      const T lambda = dot(m, q), push = dot(m, held.residual);
      Vec3<T> turning = push * tangential(l, by.normal);
      if (edge)
        turning = turning - (k == 0 ? cross(by_[1].normal, turns) : cross(turns, by_[0].normal));
      const bool carries = held.stuck && by.number == held.sticks_to;
      const Vec3<T> motion = (carries ? T(1) : T(0)) * (held.projector * q);
      write_turning(held, by, turning, lambda, edge ? -push * dot(d, l) : T(0), motion);
    }
  }

  PD_HD Vec3<T> dual(int k) const {
    const Vec3<T>&a = by_[(k + 1) % count_].normal, &b = by_[(k + 2) % 3].normal;
    const Vec3<T> n = by_[k].normal;
    // for two contacts, the part of one normal orthogonal to the other
    const Vec3<T> m = count_ == 2 ? subtract_product(dot(a, a) * n, dot(a, n), a) : cross(a, b);
    return (T(1) / dot(m, n)) * m;
  }

  const ContactGradientsCall<T, P>& call_;
  AdjointVertex<T, P> vertex_;
  ContactAt<T> by_[3] = {};
  int count_ = 0;
};

}  // namespace pd::inline PD_TARGET
