// Kernels for meshes of any size, one pass of a step each. They work patch by patch or vertex by
// vertex, with the state in global memory.
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/common/vertices.h"
#include "cuda/elements/pair_weights.h"
#include "cuda/elements/rows.h"
#include "cuda/elements/stencils.h"
#include "cuda/elements/tet_per_lane.h"
#include "cuda/rigid/rounds.h"
#include "cuda/stream/kernel_overlap.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

constexpr int vertex_threads = 256;  // per block of kernels over vertices
// of kernels over shared vertices; such a block fits beside a pipeline's block
constexpr int shared_threads = 128;
constexpr int pass_threads = 384;     // per block of kernels over patches, two on a multiprocessor
constexpr int decide_threads = 1024;  // maximum for the block that reduces an environment's sums

template <class T>
struct StreamMemory {
  Quad<T>*x, *velocity, *target, *u, *before;  // [batch, vertices]
  Quad<T>* origin;                             // [batch, slots]
  Quad<T>* shared_force;    // [batch, places]; halo messages in float32 (cuda/common/reductions.h)
  T* weights;               // [batch or 1, blocks, pair_weights, 32]
  T* patch_weight;          // [batch or 1, patches]; -1 unless the patch has one positive stiffness
  double* sums;             // [batch, patches + blocks of shared vertices, sums_count]
  Progress* progress;       // [batch]
  double* omega;            // [batch, guard_period] of the next iterations
  Piece* pieces;            // [batch, pieces]
  double* part_sum;         // [batch, count_rows, PartSums::count]
  unsigned* counter;        // [batch] barrier counters of the teams that move pieces
  ContactForces<T> forces;  // [batch]
  Plane<T>* planes;         // [batch, planes]
  Sphere<T>* spheres;       // [batch, spheres]
};

template <class T>
struct StreamCall {
  DeviceStep<T> step;
  StreamMemory<T> memory;
  bool stops = step.settings.tolerance > 0;  // whether updates skip environments that are done
  const unsigned char* skipped = nullptr;    // [batch] environments that other passes skip

  PD_HD int shared_blocks() const {
    return (step.plan.shared + shared_threads - 1) / shared_threads;
  }
  // number of forces on shared vertices
  PD_HD std::int64_t places() const {
    return step.plan.slots - (step.plan.vertices - step.plan.shared);
  }
  PD_HD int sum_rows() const { return step.plan.patches + shared_blocks(); }
};

template <class T>
PD_HD bool own_weights(const DeviceStep<T>& step) {
  return has_own_weights(step.material.stiffness, step.poisson);
}

// Pointers of one environment of a call.
template <class T, bool HasContacts>
struct StreamWork {
  const StreamCall<T>& call;
  const DevicePlan<T>& plan;
  std::int64_t environment;
  Vertices<T, HasContacts> v;
  Quad<T>*origin, *shared_force;
  T *weights, *patch_weight;
  Progress& progress;
  Contacts<T> contacts;
  Inputs<T> in;
  T h;

  PD_DEVICE StreamWork(const StreamCall<T>& c, std::int64_t e)
      : call(c),
        plan(c.step.plan),
        environment(e),
        v{c.memory.x + e * plan.vertices, c.memory.velocity + e * plan.vertices,
          c.memory.target + e * plan.vertices, c.memory.u + e * plan.vertices,
          c.memory.before + e * plan.vertices},
        origin(c.memory.origin + e * plan.slots),
        shared_force(c.memory.shared_force + e * c.places()),
        weights(c.memory.weights +
                (own_weights(c.step) ? e * plan.blocks * pair_weights * pair_lanes : 0)),
        patch_weight(c.memory.patch_weight + (own_weights(c.step) ? e * plan.patches : 0)),
        progress(c.memory.progress[e]),
        contacts{c.memory.planes + e * c.step.material.planes_count,
                 c.memory.spheres + e * c.step.material.spheres_count, c.step.material.planes_count,
                 c.step.material.spheres_count},
        in{&c.step, e},
        h(T(c.step.settings.time_step)) {}

