// Runs solver/step.h inside a kernel: one launch covers all iterations and all steps of a rollout.
//
// A team of blocks works on one environment at a time, with one patch of the mesh per block. The
// iterate stays in shared memory. A single patch needs no communication; several patches exchange
// once per iteration.
//
// Patches of a grid exchange the forces on their shared vertices. Each patch sums them in the same
// order and updates its own copy of the vertex.
//
// Patches of a cluster share no vertices. Each patch computes all tetrahedra that touch its own
// vertices, and sends the new positions of these vertices.
#pragma once
#include "cuda/common/vertices.h"
#include "cuda/elements/pair_weights.h"
#include "cuda/elements/pairs_per_thread.h"
#include "cuda/elements/prefetched_pairs.h"
#include "cuda/elements/rows.h"
#include "cuda/elements/stencils.h"
#include "cuda/elements/tet_per_lane.h"
#include "cuda/fused/call.h"
#include "cuda/fused/halo.h"
#include "solver/step.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

// `HasContacts`: the scene has contacts. `HasFreePieces`: pins may leave a piece free to move;
// always true with contacts. Elsewhere the sums and motions of pieces would only take registers
// from the iterations.
//
// `InShared`, one patch: the arrays that iterations read fit in shared memory. Several patches: all
// arrays fit, and each thread has at most one slot and, in float32, one tetrahedron. Cluster: in
// addition, a patch has so few vertices of its own that each gets eight lanes instead of four.
//
// `HasStencils`, one patch: the scene has other elements than tetrahedra, or no tetrahedra.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
class FusedRunner {
  static_assert(!HasStencils || Kind == Blocks::one);
  using Call = std::conditional_t<HasStencils, MixedFusedCall<T>, FusedCall<T>>;
  static constexpr bool Many = Kind != Blocks::one;  // several patches per environment
  static constexpr bool Clustered = Kind == Blocks::cluster;
  static constexpr bool OnePerThread = (InShared || Clustered) && near_once(sizeof(T));
  // each thread keeps its first tetrahedron in registers; without it, a grid's thread keeps its
  // first pair
  static constexpr bool TetPerLane = Clustered || (Kind == Blocks::grid && InShared);
  // loads from global memory are prefetched; arrays in shared memory need no prefetch
  static constexpr bool prefetches = Kind == Blocks::grid && !InShared;
  using Lanes = Thread<T>;
  using HaloMessage = pd::HaloMessage<T>;
  using OwnHalo = Halo<T, InShared ? 8 : 4>;
  using LoadedVertex = typename Vertices<T, HasContacts>::LoadedVertex;

  struct Stencils {
    const StencilWork<T>& work;
    PD_DEVICE explicit Stencils(const Call& call) : work(call.stencils) {}
  };
  struct NoStencils {
    PD_DEVICE explicit NoStencils(const Call&) {}
  };

  // A slot, as one thread updates it in a pass.
  struct WorkItem {
    int slot, row;
    Vec3<T> origin;

    PD_DEVICE bool owned() const { return row >= 0; }
  };

 public:
  // `shared`: size from FusedLaunch
  PD_DEVICE FusedRunner(const Call& call, std::byte* shared)
      : stencils_(call),
        call_(call.step),
        plan_(call.step.plan),
        set_(call.step.settings),
        index_(Many ? int(blockIdx.x) % call.step.plan.patches : 0),
        patch_(call.step.plan, index_),
        outer_pairs_(patch_.pairs),
        team_(Many ? int(blockIdx.x) / call.step.plan.patches : int(blockIdx.x)),
        memory_(call.scratch),
        control_(*reinterpret_cast<Control<T>*>(shared)),
        sums_(control_.totals,
              call.scratch.sums + std::int64_t(team_) * 2 * plan_.patches * sums_count,
              ClusterSums(shared + cluster_sums_begin), index_, plan_.patches),
        h_(T(call.step.settings.time_step)),
        theta_(in_register(T(call.step.settings.relaxation))),
        halo_(shared + halo_begin, plan_.most_slots) {
    lay_out(call, shared);
    init(shared);
  }

  // Runs all steps of one environment; stores a record every `every` steps.
  PD_DEVICE void rollout(std::int64_t environment) {
    in_ = {&call_, environment};
    load();
    assemble_diagonal();
    for (int t = 0; t < set_.steps; ++t) {
      step(*this, set_);
      if ((t + 1) % set_.every == 0) store((t + 1) / set_.every - 1);
      move_spheres();
    }
    // no message may be in flight to a block that ends
    if constexpr (Clustered) wait_for_positions();
    __syncthreads();
  }

