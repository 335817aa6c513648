// The adjoint of a step with contact between bodies, compiled for one instruction set. Included once by each
// cpu/contact_adjoint_*.cpp, after cpu/target.
#pragma once
#include "cpu/adjoint/conjugate_gradients.h"
#include "cpu/step/clean_registers.h"
#include "solver/adjoint/pair_gradients.h"

#include <algorithm>
#include <atomic>
#include <vector>

namespace pd::inline PD_TARGET {

// visit(environment, team of one) for every environment; `begin()` makes the visitor of a thread.
template <class Begin>
void each_environment(std::int64_t batch, int threads, const Begin& begin) {
  std::atomic<std::int64_t> next{0};
  run_team(int(std::min<std::int64_t>(threads, batch)), [&](const Team& team) {
    const CleanRegisters clean;
    const Team alone = team.alone();
    begin(alone, [&](const auto& visit) {
      for (std::int64_t e = next++; e < batch && !alone.ended(0); e = next++) visit(e);
    });
  });
}

template <class T>
void contact_conjugate_any(const ConjugateCall<T>& call, int threads) {
  each_environment(call.batch, threads, [&](const Team& alone, const auto& each) {
    ConjugateMemory<T, true> work(call);
    Scratch<Single<T>> scratch(call.plan.most_slots);
    ConjugatePass<T, true> pass(call, work, scratch, alone);
    each([&](std::int64_t e) { pass.run(e); });
  });
}

template <class T>
void pair_gradients_any(const PairGradientsCall<T>& call, int threads) {
  each_environment(call.batch, threads, [&](const Team&, const auto& each) {
    PairStorage<T> storage(call.pairs);
    std::vector<T> inverse(call.vertices);
    std::vector<Vec3<double>> left(call.vertices);
    each([&](std::int64_t e) {
      differentiate_pairs(
          call, OneThread(), storage.memory(e), inverse.data(), left.data(),
          [&](std::int64_t low, std::int64_t square) { return storage.factors(low, square); }, e);
    });
  });
}

template void contact_conjugate_any(const ConjugateCall<float>&, int);
template void contact_conjugate_any(const ConjugateCall<double>&, int);
template void pair_gradients_any(const PairGradientsCall<float>&, int);
template void pair_gradients_any(const PairGradientsCall<double>&, int);

}  // namespace pd::inline PD_TARGET
