// First intersection of each ray with the posed surface.
//
// Every patch is divided into cells, triangles of its barycentric grid, which are stored in a tree
// of boxes. The surface over a cell lies within `slack` of the triangle of its corners; 12 check
// points inside the cell determine the slack. A ray can intersect the surface only if it passes the
// triangle within the slack. Newton's method then solves S(b) = o + t d, from the intersection with
// the triangle. Where the ray sees the cell edge-on and may intersect it twice, it also starts from
// the corners. A patch extends beyond its edges by the rounding of positions, so neighbours leave
// no gap.
//
// Newton's method stops early when it converges to the known hit. A cell right beside that hit is
// skipped unless it is seen edge-on. Both rely on cells that are no longer than the quadrics are
// wide.
#pragma once
#include "freeform/box_tree.h"
#include "freeform/posed_surface.h"

namespace pd::freeform {

constexpr int check_points = 12;
constexpr int cell_size = 3 + check_points + 2;  // corners and checks in `points`, patch, place
constexpr int cell_simd4_size = 4 * (9 + 1);     // corners and slack

// The cells of the surface.
template <class T>
struct Cells {
  Tree<T> tree;
  const int32* cells;  // [C, 17], in the order of the leaves
  const T* weights;    // [12, 3] barycentric coordinates of the checks in their cell
  const T* places;     // [m^2, 9] barycentric coordinates of the corners of a cell in its patch
  const T* points;     // [B, N, 3] m
  // [B, leaves, 10, 4] m; up to four cells per leaf, component by component: corners and slack, NaN
  // if missing
  T* simd4;
  Index samples, patches, cells_of_patch;
  T size;  // edge of a cell in barycentric coordinates, 1 / m
};

template <class T>
struct CellBoxes {
  Cells<T> cells;
};

template <class T>
struct SurfaceRays {
  PosedSurface<T> surface;
  Cells<T> cells;
  Rays<T> rays;
  T* depth;             // [B, R] m, infinite without a hit
  int32* patch;         // [B, R], -1 without a hit
  T* barycentrics;      // [B, R, 3]
  T *points, *normals;  // [B, R, 3] m and of unit length, or null
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

// Whether the indices of a cell are in range.
PD_HD bool is_cell(const int32* cell, Index samples, Index patches, Index places) {
  bool is = is_below(cell[cell_size - 2], patches) && is_below(cell[cell_size - 1], places);
  for (int k = 0; k < 3 + check_points; ++k) is = is && is_below(cell[k], samples);
  return is;
}

// Item: one leaf of one pose.
template <class T>
PD_HD void item(const CellBoxes<T>& t, Index i) {
  const Cells<T>& c = t.cells;
  const Index pose = i >> c.tree.levels, leaf = i - (pose << c.tree.levels);
  const T* points = c.points + 3 * pose * c.samples;
  const T most = biggest<T>();
  Box<T> box = {{most, most, most}, {-most, -most, -most}};
  T* simd4 = c.simd4 + cell_simd4_size * i;
  for (int k = 0; k < cell_simd4_size; ++k) simd4[k] = T(NAN);
  for (Index n = first_of(c.tree, leaf); n < first_of(c.tree, leaf + 1); ++n) {
    const int32* cell = c.cells + cell_size * n;
    // skipped, like a missing cell
    if (!is_cell(cell, c.samples, c.patches, c.cells_of_patch)) continue;
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
    // margin for the surface between the check points
    const T slack = T(1.5) * square_root(apart) + rounding;
    T* to = simd4 + n - first_of(c.tree, leaf);
    const T numbers[10] = {p[0].x, p[0].y, p[0].z, p[1].x, p[1].y,
                           p[1].z, p[2].x, p[2].y, p[2].z, slack};
    for (int k = 0; k < 10; ++k) to[4 * k] = numbers[k];
    const Vec3<T> margin = {slack, slack, slack};
    join(box, own.low - margin, own.high + margin);
  }
  store_leaf(c.tree, pose, leaf, box);
}

template <class T>
struct Hit {
  T depth;
  int32 patch;
  T b[3];
};

// The largest difference between two barycentric coordinates.
template <class T>
PD_HD T apart(const T (&a)[3], const T* b) {
  return greater(greater(absolute(a[0] - b[0]), absolute(a[1] - b[1])), absolute(a[2] - b[2]));
}

enum class RefineResult { diverged, outside_patch, on_patch };

// Newton's method from b, and how it ends. The error after a full step is of second order in the
// step. The ratio of two steps therefore predicts the next error; where that is negligible, no
// further evaluation is needed.
template <class T>
PD_HD RefineResult refine(const SurfaceRays<T>& t, const PosedPatch<T>& posed,
                          const RayFrame<T>& ray, const T* known, T (&b)[3], T& depth) {
  const T most = t.cells.size;
  T before = T(0);  // length of the previous step if it was a full one
  Vec3<T> aimed = zero3<T>();
  for (int step = 0; step < 24; ++step) {
    const SurfaceElement<T> s = surface_at(t.surface, posed, b);
    const Vec3<T> r = s.point - ray.o;
    const T x = dot(r, ray.u), y = dot(r, ray.v);
    const T xx = dot(s.tangent[0], ray.u), xy = dot(s.tangent[1], ray.u);
    const T yx = dot(s.tangent[0], ray.v), yy = dot(s.tangent[1], ray.v);
    const T det = multiply_subtract(xx, yy, xy * yx);
    T p = xy * y - yy * x, q = yx * x - xx * y;
    const T rounding = T(32) * epsilon<T>() * (largest(s.point) + largest(ray.o));
    bool close = absolute(x) <= rounding && absolute(y) <= rounding;
    // a step is at most one cell
    const T bound = most * absolute(det), longest = greater(absolute(p), absolute(q));
    const bool whole = longest <= bound;
    const T scale = whole ? T(1) / det : most / longest * (det < T(0) ? T(-1) : T(1));
    const bool flat = !(longest > T(0)) || (close && !whole);
    p = flat ? T(0) : p * scale;
    q = flat ? T(0) : q * scale;
    const T after = whole ? greater(absolute(p), absolute(q)) : T(0);
    if (whole && before > T(0)) {
      const T ratio = after / before;
      close = close ||
              (ratio < T(0.25) && largest(r - aimed) * (ratio * ratio) <= T(1) / T(64) * rounding);
    }
    b[0] = b[0] + p;
    b[1] = b[1] + q;
    b[2] = T(1) - b[0] - b[1];
    const T outside = lesser(lesser(b[0], b[1]), b[2]);
    aimed = multiply_add(p, s.tangent[0], multiply_add(q, s.tangent[1], r));
    if (close) {
      depth = dot(aimed, ray.d);
      // accuracy of the positions, in barycentric coordinates
      const T edge = greater(largest(s.tangent[0]), largest(s.tangent[1]));
      const T margin = greater(T(512) * epsilon<T>(), lesser(rounding / edge, most));
      return outside >= -margin ? RefineResult::on_patch : RefineResult::outside_patch;
    }
    // converging to the known hit
    if (known != nullptr && apart(b, known) <= T(1) / T(64) * most)
      return RefineResult::outside_patch;
    if (!(outside >= T(-2) * most)) break;
    before = after;
  }
  return RefineResult::diverged;
}

// Cells projected along a ray.
template <class T, class R>
struct ProjectedCells {
  R area[3], whole, slack, longest;
  unsigned passed;  // bits of the cells that the ray passes within the slack
};

// Projects the cells from `lane` on; R is T or Number<T>.
template <class R, class T, class Load>
PD_HD ProjectedCells<T, R> project_cells(const T* simd4, const Load& load, const RayFrame<T>& ray,
                                         const T& near, const T& far) {
  const auto spread = [](const Vec3<T>& a) { return Vec3<R>{R(a.x), R(a.y), R(a.z)}; };
  const Vec3<R> o = spread(ray.o), d = spread(ray.d), u = spread(ray.u), v = spread(ray.v);
  ProjectedCells<T, R> s;
  R flat[3][2], along[3];
  for (int k = 0; k < 3; ++k) {
    const T* p = simd4 + 12 * k;
    const Vec3<R> r = Vec3<R>{load(p), load(p + 4), load(p + 8)} - o;
    flat[k][0] = dot(r, u);
    flat[k][1] = dot(r, v);
    along[k] = dot(r, d);
  }
  const R nearest = lesser(lesser(along[0], along[1]), along[2]);
  const R farthest = greater(greater(along[0], along[1]), along[2]);
  s.slack = load(simd4 + 36) + R(T(16) * epsilon<T>()) * (R(largest(ray.o)) + absolute(farthest));
  // rejects cells that are not finite
  s.passed = bits_of(nearest - s.slack <= R(far)) & bits_of(R(near) <= farthest + s.slack);
  for (int k = 0; k < 3; ++k) {
    const R *e = flat[(k + 1) % 3], *f = flat[(k + 2) % 3];
    s.area[k] = multiply_subtract(e[0], f[1], e[1] * f[0]);
  }
  s.whole = s.area[0] + s.area[1] + s.area[2];
  s.passed &= bits_of(absolute(s.whole) <= R(biggest<T>()));
  s.longest = R(T(0));
  for (int k = 0; k < 3; ++k) {
    const R *e = flat[(k + 1) % 3], *f = flat[(k + 2) % 3], x = e[0] - f[0], y = e[1] - f[1];
    const R length = square_root(x * x + y * y);
    // not beyond this edge, for either orientation of the cell
    const R inside = select(s.whole < R(T(0)), -s.area[k], s.area[k]);
    s.passed &= bits_of(-(s.slack * length) <= inside);
    s.longest = greater(s.longest, length);
  }
  return s;
}

// Updates the nearest hit with one more cell.
template <class T>
PD_HD void intersect_cell(const SurfaceRays<T>& t, Index pose, const int32* cell,
                          const ProjectedCells<T, T>& projected, const RayFrame<T>& ray,
                          Hit<T>& hit) {
  // nearly edge-on: the ray may intersect the cell twice
  const bool edge_on = absolute(projected.whole) <= T(8) * projected.slack * projected.longest;
  const int32 patch = cell[cell_size - 2];
  const T* place = t.cells.places + 9 * cell[cell_size - 1];
  // beside the hit on the same patch, with one intersection: the same hit
  if (!edge_on && hit.patch == patch) {
    T b[3];
    for (int k = 0; k < 3; ++k) {
      b[k] = (projected.area[0] * place[k] + projected.area[1] * place[3 + k] +
              projected.area[2] * place[6 + k]) /
             projected.whole;
    }
    if (apart(b, hit.b) <= T(0.25) * t.cells.size) return;
  }
  const PosedPatch<T> posed = load_posed_patch(t.surface, pose, patch);
  for (int start = 0; start < 4; ++start) {
    T inner[3], total = T(0), b[3], depth;
    for (int k = 0; k < 3; ++k) {
      inner[k] = start > 0 ? T(int(k == start - 1))
                 : edge_on ? T(1)
                           : greater(T(0), projected.area[k] / projected.whole);
      total = total + inner[k];
    }
    for (int k = 0; k < 3; ++k)
      b[k] = (inner[0] * place[k] + inner[1] * place[3 + k] + inner[2] * place[6 + k]) / total;
    const RefineResult end = refine(t, posed, ray, hit.patch == patch ? hit.b : nullptr, b, depth);
    if (end == RefineResult::on_patch && depth >= t.rays.near && depth < hit.depth)
      hit = {depth, patch, {b[0], b[1], b[2]}};
    if (end != RefineResult::diverged && !edge_on) break;
  }
}

// Intersects the ray with the cells of a leaf.
template <class T>
struct IntersectCells {
  const SurfaceRays<T>& task;
  Index pose;
  const RayFrame<T>& ray;
  Hit<T>& hit;

