// The height of the surface over its base, h = sum_i R_i(x), and its derivatives along the chart.
//
// By default x = P(b) is a point of the base surface. Measured on the surface itself, x = P + h D,
// and h is the root of
//   g(h) = h - sum_i R_i(P + h D).
// The root is unique if sum_i 96/(25 sqrt 5) |a_i| |M_i D| < 1. With F_d = dD/db_d,
//   dh/db_d = grad R . (dP/db_d + h F_d) / (1 - grad R . D);
// the terms in D and F vanish where x is P.
#pragma once
#include "freeform/bounds.h"
#include "freeform/falloff.h"

namespace pd::freeform {

template <class T>
struct Height {
  Lists lists;
  Base<T> base;
  Ellipsoids<T> quadrics;
  const T* barycentrics;  // [S, 3]
  bool on_surface;
  T* heights;  // [S] m
  T* slopes;   // [S, 2] m
};

constexpr int probe_size = 7;

// Gradients of each sample with respect to its barycentric coordinates and corners. The probe (x,
// w, mu) of a sample gives the gradients of its quadrics: the loss changes as mu R(x) + grad R(x) .
// w.
template <class T>
struct HeightSamples {
  Lists lists;
  Base<T> base;
  Ellipsoids<T> quadrics;
  const T *barycentrics, *heights, *grad_heights, *grad_slopes;
  bool on_surface;
  T* grad_barycentrics;  // [S, 3]
  T* corners;            // [S, 18]
  T* probes;             // [S, 7]
};

// Gradients of each entry with respect to its quadric, summed over the samples of its patch.
template <class T>
struct HeightEntries {
  Lists lists;
  Ellipsoids<T> quadrics;
  const T* probes;
  T* partial;  // [entries, 10]
};

// Sums over the entries of each quadric.
template <class T>
struct HeightQuadrics {
  Lists lists;
  const T* partial;
  T *amplitudes, *centres, *factors;  // [Q], [Q, 3], [Q, 6]
};

}  // namespace pd::freeform

