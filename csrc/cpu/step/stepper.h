// Runner of solver/step.h on the CPU: one environment by a team of threads, or W environments by one thread.
#pragma once
#include "cpu/step/inputs.h"
#include "cpu/step/rigid.h"
#include "cpu/step/sweep.h"
#include "solver/chebyshev.h"
#include "solver/step.h"
#include "solver/vertex.h"

namespace pd::inline PD_TARGET {

// `HasContacts`: see solver/vertex.h.
template <class Lanes, bool HasContacts>
class Stepper {
 protected:
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;
  using Sum = Sums<Lanes>;
  static constexpr int width = Lanes::environments;

 public:
  // `first` is the first environment; lanes past the batch repeat its last one and are not written back.
  Stepper(const StepCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
          const Team& team, std::int64_t first)
      : call_(call),
        plan_(call.plan),
        set_(call.settings),
        w_(work),
        team_(team),
        sweep_{plan_, work, scratch, team},
        in_{call, first},
        h_(T(set_.time_step)),
        theta_(T(set_.relaxation)) {}

  // All steps of the call, with a record every `set_.every`.
  void rollout() {
    load();
    assemble_diagonal();
    for (int t = 0; t < set_.steps; ++t) {
      step(*this, set_);
      if (is_ended()) return;
      if ((t + 1) % set_.every == 0) store((t + 1) / set_.every - 1);
      move_spheres();
    }
  }

  void predict() {
    const Real none(T(0));
    const Value origin = Lanes::value({none, none, none});
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      w_.target[i] = target(i, none, origin);
    }
    team_.barrier();
    if (team_.rank == 0)
      in_.each_pin([&](std::int64_t i, Real spring, Value pin) {
        const Value offset = pin - w_.x[i];
        const Real soft = select(spring < Real(T(HUGE_VAL)), spring, none);
        w_.target[i] = vertex(i).hold(offset, target(i, soft, offset));
      });
    sweep_.set_origins();
    team_.barrier();
    sweep_.begin_stencils();
    if (plan_.remembers) team_.barrier();
  }

