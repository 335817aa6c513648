// Runner of solver/multilevel.h on the CPU: what Stepper does of a step, and another way to the next iterate.
#pragma once
#include "cpu/cycle.h"
#include "cpu/stepper.h"

namespace pd::inline PD_TARGET {

// Vectors of the outer iteration, beside those of a Workspace, in which u is the trial.
template <class Lanes>
struct OuterWork {
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;

  static constexpr int dots = 2 * history + 3;  // sums that one pass may make
  static constexpr int chunk = 256;             // vertices that one of them covers

  Cycle<Lanes> cycle;
  Value *base, *pull, *fresh, *direction;  // [vertices] iterate to go on from, residuals there and at the trial
  Value *s[history], *y[history];          // [vertices] L-BFGS pairs
  Mat3<Real>*free, *fresh_free;            // [vertices] directions that contacts leave; none without contacts
  Wide (*sums)[dots];                      // [chunks]
  double (*ratios)[2];                     // [threads] least and largest, of the material to that of M
  int chunks;

  OuterWork(const StepCall<typename Lanes::Scalar>& call, bool touching, int threads)
      : cycle(call.plan.levels), chunks((call.plan.vertices + chunk - 1) / chunk) {
    const bool pairs = call.settings.schedule == ScheduleKind::lbfgs;
    const std::int64_t n = call.plan.vertices, vectors = 4 + (pairs ? 2 * history : 0);
    const std::int64_t projectors = touching ? 2 * n : 0;
    storage_ = allocate_zeroed(vectors * n * sizeof(Value) + projectors * sizeof(Mat3<Real>) +
                               chunks * sizeof(*sums) + threads * sizeof(*ratios) + 4 * alignment);
    std::byte* at = storage_.get();
    for (Value** field : {&base, &pull, &fresh, &direction}) *field = place<Value>(at, n);
    for (int i = 0; i < history; ++i) {
      s[i] = place<Value>(at, pairs ? n : 0);
      y[i] = place<Value>(at, pairs ? n : 0);
    }
    sums = place<Wide[dots]>(at, chunks);
    free = place<Mat3<Real>>(at, projectors / 2);
    fresh_free = place<Mat3<Real>>(at, projectors / 2);
    ratios = place<double[2]>(at, threads);
  }

 private:
  static constexpr std::size_t alignment = 64;

  template <class Item>
  static Item* place(std::byte*& at, std::int64_t count) {
    const auto address = reinterpret_cast<std::uintptr_t>(at);
    Item* items = reinterpret_cast<Item*>((address + alignof(Item) - 1) / alignof(Item) * alignof(Item));
    at = reinterpret_cast<std::byte*>(items + count);
    return items;
  }

  Storage storage_;
};

// `Touching`: see solver/vertex.h.
template <class Lanes, bool Touching>
class MultilevelStepper : public Stepper<Lanes, Touching> {
  using Base = Stepper<Lanes, Touching>;
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;
  using Sum = Sums<Lanes>;
  using Work = OuterWork<Lanes>;
  static constexpr int width = Lanes::environments, dots = Work::dots;
  using Base::call_, Base::contacts_, Base::done_, Base::in_, Base::plan_, Base::schedule_,
      Base::set_, Base::sweep_, Base::team_, Base::used_, Base::vertex, Base::w_;

 public:
  MultilevelStepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
                    const Team& team, std::int64_t first, Work& outer)
      : Base(call, work, scratch, team, first),
        o_(outer),
        lbfgs_(set_.schedule == ScheduleKind::lbfgs) {}

  // All steps of the call, with a record every `set_.every`.
  void roll() {
    this->load();
    this->weigh();
    compare_with_reference();
    for (int t = 0; t < set_.steps; ++t) {
      multilevel_step(*this, set_);
      if ((t + 1) % set_.every == 0) this->store((t + 1) / set_.every - 1);
      this->move_balls();
    }
  }

