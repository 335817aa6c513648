// Environments in which no surfaces come near each other take the step of the scene without contact.
//
// No pair has a force, the boxes around both ends of the ways of any two bodies are apart, and both shapes of every body
// keep its parts apart (RestShapes). Then contact has nothing to do, and nothing crosses on the way. The start is tested
// before such a step, to save it, and its end after it. Whatever fails takes the step again, with contact.
#pragma once
#include "contact/pairs/shares.h"
#include "solver/contact/serial_team.h"
#include "solver/contact/shape.h"

namespace pd::inline PD_TARGET {

template <class T>
class FreeMotion {
 public:
  FreeMotion(const StepCall<T>& call, const ContactCall<T>& contact)
      : call_(call),
        contact_(contact),
        plan_(contact.plan),
        shapes_(contact.plan),
        places_(contact.plan.vertices),
        boxes_(contact.plan.bodies) {}

  // Whether no pair has a force, and all parts are apart.
  bool begins(std::int64_t environment) {
    if (plan_.capacity > 0 && contact_.history.keys[environment * plan_.capacity] >= 0)
      return false;
    begin_boxes(environment);
    return are_apart();
  }

  // Whether the step without contact is one that contact would not have changed.
  bool ends(std::int64_t environment) {
    begin_boxes(environment);
    const T* const goal = contact_.poses + 7 * environment * plan_.colliders;
    std::swap(begin_, places_);
    places_.resize(plan_.vertices);
    place(call_.out_positions, goal, environment);
    for (int b = 0; b < plan_.bodies; ++b) {
      each_of(b, [&](int v) {
        // a helix leaves the box of its ends by half a chord at most
        const Vec3<T> chord = places_[v] - begin_[v];
        const T bow = v < plan_.body_vertices ? T(0) : T(0.5) * square_root(dot(chord, chord));
        boxes_[b].add(Box<T>{places_[v], places_[v]}.widened(margin() + bow));
        if (bow > T(0)) boxes_[b].add(Box<T>{begin_[v], begin_[v]}.widened(margin() + bow));
      });
    }
    return are_apart();
  }

  // What the step leaves: colliders at their goals, and no forces.
  void write(std::int64_t environment) const {
    const std::int64_t row = environment * plan_.capacity, vertices = environment * plan_.vertices,
                       hands = environment * plan_.colliders;
    std::fill_n(contact_.history.next_keys + row, plan_.capacity, std::int64_t(-1));
    std::fill_n(contact_.history.next_forces + 4 * row, 4 * plan_.capacity, T(0));
    std::copy_n(contact_.poses + 7 * hands, 7 * plan_.colliders,
                contact_.history.next_poses + 7 * hands);
    std::fill_n(contact_.held_back + hands, plan_.colliders, T(0));
    std::fill_n(contact_.forces + 3 * vertices, 3 * plan_.vertices, T(0));
    double* const info = contact_.info + environment * contact_info_count;
    std::fill_n(info, int(contact_info_count), 0.0);
    info[contact_gap] = HUGE_VAL;
    info[contact_residual] = NAN;
  }

 private:
  template <class Visit>
  void each_of(int body, const Visit& visit) const {
    for (int n = plan_.surface_start[body]; n < plan_.surface_start[body + 1]; ++n)
      visit(plan_.point[n]);
  }
  bool has_surface(int body) const {
    return plan_.surface_start[body] < plan_.surface_start[body + 1];
  }
  bool moves_by_hand(int body) const {
    const int first = plan_.body_start[body];
    if (!has_surface(body)) return true;
    return first >= plan_.body_vertices &&
           !(plan_.rigid &&
             plan_.rigid[rigid_numbers * std::int64_t(plan_.collider[first])] > T(0));
  }

  T margin() const { return T(0.5 + slack_share) * plan_.thickness; }

  void place(const T* positions, const T* poses, std::int64_t environment) {
    const T* p = positions + 3 * environment * plan_.body_vertices;
    for (int v = 0; v < plan_.body_vertices; ++v, p += 3) places_[v] = {p[0], p[1], p[2]};
    for (int v = plan_.body_vertices; v < plan_.vertices; ++v)
      places_[v] = Hand<T>::read(poses + 7 * plan_.collider[v]).place(local_point(plan_, v));
  }

  void begin_boxes(std::int64_t environment) {
    place(call_.positions, contact_.history.poses + 7 * environment * plan_.colliders, environment);
    for (int b = 0; b < plan_.bodies; ++b) {
      boxes_[b] = Box<T>::none();
      each_of(b, [&](int v) { boxes_[b].add(places_[v]); });
      boxes_[b] = boxes_[b].widened(margin());
    }
  }

  bool are_apart() const {
    for (int a = 0; a < plan_.bodies; ++a) {
      if (plan_.touches_itself[a] && has_surface(a) &&
          !(shapes_.apart(SerialTeam(), a, places_.data()) >
            T(1.0 + slack_share) * plan_.thickness))
        return false;
      for (int b = a + 1; b < plan_.bodies; ++b) {
        const bool held = moves_by_hand(a) && moves_by_hand(b);
        if (!held && boxes_[a].meets(boxes_[b])) return false;
      }
    }
    return true;
  }

  const StepCall<T>& call_;
  const ContactCall<T>& contact_;
  const ContactPlan<T>& plan_;
  RestShapes<T> shapes_;
  std::vector<Vec3<T>> places_, begin_;
  std::vector<Box<T>> boxes_;  // of bodies
};

// The call for some of its environments.
template <class T>
StepCall<T> part_of(const StepCall<T>& call, std::int64_t first, std::int64_t count) {
  StepCall<T> part = call;
  part.batch = count;
  const std::int64_t at = first * call.plan.vertices * 3;
  part.positions += at;
  part.velocities += at;
  if (call.forces) part.forces += at;
  if (call.start) part.start += at;
  part.out_positions += at;
  part.out_velocities += at;
  if (call.info) part.info += first * info_count;
  const auto move = [&](Values<T>& values) {
    if (values.data) values.data += first * values.stride;
  };
#define X(name, width, rows, meaning) move(part.material.name);
#include "views/material.def"
#undef X
  move(part.effects.stiffness);
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning) move(part.effects.name);
#include "views/material.def"
#undef X
  return part;
}

}  // namespace pd::inline PD_TARGET
