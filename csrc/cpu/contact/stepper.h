// Runner of a step with contact between bodies on the CPU: one environment by one thread.
#pragma once
#include "cpu/contact/coarse.h"
#include "cpu/step/stepper.h"

namespace pd::inline PD_TARGET {

constexpr int coarse_pause = 8;  // iterations between coarse corrections
constexpr int coarse_trials = 4;
constexpr int coarse_last = 2;  // iterations before the last one, in which none comes

// `HasContacts`: with planes and spheres of the scene, see solver/vertex.h.
template <class T, bool HasContacts>
class ContactStepper : public Stepper<Single<T>, HasContacts> {
  using Lanes = Single<T>;
  using Base = Stepper<Lanes, HasContacts>;
  using Value = typename Lanes::Value;
  using Sum = Sums<Lanes>;
  using Base::call_, Base::contacts_, Base::done_, Base::least_, Base::next_omega_, Base::plan_,
      Base::schedule_, Base::set_, Base::stop_, Base::sweep_, Base::theta_, Base::used_,
      Base::vertex, Base::w_;

 public:
  ContactStepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
                 const Team& team, std::int64_t environment, const ContactCall<T>& contact,
                 ContactRun<T>& run, Approach<T>& approach, CoarseContact<T>& coarse)
      : Base(call, work, scratch, team, environment),
        contact_(contact),
        run_(run),
        approach_(approach),
        coarse_(coarse),
        environment_(environment),
        touches_(std::max(1, plan_.components)) {}

  void rollout() {
    this->load();
    this->assemble_diagonal();
    step(*this, set_);
    if (!this->is_ended()) this->store(0);
    write();
  }

  void start() {
    Base::start();
    const ContactPlan<T>& plan = run_.plan();
    for (int i = 0; i < plan_.vertices; ++i) {
      const int v = plan_.vertex_order[i];
      run_.place()[v] = place_of(i, Value{});
      run_.inverse()[v] = w_.inverse[i];
      run_.goal()[v] = place_of(i, w_.target[i]);
    }
    const std::int64_t poses = environment_ * plan.colliders * 7,
                       row = environment_ * plan.capacity;
    run_.begin(contact_.history.poses + poses, contact_.poses + poses, contact_.history.keys + row,
               contact_.history.forces + 4 * row);
    begun_ = false;
  }

  // First approach, search and the first iterate, as near to the guess as the promise allows. Then the coarse correction.
  void align() {
    if (begun_) return correct(true);
    begun_ = true;
    guess_alone();
    want([&](int i) { return w_.u[i]; });
    approach_.move(run_, [&](int v) { return mass(v); }, walls());
    run_.find();
    stay_where_stopped();
    go();
    correct(false);
    for (int i = 0; i < plan_.vertices; ++i) w_.before[i] = w_.u[i];
  }

  void iterate(int k) {
    if (k > 0 && k % coarse_pause == 0 && set_.iterations - k > coarse_last) correct(false);
    const T omega(next_omega_[0]);
    const bool guards = schedule_[0].checks_energy(k);
    run_.look();
    const auto gradient = elastic_gradient<true>(guards);
    sweep_.run(k & 1, gradient, [&](std::int64_t i, const Value& force, Sum& sums) {
      const auto v = vertex(i);
      if (guards) sums.energy = v.add_energy(w_.u[i], sums.energy);
      free_[i] = Lanes::vec3(accelerate(w_.u[i], w_.before[i], v.gradient(w_.u[i], force),
                                        theta_ * w_.inverse[i], omega));
    });
    ++used_[0];
    next_omega_[0] = schedule_[0].next(k + 1);
    if (guards) guard(double(this->total(k & 1).energy));
    want([&](int i) { return Lanes::value(free_[i]); });
    run_.prox(theta_ * omega);
    if constexpr (HasContacts) leave_walls();
    run_.prepare(k);
    const double change = go();
    if (set_.tolerance > 0) stop(change, omega);
  }

