// Runs solver/step.h inside a kernel, with several environments per block, for meshes so small that
// one environment leaves lanes idle. The pairs of all environments fill the warps one after
// another.
//
// The assignment of threads, and the other environments of a block, never affect the order of a
// sum, so the bits do not depend on them. The launch may choose both by the batch.
#pragma once
#include "cuda/common/team.h"
#include "cuda/common/vertices.h"
#include "cuda/elements/pair_weights.h"
#include "cuda/elements/pairs_per_thread.h"
#include "cuda/rigid/rounds.h"
#include "cuda/small_batch/call.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

// `HasContacts`, `HasFreePieces`: see cuda/fused/runner.h. `OnePerThread`: no thread has a second pair, so
// each keeps its pair's data in registers. `FewRegisters`: too few registers to load all forces on
// a vertex at once.
template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
class SmallBatchRunner {
  using LoadedVertex = typename Vertices<T, HasContacts>::LoadedVertex;

  // A pair or a vertex of one environment.
  struct WorkItem {
    int environment, at;
  };

 public:
  // `shared`: SmallBatchLayout::bytes
  PD_DEVICE SmallBatchRunner(const SmallBatchCall<T>& call, std::byte* shared)
      : whole_(call),
        shared_(shared),
        call_(call.step),
        plan_(call.step.plan),
        set_(call.step.settings),
        memory_(call.scratch),
        pair_stride_(call.pair_stride),
        slot_stride_(call.slot_stride),
        first_of_block_(blockIdx.x * unsigned(call.per_block)),
        h_(T(call.step.settings.time_step)),
        theta_(call.relaxation) {
    const SmallBatchLayout<T> layout(call.step, call.per_block);
    control_ = reinterpret_cast<EnvironmentControl<T>*>(shared);
    position_ = reinterpret_cast<Quad<T>*>(shared + layout.vectors);
    const int all = call.per_block * plan_.most_slots;
    const std::int64_t far = std::int64_t(first_of_block_) * plan_.most_slots;
    v_ = {memory_.x + far, memory_.velocity + far, position_ + all, position_ + 2 * all,
          position_ + 3 * all};
    origin_ = position_ + 4 * all;
    entries_ = reinterpret_cast<Quad<T>*>(shared + layout.entries);
    pair_energy_ = reinterpret_cast<T*>(shared + layout.energies);
    vertex_sum_ = pair_energy_ + call.per_block * plan_.most_pairs;
    spheres_ = reinterpret_cast<Sphere<T>*>(shared + layout.contacts);
    planes_ = reinterpret_cast<Plane<T>*>(spheres_ + call.per_block * call_.material.spheres_count);
    vertex_sums_ = all;
    first_pair_ = item_of(threadIdx.x, pairs());
    first_slot_ = item_of(threadIdx.x, slots());
  }

  // Runs all steps of environments `first` to `first + here - 1`.
  PD_DEVICE void rollout(std::int64_t first, int here) {
    first_ = first;
    here_ = here;
    load();
    assemble_diagonal();
    for (int t = 0; t < set_.steps; ++t) {
      step(*this, set_);
      if ((t + 1) % set_.every == 0) store((t + 1) / set_.every - 1);
      move_spheres();
    }
    __syncthreads();
  }

  PD_DEVICE void predict() {
    __syncthreads();
    each_slot([&](const WorkItem& item, int i) {
      v_.predict(i, inputs(item.environment), item.at, h_);
      origin_[i] = quad(vec3(v_.x[i]) - vec3(v_.x[i - item.at]));
    });
  }

  PD_DEVICE void start() {
    each_slot([&](const WorkItem& item, int i) {
      const Vec3<T> u = v_.first(i, inputs(item.environment), item.at, contacts(item.environment));
      move(i, u);
      v_.set_before(i, u);
    });
    for (int e = threadIdx.x; e < here_; e += blockDim.x) {
      EnvironmentControl<T>& control = control_[e];
      Progress& progress = control.progress;
      progress.schedule = Schedule(set_, progress.min_share, contacts(e).friction() > T(0));
      control.omega[0] = T(progress.schedule.next(0));
      if (stops()) progress.stop = {inputs(e).free_fall_squared()};
      progress.used = set_.iterations;
      progress.done = false;
    }
    finished_ = pending_ = started_ = false;
    __syncthreads();
  }

  // The coarse correction of every piece that pins leave free.
  PD_DEVICE void align() {
    apply_last_sums();
    if constexpr (HasFreePieces) align_pieces();
  }

