// First intersection of each ray with the published field (freeform/paper_field.h): the least t with F'
// >= 0 over all patches.
//
// Along a ray, each plane is linear in t and each Q_i is quadratic; for an ellipsoid it is positive
// between its roots. Between the roots of the quadrics, F' is one polynomial of degree 6. In the
// literal reading, the differences of planes add breaks.
//
// A polynomial has no root in an interval if all its Bernstein coefficients are negative. Otherwise
// the interval is halved (de Casteljau), the near half first. No intersection is missed, however
// thin; where F' only touches 0, a hit may be reported. A tree of boxes around the solids skips the
// patches that a ray misses.
#pragma once
#include "freeform/box_tree.h"
#include "freeform/paper_field.h"

namespace pd::freeform {

template <class T>
struct FieldBoxes {
  PaperField<T> solid;  // without points
  Tree<T> tree;
  const int32* order;  // [P] patches, in the order of the leaves
};

template <class T>
struct FieldRays {
  PaperField<T> solid;  // without points
  Tree<T> tree;
  const int32* order;
  bool exhaustive;  // tests every patch
  Rays<T> rays;
  T* depth;      // [B, R] m, infinite without a hit
  int32* patch;  // [B, R], -1 without a hit
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

constexpr int degree = 6;

// f(t) = c_0 + c_1 t + c_2 t^2
template <class T>
struct Quadratic {
  T c0, c1, c2;
};

template <class T>
PD_HD T value_at(const Quadratic<T>& f, const T& t) {
  return multiply_add(t, multiply_add(t, f.c2, f.c1), f.c0);
}

// One patch along a ray; t starts at the foot of its first corner.
template <class T>
struct Profile {
  Vec3<T> o, d;
  Index pose, patch;
  T line[5][2];  // planes: value at 0, and slope
};

template <class T>
PD_HD Profile<T> profile_of(const PaperField<T>& s, Index pose, Index patch, const Vec3<T>& o,
                            const Vec3<T>& d) {
  Profile<T> p = {o, d, pose, patch, {}};
  const Planes<T> here = planes_at(s, pose, patch, o), there = planes_at(s, pose, patch, o + d);
  for (int k = 0; k < 5; ++k) {
    p.line[k][0] = here.value[k];
    p.line[k][1] = there.value[k] - here.value[k];
  }
  return p;
}

template <class T>
PD_HD Quadratic<T> quadric_along(const PaperField<T>& s, const Profile<T>& p, Index entry) {
  const T* w = matrices_of(s, p.pose, entry);
  const T x[4] = {p.o.x, p.o.y, p.o.z, T(1)}, d[4] = {p.d.x, p.d.y, p.d.z, T(0)};
  T mixed = T(0);
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 3; ++c)
      mixed = multiply_add(w[4 * r + c] + w[4 * c + r], x[r] * d[c], mixed);
  return {quadric_value(w, x), mixed, quadric_value(w, d)};
}

// Returns t if it lies between `after` and `next`, else `next`. Inputs must not be NaN.
template <class T>
PD_HD T earlier_root(const T& t, const T& after, const T& next) {
  return t > after && t < next ? t : next;
}

// End of the interval on which F' is one polynomial.
template <class T>
PD_HD T next_break(const PaperField<T>& s, const Profile<T>& p, const T& after, const T& last) {
  T next = last;
  for (int32 e = s.lists.patch_start[p.patch]; e < s.lists.patch_start[p.patch + 1]; ++e) {
    const Quadratic<T> q = quadric_along(s, p, e);
    const T square = multiply_subtract(q.c1, q.c1, T(4) * q.c2 * q.c0);
    if (!(square >= T(0))) continue;
    const T root = square_root(square), half = T(-0.5) * (q.c1 < T(0) ? q.c1 - root : q.c1 + root);
    next = earlier_root(half / q.c2, after, next);
    next = earlier_root(q.c0 / half, after, next);
  }
  if (s.clip) return next;
  for (int k = 0; k < 5; ++k)
    for (int j = 0; j < k; ++j)
      next =
          earlier_root((p.line[j][0] - p.line[k][0]) / (p.line[k][1] - p.line[j][1]), after, next);
  return next;
}

// Clips [from, to] to where the line is not negative; returns whether anything remains.
template <class T>
PD_HD bool clip_to_line(const T (&line)[2], T& from, T& to) {
  if (line[1] == T(0)) return line[0] >= T(0);
  const T root = -line[0] / line[1];
  if (line[1] > T(0)) {
    from = greater(from, root);
  } else {
    to = lesser(to, root);
  }
  return from <= to;
}

// Adds a times the Bernstein coefficients of the cubed quadratic over [from, to].
template <class T>
PD_HD void add_cubed_quadratic(const Quadratic<T>& q, const T& from, const T& to, const T& a,
                               T (&sum)[degree + 1]) {
  const T x = value_at(q, from), z = value_at(q, to);
  const T y =
      // twice the middle coefficient
      T(2) * x + multiply_add(T(2) * from, q.c2, q.c1) * (to - from);
  const T cube[degree + 1] = {x * x * x,
                              T(3) * x * x * y / T(6),
                              T(3) * x * (y * y + x * z) / T(15),
                              y * (y * y + T(6) * x * z) / T(20),
                              T(3) * z * (y * y + x * z) / T(15),
                              T(3) * z * z * y / T(6),
                              z * z * z};
  for (int n = 0; n <= degree; ++n) sum[n] = multiply_add(a, cube[n], sum[n]);
}

// Bernstein coefficients over the subinterval [from, to] of [0, 1].
template <class T>
PD_HD void restrict_bernstein(const T (&whole)[degree + 1], const T& from, const T& to,
                              T (&c)[degree + 1]) {
  for (int n = 0; n <= degree; ++n) c[n] = whole[n];
  for (int round = degree; round > 0; --round)  // restricts to [0, to]
    for (int n = degree; n > degree - round; --n)
      c[n] = multiply_add(to, c[n] - c[n - 1], c[n - 1]);
  const T cut = from / to;
  for (int round = degree; round > 0; --round)  // and then to [from, to]
    for (int n = 0; n < round; ++n) c[n] = multiply_add(cut, c[n + 1] - c[n], c[n]);
}

// The least s in [0, 1] where the polynomial is not negative.
template <class T>
PD_HD bool first_nonnegative(const T (&whole)[degree + 1], T& s) {
  constexpr int deepest = sizeof(T) == 4 ? 22 : 48;
  Index place = 0;
  int depth = 0;
  T size = T(1);
  while (true) {
    const T from = T(place) * size, to = T(place + 1) * size;
    T c[degree + 1];
    restrict_bernstein(whole, from, to, c);
    bool possible = false;
    for (int n = 0; n <= degree; ++n) possible = possible || c[n] >= T(0);
    if (c[0] >= T(0) || (possible && depth == deepest)) {
      s = from;
      return true;
    }
    if (possible) {
      place *= 2;
      ++depth;
      size = T(0.5) * size;
      continue;
    }
    ++place;  // the next interval, which begins where this one ends
    while (depth > 0 && place % 2 == 0) {
      place /= 2;
      --depth;
      size = T(2) * size;
    }
    if (depth == 0) return false;
  }
}

// The least t in [from, to] with F' >= 0.
template <class T>
PD_HD bool first_entry(const PaperField<T>& s, const Profile<T>& p, T from, T to, T& at) {
  for (int k = 0; s.clip && k < 4; ++k)
    if (!clip_to_line(p.line[k], from, to)) return false;
  while (true) {
    const T next = next_break(s, p, from, to), middle = T(0.5) * (from + next);
    int least = 4;
    for (int k = 0; !s.clip && k < 4; ++k) {
      const T(&other)[2] = p.line[least];
      if (p.line[k][0] - other[0] < middle * (other[1] - p.line[k][1])) least = k;
    }
    const T(&line)[2] = p.line[least];
    T c[degree + 1];
    for (int n = 0; n <= degree; ++n)
      c[n] = line[0] + line[1] * (from + (next - from) * (T(n) / T(degree)));
    bool active = false;
    for (int32 e = s.lists.patch_start[p.patch]; e < s.lists.patch_start[p.patch + 1]; ++e) {
      const Quadratic<T> q = quadric_along(s, p, e);
      if (!(value_at(q, middle) > T(0))) continue;
      active = true;
      add_cubed_quadratic(q, from, next, s.amplitudes[s.lists.entry_quadric[e]], c);
    }
    if (active) {
      T place;
      if (first_nonnegative(c, place)) {
        at = multiply_add(place, next - from, from);
        return true;
      }
    } else {
      T begin = from, end = next;
      if (clip_to_line(line, begin, end)) {
        at = begin;
        return true;
      }
    }
    if (!(next < to)) return false;
    from = next;
  }
}

// Bounds of the region where Q may be positive, rounding included, and its maximum there.
struct QuadricExtent {
  bool bounded;
  double most;
  Vec3<double> centre, half;
};

// For an ellipsoid, Q = most - (x - c)^T A (x - c); it reaches sqrt(most A^-1_ii) from c along axis
// i.
template <class T>
PD_HD QuadricExtent extent_of(const T* w) {
  const auto mean = [&](int r, int c) {
    return 0.5 * (double(w[4 * r + c]) + double(w[4 * c + r]));
  };
  const Mat3<double> a = {{{-mean(0, 0), -mean(0, 1), -mean(0, 2)},
                           {-mean(0, 1), -mean(1, 1), -mean(1, 2)},
                           {-mean(0, 2), -mean(1, 2), -mean(2, 2)}}};
  const Vec3<double> b = {mean(0, 3), mean(1, 3), mean(2, 3)};
  const Mat3<double> cofactor = {
      {cross(a.row[1], a.row[2]), cross(a.row[2], a.row[0]), cross(a.row[0], a.row[1])}};
  const double minor = cofactor.row[2].z, det = dot(a.row[0], cofactor.row[0]);
  QuadricExtent e = {false, 0.0, zero3<double>(), zero3<double>()};
  // a cone, a hyperboloid, or nearly a cylinder
  if (!(a.row[0].x > 0.0 && minor > 0.0 && det > 1e-9 * a.row[0].x * a.row[1].y * a.row[2].z))
    return e;
  const double inverse[3] = {cofactor.row[0].x / det, cofactor.row[1].y / det, minor / det};
  e.bounded = true;
  e.centre = (1.0 / det) * (cofactor * b);
  const double peak = double(w[15]) + dot(b, e.centre), root = square_root(greater(peak, 0.0));
  const double reach[3] = {absolute(e.centre.x) + root * square_root(inverse[0]),
                           absolute(e.centre.y) + root * square_root(inverse[1]),
                           absolute(e.centre.z) + root * square_root(inverse[2])};
  double terms = absolute(double(w[15]));
  for (int r = 0; r < 3; ++r) {
    terms += 2.0 * absolute(mean(r, 3)) * reach[r];
    for (int c = 0; c < 3; ++c) terms += absolute(mean(r, c)) * reach[r] * reach[c];
  }
  e.most = peak + 64.0 * double(epsilon<T>()) * terms;
  const double most = square_root(greater(e.most, 0.0));
  e.half = {most * square_root(inverse[0]), most * square_root(inverse[1]),
            most * square_root(inverse[2])};
  return e;
}

// Bounds of the region where the field of a patch may be nonnegative. Let r bound the sum of the
// positive quadrics. Clipped: the prism over the triangle from -tau to tau + r. Literal: the prism
// from -tau to tau, and every positive quadric.
template <class T>
PD_HD Box<double> field_box(const PaperField<T>& s, Index pose, Index patch) {
  Vec3<double> v[3];
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> p =
        load3(s.positions, pose * s.lists.vertices + s.lists.triangles[3 * patch + k]);
    v[k] = {double(p.x), double(p.y), double(p.z)};
  }
  const Vec3<double> area = cross(v[1] - v[0], v[2] - v[0]), normal = (1.0 / length(area)) * area;
  const double most = biggest<double>();
  Box<double> box = {{most, most, most}, {-most, -most, -most}};
  double risen = 0.0;
  // degenerate or not finite: no ray intersects it
  if (!(dot(normal, normal) > 0.5)) return box;
  bool bounded = true;
  for (int32 e = s.lists.patch_start[patch]; e < s.lists.patch_start[patch + 1]; ++e) {
    const double a = double(s.amplitudes[s.lists.entry_quadric[e]]);
    if (a <= 0.0) continue;
    const QuadricExtent q = extent_of(matrices_of(s, pose, e));
    bounded = bounded && q.bounded;
    if (!(q.most > 0.0)) continue;
    risen += a * (q.most * q.most * q.most);
    if (!s.clip) join(box, q.centre - q.half, q.centre + q.half);
  }
  bounded = bounded && risen <= most;
  const double tau = double(s.thickness), up = s.clip ? tau + risen : tau;
  for (int k = 0; k < 3; ++k) {
    const Vec3<double> low = v[k] - tau * normal, high = v[k] + up * normal;
    join(box, low, low);
    join(box, high, high);
  }
  const double margin = 64.0 * double(epsilon<T>()) * greater(largest(box.low), largest(box.high));
  const double widest = double(biggest<T>());
  if (!(bounded && margin < 1e-3 * widest))
    return {{-widest, -widest, -widest}, {widest, widest, widest}};
  const Vec3<double> around = {margin, margin, margin};
  return {box.low - around, box.high + around};
}

