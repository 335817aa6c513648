// Contact between bodies, compiled for one instruction set. Included once by each cpu/contact_*.cpp, after cpu/target.
#pragma once
#include "cpu/contact/free.h"
#include "cpu/contact/stepper.h"
#include "cpu/step/clean_registers.h"

namespace pd::inline PD_TARGET {

// In a translation unit of its own: cpu/kernels.h.
template <class T>
void step_any(const StepCall<T>& call, int threads);

// Environment by environment, each by one thread: work(make(), e) for e of a list.
template <class Make, class Work>
void each_environment(const std::vector<std::int64_t>& list, int threads, const Make& make,
                      const Work& work) {
  const std::int64_t count = std::int64_t(list.size());
  if (count == 0) return;
  std::atomic<std::int64_t> next{0};
  run_team(int(std::min<std::int64_t>(threads, count)), [&](const Team& team) {
    const CleanRegisters clean;
    const Team alone = team.alone();
    auto own = make();
    for (std::int64_t n = next++; n < count && !alone.ended(0); n = next++)
      work(own, list[n], alone);
  });
}

// What a thread needs for steps with contact.
template <class T>
struct ContactWork {
  Workspace<Single<T>> work;
  Scratch<Single<T>> scratch;
  ContactMemory<T> memory;

  ContactWork(const StepCall<T>& call, const ContactPlan<T>& plan)
      : work(call), scratch(call.plan.most_slots), memory(call, plan) {}
};

template <bool HasContacts, class T>
void contact_step_with(const StepCall<T>& call, const ContactCall<T>& contact,
                       const std::vector<std::int64_t>& list, int threads) {
  each_environment(
      list, threads, [&] { return ContactWork<T>(call, contact.plan); },
      [&](ContactWork<T>& own, std::int64_t e, const Team& alone) {
        ContactStepper<T, HasContacts>(call, own.work, own.scratch, alone, e, contact, own.memory)
            .rollout();
      });
}

// Takes the step without contact where that is the one with it; returns the other environments.
template <class T>
std::vector<std::int64_t> step_free(const StepCall<T>& call, const ContactCall<T>& contact,
                                    int threads) {
  std::vector<std::int64_t> list(call.batch), left;
  for (std::int64_t e = 0; e < call.batch; ++e) list[e] = e;
  if (!contact.plan.can_be_free) return list;
  std::vector<char> is_free(call.batch);
  const auto make = [&] { return FreeLook<T>(call, contact); };
  each_environment(list, threads, make, [&](FreeLook<T>& look, std::int64_t e, const Team&) {
    is_free[e] = look.begins(e);
  });
  for (std::int64_t e = 0, end = 0; e < call.batch; e = end + 1) {
    for (end = e; end < call.batch && is_free[end];) ++end;
    if (end > e) step_any(part_of(call, e, end - e), threads);
  }
  each_environment(list, threads, make, [&](FreeLook<T>& look, std::int64_t e, const Team&) {
    is_free[e] = is_free[e] && look.ends(e);
    if (is_free[e]) look.write(e);
  });
  for (std::int64_t e : list)
    if (!is_free[e]) left.push_back(e);
  return left;
}

template <class T>
void contact_step_any(const StepCall<T>& call, const ContactCall<T>& contact, int threads) {
  const std::vector<std::int64_t> left = step_free(call, contact, threads);
  const bool has_contacts = call.material.planes_count + call.material.spheres_count > 0;
  has_contacts ? contact_step_with<true>(call, contact, left, threads)
               : contact_step_with<false>(call, contact, left, threads);
}

template void contact_step_any(const StepCall<float>&, const ContactCall<float>&, int);
template void contact_step_any(const StepCall<double>&, const ContactCall<double>&, int);

}  // namespace pd::inline PD_TARGET
