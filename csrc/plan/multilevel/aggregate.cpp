#include "plan/multilevel/aggregate.h"

#include "threads/team.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <numeric>
#include <queue>
#include <span>
#include <utility>

namespace pd {

namespace {

constexpr int sweeps = 6;
constexpr double weakest =
    0.01;  // clip of the relative strength: an edge is at most 100 times its distance long
// A vertex is cut off if it is so many times as far from its centre as half of the vertices would be by strong edges.
constexpr double cut_off_ratio = 3;
constexpr double never = std::numeric_limits<double>::infinity();

// A vertex at a distance. Ties go to the lower number, so that all platforms agree.
using Item = std::pair<double, std::int32_t>;

// A queue for Dijkstra's method: a ring of buckets of equal width, of which only the current one is in order. The ring
// is longer than the longest edge, so that no two widths meet in one bucket.
class Calendar {
 public:
  explicit Calendar(double longest)
      : bucket_(buckets), per_width_(longest > 0 ? (buckets - 2) / longest : 0) {}

  void push(const Item& item) {
    const std::int64_t number = number_of(item);
    number == current_ ? late_.push(item) : bucket_[number % buckets].push_back(item);
    ++count_;
  }

  // Takes the next item that `is_valid`; false if there is none. Whatever is pushed later is no nearer.
  template <class IsValid>
  bool pop(Item& item, IsValid is_valid) {
    while (count_ > 0) {
      if (next_ == sorted_.size() && late_.empty()) {
        open(is_valid);
        continue;
      }
      --count_;
      if (next_ < sorted_.size() && (late_.empty() || sorted_[next_] < late_.top())) {
        item = sorted_[next_++];
      } else {
        item = late_.top();
        late_.pop();
      }
      if (is_valid(item)) return true;
    }
    // the next source is at distance 0
    current_ = -1;
    return false;
  }

 private:
  static constexpr std::int64_t buckets = 1 << 12;

  std::int64_t number_of(const Item& item) const { return std::int64_t(item.first * per_width_); }

  template <class IsValid>
  void open(IsValid is_valid) {
    do ++current_;
    while (bucket_[current_ % buckets].empty());
    sorted_.clear();
    next_ = 0;
    std::vector<Item>& items = bucket_[current_ % buckets];
    count_ -= std::ssize(items);
    std::copy_if(items.begin(), items.end(), std::back_inserter(sorted_), is_valid);
    items.clear();
    count_ += std::ssize(sorted_);
    std::sort(sorted_.begin(), sorted_.end());
  }

  std::vector<std::vector<Item>> bucket_;
  std::vector<Item> sorted_;                                               // the current bucket
  std::size_t next_ = 0;                                                   // of them
  std::priority_queue<Item, std::vector<Item>, std::greater<Item>> late_;  // pushed since into it
  double per_width_;
  std::int64_t current_ = -1, count_ = 0;
};

// Dijkstra's method from any number of sources.
class Fronts {
 public:
  explicit Fronts(const Graph& graph) : graph_(graph), queue_(graph.longest) { clear(); }

  void clear() {
    distance.assign(graph_.vertices(), never);
    path.assign(graph_.vertices(), 0);
    label.assign(graph_.vertices(), -1);
  }

  void add_source(std::int32_t vertex, std::int32_t its_label) {
    distance[vertex] = path[vertex] = 0;
    label[vertex] = its_label;
    queue_.push({0.0, vertex});
  }

  void advance() {
    const auto is_valid = [&](const Item& item) { return item.first <= distance[item.second]; };
    for (Item item; queue_.pop(item, is_valid);) {
      const auto [d, v] = item;
      for (const auto& [length, u, apart] : graph_.edges(v)) {
        const double there = d + length;
        if (!(there < distance[u])) continue;
        distance[u] = there;
        path[u] = path[v] + apart;
        label[u] = label[v];
        queue_.push({there, u});
      }
    }
  }

  std::vector<double> distance, path;  // from the source; the same with all edges strong
  std::vector<std::int32_t> label;

