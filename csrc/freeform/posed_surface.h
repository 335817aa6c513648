// The posed surface for rays: per-patch polynomials that make many evaluations on a patch cheap.
#pragma once
#include "freeform/height.h"
#include "freeform/surface.h"

namespace pd::freeform {

constexpr int posed_patch_size = 45;

// The posed surface patch by patch, with the products of its frames expanded. With A_k, v_k, e_k
// and u_k of freeform/surface.h,
//   sum_k b_k (v_k + A_k u_k) = sum_k b_k v_k + sum_{k<j} b_k b_j (A_k - A_j)(V_j - V_k) / 2
//   + sum_k b_k (h + l_k) A_k N_k.
// This form halves the arithmetic of every further evaluation on the patch. V_k and N_k follow,
// then the bumps in groups of four.
template <class T>
struct PosedPatches {
  Lists lists;
  Base<T> base;
  const T *positions, *frames;  // [B, V, 3], [B, V, 3, 3]
  T* patches;                   // [B, P, 45]
};

// The bumps of every patch in groups of four.
template <class T>
struct GatheredBumps {
  Lists lists;
  Ellipsoids<T> quadrics;
  T* simd4;  // [entries / 4 + P + 1, 10, 4]
};

// Inputs of an evaluation of the surface.
template <class T>
struct PosedSurface {
  Lists lists;
  const T *patches, *simd4;  // from PosedPatches and GatheredBumps
  T lift;                    // from Base
  bool on_surface;
};

// Corners and check points of cells: heights at rest, then points in every pose.
template <class T>
struct GridHeights {
  PosedSurface<T> surface;
  const T* barycentrics;  // [N, 3]
  T* heights;             // [N] m
};

template <class T>
struct GridPoints {
  PosedSurface<T> surface;
  const T *barycentrics, *heights;
  T* points;  // [B, N, 3] m
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

// Item: one patch of one pose.
template <class T>
PD_HD void item(const PosedPatches<T>& t, Index i) {
  const Index pose = i / t.lists.patches;
  const int32* corner = t.lists.triangles + 3 * (i % t.lists.patches);
  Mat3<T> a[3];
  T* to = t.patches + posed_patch_size * i;
  for (int k = 0; k < 3; ++k) {
    const Index vertex = pose * t.lists.vertices + corner[k];
    a[k] = load9(t.frames, vertex);
    store3(to, k, load3(t.positions, vertex));
    store3(to, 6 + k, a[k] * load3(t.base.directors, corner[k]));
    store3(to, 9 + k, load3(t.base.vertices, corner[k]));
    store3(to, 12 + k, load3(t.base.directors, corner[k]));
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

// Item: one patch.
template <class T>
PD_HD void item(const GatheredBumps<T>& t, Index patch) {
  store_simd4(t.simd4, t.quadrics, t.lists, patch);
}

// One patch at rest and in a pose.
template <class T>
struct PosedPatch {
  Vec3<T> posed[3], pair[3], director[3];  // from PosedPatches; pair k joins corners k and k + 1
  Vec3<T> v[3], n[3];                      // at rest
  BumpSimd4<T> bumps;
};

template <class T>
PD_HD PosedPatch<T> load_posed_patch(const PosedSurface<T>& t, Index pose, Index patch) {
  PosedPatch<T> s;
  const T* from = t.patches + posed_patch_size * (pose * t.lists.patches + patch);
  for (int k = 0; k < 3; ++k) {
    s.posed[k] = load3(from, k);
    s.pair[k] = load3(from, 3 + k);
    s.director[k] = load3(from, 6 + k);
    s.v[k] = load3(from, 9 + k);
    s.n[k] = load3(from, 12 + k);
  }
  s.bumps = {t.simd4 + bump_simd4_size * first_simd4(t.lists, patch), simd4_count(t.lists, patch)};
  return s;
}

template <class T>
PD_HD void item(const GridHeights<T>& t, Index i) {
  const PosedPatch<T> s = load_posed_patch(t.surface, 0, t.surface.lists.sample_patch[i]);
  const T b[3] = {t.barycentrics[3 * i], t.barycentrics[3 * i + 1], t.barycentrics[3 * i + 2]};
  const Vec3<T> flat = blend(b, s.v);
  Vec3<T> x = flat;
  if (t.surface.lift != T(0)) {
    for (int k = 0; k < 3; ++k)
      add(x, b[k] * (-t.surface.lift * dot(flat - s.v[k], s.n[k])), s.n[k]);
  }
  t.heights[i] =
      t.surface.on_surface ? solve_height(s.bumps, x, blend(b, s.n)) : bumps_at(s.bumps, x).value;
}

template <class T>
PD_HD void item(const GridPoints<T>& t, Index i) {
  const Index pose = i / t.surface.lists.samples, sample = i % t.surface.lists.samples;
  const PosedPatch<T> s = load_posed_patch(t.surface, pose, t.surface.lists.sample_patch[sample]);
  const T* from = t.barycentrics + 3 * sample;
  const T b[3] = {from[0], from[1], from[2]}, h = t.heights[sample];
  const Vec3<T> flat = blend(b, s.v);
  Vec3<T> point = blend(b, s.posed);
  for (int k = 0; k < 3; ++k) {
    add(point, b[k] * b[(k + 1) % 3], s.pair[k]);
    const T lift_height =
        t.surface.lift != T(0) ? -t.surface.lift * dot(flat - s.v[k], s.n[k]) : T(0);
    add(point, b[k] * (h + lift_height), s.director[k]);
  }
  store3(t.points, i, point);
}

// A point of the surface and its tangents along the chart.
template <class T>
struct SurfaceElement {
  Vec3<T> point, tangent[2];
};

template <class T>
PD_HD SurfaceElement<T> surface_at(const PosedSurface<T>& t, const PosedPatch<T>& s,
                                   const T (&b)[3]) {
  const Vec3<T> flat = blend(b, s.v), d = blend(b, s.director);
  Vec3<T> x = flat, along[2] = {s.v[0] - s.v[2], s.v[1] - s.v[2]};
  SurfaceElement<T> e;
  e.point = blend(b, s.posed);
  for (int k = 0; k < 3; ++k) add(e.point, b[k] * b[(k + 1) % 3], s.pair[k]);
  for (int c = 0; c < 2; ++c) {
    Vec3<T> tangent = s.posed[c] - s.posed[2];
    // derivatives of b_k b_j: direction c raises b_c and lowers the third coordinate
    add(tangent, b[1 - c], s.pair[0] - s.pair[1 + c]);
    add(tangent, b[2] - b[c], s.pair[2 - c]);
    e.tangent[c] = tangent;
  }
  if (t.lift != T(0)) {
    T lift_height[3];
    for (int k = 0; k < 3; ++k) {
      lift_height[k] = -t.lift * dot(flat - s.v[k], s.n[k]);
      add(x, b[k] * lift_height[k], s.n[k]);
      add(e.point, b[k] * lift_height[k], s.director[k]);
    }
    for (int c = 0; c < 2; ++c) {
      const Vec3<T> edge = s.v[c] - s.v[2];
      add(along[c], lift_height[c], s.n[c]);
      add(along[c], -lift_height[2], s.n[2]);
      add(e.tangent[c], lift_height[c], s.director[c]);
      add(e.tangent[c], -lift_height[2], s.director[2]);
      for (int k = 0; k < 3; ++k) {
        const T lift_slope = -t.lift * dot(edge, s.n[k]);
        add(along[c], b[k] * lift_slope, s.n[k]);
        add(e.tangent[c], b[k] * lift_slope, s.director[k]);
      }
    }
  }
  Field<T> r;
  T scale = T(1);
  if (t.on_surface) {
    const Vec3<T> up = blend(b, s.n);
    const T h = solve_height(s.bumps, x, up);
    x = multiply_add(h, up, x);
    for (int c = 0; c < 2; ++c) add(along[c], h, s.n[c] - s.n[2]);
    r = bumps_at(s.bumps, x);
    scale = T(1) / (T(1) - dot(r.gradient, up));
    r.value = h;
  } else {
    r = bumps_at(s.bumps, x);
  }
  add(e.point, r.value, d);
  for (int c = 0; c < 2; ++c) {
    add(e.tangent[c], dot(r.gradient, along[c]) * scale, d);
    add(e.tangent[c], r.value, s.director[c] - s.director[2]);
  }
  return e;
}

}  // namespace pd::freeform::inline PD_TARGET
