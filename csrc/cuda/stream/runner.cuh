// Runs solver/step.h on the host: every part of a step is a launch. It supports every mesh, effect
// and batch.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/runtime.h"
#include "cuda/common/teams.cuh"
#include "cuda/stream/mixed_interface.h"
#include "cuda/stream/multilevel_interface.h"
#include "cuda/stream/pipeline.h"
#include "cuda/stream/pipeline_elements.h"
#include "cuda/stream/pipeline_load.h"
#include "cuda/stream/pipeline_schedule.h"
#include "cuda/stream/pipeline_update.h"
#include "cuda/stream/rigid.h"
#include "cuda/stream/shared_vertices.h"
#include "solver/multilevel/lbfgs.h"
#include "solver/step.h"
#include "views/arena.h"
#include "views/shared_memory.h"

#include <algorithm>
#include <cstdint>
#include <limits>
#include <utility>

namespace pd::inline PD_TARGET {

template <class T>
StreamMemory<T> arrange(Arena& arena, const StreamCall<T>& call) {
  const DeviceStep<T>& step = call.step;
  const DevicePlan<T>& plan = step.plan;
  const Material<T>& material = step.material;
  StreamMemory<T> m;
  for (Quad<T>** array : {&m.x, &m.velocity, &m.target, &m.u, &m.before})
    arena.place(*array, step.batch * plan.vertices);
  arena.place(m.origin, step.batch * plan.slots);
  arena.place(m.shared_force, step.batch * call.places());
  arena.place(m.weights,
              (own_weights(step) ? step.batch : 1) * plan.blocks * pair_weights * pair_lanes);
  arena.place(m.patch_weight, (own_weights(step) ? step.batch : 1) * plan.patches);
  arena.place(m.sums, step.batch * call.sum_rows() * sums_count);
  arena.place(m.progress, step.batch);
  arena.place(m.omega, step.batch * guard_period);
  arena.place(m.pieces, step.batch * plan.pieces);
  arena.place(m.part_sum, step.batch * count_rows(plan) * PartSums::count);
  arena.place(m.counter, plan.pieces > 0 ? step.batch : 0);
  m.forces = arrange_contact_forces(arena, step, step.batch);
  arena.place(m.planes, step.batch * material.planes_count);
  arena.place(m.spheres, step.batch * material.spheres_count);
  return m;
}

// Launches on one stream, in order.
class Launcher {
 public:
  explicit Launcher(cudaStream_t stream) : stream_(stream) {}

  // one block of `threads` threads per task, `count` tasks
  template <class Call, class... Arguments>
  void run(void (*kernel)(Call, Arguments...), std::int64_t count, int threads, std::size_t shared,
           const Call& call, Arguments... arguments) const {
    if (count == 0) return;
    kernel<<<blocks_of(count), threads, shared, stream_>>>(call, arguments...);
    check(cudaGetLastError());
  }

  // The same for a kernel that waits itself (cuda/stream/kernel_overlap.h), so that it may start before the
  // previous kernel has ended.
  template <class Call, class... Arguments>
  void run_overlapped(void (*kernel)(Call, Arguments...), std::int64_t count, int threads,
                      std::size_t shared, const Call& call, Arguments... arguments) const {
    if (count == 0) return;
    cudaLaunchAttribute attribute = {};
    attribute.id = cudaLaunchAttributeProgrammaticStreamSerialization;
    attribute.val.programmaticStreamSerializationAllowed = 1;
    cudaLaunchConfig_t config = {};
    config.gridDim = dim3(blocks_of(count));
    config.blockDim = dim3(unsigned(threads));
    config.dynamicSmemBytes = shared;
    config.stream = stream_;
    config.attrs = &attribute;
    config.numAttrs = runs_code_for_90(reinterpret_cast<const void*>(kernel)) ? 1 : 0;
    check(cudaLaunchKernelEx(&config, kernel, call, arguments...));
  }

