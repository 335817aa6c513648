// Order of points for a recursive bisection.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>

namespace pd {

using Point = std::array<double, 3>;

// A point with the number of what it stands for.
struct Numbered {
  Point point;
  std::int32_t number;
};

// The axes by side length of the points' bounding box, longest first.
inline std::array<int, 3> axes_by_length(std::span<const Numbered> items) {
  Point low = items[0].point, high = low;
  for (const Numbered& item : items) {
    for (int c = 0; c < 3; ++c) {
      low[c] = std::min(low[c], item.point[c]);
      high[c] = std::max(high[c], item.point[c]);
    }
  }
  std::array<int, 3> axis = {0, 1, 2};
  std::stable_sort(axis.begin(), axis.end(),
                   [&](int a, int b) { return high[a] - low[a] > high[b] - low[b]; });
  return axis;
}

// Order along the first axis, then the others, then by number, so that all platforms make the same plan. A layer that
// is cut itself is thus cut across.
inline auto along(const std::array<int, 3>& axis) {
  return [axis](const Numbered& a, const Numbered& b) {
    for (const int c : axis) {
      if (a.point[c] != b.point[c]) return a.point[c] < b.point[c];
    }
    return a.number < b.number;
  };
}

}  // namespace pd
