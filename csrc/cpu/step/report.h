// Runner of solver/report.h.
#pragma once
#include "cpu/adjoint/system.h"
#include "solver/report.h"

#include <algorithm>
#include <vector>

namespace pd::inline PD_TARGET {

template <class T>
void report_any(const ReportCall<T>& call, int threads) {
  const Plan<T>& plan = call.plan;
  std::vector<int32> pin_of(plan.vertices, -1);
  for (int p = 0; p < plan.pins; ++p) pin_of[plan.pin_vertex[p]] = p;
  const std::int64_t chunks = call.chunks(), count = call.batch * chunks;
  run_team(useful_threads(call.batch * plan.vertices, threads), [&](const Team& team) {
    for (std::int64_t n = team.begin(count); n < team.end(count); ++n) {
      double sum[report_sums] = {};
      const int first = int(n % chunks) * report_chunk;
      const int end = std::min(first + report_chunk, plan.vertices);
      for (int i = first; i < end; ++i)
        ReportVertex<T, Plan<T>>{call, n / chunks, plan.vertex_order[i], pin_of[i]}.add_to(sum);
      std::copy(sum, sum + report_sums, call.sums + n * report_sums);
    }
    team.barrier();
    for (std::int64_t e = team.begin(call.batch); e < team.end(call.batch); ++e) {
      double sum[report_sums] = {};
      for (std::int64_t n = e * chunks; n < (e + 1) * chunks; ++n) {
        for (int s = 0; s < report_sums; ++s) sum[s] += call.sums[n * report_sums + s];
      }
      write_report<T>(sum, call.info + e * info_count);
    }
  });
}

}  // namespace pd::inline PD_TARGET
