// Runner of solver/adjoint/conjugate_gradients.h: one environment at a time, by one thread or by a team.
#pragma once
#include "cpu/adjoint/pair_storage.h"
#include "cpu/adjoint/rotation_jacobians.h"
#include "cpu/multilevel/v_cycle.h"
#include "cpu/step/sweep.h"
#include "solver/adjoint/friction.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>

namespace pd::inline PD_TARGET {

// Vectors of BiCGStab: p, the first residual of a cycle, the correction of y, and the second product of an iteration.
// Pairs of surfaces take two more: the vector that a product is of, slanted, and the product.
template <class T>
struct FrictionVectors {
  Quad<T>*search, *shadow, *correction, *smoothed, *slanted, *product;  // [vertices]

  FrictionVectors(std::int64_t vertices, bool pairs)
      : storage_(allocate_zeroed((pairs ? 6 : 4) * vertices * sizeof(Quad<T>))) {
    search = reinterpret_cast<Quad<T>*>(storage_.get());
    shadow = search + vertices;
    correction = shadow + vertices;
    smoothed = correction + vertices;
    slanted = smoothed + vertices;
    product = slanted + vertices;
  }

 private:
  Storage storage_;
};

// Memory of one environment's solve, shared by a team. `HasPairs`: with contact between bodies, by one thread.
template <class T, bool HasPairs>
struct ConjugateMemory {
  Workspace<Single<T>> vectors;
  RotationJacobians<T> jacobians;
  std::unique_ptr<Cycle<Single<T>>> cycle;  // null without levels
  FrictionVectors<T> friction;
  std::optional<PairStorage<T>> pairs;

  explicit ConjugateMemory(const ConjugateCall<T>& call)
      : vectors(call),
        jacobians(call.plan, call.effects.poisson.data != nullptr),
        friction(call.friction ? call.plan.vertices : 0, HasPairs) {
    if constexpr (HasPairs) pairs.emplace(*call.pairs);
    if (call.plan.levels.there()) cycle = std::make_unique<Cycle<Single<T>>>(call.plan.levels);
  }
};

template <class T, bool HasPairs = false>
class ConjugatePass {
  using Lanes = Single<T>;
  using Sum = Sums<Lanes>;

 public:
  ConjugatePass(const ConjugateCall<T>& call, ConjugateMemory<T, HasPairs>& work,
                Scratch<Lanes>& scratch, const Team& team)
      : call_(call),
        plan_(call.plan),
        w_(work.vectors),
        jacobians_(work.jacobians),
        cycle_(work.cycle.get()),
        f_(work.friction),
        storage_(work.pairs ? &*work.pairs : nullptr),
        team_(team),
        sweep_{plan_, w_, scratch, team} {}

  void run(std::int64_t environment) {
    Conjugate numbers(call_.progress + environment * progress_count);
    if (!numbers.active) return;
    environment_ = environment;
    find_unit();
    load(numbers.begins);
    numbers.scale_by(1 / double(unit_));
    if (numbers.begins) begin(numbers);
    int k = 0;
    for (; k < call_.iterations && numbers.active && !team_.ended(plan_.vertices); ++k)
      iterate(numbers);
    store(solve_friction(numbers, k));
    numbers.scale_by(double(unit_));
    if (team_.rank == 0) numbers.write(call_.progress + environment * progress_count);
    team_.barrier();
  }

 private:
  std::int64_t row(std::int64_t i) const {
    return (environment_ * plan_.vertices + plan_.vertex_order[i]) * 3;
  }
  Quad<T> read(const T* from, std::int64_t i) const {
    return to_quad(from[row(i)], from[row(i) + 1], from[row(i) + 2]);
  }

  // Every thread computes it for itself.
  void find_unit() {
    const std::int64_t count = 3 * std::int64_t(plan_.vertices);
    const T* residual = call_.residual + environment_ * count;
    T largest = 0;
    for (std::int64_t i = 0; i < count; ++i) largest = std::max(largest, std::abs(residual[i]));
    unit_ = unit_near(largest);
  }

