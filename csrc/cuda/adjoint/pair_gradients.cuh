// Runs solver/adjoint/pair_gradients.h, one block per environment.
#pragma once
#include "cuda/adjoint/body_pairs.cuh"
#include "cuda/common/launch.h"
#include "solver/adjoint/pair_gradients.h"

namespace pd::inline PD_TARGET {

constexpr int pair_threads = 256;

template <class T>
struct PairGradientsWork {
  PairGradientsCall<T> call;
  PairArena arena;
  T* inverse;          // [teams, vertices]
  Vec3<double>* left;  // [teams, vertices]
};

template <class T>
__global__ void __launch_bounds__(pair_threads)
    pair_gradients(const __grid_constant__ PairGradientsWork<T> work) {
  __shared__ PairPlaces places;
  if (threadIdx.x == 0) {
    Arena arena(work.arena.memory + work.arena.stride * blockIdx.x);
    PairArena::arrange(arena, work.call.pairs, places.memory, places.factors);
  }
  __syncthreads();
  BlockTeam block(0, 1, nullptr);
  const PairTeam team(block);
  const std::int64_t first = std::int64_t(work.call.vertices) * blockIdx.x;
  for (std::int64_t e = blockIdx.x; e < work.call.batch; e += gridDim.x) {
    differentiate_pairs(
        work.call, team, places.memory, work.inverse + first, work.left + first,
        [&](std::int64_t, std::int64_t) { return places.factors; }, e);
    __syncthreads();
  }
}

template <class T>
int blocks_of_pairs(const PairGradientsCall<T>& call) {
  const int resident =
      resident_blocks(reinterpret_cast<const void*>(pair_gradients<T>), pair_threads, 0);
  return int(std::min({call.batch, std::int64_t(resident), most_teams(call.pairs)}));
}

template <class T>
PairGradientsWork<T> arrange(Arena& arena, const PairGradientsCall<T>& call, int blocks) {
  PairGradientsWork<T> work{call, {nullptr, bytes_of_pairs(call.pairs)}, nullptr, nullptr};
  arena.place(work.arena.memory, blocks * work.arena.stride);
  arena.place(work.inverse, std::int64_t(blocks) * call.vertices);
  arena.place(work.left, std::int64_t(blocks) * call.vertices);
  return work;
}

template <class T>
std::int64_t pair_gradients_bytes(const PairGradientsCall<T>& call) {
  Arena arena(nullptr);
  arrange(arena, call, blocks_of_pairs(call));
  return arena.size();
}

template <class T>
void run_pair_gradients(const PairGradientsCall<T>& call, void* memory, Stream to) {
  Arena arena(memory);
  const int blocks = blocks_of_pairs(call);
  const PairGradientsWork<T> work = arrange(arena, call, blocks);
  pair_gradients<T><<<blocks, pair_threads, 0, static_cast<cudaStream_t>(to)>>>(work);
  check(cudaGetLastError());
}

}  // namespace pd::inline PD_TARGET
