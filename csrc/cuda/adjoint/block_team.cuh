// Conjugate gradients of solver/adjoint/conjugate_gradients.h for a plan of any size. A team of blocks works on one
// environment, with vectors in global memory in plan order, and has barriers between the phases of
// an iteration. There is no host synchronisation.
#pragma once
#include "cuda/adjoint/body_pairs.cuh"
#include "cuda/adjoint/sums.cuh"
#include "cuda/common/teams.cuh"
#include "cuda/multilevel/dense_solve.h"

namespace pd::inline PD_TARGET {

// Global memory of a team.
template <class T>
struct ConjugateMemory {
  Quad<T>*x, *solution, *image;  // [vertices]; image: H times the direction
  Quad<T>* residual;             // [vertices], w: 1 / D
  Quad<T>*direction, *other;     // [vertices], w: inertia; swapped every iteration
  Quad<T>* shared_force;         // [slots], as in FieldWork
  // BiCGStab for friction. smoothed [vertices]: second product of an iteration. Per environment,
  // kept between launches: shadow, the first residual of the cycle; correction, that of y.
  Quad<T>*smoothed, *shadow, *correction;
  // With pairs [vertices]: the vector that a product is of, slanted, and the product.
  Quad<T>*slanted, *product;
  // Partial sums. products: d . H d, or two values with friction. squares: |r|^2 and r . r / D, or
  // two values with friction. weighted: r . M r; before that, whether any vertex slides, and the
  // largest component.
  double *products, *squares, *weighted;
  CycleMemory<T> cycle;  // with levels
};

template <class T>
struct ConjugateTeams {
  using real = T;
  static constexpr bool has_stencils = false, has_pairs = false;
  DeviceConjugate<T> call;
  FieldWork<T> product;  // for its weights
  ConjugateMemory<T> memory;
  unsigned* counter;  // [teams], zero at the launch
  int teams, blocks;  // blocks of a team

  int threads;  // of a block; also vertices of a partial sum

  PD_HD int parts_of(int vertices) const { return (vertices + threads - 1) / threads; }
  PD_HD int vertex_parts() const { return parts_of(call.plan.vertices); }
  PD_HD int product_parts() const { return call.plan.patches + parts_of(call.plan.shared); }
  PD_HD int most_parts() const {
    return vertex_parts() < product_parts() ? product_parts() : vertex_parts();
  }
};

// `Work`: ConjugateTeams, or one that adds to it. `WithLevels`: with the multilevel preconditioner. `Computed`: see
// rest_of.
template <class Work, bool WithLevels, bool Computed>
class ConjugateTeam {
 protected:
  using T = typename Work::real;

 private:
  static constexpr bool has_pairs = Work::has_pairs;
  static_assert(conjugate_threads<T> % (most_parts * warp_size) == 0);

 public:
  __device__ ConjugateTeam(const Work& work, const ConjugateMemory<T>& memory,
                           std::int64_t environment, BlockTeam& team, std::byte* shared,
                           WarpSums& warp_sums, Quad<T>* cycle_sums, const PairPlaces* places)
      : work_(work),
        call_(work.call),
        plan_(work.call.plan),
        m_(memory),
        environment_(environment),
        weights_(work.product.weights_of(environment)),
        team_(team),
        cycle_(plan_.levels, memory.cycle, team, cycle_sums),
        slots_(shared, plan_.most_slots),
        entries_(reinterpret_cast<Quad<T>*>(shared + slots_bytes(sizeof(T), plan_.most_slots, 2))),
        warp_sums_(warp_sums),
        pairs_(work, team, places, environment),
        curvature_{memory.products, has_pairs ? work.vertex_parts() : work.product_parts()},
        squares_{memory.squares, work.vertex_parts()},
        weighted_{memory.weighted, work.vertex_parts()},
        largest_{memory.weighted, work.vertex_parts()},
        last_(memory.direction),
        next_(memory.other) {}

  __device__ void run() {
    double* progress = call_.progress + environment_ * progress_count;
    Conjugate numbers(progress);
    // the same decision in all threads of the team
    if (!numbers.active) return;
    load(numbers.begins);
    numbers.scale_by(1 / double(unit_));
    iterate_all(numbers);
    store();
    numbers.scale_by(double(unit_));
    team_.barrier();  // the next environment overwrites the partial sums
    if (team_.thread() == 0) numbers.write(progress);
  }

