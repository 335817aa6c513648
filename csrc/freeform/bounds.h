// Shell coordinates of a patch, value and adjoint side by side.
//
// With barycentric coordinates b, rest corners V_k and directors N_k, the base surface is
//   P(b) = sum_k b_k (V_k + l_k N_k),   l_k = -lift e_k . N_k,   e_k = sum_j b_j (V_j - V_k).
// It is flat for lift = 0; lift = 3/4 is Phong tessellation (Boubekeur and Alexa 2008). D(b) =
// sum_k b_k N_k is not normalised, and a point at height h is P + h D. Neighbours share V, N and b
// along an edge, hence also the surface P + h D over it. Derivatives are along the chart (b_1, b_2)
// with b_3 = 1 - b_1 - b_2: direction d moves weight from corner 3 to corner d.
#pragma once
#include "freeform/views.h"

namespace pd::freeform::inline PD_TARGET {

template <class T>
struct Shell {
  Vec3<T> v[3], n[3];
  T b[3];
  T lift;
  Vec3<T> corner_offset[3];  // e_k
  Vec3<T> edge[2];           // V_d - V_3
  T lift_height[3];          // l_k
  T lift_slope[3][2];        // its derivatives
};

template <class T>
PD_HD Shell<T> shell_of(const Base<T>& base, const int32* corners, const T* barycentric) {
  Shell<T> s;
  s.lift = base.lift;
  for (int k = 0; k < 3; ++k) {
    s.v[k] = load3(base.vertices, corners[k]);
    s.n[k] = load3(base.directors, corners[k]);
    s.b[k] = barycentric[k];
  }
  for (int d = 0; d < 2; ++d) s.edge[d] = s.v[d] - s.v[2];
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> away[3] = {s.v[0] - s.v[k], s.v[1] - s.v[k], s.v[2] - s.v[k]};
    s.corner_offset[k] = blend(s.b, away);
    s.lift_height[k] = -s.lift * dot(s.corner_offset[k], s.n[k]);
    for (int d = 0; d < 2; ++d) s.lift_slope[k][d] = -s.lift * dot(s.edge[d], s.n[k]);
  }
  return s;
}

template <class T>
PD_HD Vec3<T> base_point(const Shell<T>& s) {
  const Vec3<T> lift_height[3] = {s.v[0] + s.lift_height[0] * s.n[0],
                                  s.v[1] + s.lift_height[1] * s.n[1],
                                  s.v[2] + s.lift_height[2] * s.n[2]};
  return blend(s.b, lift_height);
}

template <class T>
PD_HD Vec3<T> base_tangent(const Shell<T>& s, int d) {
  Vec3<T> p = s.edge[d] + (s.lift_height[d] * s.n[d] - s.lift_height[2] * s.n[2]);
  for (int k = 0; k < 3; ++k) add(p, s.b[k] * s.lift_slope[k][d], s.n[k]);
  return p;
}

template <class T>
PD_HD Vec3<T> director(const Shell<T>& s) {
  return blend(s.b, s.n);
}

template <class T>
PD_HD Vec3<T> director_tangent(const Shell<T>& s, int d) {
  return s.n[d] - s.n[2];
}

// Gradients with respect to all members of a Shell.
template <class T>
struct ShellAdjoint {
  Vec3<T> v[3], n[3];
  T b[3];
  Vec3<T> corner_offset[3], edge[2];
  T lift_height[3], lift_slope[3][2];
};

template <class T>
PD_HD ShellAdjoint<T> no_gradient() {
  ShellAdjoint<T> g;
  for (int k = 0; k < 3; ++k) {
    g.v[k] = g.n[k] = g.corner_offset[k] = zero3<T>();
    g.b[k] = g.lift_height[k] = g.lift_slope[k][0] = g.lift_slope[k][1] = T(0);
  }
  g.edge[0] = g.edge[1] = zero3<T>();
  return g;
}

template <class T>
PD_HD void base_point_vjp(const Shell<T>& s, const Vec3<T>& grad, ShellAdjoint<T>& g) {
  for (int k = 0; k < 3; ++k) {
    add(g.v[k], s.b[k], grad);
    add(g.n[k], s.b[k] * s.lift_height[k], grad);
    g.lift_height[k] = g.lift_height[k] + s.b[k] * dot(grad, s.n[k]);
    g.b[k] = g.b[k] + dot(grad, s.v[k] + s.lift_height[k] * s.n[k]);
  }
}

