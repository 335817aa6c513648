// How far the material of a step is from that which its preconditioner was made of.
#pragma once
#include "cpu/team.h"
#include "plan/views.h"
#include "solver/multilevel.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

// All of a team measures together; the ranges do not depend on how it shares the work.
template <class T>
struct MisfitMeter {
  const Plan<T>& plan;
  const Values<T>& stiffness;
  const Team& team;
  double (*ratios)[2];  // one a thread

  // `inertia(i)` is a of an internal vertex, 0 where the step holds it
  template <class Inertia>
  Misfit measure(std::int64_t environment, const Inertia& inertia) const {
    const T* values = stiffness.of(environment);
    Range elements, inertias, common;
    for (std::int64_t t = team.begin(plan.tets); t < team.end(plan.tets); ++t)
      elements.count(double(values[t]) / double(plan.levels.reference_stiffness[t]));
    each_inertia(inertia, [&](double ratio) { inertias.count(ratio); });
    meet(elements);
    meet(inertias);
    Misfit m(elements, inertias);
    const double most = known_inertia * m.trusted;
    each_inertia(inertia, [&](double ratio) {
      if (!(ratio > most)) common.count(ratio);
    });
    meet(common);
    m.conclude(elements, inertias, common, other_pins(inertia));
    return m;
  }

 private:
  // whether the step holds other vertices than M does
  template <class Inertia>
  bool other_pins(const Inertia& inertia) const {
    Range differ;
    for (std::int64_t i = team.begin(plan.vertices); i < team.end(plan.vertices); ++i) {
      if ((inertia(i) > 0) != (plan.levels.fine_inverse[i] > T(0))) differ.count(1);
    }
    meet(differ);
    return differ.largest > 0;
  }

  // visit(a / a_0) of this thread's vertices that neither the step nor M holds
  template <class Inertia, class Visit>
  void each_inertia(const Inertia& inertia, Visit visit) const {
    for (std::int64_t i = team.begin(plan.vertices); i < team.end(plan.vertices); ++i) {
      const double a = inertia(i);
      if (a > 0 && plan.levels.fine_inverse[i] > T(0))
        visit(a / double(plan.levels.reference_inertia[i]));
    }
  }

  // the range over all threads
  void meet(Range& range) const {
    ratios[team.rank][0] = range.least;
    ratios[team.rank][1] = range.largest;
    team.barrier();
    for (int rank = 0; rank < team.size; ++rank) {
      range.least = std::min(range.least, ratios[rank][0]);
      range.largest = std::max(range.largest, ratios[rank][1]);
    }
    team.barrier();
  }
};

}  // namespace pd::inline PD_TARGET
