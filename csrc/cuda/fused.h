// Runner of solver/step.h inside a kernel: all iterations, and all steps of a rollout, in one launch.
//
// A team of blocks has one environment at a time, each block one patch of the mesh. The iterate lives in shared memory. With
// one patch nothing leaves the block; with several, one exchange an iteration is all. Patches of a grid send each other the forces
// on the vertices that they share, and each adds them up in the same order and moves its own copy. Those of a cluster share no
// vertices: each works out all tetrahedra that touch its own, and sends where these are now.
#pragma once
#include "cuda/ahead.h"
#include "cuda/fused_call.h"
#include "cuda/half.h"
#include "cuda/halo.h"
#include "cuda/patch.h"
#include "cuda/vertices.h"
#include "plan/shared_memory.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

// `Touching`: the scene has contacts. `Loose`: it may have pieces that pins leave to move, always so with contacts; elsewhere their
// sums and motions would only take registers from the iterations. `Near`: of one patch, whose vertex arrays fit shared memory, as far as iterations ask for
// them; of several, which are so small that theirs fit and that no thread has more than one slot, nor in float32 more than one
// tetrahedron; of a cluster, where all are as small, with so few own vertices that each has eight lanes and not four.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared>
class FusedRunner {
  static constexpr bool Many = Kind != Blocks::one;  // patches an environment
  static constexpr bool Clustered = Kind == Blocks::cluster;
  static constexpr bool OnePerThread = (InShared || Clustered) && near_once(sizeof(T));
  // whether each thread keeps its first tetrahedron, or else of a grid its first pair
  static constexpr bool TetPerLane = Clustered || (Kind == Blocks::grid && InShared);
  // near patches have their vertices at hand
  static constexpr bool prefetches = Kind == Blocks::grid && !InShared;
  using Lanes = Thread<T>;
  using HaloMessage = pd::HaloMessage<T>;
  using OwnHalo = Halo<T, InShared ? 8 : 4>;
  using LoadedVertex = typename Vertices<T, HasContacts>::LoadedVertex;

  // A slot as a pass visits it.
  struct WorkItem {
    int slot, row;
    Vec3<T> origin;

    PD_DEVICE bool owned() const { return row >= 0; }
  };

 public:
  // `shared`: as many bytes as FusedLaunch says
  PD_DEVICE FusedRunner(const FusedCall<T>& call, std::byte* shared)
      : call_(call.step),
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

  // All steps of one environment, with a record every `every`.
  PD_DEVICE void rollout(std::int64_t environment) {
    in_ = {&call_, environment};
    load();
    assemble_diagonal();
    for (int t = 0; t < set_.steps; ++t) {
      step(*this, set_);
      if ((t + 1) % set_.every == 0) store((t + 1) / set_.every - 1);
      move_spheres();
    }
    // nothing is under way to a block when it ends
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

  // Exact minimum of E along the rigid motions of every piece, as far as pins and contacts leave them to it.
  PD_DEVICE void align() {
    if constexpr (Clustered) store_iterate();
    apply_last_sums();
    if constexpr (HasFreePieces) align_pieces();
  }

  // When the sums of an iteration are sent and concluded: with one block, or where they may stop it, in the next one before
  // its vertices. Near patches send them at its end, far ones at the start of the next; both conclude at the end of that.
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
      // one copy of the code, which several patches have to hold in the cache
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
      // while others are still busy
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

 private:
  // Where this team's memory lies: worked out when it is wanted, to leave the registers to the elements.
  PD_DEVICE std::int64_t first_slot() const {
    return std::int64_t(team_) * plan_.slots + patch_.first_slot;
  }
  PD_DEVICE T* weights() const {
    return memory_.weights + std::int64_t(team_) * plan_.blocks * 2 * pair_lanes;
  }
  PD_DEVICE Piece<T>& piece(int piece) const {
    return memory_.pieces[(std::int64_t(team_) * plan_.patches + index_) * plan_.pieces + piece];
  }
  PD_DEVICE double* part_sums() const {
    return memory_.part_sum + std::int64_t(team_) * plan_.parts * PartSums::count;
  }
  PD_DEVICE TaggedWord* mailbox() const {
    return memory_.messages +
           (std::int64_t(team_) * 2 + (round_ & 1)) * plan_.slots * HaloMessage::words;
  }
  // Of a cluster its own vertices.
  PD_DEVICE int own_slots() const { return Clustered ? patch_.interior : patch_.slots; }
  template <class Visit>
  PD_DEVICE void each_slot(const Visit& visit) {
    for (int s = threadIdx.x; s < own_slots(); s += blockDim.x) visit(s);
  }

  // for elements to see; of a cluster that happens when it is sent
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
  PD_DEVICE T each_element(const Element& element) {
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
      const auto read = [&](unsigned corner, Vec3<T>(&x)[1]) {
        x[0] = at_corner(position_, corner);
      };
      return each_pair<1>(patch_, read, rest_of<false>(patch_), weights(), entries_, element);
    }
  }

