// One vertex in an iteration of solver/multilevel/lbfgs.h: the restriction of fields for M, and the next trial. Runners
// supply loops and sums.
#pragma once
#include "solver/multilevel/material_mismatch.h"
#include "solver/vertex.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

// Vertices that the preconditioner M does not model: those that it holds, and those with much larger inertia than its
// reference (MaterialMismatch).
template <class R>
struct Outliers {
  bool some;  // whether there are any
  R trusted;  // MaterialMismatch::trusted
};

template <class Lanes, bool HasContacts>
struct TrialVertex {
  using T = typename Lanes::Scalar;
  using Value = typename Lanes::Value;
  using Real = typename Lanes::Real;

  const Vertex<Lanes, HasContacts>& vertex;
  Value iterate, residual;  // of the last accepted trial
  const Mat3<Real>* free;   // ContactProjector::free at the iterate; not read without contacts
  const Levels<T>& levels;
  std::int64_t number;  // vertex number in the levels
  const Outliers<Real>& outliers;

  // The part of `field` on which M acts: along the free directions, zero at an outlier.
  PD_HD Value restricted(const Value& field) const { return restricted(field, free); }
  PD_HD Value restricted(const Value& field, const Mat3<Real>* along) const {
    const Real none(T(0));
    return along_free(at_outlier(Lanes::value({none, none, none}), field), along);
  }

  // `direction` from M along the free directions; Jacobi's step, residual / D, across them and at an outlier.
  PD_HD Value completed(const Value& direction) const {
    const Value diagonal = vertex.inverse * residual;
    if constexpr (!HasContacts) return at_outlier(diagonal, direction);
    return at_outlier(diagonal,
                      along_free(direction, free) + (diagonal - along_free(diagonal, free)));
  }

  // Next trial: a step of `length` against `direction`, with momentum `beta`. Friction stops it where a slip ends.
  PD_HD Value step(const Contacts<Real>& contacts, const Value& before, const Value& gradient,
                   const Value& direction, const Real& length, const Real& beta) const {
    const Value displacement = completed(length * direction - beta * (iterate - before));
    return vertex.project_trial(contacts, iterate - displacement, iterate, gradient);
  }

  // Next trial of the fallback: a Jacobi iteration; if `accelerates`, relaxed by theta and accelerated by omega.
  template <class Condition>
  PD_HD Value jacobi(const Contacts<Real>& contacts, const Value& before, const Value& gradient,
                     const Condition& accelerates, const Real& theta, const Real& omega) const {
    Value next = subtract_product(iterate, vertex.inverse, residual);
    if (any(accelerates)) {
      const Real descent = theta * vertex.inverse;
      next = select(accelerates, accelerate(iterate, before, gradient, descent, omega), next);
    }
    return vertex.project(contacts, next, iterate);
  }

 private:
  PD_HD static Value along_free(const Value& field, const Mat3<Real>* along) {
    if constexpr (!HasContacts) return field;
    return Lanes::value(*along * Lanes::vec3(field));
  }

  PD_HD Value at_outlier(const Value& there, const Value& elsewhere) const {
    if (!outliers.some) return elsewhere;
    if (!(levels.fine_inverse[number] > T(0))) return there;
    const Real most = Real(T(outlier_ratio) * levels.reference_inertia[number]) * outliers.trusted;
    return select(vertex.inertia > most, there, elsewhere);
  }
};

}  // namespace pd::inline PD_TARGET
