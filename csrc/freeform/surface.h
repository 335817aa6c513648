// The surface in any pose. With posed corners v_k and their frames A_k,
//   S(b) = sum_k b_k (v_k + A_k u_k),   u_k = e_k / 2 + (h + l_k) N_k.
// Here e_k, l_k and N_k belong to the shell at rest (freeform/bounds.h). Half of e_k blends the
// three affine maps of the corners (James 2020, Phong deformation); v_k already contains the other
// half. At rest, with v = V and A = 1, the surface is P + h D. It follows an affine motion v = G V
// + t, A = G exactly. It is linear in the pose, and both sides of an edge give the same numbers.
// Tangents are the derivatives along the chart of bounds.h.
#pragma once
#include "freeform/bounds.h"

namespace pd::freeform {

template <class T>
struct Surface {
  Lists lists;
  Base<T> base;
  const T *heights, *slopes, *barycentrics;  // [S], [S, 2], [S, 3]
  const T *positions, *frames;               // [B, V, 3], [B, V, 3, 3]
  T *points, *tangents;                      // [B, S, 3], [B, S, 2, 3] m
};

// Gradients of each sample, summed over the poses.
template <class T>
struct SurfaceSamples {
  Lists lists;
  Base<T> base;
  const T *heights, *slopes, *barycentrics, *positions, *frames;
  const T *grad_points, *grad_tangents;
  Index batch;
  T *grad_heights, *grad_slopes, *grad_barycentrics, *corners;  // [S], [S, 2], [S, 3], [S, 18]
};

// Gradients with respect to the pose: sums over the samples of the patches around each vertex.
template <class T>
struct SurfacePose {
  Lists lists;
  Base<T> base;
  const T *heights, *slopes, *barycentrics;
  const T *grad_points, *grad_tangents;
  T *positions, *frames;
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

template <class T>
PD_HD Vec3<T> frame_offset(const Shell<T>& s, int k, const T& height) {
  return T(0.5) * s.corner_offset[k] + (height + s.lift_height[k]) * s.n[k];
}

// derivative along the chart
template <class T>
PD_HD Vec3<T> frame_offset_tangent(const Shell<T>& s, int k, int d, const T& slope) {
  return T(0.5) * s.edge[d] + (slope + s.lift_slope[k][d]) * s.n[k];
}

template <class T>
PD_HD void item(const Surface<T>& t, Index i) {
  const Index pose = i / t.lists.samples, sample = i % t.lists.samples;
  const int32* corner = t.lists.triangles + 3 * Index(t.lists.sample_patch[sample]);
  const Shell<T> s = shell_of(t.base, corner, t.barycentrics + 3 * sample);
  const T h = t.heights[sample];
  const T slope[2] = {t.slopes[2 * sample], t.slopes[2 * sample + 1]};
  Vec3<T> v[3], carried[3], turned[2][3];
  for (int k = 0; k < 3; ++k) {
    const Index vertex = pose * t.lists.vertices + corner[k];
    const Mat3<T> a = load9(t.frames, vertex);
    v[k] = load3(t.positions, vertex);
    carried[k] = a * frame_offset(s, k, h);
    for (int d = 0; d < 2; ++d) turned[d][k] = a * frame_offset_tangent(s, k, d, slope[d]);
  }
  const Vec3<T> sum[3] = {v[0] + carried[0], v[1] + carried[1], v[2] + carried[2]};
  store3(t.points, i, blend(s.b, sum));
  for (int d = 0; d < 2; ++d) {
    store3(t.tangents, 2 * i + d,
           (v[d] - v[2]) + (carried[d] - carried[2]) + blend(s.b, turned[d]));
  }
}

// The gradient with respect to v_k + A_k u_k at corner k.
template <class T>
PD_HD Vec3<T> corner_gradient(const T& b, int k, const Vec3<T>& point, const Vec3<T>& tangent0,
                              const Vec3<T>& tangent1) {
  const Vec3<T> g = b * point;
  return k == 0 ? g + tangent0 : k == 1 ? g + tangent1 : g - (tangent0 + tangent1);
}

template <class T>
PD_HD void item(const SurfaceSamples<T>& t, Index sample) {
  const int32* corner = t.lists.triangles + 3 * Index(t.lists.sample_patch[sample]);
  const Shell<T> s = shell_of(t.base, corner, t.barycentrics + 3 * sample);
  const T h = t.heights[sample];
  const T slope[2] = {t.slopes[2 * sample], t.slopes[2 * sample + 1]};
  ShellAdjoint<T> g = no_gradient<T>();
  Vec3<T> to_offset[3], to_tangent[3][2];
  for (int k = 0; k < 3; ++k) to_offset[k] = to_tangent[k][0] = to_tangent[k][1] = zero3<T>();
  for (Index pose = 0; pose < t.batch; ++pose) {
    const Index i = pose * t.lists.samples + sample;
    const Vec3<T> point = load3(t.grad_points, i);
    const Vec3<T> tangent[2] = {load3(t.grad_tangents, 2 * i), load3(t.grad_tangents, 2 * i + 1)};
    for (int k = 0; k < 3; ++k) {
      const Index vertex = pose * t.lists.vertices + corner[k];
      const Mat3<T> a = load9(t.frames, vertex);
      const Vec3<T> at = load3(t.positions, vertex) + a * frame_offset(s, k, h);
      add(to_offset[k], corner_gradient(s.b[k], k, point, tangent[0], tangent[1]) * a);
      g.b[k] = g.b[k] + dot(point, at);
      for (int d = 0; d < 2; ++d) {
        const Vec3<T> pulled = tangent[d] * a;
        add(to_tangent[k][d], s.b[k], pulled);
        g.b[k] = g.b[k] + dot(pulled, frame_offset_tangent(s, k, d, slope[d]));
      }
    }
  }
  T to_height = T(0), to_slope[2] = {T(0), T(0)};
  for (int k = 0; k < 3; ++k) {
    const T along = dot(to_offset[k], s.n[k]);
    to_height = to_height + along;
    g.lift_height[k] = along;
    add(g.corner_offset[k], T(0.5), to_offset[k]);
    add(g.n[k], h + s.lift_height[k], to_offset[k]);
    for (int d = 0; d < 2; ++d) {
      const T steeper = dot(to_tangent[k][d], s.n[k]);
      to_slope[d] = to_slope[d] + steeper;
      g.lift_slope[k][d] = steeper;
      add(g.edge[d], T(0.5), to_tangent[k][d]);
      add(g.n[k], slope[d] + s.lift_slope[k][d], to_tangent[k][d]);
    }
  }
  shell_vjp(s, g);
  t.grad_heights[sample] = to_height;
  for (int d = 0; d < 2; ++d) t.grad_slopes[2 * sample + d] = to_slope[d];
  for (int k = 0; k < 3; ++k) t.grad_barycentrics[3 * sample + k] = g.b[k];
  store_corners(t.corners, sample, g);
}

template <class T>
PD_HD void item(const SurfacePose<T>& t, Index i) {
  const Index pose = i / t.lists.vertices, vertex = i % t.lists.vertices;
  Vec3<T> position = zero3<T>();
  Mat3<T> frame = zero9<T>();
  for (int32 c = t.lists.corner_start[vertex]; c < t.lists.corner_start[vertex + 1]; ++c) {
    const int32 patch = t.lists.vertex_corner[c] / 3, k = t.lists.vertex_corner[c] % 3;
    for (int32 n = t.lists.sample_start[patch]; n < t.lists.sample_start[patch + 1]; ++n) {
      const Index sample = t.lists.sample_order[n];
      const Shell<T> s =
          shell_of(t.base, t.lists.triangles + 3 * Index(patch), t.barycentrics + 3 * sample);
      const Index row = pose * t.lists.samples + sample;
      const Vec3<T> tangent[2] = {load3(t.grad_tangents, 2 * row),
                                  load3(t.grad_tangents, 2 * row + 1)};
      const Vec3<T> g =
          corner_gradient(s.b[k], k, load3(t.grad_points, row), tangent[0], tangent[1]);
      add(position, g);
      add_outer(frame, T(1), g, frame_offset(s, k, t.heights[sample]));
      for (int d = 0; d < 2; ++d)
        add_outer(frame, s.b[k], tangent[d],
                  frame_offset_tangent(s, k, d, t.slopes[2 * sample + d]));
    }
  }
  store3(t.positions, i, position);
  store9(t.frames, i, frame);
}

}  // namespace pd::freeform::inline PD_TARGET
