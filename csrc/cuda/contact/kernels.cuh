// Kernels of cuda/contact/launch.h: a team of blocks takes one environment after another.
#pragma once
#include "cuda/common/inputs.h"
#include "cuda/common/runtime.h"
#include "cuda/common/teams.cuh"
#include "cuda/contact/launch.h"
#include "cuda/contact/team.cuh"
#include "cuda/rigid/contact_forces.h"
#include "solver/contact/free.h"
#include "solver/contact/step.h"
#include "views/arena.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

// Most vertices and parts of surfaces that one block takes alone: several would wait for each other longer.
constexpr int most_items_of_block = 4096;

template <class T>
struct ContactMemory {
  ContactArrays<T> first;     // of the first environment
  std::int64_t stride;        // bytes between environments
  double* partial;            // [batch, chunks, 2]
  int* counts;                // [batch, chunks]
  unsigned* counter;          // [batch]
  unsigned char* is_free;     // [batch] whether the step without contact is the one with it
  unsigned char* is_correct;  // [batch] whether no coarse correction is asked for
  int* component;             // [vertices]
  T* saved;                   // [batch, vertices, 4]
};

template <class T>
struct ContactKernel {
  ContactWork<T> work;
  ContactMemory<T> memory;
  int chunks, teams, blocks, k, trial;
};

// The first rows of active pairs, and what they move, in shared memory: for an iteration by one block.
template <class T>
struct SharedRows {
  static constexpr int pairs = 512, vertices = 256;
  alignas(16) Four<T> moved_by[vertices];
  T weight[vertices];
  int row_of[pairs];
  alignas(16) T rows[ActiveRow<T>::chunk];

  PD_DEVICE void lend(const ContactPlan<T>& plan, ContactArrays<T>& arrays) {
    arrays.first_rows = rows;
    if (arrays.numbers->pairs <= pairs) arrays.row_of = row_of;
    if (plan.vertices <= vertices) arrays.moved_by = moved_by, arrays.weight = weight;
  }
};

// Dynamic shared memory: of walks, and before them in an iteration of SharedRows.
template <class T>
std::size_t shared_bytes_of(ContactTask task) {
  return task == ContactTask::iterate ? std::max(sizeof(SharedRows<T>), bench_bytes<T>)
                                      : bench_bytes<T>;
}

template <class T>
int count_chunks(const ContactWork<T>& work) {
  const ContactPlan<T>& plan = work.contact.plan;
  const std::int64_t most = std::max<std::int64_t>(
      {plan.vertices, std::int64_t(plan.points) + plan.edges, plan.capacity, work.sum_rows});
  return int(most / contact_chunk) + 1;
}

template <class T>
std::int64_t arrange(const ContactWork<T>& work, void* base, ContactMemory<T>& m) {
  const auto each = [&](Arena& arena) { arrange(arena, work.contact.plan, work.pieces, m.first); };
  Arena size(nullptr);
  each(size);
  m.stride = size.size();
  Arena arena(base);
  const std::int64_t chunks = work.batch * count_chunks(work);
  arena.place(m.partial, 2 * chunks);
  arena.place(m.counts, chunks);
  arena.place(m.counter, work.batch);
  arena.place(m.is_free, work.batch);
  arena.place(m.is_correct, work.batch);
  arena.place(m.component, work.vertices);
  arena.place(m.saved, work.batch * work.vertices * 4);
  const std::int64_t shared = arena.size();
  Arena environments(base ? static_cast<std::byte*>(base) + shared : nullptr);
  each(environments);
  return shared + m.stride * work.batch;
}

template <class T>
PD_DEVICE BodyState<T> body_state(const ContactKernel<T>& call, std::int64_t e) {
  const ContactWork<T>& w = call.work;
  const std::int64_t at = 4 * e * w.vertices;
  T *const u = w.u + at, *const before = w.before + at, *const target = w.target + at;
  return {w.order,
          call.memory.component,
          w.x + at,
          u,
          before,
          target,
          call.memory.saved + at,
          before,
          u + 3,
          target + 3,
          w.material.masses.of(e),
          4,
          w.vertices,
          w.pieces};
}