  PD_DEVICE const Settings& settings() const { return call.step.settings; }
  // The weight omega of iteration k, in float64. A caller that loads it early converts it late,
  // since the conversion waits for the load.
  PD_DEVICE double omega(int k) const {
    // stream_shared needs the L2 cache, see kernel_overlap.h
    return __ldcg(call.memory.omega + environment * guard_period + k % guard_period);
  }
  PD_DEVICE TaggedWord* messages() const { return reinterpret_cast<TaggedWord*>(shared_force); }
  // Stores a patch's force on a shared vertex. `round` is the message tag; 0 marks a pass that no
  // kernel waits for.
  PD_DEVICE void store_force(unsigned place, const Vec3<T>& force, unsigned round) const {
    if constexpr (sizeof(T) == 4) {
      HaloMessage<T>::send(messages() + place, force, round);
    } else {
      shared_force[place] = quad(force);
    }
  }
  PD_DEVICE double* sum_row(int row) const {
    return call.memory.sums + (environment * call.sum_rows() + row) * sums_count;
  }
  PD_DEVICE Piece& piece(int piece) const {
    return call.memory.pieces[environment * plan.pieces + piece];
  }
  PD_DEVICE double* part_sums() const {
    return call.memory.part_sum + environment * count_rows(plan) * PartSums::count;
  }
  PD_DEVICE Correction<T, HasContacts> correction(Iterate from) const {
    return {v, contacts, in, call.memory.forces.of_environment(environment), from};
  }
};

// Whether u and the previous iterate swap roles every iteration, which writes less memory. With a
// tolerance they do not, since environments stop at different iterations.
PD_HD bool alternates(const Settings& settings) { return !(settings.tolerance > 0); }

// The update of a vertex once its elastic force is known. keep_forces: see Correction.
enum class Visit { diagonal, update, update_guarded, keep_forces };

template <Visit What>
struct ElementOf {
  using type = SolidGradient<What == Visit::update_guarded>;
};
template <>
struct ElementOf<Visit::diagonal> {
  using type = SolidDiagonal;
};

struct ThreadSums {
  double value[sums_count];
};

// Loads a vertex for a visit; the first pass (diagonal) runs before there is a state.
template <Visit What, class T, bool HasContacts>
PD_DEVICE typename Vertices<T, HasContacts>::LoadedVertex load_vertex(
    const StreamWork<T, HasContacts>& w, unsigned i) {
  if constexpr (What == Visit::diagonal) return {};
  return w.v.load(i);
}

template <Visit What, class T, bool HasContacts>
PD_DEVICE double omega_of_pass(const StreamWork<T, HasContacts>& w, int k) {
  return What == Visit::update || What == Visit::update_guarded ? w.omega(k) : 0;
}

template <Visit What, class T, bool HasContacts>
PD_DEVICE void visit(const StreamWork<T, HasContacts>& w, unsigned i,
                     const typename Vertices<T, HasContacts>::LoadedVertex& loaded,
                     const Vec3<T>& force, T omega, ThreadSums& sums,
                     Iterate from = Iterate::last) {
  double (&sum)[sums_count] = sums.value;
  if constexpr (What == Visit::diagonal) {
    sum[0] = Min{}(sum[0], w.v.set_diagonal(i, force.x));
  } else if constexpr (What == Visit::keep_forces) {
    w.correction(from).keep_forces(int(i), int(i), force);
  } else {
    if constexpr (What == Visit::update_guarded) sum[0] += loaded.energy();
    if (!alternates(w.settings())) sum[2] += loaded.square_of_displacement();
    const Vec3<T> next = loaded.next(w.contacts, force, T(w.settings().relaxation), omega);
    if (alternates(w.settings())) {
      w.v.set_in_place_of_before(i, loaded, next);
    } else {
      const Vec3<T> change = next - loaded.u;
      sum[1] += double(dot(change, change));
      w.v.set_before(i, loaded.u);
      w.v.set(i, next);
    }
  }
}

template <Visit What>
PD_DEVICE ThreadSums no_sums() {
  if constexpr (What == Visit::diagonal) return {{HUGE_VAL, HUGE_VAL, HUGE_VAL}};
  return {{0, 0, 0}};
}

