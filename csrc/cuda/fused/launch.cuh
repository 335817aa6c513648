// Launch of the fused kernel in one precision.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/runtime.h"
#include "cuda/fused/kernels.cuh"
#include "views/arena.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <tuple>

namespace pd::inline PD_TARGET {

static_assert(sizeof(Control<double>) <= fused_control_bytes);
static_assert(sizeof(Plane<float>) == planes_numbers * sizeof(float) &&
              sizeof(Sphere<float>) == spheres_numbers * sizeof(float));

// Shared memory that the device reserves per block.
constexpr std::size_t reserved_shared_bytes = 1024;

// instantiated in fused_contacts_float.cu and fused_contacts_double.cu
extern template FusedKernel<float> fused_kernel_for<float, true, true>(Blocks, bool, int);
extern template FusedKernel<double> fused_kernel_for<double, true, true>(Blocks, bool, int);

template <class T>
FusedKernel<T> fused_kernel(const DeviceStep<T>& step, Blocks kind, bool in_shared, int threads) {
  if (has_contacts(step)) return fused_kernel_for<T, true, true>(kind, in_shared, threads);
  // fewer kernels with Poisson's ratio
  if constexpr (has_poisson_ratio)
    return has_free_pieces(step) ? fused_kernel_for<T, true, true>(kind, in_shared, threads)
                                 : fused_kernel_for<T, false, false>(kind, in_shared, threads);
  return has_free_pieces(step) ? fused_kernel_for<T, false, true>(kind, in_shared, threads)
                               : fused_kernel_for<T, false, false>(kind, in_shared, threads);
}

// Launch configuration of a call.
template <class T>
struct FusedLaunch {
  Blocks kind;
  FusedKernel<T> kernel;
  int threads, teams, patches;
  int kept = 0;  // vertex arrays in shared memory
  std::size_t shared;

  explicit FusedLaunch(const DeviceStep<T>& step);

  const void* function() const { return reinterpret_cast<const void*>(kernel); }

 private:
  void form_clusters(const DeviceStep<T>& step);
  void keep_vertices(const DeviceStep<T>& step);
};

// Shape of a block with one environment: threads, and resident blocks per multiprocessor.
struct BlockShape {
  int threads = warp_size, per_multiprocessor = 0;
  double pairs = 0;        // pairs in progress per multiprocessor
  double cost = HUGE_VAL;  // for the plan's number of environments, where it is known

  int resident() const { return threads * per_multiprocessor; }
  // Resident threads hide memory latency. Second, few threads should idle in the last round of
  // pairs; third, few should wait for each other.
  auto rank() const { return std::tuple(resident(), pairs, per_multiprocessor); }
  bool is_worse_than(const BlockShape& other) const {
    if (cost != other.cost) return cost > other.cost;
    return std::tuple(resident(), pairs) < std::tuple(other.resident(), other.pairs);
  }
};

// Time of an iteration on a multiprocessor with several environments; the unit is the issue time of
// one warp round. Up to two rounds per thread, pairs are prefetched and the latency is that of the
// rest of an iteration. Three rounds each add latency.
//
// Fitted on an H100 to 64 to 400 vertices with all environments resident; the chosen shape was at
// most 6 % slower than the best. Shapes with more rounds were not fitted. In float32,
// cuda/small_batch/block_shape.h now covers 64 vertices.
inline double shape_cost(int environments, int warps, int rounds) {
  const int wait = rounds <= 2 ? 26 : 15 * rounds;
  return wait + 0.25 * warps + double(warps * rounds) * environments;
}
constexpr int most_fitted_rounds = 3;

// The best shape for a mesh and its shared memory. It serves as many environments as fit on a
// multiprocessor, or those of the plan if they are fewer. The batch of a call has no influence,
// so an environment gives the same bits alone and in any batch.
//
// `pairs`: tetrahedra's pairs, or items that threads take like them.
template <class T>
BlockShape block_shape(int pairs, int environments, std::size_t shared) {
  BlockShape best, cheapest;
  if (shared > shared_memory_per_block()) return best;
  const int fit = int(shared_memory_per_multiprocessor() / (shared + reserved_shared_bytes));
  for (int threads = warp_size; threads <= resident_threads<T>; threads += warp_size) {
    const int per_multiprocessor = std::min(fit, resident_threads<T> / threads);
    const int rounds = (pairs + threads - 1) / threads;
    BlockShape shape = {threads, per_multiprocessor, double(per_multiprocessor) * pairs / rounds};
    if (shape.rank() > best.rank()) best = shape;
    const bool few = environments > 0 && environments <= per_multiprocessor;
    if (!few || rounds > most_fitted_rounds) continue;
    shape.cost = shape_cost(environments, threads / warp_size, rounds);
    if (shape.cost < cheapest.cost) cheapest = shape;
  }
  return cheapest.per_multiprocessor > 0 ? cheapest : best;
}

// A block with one environment. It keeps as many arrays in shared memory as possible without lower occupancy or higher
// cost.
struct BlockForm {
  int threads, kept = 1;  // vertex arrays in shared memory
  std::size_t shared;