template <class T>
PD_DEVICE ContactEnvironment<T> environment_of(const ContactKernel<T>& call,
                                               const ContactArrays<T>& arrays, std::int64_t e) {
  const ContactWork<T>& w = call.work;
  const ContactPlan<T>& plan = w.contact.plan;
  const int planes = w.material.planes_count, spheres = w.material.spheres_count;
  return {plan,
          arrays,
          body_state(call, e),
          {reinterpret_cast<const Plane<T>*>(w.planes) + e * planes,
           reinterpret_cast<const Sphere<T>*>(w.spheres) + e * spheres, planes, spheres},
          w.contact.history.poses + e * plan.colliders * 7,
          w.contact.poses + e * plan.colliders * 7,
          w.contact.history.keys + e * plan.capacity,
          w.contact.history.forces + 4 * e * plan.capacity,
          plan.rigid + (plan.rigid ? rigid_numbers * e * plan.colliders : 0),
          plan.friction + e * plan.friction_stride};
}

template <class T, class Steps>
PD_DEVICE void iterate(const ContactKernel<T>& call, const Steps& steps, const ContactTeam& team,
                       std::int64_t e, int k, bool leads) {
  const ContactWork<T>& w = call.work;
  Progress& p = static_cast<Progress*>(w.progress)[e];
  if (p.done) return;
  double* const omegas = w.omega + e * guard_period;
  const double omega = omegas[k % guard_period];
  const bool guards = p.schedule.checks_energy(k), soft = w.settings.tolerance > 0;
  double energy[1] = {0};
  if (guards) {
    const double* const rows = w.sums + e * w.sum_rows * sums_count;
    team.sum(w.sum_rows, [&](int n, double (&sum)[1]) { sum[0] += rows[n * sums_count]; }, energy);
  }
  double sums[2];
  const auto merits =
      steps.iterate(team, k, {T(w.settings.relaxation) * T(omega), guards, soft, energy[0]}, sums);
  if (!leads) return;
  ++p.used;
  omegas[(k + 1) % guard_period] = p.schedule.next(k + 1);
  if (guards) {
    p.schedule.last_energy = merits.known ? merits.before : HUGE_VAL;
    p.schedule.check(merits.now);
  }
  if (soft) {
    const bool rests = steps.is_at_rest();
    const bool met = p.ends(w.settings.tolerance, omega, rests ? sums[0] : HUGE_VAL, sums[1]);
    p.done = met && rests && sums[0] < HUGE_VAL;
  }
}

// A coarse correction of bodies in contact: of environments that are done only at the end.
template <class T>
PD_DEVICE bool asks_correction(const ContactKernel<T>& call, const ContactNumbers& numbers,
                               std::int64_t e) {
  const bool last = call.k == 0 || call.k == call.work.settings.iterations;
  return (last || !static_cast<const Progress*>(call.work.progress)[e].done) &&
         (call.trial == 0 || numbers.cuts);
}

template <class T, class Steps>
PD_DEVICE void begin_correction(const ContactKernel<T>& call, const Steps& steps,
                                const ContactTeam& team, ContactNumbers& numbers, std::int64_t e) {
  bool corrects = false;
  if (asks_correction(call, numbers, e)) {
    corrects = steps.begin_correction(team);
  } else {
    team.once([&] { numbers.corrects = 0; });
  }
  team.spread(1, [&](int) { call.memory.is_correct[e] = !corrects; });
}

template <class T, class Steps>
PD_DEVICE void correct(const ContactKernel<T>& call, const Steps& steps, const ContactTeam& team,
                       const ContactNumbers& numbers, std::int64_t e) {
  if (!numbers.corrects) return;
  const ContactWork<T>& w = call.work;
  const int walls = w.material.planes_count + w.material.spheres_count;
  auto* const first = reinterpret_cast<Quad<T>*>(w.wall_forces) + e * walls * w.vertices;
  const auto forces = [&](int i) { return VertexForces<T>{first + i, w.vertices}; };
  bool cuts = steps.correct(team, forces);
  // planes and spheres ask for a pass over elements between trials
  for (int n = 1; walls == 0 && cuts && n < coarse_trials && steps.begin_correction(team); ++n)
    cuts = steps.correct(team, forces);
}

// Whether a task has something to do where the step without contact is the one with it.
PD_HD constexpr bool knows_free(ContactTask task) {
  return task == ContactTask::look_for_free || task == ContactTask::write;
}