  void start() {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      w_.u[i] = w_.before[i] = vertex(i).first_iterate(contacts_, guess(i));
    }
    const Wide friction = Lanes::widen(contacts_.friction());
    for (int lane = 0; lane < width; ++lane) {
      schedule_[lane] = Schedule(set_, least_[lane], Lanes::lane(friction, lane) > 0);
      next_omega_[lane] = schedule_[lane].next(0);
      used_[lane] = 0;
      done_[lane] = false;
    }
    started_ = false;
    team_.barrier();
  }

  // The coarse correction: every body that pins leave free takes the rigid motion with the least energy. Before the
  // iterations a solid one chooses between two iterates: the present shape, and the guess.
  void align() {
    const bool first = !started_;
    started_ = true;
    if (plan_.components == 0 || (first && set_.start() == StartKind::given)) return;
    if (first && plan_.solid_components > 0) return choose_first_iterate();
    if constexpr (HasContacts) {
      each_elastic_force(
          [&](std::int64_t i, const Vec3<Wide>& force) { keep_forces(i, force, Wide(1.0)); });
    }
    correct();
    if (first) {
      each_that_moves([&](std::int64_t i) { w_.before[i] = w_.u[i]; });
      team_.barrier();
    }
  }

  // The guess that the first iterate is made from.
  Value guess(std::int64_t i) const {
    if (set_.start() == StartKind::given) return in_.at_vertex(call_.start, i) - w_.x[i];
    return set_.start() == StartKind::inertial ? w_.target[i] : Real(h_) * w_.velocity[i];
  }

  void iterate(int k) {
    for (int lane = 0; lane < width; ++lane) {
      Lanes::set_lane(omega_, lane, T(next_omega_[lane]));
      Lanes::set_lane(active_, lane, T(done_[lane] ? 0 : 1));
    }
    const bool guard = schedule_[0].checks_energy(k);
    if (guard) {
      sweep_.run(k & 1, elastic_gradient<true>(),
                 [&](std::int64_t i, const Value& force, Sum& sums) {
                   sums.energy = vertex(i).add_energy(w_.u[i], sums.energy);
                   update(i, force, sums);
                 });
    } else {
      sweep_.run(k & 1, elastic_gradient<false>(),
                 [&](std::int64_t i, const Value& force, Sum& sums) { update(i, force, sums); });
    }
    conclude(k, guard);
  }

  bool finished() const {
    if (is_ended()) return true;
    for (bool done : done_) {
      if (!done) return false;
    }
    return true;
  }

  // Whether the call was interrupted; then nothing of this step counts.
  bool is_ended() const { return team_.ended(std::int64_t(plan_.vertices) * width); }

  void finish() {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      w_.x[i] = w_.x[i] + w_.u[i];
      w_.velocity[i] = Real(T(1) / h_) * w_.u[i];
    }
    team_.barrier();
  }

 protected:
  template <class Visit>
  void each_that_moves(const Visit& visit) {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      if (plan_.vertex_component[i] >= 0) visit(i);
    }
  }

  // visit(vertex, elastic force) for every vertex of a body that moves
  template <class Visit>
  void each_elastic_force(const Visit& visit) {
    sweep_.run(0, elastic_gradient<false>(), [&](std::int64_t i, const Value& force, Sum&) {
      if (plan_.vertex_component[i] >= 0) visit(i, widened<Wide>(Lanes::vec3(force)));
    });
  }

  VertexForces<Lanes> forces_of(std::int64_t i) const { return {w_, plan_.vertices, int(i)}; }

  // Keeps the forces with which the contacts answer the gradient of E; `inertial`: 1, or 0 without inertia.
  void keep_forces(std::int64_t i, const Vec3<Wide>& elastic, const Wide& inertial) {
    const CoarseVertex<Wide> v = coarse_vertex(w_, i);
    const Vec3<Wide> offset = v.u - widened<Wide>(Lanes::vec3(w_.target[i]));
    const Vec3<Wide> gradient =
        multiply_add(inertial * Lanes::widen(w_.inertia[i]), offset, elastic);
    const Vec3<Wide> free = subtract_product(v.u, Lanes::widen(w_.inverse[i]), gradient);
    pd::keep_forces(contacts_, v, free, forces_of(i));
  }

  // Moves every body by its rigid motion with the least energy, and then each vertex by what the contacts still push.
  void correct() {
    if (team_.rank == 0) find_motions<HasContacts>(plan_, w_, contacts_);
    team_.barrier();
    each_that_moves([&](std::int64_t i) {
      CoarseVertex<Wide> v = coarse_vertex(w_, i);
      const auto narrowed = [](const Vec3<Wide>& a) {
        return Vec3<Real>{Lanes::narrow(a.x), Lanes::narrow(a.y), Lanes::narrow(a.z)};
      };
      const Vec3<Wide> way = w_.motion[plan_.vertex_component[i]].of(v.x + v.u);
      Value u = vertex(i).displaced(w_.u[i], narrowed(way));
      if constexpr (HasContacts) {
        v.u = widened<Wide>(Lanes::vec3(u));
        u = vertex(i).displaced(u, narrowed(push_of(contacts_, v, forces_of(i))));
        u = vertex(i).project(contacts_, u, u);
      }
      const Wide moves = w_.body_sums[plan_.vertex_component[i]].moves;
      w_.u[i] = select(Lanes::narrow(moves) > Real(T(0)), u, w_.u[i]);
    });
    team_.barrier();
  }

  Value present_iterate(std::int64_t i) const { return vertex(i).current_iterate(contacts_); }
  Value guessed_iterate(std::int64_t i) const {
    return vertex(i).first_iterate(contacts_, guess(i));
  }

  // The present shape and the guess are both corrected, and the one with the lower energy stays (rise_of). For the present
  // shape, contacts answer the elastic forces alone.
  void choose_first_iterate() {
    const auto add_work = [&](std::int64_t i, const Vec3<Wide>& force, double side) {
      const Vec3<Wide> way = widened<Wide>(Lanes::vec3(guessed_iterate(i))) -
                             widened<Wide>(Lanes::vec3(present_iterate(i)));
      Wide work = Wide(0.5) * dot(force, way);
      if constexpr (HasContacts) {
        keep_forces(i, force, Wide(side > 0 ? 0.0 : 1.0));
        work = multiply_add(Wide(side),
                            anchor_energy(contacts_, coarse_vertex(w_, i), forces_of(i)), work);
      }
      w_.work[i] = w_.work[i] + Lanes::narrow(work);
    };
    each_that_moves([&](std::int64_t i) {
      w_.u[i] = present_iterate(i);
      w_.work[i] = Real(T(0));
    });
    team_.barrier();
    each_elastic_force([&](std::int64_t i, const Vec3<Wide>& force) { add_work(i, force, 1.0); });
    correct();
    if (team_.rank == 0) {
      for (int n = 0; n < plan_.components * width; ++n) w_.reached[n] = w_.bodies[n].reached();
      for (int g = 0; g < plan_.components; ++g) w_.motion_before[g] = w_.motion[g];
    }
    each_that_moves([&](std::int64_t i) {
      w_.before[i] = w_.u[i];
      w_.u[i] = guessed_iterate(i);
    });
    team_.barrier();
    each_elastic_force([&](std::int64_t i, const Vec3<Wide>& force) { add_work(i, force, -1.0); });
    correct();
    if (team_.rank == 0) sum_rises();
    team_.barrier();
    each_that_moves([&](std::int64_t i) {
      const int g = plan_.vertex_component[i];
      const BodySums<Wide>& body = w_.body_sums[g];
      const Real none(T(0)),
          moves = Real(T(g < plan_.solid_components ? 1 : 0)) * Lanes::narrow(body.moves);
      const auto stays = moves > none && !(Lanes::narrow(body.rise) < none);
      w_.u[i] = w_.before[i] = select(stays, w_.before[i], w_.u[i]);
    });
    team_.barrier();
  }

  // Of every body, from the present shape to the guess.
  void sum_rises() {
    for (int g = 0; g < plan_.components; ++g) {
      for (int lane = 0; lane < width; ++lane) {
        const int n = g * width + lane;
        put_lane<Lanes>(w_.body_sums[g].rise, lane, w_.bodies[n].reached() - w_.reached[n]);
      }
    }
    each_in_a_body<Lanes>(plan_, [&](int i, int g) {
      const auto candidate = [&](const Value& first, const Value& last,
                                 const RigidMotion<Wide>& motion) {
        return Candidate<Wide>{widened<Wide>(Lanes::vec3(first)), widened<Wide>(Lanes::vec3(last)),
                               motion};
      };
      const Candidate<Wide> kept = candidate(present_iterate(i), w_.before[i], w_.motion_before[g]),
                            moved = candidate(guessed_iterate(i), w_.u[i], w_.motion[g]);
      Wide& rise = w_.body_sums[g].rise;
      rise = (rise + Lanes::widen(w_.work[i])) +
             rise_of<HasContacts>(Lanes::widen(w_.inertia[i]), widened<Wide>(Lanes::vec3(w_.x[i])),
                                  widened<Wide>(Lanes::vec3(w_.target[i])), kept, moved);
    });
  }

  Value target(std::int64_t i, const Real& spring, const Value& pin) const {
    const Real h(h_), mass = in_.number(call_.material.masses, plan_.vertex_order[i]);
    const Real weight = inertia_weight(mass, damping_, spring, h);
    const Real none(T(0));
    const Value force = call_.forces ? w_.force[i] : Lanes::value({none, none, none});
    return inertia_target(weight, mass, w_.velocity[i], gravity_, force, spring, pin, h);
  }

  PD_HD Vertex<Lanes, HasContacts> vertex(std::int64_t i) const {
    return {w_.x[i], w_.target[i], w_.inertia[i], w_.inverse[i]};
  }

  void load() {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      w_.x[i] = in_.at_vertex(call_.positions, i);
      w_.velocity[i] = in_.at_vertex(call_.velocities, i);
      if (call_.forces) w_.force[i] = in_.at_vertex(call_.forces, i);
    }
    gravity_ = in_.vector(call_.material.gravity, 0);
    for (int lane = 0; lane < width; ++lane) {
      stop_[lane] = {
          squared_free_fall(plan_.vertices, set_.time_step, Lanes::get_lane(gravity_, lane))};
    }
    damping_ = in_.number(call_.material.damping, 0);
    const Material<T>& material = call_.material;
    contacts_ = {w_.planes, w_.spheres, material.planes_count, material.spheres_count};
    if (team_.rank == 0) {
      for (int c = 0; c < material.planes_count; ++c) {
        w_.planes[c] = {Lanes::vec3(in_.vector(material.planes, planes_numbers * c)),
                        in_.number(material.planes, planes_numbers * c + planes_height),
                        in_.number(material.planes, planes_numbers * c + planes_friction)};
      }
      for (int c = 0; c < material.spheres_count; ++c) {
        w_.spheres[c] = {
            Lanes::vec3(in_.vector(material.spheres, spheres_numbers * c)),
            Lanes::vec3(in_.vector(material.spheres, spheres_numbers * c + spheres_motion)),
            in_.number(material.spheres, spheres_numbers * c + spheres_radius),
            in_.number(material.spheres, spheres_numbers * c + spheres_friction)};
      }
    }
    team_.barrier();
  }

  void move_spheres() {
    if (team_.rank == 0) {
      for (int c = 0; c < contacts_.sphere_count; ++c)
        w_.spheres[c].center = w_.spheres[c].center + w_.spheres[c].motion;
    }
    if (contacts_.sphere_count) team_.barrier();
  }

  // a and 1 / D of every vertex, the weights of every element, and the smallest a / D
  void assemble_diagonal() {
    const Real none(T(0));
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      w_.inertia[i] = inertia_weight(in_.number(call_.material.masses, plan_.vertex_order[i]),
                                     damping_, none, Real(h_));
    }
    team_.barrier();
    if (team_.rank == 0)
      in_.each_pin([&](std::int64_t i, Real spring, Value) {
        w_.inertia[i] = held_inertia(w_.inertia[i] + spring, spring);
      });
    const auto environment_of = [&](int lane) { return in_.environment(lane); };
    const auto set_weights = [&](WeightKind kind) {
      sweep_.set_weights(call_.material.stiffness, call_.effects, kind, environment_of);
    };
    set_weights(set_.weighted ? WeightKind::majoriser : WeightKind::matrix);
    sweep_.set_stencil_numbers(call_.effects, environment_of);
    team_.barrier();
    const Elements<SolidDiagonal, StencilDiagonal> diagonal{{}, {set_.weighted}};
    sweep_.run(0, diagonal, [&](std::int64_t i, const Value& force, Sum& sums) {
      const Real a = w_.inertia[i];
      const Real elastic = Lanes::vec3(force).x;
      w_.inverse[i] = inverse_diagonal(a, elastic);
      sums.least = lesser(sums.least, inertia_ratio(a, elastic, w_.inverse[i]));
    });
    Real least = Real(T(HUGE_VAL));
    for (int part = 0; part < w_.part_count; ++part) least = lesser(least, w_.parts[0][part].least);
    for (int lane = 0; lane < width; ++lane) least_[lane] = Lanes::lane(Lanes::widen(least), lane);
    team_.barrier();
    set_weights(WeightKind::force);
    team_.barrier();
  }

  void update(std::int64_t i, const Value& force, Sum& sums) {
    const Value u = w_.u[i], before = w_.before[i];
    Value next = vertex(i).next(contacts_, u, before, force, Real(theta_), omega_);
    if (set_.tolerance > 0) {
      // environments that are done keep their iterate
      next = select(active_ > Real(T(0)), next, u);
      // both are zero where a pin holds the vertex on its target
      const Value change = next - u, displacement = u - w_.target[i];
      sums.first = multiply_add(change, change, sums.first);
      sums.second = multiply_add(displacement, displacement, sums.second);
    }
    w_.before[i] = u;
    w_.u[i] = next;
  }

  typename Workspace<Lanes>::Part total(int parity) const {
    typename Workspace<Lanes>::Part sum = w_.parts[parity][0];
    for (int part = 1; part < w_.part_count; ++part) {
      sum.energy = sum.energy + w_.parts[parity][part].energy;
      sum.first = sum.first + w_.parts[parity][part].first;
      sum.second = sum.second + w_.parts[parity][part].second;
    }
    return sum;
  }

  // every thread adds up the same parts in the same order, so all make the same decisions
  void conclude(int k, bool guard) {
    const bool soft = set_.tolerance > 0;
    double omega[width];  // of this iteration
    for (int lane = 0; lane < width; ++lane) {
      used_[lane] += done_[lane] ? 0 : 1;
      omega[lane] = next_omega_[lane];
      next_omega_[lane] = schedule_[lane].next(k + 1);
    }
    if (!guard && !soft) return;
    const auto sum = total(k & 1);
    for (int lane = 0; lane < width; ++lane) {
      if (done_[lane]) continue;
      if (guard) schedule_[lane].check(Lanes::lane(sum.energy, lane));
      if (!soft) continue;
      const double change = Lanes::lane(sum.first, lane),
                   displacement = Lanes::lane(sum.second, lane);
      const ErrorShare share = schedule_[lane].error_share(omega[lane]);
      done_[lane] = stop_[lane].is_met(set_.tolerance, share, change, displacement);
    }
  }

  void store(int record) {
    const std::int64_t first_row = record * call_.batch;
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      for (int lane = 0; lane < width && in_.first + lane < call_.batch; ++lane) {
        const std::int64_t at =
            ((first_row + in_.first + lane) * plan_.vertices + plan_.vertex_order[i]) * 3;
        write(call_.out_positions + at, Lanes::get_lane(w_.x[i], lane));
        write(call_.out_velocities + at, Lanes::get_lane(w_.velocity[i], lane));
      }
    }
    if (!call_.info || team_.rank != 0) return;
    for (int lane = 0; lane < width && in_.first + lane < call_.batch; ++lane) {
      double* row = call_.info + (first_row + in_.first + lane) * info_count;
      row[info_residual] = row[info_energy] = NAN;
      row[info_iterations] = used_[lane];
      row[info_restarts] = schedule_[lane].restarts;
      row[info_converged] = done_[lane] && least_[lane] >= 0;
      row[info_rho] = schedule_[lane].rho;
      row[info_inverted] = -1;
    }
  }

  static void write(T* to, const Vec3<T>& v) {
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
  }

  const StepCall<T>& call_;
  const Plan<T>& plan_;
  const Settings& set_;
  Workspace<Lanes>& w_;
  const Team& team_;
  Sweep<Lanes> sweep_;
  Inputs<Lanes> in_;
  T h_, theta_;
  Contacts<Real> contacts_;
  Value gravity_ = {};
  Real damping_{T(0)}, omega_{T(1)}, active_{T(1)};
  double least_[width] = {};
  Schedule schedule_[width];
  double next_omega_[width] = {};  // the next omega
  StoppingTest stop_[width];
  int used_[width] = {};
  bool done_[width] = {};
  bool started_ = false;  // has a first iterate
};

}  // namespace pd::inline PD_TARGET
