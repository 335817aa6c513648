// The positive part of every stencil's second derivative at an iterate, kept for many directions.
#pragma once
#include "cpu/step/stencil_blocks.h"
#include "solver/multilevel/pieces.h"

namespace pd::inline PD_TARGET {

// Rows of a second derivative. Numbers 3 j + a: component a of column j of F.
template <class Kind>
constexpr int second_rows = 3 * Kind::dims;
// of its lower triangle, row by row
template <class Kind>
constexpr int second_numbers = second_rows<Kind> * (second_rows<Kind> + 1) / 2;

// The positive part: in closed form where the kind has one, else by its eigenvalues.
template <class Kind, class R, class Own>
void positive_second_derivative(const Vec3<R> (&f)[Kind::dims], const Own& own,
                                R (&second)[second_rows<Kind>][second_rows<Kind>]) {
  if constexpr (requires { Kind::positive_hessian(f, own.p, second); })
    return Kind::positive_hessian(f, own.p, second);
  using T = scalar_of<R>;
  constexpr int rows = second_rows<Kind>;
  const R none(T(0)), one(T(1)), half(T(0.5));
  R found[rows][rows];
  for (int c = 0; c < rows; ++c) {
    Vec3<R> df[Kind::dims], dp[Kind::dims];
    for (int j = 0; j < Kind::dims; ++j) {
      df[j] = {c == 3 * j ? one : none, c == 3 * j + 1 ? one : none, c == 3 * j + 2 ? one : none};
    }
    stress_differential<Kind>(f, df, own.p, own.c, dp);
    for (int j = 0; j < Kind::dims; ++j) {
      found[3 * j][c] = dp[j].x;
      found[3 * j + 1][c] = dp[j].y;
      found[3 * j + 2][c] = dp[j].z;
    }
  }
  for (int r = 0; r < rows; ++r) {
    for (int c = 0; c < rows; ++c) second[r][c] = half * (found[r][c] + found[c][r]);
  }
  clamp_positive(second);
}

// Lower triangles of all stencils, in blocks of lanes.
template <class T>
class StencilHessians {
  using R = Pack<T, native_width<T>>;

 public:
  explicit StencilHessians(const Plan<T>& plan) : first_(plan.stencil_blocks) {
    std::int64_t numbers = 0;
    for (int block = 0; block < plan.stencil_blocks; ++block) {
      first_[block] = numbers;
      with_kind(plan.stencil_block[4 * block],
                [&](auto kind) { numbers += second_numbers<decltype(kind)>; });
    }
    storage_ = allocate_zeroed(numbers * block_lanes * sizeof(T));
  }

  template <class Kind>
  void set(const StencilPart<T>& part,
           const R (&second)[second_rows<Kind>][second_rows<Kind>]) const {
    T* to = of(part);
    for (int r = 0; r < second_rows<Kind>; ++r) {
      for (int c = 0; c <= r; ++c, to += block_lanes) second[r][c].store(to);
    }
  }
  template <class Kind>
  void get(const StencilPart<T>& part, R (&second)[second_rows<Kind>][second_rows<Kind>]) const {
    const T* from = of(part);
    for (int r = 0; r < second_rows<Kind>; ++r) {
      for (int c = 0; c <= r; ++c, from += block_lanes) second[r][c] = second[c][r] = R::load(from);
    }
  }

 private:
  T* of(const StencilPart<T>& part) const {
    return reinterpret_cast<T*>(storage_.get()) + first_[part.block] * block_lanes +
           part.first_lane;
  }

  std::vector<std::int64_t> first_;  // number of each block
  Storage storage_;
};

// Keeps those at field 0.
template <class T>
struct KeepHessians {
  const StencilHessians<T>& hessians;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    const StencilNumbers<Kind, Stencils> own(stencils);
    Vec3<R> x[Kind::corners], f[Kind::dims];
    R second[second_rows<Kind>][second_rows<Kind>];
    stencils.corners(0, x);
    deform<Kind>(x, own.g, f);
    positive_second_derivative<Kind>(f, own, second);
    hessians.template set<Kind>(stencils.part, second);
  }
};

// The vectors g_a of a stencil.
template <class Kind, class Stencils>
struct StencilGradients {
  using R = typename Stencils::R;
  R g[gradient_numbers<Kind>];

  explicit StencilGradients(const Stencils& stencils) {
    for (int i = 0; i < gradient_numbers<Kind>; ++i) g[i] = stencils.stored(i);
  }
};

// The kept second derivatives times field 1.
template <class T>
struct HessianProduct {
  const StencilHessians<T>& hessians;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    const StencilGradients<Kind, Stencils> own(stencils);
    Vec3<R> x[Kind::corners], df[Kind::dims], dp[Kind::dims];
    R second[second_rows<Kind>][second_rows<Kind>];
    hessians.template get<Kind>(stencils.part, second);
    stencils.corners(1, x);
    deform<Kind>(x, own.g, df);
    const auto row = [&](int r) {
      R sum(T(0));
      for (int j = 0; j < Kind::dims; ++j) {
        sum = multiply_add(second[r][3 * j], df[j].x, sum);
        sum = multiply_add(second[r][3 * j + 1], df[j].y, sum);
        sum = multiply_add(second[r][3 * j + 2], df[j].z, sum);
      }
      return sum;
    };
    for (int j = 0; j < Kind::dims; ++j) dp[j] = {row(3 * j), row(3 * j + 1), row(3 * j + 2)};
    stencil_forces<Kind>(dp, own.g, x);
    stencils.add(x);
  }
};

// Column `axis` of the diagonal blocks of stencils with n corners, times n: their sum bounds the Hessian.
template <class T>
struct HessianBlocks {
  const StencilHessians<T>& hessians;
  int axis;

  template <class Kind, class Stencils>
  PD_HD void run(const Stencils& stencils) const {
    using R = typename Stencils::R;
    constexpr int n = Kind::corners, d = Kind::dims;
    const R none(T(0)), one(T(1));
    const StencilGradients<Kind, Stencils> own(stencils);
    Vec3<R> units[d], column[d][n], sum[n];  // column[j][a].x: component j of g_a
    R second[second_rows<Kind>][second_rows<Kind>];
    hessians.template get<Kind>(stencils.part, second);
    for (int j = 0; j < d; ++j) {
      for (int i = 0; i < d; ++i) units[i] = {i == j ? one : none, none, none};
      stencil_forces<Kind>(units, own.g, column[j]);
    }
    for (int a = 0; a < n; ++a) {
      sum[a] = {none, none, none};
      for (int j = 0; j < d; ++j) {
        for (int l = 0; l < d; ++l) {
          const R both = R(T(n)) * (column[j][a].x * column[l][a].x);
          const R* k = second[3 * l + axis];
          sum[a] = multiply_add(both, Vec3<R>{k[3 * j], k[3 * j + 1], k[3 * j + 2]}, sum[a]);
        }
      }
    }
    stencils.add(sum);
  }
};

}  // namespace pd::inline PD_TARGET