 private:
  cudaStream_t stream_;
};

template <class T, bool HasContacts>
class StreamRunner {
 public:
  // `multilevel_memory`: of multilevel_bytes, for the multilevel solver only. `stencils`: null without any
  StreamRunner(const StreamCall<T>& call, void* multilevel_memory, const StencilWork<T>* stencils,
               cudaStream_t stream)
      : call_(call),
        set_(call_.step.settings),
        plan_(call_.step.plan),
        multilevel_(multilevel_memory),
        stencils_(stencils),
        stream_(stream),
        launcher_(stream),
        teams_(call.step.batch, resident_blocks(rounds_kernel(), rounds_threads, 0),
               std::max(1, (plan_.parts * warp_size + rounds_threads - 1) / rounds_threads)) {
    patches_ = call.step.batch * plan_.patches;
    pass_shared_ = pass_shared_bytes(sizeof(T), plan_.most_slots, plan_.most_entries, 2);
  }

  StreamRunner(const StreamRunner&) = delete;

  void rollout() {
    vertices<VertexTask::load>(0);
    assemble_diagonal();
    if (set_.multilevel()) run_material_comparison(call_, multilevel_, stream_);
    for (int t = 0; t < set_.steps; ++t) {
      if (set_.multilevel()) {
        multilevel_step(*this);
      } else {
        step(*this, set_);
      }
      if ((t + 1) % set_.every == 0) store((t + 1) / set_.every - 1);
      if (HasContacts && t + 1 < set_.steps) environments<EnvironmentTask::move_spheres>(0);
    }
  }

  void predict() {
    vertices<VertexTask::predict>(0);
    launcher_.run(stream_origins<T>, patches_, vertex_threads, 0, call_);
    if (stencils_) run_mixed_begin(MixedStreamCall<T>{call_, *stencils_}, patches_, stream_);
  }

  void start() {
    vertices<VertexTask::start>(0);
    decide<Decision::start>(0);
    started_ = false;
  }

  void align() {
    const bool first = !started_;
    started_ = true;
    if (plan_.pieces == 0 || (first && set_.start() == StartKind::given)) return;
    if (!first) return correct(Iterate::last);
    if (plan_.solid_pieces == 0) return correct(Iterate::guess);
    constexpr int per_block = rounds_threads / warp_size;
    const std::int64_t parts = call_.step.batch * plan_.parts;
    launcher_.run(stream_present<T, HasContacts>, (parts + per_block - 1) / per_block,
                  rounds_threads, 0, call_);
    correct(Iterate::present);
    correct(Iterate::guess);
  }

  void iterate(int k) {
    const bool checks = k % guard_period == 0;
    if (checks && set_.schedule == ScheduleKind::guarded) {
      pass<Visit::update_guarded>(k);
    } else {
      pass<Visit::update>(k);
    }
    if (alternates(set_)) std::swap(call_.memory.u, call_.memory.before);
    if (checks || set_.tolerance > 0) decide<Decision::iterate>(k);
  }

  void minimise() { run_multilevel(call_, multilevel_, stream_); }

  // always false, since a query would synchronise; converged environments skip the kernels instead
  bool finished() const { return false; }

  void finish() { vertices<VertexTask::finish>(0); }

 protected:
  void assemble_diagonal() {
    const bool own = own_weights(call_.step);
    const std::int64_t sets = own ? patches_ : plan_.patches;
    weights(sets, set_.weighted ? WeightKind::majoriser : WeightKind::matrix);
    // the pass starts from u = 0 at the current positions
    launcher_.run(stream_origins<T>, patches_, vertex_threads, 0, call_);
    pass<Visit::diagonal>(0);
    decide<Decision::diagonal>(0);
    if (set_.weighted || has_poisson_ratio) weights(sets, WeightKind::force);
  }

  void weights(std::int64_t sets, WeightKind kind) {
    if (stencils_) return run_mixed_weights(call_, sets, kind, stream_);
    launcher_.run(stream_weights<T>, sets, vertex_threads, 0, call_, kind);
  }