template <class T>
PD_HD void base_tangent_vjp(const Shell<T>& s, int d, const Vec3<T>& grad, ShellAdjoint<T>& g) {
  add(g.edge[d], grad);
  for (int k = 0; k < 3; ++k) {
    const T chart = T(int(k == d) - int(k == 2)), along = dot(grad, s.n[k]);
    g.lift_height[k] = g.lift_height[k] + chart * along;
    g.lift_slope[k][d] = g.lift_slope[k][d] + s.b[k] * along;
    g.b[k] = g.b[k] + s.lift_slope[k][d] * along;
    add(g.n[k], chart * s.lift_height[k] + s.b[k] * s.lift_slope[k][d], grad);
  }
}

template <class T>
PD_HD void director_vjp(const Shell<T>& s, const Vec3<T>& grad, ShellAdjoint<T>& g) {
  for (int k = 0; k < 3; ++k) {
    add(g.n[k], s.b[k], grad);
    g.b[k] = g.b[k] + dot(grad, s.n[k]);
  }
}

template <class T>
PD_HD void director_tangent_vjp(int d, const Vec3<T>& grad, ShellAdjoint<T>& g) {
  add(g.n[d], grad);
  g.n[2] = g.n[2] - grad;
}

// Propagates the gradients of derived members to corners and barycentric coordinates.
template <class T>
PD_HD void shell_vjp(const Shell<T>& s, ShellAdjoint<T>& g) {
  for (int k = 0; k < 3; ++k) {
    const T lift_height = -s.lift * g.lift_height[k];
    add(g.corner_offset[k], lift_height, s.n[k]);
    add(g.n[k], lift_height, s.corner_offset[k]);
    for (int d = 0; d < 2; ++d) {
      const T lift_slope = -s.lift * g.lift_slope[k][d];
      add(g.edge[d], lift_slope, s.n[k]);
      add(g.n[k], lift_slope, s.edge[d]);
    }
  }
  for (int k = 0; k < 3; ++k) {
    for (int j = 0; j < 3; ++j) {
      g.b[j] = g.b[j] + dot(g.corner_offset[k], s.v[j] - s.v[k]);
      add(g.v[j], s.b[j], g.corner_offset[k]);
      add(g.v[k], -s.b[j], g.corner_offset[k]);
    }
  }
  for (int d = 0; d < 2; ++d) {
    add(g.v[d], g.edge[d]);
    g.v[2] = g.v[2] - g.edge[d];
  }
}

constexpr int corner_numbers =
    18;  // gradients of a sample with respect to its corners: V_k then N_k of each corner

template <class T>
PD_HD void store_corners(T* to, Index sample, const ShellAdjoint<T>& g) {
  for (int k = 0; k < 3; ++k) {
    store3(to, 6 * sample + 2 * k, g.v[k]);
    store3(to, 6 * sample + 2 * k + 1, g.n[k]);
  }
}

}  // namespace pd::freeform::inline PD_TARGET

namespace pd::freeform {

// Gradients with respect to vertices and directors: sums over the samples of the patches around
// each vertex.
template <class T>
struct CornerSum {
  Lists lists;
  const T* corners;         // [S, 18]
  T *vertices, *directors;  // [V, 3]
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

template <class T>
PD_HD void item(const CornerSum<T>& t, Index vertex) {
  Vec3<T> v = zero3<T>(), n = zero3<T>();
  for (int32 c = t.lists.corner_start[vertex]; c < t.lists.corner_start[vertex + 1]; ++c) {
    const int32 patch = t.lists.vertex_corner[c] / 3, k = t.lists.vertex_corner[c] % 3;
    for (int32 i = t.lists.sample_start[patch]; i < t.lists.sample_start[patch + 1]; ++i) {
      const Index sample = t.lists.sample_order[i];
      add(v, load3(t.corners, 6 * sample + 2 * k));
      add(n, load3(t.corners, 6 * sample + 2 * k + 1));
    }
  }
  store3(t.vertices, vertex, v);
  store3(t.directors, vertex, n);
}

}  // namespace pd::freeform::inline PD_TARGET