// Writes the sums of a block to its row.
template <Visit What>
PD_DEVICE void write_sums(const ThreadSums& sums, double* row) {
  using Op = std::conditional_t<What == Visit::diagonal, Min, Add>;
  __shared__ double warp_sum[sums_count][warp_size];
  static_assert(sizeof(warp_sum) == pass_static_bytes);
  const int warp = threadIdx.x / warp_size, lane = threadIdx.x % warp_size;
  for (int n = 0; n < sums_count; ++n) {
    const double sum = warp_reduce(sums.value[n], Op{});
    if (lane == 0) warp_sum[n][warp] = sum;
  }
  __syncthreads();
  if (warp != 0) return;
  for (int n = 0; n < sums_count; ++n) {
    const bool used = lane < int(blockDim.x) / warp_size;
    const double sum = warp_reduce(used ? warp_sum[n][lane] : Op::identity, Op{});
    if (lane == 0) row[n] = sum;
  }
}

template <Visit What, class T, bool HasContacts>
PD_DEVICE bool wants_sums(const StreamWork<T, HasContacts>& w) {
  if constexpr (What == Visit::keep_forces) return false;
  return What != Visit::update || w.settings().tolerance > 0;
}

template <Visit What, class T, bool HasContacts>
PD_DEVICE bool skips(const StreamWork<T, HasContacts>& w) {
  if constexpr (What == Visit::update || What == Visit::update_guarded)
    return w.call.stops && w.progress.done;
  return w.call.skipped && w.call.skipped[w.environment];
}

// The elements of a pass besides tetrahedra.
struct NoStencilsOfPass {
  static constexpr bool any = false;
};
template <class T>
struct StencilsOfPass {
  static constexpr bool any = true;
  const StencilWork<T>& work;
  bool bounded;  // whether the weights of a diagonal have l_e
};

// Computes the elements of a patch. Calls here(vertex, load(vertex), force) for every interior
// vertex and stores the forces on shared vertices. Returns this thread's energy sum. `shared`:
// pass_shared_bytes. `stencils`: StencilsOfPass, or NoStencilsOfPass.
template <class T, bool HasContacts, class Element, class Stencils, class Load, class Here>
PD_DEVICE double pass_over_patch(const StreamWork<T, HasContacts>& w, int number, std::byte* shared,
                                 const Element& element, const Stencils& stencils, const Load& load,
                                 const Here& here) {
  const Patch<T> patch(w.plan, number);
  const bool has_tets = !Stencils::any || patch.pairs > 0;
  TetInputs<T> first{};
  if (has_tets) first = load_tet<true>(patch, w.weights, int(threadIdx.x));
  const Slots<T> slots(shared, w.plan.most_slots);
  const ComputedRest<T> rest = rest_of<true>(patch);
  const T per_unit = T(1) / rest.unit;
  auto* entries = reinterpret_cast<Quad<T>*>(shared + slots_bytes(sizeof(T), w.plan.most_slots, 2));
  for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
    const Vec3<T> position = vec3(w.origin[patch.first_slot + s]) + vec3(w.v.u[patch.vertex(s)]);
    if (has_tets) {
      slots.set(s, position, rest.position[s].bits());
    } else {
      slots.set_first(s, position);  // only tetrahedra read rest positions
    }
  }
  __syncthreads();
  const auto shape_of = [&](int, const TetInputs<T>& numbers, const Quad<T>(&loaded)[4]) {
    return tet_rest(numbers, per_unit, slots, loaded);
  };
  T sum = T(0);
  if (has_tets)
    sum = each_tet<false, true>(
        patch, slots, shape_of, [](int, T) { return true; }, w.weights, entries, element, first);
  double energy = double(sum);
  if constexpr (Stencils::any) {
    const auto read = [slots](unsigned corner, Vec3<T>(&x)[1]) {
      x[0] = vec3(slots.load(corner & 0xffff));
    };
    const int before = (2 * patch.pairs + warp_size - 1) / warp_size;
    energy += each_stencil_of_step(stencils.work, w.environment, number, before, read, entries,
                                   on_stencils(element, stencils.bounded));
  }
  // loads overlap with the barrier
  int s = threadIdx.x, row = 0;
  decltype(load(0)) loaded{};
  const auto load_slot = [&] {
    if (s < patch.slots) row = patch.row(s);
    if (s < patch.interior) loaded = load(patch.first_vertex + s);
  };
  load_slot();
  __syncthreads();
#pragma unroll 1
  while (s < patch.slots) {
    const Vec3<T> force = sum_entries(entries, row);
    if (s < patch.interior) {
      here(patch.first_vertex + s, loaded, force);
    } else {
      const int end_vertex = patch.first_vertex + patch.interior;
      w.store_force(place_of_force(w.plan, patch.first_slot, end_vertex, s), force, 0);
    }
    s += blockDim.x;
    load_slot();
  }
  return energy;
}

