#include "plan/gpu/pairing.h"

#include <algorithm>
#include <bit>

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

}  // namespace

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