 protected:
  // Runs at most call_.iterations iterations; returns their number.
  __device__ int iterate_all(Conjugate& numbers) {
    if (numbers.begins) begin(numbers);
    int k = 0;
    for (; k < call_.iterations && numbers.active; ++k) iterate(numbers);
    return k;
  }

  // Calls visit(vertex) for every part of this block, then store(part).
  template <class Visit, class Store>
  __device__ void each_part(int first, int count, const Visit& visit, const Store& store) {
#pragma unroll 1
    for (int part = team_.rank(); part * int(blockDim.x) < count; part += team_.blocks()) {
      const int i = part * int(blockDim.x) + int(threadIdx.x);
      if (i < count) visit(first + i);
      store(part);
    }
  }

  // index of a vertex in the user's arrays
  __device__ std::int64_t row(int i) const {
    return environment_ * plan_.vertices + plan_.vertex_order[i];
  }
  __device__ const T* projector(int i) const {
    return call_.projector ? call_.projector + 9 * row(i) : nullptr;
  }

  __device__ void load(bool begins) {
    double largest[1] = {0};
    each_part(
        0, plan_.vertices,
        [&](int i) {
          const Vec3<T> r = read3(call_.residual + 3 * row(i));
          m_.residual[i] = quad(r, call_.inverse.of(environment_)[plan_.vertex_order[i]]);
          largest[0] = Max()(largest[0], largest_of(r));
        },
        [&](int part) {
          largest_.store(part, largest, warp_sums_);
          largest[0] = 0;
        });
    team_.barrier();
    largest_.reduce(largest, warp_sums_);
    unit_ = unit_near(T(largest[0]));
    const T none(0), per_unit = T(1) / unit_;
    double sum[2] = {0, 0};
    each_part(
        0, plan_.vertices,
        [&](int i) {
          const std::int64_t at = 3 * row(i);
          const T inertia = call_.inertia.of(environment_)[plan_.vertex_order[i]];
          const T inverse = m_.residual[i].w;
          const Vec3<T> x = read3(call_.positions + at), r = per_unit * vec3(m_.residual[i]);
          m_.x[i] = quad(x);
          m_.residual[i] = quad(r, inverse);
          Vec3<T> solution = {none, none, none}, direction = solution;
          if (!begins) {
            solution = per_unit * read3(call_.solution + at);
            direction = per_unit * read3(call_.direction + at);
          }
          m_.solution[i] = quad(solution);
          last_[i] = quad(direction, inertia);
          if constexpr (WithLevels) cycle_.set(i, r);
          sum[0] += square_of_right(r, x);
          sum[1] += double(inverse) * wide_dot(r, r);
        },
        [&](int part) {
          squares_.store(part, sum, warp_sums_);
          sum[0] = sum[1] = 0;
        });
    team_.barrier();
    if constexpr (has_pairs) read_pairs();
  }

  __device__ void begin(Conjugate& numbers) {
    double sum[2];
    squares_.reduce(sum, warp_sums_);
    if constexpr (WithLevels) sum[1] = apply_levels();
    if constexpr (has_pairs) {
      begin_with_pairs(numbers, sum[0]);
    } else {
      numbers.begin(sum[0], sum[1]);
    }
    direction_pending_ = true;
  }

  // May change 1 / D.
  __device__ void read_pairs() {
    const auto sliding = [&](int i) -> const T* {
      return call_.sliding ? call_.sliding + 3 * slide_count * row(i) : nullptr;
    };
    pairs_.all.read([&](int i) -> T& { return m_.residual[i].w; },
                    [&](int i) { return projector(i); }, sliding,
                    [&](std::int64_t, std::int64_t) { return pairs_.places.factors; });
  }

