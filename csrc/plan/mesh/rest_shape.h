// Rest shape of one tetrahedron, as both plans store it.
#pragma once

#include <array>
#include <cstdint>
#include <span>

namespace pd {

struct RestShape {
  std::array<double, 9> inverse;  // Dm^-1, row by row: the shape gradients of corners 1 to 3
  double volume;                  // negative for inverted winding of the corners

  // of all four corners
  std::array<std::array<double, 3>, 4> gradients() const;
};

// Rest shape of the four rows `tet` of `positions` [vertices, 3].
RestShape rest_shape(const double* positions, const std::array<std::int64_t, 4>& tet);

// l_e of as many tetrahedra at once, see element_bound.
constexpr std::size_t bound_lanes = 8;
std::array<double, bound_lanes> tet_bounds(const std::array<RestShape, bound_lanes>& shapes);

// Inverse rest matrices of one or two tetrahedra on the face of corners 0, 1 and 2, in the frame of
// elements/solid_pair.h. The numbers are p, q and r of the face, then s, t and h for each of the apexes 3 and 4 [1/m].
// `vertex`: rows of `positions`.
template <std::size_t Corners>
std::array<double, 3 * (Corners - 2)> face_rest(const double* positions,
                                                const std::array<std::int64_t, Corners>& vertex);

// l_e from shape gradients: the largest eigenvalue of diag(K)^-1/2 K diag(K)^-1/2, K = grad N grad N^T. Gradients of
// zero, of corners without a share, count nothing.
double element_bound(std::span<const std::array<double, 3>> gradients);

}  // namespace pd