// Writes a state in place of the one that the step leaves.
template <class T>
PD_DEVICE void write_state(const ContactWork<T>& w, const ContactTeam& team, std::int64_t e,
                           const T* positions, const T* velocities) {
  const std::int64_t count = 3 * std::int64_t(w.vertices), first = e * count;
  team.spread(count, [&](int n) {
    w.out_positions[first + n] = positions[first + n];
    w.out_velocities[first + n] = velocities[first + n];
  });
}

template <class T>
PD_DEVICE bool is_free(const ContactWork<T>& w, const FreeMotion<T>& motion,
                       const ContactTeam& team, std::int64_t e) {
  const ContactPlan<T>& plan = w.contact.plan;
  const ContactHistory<T>& history = w.contact.history;
  const std::int64_t at = 3 * e * w.vertices, pose = 7 * e * plan.colliders;
  return motion.begins(team, history.keys + e * plan.capacity, w.positions + at,
                       history.poses + pose) &&
         motion.ends(team, w.positions + at, history.poses + pose, w.free_positions + at,
                     w.contact.poses + pose);
}

template <class T>
PD_DEVICE void write_free(const ContactWork<T>& w, const FreeMotion<T>& motion,
                          const ContactTeam& team, std::int64_t e) {
  motion.write(team, w.contact.poses + 7 * e * w.contact.plan.colliders,
               contact_output(w.contact, e));
  write_state(w, team, e, w.free_positions, w.free_velocities);
  team.spread(w.out_info ? info_count : 0,
              [&](int n) { w.out_info[e * info_count + n] = w.free_info[e * info_count + n]; });
}

// Blocks on a multiprocessor: iterations wait for memory, and coarse corrections need many registers.
template <class T>
constexpr int blocks_at_once(ContactTask task) {
  if (task == ContactTask::correct) return 2;
  return sizeof(T) == 8 ? 2 : task == ContactTask::iterate ? 6 : 4;
}

// `HasRigid`: with colliders that have a mass.
template <ContactTask What, class T, bool HasRigid>
__global__ void __launch_bounds__(contact_threads, blocks_at_once<T>(What))
    contact_task(const __grid_constant__ ContactKernel<T> call) {
  __shared__ ContactArrays<T> arrays;
  const int number = int(blockIdx.x) / call.blocks, thread = int(threadIdx.x);
  const ContactWork<T>& w = call.work;
  const ContactPlan<T>& plan = w.contact.plan;
  BlockTeam blocks(int(blockIdx.x) % call.blocks, call.blocks, call.memory.counter + number);
#pragma unroll 1
  for (std::int64_t e = number; e < w.batch; e += call.teams) {
    if (What == ContactTask::start && blocks.thread() == 0) {
      static_cast<Progress*>(w.progress)[e].done = call.memory.is_free[e] != 0;
      call.memory.is_correct[e] = 1;
    }
    if (!knows_free(What) && call.memory.is_free[e]) continue;
    __syncthreads();
    if (thread < contact_array_pointers)
      reinterpret_cast<char**>(&arrays)[thread] =
          reinterpret_cast<char* const*>(&call.memory.first)[thread] + e * call.memory.stride;
    __syncthreads();
    const ContactTeam team(blocks, call.memory.partial + 2 * e * call.chunks,
                           call.memory.counts + e * call.chunks);
    if constexpr (knows_free(What)) {
      const FreeArrays<T> free{arrays.begin, arrays.place, arrays.body_box, &arrays.numbers->meets};
      const FreeMotion<T> motion(plan, free);
      if (What == ContactTask::look_for_free) {
        const bool is = is_free(w, motion, team, e);
        team.once([&] { call.memory.is_free[e] = is; });
        continue;
      }
      if (call.memory.is_free[e]) {
        write_free(w, motion, team, e);
        continue;
      }
    }
    if (What == ContactTask::iterate && call.blocks == 1) {
      if (thread == 0) reinterpret_cast<SharedRows<T>*>(contact_shared())->lend(plan, arrays);
      __syncthreads();
    }
    const ContactEnvironment<T> environment = environment_of(call, arrays, e);
    const ContactSteps<T, HasRigid> steps(environment);
    T* const forces = w.contact.forces + 3 * e * plan.vertices;
    if constexpr (What == ContactTask::start) {
      steps.start(team);
      if (blocks.thread() == 0) {
        Progress& p = static_cast<Progress*>(w.progress)[e];
        p.used = 0;
        p.stop = {
            squared_free_fall(w.vertices, w.settings.time_step, read3(w.material.gravity.of(e)))};
      }
    } else if constexpr (What == ContactTask::go_first) {
      steps.go_first(team);
    } else if constexpr (What == ContactTask::begin_correction) {
      begin_correction(call, steps, team, environment.numbers(), e);
    } else if constexpr (What == ContactTask::correct) {
      correct(call, steps, team, environment.numbers(), e);
    } else if constexpr (What == ContactTask::iterate) {
      iterate(call, steps, team, e, call.k, blocks.thread() == 0);
    } else if constexpr (What == ContactTask::go_last) {
      steps.go_last(team, w.settings.iterations);
    } else if constexpr (What == ContactTask::finish) {
      steps.finish(team, forces);
    } else {
      steps.write(team, contact_output(w.contact, e));
      if (steps.overflows()) write_state(w, team, e, w.positions, w.velocities);
    }
    team.barrier();
  }
}

