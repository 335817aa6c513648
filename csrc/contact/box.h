// Axis-aligned boxes, one by one and 32 side by side.
#pragma once
#include "math/vec.h"

namespace pd::inline PD_TARGET {

template <class T>
struct Box {
  Vec3<T> low, high;

  PD_HD void add(const Vec3<T>& p) { add(Box{p, p}); }
  PD_HD void add(const Box& other) {
    low = {lesser(low.x, other.low.x), lesser(low.y, other.low.y), lesser(low.z, other.low.z)};
    high = {larger(high.x, other.high.x), larger(high.y, other.high.y),
            larger(high.z, other.high.z)};
  }
  PD_HD Box widened(T by) const {
    return {{low.x - by, low.y - by, low.z - by}, {high.x + by, high.y + by, high.z + by}};
  }
  PD_HD bool meets(const Box& other) const {
    return (low.x <= other.high.x) & (other.low.x <= high.x) & (low.y <= other.high.y) &
           (other.low.y <= high.y) & (low.z <= other.high.z) & (other.low.z <= high.z);
  }
  PD_HD static Box none() {
    const T far(HUGE_VAL);
    return {{far, far, far}, {-far, -far, -far}};
  }

 private:
  PD_HD static T larger(T a, T b) { return a < b ? b : a; }
};

constexpr int cluster_size = 32;

// 32 boxes by coordinate.
template <class T>
struct Cluster {
  T side[6][cluster_size];

  PD_HD void set(int n, const Box<T>& box) {
    side[0][n] = box.low.x, side[1][n] = box.low.y, side[2][n] = box.low.z;
    side[3][n] = box.high.x, side[4][n] = box.high.y, side[5][n] = box.high.z;
  }
  PD_HD Box<T> box(int n) const {
    return {{side[0][n], side[1][n], side[2][n]}, {side[3][n], side[4][n], side[5][n]}};
  }
};

}  // namespace pd::inline PD_TARGET
