// The compiled physics of one instruction set. Included once by each cpu/isa_*.cpp, after cpu/target.
#pragma once
#include "cpu/multilevel/newton.h"
#include "cpu/multilevel/stepper.h"
#include "cpu/step/clean_registers.h"
#include "cpu/step/report.h"
#include "cpu/step/stepper.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <vector>

namespace pd::inline PD_TARGET {

// Fewest environments for which lanes run over environments instead of elements.
constexpr std::int64_t least_batch = 8;

// The stepper of the call's solver, with its own memory.
template <class Lanes, bool HasContacts, class T>
class Runner {
 public:
  Runner(const StepCall<T>& call, int threads) : call_(call) {
    if (call.settings.multilevel()) multilevel_.emplace(call, HasContacts, threads);
    if (call.settings.newton()) newton_.emplace(call.plan, call.effects.poisson.data != nullptr);
  }

  void rollout(Workspace<Lanes>& work, Scratch<Lanes>& scratch, const Team& team,
               std::int64_t first) {
    if (newton_) {
      if constexpr (std::is_same_v<Lanes, Single<T>>) {
        NewtonStepper<T, HasContacts>(call_, work, scratch, team, first, *multilevel_, *newton_)
            .rollout();
      }
    } else if (multilevel_) {
      MultilevelStepper<Lanes, HasContacts>(call_, work, scratch, team, first, *multilevel_)
          .rollout();
    } else {
      Stepper<Lanes, HasContacts>(call_, work, scratch, team, first).rollout();
    }
  }

