// The first point of the posed surface on each ray.
//
// Every patch is cut into cells, triangles of its barycentric grid. The surface over a cell lies within `slack` of the triangle of
// its corners, which 12 points inside the cell tell; the cells lie in a tree of boxes. Seen along a ray, the triangle is flat: the ray can meet the surface only if it passes within the slack of it. Then
// Newton's method finds S(b) = o + t d from where the ray meets the triangle, and where the cell is seen edge-on, so that it may
// be met twice, from its corners too. A patch counts as far as its edges, so neighbours leave no gap between them.
#pragma once
#include "patches/height.h"
#include "patches/surface.h"
#include "patches/tree.h"

namespace pd::freeform {

constexpr int check_points = 12;
constexpr int cell_numbers = 3 + check_points + 2;  // corners and checks in `points`, patch, place
constexpr int sheet_numbers = 27;

// Where the surface is, cell by cell.
template <class T>
struct Cells {
  Tree<T> tree;
  const int32* cells;  // [C, 17], in the order of the leaves
  const T* weights;    // [12, 3] barycentric coordinates of the checks in their cell
  const T* places;     // [m^2, 9] barycentric coordinates of the corners of a cell in its patch
  const T* points;     // [B, N, 3] m
  T* slack;            // [B, C] m
  Index samples, patches, cells_of_patch;
  T size;  // edge of a cell in barycentric coordinates, 1 / m
};

template <class T>
struct CellBoxes {
  Cells<T> cells;
};

// The posed surface patch by patch, its frames multiplied out: with A_k, v_k, e_k and u_k of patches/surface.h,
//   sum_k b_k (v_k + A_k u_k) = sum_k b_k v_k + sum_{k<j} b_k b_j (A_k - A_j)(V_j - V_k) / 2 + sum_k b_k (h + l_k) A_k N_k,
// which takes half of the arithmetic at every further place on the patch.
template <class T>
struct PosedSheets {
  Lists lists;
  Base<T> base;
  const T *positions, *frames;  // [B, V, 3], [B, V, 3, 3]
  T* sheets;                    // [B, P, 27]
};

template <class T>
struct SurfaceRays {
  Lists lists;
  Base<T> base;
  Ellipsoids<T> quadrics;
  Cells<T> cells;
  Rays<T> rays;
  const T* sheets;  // [B, P, 27]
  bool on_surface;
  T* depth;         // [B, R] m, infinite without a hit
  int32* patch;     // [B, R], -1 without a hit
  T* barycentrics;  // [B, R, 3]
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

// Whether the numbers of a cell point into the arrays.
PD_HD bool is_cell(const int32* cell, Index samples, Index patches, Index places) {
  bool is = is_below(cell[cell_numbers - 2], patches) && is_below(cell[cell_numbers - 1], places);
  for (int k = 0; k < 3 + check_points; ++k) is = is && is_below(cell[k], samples);
  return is;
}

// Item: a leaf of a pose.
template <class T>
PD_HD void item(const CellBoxes<T>& t, Index i) {
  const Cells<T>& c = t.cells;
  const Index pose = i >> c.tree.levels, leaf = i - (pose << c.tree.levels);
  const T* points = c.points + 3 * pose * c.samples;
  const T most = biggest<T>();
  Box<T> box = {{most, most, most}, {-most, -most, -most}};
  for (Index n = first_of(c.tree, leaf); n < first_of(c.tree, leaf + 1); ++n) {
    const int32* cell = c.cells + cell_numbers * n;
    if (!is_cell(cell, c.samples, c.patches, c.cells_of_patch)) {
      c.slack[pose * c.tree.count + n] = T(NAN);  // never met
      continue;
    }
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
    c.slack[pose * c.tree.count + n] = slack;
    const Vec3<T> margin = {slack, slack, slack};
    join(box, own.low - margin, own.high + margin);
  }
  store_leaf(c.tree, pose, leaf, box);
}

// Item: a patch of a pose.
template <class T>
PD_HD void item(const PosedSheets<T>& t, Index i) {
  const Index pose = i / t.lists.patches;
  const int32* corner = t.lists.triangles + 3 * (i % t.lists.patches);
  Mat3<T> a[3];
  T* to = t.sheets + sheet_numbers * i;
  for (int k = 0; k < 3; ++k) {
    const Index vertex = pose * t.lists.vertices + corner[k];
    a[k] = load9(t.frames, vertex);
    store3(to, k, load3(t.positions, vertex));
    store3(to, 6 + k, a[k] * load3(t.base.directors, corner[k]));
  }
  for (int k = 0; k < 3; ++k) {
    const int next = (k + 1) % 3;
    const Vec3<T> half =
        T(0.5) * (load3(t.base.vertices, corner[next]) - load3(t.base.vertices, corner[k]));
    const Mat3<T> apart = {
        {a[k].row[0] - a[next].row[0], a[k].row[1] - a[next].row[1], a[k].row[2] - a[next].row[2]}};
    store3(to, 3 + k, apart * half);
  }
}

// One patch at rest and in a pose.
template <class T>
struct Sheet {
  Index patch;
  T lift;
  Vec3<T> v[3], n[3];                      // at rest
  Vec3<T> posed[3], pair[3], director[3];  // of PosedSheets, pair k of corners k and k + 1
};

template <class T>
PD_HD Sheet<T> load_sheet(const SurfaceRays<T>& t, Index pose, Index patch) {
  Sheet<T> s;
  s.patch = patch;
  s.lift = t.base.lift;
  const T* from = t.sheets + sheet_numbers * (pose * t.lists.patches + patch);
  for (int k = 0; k < 3; ++k) {
    const int32 corner = t.lists.triangles[3 * patch + k];
    s.v[k] = load3(t.base.vertices, corner);
    s.n[k] = load3(t.base.directors, corner);
    s.posed[k] = load3(from, k);
    s.pair[k] = load3(from, 3 + k);
    s.director[k] = load3(from, 6 + k);
  }
  return s;
}

// The surface at one place: a point and its tangents along the chart.
template <class T>
struct SurfaceElement {
  Vec3<T> point, tangent[2];
};

template <class T>
PD_HD SurfaceElement<T> surface_at(const SurfaceRays<T>& t, const Sheet<T>& s, const T (&b)[3]) {
  const Vec3<T> flat = blend(b, s.v);
  Vec3<T> x = flat, d = zero3<T>(), along[2] = {s.v[0] - s.v[2], s.v[1] - s.v[2]};
  T raised[3] = {T(0), T(0), T(0)}, raising[2][3] = {};
  if (s.lift != T(0)) {
    for (int k = 0; k < 3; ++k) {
      raised[k] = -s.lift * dot(flat - s.v[k], s.n[k]);
      for (int c = 0; c < 2; ++c) raising[c][k] = -s.lift * dot(s.v[c] - s.v[2], s.n[k]);
      add(x, b[k] * raised[k], s.n[k]);
    }
    for (int c = 0; c < 2; ++c) {
      add(along[c], raised[c], s.n[c]);
      add(along[c], -raised[2], s.n[2]);
      for (int k = 0; k < 3; ++k) add(along[c], b[k] * raising[c][k], s.n[k]);
    }
  }
  T h = T(0), scale = T(1);
  if (t.on_surface) {
    d = blend(b, s.n);
    h = solve_height(t.quadrics, t.lists, s.patch, x, d);
    x = multiply_add(h, d, x);
    for (int c = 0; c < 2; ++c) add(along[c], h, s.n[c] - s.n[2]);
  }
  const Field<T> r = bumps_at(t.quadrics, t.lists, s.patch, x);
  if (t.on_surface) {
    scale = T(1) / (T(1) - dot(r.gradient, d));
  } else {
    h = r.value;
  }
  SurfaceElement<T> e;
  const T reach[3] = {h + raised[0], h + raised[1], h + raised[2]};
  e.point = blend(b, s.posed);
  for (int k = 0; k < 3; ++k) {
    add(e.point, b[k] * b[(k + 1) % 3], s.pair[k]);
    add(e.point, b[k] * reach[k], s.director[k]);
  }
  for (int c = 0; c < 2; ++c) {
    const T slope = dot(r.gradient, along[c]) * scale;
    Vec3<T> tangent = s.posed[c] - s.posed[2];
    // of the pairs, that without the third corner grows, that without c shrinks, and theirs does both
    add(tangent, b[1 - c], s.pair[0] - s.pair[1 + c]);
    add(tangent, b[2] - b[c], s.pair[2 - c]);
    for (int k = 0; k < 3; ++k) add(tangent, b[k] * (slope + raising[c][k]), s.director[k]);
    add(tangent, reach[c], s.director[c]);
    add(tangent, -reach[2], s.director[2]);
    e.tangent[c] = tangent;
  }
  return e;
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
PD_HD End refine(const SurfaceRays<T>& t, const Sheet<T>& sheet, const Sight<T>& ray, T (&b)[3],
                 T& depth) {
  const T most = t.cells.size;
  for (int step = 0; step < 24; ++step) {
    const SurfaceElement<T> s = surface_at(t, sheet, b);
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
  const T bulge = c.slack[pose * c.tree.count + number];
  if (!(bulge >= T(0))) return;  // not finite, or points outside the arrays
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
  const T slack = bulge + T(16) * epsilon<T>() * (largest(ray.o) + absolute(farthest));
  // so that a cell that is not finite is left at once
  if (!(nearest - slack <= hit.depth && farthest + slack >= t.rays.near)) return;
  for (int k = 0; k < 3; ++k) area[k] = turn(flat[(k + 1) % 3], flat[(k + 2) % 3]);
  const T whole = area[0] + area[1] + area[2], side = whole < T(0) ? T(-1) : T(1);
  if (!(absolute(whole) <= biggest<T>())) return;
  T longest = T(0);
  for (int k = 0; k < 3; ++k) {
    const T* e = flat[(k + 1) % 3];
    const T* f = flat[(k + 2) % 3];
    const T square = (e[0] - f[0]) * (e[0] - f[0]) + (e[1] - f[1]) * (e[1] - f[1]);
    const T inside = side * area[k];
    if (inside < T(0) && inside < -slack * square_root(square)) return;  // beyond this edge
    longest = greater(longest, square);
  }
  // seen so steeply that it may be met twice
  const bool edge_on = absolute(whole) <= T(8) * slack * square_root(longest);
  const T* place = c.places + 9 * cell[cell_numbers - 1];
  const Sheet<T> sheet = load_sheet(t, pose, cell[cell_numbers - 2]);
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
    const End end = refine(t, sheet, ray, b, depth);
    if (end == End::on_patch && depth >= t.rays.near && depth < hit.depth)
      hit = {depth, cell[cell_numbers - 2], {b[0], b[1], b[2]}};
    if (end != End::nowhere && !edge_on) break;
  }
}

// Visits leaves with the cells that they hold.
template <class T>
struct MeetCells {
  const SurfaceRays<T>& task;
  Index pose;
  const Sight<T>& ray;
  Hit<T>& hit;

  PD_HD void operator()(Index number) const { meet_cell(task, pose, number, ray, hit); }
};

// Item: a ray in a pose.
template <class T>
PD_HD void item(const SurfaceRays<T>& t, Index i) {
  const Index pose = i / t.rays.count, ray = i % t.rays.count;
  const Sight<T> sight = sight_along(load3(t.rays.origins + pose * t.rays.origin_step, ray),
                                     load3(t.rays.directions + pose * t.rays.direction_step, ray));
  Hit<T> hit = {t.rays.far, -1, {T(0), T(0), T(0)}};
  // one that is not finite meets nothing
  if (dot(sight.o, sight.o) + dot(sight.d, sight.d) <= biggest<T>())
    visit(t.cells.tree, pose, sight, t.rays.near, hit.depth, T(0),
          MeetCells<T>{t, pose, sight, hit});
  t.depth[i] = hit.patch < 0 ? T(HUGE_VAL) : hit.depth;
  t.patch[i] = hit.patch;
  for (int k = 0; k < 3; ++k) t.barycentrics[3 * i + k] = hit.b[k];
}

}  // namespace pd::freeform::inline PD_TARGET
