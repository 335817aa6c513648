// When the coarse correction of bodies in contact comes: before the first iteration, after the last, and some between.
#pragma once
#include "math/config.h"

namespace pd::inline PD_TARGET {

constexpr int coarse_first = 8;  // iterations before the first correction between
constexpr int coarse_last = 2;   // iterations before the last correction, in which none comes
constexpr int coarse_trials =
    4;  // where a motion is cut, forces grow with the gaps of now, and another one follows

// Before iterations 8, 16, 32, ...: every eighth one would swing with the transients of Chebyshev's iteration.
PD_HD bool has_correction(int k, int iterations) {
  return k >= coarse_first && (k & (k - 1)) == 0 && iterations - k > coarse_last;
}

}  // namespace pd::inline PD_TARGET
