// Members of Pipeline that bring the slots of a patch into shared memory, and add up the forces that movers leave to them.
#pragma once
#include "cuda/pipeline.h"

namespace pd::inline PD_TARGET {

// What is on its way to the slots.
template <class T, Visit What>
struct Pipeline<T, What>::Held {
  Vec3<T> u[brought], origin[brought];
  RestPoint<T> rest[brought];
};

// The forces that movers leave to bringers, who have the time.
template <class T, Visit What>
struct Pipeline<T, What>::Left {
  int row;
  unsigned place;
};

// Past the last stop, too: nothing is brought, but the forces of the two before are there.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::bring_slots() const {
  unsigned vertex[brought];
  find(told(0), vertex);
  await_kernel_before();
#pragma unroll 1
  for (unsigned n = 0; n < 2 || told(n - 2).blocks > 0; ++n) {
    Held held;
    ask(told(n), vertex, held);
    find(told(n + 1), vertex);
    Left left{};
    if (n >= 2) {
      const Stop at = told(n - 2);
      left = left_at(at, first_left(at));
      await(forces_ready, n - 2);
    }
    // first the forces, while slots are on their way
    if (n >= 2) sum_shared(n - 2, left);
    put(told(n).slots, n, held);
    give(slots_ready, n);
    if (n % told_at_once == told_at_once / 2 && bringer() < warp_size)
      tell_stops(n + told_at_once / 2);
  }
}

template <class T, Visit What>
PD_DEVICE int Pipeline<T, What>::first_left(const Stop& at) {
  return max(left_slots, at.interior) + bringer();
}

template <class T, Visit What>
PD_DEVICE typename Pipeline<T, What>::Left Pipeline<T, What>::left_at(const Stop& at, int s) const {
  if (s >= at.slots) return {0, 0};
  return {plan().slot_row[at.first_slot + s], place_of_force(at, s)};
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::sum_shared(unsigned n, Left left) const {
  const Stop at = told(n);
  const Work all = work();
  const Entries entries = entries_of(n);
#pragma unroll 1
  for (int s = first_left(at); s < at.slots;) {
    all.leave_force(left.place, sum_entries_briefly<T, 2>(entries, left.row), round_);
    s += bringer_threads;
    left = left_at(at, s);
  }
}

template <class T, Visit What>
PD_DEVICE unsigned Pipeline<T, What>::vertex_of(const Stop& at, int slot) const {
  return at.vertex + unsigned(slot < at.interior ? at.first_vertex + slot
                                                 : plan().slot_vertex[at.first_slot + slot]);
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::find(const Stop& in, unsigned (&vertex)[brought]) const {
  const Stop at = in;
#pragma unroll
  for (int r = 0; r < brought; ++r) {
    const int s = bringer() + r * bringer_threads;
    int found = at.first_vertex + (s < at.interior ? s : 0);
    if (s >= at.interior && s < at.slots) found = plan().slot_vertex[at.first_slot + s];
    vertex[r] = unsigned(found);
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::ask(const Stop& in, const unsigned (&vertex)[brought],
                                      Held& held) const {
  const Stop at = in;
  const Work all = work();
  const RestPoint<T>* rest = rest_positions(plan(), 0);
#pragma unroll
  for (int r = 0; r < brought; ++r) {
    const int s = bringer() + r * bringer_threads;
    const unsigned slot = unsigned(at.first_slot + (s < at.slots ? s : 0));
    held.u[r] = vec3(all.v.u[at.vertex + vertex[r]]);
    held.origin[r] = vec3(all.origin[at.slot + slot]);
    held.rest[r] = rest[slot];
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::put(int slots, unsigned n, const Held& held) const {
  const Slots<T> to = slots_of(n);
#pragma unroll
  for (int r = 0; r < brought; ++r) {
    const int s = bringer() + r * bringer_threads;
    if (s < slots) to.set(s, held.origin[r] + held.u[r], held.rest[r].bits());
  }
  if (slots <= usual_slots) return;
  const Stop at = told(n);
  const Work all = work();
#pragma unroll 1
  for (int s = bringer() + usual_slots; s < slots; s += bringer_threads) {
    const unsigned slot = unsigned(at.first_slot + s);
    const Vec3<T> origin = vec3(all.origin[at.slot + slot]);
    to.set(s, origin + vec3(all.v.u[vertex_of(at, s)]), rest_positions(plan(), 0)[slot].bits());
  }
}

}  // namespace pd::inline PD_TARGET
