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
  work.out_info = step.info;
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

// The same call without a tolerance: passes write the free iterate in place of the one before. Tasks of contact stop.
template <class T>
StreamCall<T> without_tolerance(const StreamCall<T>& call) {
  StreamCall<T> own = call;
  own.step.settings.tolerance = 0;
  own.stops = true;
  return own;
}

// `HasContacts`: with planes and spheres of the scene, see solver/vertex.h.
template <class T, bool HasContacts>
class ContactRunner : public StreamRunner<T, HasContacts> {
  using Base = StreamRunner<T, HasContacts>;

 public:
  ContactRunner(const StreamCall<T>& call, const ContactWork<T>& work,
                const StencilWork<T>* stencils, cudaStream_t stream)
      : Base(without_tolerance(call), nullptr, stencils, stream),
        work_(work),
        flags_(contact_flags(work)),
        stream_(stream) {
    this->call_.skipped = flags_.is_free;
  }

  void rollout() {
    prepare_contact(work_, stream_);
    if (work_.free_positions) run(ContactTask::look_for_free);
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
      if (HasContacts) {
        this->call_.skipped = flags_.is_correct;
        this->template pass<Visit::keep_forces>(int(Iterate::last));
        this->call_.skipped = flags_.is_free;
      }
      run(ContactTask::correct, k, trial);
    }
  }

  ContactWork<T> work_;
  ContactFlags flags_;
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
void run_contact_with(const StreamCall<T>& call, const ContactWork<T>& work,
                      const StencilWork<T>* stencils, cudaStream_t stream) {
  if (has_contacts(call.step)) {
    run_contact_with<T, true>(call, work, stencils, stream);
  } else {
    run_contact_with<T, false>(call, work, stencils, stream);
  }
}

template <class T>
std::int64_t block_bytes(const DeviceStep<T>& step) {
  return fused_bytes(step);
}
template <class T>
std::int64_t block_bytes(const MixedStep<T>& step) {
  return mixed_block_bytes(step);
}

// A step with contact and its memory.
//
// The step without contact, which environments in which nothing comes near take, runs as kernel `block` for all of them
// before contact does, where that kernel has room for a scene: then it takes a small share of the time. Its scratch is
// where other arrays are later.
template <class Step>
struct ContactStep {
  using T = typename Step::real;
  StreamCall<T> call;
  StencilWork<T> stencils;  // of a scene that has some
  ContactWork<T> work;
  Step free;  // the step without contact
  bool tries_free;
  void* scratch;
  std::int64_t bytes;

  // `place(arena)` places what passes need.
  template <class Place>
  ContactStep(const WithContact<Step>& given, void* memory, const Place& place)
      : call{given.step, {}}, free(given.step) {
    const DevicePlan<T>& plan = free.plan;
    const Material<T>& material = free.material;
    const std::size_t shared =
        fused_shared_bytes(sizeof(T), false, plan.most_slots, plan.most_entries,
                           material.planes_count, material.spheres_count);
    tries_free =
        given.contact.plan.can_be_free && plan.patches == 1 && shared <= shared_memory_per_block();
    free.plan.kernel = int(DeviceKernel::block);
    Arena arena(memory);
    if (tries_free) {
      const std::int64_t numbers = 3 * free.batch * plan.vertices;
      arena.place(free.out_positions, numbers);
      arena.place(free.out_velocities, numbers);
      if (free.info) arena.place(free.info, free.batch * info_count);
    }
    const std::int64_t begin = arena.size();
    const auto at = [&](std::int64_t n) {
      return memory ? static_cast<std::byte*>(memory) + n : nullptr;
    };
    scratch = at(begin);
    place(arena, *this);
    work = contact_work(call, given.contact, free.settings, at(arena.size()));
    if (tries_free) {
      work.free_positions = free.out_positions;
      work.free_velocities = free.out_velocities;
      work.free_info = free.info;
    }
    bytes =
        std::max(arena.size() + contact_bytes(work), begin + (tries_free ? block_bytes(free) : 0));
  }
};

template <class T>
ContactStep<DeviceStep<T>> contact_step(const WithContact<DeviceStep<T>>& given, void* memory) {
  return {given, memory,
          [](Arena& arena, auto& own) { own.call.memory = arrange(arena, own.call); }};
}
template <class T>
ContactStep<MixedStep<T>> contact_step(const WithContact<MixedStep<T>>& given, void* memory) {
  const MixedStep<T> step = with_rows(given.step);
  return {{step, given.contact}, memory, [&](Arena& arena, auto& own) {
            own.stencils = arrange_mixed(arena, step, own.call);
          }};
}

template <class T>
std::int64_t contact_stream_bytes(const WithContact<DeviceStep<T>>& given) {
  return contact_step(given, nullptr).bytes;
}

template <class T>
void run_contact_stream(const WithContact<DeviceStep<T>>& given, void* memory, Stream to) {
  const auto own = contact_step(given, memory);
  if (own.tries_free) run_fused(own.free, own.scratch, to);
  run_contact_with<T>(own.call, own.work, nullptr, static_cast<cudaStream_t>(to));
}

template <class T>
std::int64_t contact_mixed_bytes(const WithContact<MixedStep<T>>& given) {
  return contact_step(given, nullptr).bytes;
}

template <class T>
void run_contact_mixed(const WithContact<MixedStep<T>>& given, void* memory, Stream to) {
  const auto own = contact_step(given, memory);
  if (own.tries_free) run_mixed_block(own.free, own.scratch, to);
  const auto stream = static_cast<cudaStream_t>(to);
  compute_stencil_numbers(own.stencils, own.free.effects, own.free.batch, stream);
  compute_row_numbers(own.stencils, own.free.batch, stream);
  run_contact_with<T>(own.call, own.work, &own.stencils, stream);
}

}  // namespace pd::inline PD_TARGET
