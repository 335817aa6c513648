// Joins the tetrahedra of a patch into pairs that share a face: five vertices instead of eight.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

namespace pd {

using Corners = std::array<std::int32_t, 4>;

// Tetrahedra (p0, p1, p2, p3) and (p0, p1, p2, p4). A single tetrahedron has tet[1] = -1 and p4 = p3.
struct Pair {
  std::array<std::int32_t, 2> tet;
  std::array<std::int32_t, 5> corner;

  bool single() const { return tet[1] < 0; }
  int corners() const { return single() ? 4 : 5; }
};

// Pairs tetrahedra in groups that average their trace: those of one patch, group by group, each of `sizes` members.
// Pairs of the groups of more than two come first, two by two; `coupled` counts them. Throws std::invalid_argument for
// a group whose tetrahedra do not form pairs that share a face.
std::vector<Pair> pair_groups(const std::vector<Corners>& tets, const std::vector<int>& sizes,
                              std::int64_t& coupled);

// Pairs the `tets` of one patch, with vertices numbered below 2^21; `tet` of the pairs counts in their order.
std::vector<Pair> pair_tets(const std::vector<Corners>& tets);

}  // namespace pd
