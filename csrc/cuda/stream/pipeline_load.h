// Members of Pipeline that load the slots of a patch into shared memory, and sum the forces that
// updaters leave to loaders.
#pragma once
#include "cuda/stream/pipeline.h"

namespace pd::inline PD_TARGET {

// Slot data in flight.
template <class T, Visit What>
struct Pipeline<T, What>::SlotData {
  Vec3<T> u[loaded_slots], origin[loaded_slots];
  RestPoint<T> rest[loaded_slots];
};

// A force that loaders sum, since they wait more than updaters.
template <class T, Visit What>
struct Pipeline<T, What>::RemainingForce {
  int row;
  unsigned place;
};

// Continues for two entries past the end of the schedule: it loads nothing there, but sums the
// forces of the last two patches.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::load_slots() const {
  unsigned vertex[loaded_slots];
  load_vertices(scheduled(0), vertex);
  wait_for_previous_kernel();
#pragma unroll 1
  for (unsigned n = 0; n < 2 || scheduled(n - 2).blocks > 0; ++n) {
    SlotData data;
    load_slot_data(scheduled(n), vertex, data);
    load_vertices(scheduled(n + 1), vertex);
    RemainingForce remaining{};
    if (n >= 2) {
      const ScheduledPatch at = scheduled(n - 2);
      remaining = remaining_at(at, first_remaining(at));
      wait(forces_ready, n - 2);
    }
    // sums forces first, while the slot loads are in flight
    if (n >= 2) sum_remaining(n - 2, remaining);
    store_slots(scheduled(n).slots, n, data);
    arrive(slots_ready, n);
    if (n % schedule_chunk == schedule_chunk / 2 && loader() < warp_size)
      extend_schedule(n + schedule_chunk / 2);
  }
}

template <class T, Visit What>
PD_DEVICE int Pipeline<T, What>::first_remaining(const ScheduledPatch& at) {
  return max(updated_slots, at.interior) + loader();
}

template <class T, Visit What>
PD_DEVICE typename Pipeline<T, What>::RemainingForce Pipeline<T, What>::remaining_at(
    const ScheduledPatch& at, int s) const {
  if (s >= at.slots) return {0, 0};
  return {plan().slot_row[at.first_slot + s], place_of_force(at, s)};
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::sum_remaining(unsigned n, RemainingForce remaining) const {
  const ScheduledPatch at = scheduled(n);
  const Work all = work();
  const Entries entries = entries_of(n);
#pragma unroll 1
  for (int s = first_remaining(at); s < at.slots;) {
    all.store_force(remaining.place, sum_entries_compact<T, 2>(entries, remaining.row), round_);
    s += loader_threads;
    remaining = remaining_at(at, s);
  }
}

template <class T, Visit What>
PD_DEVICE unsigned Pipeline<T, What>::vertex_of(const ScheduledPatch& at, int slot) const {
  return at.vertex + unsigned(slot < at.interior ? at.first_vertex + slot
                                                 : plan().slot_vertex[at.first_slot + slot]);
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::load_vertices(const ScheduledPatch& in,
                                                unsigned (&vertex)[loaded_slots]) const {
  const ScheduledPatch at = in;
#pragma unroll
  for (int r = 0; r < loaded_slots; ++r) {
    const int s = loader() + r * loader_threads;
    int found = at.first_vertex + (s < at.interior ? s : 0);
    if (s >= at.interior && s < at.slots) found = plan().slot_vertex[at.first_slot + s];
    vertex[r] = unsigned(found);
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::load_slot_data(const ScheduledPatch& in,
                                                 const unsigned (&vertex)[loaded_slots],
                                                 SlotData& data) const {
  const ScheduledPatch at = in;
  const Work all = work();
  const RestPoint<T>* rest = rest_positions(plan(), 0);
#pragma unroll
  for (int r = 0; r < loaded_slots; ++r) {
    const int s = loader() + r * loader_threads;
    const unsigned slot = unsigned(at.first_slot + (s < at.slots ? s : 0));
    data.u[r] = vec3(all.v.u[at.vertex + vertex[r]]);
    data.origin[r] = vec3(all.origin[at.slot + slot]);
    data.rest[r] = rest[slot];
  }
}

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::store_slots(int slots, unsigned n, const SlotData& data) const {
  const Slots<T> to = slots_of(n);
#pragma unroll
  for (int r = 0; r < loaded_slots; ++r) {
    const int s = loader() + r * loader_threads;
    if (s < slots) to.set(s, data.origin[r] + data.u[r], data.rest[r].bits());
  }
  if (slots <= usual_slots) return;
  const ScheduledPatch at = scheduled(n);
  const Work all = work();
#pragma unroll 1
  for (int s = loader() + usual_slots; s < slots; s += loader_threads) {
    const unsigned slot = unsigned(at.first_slot + s);
    const Vec3<T> origin = vec3(all.origin[at.slot + slot]);
    to.set(s, origin + vec3(all.v.u[vertex_of(at, s)]), rest_positions(plan(), 0)[slot].bits());
  }
}

}  // namespace pd::inline PD_TARGET
