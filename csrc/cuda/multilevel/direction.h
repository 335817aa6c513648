// Members of MultilevelRunner that compute the search direction: M with the L-BFGS correction,
// along the free directions of contacts.
#pragma once
#include "cuda/multilevel/runner.h"

namespace pd::inline PD_TARGET {

// Computes direction = theta M g with the L-BFGS correction. Blocked directions and outliers use
// the diagonal instead.
template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::precondition() {
  if (corotates_) corotate();
  const double scale = c_.outer.weight(w_.settings().relaxation, has_contact_springs());
  const auto right_side = [&](int i) {
    Vec3<T> q = restricted(i, vec3(residual_[i]));
    if (lbfgs_) {
      Vec3<T> y[history];
      load_pairs(m_.y, i, y);
#pragma unroll
      for (int j = 0; j < history; ++j) {
        if (c_.pairs.valid[j]) q = subtract_product(q, T(c_.pairs.alpha[j]), y[j]);
      }
      q = restricted(i, q);
    }
    return T(scale) * q;
  };
  // If vertices are held that M leaves free, the coarse problem deflates the right-hand side before
  // the cycle and corrects the result after it.
  const bool deflates = corotated_ && !w_.plan.levels.direct && (HasContacts || outliers_.some);
  if (corotated_) {
    pass<turning_modes, T>([&](int i, T(&sum)[turning_modes]) {
      const Vec3<T> q = right_side(i);
      cycle_.set(i, q);
      corotation_.multiply_modes(i, q, sum);
    });
    corotation_.compute_modes(c_.total, deflates, scale);
  } else {
    each_vertex([&](int i) { cycle_.set(i, right_side(i)); });
  }
  // the last phase of the cycle can be fused with the pass that follows it
  const bool separate_finish = deflates || !lbfgs_;
  if (deflates)
    each_vertex([&](int i) { cycle_.set(i, corotation_.deflated(i, cycle_.right_side(i))); });
  cycle_.run_but_last();
  if (separate_finish) cycle_.finish();
  if (deflates) {
    pass<turning_modes, T>([&](int i, T(&sum)[turning_modes]) {
      corotation_.multiply_images(i, cycle_.result(i), sum);
    });
    corotation_.complete_modes(c_.total, scale);
  }
  if (lbfgs_) correct(!separate_finish);
}

template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::corotate() {
  const TurningPlan plan(iteration_, builds_, c_.outer.restarts - restarts_at_build_, HasContacts,
                         c_.outer.rebuilds_coarse());
  const CorotationInput<T> in = {w_.v.x, w_.v.u, w_.v.target, iterate_, w_.weights};
  if (plan.forget) corotated_ = false;
  if (plan.make) {
    ++builds_;
    restarts_at_build_ = c_.outer.restarts;
    corotated_ = true;
    contacts_current_ = false;
    team_ = make_corotation(in, m_.corotation, team_, shared_, call_.shared_corotation,
                            c_.outer.scale, corotation_.with_plan(call_.plan()));
    if (threadIdx.x == 0) c_.outer.path_since_coarse = 0;
  }
  if constexpr (HasContacts) {
    if (corotated_ && !contacts_current_)
      team_ = hold_corotation(in, free_, m_.corotation, team_, shared_, c_.outer.scale,
                              corotation_.control());
    contacts_current_ = corotated_;
  }
}

// The second loop of L-BFGS, and the slope g . d. `last`: also runs the last phase of the cycle.
template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::correct(bool last) {
  const auto visit = [&](int i, T(&sum)[history + 1]) {
    // loads come before the first store, so that they overlap
    Vec3<T> y[history];
    load_pairs(m_.y, i, y);
    Vec3<T> z = cycle_.result(i);
    if (corotated_) {
      z = corotation_.corrected(i, z);
      cycle_.set_result(i, z);
    }
#pragma unroll
    for (int j = 0; j < history; ++j) {
      if (c_.pairs.valid[j]) sum[j] += dot(y[j], z);
    }
    sum[history] += dot(vec3(residual_[i]), completed(i, z));
  };
  pass<history + 1, T>(visit, [&](int rows, const auto& row) {
    if (last) cycle_.run_last(rows, row);
  });
  if (threadIdx.x < warp_size) SecantPairLanes(c_.pairs, newest_).second_loop(c_.total, c_.factor);
  if (threadIdx.x == 0) {
    const double slope = c_.pairs.slope(c_.total[history], c_.factor);
    if (!c_.outer.descends(slope)) c_.pairs.clear();
  }
  __syncthreads();
}

template <class T, bool HasContacts, int Threads>
PD_DEVICE Vec3<T> MultilevelRunner<T, HasContacts, Threads>::direction(int i) const {
  Vec3<T> d = cycle_.result(i);
  if (!lbfgs_) return d;
  Vec3<T> s[history];
  load_pairs(m_.s, i, s);
#pragma unroll
  for (int j = 0; j < history; ++j) {
    if (c_.pairs.valid[j]) d = multiply_add(T(c_.factor[j]), s[j], d);
  }
  return d;
}

// Loads a field of all secant pairs at a vertex, in parallel. An invalid pair loads any valid
// address.
template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::load_pairs(
    const Quad<T>* field, int i, Vec3<T> (&loaded)[history]) const {
#pragma unroll
  for (int j = 0; j < history; ++j) {
    const Quad<T>* from = c_.pairs.valid[j] ? field + j * vertices() : w_.v.u;
    loaded[j] = vec3(from[i]);
  }
}

}  // namespace pd::inline PD_TARGET