  void load(bool begins) {
    const T per_unit = T(1) / unit_;
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      w_.x[i] = read(call_.start ? call_.start : call_.positions, i);
      if (call_.start) w_.u[i] = read(call_.positions, i) - w_.x[i];
      solution()[i] = begins ? to_quad<T>(0, 0, 0) : per_unit * read(call_.solution, i);
      residual()[i] = per_unit * read(call_.residual, i);
      direction()[i] = per_unit * read(call_.direction, i);
      w_.inertia[i] = call_.inertia.of(environment_)[plan_.vertex_order[i]];
      w_.inverse[i] = call_.inverse.of(environment_)[plan_.vertex_order[i]];
    }
    const auto environment_of = [&](int) { return environment_; };
    sweep_.set_weights(call_.stiffness, call_.effects, WeightKind::force, environment_of);
    sweep_.set_stencil_numbers(call_.effects, environment_of);
    team_.barrier();
    sweep_.set_origins();
    team_.barrier();
    if (plan_.remembers) {
      sweep_.begin_stencils();
      team_.barrier();
    }
    sweep_.run(0, Elements{KeepJacobians<T>{jacobians_}, NoStencils{}},
               [](std::int64_t, const Quad<T>&, Sum&) {});
    if constexpr (HasPairs) {
      pairs_.reset(new AdjointPairs<T, OneThread>(*call_.pairs, plan_.vertex_order, one_,
                                                  storage_->memory(environment_), environment_));
      pairs_->read(
          [&](int i) -> T& { return w_.inverse[i]; }, [&](int i) { return projector(i); },
          [&](int i) { return sliding(i); },
          [&](std::int64_t low, std::int64_t square) { return storage_->factors(low, square); });
    }
  }

  void begin(Conjugate& numbers) {
    double whole = 0;
    if constexpr (HasPairs) {
      whole = square(residual());
      leave_pairs(residual());
    }
    const double weighted = cycle_ ? apply_levels() : 0;
    each_part([&](std::int64_t i, Sum& sums) {
      const Quad<T> right = residual()[i];
      direction()[i] = preconditioned_residual(i);
      // zero, unless a number is infinite or NaN
      const Quad<T> lost = multiply_add(T(0), w_.x[i], T(0) * right);
      sums.first = multiply_add(right, right, sums.first) + lost;
      sums.second = multiply_add(right, direction()[i], sums.second);
    });
    const auto sum = total(1);
    numbers.begin(sum.first, cycle_ ? weighted : sum.second);
    // the pairs may take all of it but rounding: errors are relative to what was there before
    if (HasPairs && numbers.active) {
      numbers.scale = std::sqrt(whole);
      numbers.check_residual(sum.first, call_.tolerance);
    }
    team_.barrier();  // before the next sums stand there
  }

  // visit(vertex, elastic Hessian times the direction, sums)
  template <class Visit>
  void multiply(const Visit& visit) {
    sweep_.template run<2>(0, Elements{JacobianProduct<T>{jacobians_}, StencilHessian{}}, visit);
  }

  void iterate(Conjugate& numbers) {
    multiply([&](std::int64_t i, const Quad<T>& force, Sum& sums) {
      const Quad<T> d = direction()[i];
      const Vec3<T> moved = conjugate_image(to_vec3(force), to_vec3(d), w_.inertia[i],
                                            w_.inverse[i] != T(0), projector(i), across(i));
      image()[i] = Lanes::value(moved);
      sums.first = multiply_add(d, image()[i], sums.first);
    });
    if constexpr (HasPairs) {
      add_pairs(true, direction(), image());
      leave_pairs(image());
      each_part([&](std::int64_t i, Sum& sums) {
        sums.first = multiply_add(direction()[i], image()[i], sums.first);
      });
    }
    const T step = T(numbers.step(total(HasPairs ? 1 : 0).first));
    if (!numbers.active) return;
    each_part([&](std::int64_t i, Sum& sums) {
      solution()[i] = multiply_add(step, direction()[i], solution()[i]);
      const Quad<T> rest = subtract_product(residual()[i], step, image()[i]);
      residual()[i] = rest;
      sums.first = multiply_add(rest, rest, sums.first);
      sums.second = multiply_add(rest, w_.inverse[i] * rest, sums.second);
    });
    const auto sum = total(1);
    numbers.check_residual(sum.first, call_.tolerance);
    if (!numbers.active) return;
    const T keep = T(numbers.direction_ratio(cycle_ ? apply_levels() : sum.second));
    // not part by part: others may still read the sums
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      direction()[i] = multiply_add(keep, direction()[i], preconditioned_residual(i));
    team_.barrier();
  }

