// BiCGStab of solver/adjoint/friction.h, with an environment's whole mesh in the shared memory of
// one block.
#pragma once
#include "cuda/adjoint/sums.cuh"
#include "solver/adjoint/friction.h"

namespace pd::inline PD_TARGET {

// Vectors of BiCGStab, [batch, vertices, 3]; its p is stored in the direction.
template <class T>
struct FrictionVectors {
  T *shadow, *correction, *smoothed;  // smoothed: the second product of an iteration
};

// One environment, with its fields in shared memory. A thread keeps its vertices in all loops.
// `Work`: as for conjugate_block.
template <class Work>
class FrictionBlock {
  using T = typename Work::real;

 public:
  __device__ FrictionBlock(const Work& work, const PatchFields<2, T>& fields, T unit,
                           WarpSums& warp_sums)
      : work_(work),
        call_(work.call),
        v_(work.friction),
        image_(work.image),
        fields_(fields),
        per_unit_(T(1) / unit),
        warp_sums_(warp_sums),
        inertia_(work.call.inertia.of(blockIdx.x)),
        inverse_(work.call.inverse.of(blockIdx.x)) {}

  // Replaces the solution y by the multiplier G^T y.
  __device__ void run(FrictionSolve& friction) const {
    each_slot([&](int, int, std::int64_t at) { write3(v_.correction + at, {T(0), T(0), T(0)}); });
    while (friction.active()) advance(friction);
    each_slot([&](int, int, std::int64_t at) {
      write3(call_.solution + at,
             transposed_friction(read3(call_.solution + at), call_.sliding + slide_count * at));
    });
  }

 private:
  // visit(slot, vertex, offset of its vectors)
  template <class Visit>
  __device__ void each_slot(const Visit& visit) const {
    const DevicePlan<T>& plan = call_.plan;
    for (int s = threadIdx.x; s < plan.slots; s += blockDim.x) {
      const int i = plan.vertex_order[s];
      visit(s, i, 3 * (blockIdx.x * std::int64_t(plan.vertices) + i));
    }
  }

  __device__ Vec3<T> z(FrictionStage stage, int i, std::int64_t at) const {
    if (stage == FrictionStage::residual)
      return read3(call_.solution + at) + read3(v_.correction + at);
    const T* from = stage == FrictionStage::first ? call_.direction : call_.residual;
    return inverse_[i] * read3(from + at);
  }

  __device__ void multiply(FrictionStage stage) const {
    each_slot([&](int s, int i, std::int64_t at) {
      fields_.both.set_second(
          s, transposed_friction(z(stage, i, at), call_.sliding + slide_count * at));
    });
    __syncthreads();
    multiply_elements(work_, fields_);
    __syncthreads();
  }

  __device__ void advance(FrictionSolve& friction) const {
    const FrictionStage stage = friction.stage;
    multiply(stage);
    double sums[2] = {0, 0};
    each_slot([&](int s, int i, std::int64_t at) {
      const Vec3<T> image = friction_image(sum_entries(fields_.entries, call_.plan.slot_row[s]),
                                           z(stage, i, at), inertia_[i], inverse_[i] != T(0),
                                           call_.projector ? call_.projector + 3 * at : nullptr,
                                           call_.sliding + slide_count * at);
      if (stage == FrictionStage::residual) {
        const Vec3<T> rest = per_unit_ * read3(call_.right + at) - image;
        write3(call_.residual + at, rest);
        sums[0] += wide_dot(rest, rest);
      } else if (stage == FrictionStage::first) {
        write3(image_ + at, image);
        sums[0] += wide_dot(read3(v_.shadow + at), image);
      } else {
        write3(v_.smoothed + at, image);
        sums[0] += wide_dot(image, read3(call_.residual + at));
        sums[1] += wide_dot(image, image);
      }
    });
    block_reduce<Add>(sums, warp_sums_);
    if (stage == FrictionStage::residual) return correct(friction, sums[0]);
    const bool first = stage == FrictionStage::first;
    const T step =
        T(first ? friction.search_step(sums[0]) : friction.residual_step(sums[0], sums[1]));
    if (first && friction.stage == FrictionStage::residual) return;
    const T* const product = first ? image_ : v_.smoothed;
    double left[2] = {0, 0};
    each_slot([&](int, int i, std::int64_t at) {
      write3(v_.correction + at, multiply_add(step, z(stage, i, at), read3(v_.correction + at)));
      const Vec3<T> rest = subtract_product(read3(call_.residual + at), step, read3(product + at));
      write3(call_.residual + at, rest);
      left[0] += wide_dot(rest, rest);
      left[1] += wide_dot(read3(v_.shadow + at), rest);
    });
    if (first) return;
    block_reduce<Add>(left, warp_sums_);
    const T keep = T(friction.finish_iteration(left[0], left[1], call_.tolerance));
    each_slot([&](int, int, std::int64_t at) {
      const Vec3<T> last = subtract_product(read3(call_.direction + at), step, read3(image_ + at));
      write3(call_.direction + at, multiply_add(keep, last, read3(call_.residual + at)));
    });
  }

  // Begins a cycle or ends the solve, by the true |r|^2 of y plus its correction.
  __device__ void correct(FrictionSolve& friction, double square) const {
    const bool enters = friction.accept(square, call_.tolerance);
    each_slot([&](int, int, std::int64_t at) {
      if (enters)
        write3(call_.solution + at, read3(call_.solution + at) + read3(v_.correction + at));
      const Vec3<T> rest = read3(call_.residual + at);
      write3(v_.correction + at, {T(0), T(0), T(0)});
      write3(v_.shadow + at, rest);
      write3(call_.direction + at, rest);
    });
  }

  const Work& work_;
  const DeviceConjugate<T>& call_;
  const FrictionVectors<T>& v_;
  T* image_;
  const PatchFields<2, T>& fields_;
  T per_unit_;
  WarpSums& warp_sums_;
  const T *inertia_, *inverse_;
};

}  // namespace pd::inline PD_TARGET
