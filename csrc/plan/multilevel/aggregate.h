// Groups the vertices of a weighted graph into compact aggregates: Lloyd's method with distances along the graph.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

namespace pd {

// One undirected edge: how strongly it couples its ends, and how far apart they lie [m].
struct Coupling {
  std::int32_t a, b;
  double strength, distance;
};

// Neighbours and lengths of the edges; weak ones are long.
struct Graph {
  std::vector<std::int32_t> start, neighbour;
  std::vector<double> length;

  std::int32_t vertices() const { return std::int32_t(start.size()) - 1; }
};

// Lengths distance / clip(strength / q, 0.01, 1), q the upper quartile of all strengths.
Graph coupling_graph(std::int32_t vertices, const std::vector<Coupling>& couplings);

// Pieces of the graph that no edge joins, `left_out` not counted.
std::int32_t connected_pieces(const Graph& graph, const std::vector<std::uint8_t>& left_out);

// Aggregate of each vertex, -1 where `left_out`, and their count: about `wanted`, more where the graph falls into more
// pieces. Six sweeps: every vertex joins the centre that it is nearest to, then every centre moves to the vertex that lies
// deepest in its aggregate.
struct Aggregates {
  std::vector<std::int32_t> of;
  std::int32_t count = 0;
};

Aggregates aggregate(const Graph& graph, const std::vector<std::uint8_t>& left_out,
                     std::int32_t wanted);

using Positions = std::vector<std::array<double, 3>>;

// For a few aggregates: centres begin as far from one another as can be, and move to the middle of their aggregate in space,
// so that the aggregates part a body across.
Aggregates aggregate_far_apart(const Graph& graph, const std::vector<std::uint8_t>& left_out,
                               const Positions& position, std::int32_t wanted);

// How far each vertex is along the graph from the nearest of an aggregate, infinite where no way leads there.
std::vector<double> distances_to(const Graph& graph, const Aggregates& aggregates,
                                 std::int32_t aggregate);

}  // namespace pd
