// Conjugate gradients of solver/adjoint/conjugate_gradients.h, with an environment's whole mesh in the shared memory
// of one block.
#pragma once
#include "cuda/adjoint/friction_one_block.cuh"
#include "cuda/adjoint/sums.cuh"
#include "solver/adjoint/system.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

template <class T>
struct ConjugateBlock {
  using real = T;
  DeviceConjugate<T> call;
  FieldWork<T> product;  // with the search direction
  T* image;              // [batch, vertices, 3], the product
  FrictionVectors<T> friction;
};

// Writes the elastic product of an environment's direction to the entries.
template <class T>
PD_DEVICE void multiply_elements(const ConjugateBlock<T>& work, const PatchFields<2, T>& fields) {
  each_pair<2>(fields.patch, fields, rest_of<false>(fields.patch),
               work.product.weights_of(blockIdx.x), fields.entries, SolidHessian{});
}

// All iterations of one environment, independent of the others and without host synchronisation. A
// thread keeps its vertices in all loops, so it reads its own writes to global memory.
// `WithFriction`: adds the solve with friction. `Work`: ConjugateBlock, or one that adds to it.
template <class Work, bool WithFriction>
__global__ void __launch_bounds__(conjugate_threads<typename Work::real>)
    conjugate_block(const __grid_constant__ Work work) {
  using T = typename Work::real;
  extern __shared__ __align__(16) std::byte shared[];
  __shared__ WarpSums warp_sums;
  const DeviceConjugate<T>& call = work.call;
  const DevicePlan<T>& plan = call.plan;
  const std::int64_t environment = blockIdx.x;
  double* progress = call.progress + environment * progress_count;
  Conjugate numbers(progress);
  if (!numbers.active) return;
  const T *inertia = call.inertia.of(environment), *inverse = call.inverse.of(environment);
  // visit(slot, vertex, offset of its vectors)
  const auto each_slot = [&](const auto& visit) {
    for (int s = threadIdx.x; s < plan.slots; s += blockDim.x) {
      const int i = plan.vertex_order[s];
      visit(s, i, 3 * (environment * plan.vertices + i));
    }
  };

  // the largest component, and whether any vertex slides
  double largest[2] = {0, 0};
  each_slot([&](int, int, std::int64_t at) {
    largest[0] = Max()(largest[0], largest_of(read3(call.residual + at)));
    if constexpr (WithFriction) {
      if (slides(call.sliding + slide_count * at)) largest[1] = 1;
    }
  });
  block_reduce<Max>(largest, warp_sums);
  const T unit = unit_near(T(largest[0]));
  const auto times = [&](T factor, T* vectors, std::int64_t at) {
    write3(vectors + at, factor * read3(vectors + at));
  };
  each_slot([&](int, int, std::int64_t at) {
    times(T(1) / unit, call.residual, at);
    if (numbers.begins) return;
    times(T(1) / unit, call.solution, at);
    times(T(1) / unit, call.direction, at);
  });
  numbers.scale_by(1 / double(unit));
  if (numbers.begins) {
    double sums[2] = {0, 0};
    each_slot([&](int, int i, std::int64_t at) {
      const Vec3<T> right = read3(call.residual + at);
      write3(call.direction + at, inverse[i] * right);
      write3(call.solution + at, {T(0), T(0), T(0)});
      sums[0] += square_of_right(right, read3(call.positions + at));
      sums[1] += double(inverse[i]) * wide_dot(right, right);
    });
    block_reduce<Add>(sums, warp_sums);
    numbers.begin(sums[0], sums[1]);
  }
  const PatchFields<2, T> fields(work.product.field, shared);
  const auto direction_of = [&](int s) {
    Vec3<T> vectors[2];
    fields(unsigned(8 * s), vectors);
    return vectors[1];
  };
  int products = 0;
  while (products < call.iterations && numbers.active) {
    ++products;
    multiply_elements(work, fields);
    __syncthreads();
    double curvature[1] = {0};
    each_slot([&](int s, int i, std::int64_t at) {
      const Vec3<T> direction = direction_of(s);
      const Vec3<T> image = conjugate_image(
          sum_entries(fields.entries, plan.slot_row[s]), direction, inertia[i], inverse[i] != T(0),
          call.projector ? call.projector + 3 * at : nullptr, across_of(call, at));
      write3(work.image + at, image);
      curvature[0] += wide_dot(direction, image);
    });
    block_reduce<Add>(curvature, warp_sums);
    const T step = T(numbers.step(curvature[0]));
    if (!numbers.active) break;
    double sums[2] = {0, 0};
    each_slot([&](int s, int i, std::int64_t at) {
      write3(call.solution + at, multiply_add(step, direction_of(s), read3(call.solution + at)));
      const Vec3<T> rest =
          subtract_product(read3(call.residual + at), step, read3(work.image + at));
      write3(call.residual + at, rest);
      const double square = wide_dot(rest, rest);
      sums[0] += square;
      sums[1] += double(inverse[i]) * square;
    });
    block_reduce<Add>(sums, warp_sums);
    numbers.check_residual(sums[0], call.tolerance);
    if (!numbers.active) break;
    const T keep = T(numbers.direction_ratio(sums[1]));
    each_slot([&](int s, int i, std::int64_t at) {
      fields.both.set_second(
          s, multiply_add(keep, direction_of(s), inverse[i] * read3(call.residual + at)));
    });
    __syncthreads();
  }
  if constexpr (WithFriction) {
    if (largest[1] > 0 && continues_with_friction(numbers, call.tolerance)) {
      FrictionSolve friction(nullptr, numbers.scale);
      friction.begin(products, adjoint_iterations);
      FrictionBlock<Work>(work, fields, unit, warp_sums).run(friction);
      if (threadIdx.x == 0) friction.write(call.friction + environment * friction_count);
    }
  }
  each_slot([&](int s, int, std::int64_t at) {
    times(unit, call.residual, at);
    times(unit, call.solution, at);
    write3(call.direction + at, unit * direction_of(s));
  });
  numbers.scale_by(double(unit));
  // all threads have read the old progress
  if (threadIdx.x == 0) numbers.write(progress);
}

