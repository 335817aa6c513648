// The elements of a scene as the plans cut them: tetrahedra of solids, then stencils of other kinds.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace pd {

// Stencils of one kind, see elements/stencil.h; the arrays are the caller's.
struct StencilGroup {
  int kind = 0, corners = 0, dims = 0, constants = 0;
  int numbers = 0;          // of a step, for each stencil
  bool keeps_axes = false;  // stores g_a as they are
  std::int64_t count = 0;
  const std::int64_t* corner = nullptr;  // [count, corners]
  const double* gradient = nullptr;      // [count, corners, dims] g_a
  const double* measure = nullptr;       // [count] V
  const double* constant = nullptr;      // [count, constants]
  const std::int64_t* row = nullptr;     // [count] of the material; null: their own numbers
  bool large = false;                    // see elements/stencil.h
  bool quadratic = false;                // whether their energy is p[0] / 2 |F|^2
};

// Tetrahedra in groups that average their trace, see elements/corotated.h: a partition never cuts one.
struct TetGroups {
  std::vector<std::int32_t> tets;     // user's numbers, group by group, ascending in each
  std::vector<std::int64_t> corners;  // [4 tets] in that order
  std::vector<std::int64_t> start;    // first of each group, and the end; empty: each alone
  int members = 1;                   // places of every group: 1, 2 or 4; smaller ones are filled up
  std::vector<bool> traceless = {};  // [tets] whether a stencil has its volume energy

  bool is_empty() const { return start.empty(); }
  std::int64_t count() const { return std::ssize(start) - 1; }
  bool has_trace(std::int64_t tet) const { return is_empty() || !traceless[tet]; }
};

// From the number of each tetrahedron's group [count]; without a trace term where it is negative. Groups are in the order of their first tetrahedra. Throws
// std::invalid_argument for more than four in one.
TetGroups groups_of(const std::int64_t* group, const std::int64_t* tets, std::int64_t count);

struct MeshElements {
  const double* positions = nullptr;  // [vertices, 3] at rest
  std::int64_t vertices = 0;
  const std::int64_t* tets = nullptr;  // [tet_count, 4], of positive volume
  std::int64_t tet_count = 0;
  std::vector<StencilGroup> groups = {};  // in the order of elements/kinds.def
  TetGroups averaged = {};

  // elements of tetrahedra: groups, or each alone
  std::int64_t solids() const { return averaged.is_empty() ? tet_count : averaged.count(); }

  std::int64_t count() const {
    std::int64_t sum = solids();
    for (const StencilGroup& group : groups) sum += group.count;
    return sum;
  }

  // tetrahedra of a solid element
  int members(std::int64_t element) const {
    return averaged.is_empty() ? 1 : int(averaged.start[element + 1] - averaged.start[element]);
  }
  std::int32_t member(std::int64_t element, int which) const {
    return averaged.is_empty() ? std::int32_t(element)
                               : averaged.tets[averaged.start[element] + which];
  }

  std::array<std::int64_t, 4> tet(std::int64_t number) const {
    const std::int64_t* v = tets + 4 * number;
    return {v[0], v[1], v[2], v[3]};
  }

  // vertices of an element, repeated where tetrahedra of a group share them: solids are counted first, then the groups
  // of stencils
  std::span<const std::int64_t> corners(std::int64_t element) const {
    if (element < solids()) {
      if (averaged.is_empty()) return {tets + 4 * element, 4};
      return {averaged.corners.data() + 4 * averaged.start[element],
              std::size_t(4 * members(element))};
    }
    element -= solids();
    std::size_t g = 0;
    while (element >= groups[g].count) element -= groups[g++].count;
    return {groups[g].corner + element * groups[g].corners, std::size_t(groups[g].corners)};
  }
};

}  // namespace pd
