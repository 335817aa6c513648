// The kernel for several environments a block and its launch.
#pragma once
#include "cuda/arena.h"
#include "cuda/launch.h"
#include "cuda/runtime.h"
#include "cuda/several_rigid.h"
#include "cuda/several_shape.h"

#include <algorithm>

namespace pd {

template <class T, bool Touching, bool Loose, bool Once, bool Lean>
__global__ void __launch_bounds__(Lean ? lean_threads : several_threads, 1)
    several_step(const __grid_constant__ SeveralCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  SeveralRunner<T, Touching, Loose, Once, Lean> runner(call, shared);
  const auto begin = [&](std::int64_t block, std::int64_t each, std::int64_t before) {
    return min(before + block * each, call.step.batch);
  };
  // so many to every block, as often as there are as many, then what is left in equal parts
  const std::int64_t blocks = gridDim.x, wave = blocks * call.together;
  for (std::int64_t before = 0; before < call.step.batch; before += wave) {
    const std::int64_t left = min(call.step.batch - before, wave);
    const std::int64_t each = (left + blocks - 1) / blocks;
    const std::int64_t first = begin(blockIdx.x, each, before);
    const std::int64_t here = begin(blockIdx.x + 1, each, before) - first;
    if (here > 0) runner.roll(first, int(here));
  }
}

template <class T>
struct SeveralLaunch {
  SeveralShape shape;
  void (*kernel)(SeveralCall<T>);
  int blocks;
  std::size_t shared;
  // that device memory is for: with any batch no more than a large one has at work
  std::int64_t environments;

  explicit SeveralLaunch(const DeviceStep<T>& step) {
    const SmallMesh mesh{step.plan.most_pairs, step.plan.most_slots};
    const Room room{multiprocessors(), shared_memory_per_multiprocessor(),
                    shared_memory_per_block()};
    const auto bytes = [&](int together) { return SeveralLayout<T>(step, together).bytes; };
    shape = several_shape(mesh, step.batch, room, bytes);
    shared = bytes(shape.together);
    kernel = touches(step)     ? kernel_for<true, true>(mesh)
             : has_loose(step) ? kernel_for<false, true>(mesh)
                               : kernel_for<false, false>(mesh);
    const int resident = resident_blocks(function(), shape.threads, shared);
    if (resident == 0) refuse_shared_memory(shared);
    const std::int64_t most = most_at_work(mesh, room, bytes), together = shape.together;
    const std::int64_t wanted = (step.batch + together - 1) / together;
    blocks = int(std::min({wanted, std::int64_t(resident), most / together}));
    environments = std::min(wanted * together, most);
  }

  const void* function() const { return reinterpret_cast<const void*>(kernel); }

  SeveralCall<T> call(const DeviceStep<T>& step, const SeveralScratch<T>& scratch) const {
    return {step,
            scratch,
            shape.together,
            Stride(shape.threads, step.plan.most_pairs),
            Stride(shape.threads, step.plan.most_slots),
            T(step.settings.relaxation)};
  }

 private:
  template <bool Touching, bool Loose>
  auto kernel_for(const SmallMesh& mesh) const {
    if (!shape.once(mesh)) return several_step<T, Touching, Loose, false, false>;
    return shape.lean ? several_step<T, Touching, Loose, true, true>
                      : several_step<T, Touching, Loose, true, false>;
  }
};

// Few pairs, whose vertices all fit the shared memory of a block. The batch does not enter: the bits are those of this kernel.
template <class T>
bool takes_several(const DeviceStep<T>& step) {
  return step.plan.kernel == int(DeviceKernel::block) &&
         step.plan.most_pairs <= most_sharing_pairs &&
         SeveralLayout<T>(step, 1).bytes <= shared_memory_per_block();
}

template <class T>
SeveralScratch<T> arrange(Arena& arena, const DeviceStep<T>& step, const SeveralLaunch<T>& launch) {
  const DevicePlan<T>& plan = step.plan;
  const std::int64_t many = launch.environments;
  SeveralScratch<T> s;
  arena.place(s.x, many * plan.slots);
  arena.place(s.velocity, many * plan.slots);
  arena.place(s.weights, many * plan.blocks * 2 * pair_lanes);
  arena.place(s.pieces, many * plan.pieces);
  arena.place(s.part_sum, many * plan.parts * PartSums::count);
  return s;
}

template <class T>
std::int64_t several_bytes(const DeviceStep<T>& step) {
  Arena arena(nullptr);
  arrange(arena, step, SeveralLaunch<T>(step));
  return arena.size();
}

template <class T>
void run_several(const DeviceStep<T>& step, void* memory, Stream stream) {
  const SeveralLaunch<T> launch(step);
  Arena arena(memory);
  SeveralCall<T> call = launch.call(step, arrange(arena, step, launch));
  void* arguments[] = {&call};
  check(cudaLaunchKernel(launch.function(), dim3(unsigned(launch.blocks)),
                         dim3(unsigned(launch.shape.threads)), arguments, launch.shared,
                         static_cast<cudaStream_t>(stream)));
}

}  // namespace pd
