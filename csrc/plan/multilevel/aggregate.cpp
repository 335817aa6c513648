#include "plan/multilevel/aggregate.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <queue>
#include <utility>

namespace pd {

namespace {

constexpr int sweeps = 6;
constexpr double weakest =
    0.01;  // clip of the relative strength: an edge is at most 100 times its distance long
constexpr double never = std::numeric_limits<double>::infinity();

// Dijkstra's method from any number of sources. Ties go to the lower number, so that all platforms agree.
class Fronts {
 public:
  explicit Fronts(const Graph& graph) : graph_(graph) { clear(); }

  void clear() {
    distance.assign(graph_.vertices(), never);
    label.assign(graph_.vertices(), -1);
  }

  void add_source(std::int32_t vertex, std::int32_t its_label) {
    distance[vertex] = 0;
    label[vertex] = its_label;
    queue_.emplace(0.0, vertex);
  }

  // `may_cross(a, b)`: whether the front may pass from a to b
  template <class MayCross>
  void advance(MayCross may_cross) {
    while (!queue_.empty()) {
      const auto [d, v] = queue_.top();
      queue_.pop();
      if (d > distance[v]) continue;
      for (std::int32_t e = graph_.start[v]; e < graph_.start[v + 1]; ++e) {
        const std::int32_t u = graph_.neighbour[e];
        const double there = d + graph_.length[e];
        if (!(there < distance[u]) || !may_cross(v, u)) continue;
        distance[u] = there;
        label[u] = label[v];
        queue_.emplace(there, u);
      }
    }
  }

  std::vector<double> distance;
  std::vector<std::int32_t> label;

 private:
  using Item = std::pair<double, std::int32_t>;
  const Graph& graph_;
  std::priority_queue<Item, std::vector<Item>, std::greater<Item>> queue_;
};

// Assigns every vertex to the nearest centre; a component without a centre gets one.
void join_nearest(Fronts& fronts, std::vector<std::int32_t>& centres,
                  const std::vector<std::uint8_t>& left_out) {
  const auto anywhere = [](std::int32_t, std::int32_t) { return true; };
  fronts.clear();
  for (std::size_t i = 0; i < centres.size(); ++i) fronts.add_source(centres[i], std::int32_t(i));
  fronts.advance(anywhere);
  for (std::size_t v = 0; v < left_out.size(); ++v) {
    if (left_out[v] || fronts.label[v] >= 0) continue;
    fronts.add_source(std::int32_t(v), std::int32_t(centres.size()));
    centres.push_back(std::int32_t(v));
    fronts.advance(anywhere);
  }
}

// Moves each centre to the vertex farthest from the border of its aggregate; without a border it stays.
void centre(const Graph& graph, const std::vector<std::int32_t>& label, Fronts& depth,
            std::vector<std::int32_t>& centres) {
  depth.clear();
  for (std::int32_t v = 0; v < graph.vertices(); ++v) {
    const auto first = graph.neighbour.begin() + graph.start[v],
               end = graph.neighbour.begin() + graph.start[v + 1];
    if (std::any_of(first, end, [&](std::int32_t u) { return label[u] != label[v]; }))
      depth.add_source(v, label[v]);
  }
  depth.advance([&](std::int32_t a, std::int32_t b) { return label[a] == label[b]; });
  std::vector<double> deepest(centres.size(), -1.0);
  for (std::int32_t v = 0; v < graph.vertices(); ++v) {
    const std::int32_t l = label[v];
    if (l < 0 || depth.distance[v] == never || !(depth.distance[v] > deepest[l])) continue;
    deepest[l] = depth.distance[v];
    centres[l] = v;
  }
}

// Moves each centre to the vertex nearest to the centroid of its aggregate.
void centre_in_space(const Positions& position, const std::vector<std::int32_t>& label,
                     std::vector<std::int32_t>& centres) {
  std::vector<std::array<double, 4>> sum(centres.size(), {0, 0, 0, 0});
  for (std::size_t v = 0; v < label.size(); ++v) {
    if (label[v] < 0) continue;
    for (int c = 0; c < 3; ++c) sum[label[v]][c] += position[v][c];
    ++sum[label[v]][3];
  }
  std::vector<double> least(centres.size(), never);
  for (std::size_t v = 0; v < label.size(); ++v) {
    if (label[v] < 0) continue;
    double square = 0;
    for (int c = 0; c < 3; ++c) {
      const double side = position[v][c] - sum[label[v]][c] / sum[label[v]][3];
      square += side * side;
    }
    if (!(square < least[label[v]])) continue;
    least[label[v]] = square;
    centres[label[v]] = std::int32_t(v);
  }
}

}  // namespace

Graph coupling_graph(std::int32_t vertices, const std::vector<Coupling>& couplings) {
  std::vector<double> strengths;
  for (const Coupling& c : couplings) strengths.push_back(c.strength);
  double quartile = 1;
  if (!strengths.empty()) {
    const auto at = strengths.begin() + std::ptrdiff_t(3 * strengths.size() / 4);
    std::nth_element(strengths.begin(), at, strengths.end());
    quartile = *at > 0 ? *at : 1;
  }
  Graph graph;
  graph.start.assign(vertices + 1, 0);
  for (const Coupling& c : couplings) {
    ++graph.start[c.a + 1];
    ++graph.start[c.b + 1];
  }
  std::partial_sum(graph.start.begin(), graph.start.end(), graph.start.begin());
  graph.neighbour.resize(2 * couplings.size());
  graph.length.resize(2 * couplings.size());
  std::vector<std::int32_t> next(graph.start.begin(), graph.start.end() - 1);
  for (const Coupling& c : couplings) {
    const double length = c.distance / std::clamp(c.strength / quartile, weakest, 1.0);
    for (const auto& [from, to] : {std::pair{c.a, c.b}, std::pair{c.b, c.a}}) {
      graph.neighbour[next[from]] = to;
      graph.length[next[from]++] = length;
    }
  }
  return graph;
}

std::int32_t connected_components(const Graph& graph, const std::vector<std::uint8_t>& left_out) {
  Fronts fronts(graph);
  std::vector<std::int32_t> centres;
  join_nearest(fronts, centres, left_out);
  return std::int32_t(centres.size());
}

Aggregates aggregate(const Graph& graph, const std::vector<std::uint8_t>& left_out,
                     std::int32_t wanted) {
  // neighbours in space have near numbers, so spacing the numbers spaces the centres
  std::vector<std::int32_t> candidates, centres;
  for (std::int32_t v = 0; v < graph.vertices(); ++v) {
    if (!left_out[v]) candidates.push_back(v);
  }
  const std::int64_t count = std::min<std::int64_t>(wanted, std::ssize(candidates));
  for (std::int64_t i = 0; i < count; ++i)
    centres.push_back(candidates[std::ssize(candidates) * (2 * i + 1) / (2 * count)]);
  Fronts fronts(graph), depth(graph);
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    join_nearest(fronts, centres, left_out);
    if (sweep + 1 < sweeps) centre(graph, fronts.label, depth, centres);
  }
  return {std::move(fronts.label), std::int32_t(centres.size())};
}

