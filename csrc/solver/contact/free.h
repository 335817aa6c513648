// Environments in which no surfaces come near each other take the step of the scene without contact.
//
// No pair has a force, the boxes around both ends of the ways of any two bodies are apart, and both shapes of every body
// keep its parts apart (RestShapes). Then contact has nothing to do, and nothing crosses on the way. Whatever fails takes
// the step again, with contact.
#pragma once
#include "solver/contact/environment.h"
#include "solver/contact/shape.h"

namespace pd::inline PD_TARGET {

template <class T>
struct FreeArrays {
  Vec3<T>*begin, *end;  // [vertices] places
  Box<T>* box;          // [bodies]
  int* meets;
};

template <class T>
class FreeMotion {
 public:
  PD_HD FreeMotion(const ContactPlan<T>& plan, const FreeArrays<T>& arrays)
      : plan_(plan), a_(arrays), shapes_(plan) {}

  // Whether no pair has a force, and all parts are apart, at positions [body vertices, 3] and poses [colliders, 7].
  template <class Team>
  PD_HD bool begins(const Team& team, const std::int64_t* keys, const T* positions,
                    const T* poses) const {
    if (plan_.capacity > 0 && keys[0] >= 0) return false;
    place(team, positions, poses, a_.begin);
    enclose(team, [&](int v, const auto& add) { add(a_.begin[v], margin()); });
    return are_apart(team, a_.begin);
  }

  // Whether the step without contact, from one to the other, is one that contact would not have changed.
  template <class Team>
  PD_HD bool ends(const Team& team, const T* positions, const T* poses, const T* next_positions,
                  const T* next_poses) const {
    place(team, positions, poses, a_.begin);
    place(team, next_positions, next_poses, a_.end);
    enclose(team, [&](int v, const auto& add) {
      // a helix leaves the box of its ends by half a chord at most
      const Vec3<T> chord = a_.end[v] - a_.begin[v];
      const T bow = v < plan_.body_vertices ? T(0) : T(0.5) * square_root(dot(chord, chord));
      add(a_.begin[v], margin() + bow);
      add(a_.end[v], margin() + bow);
    });
    return are_apart(team, a_.end);
  }

  // What the step leaves: colliders at their goals, and no forces.
  template <class Team>
  PD_HD void write(const Team& team, const T* goal_poses, const ContactOutput<T>& to) const {
    team.spread(plan_.capacity, [&](int n) { to.write_force(n, -1, {}); });
    team.spread(7 * plan_.colliders, [&](int n) { to.poses[n] = goal_poses[n]; });
    team.spread(plan_.colliders, [&](int c) { to.held_back[c] = T(0); });
    team.spread(3 * plan_.vertices, [&](int n) { to.vertex_forces[n] = T(0); });
    team.once([&] {
      for (int n = 0; n < contact_info_count; ++n) to.info[n] = 0;
      to.info[contact_gap] = HUGE_VAL;
      if (!to.report) to.info[contact_residual] = NAN;
    });
  }

 private:
  PD_HD bool has_surface(int body) const {
    return plan_.surface_start[body] < plan_.surface_start[body + 1];
  }
  PD_HD bool moves_by_hand(int body) const {
    const int first = plan_.body_start[body];
    if (!has_surface(body)) return true;
    return first >= plan_.body_vertices &&
           !(plan_.rigid &&
             plan_.rigid[rigid_numbers * std::int64_t(plan_.collider[first])] > T(0));
  }

  PD_HD T margin() const { return T(0.5 + slack_share) * plan_.thickness; }

  template <class Team>
  PD_HD void place(const Team& team, const T* positions, const T* poses, Vec3<T>* places) const {
    team.spread(plan_.body_vertices, [&](int v) {
      const T* const p = positions + 3 * std::int64_t(v);
      places[v] = {p[0], p[1], p[2]};
    });
    team.each(plan_.vertices - plan_.body_vertices, [&](int n) {
      const int v = plan_.body_vertices + n;
      places[v] = Hand<T>::read(poses + 7 * plan_.collider[v]).place(local_point(plan_, v));
    });
  }

  // Boxes of bodies around what visit(vertex, add(place, margin)) adds.
  template <class Team, class Visit>
  PD_HD void enclose(const Team& team, const Visit& visit) const {
    team.groups(plan_.bodies, [&](int b, const auto& group) {
      double least[6];  // of coordinates, and of their negatives
      for (double& l : least) l = HUGE_VAL;
      group.least_range(
          plan_.surface_start[b], plan_.surface_start[b + 1],
          [&](int n, double (&low)[6]) {
            visit(plan_.point[n], [&](const Vec3<T>& p, T by) {
              const T of[6] = {p.x - by, p.y - by, p.z - by, -(p.x + by), -(p.y + by), -(p.z + by)};
              for (int k = 0; k < 6; ++k) low[k] = double(of[k]) < low[k] ? double(of[k]) : low[k];
            });
          },
          least);
      if (group.leads())
        a_.box[b] = {{T(least[0]), T(least[1]), T(least[2])},
                     {-T(least[3]), -T(least[4]), -T(least[5])}};
    });
  }

  template <class Team>
  PD_HD bool are_apart(const Team& team, const Vec3<T>* places) const {
    team.once([&] { *a_.meets = 0; });
    team.spread(plan_.bodies, [&](int a) {
      for (int b = a + 1; b < plan_.bodies; ++b) {
        const bool held = moves_by_hand(a) && moves_by_hand(b);
        if (!held && a_.box[a].meets(a_.box[b])) raise(a_.meets, 1);
      }
    });
    team.groups(plan_.bodies, [&](int b, const auto& group) {
      if (!plan_.touches_itself[b] || !has_surface(b)) return;
      const bool apart = shapes_.apart(group, b, places) > T(1.0 + slack_share) * plan_.thickness;
      if (!apart && group.leads()) raise(a_.meets, 1);
    });
    const bool apart = *a_.meets == 0;
    team.barrier();
    return apart;
  }

  const ContactPlan<T>& plan_;
  const FreeArrays<T>& a_;
  const RestShapes<T> shapes_;
};

}  // namespace pd::inline PD_TARGET
