// Lists the near pairs of one environment: stdin has the arrays of a plan, places and targets.
// Prints pairs found, listed and kept; balls of the vertices; of bodies, whether they are asked with
// themselves and their largest balls; keys.
#include "cpu/target/portable.h"

#include "solver/contact/search.h"
#include "solver/contact/serial_team.h"
#include "views/arena.h"

#include <cstdio>
#include <memory>
#include <vector>

namespace {
using namespace pd;
using namespace pd::PD_TARGET;

template <class Number>
const Number* read() {
  static std::vector<std::unique_ptr<std::vector<Number>>> all;
  long count = 0;
  if (std::scanf("%ld", &count) != 1) std::exit(1);
  auto& numbers = *all.emplace_back(new std::vector<Number>(count + 1));
  for (long n = 0; n < count; ++n) {
    double number;
    if (std::scanf("%lf", &number) != 1) std::exit(1);
    numbers[n] = Number(number);
  }
  return numbers.data();
}
}  // namespace

int main() {
  const int* sizes = read<int>();
  ContactPlan<double> plan;
  int* const counts[] = {&plan.vertices, &plan.body_vertices,  &plan.triangles,    &plan.edges,
                         &plan.points,   &plan.bodies,         &plan.colliders,    &plan.capacity,
                         &plan.clusters, &plan.point_clusters, &plan.edge_clusters};
  for (int* count : counts) *count = *sizes++;
  plan.rest_pairs = *sizes;
  for (const int** array :
       {&plan.triangle, &plan.edge, &plan.point, &plan.body, &plan.collider, &plan.touches_itself,
        &plan.leaves, &plan.cluster_body, &plan.body_start})
    *array = read<int>();
  plan.surface_start = plan.body_start + plan.bodies + 1;
  plan.rest_key = read<std::int64_t>();
  for (const double** array : {&plan.rest_thickness, &plan.rest, &plan.rest_apart, &plan.local,
                               &plan.cell, &plan.friction})
    *array = read<double>();
  read<double>();  // no collider has a mass
  plan.thickness = *read<double>();
  const int* held = read<int>();
  const double *place = read<double>(), *target = read<double>();

  ContactArrays<double> a;
  Arena size(nullptr);
  arrange(size, plan, 1, a);
  std::vector<std::byte> memory(size.size());
  Arena arena(memory.data());
  arrange(arena, plan, 1, a);
  for (int v = 0; v < plan.vertices; ++v) {
    a.place[v] = {place[3 * v], place[3 * v + 1], place[3 * v + 2]};
    a.target[v] = {target[3 * v], target[3 * v + 1], target[3 * v + 2]};
    a.held[v] = held[v] != 0;
  }
  for (int n = 0; n < plan.points; ++n) a.surface[plan.point[n]] = 1;
  *a.numbers = {};
  const ContactEnvironment<double> env{plan,    a,       {},      {},      nullptr,
                                       nullptr, nullptr, nullptr, nullptr, plan.friction};
  const ContactSearch<double> search(env);
  const SerialTeam team;
  search.begin(team);
  search.find(team, true);
  std::printf("%d %d %d\n", a.numbers->most_pairs, a.numbers->listed, a.numbers->pairs);
  for (int v = 0; v < plan.vertices; ++v) std::printf("%.17g ", a.ball[v].radius);
  std::printf("\n");
  for (int b = 0; b < plan.bodies; ++b) std::printf("%d ", a.itself[b]);
  std::printf("\n");
  for (int b = 0; b < plan.bodies; ++b) std::printf("%.17g ", a.ball_most[b]);
  std::printf("\n");
  for (int p = 0; p < a.numbers->pairs; ++p) std::printf("%lld ", (long long)a.pair[p].key);
}