  PD_DEVICE void predict() {
    __syncthreads();
    const Vec3<T> anchor = anchor_of_step();
    each_slot([&](int s) {
      v_.predict(s, in_, patch_.vertex(s), h_);
      origin_[s] = quad(vec3(v_.x[s]) - anchor);
    });
    if constexpr (HasStencils && has_large_kinds) begin_stencils();
  }

  PD_DEVICE void start() {
    each_slot([&](int s) {
      const Vec3<T> u = v_.first(s, in_, patch_.vertex(s), contacts_);
      move(s, u);
      v_.set_before(s, u);
    });
    if (threadIdx.x == 0) {
      control_.progress.schedule =
          Schedule(set_, control_.progress.min_share, contacts_.friction() > T(0));
      if constexpr (Clustered) control_.omega = T(control_.progress.schedule.next(0));
      if (set_.tolerance > 0) control_.progress.stop = {in_.free_fall_squared()};
      control_.progress.used = 0;
      control_.progress.done = false;
    }
    finished_ = pending_ = false;
    started_ = false;
    moved_ = true;
    __syncthreads();
  }

  // The coarse correction of every piece that pins leave free.
  PD_DEVICE void align() {
    if constexpr (Clustered) store_iterate();
    apply_last_sums();
    if constexpr (HasFreePieces) align_pieces();
  }

  // When the sums of an iteration are sent and applied. With one block, or with a tolerance: in the
  // next iteration, before its vertices. Otherwise InShared patches send them at the end of the
  // iteration, others at the start of the next. Both apply them at the end of the next iteration.
  PD_DEVICE void iterate(int k) {
    if constexpr (Clustered) return stops_ ? iterate_own<true>(k) : iterate_own<false>(k);
    const bool guard = set_.schedule == ScheduleKind::guarded && k % guard_period == 0;
    const bool stops = set_.tolerance > 0, early = guard && stores_early();
    if (pending_ && !stores_early() && in_leading_warp()) sums_.send(Add{});
    const auto lead = [&] {
      if (is_leader()) {
        if (!Many || k == 0) next_omega_ = T(control_.progress.schedule.next(k));
        if (stops) control_.omega_by_parity[k % 2] = next_omega_;
        control_.omega = next_omega_;
      }
      if (pending_ && (stops || !Many)) apply_sums();
      if (is_leader() && !control_.progress.done) ++control_.progress.used;
    };
    if constexpr (Many) {
      // one copy of the code, which must stay in the instruction cache with several patches
      pass<true>(SolidGradient<true>{guard}, lead, early,
                 [&](const WorkItem& at, const LoadedVertex& loaded, const Vec3<T>& force) {
                   if (guard && !early && at.owned()) energy_ += loaded.energy();
                   update(at, loaded, force);
                 });
    } else if (guard) {
      pass<true>(SolidGradient<true>{}, lead, false,
                 [&](const WorkItem& at, const LoadedVertex& loaded, const Vec3<T>& force) {
                   energy_ += loaded.energy();
                   update(at, loaded, force);
                 });
    } else {
      pass<true>(SolidGradient<false>{}, lead, false,
                 [&](const WorkItem& at, const LoadedVertex& loaded, const Vec3<T>& force) {
                   update(at, loaded, force);
                 });
    }
    if (finished_) {
      pending_ = false;
      return;
    }
    if ((guard && !early) || stops)
      sums_.store_partial({energy_, first_, second_}, stops ? sums_count : 1, Add{});
    if constexpr (Many) {
      // overlaps with warps that are still busy
      if (in_leading_warp()) {
        if (early) {
          sums_.wait_for_early();
          sums_.send(Add{});
        } else if (pending_ && !stops) {
          apply_sums();
        }
        if (is_leader()) next_omega_ = T(control_.progress.schedule.next(k + 1));
      }
    }
    guarding_ = guard;
    pending_ = guard || stops;
    __syncthreads();
  }

  PD_DEVICE bool finished() const { return finished_; }

  PD_DEVICE void finish() {
    if constexpr (Clustered) __syncthreads();
    each_slot([&](int s) { v_.finish(s, h_); });
  }

  // ---- coarse correction, by a copy of the runner: cuda/fused/rigid.h

  // State of the team's exchanges, which the copy advances.
  struct Exchanges {
    TeamSums<Kind> sums;
    unsigned round, waited;
  };

  PD_DEVICE void correct_pieces(bool first);
  PD_DEVICE Exchanges exchanges() const { return {sums_, round_, waited_}; }

