#include "plan/mesh/elements.h"

#include <algorithm>
#include <numeric>
#include <stdexcept>
#include <string>
#include <unordered_map>

namespace pd {

namespace {

constexpr std::int64_t most_members = 4;

void check_size(std::int64_t group, std::int64_t members) {
  if (members > most_members)
    throw std::invalid_argument("a group that averages its trace may have up to " +
                                std::to_string(most_members) + " tetrahedra, got " +
                                std::to_string(members) + " in group " + std::to_string(group));
}

}  // namespace

TetGroups groups_of(const std::int64_t* group, const std::int64_t* tets, std::int64_t count) {
  std::unordered_map<std::int64_t, std::int64_t> place;  // of each group, by first appearance
  std::vector<std::int64_t> size, number(count);
  for (std::int64_t t = 0; t < count; ++t) {
    if (group[t] < 0) {
      number[t] = std::ssize(size);
      size.push_back(1);
      continue;
    }
    const auto [found, is_new] = place.try_emplace(group[t], std::ssize(size));
    if (is_new) size.push_back(0);
    number[t] = found->second;
    check_size(group[t], ++size[found->second]);
  }
  TetGroups groups;
  for (std::int64_t t = 0; t < count; ++t) groups.traceless.push_back(group[t] < 0);
  groups.tets.resize(count);
  groups.corners.resize(4 * count);
  groups.start.resize(size.size() + 1);
  std::partial_sum(size.begin(), size.end(), groups.start.begin() + 1);
  std::vector<std::int64_t> next(groups.start.begin(), groups.start.end() - 1);
  for (std::int64_t t = 0; t < count; ++t) {
    const std::int64_t to = next[number[t]]++;
    groups.tets[to] = std::int32_t(t);
    std::copy_n(tets + 4 * t, 4, groups.corners.begin() + 4 * to);
  }
  const std::int64_t largest = *std::max_element(size.begin(), size.end());
  groups.members = largest > 2 ? 4 : int(largest);
  return groups;
}

}  // namespace pd