  PD_DEVICE void iterate(int k) {
    if (k % guard_period == 0 && set_.schedule == ScheduleKind::guarded) {
      iterate_with<true>(k);
    } else {
      iterate_with<false>(k);
    }
  }

  PD_DEVICE bool finished() const { return finished_; }

  PD_DEVICE void finish() {
    each_slot([&](const WorkItem&, int i) { v_.finish(i, h_); });
  }

 private:
  // The per-vertex values that are summed over an environment.
  enum VertexSum { energy_sum, change_sum, displacement_sum };

  PD_DEVICE bool stops() const { return stops_; }
  // of the plan's only patch
  PD_DEVICE int pairs() const { return plan_.most_pairs; }
  PD_DEVICE int slots() const { return plan_.most_slots; }
  PD_DEVICE Inputs<T> inputs(int environment) const { return {&call_, first_ + environment}; }
  PD_DEVICE Contacts<T> contacts(int environment) const {
    const int planes = call_.material.planes_count, spheres = call_.material.spheres_count;
    return {planes_ + environment * planes, spheres_ + environment * spheres, planes, spheres};
  }
  PD_DEVICE T* weights(int environment) const {
    return memory_.weights +
           (first_of_block_ + environment) * unsigned(2 * pair_lanes * plan_.blocks);
  }
  PD_DEVICE Piece& piece(int environment, int piece) const {
    return memory_.pieces[std::int64_t(first_of_block_ + environment) * plan_.pieces + piece];
  }
  PD_DEVICE double* part_sums(int environment) const {
    return memory_.part_sum +
           std::int64_t(first_of_block_ + environment) * count_rows(plan_) * PartSums::count;
  }
  PD_DEVICE Correction<T, HasContacts> correction(int environment, Iterate from) const {
    return {v_, contacts(environment), inputs(environment),
            memory_.forces.of_environment(first_of_block_ + environment), from};
  }

  // ---- assignment of work

  PD_DEVICE static WorkItem item_of(int number, int each) { return {number / each, number % each}; }
  // this thread's next item
  PD_DEVICE static WorkItem after(const WorkItem& item, int each, const Stride& stride) {
    const int at = item.at + stride.rest;
    const bool next = at >= each;
    return {item.environment + stride.whole + next, next ? at - each : at};
  }

  // visit(item, index in the arrays of all environments)
  template <class Visit>
  PD_DEVICE void each_slot(const Visit& visit) {
    for (WorkItem item = first_slot_; item.environment < here_;
         item = after(item, slots(), slot_stride_))
      visit(item, item.environment * slots() + item.at);
  }
  // One warp per environment, from the last warp on, which has the fewest pairs.
  template <class Visit>
  PD_DEVICE void each_environment(const Visit& visit) {
    const int warps = blockDim.x / warp_size;
    for (int e = warps - 1 - int(threadIdx.x) / warp_size; e < here_; e += warps) visit(e);
  }

  // ---- elements and vertices

  PD_DEVICE void move(int i, const Vec3<T>& u) {
    v_.set(i, u);
    position_[i] = quad(vec3(origin_[i]) + u);
  }

  PD_DEVICE Vec3<T> force_on(const WorkItem& item) const {
    const Quad<T>* entries = entries_ + item.environment * plan_.most_entries;
    const int row = plan_.slot_row[item.at];
    return FewRegisters ? sum_entries(entries, row) : sum_entries_by_8<T>(entries, row);
  }

  // Loads the data of this thread's next pair, or of its first pair again.
  PD_DEVICE void prefetch_pair(const WorkItem& next) {
    if (first_pair_.environment >= here_) return;
    const WorkItem& item = next.environment < here_ ? next : first_pair_;
    pair_ = load_pair(plan_, weights(item.environment), PairPlace{unsigned(item.at)});
  }

  // Applies an element functor to all pairs, one pair per thread.
  template <bool Energies, class Element>
  PD_DEVICE void each_pair(const Element& element) {
    const StoredRest<T> rest{plan_.pair_rest};
    for (WorkItem item = first_pair_; item.environment < here_;) {
      const Quad<T>* position = position_ + item.environment * slots();
      Quad<T>* entries = entries_ + item.environment * plan_.most_entries;
      const auto read = [&](unsigned corner, Vec3<T>(&x)[1]) {
        x[0] = at_corner(position, corner);
      };
      T energy = T(0);
      process_pair<1>(read, rest.read(PairPlace{unsigned(item.at)}, pair_), pair_, entries, element,
                      energy);
      if constexpr (Energies) pair_energy_[item.environment * pairs() + item.at] = energy;
      if constexpr (OnePerThread) break;
      item = after(item, pairs(), pair_stride_);
      prefetch_pair(item);
    }
  }

