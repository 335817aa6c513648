// Iterations of solver/conjugate.h. Where a block has a mesh in its shared memory it does all of them; on any other plan the
// kernels of fields.cuh make the products, and a block an environment does the rest, or where that has many vertices one for
// each thousand of them.
#pragma once
#include "cuda/fields.cuh"
#include "solver/conjugate.h"

#include <algorithm>

namespace pd {

constexpr int conjugate_threads = 512;
constexpr int chunk_vertices = 1024;  // of a block, of an environment that has several

template <class T>
struct ConjugateWork {
  DeviceConjugate<T> call;
  FieldWork<T> product;  // of the direction, into an image
  T* image;              // [batch, vertices, 3]
  double* curvature;     // [batch, chunks] of d . H d
  double* squares;       // [batch, chunks, 2] of |r|^2 and r . r / D
  double* begun;         // [batch, progress_count] as an iteration began

  PD_HD int chunks() const { return (call.plan.vertices + chunk_vertices - 1) / chunk_vertices; }
};

using WarpSums = double[conjugate_threads / warp_size][2];

// Sums of a block, the same in all threads. `warp_sums` is free again when it returns.
template <int Count>
__device__ void add_across_block(double (&sum)[Count], WarpSums& warp_sums) {
  add_across_warp(sum);
  const int warp = int(threadIdx.x) / warp_size, lane = int(threadIdx.x) % warp_size;
  if (lane == 0) {
    for (int n = 0; n < Count; ++n) warp_sums[warp][n] = sum[n];
  }
  __syncthreads();
  for (int n = 0; n < Count; ++n) {
    sum[n] = 0;
    for (int w = 0; w < int(blockDim.x) / warp_size; ++w) sum[n] += warp_sums[w][n];
  }
  __syncthreads();
}

// In float64, where a product of any two numbers has room.
template <class T>
__device__ double wide_dot(const Vec3<T>& a, const Vec3<T>& b) {
  return double(a.x) * double(b.x) + double(a.y) * double(b.y) + double(a.z) * double(b.z);
}

// The first direction of a vertex, 1 / D times the right side; adds to |b|^2 and b . b / D, to the first also zero, which is
// no number where something is infinite or none.
template <class T>
__device__ void begin_vertex(const DeviceConjugate<T>& call, std::int64_t at, T inverse,
                             double (&sums)[2]) {
  const Vec3<T> right = read3(call.residual + at);
  const T none(0);
  write3(call.direction + at, inverse * right);
  write3(call.solution + at, {none, none, none});
  const Vec3<T> lost = multiply_add(none, read3(call.positions + at), none * right);
  const double square = wide_dot(right, right);
  sums[0] += square + double(lost.x + lost.y + lost.z);
  sums[1] += double(inverse) * square;
}

// The product with a direction, kept for `move_vertex`; adds to the curvature along it.
template <class T>
__device__ void look_along(const ConjugateWork<T>& work, std::int64_t at, const Vec3<T>& elastic,
                           const Vec3<T>& direction, T inertia, T inverse, double (&sum)[1]) {
  const T* projector = work.call.projector;
  const Vec3<T> image = conjugate_image(elastic, direction, inertia, inverse != T(0),
                                        projector ? projector + 3 * at : nullptr);
  write3(work.image + at, image);
  sum[0] += wide_dot(direction, image);
}

// Goes along a direction; adds to |r|^2 and r . r / D.
template <class T>
__device__ void move_vertex(const ConjugateWork<T>& work, std::int64_t at, T step,
                            const Vec3<T>& direction, T inverse, double (&sums)[2]) {
  const DeviceConjugate<T>& call = work.call;
  write3(call.solution + at, multiply_add(step, direction, read3(call.solution + at)));
  const Vec3<T> rest = subtract_product(read3(call.residual + at), step, read3(work.image + at));
  write3(call.residual + at, rest);
  const double square = wide_dot(rest, rest);
  sums[0] += square;
  sums[1] += double(inverse) * square;
}

// Environments that have not begun get their first direction.
template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    conjugate_begin(const __grid_constant__ DeviceConjugate<T> call) {
  __shared__ WarpSums warp_sums;
  const std::int64_t environment = blockIdx.x;
  double* progress = call.progress + environment * progress_count;
  Conjugate numbers(progress);
  if (!numbers.begins) return;
  const int vertices = call.plan.vertices;
  const T* inverse = call.inverse.of(environment);
  double sums[2] = {0, 0};
  for (int i = threadIdx.x; i < vertices; i += conjugate_threads)
    begin_vertex(call, 3 * (environment * vertices + i), inverse[i], sums);
  add_across_block(sums, warp_sums);
  numbers.begin(sums[0], sums[1]);
  if (threadIdx.x == 0) numbers.write(progress);
}

template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    conjugate_update(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ WarpSums warp_sums;
  const DeviceConjugate<T>& call = work.call;
  const std::int64_t environment = blockIdx.x;
  double* progress = call.progress + environment * progress_count;
  Conjugate numbers(progress);
  if (!numbers.active) return;
  const T *inertia = call.inertia.of(environment), *inverse = call.inverse.of(environment);
  // visit(vertex, where its vectors are)
  const auto each_vertex = [&](const auto& visit) {
    for (int i = threadIdx.x; i < call.plan.vertices; i += conjugate_threads)
      visit(i, 3 * (environment * call.plan.vertices + i));
  };
  double curvature[1] = {0};
  each_vertex([&](int i, std::int64_t at) {
    look_along(work, at, read3(work.image + at), read3(call.direction + at), inertia[i], inverse[i],
               curvature);
  });
  add_across_block(curvature, warp_sums);
  const T step = T(numbers.step(curvature[0]));
  if (numbers.active) {
    double sums[2] = {0, 0};
    each_vertex([&](int i, std::int64_t at) {
      move_vertex(work, at, step, read3(call.direction + at), inverse[i], sums);
    });
    add_across_block(sums, warp_sums);
    const T keep = T(numbers.keep(sums[0], sums[1], call.tolerance));
    each_vertex([&](int i, std::int64_t at) {
      write3(call.direction + at, multiply_add(keep, read3(call.direction + at),
                                               inverse[i] * read3(call.residual + at)));
    });
  }
  // all have read what there was
  if (threadIdx.x == 0) numbers.write(progress);
}

// A block's part of an environment that has several: its vertices, and sums of all parts in their order.
template <class T>
struct Chunk {
  const ConjugateWork<T>& work;
  std::int64_t environment;
  int number;

