// The team of solver/contact on one thread: the CPU's, which takes items in order.
#pragma once
#include "math/pack.h"
#include "solver/contact/environment.h"

#include <bit>
#include <cstdint>
#include <cstring>

namespace pd::inline PD_TARGET {

// Lanes of solver/contact/clusters.h, by vector instructions.
struct SerialLanes {
  template <class Test>
  unsigned which(const Test& test) const {
    unsigned char is[cluster_size];
    for (int n = 0; n < cluster_size; ++n) is[n] = test(n);
    static_assert(std::endian::native == std::endian::little);
    unsigned bits = 0;
    for (int word = 0; word < cluster_size / 8; ++word) {
      std::uint64_t bytes;
      std::memcpy(&bytes, is + 8 * word, 8);
      // byte k of eight, 0 or 1, becomes bit k
      bits |= unsigned(bytes * 0x0102040810204080u >> 56) << (8 * word);
    }
    return bits;
  }
  template <class T, class BoxAt>
  Box<T> unite(const BoxAt& box_at) const {
    Box<T> whole = Box<T>::none();
    for (int n = 0; n < cluster_size; ++n) whole.add(box_at(n));
    return whole;
  }
  bool leads() const { return true; }
};

// A block of items in vector instructions, some of them: lanes past the last one say nothing.
template <class T>
struct VectorLanes {
  static constexpr int width = PD_VECTOR_BYTES / int(sizeof(T));
  using Number = Pack<T, width>;
  int first, count;

  int begin() const { return first; }
  static Number load(const T* from) { return Number::load(from); }
  static void store(T* to, const Number& value) { value.store(to); }
  template <class Get>
  Vec3<Number> vector(const Get& get) const {
    T number[3][width] = {};
    for (int lane = 0; lane < count; ++lane) {
      const auto of = get(first + lane);
      number[0][lane] = of.x, number[1][lane] = of.y, number[2][lane] = of.z;
    }
    return {Number::load(number[0]), Number::load(number[1]), Number::load(number[2])};
  }
  template <class Visit>
  void each(const Visit& visit) const {
    for (int lane = 0; lane < count; ++lane) visit(first + lane);
  }
  bool all(const Mask<T, width>& mask) const {
    bool holds = true;
    for (int lane = 0; lane < count; ++lane) holds = holds && mask.m[lane] != 0;
    return holds;
  }
};

class SerialTeam {
  // What a walk found.
  struct Found {
    static constexpr int most = 256;
    SidePair side[most];
    int count = 0;

    template <class Visit>
    void each(const Visit& visit) const {
      for (int n = 0; n < count; ++n) visit(side[n].owner, side[n].other);
    }
    template <class T, class SidesOf, class Visit>
    void each_closest(const SidesOf& sides_of, const Vec3<T>* places, const Visit& visit) const {
      SerialTeam().each_closest(
          count, [&](int n) { return sides_of(side[n].owner, side[n].other); }, places,
          [&](int n, const Closest<T>& near) { visit(side[n].owner, side[n].other, near); });
    }
  };

 public:
  static constexpr bool in_order = true;

  template <class Item>
  void spread(std::int64_t count, const Item& item) const {
    for (std::int64_t i = 0; i < count; ++i) item(int(i));
  }
  template <class Item>
  void each(std::int64_t count, const Item& item) const {
    spread(count, item);
  }
  template <class T, class Visit>
  void blocks(int count, const Visit& visit) const {
    constexpr int W = VectorLanes<T>::width;
    for (int first = 0; first < count; first += W)
      visit(VectorLanes<T>{first, count - first < W ? count - first : W});
  }
  template <class Visit>
  void warps(int count, const Visit& visit) const {
    for (int n = 0; n < count; ++n) visit(n, SerialLanes());
  }

  // Closest points of pairs, side by side those of one kind.
  template <class T, class PairAt, class Visit>
  void each_closest(int count, const PairAt& pair_at, const Vec3<T>* places,
                    const Visit& visit) const {
    constexpr int W = PD_VECTOR_BYTES / int(sizeof(T));
    for (int begin = 0, end = 0; begin < count; begin = end) {
      const bool edges = pair_at(begin).edges;
      T number[12][W];
      for (; end < count && end < begin + W && pair_at(end).edges == edges; ++end) {
        for (int a = 0; a < 4; ++a) {
          const Vec3<T>& place = places[pair_at(end).vertex[a]];
          number[3 * a][end - begin] = place.x;
          number[3 * a + 1][end - begin] = place.y;
          number[3 * a + 2][end - begin] = place.z;
        }
      }
      for (auto& row : number)
        for (int lane = end - begin; lane < W; ++lane) row[lane] = row[0];
      using P = Pack<T, W>;
      Vec3<P> corner[4];
      for (int a = 0; a < 4; ++a)
        corner[a] = {P::load(number[3 * a]), P::load(number[3 * a + 1]),
                     P::load(number[3 * a + 2])};
      const Closest<P> near = closest_points(edges, corner);
      for (int a = 0; a < 4; ++a) near.weight[a].store(number[a]);
      near.diff.x.store(number[4]), near.diff.y.store(number[5]), near.diff.z.store(number[6]);
      near.distance.store(number[7]);
      for (int n = begin; n < end; ++n) {
        const int lane = n - begin;
        visit(n, Closest<T>{{number[0][lane], number[1][lane], number[2][lane], number[3][lane]},
                            {number[4][lane], number[5][lane], number[6][lane]},
                            number[7][lane]});
      }
    }
  }

