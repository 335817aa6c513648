// Fibre through a tetrahedron, along f at rest: w / 2 V (|F f| - L)^2. A muscle shortens L; a passive fibre may resist
// tension alone, its constant being one.
#pragma once
#include "elements/length.h"

namespace pd::inline PD_TARGET {

struct Fibre : Length<4> {
  static constexpr int constants = 1, rows = 2;

  template <class R>
  PD_HD static void parameters(const R (&row)[2], const R& measure, R (&p)[2]) {
    p[0] = measure * row[0];
    p[1] = row[1];
  }

  template <bool Energy, class R>
  PD_HD static void stress(const Vec3<R> (&f)[1], const R (&p)[2], const R (&c)[1],
                           Vec3<R> (&stress)[1], R& energy) {
    length_stress<Energy>(f[0], p[0], p[1], true, R(scalar_of<R>(1)) - c[0], stress[0], energy);
  }
};

}  // namespace pd::inline PD_TARGET
