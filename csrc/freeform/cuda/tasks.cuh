// Runs a task of freeform patches with one thread per item.
#pragma once
#include "cuda/common/runtime.h"
#include "freeform/cuda/tasks.h"

namespace pd::freeform {

constexpr int freeform_threads = 128;

template <class Task>
__global__ void __launch_bounds__(freeform_threads)
    freeform_items(const __grid_constant__ Task task, Index count) {
  const Index i = Index(blockIdx.x) * freeform_threads + threadIdx.x;
  if (i < count) item(task, i);
}

template <class Task>
void launch_items(const Task& task, Index count, Stream to) {
  if (count == 0) return;
  const unsigned blocks = blocks_of((count + freeform_threads - 1) / freeform_threads);
  freeform_items<<<blocks, freeform_threads, 0, static_cast<cudaStream_t>(to)>>>(task, count);
  check(cudaGetLastError());
}

}  // namespace pd::freeform
