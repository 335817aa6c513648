// Iterations of solver/conjugate.h on any plan: products by the kernels of fields.cuh, and a block an environment for the rest.
#pragma once
#include "cuda/fields.cuh"
#include "solver/conjugate.h"

namespace pd {

constexpr int conjugate_threads = 512;

template <class T>
struct ConjugateWork {
  DeviceConjugate<T> call;
  FieldWork<T> product;  // of the direction, into an image
  T* image;              // [batch, vertices, 3]
};

// Sums of a block, the same in all threads. `warp_sums` is free again when it returns.
template <int Count>
__device__ void add_across_block(double (&sum)[Count],
                                 double (&warp_sums)[conjugate_threads / warp_size][2]) {
  add_across_warp(sum);
  const int warp = int(threadIdx.x) / warp_size, lane = int(threadIdx.x) % warp_size;
  if (lane == 0) {
    for (int n = 0; n < Count; ++n) warp_sums[warp][n] = sum[n];
  }
  __syncthreads();
  for (int n = 0; n < Count; ++n) {
    sum[n] = 0;
    for (int w = 0; w < conjugate_threads / warp_size; ++w) sum[n] += warp_sums[w][n];
  }
  __syncthreads();
}

// Environments that have not begun get their first direction.
template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    conjugate_begin(const __grid_constant__ DeviceConjugate<T> call) {
  __shared__ double warp_sums[conjugate_threads / warp_size][2];
  const std::int64_t environment = blockIdx.x;
  double* progress = call.progress + environment * progress_count;
  Conjugate numbers(progress);
  if (!numbers.begins) return;
  const int vertices = call.plan.vertices;
  const T* inverse = call.inverse.of(environment);
  double sums[2] = {0, 0};
  for (int i = threadIdx.x; i < vertices; i += conjugate_threads) {
    const std::int64_t at = 3 * (environment * vertices + i);
    const Vec3<T> right = read3(call.residual + at);
    write3(call.direction + at, inverse[i] * right);
    const double square = double(dot(right, right));
    sums[0] += square;
    sums[1] += double(inverse[i]) * square;
  }
  add_across_block(sums, warp_sums);
  numbers.begin(sums[0], sums[1]);
  if (threadIdx.x == 0) numbers.write(progress);
}

template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    conjugate_update(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ double warp_sums[conjugate_threads / warp_size][2];
  const DeviceConjugate<T>& call = work.call;
  const std::int64_t environment = blockIdx.x;
  double* progress = call.progress + environment * progress_count;
  Conjugate numbers(progress);
  if (!numbers.active) return;
  const int vertices = call.plan.vertices;
  const std::int64_t first = environment * vertices;
  const T *inertia = call.inertia.of(environment), *inverse = call.inverse.of(environment);

  double curvature[1] = {0};
  for (int i = threadIdx.x; i < vertices; i += conjugate_threads) {
    const std::int64_t at = 3 * (first + i);
    const Vec3<T> direction = read3(call.direction + at);
    const Vec3<T> image =
        conjugate_image(read3(work.image + at), direction, inertia[i], inverse[i] != T(0),
                        call.projector ? call.projector + 3 * at : nullptr);
    write3(work.image + at, image);
    curvature[0] += double(dot(direction, image));
  }
  add_across_block(curvature, warp_sums);

  const T step = T(numbers.step(curvature[0]));
  double sums[2] = {0, 0};  // |r|^2, r . r / D
  if (numbers.active) {
    for (int i = threadIdx.x; i < vertices; i += conjugate_threads) {
      const std::int64_t at = 3 * (first + i);
      const Vec3<T> direction = read3(call.direction + at);
      write3(call.solution + at, multiply_add(step, direction, read3(call.solution + at)));
      const Vec3<T> rest =
          subtract_product(read3(call.residual + at), step, read3(work.image + at));
      write3(call.residual + at, rest);
      const double square = double(dot(rest, rest));
      sums[0] += square;
      sums[1] += double(inverse[i]) * square;
    }
    add_across_block(sums, warp_sums);
    const T keep = T(numbers.keep(sums[0], sums[1], call.tolerance));
    for (int i = threadIdx.x; i < vertices; i += conjugate_threads) {
      const std::int64_t at = 3 * (first + i);
      const Vec3<T> direction = read3(call.direction + at);
      write3(call.direction + at,
             multiply_add(keep, direction, inverse[i] * read3(call.residual + at)));
    }
  }
  // all have read what there was
  if (threadIdx.x == 0) numbers.write(progress);
}

template <class T>
ConjugateWork<T> arrange(Arena& arena, const DeviceConjugate<T>& call) {
  DeviceField<T> field;
  field.plan = call.plan;
  field.field = Field::hessian_product;
  field.stiffness = call.stiffness;
  field.batch = call.batch;
  field.positions = call.positions;
  field.direction = call.direction;
  T* image = nullptr;
  arena.place(image, call.batch * call.plan.vertices * 3);
  field.out = image;
  return {call, arrange(arena, field), image};
}

template <class T>
std::int64_t conjugate_bytes(const DeviceConjugate<T>& call) {
  Arena arena(nullptr);
  arrange(arena, call);
  return arena.size();
}

template <bool Computed, class T>
void run_conjugate_with(const ConjugateWork<T>& work, cudaStream_t stream) {
  weigh_field<Computed>(work.product, stream);
  conjugate_begin<T><<<blocks_of(work.call.batch), conjugate_threads, 0, stream>>>(work.call);
  check(cudaGetLastError());
  for (int k = 0; k < work.call.iterations; ++k) {
    run_vertices<Computed, SolidHessian, 2, 3>(work.product, stream);
    conjugate_update<T><<<blocks_of(work.call.batch), conjugate_threads, 0, stream>>>(work);
    check(cudaGetLastError());
  }
}

template <class T>
void run_conjugate(const DeviceConjugate<T>& call, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  Arena arena(memory);
  const ConjugateWork<T> work = arrange(arena, call);
  if (call.plan.kernel == int(DeviceKernel::block)) {
    run_conjugate_with<false>(work, stream);
  } else {
    run_conjugate_with<true>(work, stream);
  }
}

}  // namespace pd
