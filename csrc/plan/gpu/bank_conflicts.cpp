#include "plan/gpu/bank_conflicts.h"

#include <algorithm>
#include <utility>

namespace pd {

namespace {

constexpr int banks = 8, phase_lanes = 8;
constexpr int never = 6;  // more than a lane can cost

struct Candidate {
  std::int32_t pair;
  std::array<std::uint8_t, 5> bank;
  bool single;
};

Candidate candidate_of(const std::vector<Pair>& pairs, std::size_t number) {
  Candidate result = {std::int32_t(number), {}, pairs[number].single()};
  for (int c = 0; c < 5; ++c) result.bank[c] = std::uint8_t(pairs[number].corner[c] % banks);
  return result;
}

// A phase of eight lanes, being filled.
class Phase {
 public:
  // bit c: whether one more lane with corner c in this bank costs a pass
  unsigned costs(int bank) const { return costs_[bank]; }

  void add(const Pair& pair) {
    for (int c = 0; c < 5; ++c) {
      const int bank = pair.corner[c] % banks, passes = ++lanes_[c][bank];
      if (passes < passes_[c]) continue;
      if (passes > passes_[c]) {
        for (std::uint8_t& costs : costs_) costs &= std::uint8_t(~(1u << c));
      }
      passes_[c] = passes;
      costs_[bank] |= std::uint8_t(1u << c);
    }
  }

