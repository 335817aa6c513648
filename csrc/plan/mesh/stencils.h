// What a plan stores of the constant vectors g_a of a stencil.
#pragma once

#include "plan/mesh/elements.h"

#include <cstdint>
#include <vector>

namespace pd {

// Numbers of the vectors g_a of a stencil, see elements/stencil.h.
int stored_gradient_numbers(const StencilGroup& group);

// Those numbers of stencil `s`: the vectors after a rotation of R^d, so that column j of F needs the first n - d + j
// edges alone.
std::vector<double> stored_gradients(const StencilGroup& group, std::int64_t s);

// l_e of stencil `s`, see element_bound.
double stencil_bound(const StencilGroup& group, std::int64_t s);

}  // namespace pd
