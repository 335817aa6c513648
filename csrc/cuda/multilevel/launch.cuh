// Kernels of the multilevel solver and their launches, in one precision.
#pragma once
#include "cuda/common/teams.cuh"
#include "cuda/multilevel/dense_solve.h"
#include "cuda/multilevel/direction.h"
#include "cuda/multilevel/material_mismatch.h"
#include "cuda/multilevel/trial.h"
#include "cuda/stream/multilevel_interface.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

static_assert(sizeof(MultilevelControl) + pass_static_bytes <= outer_static_bytes);
static_assert(sizeof(MultilevelControl::warp_dot) >= 4 * multilevel_warps * sizeof(Quad<double>));

template <class T, bool HasContacts, int Threads>
__global__ void __launch_bounds__(Threads,
                                  Threads == multilevel_threads ? 1 : small_multilevel_blocks)
    multilevel_kernel(const __grid_constant__ MultilevelCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  __shared__ __align__(16) std::byte control[sizeof(MultilevelControl)];
  const int number = int(blockIdx.x) / call.blocks;
  BlockTeam team(int(blockIdx.x) % call.blocks, call.blocks, call.memory.counter + number);
  MultilevelMemory<T> memory = of_team(call, number);
  if (call.shared_cycle) {
    Arena arena(shared + call.shared_cycle);
    arrange(arena, call.plan().levels, 1, memory.cycle);
  }
  for (std::int64_t e = number; e < call.stream.step.batch; e += call.teams) {
    MultilevelRunner<T, HasContacts, Threads> runner(
        call, memory, e, team, *reinterpret_cast<MultilevelControl*>(control), shared);
    multilevel_iterations(runner, call.stream.step.settings);
  }
}

template <class T>
__global__ void __launch_bounds__(multilevel_threads)
    compare_material(const __grid_constant__ MultilevelCall<T> call) {
  const int number = int(blockIdx.x) / call.blocks;
  BlockTeam team(int(blockIdx.x) % call.blocks, call.blocks, call.memory.counter + number);
  RatioRange* const ranges = of_team(call, number).ranges;
  for (std::int64_t e = number; e < call.stream.step.batch; e += call.teams) {
    const StreamWork<T, false> w(call.stream, e);
    const DeviceStep<T>& step = call.stream.step;
    MismatchRunner<T> run(w, {step.material.stiffness, step.poisson, e}, ranges, team);
    const MaterialMismatch mismatch = measure_mismatch(run, w.plan.levels);
    if (team.thread() == 0) call.memory.mismatch[e] = mismatch;
  }
}

template <class T>
struct CycleCall {
  PreconditionCall<T> op;
  CycleMemory<T> memory;
  unsigned* counter;
  int teams, blocks;
};

template <class T>
__global__ void __launch_bounds__(multilevel_threads)
    precondition_fields(const __grid_constant__ CycleCall<T> call) {
  const int number = int(blockIdx.x) / call.blocks;
  BlockTeam team(int(blockIdx.x) % call.blocks, call.blocks, call.counter + number);
  const Levels<T>& levels = call.op.levels;
  const CycleMemory<T> memory = cycle_of_team(levels, call.memory, number);
  __shared__ Quad<T> part[4 * multilevel_warps];
  DeviceCycle<T> cycle(levels, memory, team, part);
  for (std::int64_t e = number; e < call.op.batch; e += call.teams) {
    const auto row = [&](int i) { return (e * levels.vertices + call.op.vertex_order[i]) * 3; };
    for (int i = team.thread(); i < levels.vertices; i += team.threads())
      cycle.set(i, read3(call.op.field + row(i)));
    team.barrier();
    cycle.run();
    for (int i = team.thread(); i < levels.vertices; i += team.threads())
      write3(call.op.out + row(i), cycle.result(i));
    team.barrier();
  }
}

// Whether L-BFGS has a coarse space.
template <class T>
bool has_space(const DeviceStep<T>& step) {
  return step.settings.learns() && step.plan.levels.pieces > 0;
}