Aggregates aggregate_far_apart(const Graph& graph, const std::vector<std::uint8_t>& left_out,
                               const Positions& position, std::int32_t wanted) {
  std::vector<std::int32_t> centres;
  Fronts fronts(graph);
  const auto farthest = [&] {
    std::int32_t best = -1;
    for (std::int32_t v = 0; v < graph.vertices(); ++v) {
      if (!left_out[v] && (best < 0 || fronts.distance[v] > fronts.distance[best])) best = v;
    }
    return best;
  };
  const auto spread_from = [&](std::int32_t vertex) {
    fronts.add_source(vertex, 0);
    fronts.advance([](std::int32_t, std::int32_t) { return true; });
  };
  // start at a vertex on the rim
  if (const std::int32_t any = farthest(); any >= 0) {
    spread_from(any);
    const std::int32_t first = farthest();
    fronts.clear();
    centres.push_back(first);
    spread_from(first);
  }
  while (!centres.empty() && std::ssize(centres) < wanted) {
    const std::int32_t next = farthest();
    if (!(fronts.distance[next] > 0)) break;
    centres.push_back(next);
    spread_from(next);
  }
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    join_nearest(fronts, centres, left_out);
    if (sweep + 1 < sweeps) centre_in_space(position, fronts.label, centres);
  }
  return {std::move(fronts.label), std::int32_t(centres.size())};
}

std::vector<double> distances_to(const Graph& graph, const Aggregates& aggregates,
                                 std::int32_t aggregate) {
  Fronts fronts(graph);
  for (std::int32_t v = 0; v < graph.vertices(); ++v) {
    if (aggregates.of[v] == aggregate) fronts.add_source(v, aggregate);
  }
  fronts.advance([](std::int32_t, std::int32_t) { return true; });
  return std::move(fronts.distance);
}

}  // namespace pd
