// Update of vertices shared by several patches, for kernel stream. The force on a vertex is the sum
// over its patches.
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/stream/kernels.h"

namespace pd::inline PD_TARGET {

// Range of a shared vertex's forces, in patch order.
struct SharedPlaces {
  int at, end;

  template <class Plan>
  PD_DEVICE SharedPlaces(const Plan& plan, int shared)
      : at(plan.shared_start[shared]), end(plan.shared_start[shared + 1]) {}
};

// Sums the forces, two loads at a time: few vertices have more, and more registers would lower
// occupancy.
template <class T, bool HasContacts>
PD_DEVICE Vec3<T> shared_force(const StreamWork<T, HasContacts>& w, SharedPlaces place) {
  constexpr int in_flight = 2;
  Vec3<T> force = {T(0), T(0), T(0)};
#pragma unroll 1
  for (; place.at < place.end; place.at += in_flight) {
    Vec3<T> part[in_flight];
#pragma unroll
    for (int i = 0; i < in_flight; ++i)
      part[i] = vec3(w.shared_force[min(place.at + i, place.end - 1)]);
#pragma unroll
    for (int i = 0; i < in_flight; ++i)
      if (place.at + i < place.end) force = force + part[i];
  }
  return force;
}

// The same sum by whole warps, which wait for the messages of `round` in float32.
template <bool HasContacts>
PD_DEVICE Vec3<double> wait_for_force(const StreamWork<double, HasContacts>& w, SharedPlaces place,
                                      unsigned) {
  return shared_force(w, place);
}
template <bool HasContacts>
PD_DEVICE Vec3<float> wait_for_force(const StreamWork<float, HasContacts>& w, SharedPlaces place,
                                     unsigned round) {
  constexpr int in_flight = 2;
  const TaggedWord* mailbox = w.messages();
  Vec3<float> force = {0, 0, 0};
  do {
    HaloMessage<float> message[in_flight];
    bool missing;
    do {
#pragma unroll
      for (int i = 0; i < in_flight; ++i)
        message[i].load(mailbox + place.at + i, place.at + i < place.end);
      missing = false;
#pragma unroll
      for (int i = 0; i < in_flight; ++i)
        missing |= (place.at + i < place.end) & !message[i].arrived(round);
    } while (__any_sync(full_warp, missing));
#pragma unroll
    for (int i = 0; i < in_flight; ++i)
      if (place.at + i < place.end) force = force + message[i].vector();
    place.at += in_flight;
  } while (__any_sync(full_warp, place.at < place.end));
  return force;
}

// Vertices are ordered by the last patch that holds them, so this message of a block should arrive
// last.
template <bool HasContacts>
PD_DEVICE void wait_for_last_message(const StreamWork<float, HasContacts>& w, int place,
                                     unsigned round) {
  HaloMessage<float> message;
  while (true) {
    message.load(w.messages() + place, true);
    if (message.arrived(round)) return;
    __nanosleep(200);
  }
}

// Loads through the L2 cache, see kernel_overlap.h. Only contacts read x, which is constant during a step.
PD_DEVICE Quad<float> load_from_l2(const Quad<float>& item) {
  const float4 f = __ldcg(reinterpret_cast<const float4*>(&item));
  return {f.x, f.y, f.z, f.w};
}
PD_DEVICE Quad<double> load_from_l2(const Quad<double>& item) { return item; }

template <Visit What, class T, bool HasContacts>
PD_DEVICE typename Vertices<T, HasContacts>::LoadedVertex load_vertex_from_l2(
    const StreamWork<T, HasContacts>& w, int i) {
  if constexpr (What == Visit::diagonal) return {};
  const Quad<T> u = load_from_l2(w.v.u[i]), before = load_from_l2(w.v.before[i]),
                target = load_from_l2(w.v.target[i]);
  return {{vec3(w.v.x[i]), vec3(target), target.w, u.w}, vec3(u), vec3(before)};
}

// Updates vertices that patches share. With 32 registers per thread, occupancy of iterations is
// highest, which hides the memory latency.
//
// With `round` above 0 the kernel runs beside the pipeline of its pass, which leaves registers for
// one block on each multiprocessor. It updates a vertex as soon as its messages have arrived. Its
// other inputs come from kernels that ended before the pipeline triggered it. No kernel reads its
// results before it ends. Its last block waits for the pipeline, so waiting for this kernel is
// waiting for both.
template <Visit What, class T, bool HasContacts>
__global__ void __launch_bounds__(shared_threads,
                                  sizeof(T) == 4 && !HasContacts && What != Visit::keep_forces ? 16
                                                                                               : 1)
    stream_shared(const __grid_constant__ StreamCall<T> call, int k, unsigned round) {
  const int blocks = call.shared_blocks(), number = int(blockIdx.x % blocks);
  const StreamWork<T, HasContacts> w(call, blockIdx.x / blocks);
  const int i = number * shared_threads + int(threadIdx.x), within = min(i, w.plan.shared - 1);
  const SharedPlaces places(w.plan, within);
  if (round == 0 || blockIdx.x == gridDim.x - 1) wait_for_previous_kernel();
  if (threadIdx.x == 0) launch_dependents();
  if (skips<What>(w)) return;
  const int vertex = w.plan.patch_vertex[w.plan.patches] + within;
  if constexpr (sizeof(T) == 4) {
    if (round > 0) {
      const int end = min((number + 1) * shared_threads, w.plan.shared);
      if (threadIdx.x == 0) wait_for_last_message(w, w.plan.shared_start[end] - 1, round);
      __syncthreads();
    }
  }
  const auto loaded = load_vertex_from_l2<What>(w, vertex);
  const double omega = omega_of_pass<What>(w, k);
  const Vec3<T> force = wait_for_force(w, places, round);
  ThreadSums sums = no_sums<What>();
  if (i < w.plan.shared) visit<What>(w, vertex, loaded, force, T(omega), sums, Iterate(k));
  if (wants_sums<What>(w)) write_sums<What>(sums, w.sum_row(w.plan.patches + number));
}

}  // namespace pd::inline PD_TARGET
