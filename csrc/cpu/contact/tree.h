// Boxes of primitives in clusters of 32: the order of the leaves is made once, boxes before every search.
//
// One box is tested against the 32 of a cluster at a time. Clusters are made body by body, so that a search opens only the
// bodies whose boxes meet. Sides with a common vertex are no pair; three of four meetings are such, and never come out.
#pragma once
#include "contact/box.h"

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>
#include <vector>

namespace pd::inline PD_TARGET {

constexpr int cluster_size = 32;

// 32 boxes by coordinate, and which of them meet another one.
template <class T>
struct Cluster {
  T side[6][cluster_size];

  Cluster() {
    for (int n = 0; n < cluster_size; ++n) set(n, Box<T>::none());
  }
  void set(int n, const Box<T>& box) {
    side[0][n] = box.low.x, side[1][n] = box.low.y, side[2][n] = box.low.z;
    side[3][n] = box.high.x, side[4][n] = box.high.y, side[5][n] = box.high.z;
  }
  Box<T> box(int n) const {
    return {{side[0][n], side[1][n], side[2][n]}, {side[3][n], side[4][n], side[5][n]}};
  }
  void meets(const Box<T>& box, unsigned char (&which)[cluster_size]) const {
    for (int n = 0; n < cluster_size; ++n) {
      which[n] = (side[0][n] <= box.high.x) & (box.low.x <= side[3][n]) &
                 (side[1][n] <= box.high.y) & (box.low.y <= side[4][n]) &
                 (side[2][n] <= box.high.z) & (box.low.z <= side[5][n]);
    }
  }
};

// calls visit(n) for every n with which[n], in order
template <class Visit>
void each_set(const unsigned char (&which)[cluster_size], const Visit& visit) {
  for (int word = 0; word < cluster_size / 8; ++word) {
    std::uint64_t bytes;
    std::memcpy(&bytes, which + 8 * word, 8);
    static_assert(std::endian::native == std::endian::little);
    for (; bytes != 0; bytes &= bytes - 1) visit(8 * word + std::countr_zero(bytes) / 8);
  }
}

// Clusters of primitives with so many corners each.
template <class T, int Corners>
class BoxClusters {
 public:
  // `order`: [count] numbers of the primitives, body by body; `corner`: [primitives, Corners]; `body`: [vertices]
  BoxClusters(const int* order, int count, const int* corner, const int* body, int bodies)
      : begin_(bodies + 1) {
    for (int n = 0, b = 0; b < bodies; ++b) {
      begin_[b] = int(leaves_.size());
      for (; n < count && body[corner[Corners * order[n]]] == b;) {
        Leaves& leaves = leaves_.emplace_back();
        for (; leaves.count < cluster_size && n < count && body[corner[Corners * order[n]]] == b;
             ++n) {
          leaves.number[leaves.count] = order[n];
          for (int a = 0; a < Corners; ++a)
            leaves.corner[a][leaves.count] = corner[Corners * order[n] + a];
          ++leaves.count;
        }
      }
    }
    begin_[bodies] = int(leaves_.size());
    whole_.resize((leaves_.size() + cluster_size - 1) / cluster_size);
  }

  // Boxes of the primitives of a body by box_of(corners).
  template <class BoxOf>
  void refit(int body, const BoxOf& box_of) {
    for (int l = begin_[body]; l < begin_[body + 1]; ++l) {
      Leaves& leaves = leaves_[l];
      Box<T> whole = Box<T>::none();
      for (int n = 0; n < leaves.count; ++n) {
        int corner[Corners];
        for (int a = 0; a < Corners; ++a) corner[a] = leaves.corner[a][n];
        const Box<T> box = box_of(corner);
        leaves.boxes.set(n, box);
        whole.add(box);
      }
      whole_[l / cluster_size].set(l % cluster_size, whole);
    }
  }

  // visit(number, number of the other) for primitives of two bodies whose boxes meet and that share no vertex. Of one
  // body with itself each two come once.
  template <int Others, class Visit>
  void each_meeting(int body, const BoxClusters<T, Others>& other, int beside,
                    const Visit& visit) const {
    const bool once = static_cast<const void*>(this) == &other && body == beside;
    const int end = other.begin_[beside + 1];
    for (int l = begin_[body]; l < begin_[body + 1]; ++l) {
      const Box<T> whole = whole_[l / cluster_size].box(l % cluster_size);
      const int first = once ? l : other.begin_[beside];
      for (int w = first / cluster_size; w * cluster_size < end; ++w) {
        unsigned char near[cluster_size];
        other.whole_[w].meets(whole, near);
        each_set(near, [&](int n) {
          const int at = w * cluster_size + n;
          if (at >= first && at < end) open(l, other, at, once && l == at, visit);
        });
      }
    }
  }

 private:
  template <class, int>
  friend class BoxClusters;

  struct Leaves {
    Cluster<T> boxes;
    int number[cluster_size], corner[Corners][cluster_size];
    int count = 0;
  };

  template <int Others, class Visit>
  void open(int own, const BoxClusters<T, Others>& other, int beside, bool once,
            const Visit& visit) const {
    const Leaves& leaves = leaves_[own];
    const auto& others = other.leaves_[beside];
    unsigned char near[cluster_size];
    leaves.boxes.meets(other.whole_[beside / cluster_size].box(beside % cluster_size), near);
    each_set(near, [&](int i) {
      unsigned char meets[cluster_size];
      others.boxes.meets(leaves.boxes.box(i), meets);
      for (int a = 0; a < Corners; ++a) {
        const int corner = leaves.corner[a][i];
        for (int b = 0; b < Others; ++b) {
          for (int n = 0; n < cluster_size; ++n) meets[n] &= others.corner[b][n] != corner;
        }
      }
      each_set(meets, [&](int n) {
        if (!once || n > i) visit(leaves.number[i], others.number[n]);
      });
    });
  }

  std::vector<Leaves> leaves_;
  std::vector<Cluster<T>> whole_;  // boxes of all leaves together, of 32 clusters
  std::vector<int> begin_;         // [bodies + 1]
};

}  // namespace pd::inline PD_TARGET
