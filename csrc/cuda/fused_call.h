// What the fused kernel is given, and what it keeps where.
#pragma once
#include "cuda/inputs.h"
#include "cuda/team.h"

namespace pd::inline PD_TARGET {

// Device memory of the teams.
template <class T>
struct FusedScratch {
  Quad<T>*x, *velocity, *target, *origin, *before;  // [teams, slots]
  Quad<T>* u;                                       // the same, with several patches
  T* weights;                                       // [teams, blocks, 2, 32] w V
  Quad<T>* shift;                                   // [teams, patches, pieces]
  double* part_sum;  // [teams, parts, 4] of the vertices that a patch owns of a piece
  Word* letters;     // [teams, 2, slots, words] forces on shared vertices
  Word* sums;        // [teams, 2, patches, sums_count]
};

template <class T>
struct FusedCall {
  DeviceStep<T> step;
  FusedScratch<T> scratch;
  int teams;
};

// What the leading warp of a block decides for it.
struct Control {
  Progress progress;
  double omega;
  TeamTotals totals;
};

}  // namespace pd::inline PD_TARGET