  void finish() {
    run_.measure();
    forces_.assign(run_.plan().vertices, Vec3<T>{T(0), T(0), T(0)});
    run_.list().add_forces(forces_);
    residual_ = contact_.report ? residual() : double(NAN);
    Base::finish();
  }

 private:
  Vec3<T> place_of(std::int64_t i, const Value& u) const { return Lanes::vec3(w_.x[i] + u); }

  double mass(int v) const { return double(call_.material.masses.of(environment_)[v]); }

  // Targets of the next move: displacements of bodies, and the goals of what moves by hand.
  template <class Displacement>
  void want(const Displacement& displacement) {
    const ContactPlan<T>& plan = run_.plan();
    for (int i = 0; i < plan_.vertices; ++i) {
      const int v = plan_.vertex_order[i];
      run_.target()[v] = run_.moves_by_hand(v) ? run_.goal()[v] : place_of(i, displacement(i));
    }
    for (int v = plan.body_vertices; v < plan.vertices; ++v) run_.target()[v] = run_.goal()[v];
  }

  // The guess of components without forces of contact: the present shape or h v, after a coarse correction of its own.
  void guess_alone() {
    for (int i = 0; i < plan_.vertices; ++i) free_[i] = Lanes::vec3(w_.u[i]);
    Base::align();
    std::fill(touches_.begin(), touches_.end(), 0);
    run_.each_known([&](int v) {
      const int g = coarse_.component(v);
      if (g >= 0) touches_[g] = 1;
    });
    for (int i = 0; i < plan_.vertices; ++i) {
      const int g = plan_.vertex_component[i];
      if (g >= 0 && touches_[g]) w_.u[i] = Lanes::value(free_[i]);
    }
  }

  // The coarse correction of bodies that pairs join; `alone`: and of all others. It shifts both iterates alike. Where a motion
  // is cut, forces grow with the gaps of now, and another one follows.
  void correct(bool alone) {
    for (int n = 0; n < coarse_trials && correct_once(alone); ++n) continue;
  }

  // Whether a motion was cut.
  bool correct_once(bool alone) {
    coarse_.begin(run_);
    bool some = false, cut = false;
    for (int g = 0; g < plan_.components; ++g) some = some || asks(g, alone);
    if (!some) return false;
    run_.look();
    keep_wall_forces();
    sum_bodies(plan_, w_);
    for (int i = 0; i < plan_.vertices; ++i) {
      free_[i] = old_[i] = Lanes::vec3(w_.u[i]);
      previous_[i] = Lanes::vec3(w_.before[i]);
    }
    bool pushes = false;
    for (int g = 0; g < plan_.components; ++g) {
      if (!asks(g, alone)) continue;
      coarse_.template find<HasContacts>(run_, w_, g, contacts_);
      if (!coarse_.is_valid()) continue;
      const T share(coarse_.move(run_, w_, g));
      cut = cut || share < T(1);
      coarse_.each_vertex(g, [&](int i) {
        const Vec3<T> push = share * wall_push(i);
        pushes = pushes || dot(push, push) > T(0);
        w_.u[i] = Lanes::value(run_.place()[plan_.vertex_order[i]]) - w_.x[i];
        free_[i] = Lanes::vec3(w_.u[i]) + push;
      });
    }
    run_.remember();
    run_.forget_check();
    want([&](int i) { return Lanes::value(free_[i]); });
    if constexpr (HasContacts) leave_walls();
    if (coarse_.leaves_list()) run_.find();
    run_.look();
    run_.refresh(run_.place());
    if (pushes) {
      run_.refresh(run_.target());
      go();
    }
    for (int i = 0; i < plan_.vertices; ++i)
      w_.before[i] = Lanes::value(previous_[i]) + (w_.u[i] - Lanes::value(old_[i]));
    return cut;
  }

  bool asks(int root, bool alone) const {
    return coarse_.is_island(root) && (alone || coarse_.has_pairs(root));
  }