  // `whole`: |b|^2. The pairs may take all of it but rounding: errors are relative to what was there before.
  __device__ void begin_with_pairs(Conjugate& numbers, double whole) {
    pairs_.leave(m_.residual);
    double sum[2] = {0, 0};
    each_part(
        0, plan_.vertices,
        [&](int i) {
          const Quad<T> residual = m_.residual[i];
          const double square = wide_dot(vec3(residual), vec3(residual));
          sum[0] += square;
          sum[1] += double(residual.w) * square;
        },
        [&](int part) {
          squares_.store(part, sum, warp_sums_);
          sum[0] = sum[1] = 0;
        });
    team_.barrier();
    squares_.reduce(sum, warp_sums_);
    numbers.begin(sum[0] + 0 * whole, sum[1]);
    if (!numbers.active) return;
    numbers.scale = sqrt(whole);
    numbers.check_residual(sum[0], call_.tolerance);
  }

  __device__ void iterate(Conjugate& numbers) {
    multiply();
    if constexpr (has_pairs) add_pairs();
    double curvature[1];
    curvature_.reduce(curvature, warp_sums_);
    const T step = T(numbers.step(curvature[0]));
    if (!numbers.active) return;
    double sum[2] = {0, 0};
    each_part(
        0, plan_.vertices,
        [&](int i) {
          const Quad<T> residual = m_.residual[i];
          m_.solution[i] = quad(multiply_add(step, vec3(last_[i]), vec3(m_.solution[i])));
          const Vec3<T> r = subtract_product(vec3(residual), step, vec3(m_.image[i]));
          m_.residual[i] = quad(r, residual.w);
          if constexpr (WithLevels) cycle_.set(i, r);
          const double square = wide_dot(r, r);
          sum[0] += square;
          sum[1] += double(residual.w) * square;
        },
        [&](int part) {
          squares_.store(part, sum, warp_sums_);
          sum[0] = sum[1] = 0;
        });
    team_.barrier();
    squares_.reduce(sum, warp_sums_);
    numbers.check_residual(sum[0], call_.tolerance);
    if (!numbers.active) return;
    if constexpr (WithLevels) sum[1] = apply_levels();
    keep_ = T(numbers.direction_ratio(sum[1]));
    direction_pending_ = true;
  }

  // The next search direction, computed on demand from the last one. Without `direction_pending_`,
  // the last one is still current.
  __device__ Vec3<T> direction(int i) const {
    const Vec3<T> last_one = vec3(last_[i]);
    if (!direction_pending_) return last_one;
    if constexpr (WithLevels) return multiply_add(keep_, last_one, cycle_.result(i));
    const Quad<T> residual = m_.residual[i];
    return multiply_add(keep_, last_one, residual.w * vec3(residual));
  }

  // Computes H times the next direction, which becomes the last one, and the curvature along it.
  __device__ void multiply() {
    double sum[1] = {0};
    const auto next = [&](int i) { return direction(i); };
    const auto visit = [&](int i, const Vec3<T>& elastic, const Vec3<T>& d) {
      const T inertia = last_[i].w;
      const Vec3<T> image = conjugate_image(elastic, d, inertia, m_.residual[i].w != T(0),
                                            projector(i), across_of(call_, 3 * row(i)));
      m_.image[i] = quad(image);
      next_[i] = quad(d, inertia);
      sum[0] += wide_dot(d, image);
    };
    multiply(next, visit, [&](int part) {
      if constexpr (!has_pairs) curvature_.store(part, sum, warp_sums_);
      sum[0] = 0;
    });
    Quad<T>* const last = last_;
    last_ = next_;
    next_ = last;
    direction_pending_ = false;
  }

  // Completes the product with the last direction, and the curvature along it.
  __device__ void add_pairs() {
    pairs_.multiply(
        true, [&](int i) { return vec3(last_[i]); }, [&](int i) { return projector(i); }, m_.image);
    pairs_.leave(m_.image);
    double sum[1] = {0};
    each_part(
        0, plan_.vertices, [&](int i) { sum[0] += wide_dot(vec3(last_[i]), vec3(m_.image[i])); },
        [&](int part) {
          curvature_.store(part, sum, warp_sums_);
          sum[0] = 0;
        });
    team_.barrier();
  }

