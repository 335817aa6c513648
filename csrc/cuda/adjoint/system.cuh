// Kernels of solver/adjoint/system.h and solver/adjoint/contact_gradients.h.
#pragma once
#include "cuda/adjoint/sums.cuh"
#include "solver/adjoint/contact_gradients.h"
#include "solver/adjoint/system.h"

namespace pd::inline PD_TARGET {

// Calls visit(vertex), one thread per vertex.
template <class T, class Visit>
PD_DEVICE void visit_adjoint_vertex(const DeviceAdjointSystem<T>& call, const Visit& visit) {
  const DevicePlan<T>& plan = call.plan;
  const std::int64_t number = std::int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (number >= call.batch * plan.vertices) return;
  const std::int64_t environment = number / plan.vertices;
  const int internal = int(number % plan.vertices);
  const int pin = plan.pins ? plan.vertex_pin[internal] : -1;
  visit(AdjointVertex<T, DevicePlan<T>>{call, environment, plan.vertex_order[internal], pin});
}

template <class T>
__global__ void __launch_bounds__(field_threads)
    adjoint_system(const __grid_constant__ DeviceAdjointSystem<T> call) {
  visit_adjoint_vertex(call, [](const auto& vertex) { vertex.write_system(); });
}

template <class T>
__global__ void __launch_bounds__(field_threads)
    contact_gradients(const __grid_constant__ DeviceContactGradients<T> call) {
  visit_adjoint_vertex(call.step,
                       [&](const auto& vertex) { ContactGradients(call, vertex).differentiate(); });
}

template <class T>
__global__ void __launch_bounds__(field_threads)
    adjoint_result(const __grid_constant__ AdjointResultCall<T> call) {
  const std::int64_t number = std::int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (number >= call.batch * call.vertices) return;
  AdjointResult<T>{call, number / call.vertices, number % call.vertices}.write();
}

// One block per component and environment.
template <class T>
__global__ void __launch_bounds__(field_threads)
    vertex_sum(const __grid_constant__ VertexSumCall<T> call) {
  __shared__ WarpSums warp_sums;
  const std::int64_t environment = blockIdx.x / call.numbers, number = blockIdx.x % call.numbers;
  const T* from = call.values + environment * call.vertices * call.numbers + number;
  double sum[1] = {0};
  for (std::int64_t i = threadIdx.x; i < call.vertices; i += blockDim.x)
    sum[0] += double(from[i * call.numbers]);
  block_reduce<Add>(sum, warp_sums);
  if (threadIdx.x == 0) call.out[blockIdx.x] = T(sum[0]);
}

template <class Call>
void run_for_each(void (*kernel)(Call), const Call& call, std::int64_t count, Stream to) {
  const std::int64_t blocks = (count + field_threads - 1) / field_threads;
  kernel<<<blocks_of(blocks), field_threads, 0, static_cast<cudaStream_t>(to)>>>(call);
  check(cudaGetLastError());
}

template <class T>
void run_adjoint_system(const DeviceAdjointSystem<T>& call, Stream to) {
  run_for_each(adjoint_system<T>, call, call.batch * call.plan.vertices, to);
}

template <class T>
void run_contact_gradients(const DeviceContactGradients<T>& call, Stream to) {
  run_for_each(contact_gradients<T>, call, call.step.batch * call.step.plan.vertices, to);
}

template <class T>
void run_vertex_sum(const VertexSumCall<T>& call, Stream to) {
  const unsigned blocks = blocks_of(call.batch * call.numbers);
  vertex_sum<T><<<blocks, field_threads, 0, static_cast<cudaStream_t>(to)>>>(call);
  check(cudaGetLastError());
}

template <class T>
void run_adjoint_result(const AdjointResultCall<T>& call, Stream to) {
  run_for_each(adjoint_result<T>, call, call.batch * call.vertices, to);
}

}  // namespace pd::inline PD_TARGET
