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
  int row, place;
};

// Past the last stop, too: nothing is brought, but the forces of the two before are there.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::bring_slots() const {
  int vertex[brought];
  find(told(0), vertex);
  await_kernel_before();
#pragma unroll 1
  for (unsigned n = 0; n < 2 || told(n - 2).blocks > 0; ++n) {
    Held held;
    ask(told(n), vertex, held);
    find(told(n + 1), vertex);
    Left left{};
    if (n >= 2) {
      left = left_at(told(n - 2), first_left(told(n - 2)));
      await(forces_ready, n - 2);
    }
    put(told(n), held, n);
    if (n >= 2) sum_shared(n - 2, left);
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
  const Stop& at = told(n);
  const Work w = work(at.environment);
  const Entries entries = entries_of(n);
  const int slots = at.slots;
#pragma unroll 1
  for (int s = first_left(at); s < slots;) {
    w.leave_force(left.place, sum_entries_briefly<T>(entries, left.row), round_);
    s += bringer_threads;
    left = left_at(at, s);
  }
}

template <class T, Visit What>
PD_DEVICE int Pipeline<T, What>::vertex_of(const Stop& at, int slot) const {
  return slot < at.interior ? at.first_vertex + slot : plan().slot_vertex[at.first_slot + slot];
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::find(const Stop& at, int (&vertex)[brought]) const {
#pragma unroll
  for (int r = 0; r < brought; ++r) {
    const int s = bringer() + r * bringer_threads;
    vertex[r] = at.first_vertex + (s < at.interior ? s : 0);
    if (s >= at.interior && s < at.slots) vertex[r] = plan().slot_vertex[at.first_slot + s];
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::ask(const Stop& at, const int (&vertex)[brought],
                                      Held& held) const {
  const Work w = work(at.environment);
  const Quad<T>* origin = w.origin + at.first_slot;
  const RestPoint<T>* rest = rest_positions(w.plan, at.first_slot);
#pragma unroll
  for (int r = 0; r < brought; ++r) {
    int s = bringer() + r * bringer_threads;
    if (s >= at.slots) s = 0;
    held.u[r] = vec3(w.v.u[vertex[r]]);
    held.origin[r] = vec3(origin[s]);
    held.rest[r] = rest[s];
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::put(const Stop& at, const Held& held, unsigned n) const {
  const Work w = work(at.environment);
  const RestPoint<T>* rest = rest_positions(w.plan, at.first_slot);
  const Slots<T> slots = slots_of(n);
#pragma unroll
  for (int r = 0; r < brought; ++r) {
    const int s = bringer() + r * bringer_threads;
    if (s < at.slots) slots.set(s, held.origin[r] + held.u[r], held.rest[r].bits());
  }
#pragma unroll 1
  for (int s = bringer() + usual_slots; s < at.slots; s += bringer_threads) {
    const Vec3<T> origin = vec3(w.origin[at.first_slot + s]);
    slots.set(s, origin + vec3(w.v.u[vertex_of(at, s)]), rest[s].bits());
  }
}

}  // namespace pd::inline PD_TARGET
