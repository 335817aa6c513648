// Order of points for a recursive bisection.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace pd {

using Point = std::array<double, 3>;

// The axes by side length of the points' bounding box, longest first.
inline std::array<int, 3> axes_by_length(std::span<const std::int32_t> items,
                                         const std::vector<Point>& points) {
  Point low = points[items[0]], high = low;
  for (const std::int32_t i : items) {
    for (int c = 0; c < 3; ++c) {
      low[c] = std::min(low[c], points[i][c]);
      high[c] = std::max(high[c], points[i][c]);
    }
  }
  std::array<int, 3> axis = {0, 1, 2};
  std::stable_sort(axis.begin(), axis.end(),
                   [&](int a, int b) { return high[a] - low[a] > high[b] - low[b]; });
  return axis;
}

// Order along the first axis, then the others, then by number, so that all platforms make the same plan. A layer that
// is cut itself is thus cut across.
inline auto along(const std::array<int, 3>& axis, const std::vector<Point>& points) {
  return [&](std::int32_t a, std::int32_t b) {
    for (const int c : axis) {
      if (points[a][c] != points[b][c]) return points[a][c] < points[b][c];
    }
    return a < b;
  };
}

}  // namespace pd