// Updates the elements and interior vertices of one patch per block. `k`: iteration, or Iterate for
// keep_forces.
template <Visit What, class T, bool HasContacts, class Stencils>
PD_DEVICE void update_patch(const StreamCall<T>& call, int k, std::byte* shared,
                            const Stencils& stencils) {
  const int number = int(blockIdx.x % call.step.plan.patches);
  const StreamWork<T, HasContacts> w(call, blockIdx.x / call.step.plan.patches);
  if (skips<What>(w)) return;
  if constexpr (Stencils::any) {
    prefetch_stencils(stencils.work, w.environment, number);
    prefetch_rows(stencils.work, w.environment, number);
  }
  // prefetches data that is read after the elements
  const Patch<T> patch(w.plan, number);
  if constexpr (What != Visit::diagonal) {
    prefetch_to_l2(w.v.before + patch.first_vertex, patch.interior);
    prefetch_to_l2(w.v.target + patch.first_vertex, patch.interior);
  }
  prefetch_to_l2(w.plan.slot_row + patch.first_slot, patch.slots);
  ThreadSums sums = no_sums<What>();
  const double omega = omega_of_pass<What>(w, k);
  const double energy = pass_over_patch(
      w, number, shared, typename ElementOf<What>::type{}, stencils,
      [&](int i) { return load_vertex<What>(w, i); },
      [&](int i, const auto& loaded, const Vec3<T>& force) {
        visit<What>(w, i, loaded, force, T(omega), sums, Iterate(k));
      });
  if constexpr (What != Visit::diagonal) sums.value[0] += energy;
  if (wants_sums<What>(w)) write_sums<What>(sums, w.sum_row(number));
}

template <Visit What, class T, bool HasContacts>
__global__ void __launch_bounds__(pass_threads, sizeof(T) == 4 ? 2 : 1)
    stream_patches(const __grid_constant__ StreamCall<T> call, int k) {
  extern __shared__ __align__(16) std::byte shared[];
  update_patch<What, T, HasContacts>(call, k, shared, NoStencilsOfPass{});
}

// Decisions from the sums of a pass, one environment per block.
enum class Decision { start, diagonal, iterate };

template <Decision What, class T>
__global__ void __launch_bounds__(decide_threads)
    stream_decide(const __grid_constant__ StreamCall<T> call, int k) {
  using Op = std::conditional_t<What == Decision::diagonal, Min, Add>;
  const StreamWork<T, false> w(call, blockIdx.x);
  __shared__ double total[sums_count];
  wait_for_previous_kernel();
  if (threadIdx.x == 0) launch_dependents();
  if constexpr (What != Decision::start) {
    ThreadSums sums = {{Op::identity, Op::identity, Op::identity}};
    for (int row = threadIdx.x; row < call.sum_rows(); row += blockDim.x) {
      for (int n = 0; n < sums_count; ++n) sums.value[n] = Op{}(sums.value[n], w.sum_row(row)[n]);
    }
    write_sums<What == Decision::diagonal ? Visit::diagonal : Visit::update>(sums, total);
  }
  if (threadIdx.x != 0) return;
  const Settings& set = call.step.settings;
  Progress& p = w.progress;
  double* omega = call.memory.omega + w.environment * guard_period;
  if constexpr (What == Decision::diagonal) {
    p.min_share = total[0];
  } else if constexpr (What == Decision::start) {
    p.schedule = Schedule(set, p.min_share, w.contacts.friction() > T(0));
    p.used = set.tolerance > 0 ? 0 : set.iterations;
    if (set.tolerance > 0) p.stop = {w.in.free_fall_squared()};
    p.done = false;
    omega[0] = p.schedule.next(0);
  } else {
    const bool soft = set.tolerance > 0;
    if (p.done) return;
    p.used += soft;
    p.done = soft && p.ends(set.tolerance, omega[k % guard_period], total[1], total[2]);
    const auto set_omega = [&](int next) { omega[next % guard_period] = p.schedule.next(next); };
    set_omega(k + 1);
    if (p.schedule.checks_energy(k)) p.schedule.check(total[0]);
    // without a tolerance, all iterations until the next energy check
    for (int next = k + 2; !soft && next <= k + guard_period; ++next) set_omega(next);
  }
}

