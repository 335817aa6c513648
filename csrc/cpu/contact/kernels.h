// Contact between bodies, compiled for one instruction set. Included once by each cpu/contact_*.cpp, after cpu/target.
#pragma once
#include "cpu/contact/stepper.h"
#include "cpu/step/clean_registers.h"

namespace pd::inline PD_TARGET {

// Environment by environment, each by one thread.
template <bool HasContacts, class T>
void contact_step_with(const StepCall<T>& call, const ContactCall<T>& contact, int threads) {
  using Lanes = Single<T>;
  std::atomic<std::int64_t> next{0};
  run_team(int(std::min<std::int64_t>(threads, call.batch)), [&](const Team& team) {
    const CleanRegisters clean;
    Workspace<Lanes> work(call);
    Scratch<Lanes> scratch(call.plan.most_slots);
    ContactRun<T> run(contact.plan);
    Approach<T> approach(contact.plan);
    CoarseContact<T> coarse(contact.plan, call.plan);
    const Team alone = team.alone();
    for (std::int64_t e = next++; e < call.batch && !alone.ended(0); e = next++)
      ContactStepper<T, HasContacts>(call, work, scratch, alone, e, contact, run, approach, coarse)
          .rollout();
  });
}

template <class T>
void contact_step_any(const StepCall<T>& call, const ContactCall<T>& contact, int threads) {
  const bool has_contacts = call.material.planes_count + call.material.spheres_count > 0;
  has_contacts ? contact_step_with<true>(call, contact, threads)
               : contact_step_with<false>(call, contact, threads);
}

template void contact_step_any(const StepCall<float>&, const ContactCall<float>&, int);
template void contact_step_any(const StepCall<double>&, const ContactCall<double>&, int);

}  // namespace pd::inline PD_TARGET