 private:
  const Graph& graph_;
  Calendar queue_;
};

// Assigns every vertex to the nearest centre; a component without a centre gets one.
void join_nearest(Fronts& fronts, std::vector<std::int32_t>& centres,
                  const std::vector<std::uint8_t>& left_out) {
  fronts.clear();
  for (std::size_t i = 0; i < centres.size(); ++i) fronts.add_source(centres[i], std::int32_t(i));
  fronts.advance();
  for (std::size_t v = 0; v < left_out.size(); ++v) {
    if (left_out[v] || fronts.label[v] >= 0) continue;
    fronts.add_source(std::int32_t(v), std::int32_t(centres.size()));
    centres.push_back(std::int32_t(v));
    fronts.advance();
  }
}

// Gives centres to parts that are cut off, the farthest first, while there are less than `most`.
void join_cut_off(Fronts& fronts, std::vector<std::int32_t>& centres, std::int32_t most) {
  std::vector<double> path;
  for (std::size_t v = 0; v < fronts.label.size(); ++v) {
    if (fronts.path[v] > 0) path.push_back(fronts.path[v]);
  }
  if (path.empty()) return;
  const auto middle = path.begin() + std::ssize(path) / 2;
  std::nth_element(path.begin(), middle, path.end());
  const double farthest = cut_off_ratio * *middle;
  std::vector<Item> cut_off;
  for (std::size_t v = 0; v < fronts.label.size(); ++v) {
    const double d = fronts.distance[v];
    if (fronts.label[v] >= 0 && d > farthest) cut_off.emplace_back(-d, std::int32_t(v));
  }
  std::sort(cut_off.begin(), cut_off.end());
  for (const auto& [unused, v] : cut_off) {
    if (std::ssize(centres) >= most) return;
    if (!(fronts.distance[v] > farthest)) continue;
    fronts.add_source(v, std::int32_t(centres.size()));
    centres.push_back(v);
    fronts.advance();
  }
}

// The vertex of an aggregate farthest from its border; `otherwise` without a border. `distance` is infinite at its
// `members` before the call.
std::int32_t deepest(const Graph& graph, const std::vector<std::int32_t>& label,
                     std::span<const std::int32_t> members, std::vector<double>& distance,
                     std::int32_t otherwise) {
  const auto is_inside = [&](std::int32_t a, std::int32_t b) { return label[a] == label[b]; };
  std::priority_queue<Item, std::vector<Item>, std::greater<Item>> queue;
  for (const std::int32_t v : members) {
    if (std::ranges::all_of(graph.edges(v),
                            [&](const auto& e) { return is_inside(e.neighbour, v); }))
      continue;
    distance[v] = 0;
    queue.emplace(0.0, v);
  }
  while (!queue.empty()) {
    const auto [d, v] = queue.top();
    queue.pop();
    if (d > distance[v]) continue;
    for (const auto& [length, u, apart] : graph.edges(v)) {
      const double there = d + length;
      if (!is_inside(u, v) || !(there < distance[u])) continue;
      distance[u] = there;
      queue.emplace(there, u);
    }
  }
  double most = -1;
  for (const std::int32_t v : members) {
    if (distance[v] == never || !(distance[v] > most)) continue;
    most = distance[v];
    otherwise = v;
  }
  return otherwise;
}

// Moves each centre to the vertex farthest from the border of its aggregate; without a border it stays.
void centre(const Graph& graph, const std::vector<std::int32_t>& label,
            std::vector<std::int32_t>& centres, int threads) {
  const Members members = members_of({label, std::int32_t(centres.size())});
  std::vector<double> distance(label.size(), never);
  run_team(threads, [&](const Team& team) {
    for (std::int64_t i = team.begin(std::ssize(centres)); i < team.end(std::ssize(centres)); ++i)
      centres[i] = deepest(graph, label, members.of(i), distance, centres[i]);
  });
}

}  // namespace

Members members_of(const Aggregates& groups) {
  Members members{std::vector<std::int32_t>(groups.count + 1, 0), {}};
  for (const std::int32_t g : groups.of) {
    if (g >= 0) ++members.start[g + 1];
  }
  std::partial_sum(members.start.begin(), members.start.end(), members.start.begin());
  members.vertex.resize(members.start.back());
  std::vector<std::int32_t> next(members.start.begin(), members.start.end() - 1);
  for (std::size_t v = 0; v < groups.of.size(); ++v) {
    if (groups.of[v] >= 0) members.vertex[next[groups.of[v]]++] = std::int32_t(v);
  }
  return members;
}

Graph coupling_graph(std::int32_t vertices, const std::vector<Coupling>& couplings) {
  std::vector<double> strengths;
  strengths.reserve(couplings.size());
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
  graph.edge.resize(2 * couplings.size());
  std::vector<std::int32_t> next(graph.start.begin(), graph.start.end() - 1);
  for (const Coupling& c : couplings) {
    const double length = c.distance / std::clamp(c.strength / quartile, weakest, 1.0);
    graph.longest = std::max(graph.longest, length);
    graph.edge[next[c.a]++] = {length, c.b, float(c.distance)};
    graph.edge[next[c.b]++] = {length, c.a, float(c.distance)};
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
                     std::int32_t wanted, std::int32_t most, int threads) {
  // neighbours in space have near numbers, so spacing the numbers spaces the centres
  std::vector<std::int32_t> candidates, centres;
  for (std::int32_t v = 0; v < graph.vertices(); ++v) {
    if (!left_out[v]) candidates.push_back(v);
  }
  const std::int64_t count = std::min<std::int64_t>(wanted, std::ssize(candidates));
  for (std::int64_t i = 0; i < count; ++i)
    centres.push_back(candidates[std::ssize(candidates) * (2 * i + 1) / (2 * count)]);
  Fronts fronts(graph);
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    join_nearest(fronts, centres, left_out);
    // by then the aggregates are even
    if (sweep + 2 == sweeps) join_cut_off(fronts, centres, most);
    if (sweep + 1 < sweeps) centre(graph, fronts.label, centres, threads);
  }
  return {std::move(fronts.label), std::int32_t(centres.size())};
}

}  // namespace pd
