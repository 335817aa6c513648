// Runner of solver/adjoint/system.h and solver/adjoint/contact_gradients.h.
#pragma once
#include "solver/adjoint/contact_gradients.h"
#include "solver/adjoint/system.h"
#include "threads/team.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

// Number of threads that pays off for so many vertices.
inline int useful_threads(std::int64_t vertices, int threads) {
  constexpr std::int64_t least_share = 4096;
  return int(std::min<std::int64_t>(threads, vertices / least_share + 1));
}

// visit(vertex): all vertices as if there were no pins, then the pinned ones.
template <class T, class Visit>
void each_adjoint_vertex(const AdjointSystemCall<T>& call, int threads, const Visit& visit) {
  const Plan<T>& plan = call.plan;
  using Vertex = AdjointVertex<T, Plan<T>>;
  const std::int64_t count = call.batch * plan.vertices;
  run_team(useful_threads(count, threads), [&](const Team& team) {
    for (std::int64_t n = team.begin(count); n < team.end(count); ++n)
      visit(Vertex{call, n / plan.vertices, int(n % plan.vertices), -1});
    team.barrier();
    for (std::int64_t n = team.begin(call.batch * plan.pins); n < team.end(call.batch * plan.pins);
         ++n) {
      const std::int64_t environment = n / plan.pins, pin = n % plan.pins;
      visit(Vertex{call, environment, plan.vertex_order[plan.pin_vertex[pin]], int(pin)});
    }
  });
}

template <class T>
void adjoint_system_any(const AdjointSystemCall<T>& call, int threads) {
  each_adjoint_vertex(call, threads, [](const auto& vertex) { vertex.write_system(); });
}

template <class T>
void contact_gradients_any(const ContactGradientsCall<T>& call, int threads) {
  each_adjoint_vertex(call.step, threads,
                      [&](const auto& vertex) { ContactGradients(call, vertex).differentiate(); });
}

template <class T>
void adjoint_result_any(const AdjointResultCall<T>& call, int threads) {
  const std::int64_t count = call.batch * call.vertices;
  run_team(useful_threads(count, threads), [&](const Team& team) {
    for (std::int64_t n = team.begin(count); n < team.end(count); ++n)
      AdjointResult<T>{call, n / call.vertices, n % call.vertices}.write();
  });
}

}  // namespace pd::inline PD_TARGET