  PD_HD void operator()(Index leaf) const {
    const Cells<T>& c = task.cells;
    const T* simd4 = c.simd4 + cell_simd4_size * ((pose << c.tree.levels) + leaf);
    const Index first = first_of(c.tree, leaf), count = first_of(c.tree, leaf + 1) - first;
    const auto one = [](const T* from) { return *from; };
    for (int lane = 0; lane < count; lane += Lanes<T>::width) {
      const auto projected =
          project_cells<Number<T>>(simd4 + lane, Lanes<T>::load, ray, task.rays.near, hit.depth);
      for (int k = 0; k < Lanes<T>::width; ++k) {
        if (!(projected.passed >> k & 1)) continue;
        const int32* cell = c.cells + cell_size * (first + lane + k);
        if constexpr (Lanes<T>::width == 1) {
          intersect_cell(task, pose, cell, projected, ray, hit);
        } else {
          // earlier cells may have moved the hit nearer
          const auto again =
              project_cells<T>(simd4 + lane + k, one, ray, task.rays.near, hit.depth);
          if (again.passed) intersect_cell(task, pose, cell, again, ray, hit);
        }
      }
    }
  }
};

// Item: one ray in one pose.
template <class T>
PD_HD void item(const SurfaceRays<T>& t, Index i) {
  const Index pose = i / t.rays.count, ray = i % t.rays.count;
  const Vec3<T> d = load3(t.rays.directions + pose * t.rays.direction_step, ray);
  // scales by the largest component first, since its square alone could overflow
  const Vec3<T> scaled = (T(1) / largest(d)) * d;
  const RayFrame<T> frame = ray_frame(load3(t.rays.origins + pose * t.rays.origin_step, ray),
                                      (T(1) / square_root(dot(scaled, scaled))) * scaled);
  Hit<T> hit = {t.rays.far, -1, {T(0), T(0), T(0)}};
  // a ray that is not finite hits nothing
  if (dot(frame.o, frame.o) + dot(frame.d, frame.d) <= biggest<T>())
    visit(t.cells.tree, pose, frame, t.rays.near, hit.depth, T(0),
          IntersectCells<T>{t, pose, frame, hit});
  t.depth[i] = hit.patch < 0 ? T(HUGE_VAL) : hit.depth;
  t.patch[i] = hit.patch;
  for (int k = 0; k < 3; ++k) t.barycentrics[3 * i + k] = hit.b[k];
  if (t.points == nullptr) return;
  Vec3<T> point = zero3<T>(), normal = zero3<T>();
  if (hit.patch >= 0) {
    const SurfaceElement<T> s =
        surface_at(t.surface, load_posed_patch(t.surface, pose, Index(hit.patch)), hit.b);
    point = s.point;
    normal = cross(s.tangent[0], s.tangent[1]);
    normal = (T(1) / square_root(dot(normal, normal))) * normal;
  }
  store3(t.points, i, point);
  store3(t.normals, i, normal);
}

}  // namespace pd::freeform::inline PD_TARGET
