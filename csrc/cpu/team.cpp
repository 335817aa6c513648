#include "cpu/team.h"

#if defined(_OPENMP)
#include <omp.h>
#endif

#include <exception>

namespace pd {

int most_threads() {
#if defined(_OPENMP)
  return omp_get_max_threads();
#else
  return 1;
#endif
}

void run_team(int threads, void (*work)(void*, const Team&), void* context) {
#if defined(_OPENMP)
  if (threads > 1 && !omp_in_parallel()) {
    Barrier barrier;
    std::exception_ptr failure;
    // the runtime may grant fewer threads than asked for: the team counts those that came
#pragma omp parallel num_threads(threads)
    {
      const int size = omp_get_num_threads();
      const Team team{omp_get_thread_num(), size, size > 1 ? &barrier : nullptr};
      try {
        work(context, team);
      } catch (...) {  // memory that could not be had: an exception must not leave the region
#pragma omp critical
        failure = std::current_exception();
      }
      // meet here, where waiting soon sleeps, and not in the runtime, where it spins for milliseconds
      team.barrier();
    }
    if (failure) std::rethrow_exception(failure);
    return;
  }
#endif
  (void)threads;
  work(context, Team{});
}

}  // namespace pd