  void store(int record) {
    vertices<VertexTask::store>(record);
    if (call_.step.info) environments<EnvironmentTask::store>(record);
  }

  // `Projects`: whether vertices are projected out of the planes and spheres of the scene
  template <Visit What, bool Projects = HasContacts>
  void pass(int k) {
    // Messages of each pipeline pass carry a new number. The first pass of a call writes 0 to every
    // place, so no old message matches. Where environments stop the number is 0 too, and stream_shared
    // waits for the whole pass, since those that are done send nothing.
    const unsigned round = call_.stops ? 0 : ++round_;
    const bool piped = !stencils_ && pipe<What, Projects>(k, round);
    if (!piped && !run_mixed<What, Projects>(k))
      launcher_.run(stream_patches<What, T, Projects>, patches_, pass_threads, pass_shared_, call_,
                    k);
    launcher_.run_overlapped(stream_shared<What, T, Projects>,
                             call_.step.batch * call_.shared_blocks(), shared_threads, 0, call_, k,
                             piped ? round : 0u);
  }

  // Runs a pass of a scene with stencils.
  template <Visit What, bool Projects>
  bool run_mixed(int k) {
    if (stencils_)
      run_mixed_pass<T, Projects>(What, MixedStreamCall<T>{call_, *stencils_}, patches_,
                                  pass_shared_, k, stream_);
    return stencils_ != nullptr;
  }

  // Runs an iteration's patches as a pipeline if shared memory holds two of them. The number of
  // patches has no influence: the pipeline sums in another order, and an environment must have the
  // same bits in any batch.
  template <Visit What, bool Projects>
  bool pipe(int k, unsigned round) {
    constexpr bool updates = What == Visit::update || What == Visit::update_guarded;
    if constexpr (updates && !Projects && sizeof(T) == 4 && !has_poisson_ratio) {
      const auto kernel = stream_pipeline<What, T>;
      // the pipeline uses 32-bit indices; slots are the largest array of an environment
      constexpr std::int64_t most = std::numeric_limits<std::uint32_t>::max();
      if (plan_.most_slots > pipeline_slots || call_.step.batch * plan_.slots > most) return false;
      const std::size_t shared =
          2 * pipeline_half_bytes(sizeof(T), plan_.most_slots, plan_.most_entries);
      const std::int64_t blocks =
          resident_blocks(reinterpret_cast<const void*>(kernel), pipeline_threads, shared);
      launcher_.run_overlapped(kernel, std::min(blocks, patches_), pipeline_threads, shared, call_,
                               k, round);
      return blocks > 0;
    }
    return false;
  }

  void correct(Iterate from) {
    if (HasContacts || from != Iterate::last) pass<Visit::keep_forces>(int(from));
    RoundsCall<T> call = {call_, from, teams_.count, teams_.blocks, call_.memory.counter};
    launch_teams(rounds_kernel(), call, call.counter, rounds_threads, 0, stream_);
  }

  template <Decision What>
  void decide(int k) {
    // one thread per row of sums
    const int rows = What == Decision::start ? 1 : std::min(call_.sum_rows(), decide_threads);
    const int threads = (rows + warp_size - 1) / warp_size * warp_size;
    launcher_.run_overlapped(stream_decide<What, T>, call_.step.batch, threads, 0, call_, k);
  }

  template <VertexTask What>
  void vertices(int record) {
    const std::int64_t blocks = (plan_.vertices + vertex_threads - 1) / vertex_threads;
    launcher_.run(stream_vertices<What, T, HasContacts>, call_.step.batch * blocks, vertex_threads,
                  0, call_, record);
  }

  template <EnvironmentTask What>
  void environments(int record) {
    launcher_.run(stream_environments<What, T>, blocks_for(call_.step.batch), vertex_threads, 0,
                  call_, record);
  }

  static const void* rounds_kernel() {
    return reinterpret_cast<const void*>(stream_rounds<T, HasContacts>);
  }

