// The two loops of L-BFGS over secant pairs (SecantPairs, solver/multilevel/lbfgs.h) by one warp, one pair per
// lane. The operations on every number and their order are unchanged; the dependency chain is 8
// steps long instead of 36.
#pragma once
#include "cuda/common/reductions.h"
#include "solver/multilevel/lbfgs.h"

namespace pd::inline PD_TARGET {

// Called by a whole warp; lanes from `history` on repeat others.
class SecantPairLanes {
 public:
  PD_DEVICE SecantPairLanes(SecantPairs& pairs, int newest)
      : pairs_(pairs), newest_(newest), own_(int(threadIdx.x) % history) {}

  PD_DEVICE void first_loop() {
    Numbers n;
#pragma unroll
    for (int a = 0; a < history; ++a) load(a, pairs_.product[own_][place(a)], n);
    double rest = pairs_.s_dot_g[own_];
#pragma unroll
    for (int a = 0; a < history; ++a) {
      const double alpha = n.valid[a] ? broadcast(rest, place(a)) * n.inverse[a] : 0;
      if (age() == a) pairs_.alpha[own_] = alpha;
      // pairs older than this one, for which it is a j
      if (n.valid[a] && age() > a) rest -= alpha * n.product[a];
    }
    __syncwarp();
  }

  PD_DEVICE void second_loop(const double* with, double* c) {
    Numbers n;
#pragma unroll
    for (int a = 0; a < history; ++a) load(a, pairs_.product[place(a)][own_], n);
    double rest = with[own_];
    const double alpha = pairs_.alpha[own_];
#pragma unroll
    for (int a = history - 1; a >= 0; --a) {
      const double mine =
          n.valid[a] ? broadcast(alpha, place(a)) - broadcast(rest, place(a)) * n.inverse[a] : 0;
      if (age() == a) c[own_] = mine;
      if (n.valid[a] && age() < a) rest += mine * n.product[a];
    }
    __syncwarp();
  }

 private:
  // the pairs' values by age, loaded before the chain begins
  struct Numbers {
    double inverse[history], product[history];
    bool valid[history];
  };

  PD_DEVICE void load(int a, double product, Numbers& n) const {
    n.inverse[a] = pairs_.inverse[place(a)];
    n.valid[a] = pairs_.valid[place(a)];
    n.product[a] = product;
  }
  PD_DEVICE int place(int age) const { return SecantPairs::older(newest_, age); }
  PD_DEVICE int age() const { return (newest_ - own_ + history) % history; }
  PD_DEVICE static double broadcast(double value, int from) {
    return __shfl_sync(full_warp, value, from);
  }

  SecantPairs& pairs_;
  int newest_, own_;
};

}  // namespace pd::inline PD_TARGET