  // The forces with which planes and spheres answer those of elements, inertia and pairs.
  void keep_wall_forces() {
    if constexpr (HasContacts) {
      forces_.assign(run_.plan().vertices, Vec3<T>{T(0), T(0), T(0)});
      run_.list().add_forces(forces_);
      this->each_elastic_force([&](std::int64_t i, const Vec3<double>& force) {
        const Vec3<T>& push = forces_[plan_.vertex_order[i]];
        this->keep_forces(i, force - widened<double>(push), 1.0);
      });
    }
  }

  // What planes and spheres push after the whole motion of a body.
  Vec3<T> wall_push(int i) const {
    const auto narrowed = [](const Vec3<double>& a) { return Vec3<T>{T(a.x), T(a.y), T(a.z)}; };
    if constexpr (HasContacts) {
      const Value moved = vertex(i).displaced(w_.u[i], narrowed(coarse_.way(w_, i)));
      CoarseVertex<double> v = coarse_vertex(w_, i);
      v.u = widened<double>(Lanes::vec3(moved));
      const auto forces = this->forces_of(i);
      const Value out = vertex(i).displaced(moved, narrowed(push_of(contacts_, v, forces)));
      return Lanes::vec3(vertex(i).project(contacts_, out, out) - moved);
    }
    return {T(0), T(0), T(0)};
  }

  // calls visit(normal, bound) for planes and spheres of the scene, no deeper than at the place of a vertex
  auto walls() const {
    return [this](int v, const Vec3<T>& place, const auto& visit) {
      if (!HasContacts || v >= run_.plan().body_vertices || run_.moves_by_hand(v)) return;
      each_wall(contacts_, place, visit);
    };
  }

  // Targets out of the planes and spheres of the scene, with their friction.
  void leave_walls() {
    for (int i = 0; i < plan_.vertices; ++i) {
      Vec3<T>& target = run_.target()[plan_.vertex_order[i]];
      const Value u = Lanes::value(target) - w_.x[i];
      const Value out = vertex(i).project(contacts_, u, w_.u[i]);
      target = place_of(i, out);
    }
  }

  // What was stopped starts where it was: nearer to its guess it would only be squashed.
  void stay_where_stopped() {
    const ContactPlan<T>& plan = run_.plan();
    for (int v = 0; v < plan.body_vertices; ++v) {
      if (!run_.moves_by_hand(v) && approach_.was_stopped(plan.body[v]))
        run_.target()[v] = run_.place()[v];
    }
  }

  // Moves toward the targets; returns the square of the change, or infinity while something is held up.
  double go() {
    run_.move(walls());
    double change = 0;
    for (int i = 0; i < plan_.vertices; ++i) {
      const int v = plan_.vertex_order[i];
      const Value u = w_.u[i], next = Lanes::value(run_.place()[v]) - w_.x[i], way = next - u;
      w_.u[i] = next;
      w_.before[i] = run_.was_cut(v) ? next : u;
      change += double(dot(Lanes::vec3(way), Lanes::vec3(way)));
    }
    return run_.is_at_rest() ? change : HUGE_VAL;
  }

  void guard(double energy) {
    const auto merits = run_.check(energy);
    Schedule& schedule = schedule_[0];
    schedule.last_energy = merits.known ? merits.before : HUGE_VAL;
    schedule.check(merits.now);
  }

  void stop(double change, T omega) {
    double displacement = 0;
    for (int i = 0; i < plan_.vertices; ++i) {
      const Vec3<T> way = Lanes::vec3(w_.u[i] - w_.target[i]);
      displacement += double(dot(way, way));
    }
    const bool met = stop_[0].is_met(set_.tolerance, schedule_[0].error_share(double(omega)),
                                     change, displacement);
    done_[0] = met && change < HUGE_VAL;
  }

  // |r| / max(|r|, |f|): of r, the part of the gradient that neither pairs nor planes, spheres and pins balance, and of f,
  // the forces of inertia and of elements on every vertex.
  double residual() {
    double left = 0, whole = 0;
    sweep_.run(0, elastic_gradient<false>(), [&](std::int64_t i, const Value& force, Sum&) {
      const auto v = vertex(i);
      if (!(v.inverse > T(0))) return;
      const Value push = Lanes::value(forces_[plan_.vertex_order[i]]);
      const Value inertia = v.inertia * (w_.u[i] - v.target);
      left += square(v.residual(contacts_, w_.u[i], force - push));
      whole += square(inertia) + square(force);
    });
    const double most = left > whole ? left : whole;
    return most > 0 ? std::sqrt(left / most) : 0;
  }

