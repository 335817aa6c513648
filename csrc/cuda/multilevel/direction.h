// Members of MultilevelRunner that compute the search direction: M with the L-BFGS correction,
// along the free directions of contacts.
#pragma once
#include "cuda/multilevel/runner.h"

namespace pd::inline PD_TARGET {

// Computes direction = theta M g with the L-BFGS correction. Blocked directions and outliers use
// the diagonal instead.
template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::precondition() {
  if (has_space_) find_space();
  const double scale = c_.outer.weight(w_.settings().relaxation, is_held());
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
  each_vertex([&](int i) { cycle_.set(i, right_side(i)); });
  // around M where vertices are held that it leaves free
  const bool around = made_ && ((HasContacts && !w_.plan.levels.direct) || outliers_.some);
  if (made_)
    team_ = apply_pieces(pieces_, team_, around ? PiecesPart::before : PiecesPart::all,
                         cycle_.right_sides(), scale);
  if (around) team_ = hide_pieces(pieces_, m_.cycle, team_);
  // the last phase of the cycle can be fused with the pass that follows it
  const bool separate_finish = around || !lbfgs_;
  cycle_.run_but_last();
  if (separate_finish) cycle_.finish();
  if (around) {
    team_ = multiply_result(pieces_, m_.cycle, team_);
    team_ = apply_pieces(pieces_, team_, PiecesPart::after, pieces_.memory.field, scale);
  }
  if (lbfgs_) correct(!separate_finish);
}

// Makes the coarse space where the step needs it, at the iterate.
template <class T, bool HasContacts, int Threads>
PD_DEVICE void MultilevelRunner<T, HasContacts, Threads>::find_space() {
  const bool begins = iteration_ >= (HasContacts ? touching_pieces_begin : pieces_begin);
  const PiecesInput<T> in = {w_.v.x, w_.v.u, w_.v.target, iterate_, w_.origin, w_.weights};
  double* scratch = reinterpret_cast<double*>(shared_);
  if (made_ ? c_.outer.is_outdated() : begins) {
    made_ = true;
    holds_ = false;
    pieces_.begin(call_.plan(), call_.memory.pieces, int(blockIdx.x) / call_.blocks);
    team_ = make_pieces(in, pieces_, team_, scratch, c_.outer.scale, HasContacts);
    if (threadIdx.x == 0) c_.outer.rebuilt();
  }
  if constexpr (HasContacts) {
    if (made_ && !holds_) team_ = hold_pieces(in, free_, pieces_, team_, scratch, c_.outer.scale);
    holds_ = made_;
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
    if (made_) {
      z = z + moved(i);
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