template <class T>
__global__ void __launch_bounds__(vertex_threads)
    stream_weights(const __grid_constant__ StreamCall<T> call, WeightKind kind) {
  const StreamWork<T, false> w(call, blockIdx.x / call.step.plan.patches);
  const Patch<T> patch(w.plan, int(blockIdx.x % call.step.plan.patches));
  const Moduli<T> moduli(call.step.material.stiffness, call.step.poisson, w.environment);
  compute_patch_weights(patch, rest_of<true>(patch), moduli, kind, w.weights);
  if constexpr (has_poisson_ratio) return;  // the pipeline, which reads the rest, is without it
  const T one = one_stiffness(patch, moduli.youngs);
  if (threadIdx.x == 0)
    w.patch_weight[patch.index] =
        one > T(0) ? patch_weight(w.plan.patch_unit[patch.index], one) : T(-1);
  // clears the padding of the last block, which the pipeline reads
  const int end = (patch.pairs + pair_lanes - 1) / pair_lanes * pair_lanes;
  const int padding = patch.pairs + int(threadIdx.x);
  for (int e = 0; e < 2 && padding < end; ++e)
    (w.weights + place_of(patch, padding).in(2))[e * pair_lanes] = T(0);
}

// ---- kernels over vertices

enum class VertexTask { load, predict, start, finish, store };

template <VertexTask What, class T, bool HasContacts>
__global__ void __launch_bounds__(vertex_threads)
    stream_vertices(const __grid_constant__ StreamCall<T> call, int record) {
  const int blocks = (call.step.plan.vertices + vertex_threads - 1) / vertex_threads;
  const StreamWork<T, HasContacts> w(call, blockIdx.x / blocks);
  const int i = int(blockIdx.x % blocks) * vertex_threads + int(threadIdx.x);
  if constexpr (What == VertexTask::load && HasContacts) {
    if (i == 0)
      w.in.read_contacts(const_cast<Plane<T>*>(w.contacts.planes),
                         const_cast<Sphere<T>*>(w.contacts.spheres));
  }
  if (i >= w.plan.vertices) return;
  if constexpr (What == VertexTask::load) w.v.init(i, w.in, i, w.h);
  if constexpr (What == VertexTask::predict) w.v.predict(i, w.in, i, w.h);
  if constexpr (What == VertexTask::start) {
    const Vec3<T> u = w.v.first(i, w.in, i, w.contacts);
    w.v.set(i, u);
    w.v.set_before(i, u);
  }
  if constexpr (What == VertexTask::finish) w.v.finish(i, w.h);
  if constexpr (What == VertexTask::store)
    w.in.write(record, i, vec3(w.v.x[i]), vec3(w.v.velocity[i]));
}

// Positions relative to each patch's first vertex, which stay accurate far from the origin.
template <class T>
__global__ void __launch_bounds__(vertex_threads)
    stream_origins(const __grid_constant__ StreamCall<T> call) {
  const StreamWork<T, false> w(call, blockIdx.x / call.step.plan.patches);
  const Patch<T> patch(w.plan, int(blockIdx.x % call.step.plan.patches));
  const Vec3<T> anchor = vec3(w.v.x[patch.vertex(0)]);
  for (int s = threadIdx.x; s < patch.slots; s += blockDim.x)
    w.origin[patch.first_slot + s] = quad(vec3(w.v.x[patch.vertex(s)]) - anchor);
}

// This thread's index in the grid.
PD_DEVICE std::int64_t thread_number() {
  return std::int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
}

// ---- kernels over environments

enum class EnvironmentTask { move_spheres, store };

template <EnvironmentTask What, class T>
__global__ void __launch_bounds__(vertex_threads)
    stream_environments(const __grid_constant__ StreamCall<T> call, int record) {
  const std::int64_t e = thread_number();
  if (e >= call.step.batch) return;
  const StreamWork<T, true> w(call, e);
  if constexpr (What == EnvironmentTask::store) w.in.write_info(record, w.progress);
  if constexpr (What == EnvironmentTask::move_spheres) {
    Sphere<T>* spheres = const_cast<Sphere<T>*>(w.contacts.spheres);
    for (int b = 0; b < w.contacts.sphere_count; ++b)
      spheres[b].center = spheres[b].center + spheres[b].motion;
  }
}

}  // namespace pd::inline PD_TARGET
