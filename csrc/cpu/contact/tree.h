// A static tree of boxes with 32 children a node: the order of its leaves is made once, boxes before every search.
#pragma once
#include "contact/box.h"

#include <algorithm>
#include <cstdint>
#include <vector>

namespace pd::inline PD_TARGET {

template <class T>
class BoxTree {
 public:
  static constexpr int fan = 32;

  // `order`: [count] numbers of the leaves
  BoxTree(const int* order, int count) : order_(order) {
    for (int n = count;; n = (n + fan - 1) / fan) {
      levels_.emplace_back(n);
      if (n <= 1) return;
    }
  }

  // Boxes of leaves by box_of(number), and of all nodes.
  template <class BoxOf>
  void refit(const BoxOf& box_of) {
    Level& leaves = levels_[0];
    for (int n = 0; n < leaves.count; ++n) leaves.set(n, box_of(order_[n]));
    for (std::size_t l = 1; l < levels_.size(); ++l) {
      const Level& below = levels_[l - 1];
      for (int n = 0; n < levels_[l].count; ++n) {
        Box<T> box = Box<T>::none();
        const int end = std::min(below.count, (n + 1) * fan);
        for (int child = n * fan; child < end; ++child) box.add(below.box(child));
        levels_[l].set(n, box);
      }
    }
  }

  // visit(number) for every leaf whose box meets `box`
  template <class Visit>
  void each_near(const Box<T>& box, const Visit& visit) const {
    if (levels_[0].count > 0) descend(int(levels_.size()) - 1, 0, 1, box, visit);
  }

 private:
  // Boxes by coordinate, so that one vector instruction compares many.
  struct Level {
    int count;
    std::vector<T> side[6];

    explicit Level(int count) : count(count) {
      for (auto& numbers : side) numbers.resize(count);
    }
    void set(int n, const Box<T>& box) {
      side[0][n] = box.low.x, side[1][n] = box.low.y, side[2][n] = box.low.z;
      side[3][n] = box.high.x, side[4][n] = box.high.y, side[5][n] = box.high.z;
    }
    Box<T> box(int n) const {
      return {{side[0][n], side[1][n], side[2][n]}, {side[3][n], side[4][n], side[5][n]}};
    }
  };

  template <class Visit>
  void descend(int level, int begin, int end, const Box<T>& box, const Visit& visit) const {
    const Level& own = levels_[level];
    unsigned char meets[fan];
    const int count = end - begin;
    const T *lx = own.side[0].data() + begin, *ly = own.side[1].data() + begin,
            *lz = own.side[2].data() + begin, *hx = own.side[3].data() + begin,
            *hy = own.side[4].data() + begin, *hz = own.side[5].data() + begin;
    for (int n = 0; n < count; ++n) {
      meets[n] = (lx[n] <= box.high.x) & (box.low.x <= hx[n]) & (ly[n] <= box.high.y) &
                 (box.low.y <= hy[n]) & (lz[n] <= box.high.z) & (box.low.z <= hz[n]);
    }
    for (int n = 0; n < count; ++n) {
      if (!meets[n]) continue;
      const int node = begin + n;
      if (level == 0) {
        visit(order_[node]);
      } else {
        descend(level - 1, node * fan, std::min(levels_[level - 1].count, (node + 1) * fan), box,
                visit);
      }
    }
  }

  const int* order_;
  std::vector<Level> levels_;
};

}  // namespace pd::inline PD_TARGET
