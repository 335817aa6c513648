// The fused kernel and its launch, for one precision.
#pragma once
#include "cuda/arena.h"
#include "cuda/fused_momentum.h"
#include "cuda/launch.h"
#include "cuda/runtime.h"
#include "plan/shared_memory.h"

#include <algorithm>
#include <stdexcept>
#include <string>

namespace pd {

static_assert(sizeof(Control) <= fused_control_bytes);
static_assert(sizeof(Plane<float>) == 5 * sizeof(float) &&
              sizeof(Ball<float>) == 8 * sizeof(float));

template <class T, bool Touching, bool Many, int Threads, int Blocks>
__global__ void __launch_bounds__(Threads, Blocks)
    fused_step(const __grid_constant__ FusedCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  FusedRunner<T, Touching, Many> runner(call, shared);
  const int team = Many ? int(blockIdx.x) / call.step.plan.patches : int(blockIdx.x);
  for (std::int64_t e = team; e < call.step.batch; e += call.teams) runner.roll(e);
}

// of a block that has a multiprocessor to itself
template <class T>
constexpr int most_grid_threads = sizeof(T) == 4 ? 512 : 256;

template <class T>
using FusedKernel = void (*)(FusedCall<T>);

// One environment a multiprocessor has its registers to itself; several small ones share them.
template <class T, bool Touching, bool Many>
FusedKernel<T> fused_kernel_for(int threads) {
  if constexpr (Many) {
    if (threads <= 256) return fused_step<T, Touching, true, 256, 1>;
    return fused_step<T, Touching, true, most_grid_threads<T>, 1>;
  } else if constexpr (sizeof(T) == 8) {
    if (threads <= 128) return fused_step<T, Touching, false, 128, 2>;
    return fused_step<T, Touching, false, 256, 1>;
  } else {
    if (threads <= 128) return fused_step<T, Touching, false, 128, 5>;
    if (threads <= 192) return fused_step<T, Touching, false, 192, 3>;
    if (threads <= 320) return fused_step<T, Touching, false, 320, 2>;
    return fused_step<T, Touching, false, most_threads, 1>;
  }
}

template <class T>
FusedKernel<T> fused_kernel(const DeviceStep<T>& step, int threads) {
  const bool touching = step.material.planes_count + step.material.spheres_count > 0;
  if (step.plan.kernel == int(DeviceKernel::grid))
    return touching ? fused_kernel_for<T, true, true>(threads)
                    : fused_kernel_for<T, false, true>(threads);
  return touching ? fused_kernel_for<T, true, false>(threads)
                  : fused_kernel_for<T, false, false>(threads);
}

// How a call is launched.
template <class T>
struct FusedLaunch {
  FusedKernel<T> kernel;
  int threads, teams, patches;
  std::size_t shared;

  explicit FusedLaunch(const DeviceStep<T>& step);
};

// A multiprocessor has registers for some 640 threads of float32: they are dealt out to as many environments as its shared
// memory holds. The batch does not enter, so that an environment gives the same bits alone and in any batch.
inline int block_threads(std::size_t real, std::size_t shared) {
  const std::size_t together = shared_memory_per_multiprocessor() / (shared + 1024);
  const int threads = together >= 9   ? 64
                      : together >= 4 ? 128
                      : together == 3 ? 192
                      : together == 2 ? 320
                                      : 640;
  return real == 4 ? threads : std::min(threads, 256);
}

// One patch a multiprocessor: a thread for every tetrahedron and slot, as far as there are, and a warp without any to lead.
template <class T>
int grid_threads(int pairs, int slots) {
  const int wanted = std::max(2 * pairs + warp_size, slots);
  return std::clamp((wanted + warp_size - 1) / warp_size * warp_size, 64, most_grid_threads<T>);
}

template <class T>
FusedLaunch<T>::FusedLaunch(const DeviceStep<T>& step) {
  const DevicePlan<T>& plan = step.plan;
  const bool many = plan.kernel == int(DeviceKernel::grid);
  shared = fused_shared_bytes(sizeof(T), plan.most_slots, plan.most_entries,
                              step.material.planes_count, step.material.spheres_count);
  threads =
      many ? grid_threads<T>(plan.most_pairs, plan.most_slots) : block_threads(sizeof(T), shared);
  kernel = fused_kernel(step, threads);
  patches = many ? plan.patches : 1;
  const int resident = resident_blocks(reinterpret_cast<const void*>(kernel), threads, shared);
  if (resident < patches)
    throw std::runtime_error(
        "torchpd: this device runs " + std::to_string(resident) + " blocks of " +
        std::to_string(shared) + " bytes of shared memory at once, and the plan has " +
        std::to_string(patches) + " patches; build the simulator with kernel=\"stream\"");
  teams = int(std::min<std::int64_t>(step.batch, resident / patches));
}

template <class T>
FusedScratch<T> arrange(Arena& arena, const DeviceStep<T>& step, const FusedLaunch<T>& launch) {
  const DevicePlan<T>& plan = step.plan;
  const bool many = step.plan.kernel == int(DeviceKernel::grid);
  const std::int64_t teams = launch.teams, letters = many ? teams * 2 * plan.slots : 0;
  FusedScratch<T> s;
  // what must start as zero comes first
  arena.place(s.letters, letters * Letter<T>::words);
  arena.place(s.sums, many ? teams * 2 * plan.patches * sums_count : 0);
  for (Quad<T>** array : {&s.x, &s.velocity, &s.target, &s.origin, &s.before})
    arena.place(*array, teams * plan.slots);
  arena.place(s.u, many ? teams * plan.slots : 0);
  arena.place(s.weights, teams * plan.blocks * 2 * pair_lanes);
  arena.place(s.shift, teams * launch.patches * plan.pieces);
  arena.place(s.part_sum, teams * plan.parts * 4);
  return s;
}

template <class T>
std::int64_t fused_bytes(const DeviceStep<T>& step) {
  Arena arena(nullptr);
  arrange(arena, step, FusedLaunch<T>(step));
  return arena.size();
}

template <class T>
void run_fused(const DeviceStep<T>& step, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  const FusedLaunch<T> launch(step);
  Arena arena(memory);
  FusedCall<T> call{step, arrange(arena, step, launch), launch.teams};
  void* arguments[] = {&call};
  const dim3 grid(launch.teams * launch.patches), block(launch.threads);
  const void* kernel = reinterpret_cast<const void*>(launch.kernel);
  if (step.plan.kernel == int(DeviceKernel::grid)) {
    const auto* begin = reinterpret_cast<const std::byte*>(call.scratch.letters);
    const auto* end = reinterpret_cast<const std::byte*>(call.scratch.x);
    check(cudaMemsetAsync(call.scratch.letters, 0, end - begin, stream));
    check(cudaLaunchCooperativeKernel(kernel, grid, block, arguments, launch.shared, stream));
  } else {
    check(cudaLaunchKernel(kernel, grid, block, arguments, launch.shared, stream));
  }
}

}  // namespace pd
