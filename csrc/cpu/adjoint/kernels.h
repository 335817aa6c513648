// Gradients of a step, compiled for one instruction set. Included once by each cpu/adjoint_*.cpp, after cpu/target.
#pragma once
#include "cpu/adjoint/conjugate_gradients.h"
#include "cpu/adjoint/energy_fields.h"
#include "cpu/adjoint/system.h"
#include "cpu/step/clean_registers.h"
#include "solver/adjoint/pair_gradients.h"

#include <algorithm>
#include <atomic>
#include <vector>

namespace pd::inline PD_TARGET {

template <class T>
void field_any(const FieldCall<T>& call, int threads) {
  using Lanes = Single<T>;
  Workspace<Lanes> work(call);
  auto scratches = make_scratches<Lanes>(call.plan, threads);
  run_team(std::min(threads, call.plan.patches), [&](const Team& team) {
    const CleanRegisters clean;
    FieldPass<T> pass(call, work, scratches[team.rank], team);
    for (std::int64_t e = 0; e < call.batch; ++e) pass.run(e);
  });
}

// Environments run side by side where they have too few patches to share.
template <class T>
void conjugate_any(const ConjugateCall<T>& call, int threads) {
  using Lanes = Single<T>;
  if (call.batch > 1 && call.plan.patches < 2 * threads) {
    std::atomic<std::int64_t> next{0};
    run_team(int(std::min<std::int64_t>(threads, call.batch)), [&](const Team& team) {
      const CleanRegisters clean;
      ConjugateMemory<T, false> work(call);
      Scratch<Lanes> scratch(call.plan.most_slots);
      const Team alone = team.alone();
      ConjugatePass<T> pass(call, work, scratch, alone);
      for (std::int64_t e = next++; e < call.batch; e = next++) pass.run(e);
    });
    return;
  }
  ConjugateMemory<T, false> work(call);
  auto scratches = make_scratches<Lanes>(call.plan, threads);
  run_team(std::min(threads, call.plan.patches), [&](const Team& team) {
    const CleanRegisters clean;
    ConjugatePass<T> pass(call, work, scratches[team.rank], team);
    for (std::int64_t e = 0; e < call.batch; ++e) pass.run(e);
  });
}

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

template void field_any(const FieldCall<float>&, int);
template void field_any(const FieldCall<double>&, int);
template void conjugate_any(const ConjugateCall<float>&, int);
template void conjugate_any(const ConjugateCall<double>&, int);
template void contact_conjugate_any(const ConjugateCall<float>&, int);
template void contact_conjugate_any(const ConjugateCall<double>&, int);
template void adjoint_system_any(const AdjointSystemCall<float>&, int);
template void adjoint_system_any(const AdjointSystemCall<double>&, int);
template void contact_gradients_any(const ContactGradientsCall<float>&, int);
template void contact_gradients_any(const ContactGradientsCall<double>&, int);
template void adjoint_result_any(const AdjointResultCall<float>&, int);
template void adjoint_result_any(const AdjointResultCall<double>&, int);
template void pair_gradients_any(const PairGradientsCall<float>&, int);
template void pair_gradients_any(const PairGradientsCall<double>&, int);

}  // namespace pd::inline PD_TARGET
