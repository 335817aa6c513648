// The preconditioner M of solver/multilevel/lbfgs.h on the CPU: one V-cycle, or a direct solve, by a team of threads. The
// order of sums is fixed.
#pragma once
#include "cpu/multilevel/dense_solve.h"
#include "cpu/step/workspace.h"
#include "solver/multilevel/lbfgs.h"
#include "threads/team.h"

namespace pd::inline PD_TARGET {

template <class Lanes>
class Cycle {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;

  // right side, result, residual and work vector
  struct Fields {
    Value *in, *z, *rest, *part;
  };

 public:
  explicit Cycle(const Levels<T>& levels) : levels_(levels), coarse_(levels.coarse_unknowns()) {
    const std::int64_t middle = levels.has_middle() ? 4 * std::int64_t(levels.fine_nodes) : 0;
    const std::int64_t count = 4 * (levels.vertices + middle) + 3 * std::int64_t(coarse_);
    storage_ = allocate_zeroed(std::size_t(count) * sizeof(Value));
    Value* at = reinterpret_cast<Value*>(storage_.get());
    const auto take = [&](std::int64_t size) { return std::exchange(at, at + size); };
    for (Fields* level : {&fine_, &middle_}) {
      const std::int64_t size = level == &fine_ ? levels.vertices : middle;
      *level = {take(size), take(size), take(size), take(size)};
    }
    coarse_in_ = levels.direct ? fine_.in : take(coarse_);
    coarse_half_ = take(coarse_);
    coarse_out_ = levels.direct ? fine_.z : take(coarse_);
  }

  Value* input() const { return fine_.in; }
  Value* result() const { return fine_.z; }

  // result = M input, by the whole team. The input has to be complete; the result is complete on return.
  void run(const Team& team) const {
    if (levels_.direct) {
      // held vertices must not enter a product, since they may be NaN
      each_row(team, fine_level(levels_), [&](int row, std::int64_t) {
        if (!(levels_.fine_inverse[row] > T(0))) fine_.in[row] = {};
      });
      solve_coarse(team);
    } else if (levels_.has_middle()) {
      const auto below = [&] {
        descend(team, middle_level(levels_), middle_, coarse_in_, coarse_out_,
                [&] { solve_coarse(team); });
      };
      descend(team, fine_level(levels_), fine_, middle_.in, middle_.z, below);
    } else {
      descend(team, fine_level(levels_), fine_, coarse_in_, coarse_out_,
              [&] { solve_coarse(team); });
    }
  }

 private:
  // visit(row, first unknown of the row)
  template <int B, class Visit>
  static void each_row(const Team& team, const Level<B, T>& level, Visit visit) {
    for (std::int64_t row = team.begin(level.rows); row < team.end(level.rows); ++row)
      visit(int(row), row * B);
    team.barrier();
  }

  // smooth, correct by the `below` level's solution for the restricted residual, smooth
  template <int B, class Below>
  static void descend(const Team& team, const Level<B, T>& level, const Fields& f, Value* below_in,
                      const Value* below_out, const Below& below) {
    each_row(team, level, [&](int, std::int64_t at) {
      for (int i = 0; i < B; ++i)
        f.part[at + i] = Real(T(Smoother::first) * level.inverse[at + i]) * f.in[at + i];
    });
    each_row(team, level, [&](int row, std::int64_t at) {
      Value rest[B];
      smooth(level, f, f.in, row, rest);
      for (int i = 0; i < B; ++i) f.z[at + i] = rest[i];
    });
    each_row(team, level, [&](int row, std::int64_t at) {
      Value rest[B];
      for (int i = 0; i < B; ++i) rest[i] = f.in[at + i];
      subtract_row<Real>(level, f.z, row, rest);
      for (int i = 0; i < B; ++i) f.rest[at + i] = rest[i];
    });
    restrict_to(team, level, f, below_in);
    below();
    each_row(team, level, [&](int row, std::int64_t at) {
      Value sum[B];
      for (int i = 0; i < B; ++i) sum[i] = f.z[at + i];
      add_prolongation<Real>(level, below_out, row, sum);
      for (int i = 0; i < B; ++i) f.z[at + i] = sum[i];
    });
    each_row(team, level, [&](int row, std::int64_t at) {
      Value rest[B];
      for (int i = 0; i < B; ++i) rest[i] = f.in[at + i];
      subtract_row<Real>(level, f.z, row, rest);
      for (int i = 0; i < B; ++i) {
        f.rest[at + i] = rest[i];
        f.part[at + i] = Real(T(Smoother::first) * level.inverse[at + i]) * rest[i];
      }
    });
    each_row(team, level, [&](int row, std::int64_t at) {
      Value rest[B];
      smooth(level, f, f.rest, row, rest);
      for (int i = 0; i < B; ++i) f.z[at + i] = f.z[at + i] + rest[i];
    });
  }

  // keep w + second / D (r - A w), w being f.part
  template <int B>
  PD_HD static void smooth(const Level<B, T>& level, const Fields& f, const Value* right, int row,
                           Value (&rest)[B]) {
    const std::int64_t at = std::int64_t(row) * B;
    for (int i = 0; i < B; ++i) rest[i] = right[at + i];
    subtract_row<Real>(level, f.part, row, rest);
    for (int i = 0; i < B; ++i) {
      const Real scale(T(Smoother::second) * level.inverse[at + i]);
      rest[i] = multiply_add(Real(T(Smoother::keep)), f.part[at + i], scale * rest[i]);
    }
  }

  template <int B>
  static void restrict_to(const Team& team, const Level<B, T>& level, const Fields& f,
                          Value* below_in) {
    for (std::int64_t node = team.begin(level.nodes); node < team.end(level.nodes); ++node) {
      Value sum[4] = {};
      add_restriction<Real>(level, f.rest, int(node), sum);
      for (int i = 0; i < 4; ++i) below_in[4 * node + i] = sum[i];
    }
    team.barrier();
  }

  void solve_coarse(const Team& team) const {
    Dense<Lanes>(levels_.coarse_factor, coarse_).solve(team, coarse_in_, coarse_half_, coarse_out_);
  }

  const Levels<T>& levels_;
  int coarse_;
  Fields fine_ = {}, middle_ = {};
  Value *coarse_in_ = nullptr, *coarse_half_ = nullptr, *coarse_out_ = nullptr;
  Storage storage_;
};

}  // namespace pd::inline PD_TARGET
