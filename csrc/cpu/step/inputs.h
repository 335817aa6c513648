// The user's inputs, lane by lane: environments past the batch repeat its last one.
#pragma once
#include "cpu/step/lanes.h"

namespace pd::inline PD_TARGET {

template <class Lanes>
struct Inputs {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  static constexpr int width = Lanes::environments;

  const StepCall<T>& call;
  std::int64_t first;  // environment

  std::int64_t environment(int lane) const {
    const std::int64_t e = first + lane;
    return e < call.batch ? e : call.batch - 1;
  }

  // one vertex of an array [batch, vertices, 3] in the user's order
  Value at_vertex(const T* from, std::int64_t i) const {
    Value r = {};
    for (int lane = 0; lane < width; ++lane) {
      const T* p = from + (environment(lane) * call.plan.vertices + call.plan.vertex_order[i]) * 3;
      Lanes::set_lane(r, lane, p[0], p[1], p[2]);
    }
    return r;
  }

  Real number(const Values<T>& values, std::int64_t index) const {
    Real r(T(0));
    for (int lane = 0; lane < width; ++lane)
      Lanes::set_lane(r, lane, values.of(environment(lane))[index]);
    return r;
  }

  Value vector(const Values<T>& values, std::int64_t index) const {
    Value r = {};
    for (int lane = 0; lane < width; ++lane) {
      const T* p = values.of(environment(lane)) + index;
      Lanes::set_lane(r, lane, p[0], p[1], p[2]);
    }
    return r;
  }

  // visit(vertex, spring, target); an infinite spring holds the vertex on its target
  template <class Visit>
  void each_pin(Visit visit) const {
    for (int p = 0; p < call.plan.pins; ++p) {
      visit(call.plan.pin_vertex[p], number(call.material.pin_stiffness, p),
            vector(call.material.pin_targets, 3 * p));
    }
  }
};

}  // namespace pd::inline PD_TARGET
