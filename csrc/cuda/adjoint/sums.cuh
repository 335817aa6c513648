// Shared parts of the runners of solver/adjoint/conjugate_gradients.h: float64 sums over a block and a team, and the
// elastic product of an iteration.
#pragma once
#include "cuda/adjoint/energy_fields.cuh"
#include "cuda/common/block_team.h"
#include "solver/adjoint/conjugate_gradients.h"

namespace pd::inline PD_TARGET {

// Threads of a block that has a multiprocessor to itself, limited by registers.
template <class T>
constexpr int conjugate_threads = sizeof(T) == 4 ? 512 : 256;

using WarpSums = double[conjugate_threads<float> / warp_size][2];

struct Max {
  static constexpr double identity = 0;
  // ignores b if it is NaN
  __device__ double operator()(double a, double b) const { return b > a ? b : a; }
};

// Reduces over all threads of a block; all threads get the result. `warp_sums` may be reused on
// return.
template <class Op, int Count>
__device__ void block_reduce(double (&value)[Count], WarpSums& warp_sums) {
  const Op op;
  const int warp = int(threadIdx.x) / warp_size, lane = int(threadIdx.x) % warp_size;
  for (int n = 0; n < Count; ++n) {
    value[n] = warp_reduce(value[n], op);
    if (lane == 0) warp_sums[warp][n] = value[n];
  }
  __syncthreads();
  for (int n = 0; n < Count; ++n) {
    value[n] = Op::identity;
    for (int w = 0; w < int(blockDim.x) / warp_size; ++w) value[n] = op(value[n], warp_sums[w][n]);
  }
  __syncthreads();
}

// Partial sums of an environment: blocks store them, and after a team barrier every block reduces
// them in the same order.
template <class Op, int Count>
struct PartialSums {
  double* values;  // [count, Count]
  int count;

  __device__ void store(int part, double (&value)[Count], WarpSums& warp_sums) const {
    block_reduce<Op>(value, warp_sums);
    if (threadIdx.x != 0) return;
    for (int n = 0; n < Count; ++n) values[part * std::int64_t(Count) + n] = value[n];
  }
  __device__ void reduce(double (&value)[Count], WarpSums& warp_sums) const {
    const Op op;
    for (int n = 0; n < Count; ++n) value[n] = Op::identity;
    for (int part = threadIdx.x; part < count; part += int(blockDim.x)) {
      for (int n = 0; n < Count; ++n)
        value[n] = op(value[n], values[part * std::int64_t(Count) + n]);
    }
    block_reduce<Op>(value, warp_sums);
  }
};

template <class T>
__device__ double wide_dot(const Vec3<T>& a, const Vec3<T>& b) {
  return double(a.x) * double(b.x) + double(a.y) * double(b.y) + double(a.z) * double(b.z);
}

template <class T>
__device__ double largest_of(const Vec3<T>& a) {
  const Max larger;
  return larger(larger(double(absolute(a.x)), double(absolute(a.y))), double(absolute(a.z)));
}

// |b|^2; the added zero terms make it NaN if the right-hand side b or the position is infinite or
// NaN.
template <class T>
__device__ double square_of_right(const Vec3<T>& right, const Vec3<T>& position) {
  const T none(0);
  const Vec3<T> lost = multiply_add(none, position, none * right);
  return wide_dot(right, right) + double(lost.x + lost.y + lost.z);
}

// slide_across of a vertex, whose vectors start at `at`
template <class T>
__device__ const T* across_of(const DeviceConjugate<T>& call, std::int64_t at) {
  return call.sliding ? call.sliding + slide_count * at + 3 * slide_across : nullptr;
}

// The elastic Hessian product with the search direction.
template <class T>
DeviceField<T> conjugate_field(const DeviceConjugate<T>& call) {
  DeviceField<T> field;
  field.plan = call.plan;
  field.field = Field::hessian_product;
  field.stiffness = call.stiffness;
  field.poisson = call.poisson;
  field.batch = call.batch;
  field.positions = call.positions;
  field.direction = call.direction;
  return field;
}

}  // namespace pd::inline PD_TARGET