  // Elements, then every slot once with the force on its vertex. `lead` is for the leading warp, before the slots; where it
  // `MayStop`, an environment that is done is not visited any more. `early`: energies are left before
  // the wait for letters.
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
    // of several patches only late, when what others wait for has been sent
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

  // What the leading warp has decided.
  template <bool MayStop>
  PD_DEVICE void read_control() {
    finished_ = MayStop && control_.progress.done;
    omega_ = control_.omega;
  }
  // With several patches it may have waited for the sums of the others meanwhile.
  template <bool MayStop>
  PD_DEVICE void read_control_late() {
    if (!late_) return;
    __syncthreads();
    read_control<MayStop>();
  }

  // ---- visits: cuda/fused_visit.h

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

  // ---- what is different in a cluster: cuda/fused_halo.h

  // whether this warp has any own vertices, and whether this thread is the first of the lanes of one
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

  // Whether nobody waits for the sums of the last iteration but the leading warp: energies are left before the wait for letters,
  // and sent once it has made its own visits.
  PD_DEVICE bool stores_early() const {
    return Many && (InShared || Clustered) && !(set_.tolerance > 0);
  }

  // The weight of the last iteration that was counted, whose sums are concluded.
  PD_DEVICE double omega_of_sums() const {
    return double(control_.omega_by_parity[(control_.progress.used - 1) & 1]);
  }

  // Leading warp: what follows from the sums of the last iteration.
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

  // The last iteration's sums, which no iteration follows.
  PD_DEVICE void apply_last_sums() {
    if (!pending_) return;
    if (in_leading_warp()) {
      if (!stores_early()) sums_.send(Add{});
      apply_sums();
    }
    pending_ = false;
    __syncthreads();
  }

  // ---- start of a call: cuda/fused_start.h

  PD_DEVICE void lay_out(const FusedCall<T>& call, std::byte* shared);
  PD_DEVICE void init(std::byte* shared);
  PD_DEVICE void load();
  PD_DEVICE void move_spheres();
  PD_DEVICE void assemble_diagonal();
  PD_DEVICE void compute_weights(const T* stiffness, bool bounded);
  PD_DEVICE T compute_own_weight(const T* stiffness, bool bounded);
  PD_DEVICE void load_own();

  // ---- rigid motions: cuda/fused_rigid.h

  PD_DEVICE void align_pieces();

  // ---- results

  PD_DEVICE void store(int record) {
    each_slot([&](int s) {
      if (Many && !patch_.owns(s)) return;
      in_.write(record, patch_.vertex(s), vec3(v_.x[s]), vec3(v_.velocity[s]));
    });
    if (index_ == 0 && threadIdx.x == 0) in_.write_info(record, control_.progress);
  }

  const DeviceStep<T>& call_;
  const DevicePlan<T>& plan_;
  const Settings& set_;
  int index_;  // of the patch
  Patch<T> patch_;
  int outer_pairs_;  // of a far grid: pairs after which forces on shared vertices are complete, a multiple of the threads, or all
  int team_;
  const FusedScratch<T>& memory_;
  Control<T>& control_;
  TeamSums<Kind> sums_;
  // where elements read vertices, from the patch's first; of a cluster halo_ has them
  Quad<T>* position_;
  Quad<T>* entries_;  // forces of elements
  double* energies_;  // of a cluster: what each thread has met of them
  Vertices<T, HasContacts> v_;
  Quad<T>* origin_;  // start of the step, from the patch's first vertex, of a cluster the mesh's
  Plane<T>* planes_;
  Ball<T>* spheres_;
  Inputs<T> in_;
  Contacts<T> contacts_;
  OwnHalo halo_;            // of a cluster
  TetInputs<T> tet_;        // with Halves: this thread's first tetrahedron,
  FaceRest<T, 1> rest_;     // and its rest shape
  PrefetchedPair<T> pair_;  // of a grid without: this thread's first pair, between passes
  int row_ =
      0;  // slot_row of a grid's first seat of this thread, of the vertex that it has in a cluster
  WorkItem item_;        // the seat that comes next,
  LoadedVertex loaded_;  // with what a pass knows of its vertex
  T h_, theta_, omega_ = T(1);
  double energy_ = 0, first_ = 0, second_ = 0;  // this thread's part of the sums
  unsigned round_ = 0;                          // exchanges so far
  unsigned waited_ = 0;                         // of a cluster: those that were waited for
  bool finished_ = false, pending_ = false, guarding_ = false, started_ = false, late_ = false;
  T next_omega_ = T(1);  // of the leader: the next omega
  // of a cluster: whether vertices have moved since they were sent, whether seen_ is newer than their arrays, whether the environment
  // has just been loaded, whether the energy of this thread's first tetrahedron counts; whether a tolerance may stop it
  bool moved_ = false, in_registers_ = false, just_loaded_ = false, counts_ = false;
  int stops_ = in_register(int(set_.tolerance > 0));
};

}  // namespace pd::inline PD_TARGET