  template <bool Guard>
  PD_DEVICE void iterate_with(int k) {
    each_pair<Guard>(SolidGradient<Guard>{});
    if (stops() && pending_) apply_sums(k, [](int) {});
    __syncthreads();
    if (stops() && all_done()) {
      finished_ = true;
      pending_ = false;
      return;
    }
    each_slot([&](const WorkItem& item, int i) {
      const EnvironmentControl<T>& control = control_[item.environment];
      if (stops() && control.progress.done) return;
      const LoadedVertex loaded = v_.load(i);
      const Vec3<T> force = force_on(item);
      if constexpr (Guard) store_sum(energy_sum, i, loaded.energy());
      const Vec3<T> next =
          loaded.next(contacts(item.environment), force, theta_, control.omega[k & 1]);
      if (stops()) {
        const Vec3<T> change = next - loaded.u;
        store_sum(change_sum, i, double(dot(change, change)));
        store_sum(displacement_sum, i, loaded.square_of_displacement());
      }
      v_.set_before(i, loaded.u);
      v_.set(i, next);
      position_[i] = quad(vec3(origin_[i]) + next);
    });
    // by the warps with the fewest vertices, while others update theirs
    const auto compute_omega = [&](int e) { control_[e].compute_omega(k + 1); };
    if (!stops() && pending_) {
      apply_sums(k, compute_omega);
    } else if (in_leading_warp() && lane() < here_) {
      compute_omega(lane());
    }
    pending_ = stops() || Guard;
    __syncthreads();
  }

  PD_DEVICE bool all_done() const {
    for (int e = 0; e < here_; ++e)
      if (!control_[e].progress.done) return false;
    return true;
  }

  // ---- sums

  // stored in the precision T
  PD_DEVICE void store_sum(VertexSum which, int i, double value) {
    vertex_sum_[int(which) * vertex_sums_ + i] = T(value);
  }

  template <class Op>
  PD_DEVICE double reduce_over_vertices(VertexSum which, int environment, Op op) const {
    const T* values = vertex_sum_ + int(which) * vertex_sums_ + environment * slots();
    double sum = Op::identity;
    for (int s = lane(); s < slots(); s += warp_size) sum = op(sum, double(values[s]));
    return warp_reduce(sum, op);
  }
  PD_DEVICE double energy_of(int environment) const {
    const T* values = pair_energy_ + environment * pairs();
    double sum = 0;
    for (int p = lane(); p < pairs(); p += warp_size) sum += double(values[p]);
    return warp_reduce(sum, Add{}) + reduce_over_vertices(energy_sum, environment, Add{});
  }

  // Applies the sums of iteration k - 1; then one thread of each environment calls `then`.
  template <class Then>
  PD_DEVICE void apply_sums(int k, const Then& then) {
    const bool guarded = (k - 1) % guard_period == 0 && set_.schedule == ScheduleKind::guarded;
    each_environment([&](int e) {
      EnvironmentControl<T>& control = control_[e];
      Progress& progress = control.progress;
      if (stops() && progress.done) return;
      const double energy = guarded ? energy_of(e) : 0;
      const double change = stops() ? reduce_over_vertices(change_sum, e, Add{}) : 0;
      const double displacement = stops() ? reduce_over_vertices(displacement_sum, e, Add{}) : 0;
      if (lane() == 0) {
        if (guarded) progress.schedule.check(energy);
        if (stops() && progress.ends(set_.tolerance, double(control.omega[(k - 1) & 1]), change,
                                     displacement)) {
          progress.done = true;
          progress.used = k;
        }
        then(e);
      }
    });
    __syncwarp();
  }

  // Applies the sums of the final iteration.
  PD_DEVICE void apply_last_sums() {
    if (!pending_) return;
    apply_sums(set_.iterations, [](int) {});
    pending_ = false;
    __syncthreads();
  }

  // ---- initialisation

  PD_DEVICE void load() {
    for (int e = threadIdx.x; e < here_; e += blockDim.x)
      inputs(e).read_contacts(planes_ + e * call_.material.planes_count,
                              spheres_ + e * call_.material.spheres_count);
    each_slot([&](const WorkItem& item, int i) {
      v_.init(i, inputs(item.environment), item.at, h_);
      position_[i] = {T(0), T(0), T(0), T(0)};
    });
    __syncthreads();
  }

