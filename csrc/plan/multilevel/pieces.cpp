#include "plan/multilevel/pieces.h"

#include "solver/multilevel/pieces.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace pd {

namespace {

constexpr int blend_sweeps = 2;
constexpr double blend_damping = 2.0 / 3.0;  // of the Jacobi sweeps
constexpr double least_share =
    0.1;  // smaller ones would make more elements bend, and save no iterations

using Share = std::pair<std::int32_t, double>;  // of a piece in the motion of a vertex

// Rows of shares, one for each vertex.
struct Shares {
  std::vector<std::int64_t> start{0};
  std::vector<Share> entry;

  void end_row() { start.push_back(std::int64_t(entry.size())); }
};

Shares one_each(const Aggregates& groups) {
  Shares shares;
  for (const std::int32_t group : groups.of) {
    if (group >= 0) shares.entry.emplace_back(group, 1.0);
    shares.end_row();
  }
  return shares;
}

// W - omega D^-1 E W with the elastic part E of A, without negative shares, scaled to a sum of one
Shares blended(const Shares& before, const FineMatrix& fine, const std::vector<double>& inertia,
               std::int32_t pieces) {
  const BlockMatrix& a = fine.matrix;
  Shares after;
  std::vector<double> sum(pieces, 0.0);
  std::vector<std::int32_t> found;
  for (std::int32_t i = 0; i < a.rows; ++i) {
    found.clear();
    double own = 0;  // of the elastic diagonal
    const auto add = [&](std::int32_t vertex, double factor) {
      for (std::int64_t e = before.start[vertex]; e < before.start[vertex + 1]; ++e) {
        const auto& [piece, share] = before.entry[e];
        if (std::find(found.begin(), found.end(), piece) == found.end()) {
          found.push_back(piece);
          sum[piece] = 0;
        }
        sum[piece] += factor * share;
      }
    };
    for (std::int32_t p = a.start[i]; p < a.start[i + 1]; ++p) {
      const bool diagonal = a.column[p] == i;
      const double value = a.value[p] - (diagonal ? inertia[i] : 0);
      if (diagonal) own = value;
      add(a.column[p], value);
    }
    const double step = own > 0 ? blend_damping / own : 0;
    for (const std::int32_t piece : found) sum[piece] *= -step;
    add(i, 1);
    double total = 0;
    for (const std::int32_t piece : found) total += std::max(sum[piece], 0.0);
    std::sort(found.begin(), found.end());
    for (const std::int32_t piece : found) {
      if (sum[piece] > 0) after.entry.emplace_back(piece, sum[piece] / total);
    }
    after.end_row();
  }
  return after;
}

}  // namespace

Aggregates limited(Aggregates groups, std::int32_t most) {
  if (groups.count <= most) return groups;
  for (std::int32_t& g : groups.of)
    g = g < 0 ? g : std::int32_t(std::int64_t(g) * most / groups.count);
  groups.count = most;
  return groups;
}

Pieces cut_pieces(const FineMatrix& fine, const Graph& graph, const std::vector<double>& inertia,
                  int threads) {
  const auto free = double(std::count(fine.held.begin(), fine.held.end(), 0));
  const auto wanted =
      std::int32_t(std::clamp(std::round(2 * std::cbrt(free)), 1.0, double(most_pieces)));
  const Aggregates groups =
      limited(aggregate(graph, fine.held, wanted, most_pieces, threads), most_pieces);
  Shares shares = one_each(groups);
  for (int sweep = 0; sweep < blend_sweeps; ++sweep)
    shares = blended(shares, fine, inertia, groups.count);
  const std::size_t places = groups.of.size() * pieces_of_vertex;
  Pieces pieces{std::vector<std::int32_t>(places, 0), std::vector<double>(places, 0.0),
                groups.count};
  for (std::size_t i = 0; i < groups.of.size(); ++i) {
    std::vector<Share> row(shares.entry.begin() + shares.start[i],
                           shares.entry.begin() + shares.start[i + 1]);
    std::stable_sort(row.begin(), row.end(),
                     [](const Share& a, const Share& b) { return a.second > b.second; });
    while (row.size() > 1 && (row.size() > pieces_of_vertex || row.back().second < least_share))
      row.pop_back();
    double sum = 0;
    for (const auto& [piece, share] : row) sum += share;
    for (std::size_t k = 0; k < row.size(); ++k) {
      pieces.of[i * pieces_of_vertex + k] = row[k].first;
      pieces.weight[i * pieces_of_vertex + k] = row[k].second / sum;
    }
  }
  return pieces;
}

}  // namespace pd
