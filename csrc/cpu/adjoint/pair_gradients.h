// Derivatives of a loss by what the pairs of a solved adjoint depend on, environment by environment, by one thread each.
//
// The multipliers nu of the rows balance what the multiplier l of the step leaves of the right side:
//
//   C^T nu = P (dL/dx' + dL/dv' / h - a l - K l)     with all terms of planes and spheres of the scene
#pragma once
#include "cpu/adjoint/pairs.h"

#include <vector>

namespace pd::inline PD_TARGET {

// Of one environment. `pairs`: memory to use.
template <class T>
void differentiate_pairs(const PairGradientsCall<T>& call, AdjointPairs<T>& pairs,
                         std::int64_t environment) {
  const Plan<T>& plan = call.plan;
  const auto user = [&](int i) { return environment * plan.vertices + plan.vertex_order[i]; };
  const auto in_double = [](const T* p) {
    return Vec3<double>{double(p[0]), double(p[1]), double(p[2])};
  };
  std::vector<T> inverse(plan.vertices);
  for (int i = 0; i < plan.vertices; ++i)
    inverse[i] = call.inverse.of(environment)[plan.vertex_order[i]];
  const auto sliding = [&](int i) -> const T* {
    return call.sliding ? call.sliding + 3 * slide_count * user(i) : nullptr;
  };
  const auto projector = [&](int i) -> const T* {
    return call.projector ? call.projector + 9 * user(i) : nullptr;
  };
  pairs.read(environment, [&](int i) -> T& { return inverse[i]; }, projector, sliding);
  const auto multiplier = [&](int i) { return in_double(call.multiplier + 3 * user(i)); };
  std::vector<Vec3<double>> left(plan.vertices), own(plan.vertices, Vec3<double>{0, 0, 0});
  pairs.multiply(false, multiplier, [&](int i, const Vec3<double>& a) { own[i] = a; });
  for (int i = 0; i < plan.vertices; ++i) {
    double numbers[9], vectors[3 * slide_count];
    const T* const p = projector(i);
    for (int n = 0; p && n < 9; ++n) numbers[n] = double(p[n]);
    for (int n = 0; p && n < 3 * slide_count; ++n) vectors[n] = double(sliding(i)[n]);
    const Vec3<double> force = in_double(call.elastic + 3 * user(i)) + own[i];
    const bool moves = inverse[i] != T(0);
    const double inertia = double(call.inertia.of(environment)[plan.vertex_order[i]]);
    const Vec3<double> l = multiplier(i), right = in_double(call.right + 3 * user(i));
    const Vec3<double> image =
        p ? friction_image<double>(force, project<double>(l, numbers), inertia, moves, numbers,
                                   vectors)
          : conjugate_image<double>(force, l, inertia, moves, nullptr, nullptr);
    left[i] = right - image;
  }
  const std::vector<double> nu =
      pairs.unscaled(pairs.rows().multipliers([&](int i) { return left[i]; }));
  pairs.differentiate(environment, multiplier, nu, call.out);
}

}  // namespace pd::inline PD_TARGET
