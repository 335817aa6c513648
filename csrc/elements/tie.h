// Tie of a vertex to a point: k / 2 |x_0 - sum_a b_a x_a|^2, b the barycentric coordinates of the point in a triangle
// or a tetrahedron. Corners that the point does not need have b = 0.
#pragma once
#include "elements/length.h"

namespace pd::inline PD_TARGET {

struct Tie : Length<5> {
  static constexpr int rows = 1, quadratic = 1;

  template <class R>
  PD_HD static void parameters(const R (&row)[1], const R& measure, R (&p)[2]) {
    p[0] = measure * row[0];
    p[1] = R(scalar_of<R>(0));
  }
};

}  // namespace pd::inline PD_TARGET
