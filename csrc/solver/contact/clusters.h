// Clusters of 32 sides of one body, whose boxes are tested 32 at a time, and trees over them.
//
// Lanes are the 32 threads of a warp, or vector instructions of one thread. They offer
//
//   which(test)      bits of the n for which test(n)
//   unite(box)       the box around all box(n), known to all
//   leads()          whether a thread writes what all know
#pragma once
#include "contact/box.h"
#include "contact/views.h"

#if !defined(__CUDA_ARCH__)
#include <bit>
#endif

namespace pd::inline PD_TARGET {

constexpr int cluster_bits = 5;      // 32 = 1 << 5
constexpr int most_tree_levels = 6;  // for 2^30 clusters
constexpr int leaf_rows = 4;         // of a cluster: numbers of sides, and their corners

// The place of the lowest bit of a number that is not 0, which it loses.
PD_HD int take_lowest(unsigned& bits) {
#if defined(__CUDA_ARCH__)
  const int lowest = __ffs(int(bits)) - 1;
#else
  const int lowest = std::countr_zero(bits);
#endif
  bits &= bits - 1;
  return lowest;
}

// Groups of 32 hulls of clusters, then of 32 such groups, up to a single one.
PD_HD int count_groups(int clusters, int level) {
  return ((clusters - 1) >> (cluster_bits * (level + 1))) + 1;
}
PD_HD int count_groups(int clusters) {
  int all = 0;
  for (int level = 0; clusters > 0; ++level) {
    all += count_groups(clusters, level);
    if (count_groups(clusters, level) == 1) break;
  }
  return all;
}

// A tree over clusters. The groups of a level lie after those below.
template <class T>
struct BoxTree {
  Cluster<T>* group;
  int first, count;  // clusters

  PD_HD int top() const {
    int level = 0;
    while (count_groups(count, level) > 1) ++level;
    return level;
  }
  PD_HD Cluster<T>* level(int of) const {
    Cluster<T>* begin = group;
    for (int below = 0; below < of; ++below) begin += count_groups(count, below);
    return begin;
  }
  PD_HD Box<T> hull(int cluster) const {
    const int n = cluster - first;
    return group[n / cluster_size].box(n % cluster_size);
  }
  PD_HD void set_hull(int cluster, const Box<T>& box) const {
    const int n = cluster - first;
    group[n / cluster_size].set(n % cluster_size, box);
  }

  // boxes of the groups above the first level
  template <class Team>
  PD_HD void refit(const Team& team) const {
    for (int own = 0; count > 0 && count_groups(count, own) > 1; ++own) {
      const Cluster<T>* const below = level(own);
      Cluster<T>* const above = level(own + 1);
      team.warps(count_groups(count, own), [&](int g, const auto& lanes) {
        const Box<T> hull = lanes.template unite<T>([&](int n) { return below[g].box(n); });
        if (lanes.leads()) above[g / cluster_size].set(g % cluster_size, hull);
      });
      team.barrier();
    }
  }
};

// The clusters of a tree whose hulls meet a box, one after another.
template <class T>
class ClusterWalk {
 public:
  // `least`: first cluster that counts
  template <class Lanes>
  PD_HD void start(const Lanes& lanes, const BoxTree<T>& tree, const Box<T>& box, int least) {
    tree_ = tree;
    box_ = box;
    least_ = least - tree.first;
    level_ = top_ = tree.top();
    node_ = 0;
    groups_ = tree.level(top_);
    enter(lanes);
  }
  PD_HD void stop() { level_ = top_ = 0, which_[0] = 0; }

  // -1: no more
  template <class Lanes>
  PD_HD int next(const Lanes& lanes) {
    while (true) {
      if (which_[level_] == 0) {
        if (level_ == top_) return -1;
        groups_ += count_groups(tree_.count, level_);
        node_ /= cluster_size;
        ++level_;
      } else {
        const int child = cluster_size * node_ + take_lowest(which_[level_]);
        if (level_ == 0) return tree_.first + child;
        --level_;
        groups_ -= count_groups(tree_.count, level_);
        node_ = child;
        enter(lanes);
      }
    }
  }

