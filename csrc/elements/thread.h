// Thread through a triangle, along f at rest: w / 2 A (|F f| - 1)^2. Two of them make warp and weft of a cloth.
#pragma once
#include "elements/length.h"

namespace pd::inline PD_TARGET {

struct WovenThread : Length<3> {
  static constexpr int rows = 1;

  template <class R>
  PD_HD static void parameters(const R (&row)[1], const R& measure, R (&p)[2]) {
    p[0] = measure * row[0];
    p[1] = R(scalar_of<R>(1));
  }
};

}  // namespace pd::inline PD_TARGET
