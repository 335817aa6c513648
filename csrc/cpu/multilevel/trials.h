// What L-BFGS, momentum and Newton's method share on the CPU: trials, their acceptance, the next trial, and the coarse space
// at an iterate.
#pragma once
#include "cpu/multilevel/material_mismatch.h"
#include "cpu/multilevel/pieces.h"
#include "cpu/multilevel/workspace.h"
#include "cpu/step/stepper.h"
#include "solver/multilevel/trial_vertex.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

// A Stepper that tries directions. `HasContacts`: see solver/vertex.h.
template <class Lanes, bool HasContacts>
class TrialStepper : public Stepper<Lanes, HasContacts> {
  using Base = Stepper<Lanes, HasContacts>;

 protected:
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;
  using Sum = Sums<Lanes>;
  using Work = MultilevelWork<Lanes>;
  static constexpr int width = Lanes::environments, dots = Work::dots;
  using Base::call_, Base::contacts_, Base::done_, Base::in_, Base::plan_, Base::schedule_,
      Base::set_, Base::sweep_, Base::team_, Base::used_, Base::vertex, Base::w_;

 public:
  TrialStepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
               const Team& team, std::int64_t first, Work& outer)
      : Base(call, work, scratch, team, first),
        o_(outer),
        pieces_(plan_, team, work, outer.pieces),
        has_space_(pieces_.there()) {}

  void start() {
    Base::start();
    uses_space_ = false;
    const Wide friction = Lanes::widen(contacts_.friction());
    for (int lane = 0; lane < width; ++lane) {
      const bool has_friction = Lanes::lane(friction, lane) > 0;
      search_[lane].begin(mismatch_[lane], HasContacts, has_friction, set_.learns(),
                          energy_noise<T>(), this->stop_[lane].free_fall);
      made_[lane] = holds_[lane] = false;
      schedule_[lane].rho = mismatch_[lane].spread;
    }
    if (has_space_) pieces_.forget();
  }

  // E and the residual at the trial u
  void evaluate(int k) {
    sweep_.run(k & 1, elastic_gradient<true>(), [&](std::int64_t i, const Value& force, Sum& sums) {
      const auto v = vertex(i);
      sums.energy = v.add_energy(w_.u[i], sums.energy);
      o_.trial_residual[i] = v.residual(contacts_, w_.u[i], force);
      if constexpr (HasContacts) {
        const auto free_directions = v.contact_projector(contacts_, w_.u[i], force);
        o_.trial_free[i] = free_directions.free;
        o_.trial_friction[i] = v.friction_force(free_directions.slip);
        o_.trial_gradient[i] = v.gradient(w_.u[i], force);
        // work against the friction at the iterate
        sums.first = multiply_add(o_.friction[i], w_.u[i] - o_.iterate[i], sums.first);
      }
    });
  }

  // every thread decides from the same sums, so all decide alike
  void accept_or_reject(int k) {
    const auto sum = this->total(k & 1);
    for (int lane = 0; lane < width; ++lane) {
      if (done_[lane]) {
        Lanes::set_lane(accepted_, lane, T(0));
        // a finished lane must not enter sums either
        Lanes::set_lane(finite_, lane, T(0));
        continue;
      }
      const double work = search_[lane].known ? Lanes::lane(sum.first, lane) : 0;
      const double energy = Lanes::lane(sum.energy, lane) + work;
      const bool accepted = search_[lane].accept(energy, work);
      Lanes::set_lane(accepted_, lane, T(accepted ? 1 : 0));
      Lanes::set_lane(finite_, lane, T(energy < HUGE_VAL ? 1 : 0));
    }
  }

  // The iterate of a vertex moves to an accepted trial. The last sums are squares: of the change, of the displacement, and
  // of the change of the free directions.
  void move_vertex(int k, std::int64_t i, Value (&sum)[dots]) {
    if (k == 0) {
      o_.iterate[i] = w_.u[i];
      o_.residual[i] = o_.trial_residual[i];
    }
    const Value change = w_.u[i] - o_.iterate[i];
    if constexpr (HasContacts) {
      for (int a = 0; has_space_ && a < 3; ++a) {
        const Value d = Lanes::value(o_.trial_free[i].row[a]) - Lanes::value(o_.free[i].row[a]);
        sum[2 * history + 3] = multiply_add(d, d, sum[2 * history + 3]);
      }
      keep_directions(i);
    }
    // the previous iterate, for momentum
    w_.before[i] = choose(o_.iterate[i], w_.before[i]);
    o_.iterate[i] = choose(w_.u[i], o_.iterate[i]);
    o_.residual[i] = choose(o_.trial_residual[i], o_.residual[i]);
    sum[2 * history] = multiply_add(change, change, sum[2 * history]);
    if (set_.tolerance > 0) {
      const Value displacement = w_.u[i] - w_.target[i];
      sum[2 * history + 1] = multiply_add(displacement, displacement, sum[2 * history + 1]);
    }
  }

  // Reads the sums of all vertices of a lane.
  void moved(int k, int lane, const double (&total)[dots]) {
    search_[lane].add_path(total[2 * history]);
    if (search_[lane].accepted && !(total[2 * history + 3] == 0)) holds_[lane] = false;
    stop(lane, k, total[2 * history], total[2 * history + 1]);
  }

  // next trial: u + beta (u - before) - (1 + beta) t d out of the contacts, or a plain or accelerated Jacobi
  // iteration
  void next_trial() {
    Real beta, length, fallback, diagonal;
    bool some_fallback = false;
    for (int lane = 0; lane < width; ++lane) {
      LineSearch& search = search_[lane];
      const bool goes = !done_[lane], falls_back = goes && (search.plain_jacobi || search.jacobi);
      const double b = goes ? search.propose(schedule_[lane].limit, made_[lane],
                                             has_space_ && !made_[lane], is_held(lane))
                            : 0;
      Lanes::set_lane(beta, lane, T(b));
      Lanes::set_lane(length, lane, T(goes ? (1 + b) * search.trial_length() : 0));
      Lanes::set_lane(fallback, lane, T(falls_back ? 1 : 0));
      Lanes::set_lane(diagonal, lane, T(search.accelerates() ? 1 : 0));
      some_fallback = some_fallback || falls_back;
      used_[lane] += goes ? 1 : 0;
    }
    const Real theta(T(set_.relaxation)), one(T(1));
    each_vertex([&](std::int64_t i) {
      const auto v = vertex(i);
      const auto at = trial_vertex(v, i);
      const Value before = w_.before[i];
      const Value& slope = HasContacts ? o_.gradient[i] : o_.residual[i];
      Value next = at.step(contacts_, before, slope, o_.direction[i], length, beta);
      if (some_fallback)
        next = pick(fallback,
                    at.jacobi(contacts_, before, slope, diagonal > Real(T(0)), theta, one + beta),
                    next);
      w_.u[i] = v.hold(v.target, next);
    });
  }

  // the result is the last trial if accepted, else the iterate; NaN if even its energy is NaN
  void keep_best() {
    Real lost;
    for (int lane = 0; lane < width; ++lane)
      Lanes::set_lane(lost, lane, search_[lane].energy < HUGE_VAL ? T(0) : T(NAN));
    const Value none = Lanes::value({lost, lost, lost});
    each_vertex([&](std::int64_t i) { w_.u[i] = choose(w_.u[i], o_.iterate[i]) + none; });
    for (int lane = 0; lane < width; ++lane) schedule_[lane].restarts = search_[lane].restarts;
  }

 protected:
  // `self`: this, as what it is
  template <class Self>
  void take_steps(Self& self) {
    this->load();
    this->assemble_diagonal();
    compare_with_reference();
    for (int t = 0; t < set_.steps; ++t) {
      multilevel_step(self);
      if (this->is_ended()) return;
      if ((t + 1) % set_.every == 0) this->store((t + 1) / set_.every - 1);
      this->move_spheres();
    }
  }

  // whether contacts or pins that M does not know hold vertices, and the coarse space includes them
  bool is_held(int lane) const {
    return made_[lane] && (mismatch_[lane].has_outliers || pieces_.is_held(lane));
  }

  // the cycle with the coarse space, which encloses it where contacts or outliers hold vertices that M leaves free, or
  // `everywhere`: then the sum is positive
  void run_with_space(const Real& scale, bool everywhere = false) {
    Value *in = o_.cycle.input(), *z = o_.cycle.result();
    bool around[width], some = false;
    for (int lane = 0; lane < width; ++lane) {
      around[lane] =
          everywhere || (HasContacts && !plan_.levels.direct) || mismatch_[lane].has_outliers;
      some = some || around[lane];
    }
    pieces_.before(in, around, some);
    o_.cycle.run(team_);
    pieces_.after(z, around, some, scale);
  }

  // `a` where the lane accepted its trial, else `b`
  Value choose(const Value& a, const Value& b) const { return pick(accepted_, a, b); }

  static Value pick(const Real& flag, const Value& a, const Value& b) {
    return select(flag > Real(T(0)), a, b);
  }

  template <class Visit>
  void each_vertex(Visit visit) const {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) visit(i);
    team_.barrier();
  }

  // visit(vertex, sums), chunk by chunk: neither threads nor the batch change the order of a sum
  template <class Visit>
  void pass(Visit visit) {
    for (std::int64_t c = team_.begin(o_.chunks); c < team_.end(o_.chunks); ++c) {
      Value sum[dots];
      for (Value& s : sum) s = none_;
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

  // from the iterate
  TrialVertex<Lanes, HasContacts> trial_vertex(const Vertex<Lanes, HasContacts>& v,
                                               std::int64_t i) const {
    return {v, o_.iterate[i], o_.residual[i], o_.free + i, plan_.levels, i, outliers_};
  }
  Value restricted(std::int64_t i, const Value& field) const {
    return trial_vertex(vertex(i), i).restricted(field);
  }

  void keep_directions(std::int64_t i) {
    o_.gradient[i] = choose(o_.trial_gradient[i], o_.gradient[i]);
    o_.friction[i] = choose(o_.trial_friction[i], o_.friction[i]);
    for (int a = 0; a < 3; ++a) {
      o_.free[i].row[a] = Lanes::vec3(
          choose(Lanes::value(o_.trial_free[i].row[a]), Lanes::value(o_.free[i].row[a])));
    }
  }

  // The stopping test of an environment. A rejected trial counts too: at rest rounding decides which trials are.
  void stop(int lane, int k, double change, double displacement) {
    if (!(set_.tolerance > 0) || k == 0 || done_[lane]) return;
    done_[lane] = search_[lane].is_met(set_.tolerance, schedule_[lane], change, displacement);
  }

  // the material mismatch of each lane
  void compare_with_reference() {
    for (int lane = 0; lane < width; ++lane) {
      const auto inertia = [&](std::int64_t i) {
        return Lanes::lane(Lanes::widen(w_.inertia[i]), lane);
      };
      MismatchRunner<T, decltype(inertia)> run{
          plan_, call_, in_.environment(lane), w_.per_time, team_, o_.ranges, inertia};
      mismatch_[lane] = measure_mismatch(run, plan_.levels);
      Lanes::set_lane(outliers_.trusted, lane, T(mismatch_[lane].trusted));
      outliers_.some = outliers_.some || mismatch_[lane].has_outliers;
    }
  }

  Work& o_;
  bool uses_space_ = false;
  Outliers<Real> outliers_{false, Real(T(1))};  // in any lane
  bool made_[width] = {};                       // the step has made the coarse space of the lane
  bool holds_[width] = {};                      // includes the contacts at the iterate
  PiecesOfTeam<Lanes> pieces_;
  bool has_space_;
  Value none_ = Lanes::value({Real(T(0)), Real(T(0)), Real(T(0))});
  Real accepted_{T(1)}, finite_{T(1)};
  MaterialMismatch mismatch_[width];
  LineSearch search_[width];
};

}  // namespace pd::inline PD_TARGET