 private:
  const StepCall<T>& call_;
  std::optional<MultilevelWork<Lanes>> multilevel_;
  std::optional<NewtonWork<T>> newton_;
};

template <class Lanes, bool HasContacts, class T>
void step_batches(const StepCall<T>& call, int threads) {
  constexpr int W = Lanes::environments;
  const std::int64_t groups = (call.batch + W - 1) / W;
  std::atomic<std::int64_t> next{0};
  run_team(int(std::min<std::int64_t>(threads, groups)), [&](const Team& team) {
    const CleanRegisters clean;
    Workspace<Lanes> work(call);
    Scratch<Lanes> scratch(call.plan.most_slots);
    Runner<Lanes, HasContacts, T> runner(call, 1);
    const Team alone = team.alone();
    for (std::int64_t g = next++; g < groups && !alone.ended(0); g = next++)
      runner.rollout(work, scratch, alone, g * W);
  });
}

// One environment after another by the whole team, or each by one thread when it has too few patches to share.
template <bool HasContacts, class T>
void step_singles(const StepCall<T>& call, int threads) {
  using Lanes = Single<T>;
  if (call.batch > 1 && call.plan.patches < 2 * threads)
    return step_batches<Lanes, HasContacts>(call, threads);
  Workspace<Lanes> work(call);
  // allocated before the team starts: a member without memory would keep the others waiting
  auto scratches = make_scratches<Lanes>(call.plan, threads);
  Runner<Lanes, HasContacts, T> runner(call, threads);
  run_team(std::min(threads, call.plan.patches), [&](const Team& team) {
    const CleanRegisters clean;
    for (std::int64_t e = 0; e < call.batch && !team.ended(0); ++e) {
      runner.rollout(work, scratches[team.rank], team, e);
      team.barrier();
    }
  });
}

template <bool HasContacts, class T>
void step_with(const StepCall<T>& call, int threads) {
  constexpr int wide = native_width<T>;
  constexpr int narrow = wide > 4 ? wide / 2 : wide;
  if (call.batch < least_batch || call.settings.newton())
    return step_singles<HasContacts>(call, threads);
  // half the lanes where full ones would leave a thread without work
  const std::int64_t groups = (call.batch + wide - 1) / wide;
  if (groups >= threads) return step_batches<Batch<T, wide>, HasContacts>(call, threads);
  step_batches<Batch<T, narrow>, HasContacts>(call, threads);
}

template <class T>
void step_any(const StepCall<T>& call, int threads) {
  const bool has_contacts = call.material.planes_count + call.material.spheres_count > 0;
  has_contacts ? step_with<true>(call, threads) : step_with<false>(call, threads);
}

// contact/kernels.h calls it, too
template void step_any(const StepCall<float>&, int);
template void step_any(const StepCall<double>&, int);

// In translation units of their own: cpu/contact/kernels.h and cpu/adjoint/kernels.h.
template <class T>
void contact_step_any(const StepCall<T>& call, const ContactCall<T>& contact, int threads);
template <class T>
void field_any(const FieldCall<T>& call, int threads);
template <class T>
void conjugate_any(const ConjugateCall<T>& call, int threads);
template <class T>
void contact_conjugate_any(const ConjugateCall<T>& call, int threads);
template <class T>
void adjoint_system_any(const AdjointSystemCall<T>& call, int threads);
template <class T>
void contact_gradients_any(const ContactGradientsCall<T>& call, int threads);
template <class T>
void adjoint_result_any(const AdjointResultCall<T>& call, int threads);
template <class T>
void pair_gradients_any(const PairGradientsCall<T>& call, int threads);

// Applies M to the fields, environment by environment.
template <class T>
void precondition_any(const PreconditionCall<T>& call, int threads) {
  using Lanes = Single<T>;
  const Cycle<Lanes> cycle(call.levels);
  const std::int64_t n = call.levels.vertices;
  run_team(threads, [&](const Team& team) {
    const CleanRegisters clean;
    for (std::int64_t e = 0; e < call.batch; ++e) {
      for (std::int64_t i = team.begin(n); i < team.end(n); ++i) {
        const T* from = call.field + (e * n + call.vertex_order[i]) * 3;
        cycle.input()[i] = to_quad(from[0], from[1], from[2]);
      }
      team.barrier();
      cycle.run(team);
      for (std::int64_t i = team.begin(n); i < team.end(n); ++i) {
        T* to = call.out + (e * n + call.vertex_order[i]) * 3;
        for (int c = 0; c < 3; ++c) to[c] = cycle.result()[i].q.v[c];
      }
      team.barrier();
    }
  });
}

template <class T, int W>
Mat3<Pack<T, W>> load_matrices(const T* from, int count) {
  Mat3<Pack<T, W>> r;
  for (int lane = 0; lane < W; ++lane) {
    const T* m = from + 9 * (lane < count ? lane : count - 1);
    for (int a = 0; a < 3; ++a) {
      r.row[a].x.v[lane] = m[3 * a];
      r.row[a].y.v[lane] = m[3 * a + 1];
      r.row[a].z.v[lane] = m[3 * a + 2];
    }
  }
  return r;
}

template <class T>
void rotation_range(const RotationCall<T>& call, std::int64_t begin, std::int64_t end) {
  constexpr int W = native_width<T>;
  for (std::int64_t first = begin; first < end; first += W) {
    const int count = int(std::min<std::int64_t>(W, end - first));
    const Mat3<Pack<T, W>> f = load_matrices<T, W>(call.matrices + 9 * first, count);
    Mat3<Pack<T, W>> r = polished_rotation(f);
    if (call.direction)
      r = rotation_differential(f, r, load_matrices<T, W>(call.direction + 9 * first, count));
    for (int lane = 0; lane < count; ++lane) {
      T* to = call.out + 9 * (first + lane);
      for (int a = 0; a < 3; ++a) {
        to[3 * a] = r.row[a].x.v[lane];
        to[3 * a + 1] = r.row[a].y.v[lane];
        to[3 * a + 2] = r.row[a].z.v[lane];
      }
    }
  }
}

template <class T>
void rotation_any(const RotationCall<T>& call, int threads) {
  const CleanRegisters clean;
  constexpr std::int64_t least_share = 4096;
  const int useful = int(std::min<std::int64_t>(threads, call.count / least_share + 1));
  run_team(useful, [&](const Team& team) {
    rotation_range(call, team.begin(call.count), team.end(call.count));
  });
}

// A loop of independent multiply-adds: measures this processor's arithmetic, to compare speeds across machines.
inline void multiply_add_loop(float* seconds, std::int64_t* operations) {
  constexpr int W = native_width<float>, chains = 12, rounds = 2'000'000;
  Pack<float, W> a[chains];
  for (int c = 0; c < chains; ++c) a[c] = Pack<float, W>(1.0f + 0.001f * float(c));
  const Pack<float, W> x(0.9999f), y(0.0001f);
  const auto start = std::chrono::steady_clock::now();
  for (int r = 0; r < rounds; ++r) {
    for (int c = 0; c < chains; ++c) a[c] = multiply_add(a[c], x, y);
  }
  const auto stop = std::chrono::steady_clock::now();
  Pack<float, W> sum = a[0];
  for (int c = 1; c < chains; ++c) sum = sum + a[c];
  volatile float keep = sum.v[0];
  (void)keep;
  *seconds = std::chrono::duration<float>(stop - start).count();
  *operations = std::int64_t(rounds) * chains * W;
}

}  // namespace pd::inline PD_TARGET

namespace pd {

extern const Kernels PD_KERNELS;
const Kernels PD_KERNELS = {PD_NAME,
                            &step_any<float>,
                            &step_any<double>,
                            &contact_step_any<float>,
                            &contact_step_any<double>,
                            &field_any<float>,
                            &field_any<double>,
                            &report_any<float>,
                            &report_any<double>,
                            &rotation_any<float>,
                            &rotation_any<double>,
                            &precondition_any<float>,
                            &precondition_any<double>,
                            &conjugate_any<float>,
                            &conjugate_any<double>,
                            &adjoint_system_any<float>,
                            &adjoint_system_any<double>,
                            &contact_gradients_any<float>,
                            &contact_gradients_any<double>,
                            &adjoint_result_any<float>,
                            &adjoint_result_any<double>,
                            &contact_conjugate_any<float>,
                            &contact_conjugate_any<double>,
                            &pair_gradients_any<float>,
                            &pair_gradients_any<double>,
                            &multiply_add_loop};

}  // namespace pd