template <class T>
ConjugateBlock<T> arrange_block(Arena& arena, const DeviceConjugate<T>& call) {
  ConjugateBlock<T> work{call, arrange(arena, conjugate_field(call), 0), nullptr, {}};
  const std::int64_t count = call.batch * call.plan.vertices * 3;
  arena.place(work.image, count);
  FrictionVectors<T>& f = work.friction;
  for (T** array : {&f.shadow, &f.correction, &f.smoothed})
    arena.place(*array, call.friction ? count : 0);
  return work;
}

// `pairs`: of tetrahedra, or items that threads take like them
template <class Work>
void launch_block(const Work& work, int pairs, cudaStream_t stream) {
  using T = typename Work::real;
  const auto kernel =
      work.call.friction ? conjugate_block<Work, true> : conjugate_block<Work, false>;
  const DevicePlan<T>& plan = work.call.plan;
  const std::size_t bytes = pass_shared_bytes(sizeof(T), plan.most_slots, plan.most_entries, 2);
  // Half as many threads if two blocks then share a multiprocessor, unless the plan is for one
  // environment. The batch of this call has no influence, since the number of threads sets the
  // order of sums.
  const void* function = reinterpret_cast<const void*>(kernel);
  const bool share = plan.environments != 1 && resident_blocks(function, conjugate_threads<T> / 2,
                                                               bytes) >= 2 * multiprocessors();
  const int most = share ? conjugate_threads<T> / 2 : conjugate_threads<T>;
  const int threads = std::min(int(whole_warps(pairs)), most);
  if (resident_blocks(function, threads, bytes) == 0) refuse_shared_memory(bytes);
  kernel<<<blocks_of(work.call.batch), threads, bytes, stream>>>(work);
  check(cudaGetLastError());
}

template <class T>
void run_conjugate_block(const DeviceConjugate<T>& call, void* memory, cudaStream_t stream) {
  Arena arena(memory);
  const ConjugateBlock<T> work = arrange_block(arena, call);
  compute_field_weights<false>(work.product, stream);
  launch_block(work, call.plan.most_pairs, stream);
}

}  // namespace pd::inline PD_TARGET