 private:
  template <class Lanes>
  PD_HD void enter(const Lanes& lanes) {
    const Cluster<T>& group = groups_[node_];
    unsigned which = lanes.which([&](int n) { return group.box(n).meets(box_); });
    const int before = (least_ >> (cluster_bits * level_)) - cluster_size * node_;
    if (before > 0) which &= ~0u << before;
    which_[level_] = which;
  }

  BoxTree<T> tree_ = {};
  Box<T> box_ = {};
  const Cluster<T>* groups_ = nullptr;  // of the level
  int least_ = 0, top_ = 0, level_ = 0, node_ = 0;
  unsigned which_[most_tree_levels];
};

// Pairs of sides that may come near: the boxes of clusters of all sides, and which bodies are asked.
template <class T>
struct ClusterBoxes {
  using Real = T;

  const int* leaves;  // [clusters, 4, 32]
  const int* body;    // [clusters]
  Cluster<T>* box;    // [clusters]
  BoxTree<T> points, edges, triangles;
  const unsigned char *itself, *wanted, *by_hand;  // [bodies] see ContactArrays

  PD_HD int owners() const { return points.count + edges.count; }
  PD_HD bool has_points(int cluster) const { return cluster < points.count; }
  PD_HD const int* leaf(int cluster) const { return leaves + leaf_rows * cluster_size * cluster; }
  PD_HD const BoxTree<T>& tree_of(int cluster) const {
    return cluster < points.count ? points : cluster < owners() ? edges : triangles;
  }
  PD_HD Box<T> hull(int cluster) const { return tree_of(cluster).hull(cluster); }

  // Fits a cluster to box_of(vertex), each widened by the largest reach(vertex) of the side.
  template <class Lanes, class BoxOf, class Reach>
  PD_HD Box<T> fit(const Lanes& lanes, int cluster, const BoxOf& box_of, const Reach& reach) const {
    const int* const of = leaf(cluster);
    const int corners = has_points(cluster) ? 1 : cluster < owners() ? 2 : 3;
    Cluster<T>& boxes = box[cluster];
    return lanes.template unite<T>([&](int n) {
      Box<T> whole = Box<T>::none();
      if (of[n] >= 0) {
        T widest(0);
        for (int corner = 1; corner <= corners; ++corner) {
          const int v = of[cluster_size * corner + n];
          const T own = reach(v);
          whole.add(box_of(v));
          widest = widest < own ? own : widest;
        }
        whole = whole.widened(widest);
      }
      boxes.set(n, whole);
      return whole;
    });
  }

  PD_HD bool may_meet(int one, int other) const {
    const int a = body[one], b = body[other];
    return a == b ? itself[a] != 0 : !(by_hand[a] && by_hand[b]);
  }
  // Whether a side of the cluster `one` has no vertex of one of `other`; `of`, `to`: leaves
  PD_HD static bool share_none(bool point, const int* of, int i, const int* to, int n) {
    const int a = of[cluster_size + i], b = of[2 * cluster_size + i], p = to[cluster_size + n],
              q = to[2 * cluster_size + n], r = to[3 * cluster_size + n];
    return (p != a) & (q != a) & ((point & (r != a)) | (!point & (p != b) & (q != b)));
  }
};

// Pairs of clusters whose hulls meet, of the owners c, c + stride, ...
template <class T>
class ClusterPairs {
 public:
  int own = 0, other = 0;
  Box<T> hull;  // of `own`

  PD_HD ClusterPairs(int first, int stride) : own(first - stride), stride_(stride) { walk_.stop(); }

  template <class Lanes>
  PD_HD bool next(const Lanes& lanes, const ClusterBoxes<T>& of) {
    while (true) {
      other = walk_.next(lanes);
      if (other >= 0) {
        if (of.may_meet(own, other)) return true;
        continue;
      }
      own += stride_;
      if (own >= of.owners()) return false;
      if (!of.wanted[of.body[own]]) continue;
      hull = of.hull(own);
      if (of.has_points(own)) {
        if (of.triangles.count > 0) walk_.start(lanes, of.triangles, hull, of.triangles.first);
      } else {
        walk_.start(lanes, of.edges, hull, own);
      }
    }
  }

 private:
  ClusterWalk<T> walk_;
  int stride_;
};

}  // namespace pd::inline PD_TARGET