  // Continues with BiCGStab where vertices slide, after so many products; returns whether it has.
  bool solve_friction(const Conjugate& numbers, int products) {
    if (!call_.friction || !continues_with_friction(numbers, call_.tolerance)) return false;
    if (!some_slide() && !(HasPairs && pairs_->some())) return false;
    FrictionSolve friction(nullptr, numbers.scale);
    friction.begin(products, adjoint_iterations);
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      f_.correction[i] = to_quad<T>(0, 0, 0);
    while (friction.active() && !team_.ended(plan_.vertices)) advance(friction);
    if (team_.rank == 0) friction.write(call_.friction + environment_ * friction_count);
    return true;
  }

  // every thread checks for itself
  bool some_slide() const {
    if (!call_.sliding) return false;
    for (std::int64_t i = 0; i < plan_.vertices; ++i) {
      if (slides(sliding(i))) return true;
    }
    return false;
  }

  void advance(FrictionSolve& friction) {
    const FrictionStage stage = friction.stage;
    if (cycle_ && stage != FrictionStage::residual)
      precondition(stage == FrictionStage::first ? f_.search : residual());
    const auto z = [&](std::int64_t i) {
      if (stage == FrictionStage::residual) return solution()[i] + f_.correction[i];
      if (cycle_) return cycle_->result()[i];
      return w_.inverse[i] * (stage == FrictionStage::first ? f_.search : residual())[i];
    };
    if constexpr (HasPairs) slant(stage == FrictionStage::residual ? 2 : 1, z);
    const auto moved = [&](std::int64_t i) { return HasPairs ? f_.slanted[i] : z(i); };
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      direction()[i] = against_friction(moved(i), i);
    team_.barrier();
    const auto record = [&](std::int64_t i, const Quad<T>& product, Sum& sums) {
      if (stage == FrictionStage::residual) {
        const Quad<T> rest = HasPairs ? product : (T(1) / unit_) * read(call_.right, i) - product;
        residual()[i] = rest;
        sums.first = multiply_add(rest, rest, sums.first);
      } else if (stage == FrictionStage::first) {
        image()[i] = product;
        sums.first = multiply_add(f_.shadow[i], product, sums.first);
      } else {
        f_.smoothed[i] = product;
        sums.first = multiply_add(product, residual()[i], sums.first);
        sums.second = multiply_add(product, product, sums.second);
      }
    };
    multiply([&](std::int64_t i, const Quad<T>& force, Sum& sums) {
      const Quad<T> product = image_with_friction(i, force, moved(i));
      if constexpr (HasPairs) {
        f_.product[i] = product;
      } else {
        record(i, product, sums);
      }
    });
    if constexpr (HasPairs) {
      add_pairs(false, direction(), f_.product);
      for (std::int64_t i = 0; stage == FrictionStage::residual && i < plan_.vertices; ++i)
        f_.product[i] = (T(1) / unit_) * read(call_.right, i) - f_.product[i];
      leave_pairs(f_.product);
      each_part([&](std::int64_t i, Sum& sums) { record(i, f_.product[i], sums); });
    }
    const auto sum = total(HasPairs ? 1 : 0);
    if (stage == FrictionStage::residual) return correct(friction, sum.first);
    const bool first = stage == FrictionStage::first;
    const T step =
        T(first ? friction.search_step(sum.first) : friction.residual_step(sum.first, sum.second));
    if (first && friction.stage == FrictionStage::residual) return;
    const Quad<T>* const product = first ? image() : f_.smoothed;
    each_part([&](std::int64_t i, Sum& sums) {
      f_.correction[i] = multiply_add(step, z(i), f_.correction[i]);
      const Quad<T> rest = subtract_product(residual()[i], step, product[i]);
      residual()[i] = rest;
      sums.first = multiply_add(rest, rest, sums.first);
      sums.second = multiply_add(f_.shadow[i], rest, sums.second);
    });
    if (first) return;
    const auto left = total(1);
    const T keep = T(friction.finish_iteration(left.first, left.second, call_.tolerance));
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      f_.search[i] =
          multiply_add(keep, subtract_product(f_.search[i], step, image()[i]), residual()[i]);
    team_.barrier();
  }