  void start() {
    Base::start();
    const Wide friction = Lanes::widen(contacts_.friction());
    for (int lane = 0; lane < width; ++lane) {
      outer_[lane] = {};
      outer_[lane].scale = scale_[lane];
      outer_[lane].friction = Lanes::lane(friction, lane) > 0;
      outer_[lane].slack = outer_[lane].friction ? guard_slack_friction : energy_noise<T>();
      pairs_[lane] = {};
      schedule_[lane].rho = misfit_[lane];
    }
  }

  // E and what is out of balance at the trial u
  void evaluate(int k) {
    sweep_.run(k & 1, SolidGradient<true>{}, [&](std::int64_t i, const Value& force, Sum& sums) {
      const auto v = vertex(i);
      sums.energy = v.add_energy(w_.u[i], sums.energy);
      o_.fresh[i] = v.unbalanced(contacts_, w_.u[i], force);
      if constexpr (Touching) o_.fresh_free[i] = v.free_directions(contacts_, w_.u[i], force);
    });
  }

  // every thread decides from the same sums, so all decide alike
  void judge(int k) {
    const auto sum = this->total(k & 1);
    for (int lane = 0; lane < width; ++lane) {
      if (done_[lane]) {
        Lanes::set_lane(accepted_, lane, T(0));
        continue;
      }
      const double energy = Lanes::lane(sum.energy, lane);
      const bool accepted = outer_[lane].accept(energy, lbfgs_);
      Lanes::set_lane(accepted_, lane, T(accepted ? 1 : 0));
      Lanes::set_lane(finite_, lane, T(energy < HUGE_VAL ? 1 : 0));
    }
  }

  // The pair from the base to the trial, kept or not: it holds for the curvature on the way. Then the base moves on.
  void learn(int k) {
    newest_ = (newest_ + 1) % history;
    const Real zero(T(0));
    const Value none = Lanes::value({zero, zero, zero});
    pass([&](std::int64_t i, Value(&sum)[dots]) {
      const Value s = w_.u[i] - o_.base[i], y = o_.fresh[i] - o_.pull[i];
      if constexpr (Touching) keep_directions(i);
      // what momentum goes on along
      w_.before[i] = choose(o_.base[i], w_.before[i]);
      o_.base[i] = choose(w_.u[i], o_.base[i]);
      o_.pull[i] = choose(o_.fresh[i], o_.pull[i]);
      sum[2 * history] = multiply_add(s, s, sum[2 * history]);
      sum[2 * history + 1] = multiply_add(w_.u[i], w_.u[i], sum[2 * history + 1]);
      if (!lbfgs_) return;
      // a trial out of range must not poison sums in which it has no part
      o_.s[newest_][i] = pick(finite_, s, none);
      o_.y[newest_][i] = pick(finite_, y, none);
      const Value g = let_through(i, o_.pull[i]);
      for (int j = 0; j < history; ++j) {
        sum[j] = multiply_add(o_.s[j][i], y, sum[j]);
        sum[history + j] = multiply_add(o_.s[j][i], g, sum[history + j]);
      }
      sum[2 * history + 2] = multiply_add(y, y, sum[2 * history + 2]);
    });
    double total[dots];
    for (int lane = 0; lane < width; ++lane) {
      add_up(lane, total);
      stop(lane, k, total[2 * history], total[2 * history + 1]);
      if (!lbfgs_) continue;
      double with[history];
      for (int j = 0; j < history; ++j) {
        with[j] = total[j];
        pairs_[lane].pulled[j] = total[history + j];
      }
      pairs_[lane].valid[newest_] = false;
      if (k > 0) pairs_[lane].add(newest_, with, total[2 * history], total[2 * history + 2]);
      if (outer_[lane].plain) pairs_[lane].clear();
      pairs_[lane].first_loop(newest_);
    }
    team_.barrier();
  }

  // direction = theta M g, corrected by the pairs; contacts and what M does not know go by the diagonal
  void precondition() {
    Real alpha[history], scale;
    for (int lane = 0; lane < width; ++lane) {
      for (int j = 0; j < history; ++j) Lanes::set_lane(alpha[j], lane, T(pairs_[lane].alpha[j]));
      Lanes::set_lane(scale, lane, T(set_.relaxation / outer_[lane].scale));
    }
    Value* in = o_.cycle.input();
    each_vertex([&](std::int64_t i) {
      Value q = let_through(i, o_.pull[i]);
      if (lbfgs_) {
        for (int j = 0; j < history; ++j) q = subtract_product(q, alpha[j], o_.y[j][i]);
        q = let_through(i, q);
      }
      in[i] = scale * q;
    });
    o_.cycle.run(team_);
    lbfgs_ ? correct() : take_result();
  }