template <class T>
using MultilevelKernel = void (*)(MultilevelCall<T>);

template <class T>
struct MultilevelLaunch {
  MultilevelKernel<T> kernel;
  int threads;
  std::size_t shared, shared_cycle = 0, shared_pieces = 0;
  int resident;

  explicit MultilevelLaunch(const DeviceStep<T>& step)
      : kernel(kernel_of(step)),
        threads(is_small(step) ? small_multilevel_threads : multilevel_threads),
        shared(pass_shared_bytes(sizeof(T), step.plan.most_slots, step.plan.most_entries, 2)) {
    if (has_space(step)) {
      shared_pieces = pieces_offset(shared);
      shared = shared_pieces + pieces_bytes;
    }
    resident = blocks_with(shared);
    keep_cycle(step);
    if (resident == 0) refuse_shared_memory(shared);
  }

  int blocks_with(std::size_t bytes) const {
    const auto of = [&](const void* any, std::size_t shared_bytes) {
      return resident_blocks(any, threads, shared_bytes);
    };
    // the same teams compare the material
    return std::min(of(reinterpret_cast<const void*>(kernel), bytes),
                    of(reinterpret_cast<const void*>(compare_material<T>), 0));
  }

  // Puts the fields of the cycle in shared memory if one block works on an environment and they
  // fit.
  void keep_cycle(const DeviceStep<T>& step) {
    const bool one = step.plan.patches == 1;
    if (resident == 0 || (!one && step.batch < resident)) return;
    Arena arena(nullptr);
    CycleMemory<T> fields;
    arrange(arena, step.plan.levels, 1, fields);
    const std::size_t begin = (shared + 255) / 256 * 256, all = begin + std::size_t(arena.size());
    const int blocks = blocks_with(all);
    if (blocks < (one ? std::min<std::int64_t>(step.batch, resident) : resident)) return;
    shared_cycle = begin;
    shared = all;
    resident = blocks;
  }

  static bool is_small(const DeviceStep<T>& step) { return step.plan.patches == 1; }

  static MultilevelKernel<T> kernel_of(const DeviceStep<T>& step) {
    const auto of = [&]<int Threads>() {
      return has_contacts(step) ? multilevel_kernel<T, true, Threads>
                                : multilevel_kernel<T, false, Threads>;
    };
    return is_small(step) ? of.template operator()<small_multilevel_threads>()
                          : of.template operator()<multilevel_threads>();
  }

  MultilevelCall<T> call(const StreamCall<T>& stream) const {
    const DevicePlan<T>& plan = stream.step.plan;
    const bool spread = plan.levels.direct && !is_small(stream.step);
    const int useful =
        std::max(plan.patches, spread ? useful_blocks(plan.levels, multilevel_threads) : 1);
    const Teams teams(stream.step.batch, resident, useful);
    return {stream, {}, teams.count, teams.blocks, shared_cycle, shared_pieces};
  }
};

template <class T>
void arrange(Arena& arena, const Levels<T>& levels, std::int64_t teams, bool touching,
             PiecesMemory<T>& m) {
  const std::int64_t pieces = levels.pieces, unknowns = piece_modes * pieces;
  const std::int64_t blocks = piece_pair(levels.pieces, 0) * piece_block;
  for (Quad<T>** array : {&m.arm, &m.field}) arena.place(*array, teams * levels.vertices);
  arena.place(m.centre, teams * pieces);
  arena.place(m.row_sums, teams * levels.piece_row_tasks * piece_block);
  arena.place(m.strains, teams * levels.piece_tet_tasks * piece_block);
  for (double** array : {&m.mode, &m.scale}) arena.place(*array, teams * unknowns);
  for (double*& block : m.block) arena.place(block, teams * blocks);
  arena.place(m.unheld, touching ? teams * blocks : 0);
  arena.place(m.panel, teams * 4 * pieces * piece_block);
}