  Quad<T> image_with_friction(std::int64_t i, const Quad<T>& force, const Quad<T>& z) const {
    const bool moves = w_.inverse[i] != T(0);
    if (!call_.sliding)
      return Lanes::value(conjugate_image<T>(to_vec3(force), to_vec3(z), w_.inertia[i], moves,
                                             projector(i), nullptr));
    return Lanes::value(
        friction_image(to_vec3(force), to_vec3(z), w_.inertia[i], moves, projector(i), sliding(i)));
  }

  // l of a vertex without pairs: moves along its plane go with moves off it, where friction acts.
  Quad<T> against_friction(const Quad<T>& z, std::int64_t i) const {
    const T* of = sliding(i);
    return of ? Lanes::value(transposed_friction(to_vec3(z), of)) : z;
  }

  // ---- pairs of surfaces

  static Vec3<double> in_double(const Quad<T>& a) {
    return {double(a.q.v[0]), double(a.q.v[1]), double(a.q.v[2])};
  }
  static Quad<T> plus(const Quad<T>& a, const Vec3<double>& b) {
    return to_quad(T(double(a.q.v[0]) + b.x), T(double(a.q.v[1]) + b.y), T(double(a.q.v[2]) + b.z));
  }

  // The part of a field that no pair takes.
  void leave_pairs(Quad<T>* field) {
    pairs_->rows().project([&](int i) { return in_double(field[i]); },
                           [&](int i, const Vec3<double>& a) { field[i] = plus(field[i], a); });
  }

  double square(const Quad<T>* field) const {
    double sum = 0;
    for (std::int64_t i = 0; i < plan_.vertices; ++i) {
      const Vec3<double> a = in_double(field[i]);
      sum += dot(a, a);
    }
    return sum;
  }

  // Adds what the pairs have of the matrix, transposed or by its positive part, times a field.
  void add_pairs(bool positive, const Quad<T>* field, Quad<T>* to) {
    pairs_->multiply(
        positive, [&](int i) { return in_double(field[i]); },
        [&](int i, const Vec3<double>& a) {
          const Vec3<T> free = project(Vec3<T>{T(a.x), T(a.y), T(a.z)}, projector(i));
          to[i] = to[i] + Lanes::value(free);
        });
  }

  // Moves of z that the forces of all pairs do not resist.
  template <class Z>
  void slant(int rounds, const Z& z) {
    for (std::int64_t i = 0; i < plan_.vertices; ++i) f_.slanted[i] = z(i);
    pairs_->rows().slant(
        rounds, [&](int i) { return in_double(f_.slanted[i]); },
        [&](int i, const Vec3<double>& a) { f_.slanted[i] = plus(f_.slanted[i], a); });
  }

