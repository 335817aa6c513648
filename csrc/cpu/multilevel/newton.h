// Inexact Newton on the CPU: the iterations of solver/multilevel/lbfgs.h, with directions by conjugate gradients on the
// positive part of the Hessian. An environment at a time.
//
// The preconditioner is that of L-BFGS with the coarse space made at every iterate, between two steps each of a Chebyshev
// iteration with 3 x 3 blocks D >= H: the scalar matrix A resists out of the plane of cloth as in it, H does not. On
// directions that contacts block, D has its trace, so that P H P <= P D P. The space always goes around M, which makes the
// sum positive: on a rod M + Z (Hc^-1 - Ac^-1) Z^T is not, and no direction is found.
#pragma once
#include "cpu/multilevel/newton_elements.h"
#include "cpu/multilevel/trials.h"

namespace pd::inline PD_TARGET {

constexpr double newton_forcing = 0.3;  // share of the residual that conjugate gradients leave

template <class T, bool HasContacts>
class NewtonStepper : public TrialStepper<Single<T>, HasContacts> {
  using Lanes = Single<T>;
  using Base = TrialStepper<Lanes, HasContacts>;
  using Value = Quad<T>;
  using Sum = Sums<Lanes>;
  using Base::dots, Base::each_vertex, Base::none_, Base::o_, Base::plan_, Base::search_,
      Base::set_, Base::sweep_, Base::team_, Base::used_, Base::vertex, Base::w_;

 public:
  NewtonStepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
                const Team& team, std::int64_t first, MultilevelWork<Lanes>& outer,
                NewtonWork<T>& kept)
      : Base(call, work, scratch, team, first, outer), kept_(kept) {}

  void rollout() { this->take_steps(*this); }

  // One iteration is one of conjugate gradients, or one of Jacobi's. A trial of a shorter step is none.
  void minimise() {
    LineSearch& search = search_[0];
    bool moved = true;
    for (int k = 0;; ++k) {
      this->evaluate(k);
      if constexpr (HasContacts) search.overshoots = overshoots();
      this->accept_or_reject(k);
      const bool shortens = !search.accepted && !search.jacobi && !search.plain_jacobi;
      if (used_[0] >= set_.iterations && !shortens) break;
      move_iterate(k);
      if (this->finished()) break;
      moved = moved || search.accepted;
      if (!search.jacobi && moved) {
        solve();
        moved = false;
      }
      this->next_trial();
      used_[0] -= shortens ? 1 : 0;
    }
    this->keep_best();
  }

 private:
  // Whether the residual along the direction has turned round at the trial, so far that a shorter step would leave less.
  // Friction changes with the normal forces, and no energy holds that: without this test full steps diverge from
  // coefficients of about a half on.
  bool overshoots() {
    const LineSearch& search = search_[0];
    if (!search.friction || !search.known || search.jacobi || search.plain_jacobi) return false;
    const double after = product(o_.trial_residual, image());
    const double shorter = search.slope + contact_step_reduction * (after - search.slope);
    return -after > absolute(shorter);
  }

  void move_iterate(int k) {
    this->pass([&](std::int64_t i, Value(&sum)[dots]) { this->move_vertex(k, i, sum); });
    double total[dots];
    this->add_up(0, total);
    this->moved(k, 0, total);
    team_.barrier();
  }

  // The direction at the iterate.
  void solve() {
    each_vertex([&](std::int64_t i) {
      w_.u[i] = o_.iterate[i];
      before()[i] = w_.before[i];
    });
    sweep_.run(0, Elements{KeepFrames<T>{kept_.frames}, KeepHessians<T>{kept_.hessians}},
               [](std::int64_t, const Value&, Sum&) {});
    find_blocks();
    if (this->has_space_) make_space();
    each_vertex([&](std::int64_t i) {
      rest()[i] = moving(i, o_.residual[i]);
      o_.direction[i] = along()[i] = none_;
    });
    const int spent = conjugate_gradients(set_.iterations - used_[0]);
    // the trial that follows counts, too
    used_[0] += spent > 0 ? spent - 1 : 0;
    each_vertex([&](std::int64_t i) {
      w_.before[i] = before()[i];
      image()[i] = this->trial_vertex(vertex(i), i).completed(o_.direction[i]);
    });
    search_[0].renewed();
    search_[0].descends(product(o_.residual, image()));
  }

  // Makes the coarse space at the iterate.
  void make_space() {
    const bool all[1] = {true};
    const double scales[1] = {search_[0].scale};
    this->made_[0] = this->uses_space_ = true;
    this->pieces_.make(o_.iterate, all, scales, &kept_.hessians);
    if constexpr (HasContacts) this->pieces_.hold(o_.free, all, scales);
  }

  // Returns how many there were.
  int conjugate_gradients(int most) {
    const double wanted = newton_forcing * newton_forcing * product(rest(), rest());
    double last = 0;
    for (int n = 0; n < most; ++n) {
      if (team_.ended(plan_.vertices)) return n;
      precondition();
      const double next = product(rest(), solution());
      if (!(next > 0 && next < HUGE_VAL)) return n;
      const T ratio = T(last > 0 ? next / last : 0);
      last = next;
      each_vertex(
          [&](std::int64_t i) { along()[i] = multiply_add(ratio, along()[i], solution()[i]); });
      multiply(along());
      const double curvature = product(along(), image());
      if (!(curvature > 0 && curvature < HUGE_VAL)) return n;
      const T length = T(next / curvature);
      each_vertex([&](std::int64_t i) {
        o_.direction[i] = multiply_add(length, along()[i], o_.direction[i]);
        rest()[i] = subtract_product(rest()[i], length, image()[i]);
      });
      if (product(rest(), rest()) <= wanted) return n + 1;
    }
    return most;
  }