  static double square(const Value& a) {
    const Vec3<T> b = Lanes::vec3(a);
    return double(dot(b, b));
  }

  // Poses, forces and numbers of the contact, for the caller. An overflow takes the step back.
  void write() {
    const ContactPlan<T>& plan = run_.plan();
    const std::int64_t row = environment_ * plan.capacity;
    std::int64_t* key = contact_.history.next_keys + row;
    T* force = contact_.history.next_forces + 4 * row;
    run_.remember();
    int count = 0;
    run_.each_force([&](std::int64_t k, const Multiplier<T>& of) {
      key[count] = k;
      T* const f = force + 4 * count++;
      f[0] = of.normal, f[1] = of.tangential.x, f[2] = of.tangential.y, f[3] = of.tangential.z;
    });
    for (; count < plan.capacity; ++count) {
      key[count] = -1;
      std::fill_n(force + 4 * count, 4, T(0));
    }
    for (int c = 0; c < plan.colliders; ++c) {
      const Hand<T>& hand = run_.hands()[c];
      const std::int64_t at = environment_ * plan.colliders + c;
      Hand<T>::write(hand.pose, contact_.history.next_poses + 7 * at);
      contact_.held_back[at] = T(run_.held_back(hand.begin, hand.end));
    }
    double* info = contact_.info + environment_ * contact_info_count;
    info[contact_gap] = run_.gap;
    info[contact_overflow] = double(std::max<std::int64_t>(0, run_.most_pairs - plan.capacity));
    info[contact_pairs] = double(run_.most_pairs);
    info[contact_searches] = double(run_.searches);
    info[contact_shortened] = double(run_.shortened);
    info[contact_frozen] = double(run_.frozen);
    info[contact_pins_held_back] = run_.held_back(0, plan.body_vertices);
    info[contact_residual] = residual_;
    T* const push = contact_.forces + environment_ * plan.vertices * 3;
    for (int v = 0; v < plan.vertices; ++v) Base::write(push + 3 * v, forces_[v]);
    if (run_.overflows()) take_back();
  }

  // Positions and velocities stay; so do poses and forces. No force acts on the vertices.
  void take_back() {
    const ContactPlan<T>& plan = run_.plan();
    const std::int64_t count = std::int64_t(plan_.vertices) * 3, row = environment_ * plan.capacity,
                       poses = environment_ * plan.colliders * 7;
    std::copy_n(call_.positions + environment_ * count, count,
                call_.out_positions + environment_ * count);
    std::copy_n(call_.velocities + environment_ * count, count,
                call_.out_velocities + environment_ * count);
    std::fill_n(contact_.forces + environment_ * plan.vertices * 3, plan.vertices * 3, T(0));
    std::copy_n(contact_.history.keys + row, plan.capacity, contact_.history.next_keys + row);
    std::copy_n(contact_.history.forces + 4 * row, 4 * plan.capacity,
                contact_.history.next_forces + 4 * row);
    std::copy_n(contact_.history.poses + poses, 7 * plan.colliders,
                contact_.history.next_poses + poses);
  }

  const ContactCall<T>& contact_;
  ContactRun<T>& run_;
  Approach<T>& approach_;
  CoarseContact<T>& coarse_;
  std::int64_t environment_;
  // displacements of the next iterate before contact; and of this one and the last before a correction. A Quad is aligned
  // more than std::vector grants
  std::vector<Vec3<T>> free_ = std::vector<Vec3<T>>(plan_.vertices), old_ = free_,
                       previous_ = free_;
  std::vector<char> touches_;    // [components]
  std::vector<Vec3<T>> forces_;  // of contact, on every vertex
  double residual_ = 0;
  bool begun_ = false;
};

}  // namespace pd::inline PD_TARGET
