// Pieces of a scene for the coarse space of solver/multilevel/pieces.h.
#pragma once

#include "plan/multilevel/aggregate.h"
#include "plan/multilevel/fine_matrix.h"

#include <cstdint>
#include <vector>

namespace pd {

// The pieces that move each vertex, by falling weight. The weights of a vertex add up to one; they are zero in unused
// places and where a pin holds it.
struct Pieces {
  std::vector<std::int32_t> of;  // [vertices, pieces_of_vertex]
  std::vector<double> weight;    // [vertices, pieces_of_vertex]
  std::int32_t count = 0;
};

// Compact pieces by Lloyd's method on the coupling graph, 2 n^(1/3) for n free vertices. Jacobi sweeps on the elastic
// part of A smooth their weights, so that pieces bend into each other. `inertia`: of each vertex [N/m]
Pieces cut_pieces(const FineMatrix& fine, const Graph& graph, const std::vector<double>& inertia,
                  int threads);

// Aggregates joined by their numbers until there are at most so many.
Aggregates limited(Aggregates groups, std::int32_t most);

}  // namespace pd
