// Functions of the stretches of a matrix that are differentiable by dual numbers, for one matrix at a time.
#pragma once
#include "math/dual.h"
#include "math/stretch.h"

namespace pd::inline PD_TARGET {

// The nearest rotation, with its derivative where the matrix is dual.
template <class R>
PD_HD Mat3<R> varying_rotation(const Mat3<R>& a) {
  return nearest_rotation(a);
}
template <class R>
PD_HD void split(const Mat3<Dual<R>>& a, Mat3<R>& value, Mat3<R>& slope) {
  for (int i = 0; i < 3; ++i) {
    value.row[i] = {a.row[i].x.value, a.row[i].y.value, a.row[i].z.value};
    slope.row[i] = {a.row[i].x.slope, a.row[i].y.slope, a.row[i].z.slope};
  }
}
template <class R>
PD_HD Mat3<Dual<R>> varying_rotation(const Mat3<Dual<R>>& a) {
  Mat3<R> value, slope;
  split(a, value, slope);
  const Mat3<R> r = nearest_rotation(value), dr = rotation_differential(value, r, slope);
  Mat3<Dual<R>> both;
  for (int i = 0; i < 3; ++i)
    both.row[i] = {{r.row[i].x, dr.row[i].x}, {r.row[i].y, dr.row[i].y}, {r.row[i].z, dr.row[i].z}};
  return both;
}

// e = log s of A = U diag(s) V^T with det A > 0, and V diag(exp(x)) V^T. R is a scalar or a dual one.
//
// With C = A^T A = V diag(c) V^T and C' in the frame V, the derivative of V diag(f) V^T has f_i' on its diagonal, and
// C'_ij (f_i - f_j) / (c_i - c_j) off it; e_i' = C'_ii / 2 c_i.
template <class R>
class LogStretch {
  using T = typename Still<R>::Value;

 public:
  R e[3];

  PD_HD explicit LogStretch(const Mat3<R>& a) {
    if constexpr (Still<R>::varies) {
      Mat3<T> value, slope;
      split(a, value, slope);
      set(value, slope);
    } else {
      set(a, a);
    }
  }

  // for x_i - x_j = factor (e_i - e_j)
  PD_HD Mat3<R> exponential_of(const R (&x)[3], const T& factor) const {
    Mat3<R> sum;
    R own[3];
    for (int i = 0; i < 3; ++i) own[i] = exponential(x[i]);
    for (int i = 0; i < 3; ++i) {
      const R row[3] = {entry(i, 0, own, factor), entry(i, 1, own, factor),
                        entry(i, 2, own, factor)};
      const Vec3<R> along =
          multiply_add(row[2], axis(2), multiply_add(row[1], axis(1), row[0] * axis(0)));
      const Vec3<R> v = axis(i);
      sum.row[0] = i == 0 ? v.x * along : multiply_add(v.x, along, sum.row[0]);
      sum.row[1] = i == 0 ? v.y * along : multiply_add(v.y, along, sum.row[1]);
      sum.row[2] = i == 0 ? v.z * along : multiply_add(v.z, along, sum.row[2]);
    }
    return sum;
  }

 private:
  PD_HD void set(const Mat3<T>& a, const Mat3<T>& slope) {
    const Stretches<T> at(a, nearest_rotation(a));
    T m[3][3];
    at.in_frame(slope, m);
    for (int i = 0; i < 3; ++i) {
      right_[i] = at.right[i];
      const T s = greater(at.s[i], smallest<T>());
      stretch_[i] = s;
      if constexpr (Still<R>::varies) {
        e[i] = R(logarithm(s), m[i][i] / s);
      } else {
        e[i] = logarithm(s);
      }
    }
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j)
        change_[i][j] = multiply_add(stretch_[i], m[i][j], stretch_[j] * m[j][i]);
    }
  }

  PD_HD Vec3<R> axis(int i) const {
    return {Still<R>::number(right_[i].x), Still<R>::number(right_[i].y),
            Still<R>::number(right_[i].z)};
  }

  // in the frame V
  PD_HD R entry(int i, int j, const R (&own)[3], const T& factor) const {
    if (i == j) return own[i];
    if constexpr (Still<R>::varies) return R(T(0), change_[i][j] * quotient(i, j, own, factor));
    return R(T(0));
  }

  // (f_i - f_j) / (c_i - c_j), from the larger stretch: without cancellation
  PD_HD T quotient(int i, int j, const R (&own)[3], const T& factor) const {
    const bool turned = stretch_[j] < stretch_[i];
    const int large = turned ? i : j, small = turned ? j : i;
    const T apart = Still<R>::value(e[small]) - Still<R>::value(e[large]);
    const T over = Still<R>::value(own[large]) / (stretch_[large] * stretch_[large]);
    if (!(apart < T(0))) return over * (T(0.5) * factor);
    return over * (exponential_less_one(factor * apart) / exponential_less_one(apart + apart));
  }

  Vec3<T> right_[3];
  T stretch_[3], change_[3][3];
};

}  // namespace pd::inline PD_TARGET