  __device__ explicit Chunk(const ConjugateWork<T>& w)
      : work(w), environment(blockIdx.x / w.chunks()), number(int(blockIdx.x % w.chunks())) {}

  __device__ double* progress() const { return work.call.progress + environment * progress_count; }
  __device__ double* begun() const { return work.begun + environment * progress_count; }
  __device__ bool leads() const { return number == 0 && threadIdx.x == 0; }

  // visit(vertex, where its vectors are)
  template <class Visit>
  __device__ void each_vertex(const Visit& visit) const {
    const int first = number * chunk_vertices, vertices = work.call.plan.vertices;
    const int end = min(first + chunk_vertices, vertices);
    for (int i = first + int(threadIdx.x); i < end; i += conjugate_threads)
      visit(i, 3 * (environment * vertices + i));
  }

  // of this part, for others
  template <int Count>
  __device__ void leave(double (&sum)[Count], double* sums, WarpSums& warp_sums) const {
    add_across_block(sum, warp_sums);
    if (threadIdx.x != 0) return;
    for (int n = 0; n < Count; ++n) sums[int(blockIdx.x) * std::int64_t(Count) + n] = sum[n];
  }
  template <int Count>
  __device__ void add_up(double (&sum)[Count], const double* sums, WarpSums& warp_sums) const {
    for (int n = 0; n < Count; ++n) sum[n] = 0;
    for (int part = threadIdx.x; part < work.chunks(); part += conjugate_threads) {
      for (int n = 0; n < Count; ++n)
        sum[n] += sums[(environment * work.chunks() + part) * Count + n];
    }
    add_across_block(sum, warp_sums);
  }
};

// As conjugate_begin, of a part; what comes of all of them conjugate_begun writes, one thread block an environment.
template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    chunk_begin(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ WarpSums warp_sums;
  const Chunk<T> chunk(work);
  if (!Conjugate(chunk.progress()).begins) return;
  const T* inverse = work.call.inverse.of(chunk.environment);
  double sums[2] = {0, 0};
  chunk.each_vertex([&](int i, std::int64_t at) { begin_vertex(work.call, at, inverse[i], sums); });
  chunk.leave(sums, work.squares, warp_sums);
}

template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    chunk_begun(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ WarpSums warp_sums;
  Chunk<T> all(work);
  all.environment = blockIdx.x;
  double* progress = all.progress();
  Conjugate numbers(progress);
  if (!numbers.begins) return;
  double sums[2];
  all.add_up(sums, work.squares, warp_sums);
  numbers.begin(sums[0], sums[1]);
  if (threadIdx.x == 0) numbers.write(progress);
}

// An iteration in three: the curvature along the direction, the way along it, and the next one.
template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    chunk_look(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ WarpSums warp_sums;
  const Chunk<T> chunk(work);
  const DeviceConjugate<T>& call = work.call;
  const Conjugate numbers(chunk.progress());
  if (chunk.leads()) numbers.write(chunk.begun());
  if (!numbers.active) return;
  const T* inertia = call.inertia.of(chunk.environment);
  const T* inverse = call.inverse.of(chunk.environment);
  double curvature[1] = {0};
  chunk.each_vertex([&](int i, std::int64_t at) {
    look_along(work, at, read3(work.image + at), read3(call.direction + at), inertia[i], inverse[i],
               curvature);
  });
  chunk.leave(curvature, work.curvature, warp_sums);
}

template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    chunk_move(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ WarpSums warp_sums;
  const Chunk<T> chunk(work);
  const DeviceConjugate<T>& call = work.call;
  Conjugate numbers(chunk.begun());
  if (!numbers.active) return;
  double curvature[1];
  chunk.add_up(curvature, work.curvature, warp_sums);
  const T step = T(numbers.step(curvature[0]));
  if (!numbers.active) return;
  const T* inverse = call.inverse.of(chunk.environment);
  double sums[2] = {0, 0};
  chunk.each_vertex([&](int i, std::int64_t at) {
    move_vertex(work, at, step, read3(call.direction + at), inverse[i], sums);
  });
  chunk.leave(sums, work.squares, warp_sums);
}

template <class T>
__global__ void __launch_bounds__(conjugate_threads)
    chunk_turn(const __grid_constant__ ConjugateWork<T> work) {
  __shared__ WarpSums warp_sums;
  const Chunk<T> chunk(work);
  const DeviceConjugate<T>& call = work.call;
  Conjugate numbers(chunk.begun());
  if (!numbers.active) return;
  double curvature[1];
  chunk.add_up(curvature, work.curvature, warp_sums);
  numbers.step(curvature[0]);
  if (numbers.active) {
    double sums[2];
    chunk.add_up(sums, work.squares, warp_sums);
    const T keep = T(numbers.keep(sums[0], sums[1], call.tolerance));
    const T* inverse = call.inverse.of(chunk.environment);
    chunk.each_vertex([&](int i, std::int64_t at) {
      write3(call.direction + at, multiply_add(keep, read3(call.direction + at),
                                               inverse[i] * read3(call.residual + at)));
    });
  }
  if (chunk.leads()) numbers.write(chunk.progress());
}

// Threads of a block that has a multiprocessor to itself: as many as there are registers for.
template <class T>
constexpr int alone_threads = sizeof(T) == 4 ? 512 : 256;

// All iterations of an environment, until it is done: no other one enters, and nobody asks in between. A thread has the same
// vertices from the first loop to the last, so what it writes of them in device memory it finds there.
template <class T>
__global__ void __launch_bounds__(alone_threads<T>)
    conjugate_alone(const __grid_constant__ ConjugateWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  __shared__ WarpSums warp_sums;
  const DeviceConjugate<T>& call = work.call;
  const DevicePlan<T>& plan = call.plan;
  const std::int64_t environment = blockIdx.x;
  double* progress = call.progress + environment * progress_count;
  Conjugate numbers(progress);
  if (!numbers.active) return;
  const T *inertia = call.inertia.of(environment), *inverse = call.inverse.of(environment);
  // visit(slot, vertex, where its vectors are)
  const auto each_slot = [&](const auto& visit) {
    for (int s = threadIdx.x; s < plan.slots; s += blockDim.x) {
      const int i = plan.vertex_order[s];
      visit(s, i, 3 * (environment * plan.vertices + i));
    }
  };

  if (numbers.begins) {
    double sums[2] = {0, 0};
    each_slot([&](int, int i, std::int64_t at) { begin_vertex(call, at, inverse[i], sums); });
    add_across_block(sums, warp_sums);
    numbers.begin(sums[0], sums[1]);
  }
  const PatchFields<2, T> fields(work.product.field, shared);
  const auto direction_of = [&](int s) {
    Vec3<T> vectors[2];
    fields(unsigned(8 * s), vectors);
    return vectors[1];
  };
  for (int k = 0; k < call.iterations && numbers.active; ++k) {
    each_pair<2>(fields.patch, fields, rest_of<false>(fields.patch),
                 work.product.weights_of(environment), fields.entries, SolidHessian{});
    __syncthreads();
    double curvature[1] = {0};
    each_slot([&](int s, int i, std::int64_t at) {
      look_along(work, at, sum_entries(fields.entries, plan.slot_row[s]), direction_of(s),
                 inertia[i], inverse[i], curvature);
    });
    add_across_block(curvature, warp_sums);
    const T step = T(numbers.step(curvature[0]));
    if (!numbers.active) break;
    double sums[2] = {0, 0};
    each_slot([&](int s, int i, std::int64_t at) {
      move_vertex(work, at, step, direction_of(s), inverse[i], sums);
    });
    add_across_block(sums, warp_sums);
    const T keep = T(numbers.keep(sums[0], sums[1], call.tolerance));
    each_slot([&](int s, int i, std::int64_t at) {
      fields.both.set_second(
          s, multiply_add(keep, direction_of(s), inverse[i] * read3(call.residual + at)));
    });
    __syncthreads();
  }
  each_slot([&](int s, int, std::int64_t at) { write3(call.direction + at, direction_of(s)); });
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
  ConjugateWork<T> work{call, arrange(arena, field), image, nullptr, nullptr, nullptr};
  const std::int64_t parts = call.batch * work.chunks();
  arena.place(work.curvature, parts);
  arena.place(work.squares, 2 * parts);
  arena.place(work.begun, call.batch * progress_count);
  return work;
}

template <class T>
std::int64_t conjugate_bytes(const DeviceConjugate<T>& call) {
  Arena arena(nullptr);
  arrange(arena, call);
  return arena.size();
}

template <class T>
void run_conjugate_alone(const ConjugateWork<T>& work, cudaStream_t stream) {
  const DevicePlan<T>& plan = work.call.plan;
  weigh_field<false>(work.product, stream);
  const auto kernel = conjugate_alone<T>;
  const std::size_t bytes = pass_shared_bytes(sizeof(T), plan.most_slots, plan.most_entries, 2);
  // Half as many threads where two blocks then share a multiprocessor, which is for many environments. How many there are in
  // this call does not enter, since the threads decide the order of sums.
  const void* function = reinterpret_cast<const void*>(kernel);
  const bool share = plan.environments != 1 && resident_blocks(function, alone_threads<T> / 2,
                                                               bytes) >= 2 * multiprocessors();
  const int most = share ? alone_threads<T> / 2 : alone_threads<T>;
  const int threads = std::min(int(whole_warps(plan.most_pairs)), most);
  if (resident_blocks(function, threads, bytes) == 0) refuse_shared_memory(bytes);
  kernel<<<blocks_of(work.call.batch), threads, bytes, stream>>>(work);
  check(cudaGetLastError());
}

template <class T>
void run_conjugate_together(const ConjugateWork<T>& work, cudaStream_t stream) {
  weigh_field<true>(work.product, stream);
  conjugate_begin<T><<<blocks_of(work.call.batch), conjugate_threads, 0, stream>>>(work.call);
  check(cudaGetLastError());
  for (int k = 0; k < work.call.iterations; ++k) {
    run_vertices<true, SolidHessian, 2, 3>(work.product, stream);
    conjugate_update<T><<<blocks_of(work.call.batch), conjugate_threads, 0, stream>>>(work);
    check(cudaGetLastError());
  }
}

template <class T>
void run_conjugate_in_chunks(const ConjugateWork<T>& work, cudaStream_t stream) {
  const auto run = [&](void (*kernel)(ConjugateWork<T>), std::int64_t blocks) {
    kernel<<<blocks_of(work.call.batch * blocks), conjugate_threads, 0, stream>>>(work);
    check(cudaGetLastError());
  };
  weigh_field<true>(work.product, stream);
  run(chunk_begin<T>, work.chunks());
  run(chunk_begun<T>, 1);
  for (int k = 0; k < work.call.iterations; ++k) {
    run_vertices<true, SolidHessian, 2, 3>(work.product, stream);
    for (const auto kernel : {chunk_look<T>, chunk_move<T>, chunk_turn<T>})
      run(kernel, work.chunks());
  }
}

template <class T>
void run_conjugate(const DeviceConjugate<T>& call, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  Arena arena(memory);
  const ConjugateWork<T> work = arrange(arena, call);
  if (call.plan.kernel == int(DeviceKernel::block)) {
    run_conjugate_alone(work, stream);
  } else if (work.chunks() > 1) {
    run_conjugate_in_chunks(work, stream);
  } else {
    run_conjugate_together(work, stream);
  }
}

}  // namespace pd
