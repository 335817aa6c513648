// The field of one patch as published (Vyatkin and Dolgovesov 2023): F' = F + sum_i R_i, positive
// inside. F = min(p_1 .. p_5) is the solid between five planes. R_i = a_i [Q_i]_+^3 is the
// perturbation of a quadric, with Q(x) = (x, 1)^T W (x, 1). Over the triangle (v_1, v_2, v_3) with
// unit normal n and indices mod 3,
//   p_k(x) = m_k . (x - v_{k+1}),  m_k = n x (v_{k+2} - v_{k+1}) / |.|   for k = 1..3, the clip planes
//   p_4(x) = tau + n . (x - v_1),  p_5(x) = tau - n . (x - v_1),         the base planes
// where the clip planes face inwards and tau is half the thickness. The literal reading adds the
// sum to all five planes. The clipped one adds it to p_5 only: min(p_1 .. p_4, p_5 + R). Here
// quadrics need not be ellipsoids.
#pragma once
#include "freeform/views.h"

namespace pd::freeform {

template <class T>
struct PaperField {
  Lists lists;
  const T* points;      // [B, S, 3] m
  const T* positions;   // [B, V, 3] m
  const T* amplitudes;  // [Q]
  const T* matrices;    // [1 or B, Q, 4, 4]
  Index stride;         // between the matrices of consecutive poses: 0 or 16 Q
  T thickness;          // tau, m
  bool clip;
};

template <class T>
struct PaperFieldValues {
  PaperField<T> solid;
  T* out;  // [B, S] m
};

// Gradients of each sample with respect to its point and its three corners.
template <class T>
struct PaperFieldSamples {
  PaperField<T> solid;
  const T* grad;        // [B, S]
  T *points, *corners;  // [B, S, 3], [B, S, 9]
};

template <class T>
struct PaperFieldVertices {
  Lists lists;
  const T* corners;
  T* positions;  // [B, V, 3]
};

// Gradients of each entry with respect to its quadric, summed over the samples of its patch and all
// poses that share the quadric.
template <class T>
struct PaperFieldEntries {
  PaperField<T> solid;
  const T* grad;
  Index batch, sets;  // poses, and their sets of matrices
  T* partial;         // [sets, entries, 17]
};

template <class T>
struct PaperFieldQuadrics {
  Lists lists;
  const T* partial;
  Index sets;
  T *amplitudes, *matrices;  // [Q], [sets, Q, 4, 4]
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

template <class T>
PD_HD T length(const Vec3<T>& a) {
  return square_root(dot(a, a));
}

template <class T>
PD_HD void load_homogeneous(const T* from, Index row, T (&x)[4]) {
  for (int i = 0; i < 3; ++i) x[i] = from[3 * row + i];
  x[3] = T(1);
}

template <class T>
PD_HD T quadric_value(const T* w, const T (&x)[4]) {
  T q = T(0);
  for (int r = 0; r < 4; ++r) {
    T row = T(0);
    for (int c = 0; c < 4; ++c) row = multiply_add(w[4 * r + c], x[c], row);
    q = multiply_add(x[r], row, q);
  }
  return q;
}

template <class T>
PD_HD const T* matrices_of(const PaperField<T>& t, Index pose, Index entry) {
  return t.matrices + pose * t.stride + 16 * Index(t.lists.entry_quadric[entry]);
}

template <class T>
PD_HD T perturbation(const PaperField<T>& t, Index pose, Index patch, const T (&x)[4]) {
  T sum = T(0);
  for (int32 e = t.lists.patch_start[patch]; e < t.lists.patch_start[patch + 1]; ++e) {
    const T q = quadric_value(matrices_of(t, pose, e), x);
    if (q > T(0)) sum = sum + t.amplitudes[t.lists.entry_quadric[e]] * (q * q * q);
  }
  return sum;
}

// The five planes at x.
template <class T>
struct Planes {
  Vec3<T> v[3], normal, cross_edges;
  T value[5];
};

template <class T>
PD_HD Planes<T> planes_at(const PaperField<T>& t, Index pose, Index patch, const Vec3<T>& x) {
  Planes<T> p;
  for (int k = 0; k < 3; ++k)
    p.v[k] = load3(t.positions, pose * t.lists.vertices + t.lists.triangles[3 * patch + k]);
  p.cross_edges = cross(p.v[1] - p.v[0], p.v[2] - p.v[0]);
  p.normal = (T(1) / length(p.cross_edges)) * p.cross_edges;
  for (int k = 0; k < 3; ++k) {
    const Vec3<T> inward = cross(p.normal, p.v[(k + 2) % 3] - p.v[(k + 1) % 3]);
    p.value[k] = dot(inward, x - p.v[(k + 1) % 3]) / length(inward);
  }
  const T h = dot(p.normal, x - p.v[0]);
  p.value[3] = t.thickness + h;
  p.value[4] = t.thickness - h;
  return p;
}

// The first of the smallest planes; it takes the derivative where planes intersect.
template <class T>
PD_HD int smallest_of(const T (&value)[5]) {
  int least = 0;
  for (int k = 1; k < 5; ++k) least = value[k] < value[least] ? k : least;
  return least;
}

template <class T>
PD_HD void item(const PaperFieldValues<T>& t, Index i) {
  const PaperField<T>& s = t.solid;
  const Index pose = i / s.lists.samples, patch = s.lists.sample_patch[i % s.lists.samples];
  T x[4];
  load_homogeneous(s.points, i, x);
  Planes<T> p = planes_at(s, pose, patch, load3(s.points, i));
  const T r = perturbation(s, pose, patch, x);
  T f = s.clip ? p.value[4] + r : p.value[4];
  for (int k = 0; k < 4; ++k) f = lesser(f, p.value[k]);
  t.out[i] = s.clip ? f : f + r;
}

// Gradient of plane `k` with respect to x and the corners.
template <class T>
PD_HD void plane_vjp(const Planes<T>& p, int k, const Vec3<T>& x, const T& grad, Vec3<T>& gx,
                     Vec3<T> (&gv)[3]) {
  Vec3<T> to_normal;
  if (k < 3) {
    const int o = (k + 1) % 3, e = (k + 2) % 3;
    const Vec3<T> edge = p.v[e] - p.v[o], inward = cross(p.normal, edge);
    const T scale = T(1) / length(inward);
    const Vec3<T> m = scale * inward, away = x - p.v[o];
    const Vec3<T> to_inward = (grad * scale) * (away - dot(away, m) * m);
    add(gx, grad, m);
    const Vec3<T> to_edge = cross(to_inward, p.normal);
    gv[e] = gv[e] + to_edge;
    gv[o] = gv[o] - to_edge - grad * m;
    to_normal = cross(edge, to_inward);
  } else {
    const T sign = k == 3 ? grad : -grad;
    add(gx, sign, p.normal);
    gv[0] = gv[0] - sign * p.normal;
    to_normal = sign * (x - p.v[0]);
  }
  const T scale = T(1) / length(p.cross_edges);
  const Vec3<T> to_cross = scale * (to_normal - dot(to_normal, p.normal) * p.normal);
  const Vec3<T> to_first = cross(p.v[2] - p.v[0], to_cross);
  const Vec3<T> to_second = cross(to_cross, p.v[1] - p.v[0]);
  gv[1] = gv[1] + to_first;
  gv[2] = gv[2] + to_second;
  gv[0] = gv[0] - to_first - to_second;
}

template <class T>
PD_HD void item(const PaperFieldSamples<T>& t, Index i) {
  const PaperField<T>& s = t.solid;
  const Index pose = i / s.lists.samples, patch = s.lists.sample_patch[i % s.lists.samples];
  T x[4];
  load_homogeneous(s.points, i, x);
  const Vec3<T> point = load3(s.points, i);
  Planes<T> p = planes_at(s, pose, patch, point);
  if (s.clip) p.value[4] = p.value[4] + perturbation(s, pose, patch, x);
  const int least = smallest_of(p.value);
  Vec3<T> gx = zero3<T>(), gv[3] = {gx, gx, gx};
  plane_vjp(p, least, point, t.grad[i], gx, gv);
  T bend[3] = {T(0), T(0), T(0)};
  if (!s.clip || least == 4) {
    for (int32 e = s.lists.patch_start[patch]; e < s.lists.patch_start[patch + 1]; ++e) {
      const T* w = matrices_of(s, pose, e);
      const T q = quadric_value(w, x);
      if (!(q > T(0))) continue;
      const T scale = T(3) * s.amplitudes[s.lists.entry_quadric[e]] * (q * q);
      for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 4; ++c)
          bend[r] = bend[r] + scale * (w[4 * r + c] + w[4 * c + r]) * x[c];
    }
  }
  add(gx, t.grad[i], Vec3<T>{bend[0], bend[1], bend[2]});
  store3(t.points, i, gx);
  for (int k = 0; k < 3; ++k) store3(t.corners, 3 * i + k, gv[k]);
}

template <class T>
PD_HD void item(const PaperFieldVertices<T>& t, Index i) {
  const Index pose = i / t.lists.vertices, vertex = i % t.lists.vertices;
  Vec3<T> sum = zero3<T>();
  for (int32 c = t.lists.corner_start[vertex]; c < t.lists.corner_start[vertex + 1]; ++c) {
    const int32 patch = t.lists.vertex_corner[c] / 3, k = t.lists.vertex_corner[c] % 3;
    for (int32 n = t.lists.sample_start[patch]; n < t.lists.sample_start[patch + 1]; ++n)
      add(sum, load3(t.corners, 3 * (pose * t.lists.samples + t.lists.sample_order[n]) + k));
  }
  store3(t.positions, i, sum);
}

template <class T>
PD_HD void item(const PaperFieldEntries<T>& t, Index i) {
  const PaperField<T>& s = t.solid;
  const Index set = i / s.lists.entries, entry = i % s.lists.entries;
  const Index patch = s.lists.entry_patch[entry];
  const T a = s.amplitudes[s.lists.entry_quadric[entry]];
  const T* w = matrices_of(s, set, entry);
  T sum[17] = {};
  const Index first = t.sets > 1 ? set : 0, end = t.sets > 1 ? set + 1 : t.batch;
  for (Index pose = first; pose < end; ++pose) {
    for (int32 n = s.lists.sample_start[patch]; n < s.lists.sample_start[patch + 1]; ++n) {
      const Index row = pose * s.lists.samples + s.lists.sample_order[n];
      T x[4];
      load_homogeneous(s.points, row, x);
      const T q = quadric_value(w, x);
      if (!(q > T(0))) continue;
      if (s.clip) {
        Planes<T> p = planes_at(s, pose, patch, load3(s.points, row));
        p.value[4] = p.value[4] + perturbation(s, pose, patch, x);
        if (smallest_of(p.value) != 4) continue;
      }
      sum[0] = sum[0] + t.grad[row] * (q * q * q);
      const T scale = T(3) * t.grad[row] * a * (q * q);
      for (int k = 0; k < 16; ++k) sum[1 + k] = sum[1 + k] + scale * x[k / 4] * x[k % 4];
    }
  }
  for (int k = 0; k < 17; ++k) t.partial[17 * i + k] = sum[k];
}

template <class T>
PD_HD void item(const PaperFieldQuadrics<T>& t, Index quadric) {
  T amplitude = T(0);
  for (Index set = 0; set < t.sets; ++set) {
    T sum[16] = {};
    for (int32 i = t.lists.quadric_start[quadric]; i < t.lists.quadric_start[quadric + 1]; ++i) {
      const T* from = t.partial + 17 * (set * t.lists.entries + t.lists.quadric_entry[i]);
      amplitude = amplitude + from[0];
      for (int k = 0; k < 16; ++k) sum[k] = sum[k] + from[1 + k];
    }
    T* to = t.matrices + 16 * (set * t.lists.quadrics + quadric);
    for (int k = 0; k < 16; ++k) to[k] = sum[k];
  }
  t.amplitudes[quadric] = amplitude;
}

}  // namespace pd::freeform::inline PD_TARGET