 private:
  // Makes what stencils remember of the start of the step.
  PD_DEVICE void begin_stencils() {
    if (!stencils_.work.plan.remembers) return;
    __syncthreads();
    const int before = (patch_.pairs + pair_lanes - 1) / pair_lanes;
    pd::begin_stencils(
        stencils_.work, in_.environment, patch_.index, before,
        [from = origin_](unsigned corner, Vec3<T>(&x)[1]) { x[0] = at_corner(from, corner); });
    __syncthreads();
  }

  // Offsets of this team's memory are computed on demand, which leaves the registers to the
  // elements.
  PD_DEVICE std::int64_t first_slot() const {
    return std::int64_t(team_) * plan_.slots + patch_.first_slot;
  }
  PD_DEVICE T* weights() const {
    return memory_.weights + std::int64_t(team_) * plan_.blocks * pair_weights * pair_lanes;
  }
  PD_DEVICE Piece& piece(int piece) const {
    return memory_.pieces[(std::int64_t(team_) * plan_.patches + index_) * plan_.pieces + piece];
  }
  PD_DEVICE double* part_sums() const {
    return memory_.part_sum + std::int64_t(team_) * count_rows(plan_) * PartSums::count;
  }
  PD_DEVICE TaggedWord* mailbox() const {
    return memory_.messages +
           (std::int64_t(team_) * 2 + (round_ & 1)) * plan_.slots * HaloMessage::words;
  }
  // In a cluster, the patch's own vertices.
  PD_DEVICE int own_slots() const { return Clustered ? patch_.interior : patch_.slots; }
  template <class Visit>
  PD_DEVICE void each_slot(const Visit& visit) {
    for (int s = threadIdx.x; s < own_slots(); s += blockDim.x) visit(s);
  }

  // Writes the position that elements read; in a cluster, sending it does this.
  PD_DEVICE void place(int s, const Vec3<T>& position) {
    if constexpr (Clustered) {
      return;
    } else {
      position_[s] = quad(position);
    }
  }

  PD_DEVICE void move(int s, const Vec3<T>& u) {
    v_.set(s, u);
    place(s, vec3(origin_[s]) + u);
  }

  PD_DEVICE void update(const WorkItem& at, const LoadedVertex& loaded, const Vec3<T>& force) {
    const bool counts = set_.tolerance > 0 && at.owned();
    if (counts) second_ += loaded.square_of_displacement();
    const Vec3<T> next = loaded.next(contacts_, force, theta_, omega_);
    if (counts) {
      const Vec3<T> change = next - loaded.u;
      first_ += double(dot(change, change));
    }
    v_.set_before(at.slot, loaded.u);
    v_.set(at.slot, next);
    place(at.slot, at.origin + next);
  }

  template <class Element>
  PD_DEVICE auto each_element(const Element& element) {
    if constexpr (TetPerLane) {
      const auto shape_of = [&](int number, const TetInputs<T>&, const Quad<T>(&)[4]) {
        return OnePerThread || number == int(threadIdx.x) ? rest_ : tet_rest(patch_, number);
      };
      const auto counts = [&](int number, T tet_energy) {
        return !Clustered || this->counts(number, tet_energy);
      };
      if constexpr (Clustered) {
        return each_tet<OnePerThread, false>(patch_, halo_.positions(round_), shape_of, counts,
                                             weights(), entries_of_round(), element, tet_);
      } else {
        return each_tet<OnePerThread, false>(patch_, SlotPositions<T>{position_}, shape_of, counts,
                                             weights(), entries_, element, tet_);
      }
    } else if constexpr (Many) {
      T energy = T(0);
#pragma unroll 1
      for (int begin = 0, end = outer_pairs_;; begin = end, end = patch_.pairs) {
        energy += each_prefetched_pair(patch_, position_, weights(), entries_, element, pair_,
                                       begin, end);
        if (end == patch_.pairs) return energy;
        __syncthreads();
        send_shared_forces();
      }
    } else {
      // by value: a large kind gets it outside the registers
      const auto read = [from = position_](unsigned corner, Vec3<T>(&x)[1]) {
        x[0] = at_corner(from, corner);
      };
      if constexpr (HasStencils) {
        double energy = 0;
        if (patch_.pairs > 0)
          energy = double(
              each_pair<1>(patch_, read, rest_of<false>(patch_), weights(), entries_, element));
        const int blocks = (patch_.pairs + pair_lanes - 1) / pair_lanes;
        return energy + each_stencil_of_step(stencils_.work, in_.environment, patch_.index, blocks,
                                             read, entries_, on_stencils(element, set_.weighted));
      } else {
        return each_pair<1>(patch_, read, rest_of<false>(patch_), weights(), entries_, element);
      }
    }
  }

