// Groups the vertices of a weighted graph into compact aggregates by Lloyd's method with distances along the graph.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace pd {

// One undirected edge: how strongly it couples its ends, and how far apart they lie [m].
struct Coupling {
  std::int32_t a, b;
  double strength, distance;
};

// The edges of each vertex; weak ones are long.
struct Graph {
  struct Edge {
    double length;
    std::int32_t neighbour;
    float distance;  // of its ends [m]
  };
  std::vector<std::int32_t> start;
  std::vector<Edge> edge;
  double longest = 0;

  std::span<const Edge> edges(std::int32_t vertex) const {
    return {edge.data() + start[vertex], edge.data() + start[vertex + 1]};
  }

  std::int32_t vertices() const { return std::int32_t(start.size()) - 1; }
};

// Lengths distance / clip(strength / q, 0.01, 1), q the upper quartile of all strengths.
Graph coupling_graph(std::int32_t vertices, const std::vector<Coupling>& couplings);

// Number of connected components of the graph without the vertices `left_out`.
std::int32_t connected_components(const Graph& graph, const std::vector<std::uint8_t>& left_out);

// Aggregate of each vertex, -1 where `left_out`, and their count.
struct Aggregates {
  std::vector<std::int32_t> of;
  std::int32_t count = 0;
};

// The vertices of each aggregate, ascending.
struct Members {
  std::vector<std::int32_t> start, vertex;

  std::span<const std::int32_t> of(std::int64_t aggregate) const {
    return {vertex.data() + start[aggregate], vertex.data() + start[aggregate + 1]};
  }
};

Members members_of(const Aggregates& groups);

// About `wanted` aggregates, more if the graph has more components. Six sweeps: every vertex joins the nearest centre,
// then every centre moves to the deepest vertex of its aggregate. Parts that weak edges cut off from every centre, such
// as stiff grains in soft surroundings, get centres of their own while there are less than `most`.
Aggregates aggregate(const Graph& graph, const std::vector<std::uint8_t>& left_out,
                     std::int32_t wanted, std::int32_t most, int threads);

}  // namespace pd
