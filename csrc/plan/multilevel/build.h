// Builds the multilevel approximation of A^-1 for a scene: the arrays of multilevel.def.
//
// A = diag(a) + sum_e w_e V_e G G^T is constant, so this happens once. The method is smoothed aggregation
// (Vanek, Mandel and Brezina 1996) with the affine functions as near-nullspace. They represent rigid motions and
// uniform strains of an aggregate exactly.
#pragma once

#include "plan/mesh/elements.h"
#include "views/views.h"

#include <cstdint>
#include <functional>
#include <vector>

namespace pd {

// The scene, checked by the caller; in the user's numbers but for `vertex_order` (internal number -> user's number).
struct MultilevelScene {
  MeshElements elements;
  const std::int32_t* vertex_order;  // [vertices]
  const double* stiffness;           // [elements] at rest: Young's modulus of a tetrahedron [Pa]
  const double* inertia;             // [vertices] a, inf where a pin holds the vertex exactly [N/m]
  std::int64_t most_direct;  // largest mesh without levels, where M is A^-1 itself [vertices]
  bool folded;               // prolongation with smoothing folded in, for a GPU
};

// The table's arrays as vectors.
struct MultilevelTables {
  using real = double;
#define X(name, type, width, rows, meaning) std::vector<type> name;
#include "views/multilevel.def"
#undef X
};

// Reports the fraction done to `progress` now and then. The result has the same bits for any number of threads.
MultilevelTables build_multilevel(const MultilevelScene& scene, int threads,
                                  const std::function<void(double)>& progress);

}  // namespace pd
