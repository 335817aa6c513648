// What a step does with one vertex: predict, accelerate.
#pragma once
#include "math/vec.h"

namespace pd::inline PD_TARGET {

// Inertia, drag, forces and springs are quadratics of one vertex, so they fold into a single one, a / 2 |u - s|^2:
//   a   = m / h^2 (1 + damping h) + k
//   a s = m / h (v + h gravity) + force + k (pin - x)
template <class R>
PD_HD R inertia_weight(const R& mass, const R& damping, const R& spring, const R& h) {
  return multiply_add(mass / (h * h), multiply_add(damping, h, R(1)), spring);
}

template <class V, class R>
PD_HD V inertia_target(const R& weight, const R& mass, const V& velocity, const V& gravity,
                       const V& force, const R& spring, const V& pin, const R& h) {
  const V free = multiply_add(mass / h, multiply_add(h, gravity, velocity), force);
  const V pull = multiply_add(spring, pin, free);
  return (R(1) / weight) * pull;
}

// x_{k+1} = x_{k-1} + omega (x_k - theta D^-1 grad E - x_{k-1})            (Wang 2015, eq. 16; descent = theta / D)
template <class V, class R>
PD_HD V accelerate(const V& u, const V& before, const V& gradient, const R& descent,
                   const R& omega) {
  return multiply_add(omega, subtract_product(u, descent, gradient) - before, before);
}

}  // namespace pd::inline PD_TARGET