  // Sides of clusters whose boxes meet, many at a time: sides(cluster, number, number of the other)
  template <class T, class Sides, class Visit>
  void walk(const ClusterBoxes<T>& boxes, const Sides& sides, const Visit& visit) const {
    const SerialLanes lanes;
    Found found;
    ClusterPairs<T> pairs(0, 1);
    while (pairs.next(lanes, boxes)) {
      const int own = pairs.own, other = pairs.other;
      const Cluster<T>&of = boxes.box[own], &to = boxes.box[other];
      const int *leaf = boxes.leaf(own), *leaf_of_other = boxes.leaf(other);
      const bool point = boxes.has_points(own);
      const Box<T> hull = boxes.hull(other);
      unsigned near = lanes.which([&](int n) { return of.box(n).meets(hull); });
      while (near != 0) {
        const int i = take_lowest(near);
        const Box<T> box = of.box(i);
        unsigned meets = lanes.which([&](int n) { return to.box(n).meets(box); });
        if (own == other) meets &= ~1u << i;
        if (meets == 0) continue;
        meets &=
            lanes.which([&](int n) { return boxes.share_none(point, leaf, i, leaf_of_other, n); });
        while (meets != 0) {
          if (found.count == Found::most) visit(found), found.count = 0;
          found.side[found.count++] = sides(own, leaf[i], leaf_of_other[take_lowest(meets)]);
        }
      }
    }
    if (found.count > 0) visit(found);
  }

  template <class Task>
  void once(const Task& task) const {
    task();
  }
  void barrier() const {}

  // Adds what add(i, sums) adds for every item.
  template <int Count, class Add>
  void sum(std::int64_t count, const Add& add, double (&sums)[Count]) const {
    for (std::int64_t i = 0; i < count; ++i) add(int(i), sums);
  }

  // Replaces numbers [count] by the sums of those before; [count] is the sum of all.
  void scan(int* numbers, std::int64_t count) const {
    int sum = 0;
    for (std::int64_t i = 0; i < count; ++i) {
      const int own = numbers[i];
      numbers[i] = sum;
      sum += own;
    }
    numbers[count] = sum;
  }

  // calls visit(n, group) for every group; a group has the threads that its sums take
  template <class Visit>
  void groups(int count, const Visit& visit) const {
    for (int n = 0; n < count; ++n) visit(n, *this);
  }
  template <int Count, class Add>
  void sum_range(int begin, int end, const Add& add, double (&sums)[Count]) const {
    for (int i = begin; i < end; ++i) add(i, sums);
  }
  // the same in parts: items of its own, and then what all have added
  template <class Add>
  void add_range(int begin, int end, const Add& add) const {
    for (int i = begin; i < end; ++i) add(i);
  }
  template <int Count>
  void add_up(double (&)[Count]) const {}
  template <int Count, class Take>
  void least_range(int begin, int end, const Take& take, double (&least)[Count]) const {
    for (int i = begin; i < end; ++i) take(i, least);
  }
  // Writes the items of [0, count) that `is` picks to `out`, in their order.
  template <class Is>
  void select(int count, const Is& is, int* out) const {
    for (int i = 0; i < count; ++i)
      if (is(i)) *out++ = i;
  }
  bool leads() const { return true; }
  template <class Task>
  void lead(const Task& task) const {
    task();
  }
  template <class Item>
  void spread_of_group(int count, const Item& item) const {
    for (int i = 0; i < count; ++i) item(i);
  }
  template <class Item>
  void each_of_group(int count, const Item& item) const {
    spread_of_group(count, item);
  }
  template <class Item>
  void each_below(int begin, int end, const Item& item) const {
    for (int c = begin; c < end; ++c) {
      for (int r = c; r < end; ++r) item(r, c);
    }
  }
};

}  // namespace pd::inline PD_TARGET
