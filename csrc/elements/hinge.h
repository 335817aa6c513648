// Bending of a hinge: kb / 2 A (|F| - k0)^2, F the curvature vector [1/m] of the four vertices around an edge.
//
//   F = sum_a c_a x_a / A,   A = A_0 + A_1,   c from the cotangents at the edge       (Bergou et al. 2006)
//
// Flat where k0 = 0, or where the scene has no k0: then the energy is quadratic. A rod has the same energy at three vertices, the fourth with c = 0.
#pragma once
#include "elements/length.h"

namespace pd::inline PD_TARGET {

struct Hinge : Length<4> {
  static constexpr int rows = 2, quadratic = 1;

  template <class R>
  PD_HD static void parameters(const R (&row)[2], const R& measure, R (&p)[2]) {
    p[0] = measure * row[0];
    p[1] = row[1];
  }
};

}  // namespace pd::inline PD_TARGET
