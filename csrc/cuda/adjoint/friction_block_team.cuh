// BiCGStab of solver/adjoint/friction.h by a team of blocks, after the solve of the symmetric part.
#pragma once
#include "cuda/adjoint/block_team.cuh"
#include "solver/adjoint/friction.h"

namespace pd::inline PD_TARGET {

template <class Work, bool WithLevels, bool Computed>
class FrictionTeam : ConjugateTeam<Work, WithLevels, Computed> {
  using Base = ConjugateTeam<Work, WithLevels, Computed>;
  using Base::call_;
  using Base::cycle_;
  using Base::direction_pending_;
  using Base::each_part;
  using Base::environment_;
  using Base::last_;
  using Base::m_;
  using Base::pairs_;
  using Base::plan_;
  using Base::projector;
  using Base::row;
  using Base::squares_;
  using Base::team_;
  using Base::unit_;
  using Base::warp_sums_;
  using typename Base::T;
  static constexpr bool has_pairs = Work::has_pairs;

 public:
  using Base::Base;

  __device__ void run() {
    double* const progress = call_.progress + environment_ * progress_count;
    double* const of_friction = call_.friction + environment_ * friction_count;
    Conjugate numbers(progress);
    FrictionSolve friction(of_friction, numbers.scale);
    // the same decision in all threads of the team
    if (!numbers.active && !friction.active()) return;
    bool slides = any_slides();
    Base::load(numbers.begins);
    if constexpr (has_pairs) slides = slides || pairs_.all.some();
    if (friction.active()) {
      scale_cycle(T(1) / unit_);
      team_.barrier();
    }
    numbers.scale_by(1 / double(unit_));
    friction.scale_by(1 / double(unit_));
    int k = 0;
    if (numbers.active) {
      k = Base::iterate_all(numbers);
      friction.scale = numbers.scale;
      friction.products_left += k;
      if (slides && continues_with_friction(numbers, call_.tolerance)) begin(friction);
    }
    if (friction.active()) {
      for (; friction.active() && (k < call_.iterations || !friction.may_pause()); ++k)
        advance(friction);
      friction.active() ? scale_cycle(unit_) : press_solution();
    }
    Base::store();
    numbers.scale_by(double(unit_));
    friction.scale_by(double(unit_));
    team_.barrier();  // the next environment overwrites the partial sums
    if (team_.thread() != 0) return;
    numbers.write(progress);
    friction.write(of_friction);
  }

 private:
  template <class Visit>
  __device__ void each_vertex(const Visit& visit) {
    each_part(0, plan_.vertices, visit, [](int) {});
  }

  __device__ const T* sliding(int i) const { return call_.sliding + 3 * slide_count * row(i); }

  // Only scenes with pairs have friction without vertices that touch planes or spheres.
  __device__ Vec3<T> press(const Vec3<T>& z, int i) const {
    if constexpr (has_pairs) {
      if (!call_.sliding) return z;
    }
    return transposed_friction(z, sliding(i));
  }
  __device__ Vec3<T> image_of(const Vec3<T>& elastic, const Vec3<T>& z, int i) const {
    const bool moves = m_.residual[i].w != T(0);
    if constexpr (has_pairs) {
      if (!call_.sliding)
        return conjugate_image<T>(elastic, z, last_[i].w, moves, projector(i), nullptr);
    }
    return friction_image(elastic, z, last_[i].w, moves, projector(i), sliding(i));
  }

  __device__ bool any_slides() {
    if constexpr (has_pairs) {
      if (!call_.sliding) return false;
    }
    double any[1] = {0};
    each_part(
        0, plan_.vertices, [&](int i) { any[0] = slides(sliding(i)) ? 1 : any[0]; },
        [&](int part) {
          Base::largest_.store(part, any, warp_sums_);
          any[0] = 0;
        });
    team_.barrier();
    Base::largest_.reduce(any, warp_sums_);
    team_.barrier();  // others overwrite the partial sums
    return any[0] > 0;
  }

  // Scales the vectors that a cycle keeps between launches.
  __device__ void scale_cycle(T factor) {
    each_vertex([&](int i) {
      m_.shadow[i] = quad(factor * vec3(m_.shadow[i]));
      m_.correction[i] = quad(factor * vec3(m_.correction[i]));
    });
  }

  // Replaces the solution y by the multiplier G^T y.
  __device__ void press_solution() {
    if constexpr (has_pairs) pairs_.slant(2, m_.solution);
    each_vertex([&](int i) { m_.solution[i] = quad(press(vec3(m_.solution[i]), i)); });
  }

  // Called after the solve of the symmetric part.
  __device__ void begin(FrictionSolve& friction) {
    friction.begin(friction.products_left, adjoint_iterations);
    direction_pending_ = false;
    each_part(
        0, plan_.vertices, [&](int i) { m_.correction[i] = quad(Vec3<T>{T(0), T(0), T(0)}); },
        [](int) {});
    team_.barrier();
  }

  __device__ Vec3<T> z(FrictionStage stage, int i) const {
    if (stage == FrictionStage::residual) return vec3(m_.solution[i]) + vec3(m_.correction[i]);
    if constexpr (WithLevels) return cycle_.result(i);
    const Quad<T> residual = m_.residual[i];
    return residual.w * vec3(stage == FrictionStage::first ? last_[i] : residual);
  }

  // What a product is of: z, slanted if there are pairs.
  __device__ Vec3<T> moved(FrictionStage stage, int i) const {
    if constexpr (has_pairs) return vec3(m_.slanted[i]);
    return z(stage, i);
  }

