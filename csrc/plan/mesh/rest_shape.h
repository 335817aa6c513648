// Rest shape of one tetrahedron: what both plans store of it.
#pragma once

#include <array>
#include <cstdint>

namespace pd {

struct Rest {
  std::array<double, 9> inverse;  // Dm^-1, row by row: the shape gradients of corners 1 to 3
  double volume;                  // negative when the corners wind the other way
  double bound;                   // l_e
};

// `tet` holds four rows of `positions` [vertices, 3].
Rest rest_of(const double* positions, const std::array<std::int64_t, 4>& tet);

// Inverse rest matrices of one or two tetrahedra on a face, corners 0, 1 and 2, in the frame of elements/solid_pair.h: p, q and r of
// the face, then s, t and h of those with apexes 3 and 4 [1/m]. `vertex`: rows of `positions`.
template <std::size_t Corners>
std::array<double, 3 * (Corners - 2)> face_rest(const double* positions,
                                                const std::array<std::int64_t, Corners>& vertex);

// l_e of shape gradients: the largest eigenvalue of diag(K)^-1/2 K diag(K)^-1/2, K = grad N grad N^T.
double element_bound(const std::array<std::array<double, 3>, 4>& gradients);

}  // namespace pd
