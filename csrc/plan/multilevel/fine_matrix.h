// Assembles the constant matrix of projective dynamics, which the multilevel preconditioner approximates.
#pragma once

#include "plan/multilevel/block_matrix.h"
#include "plan/multilevel/build.h"

#include <cstdint>
#include <vector>

namespace pd {

using Mask = std::vector<std::uint8_t>;

// In internal numbers.
struct FineMatrix {
  BlockMatrix matrix;         // A, rows and columns of held vertices empty
  std::vector<double> bound;  // D, the weighted diagonal, 0 where held
  Mask held;                  // by a pin, exactly
};

FineMatrix assemble(const MultilevelScene& scene, int threads);

}  // namespace pd