 private:
  std::array<std::uint8_t, banks> costs_ = {};
  int lanes_[5][banks] = {}, passes_[5] = {};
};

constexpr std::array<std::array<std::uint8_t, 3>, 6> permutations = {
    {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {0, 2, 1}, {2, 1, 0}, {1, 0, 2}}};

// One order of a pair: a permutation of its common face, and which tetrahedron comes first.
struct PairOrder {
  int cost = never, permutation = 0;
  bool exchanged = false;
};

// The cheapest permutation for all costs of a face: bits 3 v + c for its vertex v as corner c.
constexpr auto face_orders = [] {
  std::array<PairOrder, 512> best;
  for (unsigned costs = 0; costs < best.size(); ++costs) {
    for (int t = 0; t < int(permutations.size()); ++t) {
      int cost = 0;
      for (int c = 0; c < 3; ++c) cost += int(costs >> (3 * permutations[t][c] + c) & 1);
      if (cost < best[costs].cost) best[costs] = {cost, t, false};
    }
  }
  return best;
}();

// The cheapest order, if it costs less than `limit`.
PairOrder best_order(const Phase& phase, const Candidate& candidate, int limit) {
  const auto& bank = candidate.bank;
  const auto apex = [&](int place, int corner) {
    return int(phase.costs(bank[place]) >> corner & 1);
  };
  const int kept = apex(3, 3) + apex(4, 4);
  const int exchanged = candidate.single ? never : apex(4, 3) + apex(3, 4);
  const auto face = [&](int place) { return phase.costs(bank[place]) & 7; };
  const PairOrder& order = face_orders[face(0) | face(1) << 3 | face(2) << 6];
  const int cost = std::min(kept, exchanged) + order.cost;
  return cost < limit ? PairOrder{cost, order.permutation, exchanged < kept} : PairOrder{limit};
}

Pair reordered(const Pair& pair, const PairOrder& order) {
  const auto& permutation = permutations[order.permutation];
  const auto& p = pair.corner;
  Pair result = {pair.tet, {p[permutation[0]], p[permutation[1]], p[permutation[2]], p[3], p[4]}};
  if (order.exchanged) {
    std::swap(result.tet[0], result.tet[1]);
    std::swap(result.corner[3], result.corner[4]);
  }
  return result;
}

}  // namespace

void reduce_bank_conflicts(std::vector<Pair>& pairs) {
  std::vector<Candidate> waiting;
  std::vector<Pair> ordered;
  for (std::size_t i = 0; i < pairs.size(); ++i) waiting.push_back(candidate_of(pairs, i));
  ordered.reserve(pairs.size());
  Phase phase;
  while (!waiting.empty()) {
    if (ordered.size() % phase_lanes == 0) phase = {};
    PairOrder best;
    std::size_t chosen = 0;
    for (std::size_t i = 0; i < waiting.size() && best.cost > 0; ++i) {
      const PairOrder order = best_order(phase, waiting[i], best.cost);
      if (order.cost == best.cost) continue;
      best = order;
      chosen = i;
    }
    ordered.push_back(reordered(pairs[waiting[chosen].pair], best));
    phase.add(ordered.back());
    waiting[chosen] = waiting.back();
    waiting.pop_back();
  }
  pairs = std::move(ordered);
}

void reduce_bank_conflicts(std::vector<Pair>& pairs, std::int64_t coupled) {
  std::vector<Pair> ordered, others(pairs.begin() + coupled, pairs.end());
  std::vector<std::size_t> waiting;  // first pair of each couple
  for (std::int64_t i = 0; i < coupled; i += 2) waiting.push_back(std::size_t(i));
  Phase phase;
  const auto place = [&](std::size_t number, const PairOrder& order) {
    if (ordered.size() % phase_lanes == 0) phase = {};
    ordered.push_back(reordered(pairs[number], order));
    phase.add(ordered.back());
  };
  while (!waiting.empty()) {
    if (ordered.size() % phase_lanes == 0) phase = {};
    PairOrder best;
    std::size_t chosen = 0;
    for (std::size_t i = 0; i < waiting.size() && best.cost > 0; ++i) {
      const PairOrder order = best_order(phase, candidate_of(pairs, waiting[i]), best.cost);
      if (order.cost == best.cost) continue;
      best = order;
      chosen = i;
    }
    const std::size_t first = waiting[chosen];
    waiting[chosen] = waiting.back();
    waiting.pop_back();
    place(first, best);
    place(first + 1, best_order(phase, candidate_of(pairs, first + 1), never));
  }
  reduce_bank_conflicts(others);
  ordered.insert(ordered.end(), others.begin(), others.end());
  pairs = std::move(ordered);
}

std::int64_t SliceBanks::next(std::int64_t entry) {
  if (count_ == 0) taken_ = {};
  const auto quarter = [&] { return int(entry / entry_slice % 4); };
  const auto fits = [&] {
    return !taken_[quarter()] && (count_ % 2 == 0 || (quarter() - last_) % 2 != 0);
  };
  while (!fits()) entry += entry_slice;
  last_ = quarter();
  taken_[last_] = true;
  count_ = (count_ + 1) % 4;
  return entry;
}

EntryChoice::EntryChoice(const std::vector<std::int32_t>& first,
                         const std::vector<std::int32_t>& forces, bool spread)
    : first_(first), forces_(forces), spread_(spread), row_(first.size(), {0, 1, 2, 3}) {}

std::int32_t EntryChoice::take(int corner, int lane, std::int32_t slot) {
  std::array<std::int32_t, quarters>& row = row_[slot];
  if (!spread_) return first_[slot] + entry_slice * row[0]++;
  if (lane == 0 && corner == 0) written_ = {};
  Written& written = written_[corner];
  auto& half = written.half[lane / 16];
  auto& most_half = written.most_half[lane / 16];
  const auto entry_in = [&](int q) { return first_[slot] + entry_slice * row[q]; };
  // additional passes, then conflicting lanes, then the rows that are left
  const auto cost = [&](int q) {
    const int e = entry_in(q), met_half = half[e % 16], met_warp = written.warp[e % 32];
    const int passes = (met_half == most_half) + (met_warp == written.most_warp);
    return std::int64_t(passes) << 48 | std::int64_t(met_half + met_warp) << 32 | row[q];
  };
  int best = -1;
  std::int64_t least = 0;
  for (int q = 0; q < quarters; ++q) {
    if (row[q] >= forces_[slot]) continue;
    const std::int64_t own = cost(q);
    if (best >= 0 && own >= least) continue;
    best = q;
    least = own;
  }
  const std::int32_t entry = entry_in(best);
  row[best] += quarters;
  most_half = std::max(most_half, ++half[entry % 16]);
  written.most_warp = std::max(written.most_warp, ++written.warp[entry % 32]);
  return entry;
}

}  // namespace pd
