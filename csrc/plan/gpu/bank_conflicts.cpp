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
  // 1 if one more lane with this corner in this bank costs a pass, else 0
  int cost(int corner, int bank) const { return longest_[corner][bank]; }

  void add(const Pair& pair) {
    for (int c = 0; c < 5; ++c) {
      const int bank = pair.corner[c] % banks, passes = ++lanes_[c][bank];
      if (passes < passes_[c]) continue;
      if (passes > passes_[c]) longest_[c] = {};
      passes_[c] = passes;
      longest_[c][bank] = 1;
    }
  }

 private:
  std::array<std::array<std::uint8_t, banks>, 5> longest_ =
      {};  // 1: takes most passes of the corner
  int lanes_[5][banks] = {}, passes_[5] = {};
};

constexpr std::array<std::array<std::uint8_t, 3>, 6> permutations = {
    {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {0, 2, 1}, {2, 1, 0}, {1, 0, 2}}};

// One order of a pair: a permutation of its common face, and which tetrahedron comes first.
struct PairOrder {
  int cost = never, permutation = 0;
  bool exchanged = false;
};

// The cheapest order, if it costs less than `limit`.
PairOrder best_order(const Phase& phase, const Candidate& candidate, int limit) {
  const auto& bank = candidate.bank;
  const int kept = phase.cost(3, bank[3]) + phase.cost(4, bank[4]);
  const int exchanged = candidate.single ? never : phase.cost(3, bank[4]) + phase.cost(4, bank[3]);
  const int apexes = std::min(kept, exchanged);
  PairOrder best = {limit, 0, false};
  for (int t = 0; t < int(permutations.size()) && best.cost > apexes; ++t) {
    const auto& permutation = permutations[t];
    const int cost = apexes + phase.cost(0, bank[permutation[0]]) +
                     phase.cost(1, bank[permutation[1]]) + phase.cost(2, bank[permutation[2]]);
    if (cost < best.cost) best = {cost, t, exchanged < kept};
  }
  return best;
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
  auto& half = written_[corner].half[lane / 16];
  auto& warp = written_[corner].warp;
  const auto entry_in = [&](int q) { return first_[slot] + entry_slice * row[q]; };
  const int most_half = *std::max_element(half.begin(), half.end());
  const int most_warp = *std::max_element(warp.begin(), warp.end());
  // additional passes, then conflicting lanes, then the rows that are left
  const auto cost = [&](int q) {
    const int e = entry_in(q), met_half = half[e % 16], met_warp = warp[e % 32];
    return std::array<int, 3>{(met_half == most_half) + (met_warp == most_warp),
                              met_half + met_warp, row[q] - forces_[slot]};
  };
  int best = -1;
  for (int q = 0; q < quarters; ++q) {
    if (row[q] < forces_[slot] && (best < 0 || cost(q) < cost(best))) best = q;
  }
  const std::int32_t entry = entry_in(best);
  row[best] += quarters;
  ++half[entry % 16];
  ++warp[entry % 32];
  return entry;
}

}  // namespace pd
