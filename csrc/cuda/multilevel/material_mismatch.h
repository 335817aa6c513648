// Runs measure_mismatch of solver/multilevel/material_mismatch.h on a GPU.
#pragma once
#include "cuda/multilevel/runner.h"

namespace pd::inline PD_TARGET {

// Called by all threads of a team.
template <class T>
class MismatchRunner {
 public:
  PD_DEVICE MismatchRunner(const StreamWork<T, false>& w, const Moduli<T>& moduli,
                           RatioRange* memory, BlockTeam& team)
      : w_(w), moduli_(moduli), memory_(memory), team_(team) {}

  template <class Visit>
  PD_DEVICE void each_element(const Visit& visit) const {
#pragma unroll 1
    for (int t = team_.thread(); t < w_.plan.tets; t += team_.threads()) {
      if constexpr (has_poisson_ratio) {
        visit(moduli_.lame(t).matrix(), t);
      } else {
        visit(moduli_.youngs[t], t);
      }
    }
  }

  template <class Visit>
  PD_DEVICE void each_vertex(const Visit& visit) const {
#pragma unroll 1
    for (int i = team_.thread(); i < w_.plan.vertices; i += team_.threads())
      visit(i, double(w_.v.inertia(i)));
  }

  PD_DEVICE void reduce(RatioRange (&range)[ranges_count]) {
    __shared__ double least[ranges_count][warp_size], largest[ranges_count][warp_size];
    const int lane = threadIdx.x % warp_size, warp = threadIdx.x / warp_size;
    __syncthreads();  // the previous round has read the shared arrays
    for (int n = 0; n < ranges_count; ++n) {
      const double low = warp_reduce(range[n].least, Min{});
      const double high = -warp_reduce(-range[n].largest, Min{});
      if (lane == 0) {
        least[n][warp] = low;
        largest[n][warp] = high;
      }
    }
    __syncthreads();
    RatioRange* rows = memory_ + (round_++ & 1) * team_.blocks() * ranges_count;
    if (threadIdx.x < ranges_count) {
      RatioRange own;
      for (int w = 0; w < int(blockDim.x) / warp_size; ++w)
        own.add({least[threadIdx.x][w], largest[threadIdx.x][w]});
      rows[team_.rank() * ranges_count + threadIdx.x] = own;
    }
    team_.barrier();
    for (int n = 0; n < ranges_count; ++n) {
      RatioRange all;
      for (int b = lane; b < team_.blocks(); b += warp_size) all.add(rows[b * ranges_count + n]);
      range[n] = {warp_reduce(all.least, Min{}), -warp_reduce(-all.largest, Min{})};
    }
  }

 private:
  const StreamWork<T, false>& w_;
  Moduli<T> moduli_;
  RatioRange* memory_;
  BlockTeam& team_;
  int round_ = 0;
};

}  // namespace pd::inline PD_TARGET