  template <class T>
  BlockForm(const DeviceStep<T>& step, int pairs) : shared(fused_shared_bytes(step)) {
    const std::size_t each = sizeof(Quad<T>) * step.plan.most_slots;
    const std::size_t begin = vertices_begin(step, false);
    const auto shape_with = [&](std::size_t bytes) {
      return block_shape<T>(pairs, step.plan.environments, bytes);
    };
    const BlockShape least = shape_with(shared);
    BlockShape taken = least;
    for (int arrays = 2; least.per_multiprocessor > 0 && arrays <= block_arrays; ++arrays) {
      const BlockShape shape = shape_with(begin + (arrays - 1) * each);
      if (shape.is_worse_than(least)) break;
      taken = shape;
      kept = arrays;
      shared = begin + (arrays - 1) * each;
    }
    threads = taken.threads;
  }

  bool in_shared() const { return kept == block_arrays; }
};

// Threads of a block with one patch: one per tetrahedron and slot, up to a limit, plus a leading
// warp without pairs.
template <class T>
int patch_threads(const DevicePlan<T>& plan) {
  const int wanted = std::max(2 * plan.most_pairs + warp_size, plan.most_slots);
  return std::clamp((wanted + warp_size - 1) / warp_size * warp_size, 64, most_grid_threads<T>);
}

template <class T>
bool fits_in_shared(const DevicePlan<T>& plan, int threads) {
  return is_near(sizeof(T), plan.most_slots, plan.most_pairs, threads);
}

template <class T>
FusedLaunch<T>::FusedLaunch(const DeviceStep<T>& step)
    : kind(step.plan.kernel == int(DeviceKernel::cluster) ? Blocks::cluster
           : step.plan.kernel == int(DeviceKernel::grid)  ? Blocks::grid
                                                          : Blocks::one),
      patches(kind == Blocks::one ? 1 : step.plan.patches) {
  if (kind == Blocks::cluster) {
    if constexpr (has_poisson_ratio)
      throw std::invalid_argument(
          "torchpd: kernel \"cluster\" has no Poisson's ratio; build the simulator with "
          "kernel=\"grid\", or leave kernel to \"auto\"");
    form_clusters(step);
    return;
  }
  shared = fused_shared_bytes(step);
  if (kind == Blocks::one) {
    const BlockForm form(step, step.plan.most_pairs);
    threads = form.threads;
    kept = form.kept;
    shared = form.shared;
    kernel = fused_kernel(step, kind, form.in_shared(), threads);
  } else {
    threads = patch_threads(step.plan);
    keep_vertices(step);
    const bool in_shared = kept == vertex_arrays && fits_in_shared(step.plan, threads);
    if (!in_shared) threads = global_memory_threads<T>;
    kernel = fused_kernel(step, kind, in_shared, threads);
  }
  const int resident = resident_blocks(function(), threads, shared);
  if (resident < patches)
    throw std::runtime_error(
        "torchpd: this device runs " + std::to_string(resident) + " blocks of " +
        std::to_string(shared) + " bytes of shared memory at once, and the plan has " +
        std::to_string(patches) + " patches; build the simulator with kernel=\"stream\"");
  teams = int(std::min<std::int64_t>(step.batch, resident / patches));
}

// Few patches with distributed shared memory. The batch has no influence here either.
template <class T>
void FusedLaunch<T>::form_clusters(const DeviceStep<T>& step) {
  shared = cluster_shared_bytes(step);
  threads = int(cluster_threads(sizeof(T), step.plan.most_pairs, step.plan.most_interior));
  const bool in_shared = halo_lanes(sizeof(T), step.plan.most_pairs, step.plan.most_interior) == 8;
  kernel = fused_kernel(step, Blocks::cluster, in_shared, threads);
  int clusters = 0;
  if (threads <= most_grid_threads<T> && resident_blocks(function(), threads, shared) > 0)
    clusters = resident_clusters(function(), threads, shared, patches);
  if (clusters == 0)
    throw std::runtime_error(
        "torchpd: this device runs no cluster of " + std::to_string(patches) + " blocks with " +
        std::to_string(threads) + " threads and " + std::to_string(shared) +
        " bytes of shared memory each; build the simulator with kernel=\"grid\"");
  kept = vertex_arrays;
  teams = int(std::min<std::int64_t>(step.batch, clusters));
}

// Blocks of the largest cluster that this device runs with any amount of shared memory, if this
// build has code for it; otherwise 1.
template <class T>
int largest_cluster_with() {
  constexpr int threads = most_grid_threads<T>;
  const auto* kernel = reinterpret_cast<const void*>(
      fused_kernel_for<T, true, true>(Blocks::cluster, true, threads));
  const std::size_t shared = shared_memory_per_block();
  if (resident_blocks(kernel, threads, shared) == 0) return 1;
  int blocks = int(most_cluster_blocks);
  while (blocks > 1 && resident_clusters(kernel, threads, shared, blocks) == 0) blocks /= 2;
  return blocks;
}

// As many arrays as fit in a block that has a multiprocessor to itself.
template <class T>
void FusedLaunch<T>::keep_vertices(const DeviceStep<T>& step) {
  const std::size_t each = sizeof(Quad<T>) * step.plan.most_slots;
  const std::size_t begin = vertices_begin(step, false), most = shared_memory_per_block();
  if (begin >= most || each == 0) return;
  kept = int(std::min<std::size_t>((most - begin) / each, vertex_arrays));
  if (kept > 0) shared = begin + kept * each;
}

template <class T, class Launch>
FusedScratch<T> arrange(Arena& arena, const DeviceStep<T>& step, const Launch& launch) {
  const DevicePlan<T>& plan = step.plan;
  const bool grid = launch.kind == Blocks::grid;
  const std::int64_t teams = launch.teams;
  FusedScratch<T> s;
  // zero-initialised arrays come first
  arena.place(s.messages, grid ? teams * 2 * plan.slots * HaloMessage<T>::words : 0);
  arena.place(s.sums, grid ? teams * 2 * plan.patches * sums_count : 0);
  for (int a = 0; a < vertex_arrays; ++a) {
    arena.place(s.vertex[a], a < launch.kept ? 0 : teams * plan.slots);
  }
  // with one tetrahedron per thread, its weight stays in a register
  const bool own = launch.kind == Blocks::cluster && near_once(sizeof(T));
  arena.place(s.weights, own ? 0 : teams * plan.blocks * pair_weights * pair_lanes);
  arena.place(s.pieces, teams * launch.patches * plan.pieces);
  arena.place(s.part_sum, teams * count_rows(plan) * PartSums::count);
  s.forces = arrange_contact_forces(arena, step, teams);
  return s;
}

template <class T>
std::int64_t fused_bytes(const DeviceStep<T>& step) {
  if constexpr (sizeof(T) == 4 && !has_poisson_ratio)
    if (takes_small_batch(step)) return small_batch_bytes(step);
  Arena arena(nullptr);
  arrange(arena, step, FusedLaunch<T>(step));
  return arena.size();
}

template <class T>
void run_fused(const DeviceStep<T>& step, void* memory, Stream to) {
  if constexpr (sizeof(T) == 4 && !has_poisson_ratio)
    if (takes_small_batch(step)) return run_small_batch(step, memory, to);
  const auto stream = static_cast<cudaStream_t>(to);
  const FusedLaunch<T> launch(step);
  Arena arena(memory);
  FusedCall<T> call{step, arrange(arena, step, launch), launch.teams, launch.kept};
  void* arguments[] = {&call};
  const unsigned blocks = unsigned(launch.teams) * unsigned(launch.patches);
  if (launch.kind == Blocks::one) {
    check(cudaLaunchKernel(launch.function(), dim3(blocks), dim3(launch.threads), arguments,
                           launch.shared, stream));
    return;
  }
  const auto* begin = reinterpret_cast<const std::byte*>(call.scratch.messages);
  const auto* end = reinterpret_cast<const std::byte*>(call.scratch.vertex[0]);
  if (begin != end) check(cudaMemsetAsync(call.scratch.messages, 0, end - begin, stream));
  pd::launch(launch.function(), blocks, launch.threads, arguments, launch.shared,
             launch.kind == Blocks::cluster ? launch.patches : 0, stream);
}

}  // namespace pd::inline PD_TARGET
