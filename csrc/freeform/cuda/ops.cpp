// The ops of freeform patches on CUDA. Torch provides memory, stream and device.
#include "freeform/binding/ops.h"

#include "freeform/cuda/tasks.h"

#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

namespace pd::freeform {
namespace {

struct Cuda {
  template <class Task>
  static void run(const Task& task, std::int64_t count, const Tensor& like) {
    const c10::cuda::CUDAGuard guard(like.device());
    run_task(task, count, c10::cuda::getCurrentCUDAStream().stream());
  }
};

}  // namespace

TORCH_LIBRARY_IMPL(torchpd, CUDA, m) { register_ops<Cuda>(m); }

}  // namespace pd::freeform
