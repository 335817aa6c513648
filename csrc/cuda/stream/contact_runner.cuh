// A step with contact between bodies: the passes of kernel `stream` find the free iterate, the
// tasks of cuda/contact do the rest.
#pragma once
#include "cuda/contact/launch.h"
#include "cuda/stream/runner.cuh"
#include "solver/contact/schedule.h"

namespace pd::inline PD_TARGET {

template <class T>
ContactWork<T> contact_work(const StreamCall<T>& call, const ContactCall<T>& contact,
                            const Settings& settings, void* memory) {
  const DeviceStep<T>& step = call.step;
  const DevicePlan<T>& plan = step.plan;
  const StreamMemory<T>& m = call.memory;
  const auto numbers = [](auto* array) { return reinterpret_cast<T*>(array); };
  ContactWork<T> work;
  work.contact = contact;
  work.material = step.material;
  work.settings = settings;
  work.batch = step.batch;
  work.vertices = plan.vertices;
  work.pieces = plan.pieces;
  work.slots = plan.slots;
  work.order = plan.vertex_order;
  work.slot_vertex = plan.slot_vertex;
  work.slot_piece = plan.slot_piece;
  work.positions = step.positions;
  work.velocities = step.velocities;
  work.out_positions = step.out_positions;
  work.out_velocities = step.out_velocities;
  work.x = numbers(m.x);
  work.u = numbers(m.u);
  work.before = numbers(m.before);
  work.target = numbers(m.target);
  work.planes = numbers(m.planes);
  work.spheres = numbers(m.spheres);
  work.wall_forces = numbers(m.forces.force);
  work.sums = m.sums;
  work.sum_rows = call.sum_rows();
  work.progress = m.progress;
  work.omega = m.omega;
  work.memory = memory;
  return work;
}

// The same call without a tolerance: passes write the free iterate in place of the one before, and
// environments that are done keep theirs.
template <class T>
StreamCall<T> without_tolerance(const StreamCall<T>& call) {
  StreamCall<T> own = call;
  own.step.settings.tolerance = 0;
  return own;
}

// `HasContacts`: with planes and spheres of the scene, see solver/vertex.h.
template <class T, bool HasContacts>
class ContactRunner : public StreamRunner<T, HasContacts> {
  using Base = StreamRunner<T, HasContacts>;

 public:
  ContactRunner(const StreamCall<T>& call, const ContactWork<T>& work,
                const StencilWork<T>* stencils, cudaStream_t stream)
      : Base(without_tolerance(call), nullptr, stencils, stream), work_(work), stream_(stream) {}

  void rollout() {
    prepare_contact(work_, stream_);
    this->template vertices<VertexTask::load>(0);
    this->assemble_diagonal();
    step(*this, this->set_);
    this->store(0);
    run(ContactTask::write);
  }

  void start() {
    Base::start();
    run(ContactTask::start);
    begun_ = false;
  }

  void align() {
    if (begun_ && !moves_rigidly()) return;
    if (work_.pieces > 0) keep_displacements(work_, stream_);
    Base::align();
    run(begun_ ? ContactTask::go_last : ContactTask::go_first);
    correct(begun_ ? this->set_.iterations : 0);
    begun_ = true;
  }

  void iterate(int k) {
    if (has_correction(k, this->set_.iterations)) correct(k);
    if (k % guard_period == 0 && this->set_.schedule == ScheduleKind::guarded) {
      this->template pass<Visit::update_guarded, false>(k);
    } else {
      this->template pass<Visit::update, false>(k);
    }
    run(ContactTask::iterate, k);
  }

  void finish() {
    run(ContactTask::finish);
    Base::finish();
  }

 private:
  // whether there are bodies or colliders for a coarse correction
  bool moves_rigidly() const { return work_.pieces > 0 || work_.contact.plan.rigid; }

  void run(ContactTask task, int k = 0, int trial = 0) {
    run_contact(task, work_, k, trial, stream_);
  }

  // The coarse correction of bodies in contact. Environments that do not ask for a trial return at once.
  void correct(int k) {
    if (!moves_rigidly()) return;
    for (int trial = 0; trial < (HasContacts ? coarse_trials : 1); ++trial) {
      run(ContactTask::begin_correction, k, trial);
      if (HasContacts) this->template pass<Visit::keep_forces>(int(Iterate::last));
      run(ContactTask::correct, k, trial);
    }
  }

  ContactWork<T> work_;
  cudaStream_t stream_;
  bool begun_ = false;
};

template <class T, bool HasContacts>
void run_contact_with(const StreamCall<T>& call, const ContactWork<T>& work,
                      const StencilWork<T>* stencils, cudaStream_t stream) {
  const std::size_t bytes =
      pass_shared_bytes(sizeof(T), call.step.plan.most_slots, call.step.plan.most_entries, 2);
  if (stencils) {
    allow_mixed_passes<T, HasContacts>(bytes);
    allow_mixed_passes<T, false>(bytes);
  } else {
    allow_shared_memory<T, HasContacts>(bytes);
    allow_shared_memory<T, false>(bytes);
  }
  ContactRunner<T, HasContacts>(call, work, stencils, stream).rollout();
}

template <class T>
void run_contact_with(const StreamCall<T>& call, const ContactCall<T>& contact,
                      const Settings& settings, void* memory, const StencilWork<T>* stencils,
                      cudaStream_t stream) {
  const ContactWork<T> work = contact_work(call, contact, settings, memory);
  if (has_contacts(call.step)) {
    run_contact_with<T, true>(call, work, stencils, stream);
  } else {
    run_contact_with<T, false>(call, work, stencils, stream);
  }
}

template <class T>
std::int64_t contact_stream_bytes(const WithContact<DeviceStep<T>>& given) {
  Arena arena(nullptr);
  StreamCall<T> call{given.step, {}};
  arrange(arena, call);
  return arena.size() +
         contact_bytes(contact_work(call, given.contact, given.step.settings, nullptr));
}

template <class T>
void run_contact_stream(const WithContact<DeviceStep<T>>& given, void* memory, Stream to) {
  StreamCall<T> call{given.step, {}};
  Arena arena(memory);
  call.memory = arrange(arena, call);
  run_contact_with<T>(call, given.contact, given.step.settings,
                      static_cast<std::byte*>(memory) + arena.size(), nullptr,
                      static_cast<cudaStream_t>(to));
}

template <class T>
std::int64_t contact_mixed_bytes(const WithContact<MixedStep<T>>& given) {
  const MixedStep<T> step = with_rows(given.step);
  Arena arena(nullptr);
  StreamCall<T> call{step, {}};
  arrange_mixed(arena, step, call);
  return arena.size() + contact_bytes(contact_work(call, given.contact, step.settings, nullptr));
}

template <class T>
void run_contact_mixed(const WithContact<MixedStep<T>>& given, void* memory, Stream to) {
  const MixedStep<T> step = with_rows(given.step);
  const auto stream = static_cast<cudaStream_t>(to);
  StreamCall<T> call{step, {}};
  Arena arena(memory);
  const StencilWork<T> stencils = arrange_mixed(arena, step, call);
  compute_stencil_numbers(stencils, step.effects, step.batch, stream);
  compute_row_numbers(stencils, step.batch, stream);
  run_contact_with<T>(call, given.contact, step.settings,
                      static_cast<std::byte*>(memory) + arena.size(), &stencils, stream);
}

}  // namespace pd::inline PD_TARGET
