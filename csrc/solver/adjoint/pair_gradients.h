// Derivatives of a loss by what the pairs of a solved adjoint depend on, of one environment.
//
// The multipliers nu of the rows balance what the multiplier l of the step leaves of the right side:
//
//   C^T nu = P (dL/dx' + dL/dv' / h - a l - K l)     with all terms of planes and spheres of the scene
#pragma once
#include "solver/adjoint/pairs.h"

namespace pd::inline PD_TARGET {

// `inverse`, `left`: memory for [vertices] of bodies
template <class T, class Team, class Provide>
PD_HD void differentiate_pairs(const PairGradientsCall<T>& call, const Team& team,
                               const PairMemory& memory, T* inverse, Vec3<double>* left,
                               const Provide& provide, std::int64_t environment) {
  const int vertices = call.vertices;
  const auto user = [&](int i) { return environment * vertices + call.vertex_order[i]; };
  const auto in_double = [](const T* p) {
    return Vec3<double>{double(p[0]), double(p[1]), double(p[2])};
  };
  const auto sliding = [&](int i) -> const T* {
    return call.sliding ? call.sliding + 3 * slide_count * user(i) : nullptr;
  };
  const auto projector = [&](int i) -> const T* {
    return call.projector ? call.projector + 9 * user(i) : nullptr;
  };
  team.each(vertices, [&](int i) {
    inverse[i] = call.inverse.of(environment)[call.vertex_order[i]];
    left[i] = {0, 0, 0};
  });
  AdjointPairs<T, Team> pairs(call.pairs, call.vertex_order, team, memory, environment);
  pairs.read([&](int i) -> T& { return inverse[i]; }, projector, sliding, provide);
  const auto multiplier = [&](int i) { return in_double(call.multiplier + 3 * user(i)); };
  pairs.multiply(false, multiplier, [&](int i, const Vec3<double>& a) { left[i] = a; });
  team.each(vertices, [&](int i) {
    double numbers[9], vectors[3 * slide_count];
    const T* const p = projector(i);
    for (int n = 0; p && n < 9; ++n) numbers[n] = double(p[n]);
    for (int n = 0; p && n < 3 * slide_count; ++n) vectors[n] = double(sliding(i)[n]);
    const Vec3<double> force = in_double(call.elastic + 3 * user(i)) + left[i];
    const bool moves = inverse[i] != T(0);
    const double inertia = double(call.inertia.of(environment)[call.vertex_order[i]]);
    const Vec3<double> l = multiplier(i), right = in_double(call.right + 3 * user(i));
    const Vec3<double> image =
        p ? friction_image<double>(force, project<double>(l, numbers), inertia, moves, numbers,
                                   vectors)
          : conjugate_image<double>(force, l, inertia, moves, nullptr, nullptr);
    left[i] = right - image;
  });
  double* const nu = pairs.rows().multipliers([&](int i) { return left[i]; });
  pairs.differentiate(multiplier, nu, call.out);
}

}  // namespace pd::inline PD_TARGET
