// Members of MultilevelRunner that compute energy and residual at a trial.
#pragma once
#include "cuda/multilevel/runner.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::evaluate(int k) {
#pragma unroll 1
  for (int patch = team_.rank(); patch < w_.plan.patches; patch += team_.blocks()) {
    ThreadSums sums = {{0, 0, 0}};
    sums.value[0] += pass_over_patch(
        w_, patch, shared_, SolidGradient<true>{}, NoStencilsOfPass{},
        [&](int i) { return w_.v.load(i); },
        [&](int i, const auto& loaded, const Vec3<T>& force) {
          evaluate_vertex(i, loaded, force, sums);
        });
    write_sums<Visit::update>(sums, m_.patch_sums + patch * sums_count);
  }
  team_.barrier();
  // loads these sums early; the pass over the shared vertices hides the latency
  patch_sum_[0] = patch_sum_[1] = 0;
#pragma unroll 1
  for (int patch = threadIdx.x; patch < w_.plan.patches; patch += blockDim.x) {
    for (int n = 0; n < 2; ++n) patch_sum_[n] += m_.patch_sums[patch * sums_count + n];
  }
  reduce_trial(k);
}

template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::evaluate_vertex(
    int i, const typename Vertices<T, HasContacts>::LoadedVertex& loaded, const Vec3<T>& force,
    ThreadSums& sums) const {
  const auto& v = loaded.vertex;
  sums.value[0] += loaded.energy();
  m_.trial_residual[i] = quad(v.residual(w_.contacts, loaded.u, force));
  if constexpr (HasContacts) {
    const ContactProjector<T> left = v.contact_projector(w_.contacts, loaded.u, force);
    m_.trial_free[i] = left.free;
    m_.trial_friction[i] = quad(v.friction_force(left.slip));
    m_.trial_gradient[i] = quad(v.gradient(loaded.u, force));
    // work against the friction of the iterate
    if (!c_.outer.known) return;
    sums.value[1] += double(dot(vec3(m_.friction[i]), loaded.u - vec3(m_.iterate[i])));
  }
}

// The same at shared vertices; then sums over all vertices, for the decision and for the newest
// secant pair.
template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::reduce_trial(int k) {
  newest_ = (newest_ + 1) % history;
  iteration_ = k;
  const int first_shared = w_.plan.patch_vertex[w_.plan.patches];
  pass<trial_dots, T>([&](int i, T(&sum)[trial_dots]) {
    if (i >= first_shared) {
      ThreadSums sums = {{0, 0, 0}};
      const auto loaded = w_.v.load(i);
      evaluate_vertex(i, loaded, shared_force(w_, SharedPlaces(w_.plan, i - first_shared)), sums);
      for (int n = 0; n < 2; ++n) sum[dots_energy + n] = T(sums.value[n]);
    }
    const Vec3<T> u = vec3(w_.v.u[i]);
    if (w_.settings().tolerance > 0) {
      const Vec3<T> displacement = u - vec3(w_.v.target[i]);
      sum[dots_displacement] = dot(displacement, displacement);
    }
    // no iterate yet, or no iteration left that could use the pair
    if (k == 0 || k == w_.settings().iterations) return;
    const Vec3<T> change = u - vec3(m_.iterate[i]);
    sum[dots_change] = dot(change, change);
    if constexpr (HasContacts) {
      for (int a = 0; has_space_ && a < 3; ++a) {
        const Vec3<T> d = m_.trial_free[i].row[a] - m_.free[i].row[a];
        sum[dots_free_change] += dot(d, d);
      }
    }
    if (!lbfgs_) return;
    const Vec3<T> trial_residual = vec3(m_.trial_residual[i]), residual = vec3(m_.residual[i]);
    const Vec3<T> s = restricted(i, change), y = restricted(i, trial_residual - residual);
    const Vec3<T> g = trial_vertex(w_.v.at(i), i).restricted(trial_residual, m_.trial_free + i);
    Vec3<T> differences[history];
    load_pairs(m_.s, i, differences);
#pragma unroll
    for (int j = 0; j < history; ++j) {
      if (j != newest_ && !c_.pairs.valid[j]) continue;
      const Vec3<T> s_j = j == newest_ ? s : differences[j];
      sum[dots_sy + j] = dot(s_j, y);
      sum[dots_sg + j] = dot(s_j, g);
    }
    sum[dots_s_residual] = dot(s, restricted(i, residual));
    sum[dots_yy] = dot(y, y);
    m_.s[newest_ * vertices() + i] = quad(s);
    m_.y[newest_ * vertices() + i] = quad(y);
  });
}

}  // namespace pd::inline PD_TARGET
