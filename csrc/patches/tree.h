// A complete binary tree of boxes around things that a ray may meet, refitted in every pose.
#pragma once
#include "patches/views.h"

namespace pd::freeform {

template <class T>
struct Tree {
  T* boxes;  // [B, 2^(levels + 1) / 4 or 1, 6, 4] least and greatest coordinates of four nodes, m
  Index count;  // things, in the order of the leaves
  int levels;
};

template <class T>
struct JoinedBoxes {
  Tree<T> tree;
  int level;
};

template <class T>
struct Rays {
  const T *origins, *directions;  // [1 or B, R, 3] m, and of unit length
  Index count, origin_step,
      direction_step;  // from the rays of one pose to those of the next: 0 or 3 R
  T near, far;         // m
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

template <class T>
PD_HD T greater(const T& a, const T& b) {
  return b > a ? b : a;
}

template <class T>
PD_HD T largest(const Vec3<T>& a) {
  return greater(greater(absolute(a.x), absolute(a.y)), absolute(a.z));
}

template <class T>
struct Box {
  Vec3<T> low, high;
};

template <class T>
PD_HD void join(Box<T>& box, const Vec3<T>& low, const Vec3<T>& high) {
  box.low = {lesser(box.low.x, low.x), lesser(box.low.y, low.y), lesser(box.low.z, low.z)};
  box.high = {greater(box.high.x, high.x), greater(box.high.y, high.y),
              greater(box.high.z, high.z)};
}

template <class T>
PD_HD Index first_of(const Tree<T>& t, Index leaf) {
  return (leaf * t.count) >> t.levels;
}

// Nodes are numbered from the root, 1; below n lie 2 n and 2 n + 1, and below those 4 n up to 4 n + 3, which are kept together.
// There is no node 0.
template <class T>
PD_HD Index numbers_of(const Tree<T>& t) {
  return 24 * greater(Index(1), Index(1) << t.levels >> 1);
}

PD_HD Index place_of(Index node) { return 24 * (node / 4) + node % 4; }

template <class T>
PD_HD Box<T> load_box(const T* boxes, Index node) {
  const T* from = boxes + place_of(node);
  return {{from[0], from[4], from[8]}, {from[12], from[16], from[20]}};
}

template <class T>
PD_HD void store_box(T* boxes, Index node, const Box<T>& box) {
  const T numbers[6] = {box.low.x, box.low.y, box.low.z, box.high.x, box.high.y, box.high.z};
  for (int k = 0; k < 6; ++k) boxes[place_of(node) + 4 * k] = numbers[k];
}

template <class T>
PD_HD void store_leaf(const Tree<T>& t, Index pose, Index leaf, const Box<T>& box) {
  store_box(t.boxes + pose * numbers_of(t), (Index(1) << t.levels) + leaf, box);
}

// Item: an inner node of a pose at a level, 0 the root, from its children.
template <class T>
PD_HD void item(const JoinedBoxes<T>& t, Index i) {
  const Index pose = i >> t.level, node = (Index(1) << t.level) + i - (pose << t.level);
  T* boxes = t.tree.boxes + pose * numbers_of(t.tree);
  Box<T> box = load_box(boxes, 2 * node);
  const Box<T> other = load_box(boxes, 2 * node + 1);
  join(box, other.low, other.high);
  store_box(boxes, node, box);
}

// A ray and two directions across it (Duff et al. 2017): what meets it has no component along either.
template <class T>
struct Sight {
  Vec3<T> o, d, u, v, inverse;  // of d, component by component
};

// Finite for 0 too, or 0 times it would be NaN. Only along the very face of a box is the answer then open, and the margin of the
// boxes keeps the surface off their faces.
template <class T>
PD_HD T inverse_of(const T& a) {
  constexpr T least = T(1) / biggest<T>() * T(4);
  return T(1) / (absolute(a) > least ? a : least);
}

template <class T>
PD_HD Sight<T> sight_along(const Vec3<T>& o, const Vec3<T>& d) {
  const T sign = d.z < T(0) ? T(-1) : T(1), a = T(-1) / (sign + d.z), b = d.x * d.y * a;
  return {o,
          d,
          {T(1) + sign * d.x * d.x * a, sign * b, -sign * d.x},
          {b, sign + d.y * d.y * a, -d.y},
          {inverse_of(d.x), inverse_of(d.y), inverse_of(d.z)}};
}

// Which of four boxes, larger by `margin`, a ray enters before `far`, and where: never later than that, for the rounding of six products.
template <class T>
PD_HD void enter_four(const T* boxes, const Sight<T>& ray, const T& near, const T& far,
                      const T& margin, T (&entry)[4], bool (&in)[4]) {
  constexpr T rounding = T(4) * epsilon<T>();
  T exit[4];
  for (int k = 0; k < 4; ++k) {  // in one vector
    const T a[3] = {(boxes[k] - ray.o.x - margin) * ray.inverse.x,
                    (boxes[4 + k] - ray.o.y - margin) * ray.inverse.y,
                    (boxes[8 + k] - ray.o.z - margin) * ray.inverse.z};
    const T b[3] = {(boxes[12 + k] - ray.o.x + margin) * ray.inverse.x,
                    (boxes[16 + k] - ray.o.y + margin) * ray.inverse.y,
                    (boxes[20 + k] - ray.o.z + margin) * ray.inverse.z};
    const T first = greater(greater(lesser(a[0], b[0]), lesser(a[1], b[1])), lesser(a[2], b[2]));
    const T last = lesser(lesser(greater(a[0], b[0]), greater(a[1], b[1])), greater(a[2], b[2]));
    entry[k] = greater(near, first * (T(1) - rounding));
    exit[k] = lesser(far, last * (T(1) + rounding));
  }
  // a box around nothing has its faces the wrong way round
  for (int k = 0; k < 4; ++k) in[k] = entry[k] <= exit[k] && boxes[k] <= boxes[12 + k];
}

// Nodes still to be looked into, the nearest on top.
template <class T>
struct Waiting {
  int32 node[64];
  T entry[64];
  int count;
};

template <class T>
PD_HD void put(Waiting<T>& w, int base, Index node, const T& entry) {
  int at = w.count++;
  for (; at > base && w.entry[at - 1] < entry; --at) {
    w.node[at] = w.node[at - 1];
    w.entry[at] = w.entry[at - 1];
  }
  w.node[at] = int32(node);
  w.entry[at] = entry;
}

// Calls `meet` with the numbers of the things whose boxes, larger by `margin`, a ray enters before `far`, which may shrink
// meanwhile; about from near to far.
template <class T, class Meet>
PD_HD void visit(const Tree<T>& t, Index pose, const Sight<T>& ray, const T& near, const T& far,
                 const T& margin, const Meet& meet) {
  const T* boxes = t.boxes + pose * numbers_of(t);
  const Index leaves = Index(1) << t.levels;
  Waiting<T> w;
  w.count = 0;
  // steps of two levels end at the leaves
  for (Index node = 1 + t.levels % 2; node <= 1 + 2 * (t.levels % 2); ++node)
    put(w, w.count, node, near);
  while (w.count > 0) {
    const Index node = w.node[--w.count];
    if (w.entry[w.count] > far) continue;
    if (node >= leaves) {
      const Index leaf = node - leaves;
      for (Index n = first_of(t, leaf); n < first_of(t, leaf + 1); ++n) meet(n);
      continue;
    }
    T entry[4];
    bool in[4];
    enter_four(boxes + place_of(4 * node), ray, near, far, margin, entry, in);
    const int base = w.count;
    for (int k = 0; k < 4; ++k)
      if (in[k]) put(w, base, 4 * node + k, entry[k]);
  }
}

}  // namespace pd::freeform::inline PD_TARGET
