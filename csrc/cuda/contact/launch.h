// Entry points of contact between bodies: the tasks of solver/contact/step.h, a launch each for all environments.
//
// Arrays are raw, since every target has types of its own and this part is compiled once. Vertices
// of the step have four numbers each: x, y, z, and the fourth of cuda/common/vertices.h.
#pragma once
#include "contact/views.h"
#include "cuda/common/launch.h"
#include "views/views.h"

#include <cstdint>

namespace pd {

enum class ContactTask {
  look_for_free,
  start,
  go_first,
  begin_correction,
  correct,
  iterate,
  go_last,
  finish,
  write
};

template <class T>
struct ContactWork {
  ContactCall<T> contact;
  Material<T> material;
  Settings settings;
  std::int64_t batch = 0;
  int vertices = 0, pieces = 0, slots = 0;
  const int *order = nullptr, *slot_vertex = nullptr, *slot_piece = nullptr;
  const T *positions = nullptr, *velocities = nullptr;  // of the caller
  T *out_positions = nullptr, *out_velocities = nullptr;
  double* out_info = nullptr;  // [batch, info_count], or null
  // of the step without contact, where it runs: the same arrays
  T *free_positions = nullptr, *free_velocities = nullptr;
  double* free_info = nullptr;
  // of the runner
  T *x = nullptr, *u = nullptr, *before = nullptr, *target = nullptr, *planes = nullptr,
    *spheres = nullptr;
  T* wall_forces =
      nullptr;  // [batch, planes and spheres, vertices, 4]: see cuda/rigid/contact_forces.h
  const double* sums = nullptr;  // [batch, sum_rows, sums_count]
  int sum_rows = 0;
  void* progress = nullptr;  // [batch]
  double* omega = nullptr;   // [batch, guard_period]
  void* memory = nullptr;    // of contact_bytes
};

template <class T>
std::int64_t contact_bytes(const ContactWork<T>& work);

// What all tasks read, before the first.
template <class T>
void prepare_contact(const ContactWork<T>& work, Stream stream);

// [batch] Environments that no task but the last changes, and those that ask for no coarse correction.
struct ContactFlags {
  const unsigned char *is_free, *is_correct;
};
template <class T>
ContactFlags contact_flags(const ContactWork<T>& work);

// `k`: iteration; `trial`: of its coarse correction; `HasRigid`: with colliders that have a mass
template <class T, bool HasRigid>
void run_contact_task(ContactTask task, const ContactWork<T>& work, int k, int trial,
                      Stream stream);
template <class T>
void run_contact(ContactTask task, const ContactWork<T>& work, int k, int trial, Stream stream) {
  const auto run = work.contact.plan.rigid ? run_contact_task<T, true> : run_contact_task<T, false>;
  run(task, work, k, trial, stream);
}

// Keeps the displacements, before a coarse correction.
template <class T>
void keep_displacements(const ContactWork<T>& work, Stream stream);

// A step with contact between bodies, of a plan for kernel `stream`.
template <class Call>
struct WithContact {
  Call step;
  ContactCall<typename Call::real> contact;
};

}  // namespace pd

namespace pd::inline PD_TARGET {

template <class T>
std::int64_t contact_stream_bytes(const WithContact<DeviceStep<T>>& call);
template <class T>
void run_contact_stream(const WithContact<DeviceStep<T>>& call, void* memory, Stream stream);
// The same for scenes with stencils.
template <class T>
std::int64_t contact_mixed_bytes(const WithContact<MixedStep<T>>& call);
template <class T>
void run_contact_mixed(const WithContact<MixedStep<T>>& call, void* memory, Stream stream);

}  // namespace pd::inline PD_TARGET