template <class T>
MultilevelMemory<T> arrange(Arena& arena, const MultilevelCall<T>& call) {
  const DeviceStep<T>& step = call.stream.step;
  const std::int64_t teams = call.teams, n = step.plan.vertices;
  const std::int64_t pairs = step.settings.learns() ? history * n : 0;
  const std::int64_t held = has_contacts(step) ? n : 0;
  MultilevelMemory<T> m;
  // zero-initialised arrays come first
  arena.place(m.counter, teams);
  for (Quad<T>** array : {&m.iterate, &m.residual, &m.trial_residual})
    arena.place(*array, teams * n);
  for (Quad<T>** array : {&m.s, &m.y}) arena.place(*array, teams * pairs);
  for (Mat3<T>** array : {&m.free, &m.trial_free}) arena.place(*array, teams * held);
  for (Quad<T>** array : {&m.gradient, &m.trial_gradient, &m.friction, &m.trial_friction})
    arena.place(*array, teams * held);
  arrange(arena, step.plan.levels, int(teams), m.cycle);
  if (has_space(step)) arrange(arena, step.plan.levels, teams, held > 0, m.pieces);
  arena.place(m.chunk_dots, teams * 2 * call.chunks() * most_sums);
  arena.place(m.patch_sums, teams * step.plan.patches * sums_count);
  arena.place(m.ranges, teams * 2 * call.blocks * ranges_count);
  arena.place(m.mismatch, step.batch);
  return m;
}

template <class T>
std::int64_t multilevel_bytes(const DeviceStep<T>& step) {
  Arena arena(nullptr);
  arrange(arena, MultilevelLaunch<T>(step).call({step, {}}));
  return arena.size();
}

template <class T>
MultilevelCall<T> multilevel_call(const StreamCall<T>& stream, const MultilevelLaunch<T>& launch,
                                  void* memory) {
  Arena arena(memory);
  MultilevelCall<T> call = launch.call(stream);
  call.memory = arrange(arena, call);
  return call;
}

template <class T>
void run_material_comparison(const StreamCall<T>& stream, void* memory, cudaStream_t to) {
  const MultilevelLaunch<T> launch(stream.step);
  MultilevelCall<T> call = multilevel_call(stream, launch, memory);
  launch_teams(reinterpret_cast<const void*>(compare_material<T>), call, call.memory.counter,
               launch.threads, 0, to);
}

template <class T>
void run_multilevel(const StreamCall<T>& stream, void* memory, cudaStream_t to) {
  const MultilevelLaunch<T> launch(stream.step);
  MultilevelCall<T> call = multilevel_call(stream, launch, memory);
  launch_teams(reinterpret_cast<const void*>(launch.kernel), call, call.memory.counter,
               launch.threads, launch.shared, to);
}

template <class T>
CycleCall<T> cycle_call(const PreconditionCall<T>& op, void* memory, std::int64_t* bytes) {
  const void* kernel = reinterpret_cast<const void*>(precondition_fields<T>);
  const Teams teams(op.batch, resident_blocks(kernel, multilevel_threads, 0),
                    useful_blocks(op.levels, multilevel_threads));
  CycleCall<T> call{op, {}, nullptr, teams.count, teams.blocks};
  Arena arena(memory);
  arena.place(call.counter, call.teams);
  arrange(arena, op.levels, call.teams, call.memory);
  *bytes = arena.size();
  return call;
}

template <class T>
std::int64_t precondition_bytes(const PreconditionCall<T>& op) {
  std::int64_t bytes = 0;
  cycle_call(op, nullptr, &bytes);
  return bytes;
}

template <class T>
void run_precondition(const PreconditionCall<T>& op, void* memory, Stream stream) {
  std::int64_t bytes = 0;
  CycleCall<T> call = cycle_call(op, memory, &bytes);
  launch_teams(reinterpret_cast<const void*>(precondition_fields<T>), call, call.counter,
               multilevel_threads, 0, static_cast<cudaStream_t>(stream));
}

}  // namespace pd::inline PD_TARGET
