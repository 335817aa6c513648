// Iterations of solver/conjugate.h on a plan of any size: a team of blocks has an environment, whose vectors are in device
// memory, in the order of the plan, and meets between the phases of an iteration. Nobody asks in between.
#pragma once
#include "cuda/conjugate_sums.cuh"
#include "cuda/cycle_triangle.h"
#include "cuda/teams.cuh"

namespace pd {

// What a team keeps.
template <class T>
struct ConjugateMemory {
  Quad<T>*x, *solution, *image;  // [vertices]; image: H times the direction
  Quad<T>* residual;             // [vertices], w: 1 / D
  Quad<T>*direction, *other;     // [vertices], w: inertia; iterations alternate
  Quad<T>* shared_force;         // [slots], as FieldWork has it
  // of parts: d . H d; |r|^2 and r . r / D; r . M r, and the largest number before
  double *curvature, *squares, *weighted;
  CycleMemory<T> cycle;  // with levels
};

template <class T>
struct ConjugateTeams {
  DeviceConjugate<T> call;
  FieldWork<T> product;  // its weights
  ConjugateMemory<T> memory;
  unsigned* counter;  // [teams], zero at the launch
  int teams, blocks;  // blocks of a team

  int threads;  // of a block, and vertices of a part

  PD_HD int parts_of(int vertices) const { return (vertices + threads - 1) / threads; }
  PD_HD int vertex_parts() const { return parts_of(call.plan.vertices); }
  PD_HD int product_parts() const { return call.plan.patches + parts_of(call.plan.shared); }
};

// `Leveled`: with a preconditioner; `Computed`: see rest_of.
template <class T, bool Leveled, bool Computed>
class ConjugateTeam {
  static_assert(conjugate_threads<T> % (most_parts * warp_size) == 0);

 public:
  __device__ ConjugateTeam(const ConjugateTeams<T>& work, const ConjugateMemory<T>& memory,
                           std::int64_t environment, BlockTeam& team, std::byte* shared,
                           WarpSums& warp_sums, Quad<T>* cycle_sums)
      : call_(work.call),
        plan_(work.call.plan),
        m_(memory),
        environment_(environment),
        weights_(work.product.weights_of(environment)),
        team_(team),
        cycle_(plan_.levels, memory.cycle, team, cycle_sums),
        slots_(shared, plan_.most_slots),
        entries_(reinterpret_cast<Quad<T>*>(shared + slots_bytes(sizeof(T), plan_.most_slots, 2))),
        warp_sums_(warp_sums),
        curvature_{memory.curvature, work.product_parts()},
        squares_{memory.squares, work.vertex_parts()},
        weighted_{memory.weighted, work.vertex_parts()},
        largest_{memory.weighted, work.vertex_parts()},
        last_(memory.direction),
        next_(memory.other) {}

  __device__ void run() {
    double* progress = call_.progress + environment_ * progress_count;
    Conjugate numbers(progress);
    // all of the team alike
    if (!numbers.active) return;
    load(numbers.begins);
    numbers.scale_by(1 / double(unit_));
    if (numbers.begins) begin(numbers);
    for (int k = 0; k < call_.iterations && numbers.active; ++k) iterate(numbers);
    store();
    numbers.scale_by(double(unit_));
    team_.barrier();  // before sums of the next environment stand where this one's were
    if (team_.thread() == 0) numbers.write(progress);
  }

 private:
  // visit(vertex) of every part of this block, after which leave(part)
  template <class Visit, class Leave>
  __device__ void each_part(int first, int count, const Visit& visit, const Leave& leave) {
#pragma unroll 1
    for (int part = team_.rank(); part * int(blockDim.x) < count; part += team_.blocks()) {
      const int i = part * int(blockDim.x) + int(threadIdx.x);
      if (i < count) visit(first + i);
      leave(part);
    }
  }

