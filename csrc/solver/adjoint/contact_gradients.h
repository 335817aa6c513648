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

  PD_HD void differentiate() {
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
    const Vec3<T> q =
        subtract_product(vertex_.loss_gradient() - vertex_.read(call_.elastic), inertia, l);
    count_ == 1 ? differentiate_single(held, l, q) : differentiate_multiple(held, l, q);
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

  // `rotation_factor`: the tangential factor of the rotation of its normal.
  PD_HD void write_rotating(const HeldVertex<T>& held, const ContactAt<T>& contact,
                            const Vec3<T>& rotation_factor, T lambda, T friction,
                            const Vec3<T>& motion) const {
    const Vec3<T>& n = contact.normal;
    const Vec3<T> first =
        is_plane(contact) ? tangential(subtract_product(rotation_factor, lambda, held.position), n)
                          : subtract_product(lambda * n, contact.inverse_distance, rotation_factor);
    write(contact, first, lambda, friction, motion);
  }

  PD_HD void differentiate_single(const HeldVertex<T>& held, const Vec3<T>& l,
                                  const Vec3<T>& q) const {
    const ContactAt<T>& by = by_[0];
    const Vec3<T>& n = by.normal;
    const Vec3<T> w = held.moved - by.motion, none = {T(0), T(0), T(0)};
    const T lambda = dot(n, q), along = dot(n, w), normal_force = dot(n, held.residual);
    if (held.stuck) {
      const Vec3<T> rest = tangential(q, n), carried = held.carried * rest;
      if (is_plane(by)) return write_rotating(held, by, along * q, lambda, T(0), none);
      return write(by, multiply_add(lambda, n, rest - carried), lambda, T(0), carried);
    }
    const Vec3<T> y = tangential(l, n), slip = tangential(w, n);
    const T slipped = square_root(dot(slip, slip));
    // on a smooth surface at rest, rounding alone would decide the direction of slip
    const bool slides = by.friction > T(0) || !held.holds(slipped, normal_force);
    const Vec3<T> d = (slipped > T(0) && slides ? T(1) / slipped : T(0)) * slip;
    const T back = dot(d, l), friction_bound = by.friction * normal_force;
    // across is the third direction, times the square root of kappa
    const Vec3<T>& across = held.slides[slide_across];
    const Vec3<T> turned = dot(across, l) * across;
    const Vec3<T> rotation_factor = multiply_add(
        normal_force, y, multiply_add(by.friction * friction_bound * back, d, along * turned));
    write_rotating(held, by, rotation_factor, lambda, -normal_force * back, turned);
  }

  // Along the edge of two planes a vertex may slide against friction; all else is smooth here, as in HeldVertex.
  PD_HD void differentiate_multiple(const HeldVertex<T>& held, const Vec3<T>& l,
                                    const Vec3<T>& q) const {
    const bool edge = count_ == 2 && held.curvature == T(0);
    const Vec3<T> c = cross(by_[0].normal, by_[1].normal);
    const T size = square_root(dot(c, c));
    // the rotation of the edge, which is the only direction of the slip
    Vec3<T> edge_rotation = {T(0), T(0), T(0)}, d = edge_rotation;
    T friction_bound(0);
    if (edge && !held.stuck) {
      const Vec3<T> slip = held.projector * held.moved;
      const T slipped = square_root(dot(slip, slip));
      if (slipped > T(0)) d = (T(1) / slipped) * slip;
      for (int k = 0; k < 2; ++k)
        friction_bound = multiply_add(by_[k].friction, dot(dual(k), held.residual), friction_bound);
      const T signed_bound = dot(d, c) < T(0) ? -friction_bound : friction_bound;
      edge_rotation = (signed_bound / size) * subtract_product(l, dot(d, l), d);
    } else if (edge) {
      edge_rotation = (dot(c, q) / (size * size)) * held.moved;
    }
    for (int k = 0; k < count_; ++k) {
      const ContactAt<T>& by = by_[k];
      const Vec3<T> m = dual(k);
      const T lambda = dot(m, q), normal_force = dot(m, held.residual);
      Vec3<T> rotation_factor = normal_force * tangential(l, by.normal);
      if (edge)
        rotation_factor = rotation_factor - (k == 0 ? cross(by_[1].normal, edge_rotation)
                                                    : cross(edge_rotation, by_[0].normal));
      const bool carries = held.stuck && by.number == held.sticks_to;
      const Vec3<T> motion = (carries ? T(1) : T(0)) * (held.projector * q);
      write_rotating(held, by, rotation_factor, lambda, edge ? -normal_force * dot(d, l) : T(0),
                     motion);
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
