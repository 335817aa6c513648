// Runner of measure_mismatch (solver/multilevel/material_mismatch.h) on the CPU.
#pragma once
#include "cpu/step/stencil_blocks.h"
#include "elements/lame.h"
#include "solver/multilevel/material_mismatch.h"
#include "threads/team.h"

namespace pd::inline PD_TARGET {

// Loops and reduction of the comparison over a team's threads. `inertia(i)` is a of an internal vertex. The ranges do
// not depend on how the team shares the work.
template <class T, class Inertia>
struct MismatchRunner {
  const Plan<T>& plan;
  const StepCall<T>& call;
  std::int64_t environment;
  T per_time;  // 1 / h
  const Team& team;
  RatioRange (*ranges)[ranges_count];  // one row a thread
  Inertia inertia;

  template <class Visit>
  void each_element(const Visit& visit) const {
    const MatrixStiffness<T> stiffness(call.material.stiffness, call.effects, environment);
    for (std::int64_t t = team.begin(plan.tets); t < team.end(plan.tets); ++t)
      visit(stiffness(t), t);
    each_stencil_stiffness(plan, call.effects, environment, per_time,
                           team.begin(plan.stencil_blocks), team.end(plan.stencil_blocks), visit);
  }

  template <class Visit>
  void each_vertex(const Visit& visit) const {
    for (std::int64_t i = team.begin(plan.vertices); i < team.end(plan.vertices); ++i)
      visit(i, inertia(i));
  }

  void reduce(RatioRange (&range)[ranges_count]) const {
    for (int n = 0; n < ranges_count; ++n) ranges[team.rank][n] = range[n];
    team.barrier();
    for (int rank = 0; rank < team.size; ++rank) {
      for (int n = 0; n < ranges_count; ++n) range[n].add(ranges[rank][n]);
    }
    team.barrier();
  }
};

}  // namespace pd::inline PD_TARGET
