// Spring between two vertices: k / 2 (|x_1 - x_0| - L)^2. Its F is the edge itself, and its measure is one.
#pragma once
#include "elements/length.h"

namespace pd::inline PD_TARGET {

struct Spring : Length<2> {
  static constexpr int rows = 2;

  template <class R>
  PD_HD static void parameters(const R (&row)[2], const R& measure, R (&p)[2]) {
    p[0] = measure * row[0];
    p[1] = row[1];
  }
};

}  // namespace pd::inline PD_TARGET