  PD_DEVICE void move_spheres() {
    if constexpr (!HasContacts) return;
    __syncthreads();
    for (int b = threadIdx.x; b < here_ * call_.material.spheres_count; b += blockDim.x)
      spheres_[b].center = spheres_[b].center + spheres_[b].motion;
    __syncthreads();
  }

  // Computes a and 1 / D of every vertex, w V of every element, and the smallest a / D.
  PD_DEVICE void assemble_diagonal() {
    compute_weights(set_.weighted);
    for (int e = threadIdx.x; e < here_; e += blockDim.x) control_[e].progress.done = false;
    pending_ = false;
    each_pair<false>(SolidDiagonal{});
    __syncthreads();
    each_slot([&](const WorkItem& item, int i) {
      store_sum(energy_sum, i, v_.set_diagonal(i, force_on(item).x));
    });
    __syncthreads();
    each_environment([&](int e) {
      const double least = reduce_over_vertices(energy_sum, e, Min{});
      if (lane() == 0) control_[e].progress.min_share = least;
    });
    if (set_.weighted) compute_weights(false);
    __syncthreads();
  }

  PD_DEVICE void compute_weights(bool bounded) {
    const StoredRest<T> rest{plan_.pair_rest};
    for (WorkItem item = first_pair_; item.environment < here_;
         item = after(item, pairs(), pair_stride_))
      compute_pair_weights(
          plan_, rest, PairPlace{unsigned(item.at)},
          Moduli<T>(call_.material.stiffness, call_.poisson, first_ + item.environment),
          bounded ? WeightKind::majoriser : WeightKind::force, weights(item.environment));
    // each thread reads only weights that it wrote itself
    prefetch_pair(first_pair_);
  }

  // ---- coarse correction: cuda/small_batch/rigid.h

  struct Rounds;

  PD_DEVICE void align_pieces() {
    const bool first = !started_;
    started_ = true;
    if (plan_.pieces == 0 || (first && set_.start() == StartKind::given)) return;
    align_out_of_line(whole_, shared_, first_, here_, first);
    // reloads the pair: registers live across the call would be spilled in the iterations too
    prefetch_pair(first_pair_);
  }

  // Uses a runner of its own, so that this runner stays in registers. `first`: no iterate precedes
  // this one.
  PD_DEVICE_COLD static void align_out_of_line(const SmallBatchCall<T>& call, std::byte* shared,
                                               std::int64_t first_environment, int here,
                                               bool first) {
    SmallBatchRunner run(call, shared);
    run.first_ = first_environment;
    run.here_ = here;
    run.correct_pieces(first);
  }

  PD_DEVICE void correct_pieces(bool first);
  PD_DEVICE void keep_forces(Iterate from);
  template <class Visit>
  PD_DEVICE void each_slot_of_a_piece(const Visit& visit);

  // ---- results

  PD_DEVICE void store(int record) {
    each_slot([&](const WorkItem& item, int i) {
      inputs(item.environment).write(record, item.at, vec3(v_.x[i]), vec3(v_.velocity[i]));
    });
    for (int e = threadIdx.x; e < here_; e += blockDim.x)
      inputs(e).write_info(record, control_[e].progress);
  }

  const SmallBatchCall<T>& whole_;
  std::byte* shared_;
  const DeviceStep<T>& call_;
  const DevicePlan<T>& plan_;
  const Settings& set_;
  const SmallBatchScratch<T>& memory_;
  const Stride &pair_stride_, &slot_stride_;
  unsigned first_of_block_;         // in scratch memory
  std::int64_t first_ = 0;          // first environment
  int here_ = 0;                    // and their number
  EnvironmentControl<T>* control_;  // of each environment
  Quad<T>* position_;               // positions that elements read
  Quad<T>* origin_;   // positions at the start of the step, relative to the first vertex
  Quad<T>* entries_;  // element forces
  Vertices<T, HasContacts> v_;
  T *pair_energy_, *vertex_sum_;  // of all environments; the latter once per VertexSum
  int vertex_sums_;
  Sphere<T>* spheres_;
  Plane<T>* planes_;
  WorkItem first_pair_, first_slot_;  // of this thread
  PairInputs<T> pair_;                // its next pair
  T h_;
  const T& theta_;
  int stops_ = in_register(int(set_.tolerance > 0));
  bool finished_ = false, pending_ = false, started_ = false;
};

}  // namespace pd::inline PD_TARGET
