// Runner of solver/multilevel/lbfgs.h on the CPU: a Stepper with other iterations.
#pragma once
#include "cpu/multilevel/trials.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

template <class Lanes, bool HasContacts>
class MultilevelStepper : public TrialStepper<Lanes, HasContacts> {
  using Base = TrialStepper<Lanes, HasContacts>;
  using Base::add_up, Base::dots, Base::each_vertex, Base::is_held, Base::pass, Base::pick,
      Base::restricted, Base::width;
  using Base::done_, Base::finite_, Base::has_space_, Base::holds_, Base::made_, Base::none_,
      Base::o_, Base::pieces_, Base::search_, Base::set_, Base::team_, Base::uses_space_,
      Base::vertex, Base::w_;
  using typename Base::Real, typename Base::T, typename Base::Value, typename Base::Work;

 public:
  MultilevelStepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
                    const Team& team, std::int64_t first, Work& outer)
      : Base(call, work, scratch, team, first, outer), lbfgs_(set_.learns()) {}

  // All steps of the call, with a record every `set_.every`.
  void rollout() { this->take_steps(*this); }

  void start() {
    Base::start();
    newest_ = 0;
    for (SecantPairs& pairs : pairs_) pairs = {};
  }

  void minimise() { multilevel_iterations(*this, set_); }

  // The secant pair from the iterate to the trial, accepted or not: it holds the curvature in between. Then the
  // iterate moves.
  void update_pairs(int k) {
    newest_ = (newest_ + 1) % history;
    iteration_ = k;
    pass([&](std::int64_t i, Value(&sum)[dots]) {
      Value s = none_, y = none_;
      // at first the directions are those of another step
      if (lbfgs_ && k > 0) {
        s = restricted(i, w_.u[i] - o_.iterate[i]);
        y = restricted(i, o_.trial_residual[i] - o_.residual[i]);
      }
      this->move_vertex(k, i, sum);
      if (!lbfgs_) return;
      // a NaN must not poison sums that it has no part in, such as those of the next environment
      o_.s[newest_][i] = pick(finite_, numbers(s), none_);
      o_.y[newest_][i] = pick(finite_, numbers(y), none_);
      const Value g = restricted(i, o_.residual[i]);
      for (int j = 0; j < history; ++j) {
        sum[j] = multiply_add(o_.s[j][i], y, sum[j]);
        sum[history + j] = multiply_add(o_.s[j][i], g, sum[history + j]);
      }
      sum[2 * history + 2] = multiply_add(y, y, sum[2 * history + 2]);
    });
    double total[dots];
    for (int lane = 0; lane < width; ++lane) {
      add_up(lane, total);
      this->moved(k, lane, total);
      if (!lbfgs_) continue;
      SecantPairs& pairs = pairs_[lane];
      for (int j = 0; j < history; ++j) {
        pairs.product[j][newest_] = total[j];
        pairs.s_dot_g[j] = total[history + j];
      }
      const bool teaches = k > 0 && search_[lane].accepted;
      pairs.admit(newest_, teaches, total[newest_], total[2 * history], total[2 * history + 2]);
      if (search_[lane].clears_pairs()) pairs.clear();
      pairs.first_loop(newest_);
    }
    team_.barrier();
  }

  // whether no lane needs M
  bool uses_jacobi() const {
    const auto without = [&](int lane) { return done_[lane] || search_[lane].jacobi; };
    for (int lane = 0; lane < width; ++lane)
      if (!without(lane)) return false;
    return lbfgs_;
  }

  // direction = theta M g, corrected by secant pairs; the diagonal serves blocked directions and outliers
  void precondition() {
    if (has_space_) find_space(iteration_);
    Real alpha[history] = {}, scale;
    for (int lane = 0; lane < width; ++lane) {
      for (int j = 0; j < history; ++j) Lanes::set_lane(alpha[j], lane, T(pairs_[lane].alpha[j]));
      Lanes::set_lane(scale, lane, T(search_[lane].weight(set_.relaxation, is_held(lane))));
    }
    Value* in = o_.cycle.input();
    each_vertex([&](std::int64_t i) {
      Value q = restricted(i, o_.residual[i]);
      if (lbfgs_) {
        for (int j = 0; j < history; ++j) q = subtract_product(q, alpha[j], o_.y[j][i]);
        q = restricted(i, q);
      }
      in[i] = scale * q;
    });
    if (!uses_space_) {
      o_.cycle.run(team_);
    } else {
      this->run_with_space(scale);
    }
    if (lbfgs_) return correct();
    each_vertex([&](std::int64_t i) { o_.direction[i] = o_.cycle.result()[i]; });
  }

 private:
  // Makes the coarse space of the lanes that need it at iteration k, at their iterates.
  void find_space(int k) {
    bool asks[width], some = false;
    double scales[width];
    for (int lane = 0; lane < width; ++lane) {
      LineSearch& search = search_[lane];
      scales[lane] = search.scale;
      const bool begins = k >= (HasContacts ? touching_pieces_begin : pieces_begin);
      // alone a lane of Jacobi iterations would not be here
      asks[lane] = !done_[lane] && !search.jacobi && (made_[lane] ? search.is_outdated() : begins);
      some = some || asks[lane];
      if (!asks[lane]) continue;
      made_[lane] = true;
      holds_[lane] = false;
      search.rebuilt();
    }
    if (some) pieces_.make(o_.iterate, asks, scales);
    uses_space_ = std::any_of(made_, made_ + width, [](bool made) { return made; });
    if constexpr (HasContacts) {
      bool holds[width];
      for (int lane = 0; lane < width; ++lane) {
        holds[lane] = made_[lane] && !holds_[lane] && !done_[lane] && !search_[lane].jacobi;
        holds_[lane] = holds_[lane] || holds[lane];
      }
      if (uses_space_) pieces_.hold(o_.free, holds, scales);
    }
  }

  // the second loop of L-BFGS, and the slope g.d
  void correct() {
    const Value* z = o_.cycle.result();
    pass([&](std::int64_t i, Value(&sum)[dots]) {
      for (int j = 0; j < history; ++j) sum[j] = multiply_add(o_.y[j][i], z[i], sum[j]);
      const Value d = this->trial_vertex(vertex(i), i).completed(z[i]);
      sum[history] = multiply_add(o_.residual[i], d, sum[history]);
    });
    double total[dots], with[history], c[history];
    Real factor[history];
    for (int lane = 0; lane < width; ++lane) {
      add_up(lane, total);
      for (int j = 0; j < history; ++j) with[j] = total[j];
      pairs_[lane].second_loop(newest_, with, c);
      for (int j = 0; j < history; ++j) Lanes::set_lane(factor[j], lane, T(c[j]));
      const double slope = pairs_[lane].slope(total[history], c);
      if (!done_[lane] && !search_[lane].descends(slope)) pairs_[lane].clear();
    }
    each_vertex([&](std::int64_t i) {
      Value d = z[i];
      for (int j = 0; j < history; ++j) d = multiply_add(factor[j], o_.s[j][i], d);
      o_.direction[i] = d;
    });
  }

  // 0 for infinity and NaN
  static Value numbers(const Value& a) {
    const auto number = [](const Real& x) {
      return select(lesser(x, -x) > Real(T(-HUGE_VAL)), x, Real(T(0)));
    };
    const Vec3<Real> v = Lanes::vec3(a);
    return Lanes::value({number(v.x), number(v.y), number(v.z)});
  }

  bool lbfgs_;
  int newest_ = 0, iteration_ = 0;
  SecantPairs pairs_[width];
};

}  // namespace pd::inline PD_TARGET
