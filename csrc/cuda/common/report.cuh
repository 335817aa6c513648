// Kernels of solver/report.h: one block per chunk of vertices, then one block per environment.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/reductions.h"
#include "cuda/common/runtime.h"
#include "solver/report.h"

namespace pd::inline PD_TARGET {

// Sums over a block's threads; thread 0 gets the result.
PD_DEVICE void block_reduce_sums(double (&sum)[report_sums]) {
  constexpr int warps = report_chunk / warp_size;
  __shared__ double warp_sum[warps][report_sums];
  warp_reduce_sums(sum);
  const int warp = threadIdx.x / warp_size, lane = threadIdx.x % warp_size;
  if (lane == 0) {
    for (int s = 0; s < report_sums; ++s) warp_sum[warp][s] = sum[s];
  }
  __syncthreads();
  if (warp != 0) return;
  for (int s = 0; s < report_sums; ++s) sum[s] = lane < warps ? warp_sum[lane][s] : 0;
  warp_reduce_sums(sum);
}

template <class T>
__global__ void __launch_bounds__(report_chunk)
    report_vertices(const __grid_constant__ DeviceReport<T> call) {
  const DevicePlan<T>& plan = call.plan;
  const std::int64_t environment = blockIdx.x / call.chunks();
  const int i = int(blockIdx.x % call.chunks()) * report_chunk + int(threadIdx.x);
  double sum[report_sums] = {};
  if (i < plan.vertices) {
    const int pin = plan.pins ? plan.vertex_pin[i] : -1;
    ReportVertex<T, DevicePlan<T>>{call, environment, plan.vertex_order[i], pin}.add_to(sum);
  }
  block_reduce_sums(sum);
  if (threadIdx.x != 0) return;
  for (int s = 0; s < report_sums; ++s)
    call.sums[std::int64_t(blockIdx.x) * report_sums + s] = sum[s];
}

template <class T>
__global__ void __launch_bounds__(report_chunk)
    report_environments(const __grid_constant__ DeviceReport<T> call) {
  const double* of = call.sums + std::int64_t(blockIdx.x) * call.chunks() * report_sums;
  double sum[report_sums] = {};
  for (int chunk = threadIdx.x; chunk < call.chunks(); chunk += report_chunk) {
    for (int s = 0; s < report_sums; ++s) sum[s] += of[chunk * report_sums + s];
  }
  block_reduce_sums(sum);
  if (threadIdx.x == 0) write_report<T>(sum, call.info + std::int64_t(blockIdx.x) * info_count);
}

template <class T>
void run_report(const DeviceReport<T>& call, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  report_vertices<T><<<blocks_of(call.batch * call.chunks()), report_chunk, 0, stream>>>(call);
  check(cudaGetLastError());
  report_environments<T><<<blocks_of(call.batch), report_chunk, 0, stream>>>(call);
  check(cudaGetLastError());
}

}  // namespace pd::inline PD_TARGET
