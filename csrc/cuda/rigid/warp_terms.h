// CoarseTerms of solver/coarse/newton.h by a warp, an entry a lane: little code for each lane, and no stack.
#pragma once
#include "cuda/common/reductions.h"
#include "solver/coarse/newton.h"

namespace pd::inline PD_TARGET {

// All lanes call with equal arguments and get equal results.
class WarpTerms {
 public:
  static constexpr int count = CoarseTerms::count;
  PD_HD static constexpr int at(int row, int column) { return CoarseTerms::at(row, column); }

  PD_DEVICE WarpTerms() : lane_(int(threadIdx.x) % warp_size) {
    row_ = 0;
    for (int r = 1; r <= 6; ++r) row_ = lane_ >= at(r, 0) ? r : row_;
    column_ = lane_ - at(row_, 0);
  }

  template <class Of>
  PD_DEVICE void set(const Of& of) {
    if (lane_ < count) entry_ = of(lane_, row_, column_, entry_);
  }

  template <class Of>
  PD_DEVICE double sum(const Of& of) const {
    return warp_reduce(lane_ < count ? of(row_, column_, entry_) : 0, Add());
  }

  PD_DEVICE void solve(double (&x)[6]) {
    double most = 0, inverse[6];
#pragma unroll
    for (int i = 0; i < 6; ++i) {
      const double pivot = entry(at(i, i));
      most = pivot > most ? pivot : most;
    }
#pragma unroll
    for (int j = 0; j < 6; ++j) {
      const double pivot = entry(at(j, j));
      inverse[j] = pivot > no_pivot * most ? 1.0 / pivot : 0.0;
      const bool later = column_ > j && lane_ < count;
      const double factor = inverse[j] * entry(later ? at(column_, j) : lane_),
                   other = entry(later ? at(row_, j) : lane_);
      if (later) entry_ = subtract_product(entry_, factor, other);
    }
#pragma unroll
    for (int j = 5; j >= 0; --j) {
      x[j] = inverse[j] * entry(at(6, j));
      const bool left = row_ == 6 && column_ < j;
      const double other = entry(left ? at(j, column_) : lane_);
      if (left) entry_ = subtract_product(entry_, other, x[j]);
    }
  }

 private:
  PD_DEVICE double entry(int of_lane) const { return __shfl_sync(full_warp, entry_, of_lane); }

  int lane_, row_, column_;
  double entry_ = 0;
};

}  // namespace pd::inline PD_TARGET