namespace pd::freeform::inline PD_TARGET {

// Newton's method in a bracket of the root, with bisection where a step leaves the bracket.
template <class T, class Bumps>
PD_HD T solve_height(const Bumps& bumps, const Vec3<T>& p, const Vec3<T>& d) {
  T low = T(0), high = T(0);
  bounds_of(bumps, low, high);
  T h = bumps_at(bumps, p).value;
  for (int step = 0; step < 64; ++step) {
    const Field<T> r = bumps_at(bumps, multiply_add(h, d, p));
    const T excess = h - r.value;
    (excess > T(0) ? high : low) = h;
    T next = h - excess / (T(1) - dot(r.gradient, d));
    if (!(next >= low && next <= high)) next = T(0.5) * (low + high);
    const T change = absolute(next - h);
    h = next;
    if (!(change > T(2) * epsilon<T>() * absolute(h))) break;
  }
  return h;
}

template <class T>
PD_HD void item(const Height<T>& t, Index sample) {
  const Index patch = t.lists.sample_patch[sample];
  const Shell<T> s = shell_of(t.base, t.lists.triangles + 3 * patch, t.barycentrics + 3 * sample);
  Vec3<T> x = base_point(s);
  T h = T(0), scale = T(1);
  Field<T> r;
  if (t.on_surface) {
    const Vec3<T> d = director(s);
    h = solve_height(PatchBumps<T>{t.quadrics, t.lists, patch}, x, d);
    x = multiply_add(h, d, x);
    r = bumps_at(t.quadrics, t.lists, patch, x);
    scale = T(1) / (T(1) - dot(r.gradient, d));
  } else {
    r = bumps_at(t.quadrics, t.lists, patch, x);
  }
  t.heights[sample] = t.on_surface ? h : r.value;
  for (int d = 0; d < 2; ++d) {
    const Vec3<T> along = multiply_add(h, director_tangent(s, d), base_tangent(s, d));
    t.slopes[2 * sample + d] = dot(r.gradient, along) * scale;
  }
}

template <class T>
PD_HD void item(const HeightSamples<T>& t, Index sample) {
  const Index patch = t.lists.sample_patch[sample];
  const Shell<T> s = shell_of(t.base, t.lists.triangles + 3 * patch, t.barycentrics + 3 * sample);
  const Vec3<T> d = director(s);
  const T h = t.on_surface ? t.heights[sample] : T(0);
  const Vec3<T> x = multiply_add(h, d, base_point(s));
  const Field<T> r = bumps_at(t.quadrics, t.lists, patch, x);
  const T scale = t.on_surface ? T(1) / (T(1) - dot(r.gradient, d)) : T(1);
  const T slope_grads[2] = {t.grad_slopes[2 * sample], t.grad_slopes[2 * sample + 1]};

  // w: the factor of grad R in the loss
  Vec3<T> w = zero3<T>();
  T steepness = T(0), with_height = t.grad_heights[sample];
  for (int c = 0; c < 2; ++c) {
    const Vec3<T> turn = director_tangent(s, c);
    const Vec3<T> along = multiply_add(h, turn, base_tangent(s, c));
    add(w, slope_grads[c] * scale, along);
    if (t.on_surface) {
      steepness = steepness + slope_grads[c] * dot(r.gradient, along) * (scale * scale);
      with_height = with_height + slope_grads[c] * dot(r.gradient, turn) * scale;
    }
  }
  if (t.on_surface) add(w, steepness, d);
  const Vec3<T> bent = bumps_hessian_product(t.quadrics, t.lists, patch, x, w);
  if (t.on_surface) with_height = with_height + dot(bent, d);
  const T mu = with_height * scale;
  const Vec3<T> gx = multiply_add(mu, r.gradient, bent);

  ShellAdjoint<T> g = no_gradient<T>();
  base_point_vjp(s, gx, g);
  for (int c = 0; c < 2; ++c) {
    base_tangent_vjp(s, c, (slope_grads[c] * scale) * r.gradient, g);
    if (t.on_surface) director_tangent_vjp(c, (slope_grads[c] * scale * h) * r.gradient, g);
  }
  if (t.on_surface) director_vjp(s, multiply_add(steepness, r.gradient, h * gx), g);
  shell_vjp(s, g);
  for (int k = 0; k < 3; ++k) t.grad_barycentrics[3 * sample + k] = g.b[k];
  store_corners(t.corners, sample, g);
  T* probe = t.probes + probe_size * sample;
  store3(probe, 0, x);
  store3(probe, 1, w);
  probe[6] = mu;
}

template <class T>
PD_HD void item(const HeightEntries<T>& t, Index entry) {
  const Index patch = t.lists.entry_patch[entry];
  const Bump<T> r = load_bump(t.quadrics, t.lists.entry_quadric[entry]);
  BumpAdjoint<T> g = {T(0), zero3<T>(), {T(0), T(0), T(0), T(0), T(0), T(0)}};
  for (int32 i = t.lists.sample_start[patch]; i < t.lists.sample_start[patch + 1]; ++i) {
    const T* probe = t.probes + probe_size * Index(t.lists.sample_order[i]);
    bump_vjp(r, load3(probe, 0), load3(probe, 1), probe[6], g);
  }
  T* to = t.partial + 10 * entry;
  to[0] = g.a;
  store3(to + 1, 0, g.c);
  store3(to + 4, 0, Vec3<T>{g.m.xx, g.m.yy, g.m.zz});
  store3(to + 7, 0, Vec3<T>{g.m.yx, g.m.zx, g.m.zy});
}

template <class T>
PD_HD void item(const HeightQuadrics<T>& t, Index quadric) {
  T sum[10] = {};
  for (int32 i = t.lists.quadric_start[quadric]; i < t.lists.quadric_start[quadric + 1]; ++i) {
    const T* from = t.partial + 10 * Index(t.lists.quadric_entry[i]);
    for (int n = 0; n < 10; ++n) sum[n] = sum[n] + from[n];
  }
  t.amplitudes[quadric] = sum[0];
  for (int n = 0; n < 3; ++n) t.centres[3 * quadric + n] = sum[1 + n];
  for (int n = 0; n < 6; ++n) t.factors[6 * quadric + n] = sum[4 + n];
}

}  // namespace pd::freeform::inline PD_TARGET
