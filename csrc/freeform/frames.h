// Rotation and stretch of the posed surface: a deformation gradient for each patch, a frame for
// each vertex.
//
// Patch p has a constraint of four vertices, its corners and an apex:
//   G_p = Ds Dm^-1,   Ds = (x_2 - x_1, x_3 - x_1, x_apex - x_1).
// With G = U diag(s) V^T and det U = det V = +1, the frames use
//   G~ = U diag(f(s)) V^T,   f(s) = min(max(|s|, lower), upper).
// This prevents inversion and flattening; where f changes nothing, they use G itself. The frame of
// a vertex is the mean of G~ over its patches, weighted by rest area.
//
// With P = U^T dG V, the derivative of G~ is U K V^T. For each pair i, j, K scales the symmetric
// part of P by (f_i - f_j) / (s_i - s_j) and its skew part by (f_i + f_j) / (s_i + s_j). The map is
// self-adjoint, so it also serves as the adjoint.
#pragma once
#include "freeform/views.h"
#include "math/svd.h"

namespace pd::freeform {

template <class T>
struct Clamp {
  T lower, upper;
};

template <class T>
struct Deformation {
  Constraints constraints;
  const T *positions, *inverse_rest;  // [B, U, 3] m, [P, 3, 3] 1/m
  const T* fallback;  // [B, P, 3, 3] for collapsed constraints; null: their nearest rotation
  Clamp<T> clamp;
  T* out;  // [B, P, 3, 3]
};

// The gradients with respect to each constraint's G and to its fallback.
template <class T>
struct DeformationGradients {
  Constraints constraints;
  const T *positions, *inverse_rest;
  bool has_fallback;
  Clamp<T> clamp;
  const T* grad;            // [B, P, 3, 3]
  T *gradients, *fallback;  // [B, P, 3, 3]; fallback may be null
};

template <class T>
struct DeformationPoints {
  Constraints constraints;
  const T *inverse_rest, *gradients;
  T* positions;  // [B, U, 3]
};

template <class T>
struct DeformationRest {
  Constraints constraints;
  const T *positions, *gradients;
  Index batch;
  T* inverse_rest;  // [P, 3, 3]
};

template <class T>
struct Frames {
  Lists lists;
  const T *gradients, *weights;  // [B, P, 3, 3], [P]
  T* out;                        // [B, V, 3, 3]
};

template <class T>
struct FramesGradients {
  Lists lists;
  const T *weights, *grad;
  T* gradients;  // [B, P, 3, 3]
};

template <class T>
struct FramesWeights {
  Lists lists;
  const T *gradients, *weights, *frames, *grad;
  Index batch;
  T* out;  // [P]
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

// Below this value, the second singular value no longer defines a direction: float32 resolves G to
// a relative 1e-7.
template <class T>
PD_HD constexpr T collapsed() {
  return T(1e-4);
}

template <class T>
PD_HD Mat3<T> edges_of(const T* positions, const int32* tet, Index first) {
  const Vec3<T> origin = load3(positions, first + tet[0]);
  return from_columns(load3(positions, first + tet[1]) - origin,
                      load3(positions, first + tet[2]) - origin,
                      load3(positions, first + tet[3]) - origin);
}

template <class T>
PD_HD Mat3<T> deformation_gradient(const Constraints& c, const T* positions, const T* inverse_rest,
                                   Index i) {
  const Index pose = i / c.count, p = i % c.count;
  return edges_of(positions, c.tets + 4 * p, pose * c.points) * load9(inverse_rest, p);
}

template <class T>
PD_HD T clamped(const Clamp<T>& clamp, const T& s) {
  const T size = absolute(s);
  return size < clamp.lower ? clamp.lower : size > clamp.upper ? clamp.upper : size;
}

// df/ds
template <class T>
PD_HD T clamped_slope(const Clamp<T>& clamp, const T& s) {
  const T size = absolute(s);
  return size < clamp.lower || size > clamp.upper ? T(0) : s < T(0) ? T(-1) : T(1);
}

template <class T>
PD_HD bool within(const Clamp<T>& clamp, const SignedSvd<T>& d) {
  return d.s[2] >= clamp.lower && d.s[0] <= clamp.upper;
}

// not `<`: NaN counts as collapsed too
template <class T>
PD_HD bool has_collapsed(const SignedSvd<T>& d) {
  return !(d.s[1] >= collapsed<T>());
}

template <class T>
PD_HD void item(const Deformation<T>& t, Index i) {
  const Mat3<T> g = deformation_gradient(t.constraints, t.positions, t.inverse_rest, i);
  const SignedSvd<T> d = signed_svd(g);
  Mat3<T> out = g;
  if (has_collapsed(d)) {
    out = t.fallback ? load9(t.fallback, i) : d.rotation();
  } else if (!within(t.clamp, d)) {
    Mat3<T> scaled = d.u;
    const Vec3<T> f = {clamped(t.clamp, d.s[0]), clamped(t.clamp, d.s[1]),
                       clamped(t.clamp, d.s[2])};
    for (int r = 0; r < 3; ++r)
      scaled.row[r] = {f.x * d.u.row[r].x, f.y * d.u.row[r].y, f.z * d.u.row[r].z};
    out = scaled * transpose(d.v);
  }
  store9(t.out, i, out);
}

template <class T>
PD_HD Mat3<T> clamped_differential(const SignedSvd<T>& d, const Clamp<T>& clamp,
                                   const Mat3<T>& dg) {
  const Mat3<T> m = transpose(d.u) * dg * d.v;
  const T p[3][3] = {{m.row[0].x, m.row[0].y, m.row[0].z},
                     {m.row[1].x, m.row[1].y, m.row[1].z},
                     {m.row[2].x, m.row[2].y, m.row[2].z}};
  T k[3][3], f[3];
  for (int i = 0; i < 3; ++i) {
    f[i] = clamped(clamp, d.s[i]);
    k[i][i] = clamped_slope(clamp, d.s[i]) * p[i][i];
  }
  for (int i = 0; i < 3; ++i) {
    for (int j = i + 1; j < 3; ++j) {
      const T gap = d.s[i] - d.s[j];
      // for nearly equal singular values, the quotient is the slope up to rounding
      const T even = gap > square_root(epsilon<T>()) * d.s[0] ? (f[i] - f[j]) / gap
                                                              : clamped_slope(clamp, d.s[j]);
      const T odd = (f[i] + f[j]) / (d.s[i] + d.s[j]);
      const T symmetric = T(0.5) * even * (p[i][j] + p[j][i]);
      const T skew = T(0.5) * odd * (p[i][j] - p[j][i]);
      k[i][j] = symmetric + skew;
      k[j][i] = symmetric - skew;
    }
  }
  const Mat3<T> inner = {
      {{k[0][0], k[0][1], k[0][2]}, {k[1][0], k[1][1], k[1][2]}, {k[2][0], k[2][1], k[2][2]}}};
  return d.u * inner * transpose(d.v);
}

template <class T>
PD_HD void item(const DeformationGradients<T>& t, Index i) {
  const Mat3<T> g = deformation_gradient(t.constraints, t.positions, t.inverse_rest, i);
  const SignedSvd<T> d = signed_svd(g);
  const Mat3<T> grad = load9(t.grad, i);
  Mat3<T> out = zero9<T>(), fallback = zero9<T>();
  if (has_collapsed(d)) {
    // Without a fallback, the rotation of a collapsed constraint counts as constant, since its
    // derivative is unbounded.
    fallback = grad;
  } else {
    out = within(t.clamp, d) ? grad : clamped_differential(d, t.clamp, grad);
  }
  store9(t.gradients, i, out);
  if (t.has_fallback) store9(t.fallback, i, fallback);
}

template <class T>
PD_HD void item(const DeformationPoints<T>& t, Index i) {
  const Constraints& c = t.constraints;
  const Index pose = i / c.points, point = i % c.points;
  Vec3<T> sum = zero3<T>();
  for (int32 n = c.tet_start[point]; n < c.tet_start[point + 1]; ++n) {
    const int32 p = c.point_tet[n] / 4, k = c.point_tet[n] % 4;
    const Mat3<T> rest = load9(t.inverse_rest, p), g = load9(t.gradients, pose * c.count + p);
    // column j of dL/dDs is dL/dG times row j of Dm^-1
    const Vec3<T> rows = k == 0 ? -(rest.row[0] + rest.row[1] + rest.row[2]) : rest.row[k - 1];
    add(sum, g * rows);
  }
  store3(t.positions, i, sum);
}

template <class T>
PD_HD void item(const DeformationRest<T>& t, Index p) {
  const Constraints& c = t.constraints;
  Mat3<T> sum = zero9<T>();
  for (Index pose = 0; pose < t.batch; ++pose) {
    const Mat3<T> edges = edges_of(t.positions, c.tets + 4 * p, pose * c.points);
    const Mat3<T> part = transpose(edges) * load9(t.gradients, pose * c.count + p);
    for (int r = 0; r < 3; ++r) add(sum.row[r], part.row[r]);
  }
  store9(t.inverse_rest, p, sum);
}

template <class T>
PD_HD T weight_around(const Lists& lists, const T* weights, Index vertex) {
  T sum = T(0);
  for (int32 c = lists.corner_start[vertex]; c < lists.corner_start[vertex + 1]; ++c)
    sum = sum + weights[lists.vertex_corner[c] / 3];
  return sum;
}

template <class T>
PD_HD void item(const Frames<T>& t, Index i) {
  const Index pose = i / t.lists.vertices, vertex = i % t.lists.vertices;
  Mat3<T> sum = zero9<T>();
  for (int32 c = t.lists.corner_start[vertex]; c < t.lists.corner_start[vertex + 1]; ++c) {
    const int32 patch = t.lists.vertex_corner[c] / 3;
    const Mat3<T> g = load9(t.gradients, pose * t.lists.patches + patch);
    for (int r = 0; r < 3; ++r) add(sum.row[r], t.weights[patch], g.row[r]);
  }
  const T share = T(1) / weight_around(t.lists, t.weights, vertex);
  for (int r = 0; r < 3; ++r) sum.row[r] = share * sum.row[r];
  store9(t.out, i, sum);
}

template <class T>
PD_HD void item(const FramesGradients<T>& t, Index i) {
  const Index pose = i / t.lists.patches, patch = i % t.lists.patches;
  Mat3<T> sum = zero9<T>();
  for (int k = 0; k < 3; ++k) {
    const Index vertex = t.lists.triangles[3 * patch + k];
    const Mat3<T> g = load9(t.grad, pose * t.lists.vertices + vertex);
    const T share = t.weights[patch] / weight_around(t.lists, t.weights, vertex);
    for (int r = 0; r < 3; ++r) add(sum.row[r], share, g.row[r]);
  }
  store9(t.gradients, i, sum);
}

template <class T>
PD_HD void item(const FramesWeights<T>& t, Index patch) {
  T sum = T(0);
  for (int k = 0; k < 3; ++k) {
    const Index vertex = t.lists.triangles[3 * patch + k];
    const T share = T(1) / weight_around(t.lists, t.weights, vertex);
    for (Index pose = 0; pose < t.batch; ++pose) {
      const Index at = pose * t.lists.vertices + vertex;
      const Mat3<T> from = load9(t.gradients, pose * t.lists.patches + patch) - load9(t.frames, at);
      sum = sum + share * frobenius(load9(t.grad, at), from);
    }
  }
  t.out[patch] = sum;
}

}  // namespace pd::freeform::inline PD_TARGET