template <class T>
PD_HD Vec3<T> rounded(const Vec3<double>& a) {
  return {T(a.x), T(a.y), T(a.z)};
}

// Item: one leaf of one pose.
template <class T>
PD_HD void item(const FieldBoxes<T>& t, Index i) {
  const Index pose = i >> t.tree.levels, leaf = i - (pose << t.tree.levels);
  const double most = double(biggest<T>());
  Box<double> box = {{most, most, most}, {-most, -most, -most}};
  for (Index n = first_of(t.tree, leaf); n < first_of(t.tree, leaf + 1); ++n) {
    if (!is_below(t.order[n], t.tree.count)) continue;  // no patch
    const Box<double> own = field_box(t.solid, pose, t.order[n]);
    join(box, own.low, own.high);
  }
  store_leaf(t.tree, pose, leaf, {rounded<T>(box.low), rounded<T>(box.high)});
}

// Keeps the first patch that a ray enters; at equal depth, the one with the largest number,
// whatever their order.
template <class T>
struct EnterPatch {
  const FieldRays<T>& task;
  Index pose;
  const RayFrame<T>& ray;
  T& depth;
  int32& found;

  PD_HD void operator()(Index number) const {
    const PaperField<T>& s = task.solid;
    const int32 patch = task.order[number];
    if (!is_below(patch, task.tree.count)) return;
    const Index corner = pose * s.lists.vertices + s.lists.triangles[3 * patch];
    const T foot = dot(load3(s.positions, corner) - ray.o, ray.d);
    const Profile<T> p = profile_of(s, pose, patch, multiply_add(foot, ray.d, ray.o), ray.d);
    T reach = T(0);
    for (int k = 0; k < 5; ++k) reach = reach + absolute(p.line[k][0]) + absolute(p.line[k][1]);
    if (!(reach <= biggest<T>())) return;  // degenerate, or not finite
    T at;
    if (!first_entry(s, p, task.rays.near - foot, task.rays.far - foot, at)) return;
    const T t = at + foot;
    if (!(t < depth || (t == depth && patch > found))) return;
    depth = t;
    found = patch;
  }
};