  // Computes the elements, then visits every slot once with the force on its vertex. The leading
  // warp calls `lead` before the slots. `MayStop`: skips the vertices of a converged environment.
  // `early`: energies are contributed before the wait for messages.
  template <bool MayStop, class Element, class Lead, class Visit>
  PD_DEVICE void pass(const Element& element, const Lead& lead, bool early, const Visit& visit) {
    if constexpr (Clustered) return pass_own(element, visit);
    energy_ = double(each_element(element));
    first_ = second_ = 0;
    late_ = Many && MayStop && pending_ && set_.tolerance > 0;
    if (!late_ && in_leading_warp()) lead();
    if constexpr (prefetches) prefetch_first();
    __syncthreads();
    if (!late_) {
      read_control<MayStop>();
    } else if (in_leading_warp()) {
      lead();
    }
    // with several patches, only after this patch has sent what others wait for
    if (finished_) return;
    if constexpr (Many && InShared) {
      visit_one_item<MayStop>(early, visit);
    } else if constexpr (Many) {
      visit_items<MayStop>(visit);
    } else {
      each_slot([&](int s) {
        const LoadedVertex loaded = v_.load(s);
        const WorkItem at = {s, 0, vec3(origin_[s])};
        visit(at, loaded, sum_entries(entries_, plan_.slot_row[s]));
      });
    }
  }

  // Reads the decisions of the leading warp.
  template <bool MayStop>
  PD_DEVICE void read_control() {
    finished_ = MayStop && control_.progress.done;
    omega_ = control_.omega;
  }
  // With several patches, the leading warp may have waited for the sums of the others first.
  template <bool MayStop>
  PD_DEVICE void read_control_late() {
    if (!late_) return;
    __syncthreads();
    read_control<MayStop>();
  }

  // ---- vertex updates: cuda/fused/visit.h

  PD_DEVICE int slot_of_item(int item) const;
  PD_DEVICE int row_of_item(int item) const;
  PD_DEVICE int rounds(int items) const;
  PD_DEVICE int item_of_visit(int visit) const;
  PD_DEVICE void load_item(int item);

  // shared slots of earlier patches
  PD_DEVICE int earlier_shared() const { return patch_.first_slot - patch_.first_vertex; }

  PD_DEVICE void send_force(int item, const Vec3<T>& force) const;
  PD_DEVICE void send_shared_forces();
  PD_DEVICE Vec3<T> receive_force(int item) const;
  template <bool MayStop, class Visit>
  PD_DEVICE void visit_items(const Visit& visit);
  PD_DEVICE void prefetch_first();
  template <bool MayStop, class Visit>
  PD_DEVICE void visit_one_item(bool early, const Visit& visit);
  PD_DEVICE void store_energy(bool owned);

  // ---- cluster variant: cuda/fused/cluster_members.h

  // whether this warp has own vertices, and whether this thread is the first lane of one
  PD_DEVICE bool has_own() const { return OwnHalo::first_vertex() < patch_.interior; }
  PD_DEVICE bool is_first() const {
    return OwnHalo::part() == 0 && OwnHalo::vertex() < patch_.interior;
  }
  PD_DEVICE bool counts(int number, T tet_energy) const;
  PD_DEVICE bool counts_energy(int number) const;
  PD_DEVICE Vec3<T> anchor_of_step();
  PD_DEVICE Quad<T>* entries_of_round() const {
    return entries_ + (round_ & 1) * plan_.most_entries;
  }
  PD_DEVICE void load_iterate();
  PD_DEVICE void store_iterate();
  PD_DEVICE void wait_for_positions();
  PD_DEVICE void send_positions();
  template <bool Stops>
  PD_DEVICE void iterate_own(int k);
  template <class Element, class Visit>
  PD_DEVICE void pass_own(const Element& element, const Visit& visit);

  // Whether only the leading warp needs the sums of the last iteration. Then energies are
  // contributed before the wait for messages, and sent after the leading warp's own visits.
  PD_DEVICE bool stores_early() const {
    return Many && (InShared || Clustered) && !(set_.tolerance > 0);
  }

  // The weight omega of the last counted iteration, to which the sums belong.
  PD_DEVICE double omega_of_sums() const {
    return double(control_.omega_by_parity[(control_.progress.used - 1) & 1]);
  }