  // solution = the preconditioner times the rest
  void precondition() {
    smooth(rest(), solution());
    leave_rest();
    const T scale = T(search_[0].weight(set_.relaxation, this->is_held(0)));
    each_vertex([&](std::int64_t i) { o_.cycle.input()[i] = scale * left()[i]; });
    if (this->uses_space_) {
      this->run_with_space(scale, true);
    } else {
      o_.cycle.run(team_);
    }
    each_vertex(
        [&](std::int64_t i) { solution()[i] = solution()[i] + moving(i, o_.cycle.result()[i]); });
    leave_rest();
    smooth(left(), added());
    each_vertex([&](std::int64_t i) { solution()[i] = solution()[i] + added()[i]; });
  }

  // left = rest - H solution
  void leave_rest() {
    multiply(solution());
    each_vertex([&](std::int64_t i) { left()[i] = rest()[i] - image()[i]; });
  }

  // Two steps of Chebyshev's iteration from zero, see Smoother.
  void smooth(const Value* right, Value* result) {
    each_vertex([&](std::int64_t i) { step()[i] = T(Smoother::first) * divided(i, right[i]); });
    multiply(step());
    each_vertex([&](std::int64_t i) {
      result[i] = multiply_add(T(Smoother::keep), step()[i],
                               T(Smoother::second) * divided(i, right[i] - image()[i]));
    });
  }

  // image = H field
  void multiply(const Value* field) {
    each_vertex([&](std::int64_t i) { w_.before[i] = field[i]; });
    sweep_.template run<2>(
        0, Elements{PositiveProduct<T>{kept_.frames}, HessianProduct<T>{kept_.hessians}},
        [&](std::int64_t i, const Value& force, Sum&) {
          image()[i] =
              moves(i) ? moving(i, multiply_add(w_.inertia[i], w_.before[i], force)) : none_;
        });
  }

  // The inverses of D, column by column.
  void find_blocks() {
    for (int axis = 0; axis < 3; ++axis) {
      sweep_.run(
          0, Elements{BlockColumn<T>{kept_.frames, axis}, HessianBlocks<T>{kept_.hessians, axis}},
          [&](std::int64_t i, const Value& force, Sum&) { o_.y[axis][i] = force; });
    }
    each_vertex([&](std::int64_t i) {
      Mat3<T> inverse = {};
      if (moves(i)) inverse = inverted(i);
      for (int axis = 0; axis < 3; ++axis) o_.y[axis][i] = Lanes::value(inverse.row[axis]);
    });
  }

  // of the block at a vertex; it is symmetric
  Mat3<T> inverted(std::int64_t i) const {
    Mat3<T> d;
    for (int axis = 0; axis < 3; ++axis) d.row[axis] = to_vec3(o_.y[axis][i]);
    d.row[0].x += w_.inertia[i];
    d.row[1].y += w_.inertia[i];
    d.row[2].z += w_.inertia[i];
    const T trace = (d.row[0].x + d.row[1].y) + d.row[2].z;
    d = (T(1) / trace) * d;
    if constexpr (HasContacts) {
      const Mat3<T>& free = o_.free[i];
      d = free * (d * free);
      d.row[0] = d.row[0] + Vec3<T>{T(1), T(0), T(0)} - free.row[0];
      d.row[1] = d.row[1] + Vec3<T>{T(0), T(1), T(0)} - free.row[1];
      d.row[2] = d.row[2] + Vec3<T>{T(0), T(0), T(1)} - free.row[2];
    }
    const Mat3<T> c = cofactor(d);
    return (T(1) / (trace * dot(d.row[0], c.row[0]))) * c;
  }

  // D^-1 of a number of a field
  Value divided(std::int64_t i, const Value& right) const {
    const Vec3<T> r = to_vec3(right);
    return moving(i,
                  multiply_add(r.z, o_.y[2][i], multiply_add(r.y, o_.y[1][i], r.x * o_.y[0][i])));
  }

  bool moves(std::int64_t i) const { return w_.inverse[i] > T(0); }
  // along the directions that M and H have
  Value moving(std::int64_t i, const Value& field) const {
    return moves(i) ? this->restricted(i, field) : none_;
  }

  double product(const Value* a, const Value* b) {
    this->pass(
        [&](std::int64_t i, Value(&sum)[dots]) { sum[0] = multiply_add(a[i], b[i], sum[0]); });
    double total[dots];
    this->add_up(0, total);
    team_.barrier();  // before the next sums stand there
    return total[0];
  }

  // the vectors of L-BFGS serve here
  Value* rest() const { return o_.s[0]; }
  Value* image() const { return o_.s[1]; }
  Value* along() const { return o_.s[2]; }
  Value* before() const { return o_.s[3]; }  // the iterate before
  Value* solution() const { return o_.s[4]; }
  Value* left() const { return o_.s[5]; }
  Value* step() const { return o_.s[6]; }
  Value* added() const { return o_.s[7]; }

  NewtonWork<T>& kept_;
};

}  // namespace pd::inline PD_TARGET
