// The first point of the published field (patches/literal.h) on each ray: the least t with F' >= 0 over all patches.
//
// Along a ray each plane is a line in t and each Q_i a quadratic, positive between its roots if it is an ellipsoid. Between the
// roots of the quadrics, and of the differences of planes in the literal reading, F' is one polynomial of degree 6. In Bernstein
// form over such a piece it has no root where its coefficients are all negative; else the piece is halved (de Casteljau), the near
// half first. Nothing is missed, however thin; where F' only touches 0, a hit may be reported.
#pragma once
#include "patches/literal.h"
#include "patches/rays.h"

namespace pd::freeform {

template <class T>
struct FieldRays {
  Solid<T> solid;  // without points
  Rays<T> rays;
  T* depth;      // [B, R] m, infinite without a hit
  int32* patch;  // [B, R], -1 without a hit
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

constexpr int degree = 6;

// f(t) = c_0 + c_1 t + c_2 t^2
template <class T>
struct Parabola {
  T c0, c1, c2;
};

template <class T>
PD_HD T value_at(const Parabola<T>& f, const T& t) {
  return multiply_add(t, multiply_add(t, f.c2, f.c1), f.c0);
}

// One patch seen along a ray, t counted from the foot of its first corner.
template <class T>
struct Profile {
  Vec3<T> o, d;
  Index pose, patch;
  T line[5][2];  // planes: value at 0, and slope
};

template <class T>
PD_HD Profile<T> profile_of(const Solid<T>& s, Index pose, Index patch, const Vec3<T>& o,
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
PD_HD Parabola<T> quadric_along(const Solid<T>& s, const Profile<T>& p, Index entry) {
  const T* w = matrices_of(s, p.pose, entry);
  const T x[4] = {p.o.x, p.o.y, p.o.z, T(1)}, d[4] = {p.d.x, p.d.y, p.d.z, T(0)};
  T mixed = T(0);
  for (int r = 0; r < 4; ++r)
    for (int c = 0; c < 3; ++c)
      mixed = multiply_add(w[4 * r + c] + w[4 * c + r], x[r] * d[c], mixed);
  return {quadric_value(w, x), mixed, quadric_value(w, d)};
}

// `next`, or t if it lies between `after` and `next`. Not for NaN.
template <class T>
PD_HD T earlier(const T& t, const T& after, const T& next) {
  return t > after && t < next ? t : next;
}

// Where the polynomial that F' is now ends.
template <class T>
PD_HD T next_break(const Solid<T>& s, const Profile<T>& p, const T& after, const T& last) {
  T next = last;
  for (int32 e = s.lists.patch_start[p.patch]; e < s.lists.patch_start[p.patch + 1]; ++e) {
    const Parabola<T> q = quadric_along(s, p, e);
    const T square = multiply_subtract(q.c1, q.c1, T(4) * q.c2 * q.c0);
    if (!(square >= T(0))) continue;
    const T root = square_root(square), half = T(-0.5) * (q.c1 < T(0) ? q.c1 - root : q.c1 + root);
    next = earlier(half / q.c2, after, next);
    next = earlier(q.c0 / half, after, next);
  }
  if (s.clip) return next;
  for (int k = 0; k < 5; ++k)
    for (int j = 0; j < k; ++j)
      next = earlier((p.line[j][0] - p.line[k][0]) / (p.line[k][1] - p.line[j][1]), after, next);
  return next;
}

// Narrows [from, to] to where the line is not negative; whether anything is left.
template <class T>
PD_HD bool narrow(const T (&line)[2], T& from, T& to) {
  if (line[1] == T(0)) return line[0] >= T(0);
  const T root = -line[0] / line[1];
  if (line[1] > T(0)) {
    from = greater(from, root);
  } else {
    to = lesser(to, root);
  }
  return from <= to;
}

// Bernstein coefficients over [from, to] of the parabola's cube, times a.
template <class T>
PD_HD void add_cube(const Parabola<T>& q, const T& from, const T& to, const T& a,
                    T (&sum)[degree + 1]) {
  const T x = value_at(q, from), z = value_at(q, to);
  const T y =
      T(2) * x + multiply_add(T(2) * from, q.c2, q.c1) * (to - from);  // twice the middle one
  const T cube[degree + 1] = {x * x * x,
                              T(3) * x * x * y / T(6),
                              T(3) * x * (y * y + x * z) / T(15),
                              y * (y * y + T(6) * x * z) / T(20),
                              T(3) * z * (y * y + x * z) / T(15),
                              T(3) * z * z * y / T(6),
                              z * z * z};
  for (int n = 0; n <= degree; ++n) sum[n] = multiply_add(a, cube[n], sum[n]);
}

// Coefficients over the part [from, to] of [0, 1].
template <class T>
PD_HD void part_of(const T (&whole)[degree + 1], const T& from, const T& to, T (&c)[degree + 1]) {
  for (int n = 0; n <= degree; ++n) c[n] = whole[n];
  for (int round = degree; round > 0; --round)  // keeps [0, to]
    for (int n = degree; n > degree - round; --n)
      c[n] = multiply_add(to, c[n] - c[n - 1], c[n - 1]);
  const T cut = from / to;
  for (int round = degree; round > 0; --round)  // of that, [from, to]
    for (int n = 0; n < round; ++n) c[n] = multiply_add(cut, c[n + 1] - c[n], c[n]);
}

// The least s in [0, 1] where the polynomial is not negative.
template <class T>
PD_HD bool first_not_negative(const T (&whole)[degree + 1], T& s) {
  constexpr int deepest = sizeof(T) == 4 ? 22 : 48;
  Index place = 0;
  int depth = 0;
  T size = T(1);
  while (true) {
    const T from = T(place) * size, to = T(place + 1) * size;
    T c[degree + 1];
    part_of(whole, from, to, c);
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
    ++place;  // the next interval that begins where this one ends
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
PD_HD bool enter_patch(const Solid<T>& s, const Profile<T>& p, T from, T to, T& at) {
  for (int k = 0; s.clip && k < 4; ++k)
    if (!narrow(p.line[k], from, to)) return false;
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
      const Parabola<T> q = quadric_along(s, p, e);
      if (!(value_at(q, middle) > T(0))) continue;
      active = true;
      add_cube(q, from, next, s.amplitudes[s.lists.entry_quadric[e]], c);
    }
    if (active) {
      T place;
      if (first_not_negative(c, place)) {
        at = multiply_add(place, next - from, from);
        return true;
      }
    } else {
      T begin = from, end = next;
      if (narrow(line, begin, end)) {
        at = begin;
        return true;
      }
    }
    if (!(next < to)) return false;
    from = next;
  }
}

// Item: a ray in a pose.
template <class T>
PD_HD void item(const FieldRays<T>& t, Index i) {
  const Solid<T>& s = t.solid;
  const Index pose = i / t.rays.count, ray = i % t.rays.count;
  const Vec3<T> o = load3(t.rays.origins + pose * t.rays.origin_step, ray);
  const Vec3<T> d = load3(t.rays.directions + pose * t.rays.direction_step, ray);
  T depth = t.rays.far;
  int32 found = -1;
  const bool finite = dot(o, o) + dot(d, d) <= biggest<T>();
  for (Index patch = 0; finite && patch < s.lists.patches; ++patch) {
    const Index corner = pose * s.lists.vertices + s.lists.triangles[3 * patch];
    const T foot = dot(load3(s.positions, corner) - o, d);
    const Profile<T> p = profile_of(s, pose, patch, multiply_add(foot, d, o), d);
    T at;
    if (!enter_patch(s, p, t.rays.near - foot, depth - foot, at)) continue;
    depth = at + foot;
    found = int32(patch);
  }
  t.depth[i] = found < 0 ? T(HUGE_VAL) : depth;
  t.patch[i] = found;
}

}  // namespace pd::freeform::inline PD_TARGET
