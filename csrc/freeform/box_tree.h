// A complete binary tree of bounding boxes, refitted in every pose.
#pragma once
#include "freeform/simd4.h"

namespace pd::freeform {

template <class T>
struct Tree {
  T* boxes;     // [B, 2^(levels + 1) / 4 or 1, 6, 4] m; lower and upper bounds of four nodes
  Index count;  // items, in the order of the leaves
  int levels;
};

template <class T>
struct JoinedBoxes {
  Tree<T> tree;
  int level;
};

template <class T>
struct Rays {
  const T *origins, *directions;  // [1 or B, R, 3] m; directions have unit length for FieldRays
  Index count, origin_step,
      direction_step;  // between the rays of consecutive poses: 0 or 3 R
  T near, far;         // m
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

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

// Nodes are numbered from the root, 1. The children of n are 2 n and 2 n + 1; its grandchildren 4 n
// to 4 n + 3 are stored together. Node 0 does not exist.
template <class T>
PD_HD Index tree_size(const Tree<T>& t) {
  return 24 * greater(Index(1), Index(1) << t.levels >> 1);
}

PD_HD Index node_offset(Index node) { return 24 * (node / 4) + node % 4; }

template <class T>
PD_HD Box<T> load_box(const T* boxes, Index node) {
  const T* from = boxes + node_offset(node);
  return {{from[0], from[4], from[8]}, {from[12], from[16], from[20]}};
}

template <class T>
PD_HD void store_box(T* boxes, Index node, const Box<T>& box) {
  const T numbers[6] = {box.low.x, box.low.y, box.low.z, box.high.x, box.high.y, box.high.z};
  for (int k = 0; k < 6; ++k) boxes[node_offset(node) + 4 * k] = numbers[k];
}

template <class T>
PD_HD void store_leaf(const Tree<T>& t, Index pose, Index leaf, const Box<T>& box) {
  store_box(t.boxes + pose * tree_size(t), (Index(1) << t.levels) + leaf, box);
}

// Item: an inner node of one pose, at a level counted from the root, computed from its children.
template <class T>
PD_HD void item(const JoinedBoxes<T>& t, Index i) {
  const Index pose = i >> t.level, node = (Index(1) << t.level) + i - (pose << t.level);
  T* boxes = t.tree.boxes + pose * tree_size(t.tree);
  Box<T> box = load_box(boxes, 2 * node);
  const Box<T> other = load_box(boxes, 2 * node + 1);
  join(box, other.low, other.high);
  store_box(boxes, node, box);
}

// Finite for 0 too, since 0 times infinity would be NaN. The result is then wrong only for rays
// along the face of a box, and the margin of the boxes keeps the surface off their faces.
template <class T>
PD_HD T inverse_of(const T& a) {
  constexpr T least = T(1) / biggest<T>() * T(4);
  return T(1) / (absolute(a) > least ? a : least);
}

// A ray and two directions across it (Duff et al. 2017): a point on the ray has no component along
// either.
template <class T>
struct RayFrame {
  Vec3<T> o, d, u, v, inverse;  // 1 / d, component by component
};

template <class T>
PD_HD RayFrame<T> ray_frame(const Vec3<T>& o, const Vec3<T>& d) {
  const T sign = d.z < T(0) ? T(-1) : T(1), a = T(-1) / (sign + d.z), b = d.x * d.y * a;
  return {o,
          d,
          {T(1) + sign * d.x * d.x * a, sign * b, -sign * d.x},
          {b, sign + d.y * d.y * a, -d.y},
          {inverse_of(d.x), inverse_of(d.y), inverse_of(d.z)}};
}

// Intersects a ray with four boxes enlarged by `margin`, before `far`. Returns bits and entry
// depths, which are never too late, with the rounding of six products included. An empty box has
// inverted faces, so no ray enters it.
template <class T>
PD_HD unsigned intersect_boxes(const T* boxes, const RayFrame<T>& ray, const T& near, const T& far,
                               const T& margin, T (&entry)[4]) {
  using L = Lanes<T>;
  using R = Number<T>;
  constexpr T rounding = T(4) * epsilon<T>();
  const T o[3] = {ray.o.x, ray.o.y, ray.o.z};
  const T inverse[3] = {ray.inverse.x, ray.inverse.y, ray.inverse.z};
  unsigned in = 0;
  for (int lane = 0; lane < 4; lane += L::width) {
    R first[3], last[3];
    for (int axis = 0; axis < 3; ++axis) {
      const bool upwards = inverse[axis] > T(0);
      const T* low = boxes + 4 * axis + lane;
      const T before = upwards ? o[axis] + margin : o[axis] - margin;
      const T behind = upwards ? o[axis] - margin : o[axis] + margin;
      first[axis] = (L::load(upwards ? low : low + 12) - R(before)) * R(inverse[axis]);
      last[axis] = (L::load(upwards ? low + 12 : low) - R(behind)) * R(inverse[axis]);
    }
    const R enters =
        greater(R(near), greater(greater(first[0], first[1]), first[2]) * R(T(1) - rounding));
    const R leaves = lesser(R(far), lesser(lesser(last[0], last[1]), last[2]) * R(T(1) + rounding));
    L::store(entry + lane, enters);
    in |= bits_of(enters <= leaves) << lane;
  }
  return in;
}

// Nodes still to visit, the nearest on top.
template <class T>
struct NodeStack {
  int32 node[64];
  T entry[64];
  int count;
};

template <class T>
PD_HD void push(NodeStack<T>& w, int base, Index node, const T& entry) {
  int at = w.count++;
  for (; at > base && w.entry[at - 1] < entry; --at) {
    w.node[at] = w.node[at - 1];
    w.entry[at] = w.entry[at - 1];
  }
  w.node[at] = int32(node);
  w.entry[at] = entry;
}

// Calls `meet` for the leaves whose boxes, enlarged by `margin`, a ray enters before `far`, roughly
// from near to far. `far` may shrink meanwhile.
template <class T, class Meet>
PD_HD void visit(const Tree<T>& t, Index pose, const RayFrame<T>& ray, const T& near, const T& far,
                 const T& margin, const Meet& meet) {
  const T* boxes = t.boxes + pose * tree_size(t);
  const Index leaves = Index(1) << t.levels;
  NodeStack<T> w;
  w.count = 0;
  // steps of two levels must end at the leaves
  for (Index node = 1 + t.levels % 2; node <= 1 + 2 * (t.levels % 2); ++node)
    push(w, w.count, node, near);
  while (w.count > 0) {
    Index node = w.node[--w.count];
    if (w.entry[w.count] > far) continue;
    while (node < leaves) {
      T entry[4];
      const unsigned in =
          intersect_boxes(boxes + node_offset(4 * node), ray, near, far, margin, entry);
      // visits the nearest at once; 0 means none
      Index next = 0;
      T nearest = T(0);
      const int base = w.count;
      for (int k = 0; k < 4; ++k) {
        if (!(in >> k & 1)) continue;
        const Index found = 4 * node + k;
        if (next == 0) {
          next = found;
          nearest = entry[k];
        } else if (entry[k] < nearest) {
          push(w, base, next, nearest);
          next = found;
          nearest = entry[k];
        } else {
          push(w, base, found, entry[k]);
        }
      }
      node = next;
      if (node == 0) break;
    }
    if (node >= leaves) meet(node - leaves);
  }
}

}  // namespace pd::freeform::inline PD_TARGET
