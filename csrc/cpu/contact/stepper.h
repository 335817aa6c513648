// A step with contact between bodies on the CPU: the phases of solver/contact by one thread for each environment.
#pragma once
#include "cpu/step/stepper.h"
#include "solver/contact/serial_team.h"
#include "solver/contact/step.h"
#include "views/arena.h"

namespace pd::inline PD_TARGET {

// Arrays of one environment. Capacities are larger than what a step touches, so nothing is zeroed.
template <class T>
class ContactMemory {
 public:
  ContactMemory(const StepCall<T>& call, const ContactPlan<T>& contact) {
    Arena size(nullptr);
    place(size, call, contact);
    storage_ = Storage(new (std::align_val_t{64}) std::byte[size.size()]);
    Arena arena(storage_.get());
    place(arena, call, contact);
  }

  const ContactArrays<T>& arrays() const { return arrays_; }
  Four<T>* saved() const { return saved_; }  // [vertices] displacements before a coarse correction

 private:
  void place(Arena& arena, const StepCall<T>& call, const ContactPlan<T>& contact) {
    arrange(arena, contact, call.plan.components, arrays_);
    arena.place(saved_, call.plan.vertices);
  }

  ContactArrays<T> arrays_;
  Four<T>* saved_;
  Storage storage_;
};

// `HasContacts`: with planes and spheres of the scene, see solver/vertex.h.
template <class T, bool HasContacts>
class ContactStepper : public Stepper<Single<T>, HasContacts> {
  using Lanes = Single<T>;
  using Base = Stepper<Lanes, HasContacts>;
  using Value = typename Lanes::Value;
  using Sum = Sums<Lanes>;
  using Base::call_, Base::contacts_, Base::done_, Base::next_omega_, Base::plan_, Base::schedule_,
      Base::set_, Base::stop_, Base::sweep_, Base::theta_, Base::used_, Base::vertex, Base::w_;

 public:
  ContactStepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
                 const Team& team, std::int64_t environment, const ContactCall<T>& contact,
                 const ContactMemory<T>& memory)
      : Base(call, work, scratch, team, environment),
        contact_(contact),
        memory_(memory),
        e_(environment),
        env_{contact.plan,
             memory.arrays(),
             body(),
             {w_.planes, w_.spheres, call.material.planes_count, call.material.spheres_count},
             contact.history.poses + 7 * e_ * contact.plan.colliders,
             contact.poses + 7 * e_ * contact.plan.colliders,
             contact.history.keys + e_ * contact.plan.capacity,
             contact.history.forces + 4 * e_ * contact.plan.capacity,
             contact.plan.rigid +
                 (contact.plan.rigid ? rigid_numbers * e_ * contact.plan.colliders : 0),
             contact.plan.friction + e_ * contact.plan.friction_stride},
        steps_(env_) {}

  void rollout() {
    this->load();
    this->assemble_diagonal();
    step(*this, set_);
    if (!this->is_ended()) this->store(0);
    write();
  }

  void start() {
    Base::start();
    steps_.start(alone_);
    begun_ = false;
  }

  void align() {
    for (int i = 0; i < plan_.vertices; ++i) {
      const Vec3<T> u = Lanes::vec3(w_.u[i]);
      memory_.saved()[i] = {u.x, u.y, u.z, T(0)};
    }
    Base::align();
    begun_ ? steps_.go_last(alone_, set_.iterations) : steps_.go_first(alone_);
    begun_ = true;
    correct();
  }

  void iterate(int k) {
    if (has_correction(k, set_.iterations)) correct();
    const T omega(next_omega_[0]);
    const bool guards = schedule_[0].checks_energy(k);
    const auto free = [&](std::int64_t i, const Value& force, Sum& sums) {
      const auto v = vertex(i);
      if (guards) sums.energy = v.add_energy(w_.u[i], sums.energy);
      w_.before[i] = accelerate(w_.u[i], w_.before[i], v.gradient(w_.u[i], force),
                                theta_ * w_.inverse[i], omega);
    };
    guards ? sweep_.run(k & 1, elastic_gradient<true>(), free)
           : sweep_.run(k & 1, elastic_gradient<false>(), free);
    ++used_[0];
    next_omega_[0] = schedule_[0].next(k + 1);
    const double energy = guards ? double(this->total(k & 1).energy) : 0.0;
    const bool measures = set_.tolerance > 0;
    double sums[2];
    const auto merits = steps_.iterate(alone_, k, {theta_ * omega, guards, measures, energy}, sums);
    if (guards) {
      schedule_[0].last_energy = merits.known ? merits.before : HUGE_VAL;
      schedule_[0].check(merits.now);
    }
    if (!measures) return;
    const bool rests = steps_.is_at_rest();
    const ErrorShare share = schedule_[0].error_share(double(omega));
    const bool met = stop_[0].is_met(set_.tolerance, share, rests ? sums[0] : HUGE_VAL, sums[1]);
    done_[0] = met && rests && sums[0] < HUGE_VAL;
  }

  void finish() {
    steps_.finish(alone_, forces());
    Base::finish();
  }

 private:
  // The coarse correction of bodies in contact.
  void correct() {
    bool cuts = true;
    for (int n = 0; cuts && n < coarse_trials && steps_.begin_correction(alone_); ++n) {
      if constexpr (HasContacts) {
        this->each_elastic_force(
            [&](std::int64_t i, const Vec3<double>& force) { this->keep_forces(i, force, 1.0); });
      }
      cuts = steps_.correct(alone_, [&](int i) { return this->forces_of(i); });
    }
  }

  static T* numbers(Value* values) { return reinterpret_cast<T*>(values); }

  BodyState<T> body() {
    return {plan_.vertex_order,
            plan_.vertex_component,
            numbers(w_.x),
            numbers(w_.u),
            numbers(w_.before),
            numbers(w_.target),
            reinterpret_cast<T*>(memory_.saved()),
            numbers(w_.before),
            w_.inverse,
            w_.inertia,
            call_.material.masses.of(e_),
            1,
            plan_.vertices,
            plan_.components};
  }

  T* forces() const { return contact_.forces + 3 * e_ * contact_.plan.vertices; }

  // Poses, forces and numbers of the contact, for the caller. An overflow takes the step back.
  void write() {
    const ContactOutput<T> to = contact_output(contact_, e_);
    steps_.write(alone_, to);
    if (!steps_.overflows()) return;
    const std::int64_t count = 3 * std::int64_t(plan_.vertices);
    std::copy_n(call_.positions + e_ * count, count, call_.out_positions + e_ * count);
    std::copy_n(call_.velocities + e_ * count, count, call_.out_velocities + e_ * count);
  }

  const ContactCall<T>& contact_;
  const ContactMemory<T>& memory_;
  std::int64_t e_;
  ContactEnvironment<T> env_;
  ContactSteps<T, true> steps_;
  SerialTeam alone_;
  bool begun_ = false;
};

}  // namespace pd::inline PD_TARGET
