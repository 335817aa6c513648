// The two loops of Pairs (solver/multilevel.h) by a warp, a lane a pair: the same operations on every number in the same order,
// in a chain of eight steps instead of one of 36.
#pragma once
#include "cuda/collect.h"
#include "solver/multilevel.h"

namespace pd::inline PD_TARGET {

// A whole warp, of which lane `history` and above repeat others.
class PairLanes {
 public:
  PD_DEVICE PairLanes(Pairs& pairs, int newest)
      : pairs_(pairs), newest_(newest), own_(int(threadIdx.x) % history) {}

  PD_DEVICE void first_loop() {
    double rest = pairs_.pulled[own_];
#pragma unroll
    for (int a = 0; a < history; ++a) {
      const int i = Pairs::older(newest_, a);
      const double alpha = pairs_.valid[i] ? across(rest, i) * pairs_.inverse[i] : 0;
      if (own_ == i) pairs_.alpha[i] = alpha;
      // pairs older than i, to which it is a j
      if (pairs_.valid[i] && age() > a) rest -= alpha * pairs_.product[own_][i];
    }
    __syncwarp();
  }

  PD_DEVICE void second_loop(const double* with, double* c) {
    double rest = with[own_];
#pragma unroll
    for (int a = history - 1; a >= 0; --a) {
      const int i = Pairs::older(newest_, a);
      const double mine =
          pairs_.valid[i] ? pairs_.alpha[i] - across(rest, i) * pairs_.inverse[i] : 0;
      if (own_ == i) c[i] = mine;
      if (pairs_.valid[i] && age() < a) rest += mine * pairs_.product[i][own_];
    }
    __syncwarp();
  }

 private:
  PD_DEVICE int age() const { return (newest_ - own_ + history) % history; }
  PD_DEVICE static double across(double value, int from) {
    return __shfl_sync(whole_warp, value, from);
  }

  Pairs& pairs_;
  int newest_, own_;
};

}  // namespace pd::inline PD_TARGET