  // next trial: P(u + beta (u - before) - (1 + beta) t d), or a plain iteration
  void advance() {
    Real beta, length, plain;
    for (int lane = 0; lane < width; ++lane) {
      Outer& outer = outer_[lane];
      const double limit = outer_limit();
      const double b = lbfgs_ || outer.plain || done_[lane] ? 0 : outer.extrapolation(limit);
      Lanes::set_lane(beta, lane, T(b));
      Lanes::set_lane(length, lane, T(done_[lane] ? 0 : (1 + b) * outer.length()));
      Lanes::set_lane(plain, lane, T(outer.plain && !done_[lane] ? 1 : 0));
      used_[lane] += done_[lane] ? 0 : 1;
    }
    each_vertex([&](std::int64_t i) {
      const auto v = vertex(i);
      const Value u = o_.base[i];
      const Value way = pick(plain, v.inverse * o_.pull[i], length * o_.direction[i]);
      Value next = u - way;
      if (!lbfgs_) next = multiply_add(beta, u - w_.before[i], next);
      w_.u[i] = v.hold(v.target, v.project(contacts_, next, u));
    });
  }

  // the last trial counts only if it is better than the base
  void settle() {
    evaluate(0);
    judge(0);
    each_vertex([&](std::int64_t i) { w_.u[i] = choose(w_.u[i], o_.base[i]); });
    for (int lane = 0; lane < width; ++lane) schedule_[lane].restarts = outer_[lane].restarts;
  }

 private:
  static constexpr double momentum_rho = 0.9995;

  static double outer_limit() {
    const double b = (1 - sqrt(1 - momentum_rho * momentum_rho)) / momentum_rho;
    return b * b;
  }

  // where the lane accepted its trial `a`, else `b`
  Value choose(const Value& a, const Value& b) const { return pick(accepted_, a, b); }

  static Value pick(const Real& flag, const Value& a, const Value& b) {
    const auto take = flag > Real(T(0));
    const Vec3<Real> x = Lanes::vec3(a), y = Lanes::vec3(b);
    return Lanes::value({select(take, x.x, y.x), select(take, x.y, y.y), select(take, x.z, y.z)});
  }

