// Operations of a step on one vertex: diagonal, target, pins, projection, acceleration, energy.
#pragma once
#include "contact/plane_sphere.h"
#include "math/vec.h"

#include <limits>

namespace pd::inline PD_TARGET {

// Inertia, drag, forces and springs are quadratics of one vertex. They add up to a single one, a / 2 |u - s|^2:
//   a   = m / h^2 (1 + damping h) + k
//   a s = m / h (v + h gravity) + force + k (pin - x)
template <class R>
PD_HD R inertia_weight(const R& mass, const R& damping, const R& spring, const R& h) {
  return multiply_add(mass / (h * h), multiply_add(damping, h, R(1)), spring);
}

// The same, 0 where an infinite spring holds the vertex exactly, and -1 where the spring is negative.
template <class R>
PD_HD R held_inertia(const R& inertia, const R& spring) {
  const R none(0), invalid(-1), most(std::numeric_limits<scalar_of<R>>::max());
  return select(spring < none, invalid, select(spring > most, none, inertia));
}

template <class V, class R>
PD_HD V inertia_target(const R& weight, const R& mass, const V& velocity, const V& gravity,
                       const V& force, const R& spring, const V& pin, const R& h) {
  const V free = multiply_add(mass / h, multiply_add(h, gravity, velocity), force);
  const V pull = multiply_add(spring, pin, free);
  return (R(1) / weight) * pull;
}

// 1 / D; 0 for a vertex that a pin holds exactly (a = 0)
template <class R>
PD_HD R inverse_diagonal(const R& inertia, const R& elastic) {
  return select(inertia > R(0), R(1) / (inertia + elastic), R(0));
}

// a / D of a vertex that moves; infinite where a pin holds it, -1 where mass, spring or stiffness are negative
template <class R>
PD_HD R inertia_ratio(const R& inertia, const R& elastic, const R& inverse) {
  const R none(0), invalid(-1), held(HUGE_VAL);
  const R share = select(inertia > none, inertia * inverse, held);
  return select(inertia < none, invalid, select(elastic < none, invalid, share));
}

// x_{k+1} = x_{k-1} + omega (x_k - theta D^-1 grad E - x_{k-1})            (Wang 2015, eq. 16; descent = theta / D)
template <class V, class R>
PD_HD V accelerate(const V& u, const V& before, const V& gradient, const R& descent,
                   const R& omega) {
  return multiply_add(omega, subtract_product(u, descent, gradient) - before, before);
}

// One environment alone: the scalar policy for physics that the CPU's steps run in SIMD lanes.
template <class T>
struct Thread {
  using Scalar = T;
  using Real = T;
  using Value = Vec3<T>;
  PD_HD static Vec3<T> vec3(const Value& a) { return a; }
  PD_HD static Value value(const Vec3<T>& a) { return a; }
};

// One vertex during a step, in each environment that Lanes runs side by side. Real is one number of each environment
// and Value one vector; vec3() and value() convert between Value and Vec3<Real>. Displacements u start at x.
// `HasContacts`: the scene has contacts. Without it no contact code is compiled.
template <class Lanes, bool HasContacts>
struct Vertex {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;

  Value x, target;        // at the start of the step; s
  Real inertia, inverse;  // a; 1 / D, 0 where a pin holds the vertex on its target

  // `held` where a pin holds the vertex, `free` elsewhere
  PD_HD Value hold(const Value& held, const Value& free) const {
    return select(inverse > Real(T(0)), free, held);
  }

  // `u` projected out of the contacts; `around`: see contact/plane_sphere.h
  template <class Obstacles>
  PD_HD Value project(const Obstacles& contacts, const Value& u, const Value& around) const {
    if constexpr (!HasContacts) return u;
    return hold(
        u, Lanes::value(contacts.project(Lanes::vec3(x), Lanes::vec3(u), Lanes::vec3(around))));
  }

  // the first iterate, from a guess
  PD_HD Value first_iterate(const Contacts<Real>& contacts, const Value& guess) const {
    // a NaN target shows in the result, also where no later iterate is better
    const Value u = hold(target, guess + (target - target));
    return project(contacts, u, u);
  }

  // the first iterate from the current position
  PD_HD Value current_iterate(const Contacts<Real>& contacts) const {
    const Real none(T(0));
    return first_iterate(contacts, Lanes::value({none, none, none}));
  }

  // u plus the `displacement` of a rigid motion. A zero displacement keeps all bits, also the sign of a zero.
  PD_HD Value displaced(const Value& u, const Vec3<Real>& displacement) const {
    return select(!(dot(displacement, displacement) <= Real(T(0))),
                  hold(u, u + Lanes::value(displacement)), u);
  }

  // dE/du, from `force` = dE_elastic/du
  PD_HD Value gradient(const Value& u, const Value& force) const {
    return multiply_add(inertia, u - target, force);
  }

  // `sum` + a |u - s|^2, component by component: twice the energy
  PD_HD Value add_energy(const Value& u, const Value& sum) const {
    const Value offset = u - target;
    return multiply_add(inertia * offset, offset, sum);
  }

  // the iterate after u
  PD_HD Value next(const Contacts<Real>& contacts, const Value& u, const Value& before,
                   const Value& force, const Real& theta, const Real& omega) const {
    const Value free = accelerate(u, before, gradient(u, force), theta * inverse, omega);
    return project(contacts, free, u);
  }

  // the part of dE/du that neither a pin nor a contact balances: D times the displacement of a plain iteration
  template <class Obstacles>
  PD_HD Value residual(const Obstacles& contacts, const Value& u, const Value& force) const {
    const Real none(T(0)), one(T(1));
    const Value zero = Lanes::value({none, none, none}), free = gradient(u, force);
    if constexpr (!HasContacts) return hold(zero, free);
    const Real diagonal = one / select(inverse > none, inverse, one);
    return hold(zero, diagonal * (u - project(contacts, subtract_product(u, inverse, free), u)));
  }

  // the free directions at u: see contact/plane_sphere.h
  PD_HD ContactProjector<Real> contact_projector(const Contacts<Real>& contacts, const Value& u,
                                                 const Value& force) const {
    return contacts.contact_projector(Lanes::vec3(x),
                                      Lanes::vec3(subtract_product(u, inverse, gradient(u, force))),
                                      Lanes::vec3(u));
  }

  // the friction force, from the slip that friction takes back
  PD_HD Value friction_force(const Vec3<Real>& slip) const {
    const Real none(T(0)), one(T(1)), diagonal = one / select(inverse > none, inverse, one);
    return hold(Lanes::value({none, none, none}), Lanes::value(diagonal * slip));
  }

  // a trial `next` projected out of the contacts, from u with dE/du = `slope`: see contact/plane_sphere.h
  PD_HD Value project_trial(const Contacts<Real>& contacts, const Value& next, const Value& u,
                            const Value& slope) const {
    if constexpr (!HasContacts) return next;
    const Vec3<Real> free = Lanes::vec3(subtract_product(u, inverse, slope));
    return Lanes::value(
        contacts.project_trial(Lanes::vec3(x), free, Lanes::vec3(u), Lanes::vec3(next)));
  }
};

}  // namespace pd::inline PD_TARGET