template <class T>
struct EnterLeaf {
  const EnterPatch<T>& enter;

  PD_HD void operator()(Index leaf) const {
    const Tree<T>& t = enter.task.tree;
    for (Index n = first_of(t, leaf); n < first_of(t, leaf + 1); ++n) enter(n);
  }
};

// Item: one ray in one pose.
template <class T>
PD_HD void item(const FieldRays<T>& t, Index i) {
  const Index pose = i / t.rays.count, ray = i % t.rays.count;
  const RayFrame<T> frame = ray_frame(load3(t.rays.origins + pose * t.rays.origin_step, ray),
                                      load3(t.rays.directions + pose * t.rays.direction_step, ray));
  T depth = t.rays.far;
  int32 found = -1;
  if (dot(frame.o, frame.o) + dot(frame.d, frame.d) <= biggest<T>()) {
    const EnterPatch<T> enter = {t, pose, frame, depth, found};
    if (t.exhaustive) {
      for (Index n = 0; n < t.tree.count; ++n) enter(n);
    } else {
      visit(t.tree, pose, frame, t.rays.near, depth, T(64) * epsilon<T>() * largest(frame.o),
            EnterLeaf<T>{enter});
    }
  }
  t.depth[i] = found < 0 ? T(HUGE_VAL) : depth;
  t.patch[i] = found;
}

}  // namespace pd::freeform::inline PD_TARGET