  // Computes the elastic product with a field what(vertex). Calls visit(vertex, product, field) for
  // all vertices of this block, and store(part) after each part.
  template <class What, class Visit, class Store>
  __device__ void multiply(const What& what, const Visit& visit, const Store& store) {
#pragma unroll 1
    for (int number = team_.rank(); number < plan_.patches; number += team_.blocks()) {
      multiply_patch(Patch<T>(plan_, number), what, visit);
      store(number);
    }
    team_.barrier();
    if (plan_.shared > 0) {
      const int first = plan_.patch_vertex[plan_.patches];
      each_part(
          first, plan_.shared,
          [&](int i) {
            Vec3<T> force = {T(0), T(0), T(0)};
            const int end = plan_.shared_start[i - first + 1];
            for (int at = plan_.shared_start[i - first]; at < end; ++at)
              force = force + vec3(m_.shared_force[plan_.shared_slot[at]]);
            visit(i, force, what(i));
          },
          [&](int part) { store(plan_.patches + part); });
      team_.barrier();
    }
  }

  // of a patch: visits its interior vertices
  template <class What, class Visit>
  __device__ void multiply_patch(const Patch<T>& patch, const What& what, const Visit& visit) {
    const Vec3<T> anchor = vec3(m_.x[patch.vertex(0)]);
    for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
      const int i = patch.vertex(s);
      slots_.set(s, vec3(m_.x[i]) - anchor, what(i));
    }
    __syncthreads();
    if constexpr (Work::has_stencils) {
      each_pair_and_stencil<2>(patch, slots_, rest_of<Computed>(patch), weights_, work_.stencils,
                               environment_, false, entries_, SolidHessian{});
    } else {
      each_pair<2>(patch, slots_, rest_of<Computed>(patch), weights_, entries_, SolidHessian{});
    }
    __syncthreads();
    for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
      const int slot = patch.first_slot + s;
      if (s < patch.interior) {
        Vec3<T> vectors[2];
        slots_(unsigned(8 * s), vectors);
        visit(patch.first_vertex + s, sum_entries(entries_, plan_.slot_row[slot]), vectors[1]);
      } else if (plan_.shared > 0) {  // a cluster has none: owners hold the complete force
        m_.shared_force[slot] = quad(sum_entries(entries_, plan_.slot_row[slot]));
      }
    }
  }

  // Applies M to the residual that was set; `direction` uses the result. Returns r . M r.
  __device__ double apply_levels() {
    cycle_.run();
    double sum[1] = {0};
    each_part(
        0, plan_.vertices,
        [&](int i) {
          const Quad<T> residual = m_.residual[i];
          const Vec3<T> r = vec3(residual);
          const Vec3<T> z = preconditioned(cycle_.result(i), r, residual.w,
                                           plan_.levels.reference_inertia[i], projector(i));
          cycle_.set_result(i, z);
          sum[0] += wide_dot(r, z);
        },
        [&](int part) {
          weighted_.store(part, sum, warp_sums_);
          sum[0] = 0;
        });
    team_.barrier();
    weighted_.reduce(sum, warp_sums_);
    return sum[0];
  }

  __device__ void store() {
    const auto write = [&](int i) {
      const std::int64_t at = 3 * row(i);
      write3(call_.solution + at, unit_ * vec3(m_.solution[i]));
      write3(call_.residual + at, unit_ * vec3(m_.residual[i]));
      write3(call_.direction + at, unit_ * direction(i));
    };
    each_part(0, plan_.vertices, write, [](int) {});
  }

  const Work& work_;
  const DeviceConjugate<T>& call_;
  const DevicePlan<T>& plan_;
  const ConjugateMemory<T>& m_;
  std::int64_t environment_;
  const T* weights_;
  BlockTeam& team_;
  DeviceCycle<T> cycle_;
  Slots<T> slots_;
  Quad<T>* entries_;
  WarpSums& warp_sums_;
  BodyPairs<Work> pairs_;
  PartialSums<Add, 1> curvature_;
  PartialSums<Add, 2> squares_;
  PartialSums<Add, 1> weighted_;
  PartialSums<Max, 1> largest_;
  Quad<T>*last_, *next_;  // directions
  T unit_ = T(1), keep_ = T(0);
  bool direction_pending_ = false;
};

}  // namespace pd::inline PD_TARGET
