// Vertices that patches share, of the kernels for meshes of any size: their forces are what all these patches have of them.
#pragma once
#include "cuda/collect.h"
#include "cuda/stream.h"

namespace pd::inline PD_TARGET {

// Where the forces of patches on a vertex that they share lie, in the order of patches.
struct SharedPlaces {
  int at, end;

  template <class Plan>
  PD_DEVICE SharedPlaces(const Plan& plan, int shared)
      : at(plan.shared_start[shared]), end(plan.shared_start[shared + 1]) {}
};

// Their sum: two at once, since few have more, and more would keep other threads out for want of registers.
template <class T, bool Touching>
PD_DEVICE Vec3<T> shared_force(const StreamWork<T, Touching>& w, SharedPlaces place) {
  constexpr int together = 2;
  Vec3<T> force = {T(0), T(0), T(0)};
#pragma unroll 1
  for (; place.at < place.end; place.at += together) {
    Vec3<T> part[together];
#pragma unroll
    for (int i = 0; i < together; ++i)
      part[i] = vec3(w.shared_force[min(place.at + i, place.end - 1)]);
#pragma unroll
    for (int i = 0; i < together; ++i)
      if (place.at + i < place.end) force = force + part[i];
  }
  return force;
}

// The same by whole warps, which wait for letters of a round where there are any.
template <bool Touching>
PD_DEVICE Vec3<double> await_force(const StreamWork<double, Touching>& w, SharedPlaces place,
                                   unsigned) {
  return shared_force(w, place);
}
template <bool Touching>
PD_DEVICE Vec3<float> await_force(const StreamWork<float, Touching>& w, SharedPlaces place,
                                  unsigned round) {
  constexpr int together = 2;
  const Word* box = w.letters();
  Vec3<float> force = {0, 0, 0};
  do {
    Letter<float> letter[together];
    bool waits;
    do {
#pragma unroll
      for (int i = 0; i < together; ++i)
        letter[i].look(box + place.at + i, place.at + i < place.end);
      waits = false;
#pragma unroll
      for (int i = 0; i < together; ++i)
        waits |= (place.at + i < place.end) & !letter[i].arrived(round);
    } while (__any_sync(whole_warp, waits));
#pragma unroll
    for (int i = 0; i < together; ++i)
      if (place.at + i < place.end) force = force + letter[i].vector();
    place.at += together;
  } while (__any_sync(whole_warp, place.at < place.end));
  return force;
}

// Vertices are in the order of the last patch that has them, so this letter of a block's should come last.
template <bool Touching>
PD_DEVICE void await_last_letter(const StreamWork<float, Touching>& w, int place, unsigned round) {
  Letter<float> letter;
  while (true) {
    letter.look(w.letters() + place, true);
    if (letter.arrived(round)) return;
    __nanosleep(200);
  }
}

// From the L2 cache, see handoff.h; x, which contacts alone want, is of the step's start.
PD_DEVICE Quad<float> fresh(const Quad<float>& item) {
  const float4 f = __ldcg(reinterpret_cast<const float4*>(&item));
  return {f.x, f.y, f.z, f.w};
}
PD_DEVICE Quad<double> fresh(const Quad<double>& item) { return item; }

template <Visit What, class T, bool Touching>
PD_DEVICE typename Vertices<T, Touching>::Seen see_fresh(const StreamWork<T, Touching>& w, int i) {
  if constexpr (What == Visit::weigh) return {};
  const Quad<T> u = fresh(w.v.u[i]), before = fresh(w.v.before[i]), target = fresh(w.v.target[i]);
  return {{vec3(w.v.x[i]), vec3(target), target.w, u.w}, vec3(u), vec3(before)};
}

// Vertices that patches share. As many threads as there can be where 32 registers are enough, since they wait for memory.
//
// With a `round` above 0 it works beside the pipeline of its pass, a block on each multiprocessor, for which that leaves
// registers: it moves its vertices as soon as the letters on them have come. What else it reads is of kernels that had ended
// before any block of the pipeline let it start; what it writes nobody makes use of before it has ended. Its last block waits for
// the pipeline, so that whoever waits for it waits for both.
template <Visit What, class T, bool Touching>
__global__ void __launch_bounds__(shared_threads, sizeof(T) == 4 && !Touching ? 16 : 1)
    stream_shared(const __grid_constant__ StreamCall<T> call, int k, unsigned round) {
  const int blocks = call.shared_blocks(), number = int(blockIdx.x % blocks);
  const StreamWork<T, Touching> w(call, blockIdx.x / blocks);
  const int i = number * shared_threads + int(threadIdx.x), within = min(i, w.plan.shared - 1);
  const SharedPlaces places(w.plan, within);
  if (round == 0 || blockIdx.x == gridDim.x - 1) await_kernel_before();
  if (threadIdx.x == 0) let_next_kernel_start();
  if (skips<What>(w)) return;
  const int vertex = w.plan.patch_vertex[w.plan.patches] + within;
  if constexpr (sizeof(T) == 4) {
    if (round > 0) {
      const int end = min((number + 1) * shared_threads, w.plan.shared);
      if (threadIdx.x == 0) await_last_letter(w, w.plan.shared_start[end] - 1, round);
      __syncthreads();
    }
  }
  const auto seen = see_fresh<What>(w, vertex);
  const double omega = omega_of_pass<What>(w, k);
  const Vec3<T> force = await_force(w, places, round);
  ThreadSums sums = no_sums<What>();
  if (i < w.plan.shared) visit<What>(w, vertex, seen, force, T(omega), sums);
  if (wants_sums<What>(w)) write_sums<What>(sums, w.sum_row(w.plan.patches + number));
}

}  // namespace pd::inline PD_TARGET
