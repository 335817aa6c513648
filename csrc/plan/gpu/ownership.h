// Cuts a mesh into patches that share no vertex: the first half of a cluster's plan.
#pragma once

#include "plan/mesh/partition.h"

#include <cstdint>
#include <vector>

namespace pd {

// Each patch has every tetrahedron that touches one of its own vertices, so some tetrahedra are in several patches.
struct Ownership {
  Partition mesh;
  std::vector<std::int32_t> owner;  // patch of each vertex
};

// Recursive bisection of vertices across the axis that minimises the tetrahedra of the busier side. Its time grows
// like patches times tetrahedra. Up to `vertices` patches.
Ownership own_vertices(const double* positions, std::int64_t vertices, const std::int64_t* tets,
                       std::int64_t count, std::int64_t patches);

// All vertices lie inside the patch that owns them.
Numbering number_owned(const std::vector<std::int32_t>& owner, int patches);

}  // namespace pd