template <class T>
__global__ void contact_components(const __grid_constant__ ContactKernel<T> call) {
  const int s = int(blockIdx.x * blockDim.x + threadIdx.x);
  if (s < call.work.slots)
    call.memory.component[call.work.slot_vertex[s]] = call.work.slot_piece[s];
}

template <ContactTask What, class T, bool HasRigid>
void launch_contact(const ContactWork<T>& work, int k, int trial, cudaStream_t stream) {
  ContactKernel<T> call{work, {}, count_chunks(work), 0, 0, k, trial};
  arrange(work, work.memory, call.memory);
  const auto* kernel = reinterpret_cast<const void*>(contact_task<What, T, HasRigid>);
  const std::size_t shared = shared_bytes_of<T>(What);
  const int resident = resident_blocks(kernel, contact_threads, shared);
  const ContactPlan<T>& plan = work.contact.plan;
  const std::int64_t items = std::max<std::int64_t>(plan.vertices, std::int64_t(plan.edges));
  const Teams teams(work.batch, resident,
                    items <= most_items_of_block ? 1 : int(items / contact_threads) + 1);
  call.teams = teams.blocks > 1 ? teams.count : int(blocks_of(work.batch));
  call.blocks = teams.blocks;
  if (call.blocks > 1)
    return launch_teams(kernel, call, call.memory.counter, contact_threads, shared, stream);
  contact_task<What, T, HasRigid><<<unsigned(call.teams), contact_threads, shared, stream>>>(call);
  check(cudaGetLastError());
}

}  // namespace pd::inline PD_TARGET

namespace pd {

template <class T>
std::int64_t contact_bytes(const ContactWork<T>& work) {
  ContactMemory<T> memory;
  return arrange(work, nullptr, memory);
}

template <class T>
void prepare_contact(const ContactWork<T>& work, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  ContactKernel<T> call{work, {}, 0, 0, 0, 0, 0};
  arrange(work, work.memory, call.memory);
  check(cudaMemsetAsync(call.memory.component, 0xff, work.vertices * sizeof(int), stream));
  check(cudaMemsetAsync(call.memory.is_free, 0, work.batch, stream));
  if (work.pieces == 0 || work.slots == 0) return;
  contact_components<T><<<blocks_of((work.slots + 255) / 256), 256, 0, stream>>>(call);
  check(cudaGetLastError());
}

template <class T>
ContactFlags contact_flags(const ContactWork<T>& work) {
  ContactMemory<T> memory;
  arrange(work, work.memory, memory);
  return {memory.is_free, memory.is_correct};
}

template <class T>
void keep_displacements(const ContactWork<T>& work, Stream to) {
  ContactMemory<T> memory;
  arrange(work, work.memory, memory);
  check(cudaMemcpyAsync(memory.saved, work.u, work.batch * work.vertices * 4 * sizeof(T),
                        cudaMemcpyDeviceToDevice, static_cast<cudaStream_t>(to)));
}

template <class T, bool HasRigid>
void run_contact_task(ContactTask task, const ContactWork<T>& work, int k, int trial, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  switch (task) {
#define X(name)           \
  case ContactTask::name: \
    return launch_contact<ContactTask::name, T, HasRigid>(work, k, trial, stream);
    X(look_for_free)
    X(start)
    X(go_first)
    X(begin_correction)
    X(correct)
    X(iterate)
    X(go_last)
    X(finish)
    X(write)
#undef X
  }
}

}  // namespace pd