  // a vertex in the arrays of the user
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
          largest[0] = Largest()(largest[0], largest_of(r));
        },
        [&](int part) {
          largest_.leave(part, largest, warp_sums_);
          largest[0] = 0;
        });
    team_.barrier();
    largest_.join(largest, warp_sums_);
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
          if constexpr (Leveled) cycle_.set(i, r);
          sum[0] += square_of_right(r, x);
          sum[1] += double(inverse) * wide_dot(r, r);
        },
        [&](int part) {
          squares_.leave(part, sum, warp_sums_);
          sum[0] = sum[1] = 0;
        });
    team_.barrier();
  }

  __device__ void begin(Conjugate& numbers) {
    double sum[2];
    squares_.join(sum, warp_sums_);
    if constexpr (Leveled) sum[1] = apply_levels();
    numbers.begin(sum[0], sum[1]);
    turns_ = true;
  }

  __device__ void iterate(Conjugate& numbers) {
    multiply();
    double curvature[1];
    curvature_.join(curvature, warp_sums_);
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
          if constexpr (Leveled) cycle_.set(i, r);
          const double square = wide_dot(r, r);
          sum[0] += square;
          sum[1] += double(residual.w) * square;
        },
        [&](int part) {
          squares_.leave(part, sum, warp_sums_);
          sum[0] = sum[1] = 0;
        });
    team_.barrier();
    squares_.join(sum, warp_sums_);
    numbers.judge(sum[0], call_.tolerance);
    if (!numbers.active) return;
    if constexpr (Leveled) sum[1] = apply_levels();
    keep_ = T(numbers.keep(sum[1]));
    turns_ = true;
  }

  // The next direction, by the last one: nobody has it before it is used. Without `turns_` the last one is in use still.
  __device__ Vec3<T> direction(int i) const {
    const Vec3<T> last_one = vec3(last_[i]);
    if (!turns_) return last_one;
    if constexpr (Leveled) return multiply_add(keep_, last_one, cycle_.result(i));
    const Quad<T> residual = m_.residual[i];
    return multiply_add(keep_, last_one, residual.w * vec3(residual));
  }

  // H times the next direction, which then is the last one, and the curvature along it
  __device__ void multiply() {
    double sum[1] = {0};
    const auto look = [&](int i, const Vec3<T>& elastic, const Vec3<T>& d) {
      const T inertia = last_[i].w;
      const Vec3<T> image = conjugate_image(elastic, d, inertia, m_.residual[i].w != T(0),
                                            projector(i), across_of(call_, 3 * row(i)));
      m_.image[i] = quad(image);
      next_[i] = quad(d, inertia);
      sum[0] += wide_dot(d, image);
    };
    const auto leave = [&](int part) {
      curvature_.leave(part, sum, warp_sums_);
      sum[0] = 0;
    };
#pragma unroll 1
    for (int number = team_.rank(); number < plan_.patches; number += team_.blocks()) {
      multiply(Patch<T>(plan_, number), look);
      leave(number);
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
            look(i, force, direction(i));
          },
          [&](int part) { leave(plan_.patches + part); });
      team_.barrier();
    }
    Quad<T>* const last = last_;
    last_ = next_;
    next_ = last;
    turns_ = false;
  }

  // of a patch: look(vertex, elastic product, direction) at those that it has alone
  template <class Look>
  __device__ void multiply(const Patch<T>& patch, const Look& look) {
    const Vec3<T> anchor = vec3(m_.x[patch.vertex(0)]);
    for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
      const int i = patch.vertex(s);
      slots_.set(s, vec3(m_.x[i]) - anchor, direction(i));
    }
    __syncthreads();
    each_pair<2>(patch, slots_, rest_of<Computed>(patch), weights_, entries_, SolidHessian{});
    __syncthreads();
    for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
      const int slot = patch.first_slot + s;
      if (s < patch.interior) {
        Vec3<T> vectors[2];
        slots_(unsigned(8 * s), vectors);
        look(patch.first_vertex + s, sum_entries(entries_, plan_.slot_row[slot]), vectors[1]);
      } else if (plan_.shared >
                 0) {  // of a cluster none are, and their owners have all of the force
        m_.shared_force[slot] = quad(sum_entries(entries_, plan_.slot_row[slot]));
      }
    }
  }

  // M of the residual that was set, for `direction`; returns r . M r
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
          weighted_.leave(part, sum, warp_sums_);
          sum[0] = 0;
        });
    team_.barrier();
    weighted_.join(sum, warp_sums_);
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
  Parts<Add, 1> curvature_;
  Parts<Add, 2> squares_;
  Parts<Add, 1> weighted_;
  Parts<Largest, 1> largest_;
  Quad<T>*last_, *next_;  // directions
  T unit_ = T(1), keep_ = T(0);
  bool turns_ = false;
};

// The arrays of one of several teams.
template <class T>
__device__ ConjugateMemory<T> memory_of_team(const ConjugateTeams<T>& work, int team) {
  ConjugateMemory<T> m = work.memory;
  const std::int64_t vertices = std::int64_t(work.call.plan.vertices) * team;
  for (Quad<T>** array : {&m.x, &m.solution, &m.image, &m.residual, &m.direction, &m.other})
    *array += vertices;
  m.shared_force += std::int64_t(work.call.plan.slots) * team;
  m.curvature += std::int64_t(work.product_parts()) * team;
  m.squares += 2 * std::int64_t(work.vertex_parts()) * team;
  m.weighted += std::int64_t(work.vertex_parts()) * team;
  if (work.call.plan.levels.there()) m.cycle = cycle_of_team(work.call.plan.levels, m.cycle, team);
  return m;
}