  static std::int64_t blocks_for(std::int64_t threads) {
    return (threads + vertex_threads - 1) / vertex_threads;
  }

  StreamCall<T> call_;
  const Settings& set_;
  const DevicePlan<T>& plan_;
  void* multilevel_;
  const StencilWork<T>* stencils_;
  cudaStream_t stream_;
  Launcher launcher_;
  Teams teams_;           // for the coarse correction
  std::int64_t patches_;  // of all environments
  std::size_t pass_shared_;
  bool started_ = false;
  unsigned round_ = 0;
};

template <class T>
std::int64_t stream_bytes(const DeviceStep<T>& step) {
  Arena arena(nullptr);
  arrange(arena, StreamCall<T>{step, {}});
  return arena.size() + (step.settings.multilevel() ? multilevel_bytes(step) : 0);
}

// Raises the shared memory limit of the pass kernels above the default of 48 KB.
template <class T, bool HasContacts>
void allow_shared_memory(std::size_t bytes) {
  const auto allow = [&](void (*kernel)(StreamCall<T>, int)) {
    if (resident_blocks(reinterpret_cast<const void*>(kernel), pass_threads, bytes) == 0)
      refuse_shared_memory(bytes);
  };
  allow(stream_patches<Visit::diagonal, T, HasContacts>);
  allow(stream_patches<Visit::update, T, HasContacts>);
  allow(stream_patches<Visit::update_guarded, T, HasContacts>);
  allow(stream_patches<Visit::keep_forces, T, HasContacts>);
}

template <class T, bool HasContacts>
void run_stream_with(const StreamCall<T>& call, void* multilevel_memory,
                     const StencilWork<T>* stencils, cudaStream_t stream) {
  const std::size_t bytes =
      pass_shared_bytes(sizeof(T), call.step.plan.most_slots, call.step.plan.most_entries, 2);
  stencils ? allow_mixed_passes<T, HasContacts>(bytes) : allow_shared_memory<T, HasContacts>(bytes);
  StreamRunner<T, HasContacts>(call, multilevel_memory, stencils, stream).rollout();
}

template <class T>
void run_stream_with(const StreamCall<T>& call, void* multilevel_memory,
                     const StencilWork<T>* stencils, cudaStream_t stream) {
  if (has_contacts(call.step)) {
    run_stream_with<T, true>(call, multilevel_memory, stencils, stream);
  } else {
    run_stream_with<T, false>(call, multilevel_memory, stencils, stream);
  }
}

template <class T>
void run_stream(const DeviceStep<T>& step, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  StreamCall<T> call{step, {}};
  Arena arena(memory);
  call.memory = arrange(arena, call);
  void* multilevel_memory = static_cast<std::byte*>(memory) + arena.size();
  run_stream_with<T>(call, multilevel_memory, nullptr, stream);
}

template <class T>
StencilWork<T> arrange_mixed(Arena& arena, const MixedStep<T>& step, StreamCall<T>& call) {
  call.memory = arrange(arena, call);
  return arrange_step_stencils(arena, step.stencils, step.effects, step.batch,
                               T(1 / step.settings.time_step));
}

template <class T>
std::int64_t mixed_stream_bytes(const MixedStep<T>& given) {
  const MixedStep<T> step = with_rows(given);
  Arena arena(nullptr);
  StreamCall<T> call{step, {}};
  arrange_mixed(arena, step, call);
  return arena.size();
}

template <class T>
void run_mixed_stream(const MixedStep<T>& given, void* memory, Stream to) {
  const MixedStep<T> step = with_rows(given);
  const auto stream = static_cast<cudaStream_t>(to);
  StreamCall<T> call{step, {}};
  Arena arena(memory);
  const StencilWork<T> stencils = arrange_mixed(arena, step, call);
  compute_stencil_numbers(stencils, step.effects, step.batch, stream);
  compute_row_numbers(stencils, step.batch, stream);
  run_stream_with<T>(call, nullptr, &stencils, stream);
}

}  // namespace pd::inline PD_TARGET
