// The first point of the posed surface on each ray.
//
// Every patch is cut into cells, triangles of its barycentric grid. The surface over a cell lies within `slack` of the triangle of
// its corners, which 12 points inside the cell tell; boxes around the cells form a complete binary tree (heap order, refitted in
// every pose). Seen along a ray, the triangle is flat: the ray can meet the surface only if it passes within the slack of it. Then
// Newton's method finds S(b) = o + t d from where the ray meets the triangle, and where the cell is seen edge-on, so that it may
// be met twice, from its corners too. A patch counts as far as its edges, so neighbours leave no gap between them.
#pragma once
#include "patches/height.h"
#include "patches/surface.h"

namespace pd::freeform {

constexpr int check_points = 12;
constexpr int cell_numbers = 3 + check_points + 2;  // corners and checks in `points`, patch, place

// Where the surface is, cell by cell.
template <class T>
struct Cells {
  const int32* cells;  // [C, 17], in the order of the leaves
  const T* weights;    // [12, 3] barycentric coordinates of the checks in their cell
  const T* places;     // [m^2, 9] barycentric coordinates of the corners of a cell in its patch
  const T* points;     // [B, N, 3] m
  T* slack;            // [B, C] m
  T* boxes;            // [B, 2^(levels + 1) - 1, 6] least and greatest coordinates, m
  Index count, samples;
  int levels;
  T size;  // edge of a cell in barycentric coordinates, 1 / m
};

template <class T>
struct CellBoxes {
  Cells<T> cells;
};

template <class T>
struct JoinedBoxes {
  Cells<T> cells;
  int level;
};

template <class T>
struct Rays {
  const T *origins, *directions;  // [1 or B, R, 3] m, and of unit length
  Index count, origin_step,
      direction_step;  // from the rays of one pose to those of the next: 0 or 3 R
  T near, far;         // m
};

template <class T>
struct SurfaceRays {
  Lists lists;
  Base<T> base;
  Ellipsoids<T> quadrics;
  Cells<T> cells;
  Rays<T> rays;
  const T *positions, *frames;  // [B, V, 3], [B, V, 3, 3]
  bool on_surface;
  T* depth;         // [B, R] m, infinite without a hit
  int32* patch;     // [B, R], -1 without a hit
  T* barycentrics;  // [B, R, 3]
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
PD_HD Index first_cell(const Cells<T>& c, Index leaf) {
  return (leaf * c.count) >> c.levels;
}

template <class T>
PD_HD Index nodes_of(const Cells<T>& c) {
  return (Index(2) << c.levels) - 1;
}

// Item: a leaf of a pose.
template <class T>
PD_HD void item(const CellBoxes<T>& t, Index i) {
  const Cells<T>& c = t.cells;
  const Index pose = i >> c.levels, leaf = i - (pose << c.levels);
  const T* points = c.points + 3 * pose * c.samples;
  const T most = biggest<T>();
  Box<T> box = {{most, most, most}, {-most, -most, -most}};
  for (Index n = first_cell(c, leaf); n < first_cell(c, leaf + 1); ++n) {
    const int32* cell = c.cells + cell_numbers * n;
    const Vec3<T> p[3] = {load3(points, cell[0]), load3(points, cell[1]), load3(points, cell[2])};
    T apart = T(0);
    for (int k = 0; k < check_points; ++k) {
      const T b[3] = {c.weights[3 * k], c.weights[3 * k + 1], c.weights[3 * k + 2]};
      const Vec3<T> off = load3(points, cell[3 + k]) - blend(b, p);
      apart = greater(apart, dot(off, off));
    }
    Box<T> own = {p[0], p[0]};
    for (int k = 1; k < 3; ++k) join(own, p[k], p[k]);
    const T rounding = T(16) * epsilon<T>() * greater(largest(own.low), largest(own.high));
    // between the checks it is little more
    const T slack = T(1.5) * square_root(apart) + rounding;
    c.slack[pose * c.count + n] = slack;
    const Vec3<T> margin = {slack, slack, slack};
    join(box, own.low - margin, own.high + margin);
  }
  const Index node = pose * nodes_of(c) + (Index(1) << c.levels) - 1 + leaf;
  store3(c.boxes, 2 * node, box.low);
  store3(c.boxes, 2 * node + 1, box.high);
}

// Item: an inner node of a pose at a level, 0 the root, from its children.
template <class T>
PD_HD void item(const JoinedBoxes<T>& t, Index i) {
  const Cells<T>& c = t.cells;
  const Index pose = i >> t.level, first = pose * nodes_of(c);
  const Index node = (Index(1) << t.level) - 1 + (i - (pose << t.level));
  const Index child = first + 2 * node + 1;
  Box<T> box = {load3(c.boxes, 2 * child), load3(c.boxes, 2 * child + 1)};
  join(box, load3(c.boxes, 2 * child + 2), load3(c.boxes, 2 * child + 3));
  store3(c.boxes, 2 * (first + node), box.low);
  store3(c.boxes, 2 * (first + node) + 1, box.high);
}

// The surface at one place: a point and its tangents along the chart.
template <class T>
struct SurfaceElement {
  Vec3<T> point, tangent[2];
};

template <class T>
PD_HD SurfaceElement<T> surface_at(const SurfaceRays<T>& t, Index pose, Index patch,
                                   const T (&b)[3]) {
  const int32* corner = t.lists.triangles + 3 * patch;
  const Shell<T> s = shell_of(t.base, corner, b);
  const Vec3<T> d = director(s);
  Vec3<T> x = base_point(s);
  T h = T(0), scale = T(1);
  if (t.on_surface) {
    h = solve_height(t.quadrics, t.lists, patch, x, d);
    x = multiply_add(h, d, x);
  }
  const Field<T> r = bumps_at(t.quadrics, t.lists, patch, x);
  if (t.on_surface) scale = T(1) / (T(1) - dot(r.gradient, d));
  T slope[2];
  for (int c = 0; c < 2; ++c)
    slope[c] = dot(r.gradient, multiply_add(h, director_tangent(s, c), base_tangent(s, c))) * scale;
  if (!t.on_surface) h = r.value;
  Vec3<T> sum[3], turned[2][3];
  for (int k = 0; k < 3; ++k) {
    const Index vertex = pose * t.lists.vertices + corner[k];
    const Mat3<T> a = load9(t.frames, vertex);
    sum[k] = load3(t.positions, vertex) + a * arm(s, k, h);
    for (int c = 0; c < 2; ++c) turned[c][k] = a * arm_tangent(s, k, c, slope[c]);
  }
  return {blend(s.b, sum),
          {sum[0] - sum[2] + blend(s.b, turned[0]), sum[1] - sum[2] + blend(s.b, turned[1])}};
}

// A ray and two directions across it (Duff et al. 2017): what meets it has no component along either.
template <class T>
struct Sight {
  Vec3<T> o, d, u, v, inverse;  // of d, component by component
};

template <class T>
PD_HD Sight<T> sight_along(const Vec3<T>& o, const Vec3<T>& d) {
  const T sign = d.z < T(0) ? T(-1) : T(1), a = T(-1) / (sign + d.z), b = d.x * d.y * a;
  return {o,
          d,
          {T(1) + sign * d.x * d.x * a, sign * b, -sign * d.x},
          {b, sign + d.y * d.y * a, -d.y},
          {T(1) / d.x, T(1) / d.y, T(1) / d.z}};
}

template <class T>
struct Hit {
  T depth;
  int32 patch;
  T b[3];
};

enum class End { nowhere, beside, on_patch };

// Newton's method from b, and where it ends.
template <class T>
PD_HD End refine(const SurfaceRays<T>& t, Index pose, Index patch, const Sight<T>& ray, T (&b)[3],
                 T& depth) {
  const T most = t.cells.size;
  for (int step = 0; step < 24; ++step) {
    const SurfaceElement<T> s = surface_at(t, pose, patch, b);
    const Vec3<T> r = s.point - ray.o;
    const T x = dot(r, ray.u), y = dot(r, ray.v);
    const T xx = dot(s.tangent[0], ray.u), xy = dot(s.tangent[1], ray.u);
    const T yx = dot(s.tangent[0], ray.v), yy = dot(s.tangent[1], ray.v);
    const T det = multiply_subtract(xx, yy, xy * yx);
    T p = xy * y - yy * x, q = yx * x - xx * y;
    const T rounding = T(32) * epsilon<T>() * (largest(s.point) + largest(ray.o));
    const bool close = absolute(x) <= rounding && absolute(y) <= rounding;
    // never by more than a cell
    const T bound = most * absolute(det), longest = greater(absolute(p), absolute(q));
    const T scale = longest <= bound ? T(1) / det : most / longest * (det < T(0) ? T(-1) : T(1));
    const bool flat = !(longest > T(0)) || (close && !(longest <= bound));
    p = flat ? T(0) : p * scale;
    q = flat ? T(0) : q * scale;
    b[0] = b[0] + p;
    b[1] = b[1] + q;
    b[2] = T(1) - b[0] - b[1];
    const T outside = lesser(lesser(b[0], b[1]), b[2]);
    if (close) {
      depth = dot(multiply_add(p, s.tangent[0], multiply_add(q, s.tangent[1], r)), ray.d);
      return outside >= T(-512) * epsilon<T>() ? End::on_patch : End::beside;
    }
    if (!(outside >= T(-2) * most)) break;
  }
  return End::nowhere;
}

template <class T>
PD_HD T turn(const T (&a)[2], const T (&b)[2]) {
  return multiply_subtract(a[0], b[1], a[1] * b[0]);
}

// The nearest hit so far, after one cell more.
template <class T>
PD_HD void meet_cell(const SurfaceRays<T>& t, Index pose, Index number, const Sight<T>& ray,
                     Hit<T>& hit) {
  const Cells<T>& c = t.cells;
  const int32* cell = c.cells + cell_numbers * number;
  T flat[3][2], along[3], area[3], nearest = biggest<T>(), farthest = -biggest<T>();
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> r = load3(c.points, pose * c.samples + cell[k]) - ray.o;
    flat[k][0] = dot(r, ray.u);
    flat[k][1] = dot(r, ray.v);
    along[k] = dot(r, ray.d);
    nearest = lesser(nearest, along[k]);
    farthest = greater(farthest, along[k]);
  }
  const T slack = c.slack[pose * c.count + number] +
                  T(16) * epsilon<T>() * (largest(ray.o) + absolute(farthest));
  if (nearest - slack > hit.depth || farthest + slack < t.rays.near) return;
  for (int k = 0; k < 3; ++k) area[k] = turn(flat[(k + 1) % 3], flat[(k + 2) % 3]);
  const T whole = area[0] + area[1] + area[2], side = whole < T(0) ? T(-1) : T(1);
  T longest = T(0);
  for (int k = 0; k < 3; ++k) {
    const T* e = flat[(k + 1) % 3];
    const T* f = flat[(k + 2) % 3];
    const T length = square_root((e[0] - f[0]) * (e[0] - f[0]) + (e[1] - f[1]) * (e[1] - f[1]));
    if (side * area[k] < -slack * length) return;  // beyond this edge
    longest = greater(longest, length);
  }
  // seen so steeply that it may be met twice
  const bool edge_on = absolute(whole) <= T(8) * slack * longest;
  const T* place = c.places + 9 * cell[cell_numbers - 1];
  for (int start = 0; start < 4; ++start) {
    T inner[3], total = T(0), b[3], depth;
    for (int k = 0; k < 3; ++k) {
      inner[k] = start > 0 ? T(int(k == start - 1))
                 : edge_on ? T(1)
                           : greater(T(0), area[k] / whole);
      total = total + inner[k];
    }
    for (int k = 0; k < 3; ++k)
      b[k] = (inner[0] * place[k] + inner[1] * place[3 + k] + inner[2] * place[6 + k]) / total;
    const End end = refine(t, pose, cell[cell_numbers - 2], ray, b, depth);
    if (end == End::on_patch && depth >= t.rays.near && depth < hit.depth)
      hit = {depth, cell[cell_numbers - 2], {b[0], b[1], b[2]}};
    if (end != End::nowhere && !edge_on) break;
  }
}

// Whether a ray enters a box before `far`, and where.
template <class T>
PD_HD bool enters(const T* box, const Sight<T>& ray, const T& near, const T& far, T& entry) {
  const T o[3] = {ray.o.x, ray.o.y, ray.o.z};
  const T inverse[3] = {ray.inverse.x, ray.inverse.y, ray.inverse.z};
  T from = near, to = far;
  for (int k = 0; k < 3; ++k) {
    if (!(absolute(inverse[k]) <= biggest<T>())) {  // along two of the sides
      if (o[k] < box[k] || o[k] > box[3 + k]) return false;
      continue;
    }
    const T a = (box[k] - o[k]) * inverse[k], b = (box[3 + k] - o[k]) * inverse[k];
    const T widened = T(4) * epsilon<T>();  // more than the rounding of either
    const T first = lesser(a, b), last = greater(a, b);
    from = greater(from, first - widened * absolute(first));
    to = lesser(to, last + widened * absolute(last));
  }
  entry = from;
  return from <= to;
}

template <class T>
PD_HD void first_hit(const SurfaceRays<T>& t, Index pose, const Sight<T>& ray, Hit<T>& hit) {
  const Cells<T>& c = t.cells;
  const T* boxes = c.boxes + 6 * pose * nodes_of(c);
  const Index leaves = Index(1) << c.levels;
  Index waiting[40];
  T entry[40];
  int depth = 0;
  if (enters(boxes, ray, t.rays.near, hit.depth, entry[0])) waiting[depth++] = 0;
  while (depth > 0) {
    --depth;
    const Index node = waiting[depth];
    if (entry[depth] > hit.depth) continue;
    if (node >= leaves - 1) {
      const Index leaf = node - (leaves - 1);
      for (Index n = first_cell(c, leaf); n < first_cell(c, leaf + 1); ++n)
        meet_cell(t, pose, n, ray, hit);
      continue;
    }
    T at[2];
    bool in[2];
    for (int k = 0; k < 2; ++k)
      in[k] = enters(boxes + 6 * (2 * node + 1 + k), ray, t.rays.near, hit.depth, at[k]);
    const int nearer = in[0] && in[1] && at[1] < at[0] ? 1 : 0;  // on top of the other
    for (int k = 0; k < 2; ++k) {
      const int child = k == 0 ? 1 - nearer : nearer;
      if (!in[child]) continue;
      waiting[depth] = 2 * node + 1 + child;
      entry[depth++] = at[child];
    }
  }
}

// Item: a ray in a pose.
template <class T>
PD_HD void item(const SurfaceRays<T>& t, Index i) {
  const Index pose = i / t.rays.count, ray = i % t.rays.count;
  const Sight<T> sight = sight_along(load3(t.rays.origins + pose * t.rays.origin_step, ray),
                                     load3(t.rays.directions + pose * t.rays.direction_step, ray));
  Hit<T> hit = {t.rays.far, -1, {T(0), T(0), T(0)}};
  // one that is not finite meets nothing
  if (dot(sight.o, sight.o) + dot(sight.d, sight.d) <= biggest<T>()) first_hit(t, pose, sight, hit);
  t.depth[i] = hit.patch < 0 ? T(HUGE_VAL) : hit.depth;
  t.patch[i] = hit.patch;
  for (int k = 0; k < 3; ++k) t.barycentrics[3 * i + k] = hit.b[k];
}

}  // namespace pd::freeform::inline PD_TARGET