  // Keeps A z at a vertex, and adds to its dot products.
  __device__ void record(FrictionStage stage, int i, const Vec3<T>& image, double (&sum)[2]) {
    const Quad<T> residual = m_.residual[i];
    if (stage == FrictionStage::residual) {
      m_.residual[i] = quad(image, residual.w);
      sum[0] += wide_dot(image, image);
    } else if (stage == FrictionStage::first) {
      m_.image[i] = quad(image);
      sum[0] += wide_dot(vec3(m_.shadow[i]), image);
    } else {
      m_.smoothed[i] = quad(image);
      sum[0] += wide_dot(image, vec3(residual));
      sum[1] += wide_dot(image, image);
    }
  }

  // Computes A z, or what it leaves of the right side, and its dot products.
  __device__ void multiply(FrictionStage stage) {
    const T per_unit = T(1) / unit_;
    const auto left = [&](int i, const Vec3<T>& image) {
      return stage == FrictionStage::residual ? per_unit * read3(call_.right + 3 * row(i)) - image
                                              : image;
    };
    double sum[2] = {0, 0};
    const auto store = [&](int part) {
      products_.store(part, sum, warp_sums_);
      sum[0] = sum[1] = 0;
    };
    const auto pressed = [&](int i) { return press(moved(stage, i), i); };
    if constexpr (has_pairs) {
      each_vertex([&](int i) { m_.slanted[i] = quad(z(stage, i)); });
      team_.barrier();
      pairs_.slant(stage == FrictionStage::residual ? 2 : 1, m_.slanted);
      Base::multiply(
          pressed,
          [&](int i, const Vec3<T>& elastic, const Vec3<T>&) {
            m_.product[i] = quad(image_of(elastic, moved(stage, i), i));
          },
          [](int) {});
      pairs_.multiply(false, pressed, [&](int i) { return projector(i); }, m_.product);
      each_vertex([&](int i) { m_.product[i] = quad(left(i, vec3(m_.product[i]))); });
      team_.barrier();
      pairs_.leave(m_.product);
      each_part(
          0, plan_.vertices, [&](int i) { record(stage, i, vec3(m_.product[i]), sum); }, store);
      team_.barrier();
    } else {
      Base::multiply(
          pressed,
          [&](int i, const Vec3<T>& elastic, const Vec3<T>&) {
            record(stage, i, left(i, image_of(elastic, moved(stage, i), i)), sum);
          },
          store);
    }
  }

  __device__ void advance(FrictionSolve& friction) {
    const FrictionStage stage = friction.stage;
    const bool first = stage == FrictionStage::first;
    if constexpr (WithLevels) {
      if (stage != FrictionStage::residual) precondition(first ? last_ : m_.residual);
    }
    multiply(stage);
    double sum[2];
    products_.reduce(sum, warp_sums_);
    if (stage == FrictionStage::residual) return correct(friction, sum[0]);
    const T step = T(first ? friction.search_step(sum[0]) : friction.residual_step(sum[0], sum[1]));
    // before the next product overwrites the partial sums
    if (first && friction.stage == FrictionStage::residual) return team_.barrier();
    const Quad<T>* const product = first ? m_.image : m_.smoothed;
    double left[2] = {0, 0};
    each_part(
        0, plan_.vertices,
        [&](int i) {
          m_.correction[i] = quad(multiply_add(step, z(stage, i), vec3(m_.correction[i])));
          const Quad<T> residual = m_.residual[i];
          const Vec3<T> rest = subtract_product(vec3(residual), step, vec3(product[i]));
          m_.residual[i] = quad(rest, residual.w);
          left[0] += wide_dot(rest, rest);
          left[1] += wide_dot(vec3(m_.shadow[i]), rest);
        },
        [&](int part) {
          squares_.store(part, left, warp_sums_);
          left[0] = left[1] = 0;
        });
    team_.barrier();
    if (first) return;
    squares_.reduce(left, warp_sums_);
    const T keep = T(friction.finish_iteration(left[0], left[1], call_.tolerance));
    each_part(
        0, plan_.vertices,
        [&](int i) {
          const Quad<T> search = last_[i];
          const Vec3<T> last = subtract_product(vec3(search), step, vec3(m_.image[i]));
          last_[i] = quad(multiply_add(keep, last, vec3(m_.residual[i])), search.w);
        },
        [](int) {});
    team_.barrier();
  }

  // Begins a cycle or ends the solve, by the true |r|^2 of y plus its correction.
  __device__ void correct(FrictionSolve& friction, double square) {
    const bool enters = friction.accept(square, call_.tolerance);
    each_part(
        0, plan_.vertices,
        [&](int i) {
          if (enters) m_.solution[i] = quad(vec3(m_.solution[i]) + vec3(m_.correction[i]));
          const Vec3<T> rest = vec3(m_.residual[i]);
          m_.correction[i] = quad(Vec3<T>{T(0), T(0), T(0)});
          m_.shadow[i] = quad(rest);
          last_[i] = quad(rest, last_[i].w);
        },
        [](int) {});
    team_.barrier();
  }

  // Applies M to a field; cycle_ holds the result.
  __device__ void precondition(const Quad<T>* field) {
    each_part(0, plan_.vertices, [&](int i) { cycle_.set(i, vec3(field[i])); }, [](int) {});
    team_.barrier();
    cycle_.run();
    each_part(
        0, plan_.vertices,
        [&](int i) {
          cycle_.set_result(i, preconditioned(cycle_.result(i), vec3(field[i]), m_.residual[i].w,
                                              plan_.levels.reference_inertia[i], projector(i)));
        },
        [](int) {});
    team_.barrier();
  }

  PartialSums<Add, 2> products_{m_.products, Base::curvature_.count};
};

}  // namespace pd::inline PD_TARGET