template <class T, bool Leveled, bool Computed>
__global__ void __launch_bounds__(conjugate_threads<T>)
    conjugate_teams(const __grid_constant__ ConjugateTeams<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  __shared__ WarpSums warp_sums;
  __shared__ Quad<T> cycle_sums[Leveled ? 4 * conjugate_threads<T> / warp_size : 1];
  const int number = int(blockIdx.x) / work.blocks;
  BlockTeam team(int(blockIdx.x) % work.blocks, work.blocks, work.counter + number);
  const ConjugateMemory<T> memory = memory_of_team(work, number);
  for (std::int64_t e = number; e < work.call.batch; e += work.teams)
    ConjugateTeam<T, Leveled, Computed>(work, memory, e, team, shared, warp_sums, cycle_sums).run();
}

template <class T>
struct ConjugateLaunch {
  // Vertices of all teams: with more of them fewer teams of more blocks do as well, in less memory.
  static constexpr std::int64_t most_vertices = std::int64_t(1) << 21;
  // Vertices times iterations of a launch, some tenths of a second on an H100: a device that draws as well must not be kept
  // longer. Those that follow go on where it has ended.
  static constexpr std::int64_t most_work = std::int64_t(1) << 30;

  const void* kernel;
  int threads;
  std::size_t shared;
  Teams teams;

  explicit ConjugateLaunch(const DeviceConjugate<T>& call)
      : kernel(kernel_for(call.plan)),
        threads(threads_of(call.plan)),
        shared(pass_shared_bytes(sizeof(T), call.plan.most_slots, call.plan.most_entries, 2)),
        teams(std::min(call.batch, std::max<std::int64_t>(1, most_vertices / call.plan.vertices)),
              resident(), useful(call.plan)) {}

  static int most_iterations(const DeviceConjugate<T>& call) {
    const std::int64_t most = most_work / (call.batch * call.plan.vertices);
    return int(std::clamp<std::int64_t>(most, 1, call.iterations));
  }

 private:
  static const void* kernel_for(const DevicePlan<T>& plan) {
    if (!computes_rests(plan)) return function<false, false>();
    return plan.levels.there() ? function<true, true>() : function<false, true>();
  }
  template <bool Leveled, bool Computed>
  static const void* function() {
    return reinterpret_cast<const void*>(conjugate_teams<T, Leveled, Computed>);
  }
  int resident() const {
    const int blocks = resident_blocks(kernel, threads, shared);
    if (blocks == 0) refuse_shared_memory(shared);
    return blocks;
  }
  // The plan alone decides, since they set the order of sums: no more than there are pairs for, so that patches of a small
  // mesh are worked on side by side; but the preconditioner wants few blocks that meet, of many threads.
  static int threads_of(const DevicePlan<T>& plan) {
    constexpr int most = conjugate_threads<T>, least = 64;
    return plan.levels.there() ? most : std::clamp(int(whole_warps(plan.most_pairs)), least, most);
  }
  int useful(const DevicePlan<T>& plan) const {
    const int levels = plan.levels.there() ? useful_blocks(plan.levels, threads) : 1;
    return std::max({plan.patches, (plan.vertices + threads - 1) / threads, levels});
  }
};

template <class T>
ConjugateTeams<T> arrange_teams(Arena& arena, const DeviceConjugate<T>& call,
                                const ConjugateLaunch<T>& launch) {
  const Teams& teams = launch.teams;
  ConjugateTeams<T> work{call, {}, {}, nullptr, teams.count, teams.blocks, launch.threads};
  ConjugateMemory<T>& m = work.memory;
  const std::int64_t count = teams.count, vertices = count * call.plan.vertices;
  arena.place(work.counter, count);
  work.product = arrange(arena, conjugate_field(call), count);
  m.shared_force = work.product.shared_force;
  for (Quad<T>** array : {&m.x, &m.solution, &m.image, &m.residual, &m.direction, &m.other})
    arena.place(*array, vertices);
  arena.place(m.curvature, count * work.product_parts());
  arena.place(m.squares, 2 * count * work.vertex_parts());
  arena.place(m.weighted, count * work.vertex_parts());
  if (call.plan.levels.there()) arrange(arena, call.plan.levels, teams.count, m.cycle);
  return work;
}

template <class T>
void run_conjugate_teams(const DeviceConjugate<T>& call, void* memory, cudaStream_t stream) {
  const ConjugateLaunch<T> launch(call);
  Arena arena(memory);
  ConjugateTeams<T> work = arrange_teams(arena, call, launch);
  if (computes_rests(call.plan)) {
    weigh_field<true>(work.product, stream);
  } else {
    weigh_field<false>(work.product, stream);
  }
  const int most = launch.most_iterations(call);
  for (std::int64_t done = 0; done < call.iterations; done += most) {
    work.call.iterations = int(std::min<std::int64_t>(most, call.iterations - done));
    launch_teams(launch.kernel, work, work.counter, launch.threads, launch.shared, stream);
  }
}

}  // namespace pd
