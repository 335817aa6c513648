// Parts of a batch, for steps without contact of environments that solver/contact/free.h finds.
#pragma once
#include "solver/contact/free.h"
#include "solver/contact/serial_team.h"
#include "views/views.h"

#include <cstdint>
#include <vector>

namespace pd::inline PD_TARGET {

// What a thread needs to look whether environments are free.
template <class T>
class FreeLook {
 public:
  FreeLook(const StepCall<T>& call, const ContactCall<T>& contact)
      : call_(call),
        contact_(contact),
        begin_(contact.plan.vertices),
        end_(contact.plan.vertices),
        box_(contact.plan.bodies) {}

  bool begins(std::int64_t e) {
    return motion_.begins(alone_, contact_.history.keys + e * contact_.plan.capacity,
                          call_.positions + positions_of(e), contact_.history.poses + poses_of(e));
  }
  bool ends(std::int64_t e) {
    return motion_.ends(alone_, call_.positions + positions_of(e),
                        contact_.history.poses + poses_of(e), call_.out_positions + positions_of(e),
                        contact_.poses + poses_of(e));
  }
  void write(std::int64_t e) const {
    motion_.write(alone_, contact_.poses + poses_of(e), contact_output(contact_, e));
  }

 private:
  std::int64_t positions_of(std::int64_t e) const { return 3 * e * contact_.plan.body_vertices; }
  std::int64_t poses_of(std::int64_t e) const { return 7 * e * contact_.plan.colliders; }

  const StepCall<T>& call_;
  const ContactCall<T>& contact_;
  std::vector<Vec3<T>> begin_, end_;
  std::vector<Box<T>> box_;
  int meets_ = 0;
  const FreeArrays<T> arrays_{begin_.data(), end_.data(), box_.data(), &meets_};
  const FreeMotion<T> motion_{contact_.plan, arrays_};
  SerialTeam alone_;
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
