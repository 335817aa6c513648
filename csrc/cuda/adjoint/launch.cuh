// Launches of block_team.cuh and friction_block_team.cuh, with as many blocks per team as are useful.
#pragma once
#include "cuda/adjoint/friction_block_team.cuh"

#include <type_traits>

namespace pd::inline PD_TARGET {

// Arrays of one team; arrays per environment are not offset.
template <class T>
__device__ ConjugateMemory<T> memory_of_team(const ConjugateTeams<T>& work, int team) {
  ConjugateMemory<T> m = work.memory;
  const std::int64_t vertices = std::int64_t(work.call.plan.vertices) * team;
  for (Quad<T>** array : {&m.x, &m.solution, &m.image, &m.residual, &m.direction, &m.other})
    *array += vertices;
  if (work.call.friction) m.smoothed += vertices;
  if (work.call.pairs) {
    m.slanted += vertices;
    m.product += vertices;
  }
  m.shared_force += std::int64_t(work.call.plan.slots) * team;
  m.products += 2 * std::int64_t(work.most_parts()) * team;
  m.squares += 2 * std::int64_t(work.vertex_parts()) * team;
  m.weighted += std::int64_t(work.vertex_parts()) * team;
  if (work.call.plan.levels.there()) m.cycle = cycle_of_team(work.call.plan.levels, m.cycle, team);
  return m;
}

// `WithFriction`: adds the solve with friction. `Work`: ConjugateTeams, or one that adds to it.
template <class Work, bool WithLevels, bool Computed, bool WithFriction>
__global__ void __launch_bounds__(conjugate_threads<typename Work::real>)
    conjugate_teams(const __grid_constant__ Work work) {
  using T = typename Work::real;
  extern __shared__ __align__(16) std::byte shared[];
  __shared__ WarpSums warp_sums;
  __shared__ Quad<T> cycle_sums[WithLevels ? 4 * conjugate_threads<T> / warp_size : 1];
  const int number = int(blockIdx.x) / work.blocks;
  BlockTeam team(int(blockIdx.x) % work.blocks, work.blocks, work.counter + number);
  using Team = std::conditional_t<WithFriction, FrictionTeam<Work, WithLevels, Computed>,
                                  ConjugateTeam<Work, WithLevels, Computed>>;
  const ConjugateMemory<T> of_team = memory_of_team(work, number);
  const PairPlaces* places = nullptr;
  if constexpr (Work::has_pairs) {
    __shared__ PairPlaces of_pairs;
    if (threadIdx.x == 0) {
      Arena arena(work.arena.memory + work.arena.stride * number);
      PairArena::arrange(arena, work.pairs, of_pairs.memory, of_pairs.factors);
    }
    __syncthreads();
    places = &of_pairs;
  }
  for (std::int64_t e = number; e < work.call.batch; e += work.teams) {
    ConjugateMemory<T> memory = of_team;
    if constexpr (WithFriction) {
      memory.shadow += work.call.plan.vertices * e;
      memory.correction += work.call.plan.vertices * e;
    }
    Team(work, memory, e, team, shared, warp_sums, cycle_sums, places).run();
  }
}

template <class T>
struct ConjugateLaunch {
  // Vertices of all teams together. Beyond it, fewer teams of more blocks are as fast and take less
  // memory.
  static constexpr std::int64_t most_vertices = std::int64_t(1) << 21;
  // Vertices times iterations of a launch, some tenths of a second on an H100. The bound keeps a
  // GPU responsive that also drives a display. The next launch continues the solve.
  static constexpr std::int64_t most_work = std::int64_t(1) << 30;

  const void* kernel;
  int threads;
  std::size_t shared;
  Teams teams;

  explicit ConjugateLaunch(const DeviceConjugate<T>& call)
      : ConjugateLaunch(call,
                        call.friction ? kernel_for<true>(call.plan) : kernel_for<false>(call.plan),
                        call.plan.most_pairs) {}

  // `pairs`: of tetrahedra, or items that threads take like them; `most`: teams
  ConjugateLaunch(const DeviceConjugate<T>& call, const void* function, int pairs,
                  std::int64_t most = most_vertices)
      : kernel(function),
        threads(threads_of(call.plan, pairs)),
        shared(pass_shared_bytes(sizeof(T), call.plan.most_slots, call.plan.most_entries, 2)),
        teams(std::min({call.batch, most,
                        std::max<std::int64_t>(1, most_vertices / call.plan.vertices)}),
              resident(), useful(call.plan)) {}

  static int most_iterations(const DeviceConjugate<T>& call) {
    const std::int64_t most = most_work / (call.batch * call.plan.vertices);
    return int(std::clamp<std::int64_t>(most, 1, call.iterations));
  }

 private:
  template <bool WithFriction>
  static const void* kernel_for(const DevicePlan<T>& plan) {
    if (!computes_rests(plan)) return function<false, false, WithFriction>();
    return plan.levels.there() ? function<true, true, WithFriction>()
                               : function<false, true, WithFriction>();
  }
  template <bool WithLevels, bool Computed, bool WithFriction>
  static const void* function() {
    return reinterpret_cast<const void*>(
        conjugate_teams<ConjugateTeams<T>, WithLevels, Computed, WithFriction>);
  }
  int resident() const {
    const int blocks = resident_blocks(kernel, threads, shared);
    if (blocks == 0) refuse_shared_memory(shared);
    return blocks;
  }
  // Only the plan decides, since the number of threads sets the order of sums. More threads than
  // pairs would keep the patches of a small mesh from running in parallel. The preconditioner is
  // faster with few blocks of many threads.
  static int threads_of(const DevicePlan<T>& plan, int pairs) {
    constexpr int most = conjugate_threads<T>, least = 64;
    return plan.levels.there() ? most : std::clamp(int(whole_warps(pairs)), least, most);
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
  if (call.friction) {
    arena.place(m.smoothed, vertices);
    for (Quad<T>** array : {&m.shadow, &m.correction})
      arena.place(*array, call.batch * call.plan.vertices);
  }
  if (call.pairs) {
    for (Quad<T>** array : {&m.slanted, &m.product}) arena.place(*array, vertices);
  }
  arena.place(m.products, 2 * count * work.most_parts());
  arena.place(m.squares, 2 * count * work.vertex_parts());
  arena.place(m.weighted, count * work.vertex_parts());
  if (call.plan.levels.there()) arrange(arena, call.plan.levels, teams.count, m.cycle);
  return work;
}

// `Work`: ConjugateTeams, or one that adds to it
template <class T, class Work>
void launch_solve(const ConjugateLaunch<T>& launch, Work& work, cudaStream_t stream) {
  const DeviceConjugate<T> call = work.call;
  const int most = launch.most_iterations(call);
  for (std::int64_t done = 0; done < call.iterations; done += most) {
    work.call.iterations = int(std::min<std::int64_t>(most, call.iterations - done));
    launch_teams(launch.kernel, work, work.counter, launch.threads, launch.shared, stream);
  }
}

template <class T>
void run_conjugate_teams(const DeviceConjugate<T>& call, void* memory, cudaStream_t stream) {
  const ConjugateLaunch<T> launch(call);
  Arena arena(memory);
  ConjugateTeams<T> work = arrange_teams(arena, call, launch);
  if (computes_rests(call.plan)) {
    compute_field_weights<true>(work.product, stream);
  } else {
    compute_field_weights<false>(work.product, stream);
  }
  launch_solve(launch, work, stream);
}

}  // namespace pd::inline PD_TARGET
