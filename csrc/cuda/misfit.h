// How far the material of a step is from that which its preconditioner was made of, see solver/misfit.h.
#pragma once
#include "cuda/multilevel.h"

namespace pd::inline PD_TARGET {

// Ranges of all threads of a team, by rounds.
class Ranges {
 public:
  PD_DEVICE Ranges(Range* memory, BlockTeam& team) : memory_(memory), team_(team) {}

  // All threads; each gets the ranges of all.
  PD_DEVICE void meet(Range (&range)[ranges_count]) {
    __shared__ double least[ranges_count][warp_size], largest[ranges_count][warp_size];
    const int lane = threadIdx.x % warp_size, warp = threadIdx.x / warp_size;
    __syncthreads();  // the shared arrays of the round before have been read
    for (int n = 0; n < ranges_count; ++n) {
      const double low = across_warp(range[n].least, Least{});
      const double high = -across_warp(-range[n].largest, Least{});
      if (lane == 0) {
        least[n][warp] = low;
        largest[n][warp] = high;
      }
    }
    __syncthreads();
    Range* rows = memory_ + (round_++ & 1) * team_.blocks() * ranges_count;
    if (threadIdx.x < ranges_count) {
      Range own;
      for (int w = 0; w < int(blockDim.x) / warp_size; ++w)
        own.add({least[threadIdx.x][w], largest[threadIdx.x][w]});
      rows[team_.rank() * ranges_count + threadIdx.x] = own;
    }
    team_.barrier();
    for (int n = 0; n < ranges_count; ++n) {
      Range all;
      for (int b = lane; b < team_.blocks(); b += warp_size) all.add(rows[b * ranges_count + n]);
      range[n] = {across_warp(all.least, Least{}), -across_warp(-all.largest, Least{})};
    }
  }

 private:
  Range* memory_;
  BlockTeam& team_;
  int round_ = 0;
};

// All threads of a team; each gets the answer.
template <class T>
PD_DEVICE Misfit measure_misfit(const StreamWork<T, false>& w, Ranges& ranges, BlockTeam& team) {
  const Levels<T>& levels = w.plan.levels;
  const T* stiffness = w.call.step.material.stiffness.of(w.environment);
  // visit(a / a_0) of the vertices that neither the step nor M holds; says whether one of them alone holds any
  const auto each_inertia = [&](const auto& visit) {
    bool differ = false;
#pragma unroll 1
    for (int i = team.thread(); i < w.plan.vertices; i += team.threads()) {
      const double a = double(w.v.inertia(i));
      const bool free = levels.fine_inverse[i] > T(0);
      if (a > 0 && free) visit(a / double(levels.reference_inertia[i]));
      differ = differ || (a > 0) != free;
    }
    return differ;
  };
  Range first[ranges_count], second[ranges_count];
  Range &elements = first[0], &inertias = first[1], &common = second[0], &others = second[1];
#pragma unroll 1
  for (int t = team.thread(); t < w.plan.tets; t += team.threads())
    elements.count(double(stiffness[t]) / double(levels.reference_stiffness[t]));
  if (each_inertia([&](double ratio) { inertias.count(ratio); })) others.count(1);
  ranges.meet(first);
  Misfit misfit(elements, inertias);
  const double most = known_inertia * misfit.trusted;
  each_inertia([&](double ratio) {
    if (!(ratio > most)) common.count(ratio);
  });
  ranges.meet(second);
  misfit.conclude(elements, inertias, common, others.largest > 0);
  return misfit;
}

}  // namespace pd::inline PD_TARGET