  template <class Visit>
  void each_vertex(Visit visit) const {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) visit(i);
    team_.barrier();
  }

  // visit(vertex, sums), chunk by chunk: neither threads nor the batch change the order of a sum
  template <class Visit>
  void pass(Visit visit) {
    const Real zero(T(0));
    const Value none = Lanes::value({zero, zero, zero});
    for (std::int64_t c = team_.begin(o_.chunks); c < team_.end(o_.chunks); ++c) {
      Value sum[dots];
      for (Value& s : sum) s = none;
      const std::int64_t end = std::min<std::int64_t>(plan_.vertices, (c + 1) * Work::chunk);
      for (std::int64_t i = c * Work::chunk; i < end; ++i) visit(i, sum);
      for (int d = 0; d < dots; ++d) o_.sums[c][d] = Sweep<Lanes>::add_components(sum[d]);
    }
    team_.barrier();
  }

  void add_up(int lane, double (&total)[dots]) const {
    for (int d = 0; d < dots; ++d) {
      total[d] = 0;
      for (int c = 0; c < o_.chunks; ++c) total[d] += Lanes::lane(o_.sums[c][d], lane);
    }
  }

  // the part of a field that contacts let through
  Value let_through(std::int64_t i, const Value& field) const {
    if constexpr (!Touching) return field;
    return Lanes::value(o_.free[i] * Lanes::vec3(field));
  }

  void keep_directions(std::int64_t i) {
    for (int a = 0; a < 3; ++a) {
      o_.free[i].row[a] = Lanes::vec3(choose(Lanes::value(o_.fresh_free[i].row[a]),
                                             Lanes::value(o_.free[i].row[a])));
    }
  }

  // what of a direction a vertex takes: along the pull by the diagonal where M has no say
  Value mixed(std::int64_t i, const Value& d) const {
    const auto v = vertex(i);
    const Value plain = v.inverse * o_.pull[i];
    if (!(plan_.levels.fine_inverse[i] > T(0))) return plain;
    if constexpr (!Touching) return d;
    return let_through(i, d) + (plain - let_through(i, plain));
  }

  void take_result() {
    const Value* z = o_.cycle.result();
    each_vertex([&](std::int64_t i) { o_.direction[i] = mixed(i, z[i]); });
  }

  // the second loop of L-BFGS, and the slope g.d
  void correct() {
    const Value* z = o_.cycle.result();
    pass([&](std::int64_t i, Value(&sum)[dots]) {
      for (int j = 0; j < history; ++j) sum[j] = multiply_add(o_.y[j][i], z[i], sum[j]);
    });
    double total[dots], with[history], c[history];
    Real factor[history];
    for (int lane = 0; lane < width; ++lane) {
      add_up(lane, total);
      for (int j = 0; j < history; ++j) with[j] = total[j];
      pairs_[lane].second_loop(newest_, with, c);
      for (int j = 0; j < history; ++j) Lanes::set_lane(factor[j], lane, T(c[j]));
    }
    team_.barrier();
    pass([&](std::int64_t i, Value(&sum)[dots]) {
      Value d = z[i];
      for (int j = 0; j < history; ++j) d = multiply_add(factor[j], o_.s[j][i], d);
      o_.direction[i] = d = mixed(i, d);
      sum[0] = multiply_add(o_.pull[i], d, sum[0]);
    });
    for (int lane = 0; lane < width; ++lane) {
      add_up(lane, total);
      outer_[lane].slope = total[0];
      // not downhill: what was learnt does not hold here
      if (total[0] >= 0 || done_[lane] || outer_[lane].plain) continue;
      pairs_[lane].clear();
      outer_[lane].plain = true;
      ++outer_[lane].restarts;
    }
    team_.barrier();
  }

  // the soft stop of an environment, by a trial that it went on from
  void stop(int lane, int k, double change, double length) {
    const bool kept = k > 0 && outer_[lane].accepted && !done_[lane];
    if (kept && change <= set_.tolerance * set_.tolerance * length && set_.tolerance > 0)
      done_[lane] = true;
  }

  // least and largest ratio of the material to that of M, per lane: A <= largest A_0
  void compare_with_reference() {
    for (int lane = 0; lane < width; ++lane) {
      double least = HUGE_VAL, largest = 0;
      const auto count = [&](double ratio) {
        least = ratio < least ? ratio : least;
        largest = ratio > largest ? ratio : largest;
      };
      const T* stiffness = call_.material.stiffness.of(in_.environment(lane));
      const Levels<T>& levels = plan_.levels;
      for (std::int64_t t = team_.begin(plan_.tets); t < team_.end(plan_.tets); ++t)
        count(double(stiffness[t]) / double(levels.reference_stiffness[t]));
      for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
        const double a = Lanes::lane(Lanes::widen(w_.inertia[i]), lane);
        if (a > 0 && levels.fine_inverse[i] > T(0)) count(a / double(levels.reference_inertia[i]));
      }
      o_.ratios[team_.rank][0] = least;
      o_.ratios[team_.rank][1] = largest;
      team_.barrier();
      for (int rank = 0; rank < team_.size; ++rank) {
        least = o_.ratios[rank][0] < least ? o_.ratios[rank][0] : least;
        largest = o_.ratios[rank][1] > largest ? o_.ratios[rank][1] : largest;
      }
      scale_[lane] = largest;
      misfit_[lane] = 1 - least / largest;
      team_.barrier();
    }
  }

  Work& o_;
  bool lbfgs_;
  int newest_ = 0;
  Real accepted_{T(1)}, finite_{T(1)};
  double scale_[width] = {}, misfit_[width] = {};
  Outer outer_[width];
  Pairs pairs_[width];
};

}  // namespace pd::inline PD_TARGET
