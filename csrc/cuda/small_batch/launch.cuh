// The small-batch kernel and its launch.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/runtime.h"
#include "cuda/small_batch/block_shape.h"
#include "cuda/small_batch/rigid.h"
#include "views/arena.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
__global__ void __launch_bounds__(FewRegisters ? few_registers_threads : small_batch_threads, 1)
    small_batch_step(const __grid_constant__ SmallBatchCall<T> call) {
  extern __shared__ __align__(16) std::byte shared[];
  SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread, FewRegisters> runner(call, shared);
  const auto begin = [&](std::int64_t block, std::int64_t each, std::int64_t before) {
    return min(before + block * each, call.step.batch);
  };
  // full waves of `per_block` environments per block, then the rest in equal shares
  const std::int64_t blocks = gridDim.x, wave = blocks * call.per_block;
  for (std::int64_t before = 0; before < call.step.batch; before += wave) {
    const std::int64_t left = min(call.step.batch - before, wave);
    const std::int64_t each = (left + blocks - 1) / blocks;
    const std::int64_t first = begin(blockIdx.x, each, before);
    const std::int64_t here = begin(blockIdx.x + 1, each, before) - first;
    if (here > 0) runner.rollout(first, int(here));
  }
}

template <class T>
struct SmallBatchLaunch {
  SmallBatchShape shape;
  void (*kernel)(SmallBatchCall<T>);
  int blocks;
  std::size_t shared;
  // environments with device memory; no batch needs more than a large one keeps resident
  std::int64_t environments;

  explicit SmallBatchLaunch(const DeviceStep<T>& step) {
    const SmallMesh mesh{step.plan.most_pairs, step.plan.most_slots};
    const DeviceLimits limits{multiprocessors(), shared_memory_per_multiprocessor(),
                              shared_memory_per_block()};
    const auto bytes = [&](int per_block) { return SmallBatchLayout<T>(step, per_block).bytes; };
    shape = small_batch_shape(mesh, step.batch, limits, bytes);
    shared = bytes(shape.per_block);
    kernel = has_contacts(step)      ? kernel_for<true, true>(mesh)
             : has_free_pieces(step) ? kernel_for<false, true>(mesh)
                                     : kernel_for<false, false>(mesh);
    const int resident = resident_blocks(function(), shape.threads, shared);
    if (resident == 0) refuse_shared_memory(shared);
    const std::int64_t most = most_at_work(mesh, limits, bytes), per_block = shape.per_block;
    const std::int64_t wanted = (step.batch + per_block - 1) / per_block;
    blocks = int(std::min({wanted, std::int64_t(resident), most / per_block}));
    environments = std::min(wanted * per_block, most);
  }

  const void* function() const { return reinterpret_cast<const void*>(kernel); }

  SmallBatchCall<T> call(const DeviceStep<T>& step, const SmallBatchScratch<T>& scratch) const {
    return {step,
            scratch,
            shape.per_block,
            Stride(shape.threads, step.plan.most_pairs),
            Stride(shape.threads, step.plan.most_slots),
            T(step.settings.relaxation)};
  }

 private:
  template <bool HasContacts, bool HasFreePieces>
  auto kernel_for(const SmallMesh& mesh) const {
    if (!shape.once(mesh)) return small_batch_step<T, HasContacts, HasFreePieces, false, false>;
    return shape.few_registers ? small_batch_step<T, HasContacts, HasFreePieces, true, true>
                               : small_batch_step<T, HasContacts, HasFreePieces, true, false>;
  }
};

// For few pairs, whose vertices all fit in a block's shared memory. The batch has no influence,
// since it would change the bits.
template <class T>
bool takes_small_batch(const DeviceStep<T>& step) {
  return step.plan.kernel == int(DeviceKernel::block) &&
         step.plan.most_pairs <= most_sharing_pairs &&
         SmallBatchLayout<T>(step, 1).bytes <= shared_memory_per_block();
}

template <class T>
SmallBatchScratch<T> arrange(Arena& arena, const DeviceStep<T>& step,
                             const SmallBatchLaunch<T>& launch) {
  const DevicePlan<T>& plan = step.plan;
  const std::int64_t many = launch.environments;
  SmallBatchScratch<T> s;
  arena.place(s.x, many * plan.slots);
  arena.place(s.velocity, many * plan.slots);
  arena.place(s.weights, many * plan.blocks * 2 * pair_lanes);
  arena.place(s.pieces, many * plan.pieces);
  arena.place(s.part_sum, many * count_rows(plan) * PartSums::count);
  s.forces = arrange_contact_forces(arena, step, many);
  return s;
}

template <class T>
std::int64_t small_batch_bytes(const DeviceStep<T>& step) {
  Arena arena(nullptr);
  arrange(arena, step, SmallBatchLaunch<T>(step));
  return arena.size();
}

template <class T>
void run_small_batch(const DeviceStep<T>& step, void* memory, Stream stream) {
  const SmallBatchLaunch<T> launch(step);
  Arena arena(memory);
  SmallBatchCall<T> call = launch.call(step, arrange(arena, step, launch));
  void* arguments[] = {&call};
  check(cudaLaunchKernel(launch.function(), dim3(unsigned(launch.blocks)),
                         dim3(unsigned(launch.shape.threads)), arguments, launch.shared,
                         static_cast<cudaStream_t>(stream)));
}

}  // namespace pd::inline PD_TARGET
