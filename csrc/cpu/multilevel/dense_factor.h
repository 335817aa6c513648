// Cholesky factor of a dense symmetric matrix in double, on one thread.
#pragma once
#include "cpu/step/lanes.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace pd::inline PD_TARGET {

// L L^T = X: L in the lower triangle of rows of `stride` numbers, which vectors of any row may read beyond its end.
class DenseFactor {
  using Some = Pack<double, native_width<double>>;
  static constexpr int width = Some::width, together = 4;

 public:
  void resize(int size) {
    size_ = size;
    stride_ = (size + width - 1) / width * width;
    value_.assign(std::size_t(size) * stride_, 0.0);
  }
  int size() const { return size_; }
  void clear() { std::fill(value_.begin(), value_.end(), 0.0); }
  double& at(int i, int j) { return value_[std::size_t(i) * stride_ + j]; }
  double at(int i, int j) const { return value_[std::size_t(i) * stride_ + j]; }

  // In place, from the lower triangle of X; false where X is not positive. Row by row: L_ij = (X_ij - L_i . L_j) / L_jj.
  bool factorise() {
    for (int i = 0; i < size_; ++i) {
      double* own = row(i);
      for (int j = 0; j < i; j += together) {
        const int count = i - j < together ? i - j : together;
        double sum[together];
        products(own, j, count, sum);
        for (int c = 0; c < count; ++c) {
          const double* other = row(j + c);
          for (int k = j; k < j + c; ++k) sum[c] += own[k] * other[k];
          own[j + c] = (own[j + c] - sum[c]) / other[j + c];
        }
      }
      double square = own[i];
      for (int k = 0; k < i; ++k) square -= own[k] * own[k];
      if (!(square > 0) || !(square < HUGE_VAL)) return false;
      own[i] = std::sqrt(square);
    }
    return true;
  }

  // The same of X + other.
  bool add_and_factorise(const DenseFactor& other) {
    for (std::size_t n = 0; n < value_.size(); ++n) value_[n] += other.value_[n];
    return factorise();
  }

  // x = X^-1 x
  void solve(double* x) const {
    for (int i = 0; i < size_; ++i) {
      const double* own = row(i);
      double sum = x[i];
      for (int k = 0; k < i; ++k) sum -= own[k] * x[k];
      x[i] = sum / own[i];
    }
    for (int i = size_ - 1; i >= 0; --i) {
      const double* own = row(i);
      x[i] /= own[i];
      for (int k = 0; k < i; ++k) x[k] -= own[k] * x[i];
    }
  }

 private:
  double* row(int i) { return &value_[std::size_t(i) * stride_]; }
  const double* row(int i) const { return &value_[std::size_t(i) * stride_]; }

  // the first `end` numbers of `own` times those of rows end ... end + count - 1
  void products(const double* own, int end, int count, double (&sum)[together]) const {
    const double* other[together];
    for (int c = 0; c < together; ++c) other[c] = row(end + (c < count ? c : 0));
    Some part[together];
    for (Some& p : part) p = Some(0.0);
    int k = 0;
    for (; k + width <= end; k += width) {
      const Some x = Some::load(own + k);
      for (int c = 0; c < together; ++c)
        part[c] = multiply_add(x, Some::load(other[c] + k), part[c]);
    }
    for (int c = 0; c < together; ++c) {
      sum[c] = 0;
      for (int lane = 0; lane < width; ++lane) sum[c] += part[c].v[lane];
      for (int rest = k; rest < end; ++rest) sum[c] += own[rest] * other[c][rest];
    }
  }

  int size_ = 0, stride_ = 0;
  std::vector<double> value_;
};

}  // namespace pd::inline PD_TARGET
