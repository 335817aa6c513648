#include "plan/gpu/pairing.h"

#include <algorithm>
#include <bit>
#include <cstddef>
#include <iterator>
#include <stdexcept>
#include <string>

namespace pd {

namespace {

int place_of(const Corners& corners, std::int32_t wanted) {
  return int(std::find(corners.begin(), corners.end(), wanted) - corners.begin());
}

// For every tetrahedron, the neighbour across the face opposite each corner, -1: none.
std::vector<Corners> face_neighbours(const std::vector<Corners>& tets) {
  struct Face {
    std::uint64_t key = 0;
    std::int32_t tet = -1, corner = 0;
  };
  const std::size_t size = std::bit_ceil(4 * tets.size() + 1);
  const int shift = 64 - std::countr_zero(size);
  std::vector<Face> table(size);
  std::vector<Corners> neighbour(tets.size(), {-1, -1, -1, -1});
  for (std::int32_t t = 0; t < std::int32_t(tets.size()); ++t) {
    Corners v = tets[t];
    std::sort(v.begin(), v.end());
    for (std::int32_t k = 0; k < 4; ++k) {
      const auto at = [&](int i) { return std::uint64_t(v[i + (i >= k)]); };
      const std::uint64_t key = (at(0) << 42 | at(1) << 21 | at(2)) + 1;  // 0: an empty place
      std::size_t place = key * 0x9e3779b97f4a7c15u >> shift;
      while (table[place].key != 0 && table[place].key != key) place = (place + 1) & (size - 1);
      Face& face = table[place];
      const std::int32_t corner = place_of(tets[t], v[k]);
      if (face.tet < 0) {
        face = {key, t, corner};
      } else {
        neighbour[t][corner] = face.tet;
        neighbour[face.tet][face.corner] = t;
        face.tet = -1;
      }
    }
  }
  return neighbour;
}

// A matching of neighbours: the partner of every tetrahedron, -1: none. The tetrahedron with the fewest free
// neighbours chooses first, and takes the neighbour with the fewest. Less than one in a hundred stays single.
std::vector<std::int32_t> match(const std::vector<Corners>& neighbour) {
  std::vector<std::int32_t> partner(neighbour.size(), -1), free(neighbour.size());
  // by number of free neighbours; one that has lost a neighbour is queued again
  std::array<std::vector<std::int32_t>, 5> waiting;
  for (std::int32_t t = std::int32_t(free.size()) - 1; t >= 0; --t) {
    free[t] = 4 - std::int32_t(std::count(neighbour[t].begin(), neighbour[t].end(), -1));
    waiting[free[t]].push_back(t);
  }
  for (std::int32_t fewest = 1; fewest <= 4;) {
    if (waiting[fewest].empty()) {
      ++fewest;
      continue;
    }
    const std::int32_t t = waiting[fewest].back();
    waiting[fewest].pop_back();
    if (partner[t] >= 0 || free[t] != fewest) continue;
    std::int32_t best = -1;
    for (const std::int32_t u : neighbour[t]) {
      if (u >= 0 && partner[u] < 0 && (best < 0 || free[u] < free[best])) best = u;
    }
    partner[t] = best;
    partner[best] = t;
    for (const std::int32_t taken : {t, best}) {
      for (const std::int32_t u : neighbour[taken]) {
        if (u < 0 || partner[u] >= 0) continue;
        waiting[--free[u]].push_back(u);
        fewest = std::clamp(free[u], 1, fewest);
      }
    }
  }
  return partner;
}

// The corner of a tetrahedron that the other lacks, if they share the other three; else -1.
int corner_off(const Corners& one, const Corners& other) {
  int found = -1, missing = 0;
  for (int k = 0; k < 4; ++k) {
    if (place_of(other, one[k]) < 4) continue;
    found = k;
    ++missing;
  }
  return missing == 1 ? found : -1;
}

Pair single_pair(const std::vector<Corners>& tets, std::int32_t t) {
  const Corners& v = tets[t];
  return {{t, -1}, {v[0], v[1], v[2], v[3], v[3]}};
}

// Two tetrahedra that share the face opposite corner k of the first.
Pair pair_across(const std::vector<Corners>& tets, std::int32_t t, int k, std::int32_t partner) {
  const Corners& v = tets[t];
  const std::int32_t apex = tets[partner][corner_off(tets[partner], v)];
  return {{t, partner}, {v[(k + 1) % 4], v[(k + 2) % 4], v[(k + 3) % 4], v[k], apex}};
}

// Adds pairs of all members of a group, one of which is single where their number is odd; false if there are none.
bool pair_up(const std::vector<Corners>& tets, const std::vector<std::int32_t>& members,
             std::vector<Pair>& pairs) {
  if (members.empty()) return true;
  const std::int32_t t = members[0];
  for (std::size_t i = 1; i < members.size(); ++i) {
    const int k = corner_off(tets[t], tets[members[i]]);
    if (k < 0) continue;
    std::vector<std::int32_t> rest(members.begin() + 1, members.end());
    rest.erase(rest.begin() + std::ptrdiff_t(i) - 1);
    pairs.push_back(pair_across(tets, t, k, members[i]));
    if (pair_up(tets, rest, pairs)) return true;
    pairs.pop_back();
  }
  if (members.size() % 2 == 0) return false;
  pairs.push_back(single_pair(tets, t));
  if (pair_up(tets, {members.begin() + 1, members.end()}, pairs)) return true;
  pairs.pop_back();
  return false;
}

}  // namespace

std::vector<Pair> pair_groups(const std::vector<Corners>& tets, const std::vector<int>& sizes,
                              std::int64_t& coupled) {
  std::vector<Pair> couples, others, own;
  std::int32_t first = 0;
  for (const int size : sizes) {
    std::vector<std::int32_t> members(size);
    for (int m = 0; m < size; ++m) members[m] = first + m;
    first += size;
    own.clear();
    if (!pair_up(tets, members, own))
      throw std::invalid_argument(
          "a GPU averages the trace over groups of tetrahedra that form one or two pairs with a "
          "common face each, and a group of " +
          std::to_string(size) + " does not; give Solid(averaging=) other groups, or 1, 2 or 4");
    std::vector<Pair>& to = own.size() == 2 ? couples : others;
    to.insert(to.end(), own.begin(), own.end());
  }
  coupled = std::ssize(couples);
  couples.insert(couples.end(), others.begin(), others.end());
  return couples;
}

std::vector<Pair> pair_tets(const std::vector<Corners>& tets) {
  const std::vector<Corners> neighbour = face_neighbours(tets);
  const std::vector<std::int32_t> partners = match(neighbour);
  std::vector<Pair> pairs;
  pairs.reserve(tets.size() / 2 + 1);
  for (std::int32_t t = 0; t < std::int32_t(tets.size()); ++t) {
    const Corners& v = tets[t];
    const std::int32_t partner = partners[t];
    if (partner < 0) {
      pairs.push_back({{t, -1}, {v[0], v[1], v[2], v[3], v[3]}});
    } else if (t < partner) {
      const int k = place_of(neighbour[t], partner);
      const std::int32_t apex = tets[partner][place_of(neighbour[partner], t)];
      pairs.push_back({{t, partner}, {v[(k + 1) % 4], v[(k + 2) % 4], v[(k + 3) % 4], v[k], apex}});
    }
  }
  return pairs;
}

}  // namespace pd