  // Leading warp: receives the last iteration's sums and updates schedule and stopping rule.
  PD_DEVICE void apply_sums() {
    sums_.receive(Add{});
    if (lane() == 0) {
      Progress& progress = control_.progress;
      if (guarding_) progress.schedule.check(sums_.total(0));
      if (set_.tolerance > 0 &&
          progress.ends(set_.tolerance, omega_of_sums(), sums_.total(1), sums_.total(2)))
        progress.done = true;
    }
    __syncwarp();
  }

  // The same for the final iteration.
  PD_DEVICE void apply_last_sums() {
    if (!pending_) return;
    if (in_leading_warp()) {
      if (!stores_early()) sums_.send(Add{});
      apply_sums();
    }
    pending_ = false;
    __syncthreads();
  }

  // ---- initialisation: cuda/fused/start.h

  PD_DEVICE void lay_out(const FusedCall<T>& call, std::byte* shared);
  PD_DEVICE void init(std::byte* shared);
  PD_DEVICE void load();
  PD_DEVICE void move_spheres();
  PD_DEVICE void assemble_diagonal();
  PD_DEVICE void compute_weights(const Moduli<T>& moduli, WeightKind kind);
  PD_DEVICE T compute_own_weight(const T* stiffness, bool bounded);
  PD_DEVICE void load_own();

  // ---- coarse correction: cuda/fused/rigid.h

  PD_DEVICE void align_pieces();
  // Forgets what a pass sets anew: kept for the copy, it would take registers from the iterations.
  PD_DEVICE void forget() {
    energy_ = first_ = second_ = 0;
    omega_ = next_omega_ = T(1);
    item_ = {};
    loaded_ = {};
    guarding_ = late_ = false;
  }
  PD_DEVICE Correction<T, HasContacts> correction(Iterate from) const {
    return {v_, contacts_, in_, memory_.forces.of_environment(team_), from};
  }
  PD_DEVICE void take_present_shape();
  PD_DEVICE void keep_forces(Iterate from);

  // ---- results

  PD_DEVICE void store(int record) {
    each_slot([&](int s) {
      if (Many && !patch_.owns(s)) return;
      in_.write(record, patch_.vertex(s), vec3(v_.x[s]), vec3(v_.velocity[s]));
    });
    if (index_ == 0 && threadIdx.x == 0) in_.write_info(record, control_.progress);
  }

  std::conditional_t<HasStencils, Stencils, NoStencils> stencils_;
  const DeviceStep<T>& call_;
  const DevicePlan<T>& plan_;
  const Settings& set_;
  int index_;  // patch
  Patch<T> patch_;
  // grid without InShared: pairs after which forces on shared vertices are complete, a multiple of
  // the threads or all
  int outer_pairs_;
  int team_;
  const FusedScratch<T>& memory_;
  Control<T>& control_;
  TeamSums<Kind> sums_;
  // positions that elements read, relative to the patch's first vertex; a cluster uses halo_
  // instead
  Quad<T>* position_;
  Quad<T>* entries_;  // element forces
  double* energies_;  // cluster: energy sum of each thread
  Vertices<T, HasContacts> v_;
  // position at the start of the step, relative to the patch's first vertex (cluster: the mesh's)
  Quad<T>* origin_;
  Plane<T>* planes_;
  Sphere<T>* spheres_;
  Inputs<T> in_;
  Contacts<T> contacts_;
  OwnHalo halo_;            // cluster
  TetInputs<T> tet_;        // TetPerLane: this thread's first tetrahedron
  FaceRest<T, 1> rest_;     // and its rest shape
  PrefetchedPair<T> pair_;  // grid without TetPerLane: this thread's first pair, between passes
  int row_ = 0;    // slot_row of this thread's first item (grid) or of its own vertex (cluster)
  WorkItem item_;  // next item
  LoadedVertex loaded_;  // and its loaded vertex
  T h_, theta_, omega_ = T(1);
  double energy_ = 0, first_ = 0, second_ = 0;  // this thread's partial sums
  unsigned round_ = 0;                          // exchanges so far
  unsigned waited_ = 0;  // cluster: exchanges that this thread has waited for
  bool finished_ = false, pending_ = false, guarding_ = false, started_ = false, late_ = false;
  T next_omega_ = T(1);  // leader: the next omega
  // Cluster only: vertices moved since they were last sent; loaded_ is newer than the arrays; the
  // environment was just loaded; this patch counts the energy of this thread's first tetrahedron.
  // stops_: a tolerance may end the solve.
  bool moved_ = false, in_registers_ = false, just_loaded_ = false, counts_ = false;
  int stops_ = in_register(int(set_.tolerance > 0));
};

}  // namespace pd::inline PD_TARGET