  // Takes the |r|^2 of the true residual of y with its correction: begins a cycle, or ends.
  void correct(FrictionSolve& friction, double square) {
    const bool enters = friction.accept(square, call_.tolerance);
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      if (enters) solution()[i] = solution()[i] + f_.correction[i];
      f_.correction[i] = to_quad<T>(0, 0, 0);
      f_.search[i] = f_.shadow[i] = residual()[i];
    }
    team_.barrier();
  }

  // Applies M to a field; the result stands in the cycle.
  void precondition(const Quad<T>* field) {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      cycle_->input()[i] = field[i];
    team_.barrier();
    cycle_->run(team_);
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      Quad<T>& z = cycle_->result()[i];
      z = Lanes::value(preconditioned(to_vec3(z), to_vec3(field[i]), w_.inverse[i],
                                      plan_.levels.reference_inertia[i], projector(i)));
    }
    team_.barrier();
  }

  // Applies M to the residual, for `preconditioned_residual`; returns r . M r.
  double apply_levels() {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      cycle_->input()[i] = residual()[i];
    team_.barrier();
    cycle_->run(team_);
    each_part([&](std::int64_t i, Sum& sums) {
      Quad<T>& z = cycle_->result()[i];
      z = Lanes::value(preconditioned(to_vec3(z), to_vec3(residual()[i]), w_.inverse[i],
                                      plan_.levels.reference_inertia[i], projector(i)));
      sums.second = multiply_add(residual()[i], z, sums.second);
    });
    const double sum = total(1).second;
    team_.barrier();  // before the next sums stand there
    return sum;
  }
  Quad<T> preconditioned_residual(std::int64_t i) const {
    return cycle_ ? cycle_->result()[i] : w_.inverse[i] * residual()[i];
  }

  const T* sliding(std::int64_t i) const {
    return call_.sliding ? call_.sliding + slide_count * row(i) : nullptr;
  }
  const T* across(std::int64_t i) const {
    return call_.sliding ? sliding(i) + 3 * slide_across : nullptr;
  }
  // on the free directions; null where all are free
  const T* projector(std::int64_t i) const {
    return call_.projector ? call_.projector + 3 * row(i) : nullptr;
  }

  // `slides`: the multiplier is G^T times the solution
  void store(bool slides) {
    if (HasPairs && slides) {
      slant(2, [&](std::int64_t i) { return solution()[i]; });
      std::copy_n(f_.slanted, plan_.vertices, solution());
    }
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      if (slides) solution()[i] = against_friction(solution()[i], i);
      write(call_.solution, i, unit_ * solution()[i]);
      write(call_.residual, i, unit_ * residual()[i]);
      write(call_.direction, i, unit_ * direction()[i]);
    }
  }
  void write(T* to, std::int64_t i, const Quad<T>& a) const {
    for (int c = 0; c < 3; ++c) to[row(i) + c] = a.q.v[c];
  }

  // Visits the vertices of every part of a sweep and leaves the sums as a sweep does: in one order for any number of
  // threads.
  template <class Visit>
  void each_part(const Visit& visit) {
    for (int part = team_.begin(w_.part_count); part < team_.end(w_.part_count); ++part) {
      const bool whole = part < plan_.patches;
      const int first =
          whole ? plan_.patch_vertex[part]
                : plan_.patch_vertex[plan_.patches] + (part - plan_.patches) * shared_chunk;
      const int end =
          whole ? plan_.patch_vertex[part + 1] : std::min(first + shared_chunk, plan_.vertices);
      Sum sums = sweep_.no_sums();
      for (int i = first; i < end; ++i) visit(i, sums);
      sweep_.record(1, part, sums, 0.0);
    }
    team_.barrier();
  }

  // every thread adds up the same parts in the same order, so all make the same decisions
  typename Workspace<Lanes>::Part total(int parity) const {
    typename Workspace<Lanes>::Part sum = w_.parts[parity][0];
    for (int part = 1; part < w_.part_count; ++part) {
      sum.first += w_.parts[parity][part].first;
      sum.second += w_.parts[parity][part].second;
    }
    return sum;
  }

  // the directions stand where a sweep reads its second field
  Quad<T>* direction() const { return w_.before; }
  Quad<T>* solution() const { return w_.velocity; }
  Quad<T>* residual() const { return w_.target; }
  Quad<T>* image() const { return w_.force; }

  const ConjugateCall<T>& call_;
  const Plan<T>& plan_;
  Workspace<Lanes>& w_;
  RotationJacobians<T>& jacobians_;
  const Cycle<Lanes>* cycle_;
  FrictionVectors<T>& f_;
  PairStorage<T>* storage_;
  OneThread one_;
  std::unique_ptr<AdjointPairs<T, OneThread>> pairs_;  // of an environment
  const Team& team_;
  Sweep<Lanes> sweep_;
  std::int64_t environment_ = 0;
  T unit_ = 1;  // unit_near
};

}  // namespace pd::inline PD_TARGET
