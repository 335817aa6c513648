// Where the pairs of one environment act in the adjoint of its step: on vertices of bodies, and on the two nodes of a
// collider with a mass.
#pragma once
#include "math/screw.h"
#include "solver/adjoint/one_thread.h"
#include "solver/adjoint/pair_memory.h"
#include "solver/adjoint/pair_views.h"

namespace pd::inline PD_TARGET {

template <class T>
PD_HD PairSizes pair_sizes(const LoadedPairs<T>& call) {
  const ContactPlan<T>& plan = call.plan;
  return {plan.body_vertices, plan.rigid ? plan.colliders : 0, plan.capacity, call.most,
          plan.bodies};
}

// `Team`: as OneThread
template <class T, class Team>
class PairNodes {
 public:
  using Place = Vec3<double>;

  // `vertex_order`: the user's numbers of the nodes
  PD_HD PairNodes(const LoadedPairs<T>& call, const int* vertex_order, const Team& team,
                  const PairMemory& memory, std::int64_t environment)
      : call_(call),
        plan_(call.plan),
        order_(vertex_order),
        team_(team),
        m_(memory),
        environment_(environment),
        count_(call.plan.body_vertices),
        nodes_(int(pair_sizes(call).nodes())) {}

 protected:
  PD_HD static Place at(const T* p) { return {double(p[0]), double(p[1]), double(p[2])}; }

  // of any vertex, by the places of bodies and the poses of colliders
  PD_HD Place place(int v, const T* bodies, const T* poses) const {
    if (v < count_) return at(bodies + 3 * (environment_ * count_ + v));
    const T* const pose = poses + 7 * (environment_ * plan_.colliders + plan_.collider[v]);
    return Pose<double>{at(pose), double(pose[3]), at(pose + 4)}.place(
        at(plan_.local + 3 * std::int64_t(v - count_)));
  }

  PD_HD void corners(const PairItem& item, Place (&after)[4], Place (&before)[4]) const {
    for (int a = 0; a < 4; ++a) {
      after[a] = place(item.vertex[a], call_.after, call_.poses_after);
      before[a] = place(item.vertex[a], call_.before, call_.poses_before);
    }
  }

  template <class Read>
  PD_HD void gather(const PairItem& item, const Read& read, double (&l)[12]) const {
    for (int a = 0; a < 4; ++a) {
      Place of = {0, 0, 0};
      if (const int s = item.slot[a]; s >= 0) {
        of = read(item.node[s]);
        if (item.node[s] >= count_) of = of + cross(read(item.node[s + 1]), item.arm[a]);
      }
      l[3 * a] = of.x, l[3 * a + 1] = of.y, l[3 * a + 2] = of.z;
    }
  }

  PD_HD bool is_turn(int node) const { return node >= count_ && (node - count_) % 2 != 0; }

  // What forces at(corner) are on a slot.
  template <class At>
  PD_HD Place on_slot(const PairItem& item, int s, const At& at) const {
    const int node = item.node[s], first = item.corner[s];
    if (node < count_) return at(first);
    const int end = first > 0 ? 4 : item.pair.edges ? 2 : 1;
    Place sum = {0, 0, 0};
    for (int a = first; a < end; ++a)
      sum = sum + (is_turn(node) ? cross(item.arm[a], at(a)) : at(a));
    return sum;
  }
  PD_HD Place sum_of(int node, const Vec3<double>* part) const {
    Place sum = {0, 0, 0};
    for (int n = m_.start[node]; n < m_.start[node + 1]; ++n) {
      const int number = m_.entry[n] / m_.slots;
      sum = sum + on_slot(m_.item[number], m_.entry[n] % m_.slots,
                          [&](int a) { return part[4 * number + a]; });
    }
    return sum;
  }

  const LoadedPairs<T>& call_;
  const ContactPlan<T>& plan_;
  const int* order_;
  const Team& team_;
  const PairMemory& m_;
  std::int64_t environment_;
  int count_, nodes_;  // vertices of bodies; all
};

}  // namespace pd::inline PD_TARGET
