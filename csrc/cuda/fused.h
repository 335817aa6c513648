// Runner of solver/step.h inside a kernel: all iterations, and all steps of a rollout, in one launch.
//
// A team of blocks has one environment at a time, each block one patch of the mesh. The iterate lives in shared memory. With
// one patch nothing leaves the block; with several, patches send each other the forces on the vertices that they share, and
// each adds them up in the same order and moves its own copy, so one exchange an iteration is all.
#pragma once
#include "cuda/exchange.h"
#include "cuda/momentum.h"
#include "cuda/patch.h"
#include "cuda/vertices.h"
#include "plan/shared_memory.h"
#include "solver/step.h"

namespace pd::inline PD_TARGET {

// Device memory of the teams.
template <class T>
struct FusedScratch {
  Quad<T>*x, *velocity, *target, *origin, *before;  // [teams, slots]
  T* weights;                                       // [teams, blocks, 2, 32] w V
  Quad<T>* shift;                                   // [teams, patches, pieces]
  double* part_sum;  // [teams, parts, 4] of the vertices that a patch owns of a piece
  Word* letters;     // [teams, 2, slots, words] forces on shared vertices
  Word* sums;        // [teams, 2, patches, sums_count]
};

template <class T>
struct FusedCall {
  DeviceStep<T> step;
  FusedScratch<T> scratch;
  int teams;
};

// What the leading warp of a block decides for it.
struct Control {
  Progress progress;
  double omega;
  double warp_sum[sums_count][warp_size];
  double total[sums_count];
};

// `Touching`: the scene has contacts. `Many`: several patches an environment.
template <class T, bool Touching, bool Many>
class FusedRunner {
  using Lanes = Thread<T>;
  using Letter = pd::Letter<T>;

 public:
  // `shared`: as many bytes as fused_shared_bytes (plan/shared_memory.h) says
  __device__ FusedRunner(const FusedCall<T>& call, std::byte* shared)
      : call_(call.step),
        plan_(call.step.plan),
        set_(call.step.settings),
        index_(Many ? int(blockIdx.x) % call.step.plan.patches : 0),
        patch_(call.step.plan, index_),
        team_(Many ? int(blockIdx.x) / call.step.plan.patches : int(blockIdx.x)),
        memory_(call.scratch),
        control_(*reinterpret_cast<Control*>(shared)),
        h_(T(call.step.settings.time_step)),
        theta_(T(call.step.settings.relaxation)) {
    position_ = reinterpret_cast<Quad<T>*>(shared + fused_control_bytes);
    v_ = {memory_.x + first_slot(), memory_.velocity + first_slot(), memory_.target + first_slot(),
          position_ + plan_.most_slots, memory_.before + first_slot()};
    entries_ = position_ + 2 * plan_.most_slots;
    balls_ = reinterpret_cast<Ball<T>*>(entries_ + plan_.most_entries);
    planes_ = reinterpret_cast<Plane<T>*>(balls_ + call_.material.spheres_count);
    if (Many && int(threadIdx.x) < patch_.slots) seat_ = seat(threadIdx.x);
  }

  // All steps of one environment, with a record every `every`.
  __device__ void roll(std::int64_t environment) {
    in_ = {&call_, environment};
    load();
    weigh();
    for (int t = 0; t < set_.steps; ++t) {
      step(*this, set_);
      if ((t + 1) % set_.every == 0) store((t + 1) / set_.every - 1);
      move_balls();
    }
    __syncthreads();
  }

  __device__ void predict() {
    __syncthreads();
    const Vec3<T> anchor = vec3(v_.x[0]);
    each_slot([&](int s) {
      v_.predict(s, in_, patch_.vertex(s), h_);
      origin()[s] = quad(vec3(v_.x[s]) - anchor);
    });
  }

  __device__ void start() {
    each_slot([&](int s) {
      const Vec3<T> u = v_.first(s, in_, patch_.vertex(s), contacts_);
      move(s, u);
      v_.set_before(s, u);
    });
    if (threadIdx.x == 0) {
      control_.progress.schedule =
          Schedule(set_, control_.progress.least, contacts_.friction() > T(0));
      control_.progress.used = 0;
      control_.progress.done = false;
    }
    finished_ = pending_ = false;
    started_ = false;
    __syncthreads();
  }

  // Exact minimum of E along the translation of every piece that nothing holds or touches: its momentum is then right
  // however few iterations follow.
  __device__ void translate() {
    settle();
    const bool given_first = set_.start == StartKind::given && !started_;
    const bool first = !started_;
    started_ = true;
    if (plan_.pieces == 0 || given_first) return;
    find_shifts();
    if constexpr (Touching) drop_touching_shifts();
    each_slot([&](int s) {
      const int piece = plan_.slot_piece[patch_.first_slot + s];
      if (piece < 0) return;
      const Vec3<T> u = vec3(v_.u[s]) + vec3(shift(piece));
      move(s, u);
      if (first) v_.set_before(s, u);
    });
    __syncthreads();
  }

  __device__ void iterate(int k) {
    const bool guard = set_.schedule == ScheduleKind::guarded && k % guard_period == 0;
    if (pending_ && leads()) send(Add{});
    const auto lead = [&] {
      conclude();
      if (is_leader()) control_.omega = control_.progress.schedule.next(k);
    };
    const auto visit = [&](int s, const Vec3<T>& force) { update(s, force); };
    if (guard) {
      pass<true>(SolidGradient<true>{}, lead, [&](int s, const Vec3<T>& force) {
        if (!Many || patch_.owns(s)) energy_ += v_.energy(s);
        update(s, force);
      });
    } else {
      pass<true>(SolidGradient<false>{}, lead, visit);
    }
    pending_ = false;
    if (finished_) return;
    if (guard || set_.tolerance > 0) leave(set_.tolerance > 0 ? sums_count : 1);
    guarding_ = guard;
    if (threadIdx.x == 0) ++control_.progress.used;
    __syncthreads();
  }

  __device__ bool finished() const { return finished_; }

  // The gradient on the straight course x + h v is what residuals are relative to, whatever the first iterate.
  __device__ void measure_course() {
    each_slot([&](int s) { move(s, v_.at(s).first(contacts_, v_.straight(s, h_))); });
    measure();
    if (threadIdx.x == 0) control_.progress.course = control_.progress.residual;
  }

  // |grad E|^2 without what contacts balance, and E
  __device__ void measure() {
    settle();
    __syncthreads();
    pass<false>(
        SolidGradient<true>{}, [] {},
        [&](int s, const Vec3<T>& force) {
          if (Many && !patch_.owns(s)) return;
          energy_ += v_.energy(s);
          first_ += v_.residual(s, contacts_, force);
        });
    all_reduce(Add{});
    if (threadIdx.x == 0) {
      control_.progress.energy = control_.total[0];
      control_.progress.residual = control_.total[1];
    }
    __syncthreads();
  }

  __device__ void finish() {
    each_slot([&](int s) { v_.finish(s, h_); });
  }

 private:
  // Where this team's memory lies: worked out when it is wanted, to leave the registers to the elements.
  __device__ std::int64_t first_slot() const {
    return std::int64_t(team_) * plan_.slots + patch_.first_slot;
  }
  __device__ Quad<T>* origin() const { return memory_.origin + first_slot(); }
  __device__ T* weights() const {
    return memory_.weights + std::int64_t(team_) * plan_.blocks * 2 * pair_lanes;
  }
  __device__ Quad<T>& shift(int piece) const {
    return memory_.shift[(std::int64_t(team_) * plan_.patches + index_) * plan_.pieces + piece];
  }
  __device__ double* part_sums() const {
    return memory_.part_sum + std::int64_t(team_) * plan_.parts * 4;
  }
  __device__ Word* letter_box() const {
    return memory_.letters + (std::int64_t(team_) * 2 + (round_ & 1)) * plan_.slots * Letter::words;
  }
  __device__ Word* sums_box() const {
    return memory_.sums + (std::int64_t(team_) * 2 + (sum_round_ & 1)) * plan_.patches * sums_count;
  }

  template <class Visit>
  __device__ void each_slot(const Visit& visit) {
    for (int s = threadIdx.x; s < patch_.slots; s += blockDim.x) visit(s);
  }

  __device__ void move(int s, const Vec3<T>& u) {
    v_.set(s, u);
    position_[s] = quad(vec3(origin()[s]) + u);
  }

  __device__ void update(int s, const Vec3<T>& force) {
    const Vec3<T> u = vec3(v_.u[s]), next = v_.next(s, contacts_, force, theta_, omega_);
    if (set_.tolerance > 0 && (!Many || patch_.owns(s))) {
      const Vec3<T> change = next - u;
      first_ += double(dot(change, change));
      second_ += double(dot(next, next));
    }
    v_.set_before(s, u);
    move(s, next);
  }

  // Elements, then every slot once with the force on its vertex. `lead` is for the leading warp, before the slots;
  // where it `MayStop`, an environment that is done is not visited any more.
  template <bool MayStop, class Element, class Lead, class Visit>
  __device__ void pass(const Element& element, const Lead& lead, const Visit& visit) {
    const Quad<T>* const fields[1] = {position_};
    energy_ = double(each_pair(patch_, fields, weights(), entries_, element));
    first_ = second_ = 0;
    if (leads()) lead();
    __syncthreads();
    finished_ = MayStop && control_.progress.done;
    if (finished_) return;
    omega_ = T(control_.omega);
    if constexpr (Many) {
      visit_patch(visit);
    } else {
      each_slot([&](int s) { visit(s, sum_entries(entries_, plan_.slot_row[s])); });
    }
  }

  // Shared slots have the first seats.
  __device__ Seat seat(int number) const {
    Seat seat;
    const int shared = patch_.shared();
    seat.slot = number < shared ? patch_.interior + number : number - shared;
    seat.row = plan_.slot_row[patch_.first_slot + seat.slot];
    seat.begin = seat.end = 0;
    if (number >= shared) return seat;
    const int among = patch_.among_shared(seat.slot);
    seat.begin = plan_.shared_start[among];
    seat.end = plan_.shared_start[among + 1];
    for (int j = 0; j < Seat::remembered; ++j)
      seat.sender[j] = seat.begin + j < seat.end ? plan_.shared_slot[seat.begin + j] : 0;
    return seat;
  }

  // Sends what this patch knows of shared vertices before anything else, and looks for the others' part last.
  template <class Visit>
  __device__ void visit_patch(const Visit& visit) {
    ++round_;
    Word* box = letter_box();
    const int first = threadIdx.x, step = blockDim.x;
    for (int i = first; i < patch_.slots; i += step) {
      const Seat at = i == first ? seat_ : seat(i);
      const Vec3<T> force = sum_entries(entries_, at.row);
      if (at.slot < patch_.interior) {
        visit(at.slot, force);
      } else {
        const int slot = patch_.first_slot + at.slot;
        Letter::post(box + std::int64_t(slot) * Letter::words, force, round_);
      }
    }
    for (int i = first; i < patch_.shared(); i += step) {
      const Seat at = i == first ? seat_ : seat(i);
      visit(at.slot, read_letters<T>(box, plan_.shared_slot, at, round_));
    }
  }

  // ---- sums over the environment: every thread leaves its part, the leading warp adds up after a barrier

  template <class Op = Add>
  __device__ void leave(int wanted, Op op = {}) {
    wanted_ = wanted;
    const double mine[sums_count] = {energy_, first_, second_};
#pragma unroll
    for (int n = 0; n < sums_count; ++n) {
      if (n >= wanted) break;
      const double sum = across_warp(mine[n], op);
      if (threadIdx.x % warp_size == 0) control_.warp_sum[n][threadIdx.x / warp_size] = sum;
    }
    pending_ = true;
  }

  // Leading warp: the sums of the block, to the other blocks.
  template <class Op>
  __device__ void send(Op op) {
    const int warps = blockDim.x / warp_size;
    ++sum_round_;
    // every lane takes the same way to a shuffle, or they would not meet there
    double sum[sums_count];
#pragma unroll
    for (int n = 0; n < sums_count; ++n)
      sum[n] = across_warp(lane() < warps ? control_.warp_sum[n][lane()] : Op::none, op);
    if (lane() == 0) {
      for (int n = 0; n < sums_count; ++n) send_one(n, sum[n]);
    }
    __syncwarp();
  }

  __device__ void send_one(int n, double sum) {
    if constexpr (Many) {
      const Word word = {std::uint64_t(__double_as_longlong(sum)), sum_round_};
      if (n < wanted_) post(sums_box() + index_ * sums_count + n, word);
    } else {
      control_.total[n] = sum;
    }
  }

  // Leading warp: the sums of all blocks, the same in each.
  template <class Op>
  __device__ void receive(Op op) {
    if constexpr (!Many) return;
    double sum[sums_count] = {Op::none, Op::none, Op::none};
#pragma unroll
    for (int n = 0; n < sums_count; ++n) {
      if (n < wanted_) sum[n] = over_patches<Op>(sums_box() + n, plan_.patches, sum_round_);
    }
    __syncwarp();
#pragma unroll
    for (int n = 0; n < sums_count; ++n) sum[n] = across_warp(sum[n], op);
    if (lane() == 0) {
      for (int n = 0; n < sums_count; ++n) control_.total[n] = sum[n];
    }
    __syncwarp();
  }

  template <class Op>
  __device__ void all_reduce(Op op) {
    leave(sums_count, op);
    pending_ = false;
    __syncthreads();
    if (leads()) {
      send(op);
      receive(op);
    }
    __syncthreads();
  }

  // Waits for all blocks of the environment; what they wrote before can be read after.
  __device__ void meet() {
    if constexpr (!Many) {
      __syncthreads();
    } else {
      __threadfence();
      energy_ = first_ = second_ = 0;
      all_reduce(Add{});
      __threadfence();
    }
  }

  // Leading warp: what follows from the sums of the last iteration.
  __device__ void conclude() {
    if (!pending_) return;
    receive(Add{});
    if (lane() == 0) {
      if (guarding_) control_.progress.schedule.check(control_.total[0]);
      const double limit = set_.tolerance * set_.tolerance * control_.total[2];
      if (set_.tolerance > 0 && control_.total[1] <= limit) control_.progress.done = true;
    }
    __syncwarp();
  }

  // The last iteration's sums, which no iteration follows.
  __device__ void settle() {
    if (!pending_) return;
    if (leads()) {
      send(Add{});
      conclude();
    }
    pending_ = false;
    __syncthreads();
  }

  // ---- start of a call

  __device__ void load() {
    if (threadIdx.x == 0) in_.read_contacts(planes_, balls_);
    contacts_ = {planes_, balls_, call_.material.planes_count, call_.material.spheres_count};
    each_slot([&](int s) {
      v_.load(s, in_, patch_.vertex(s), h_);
      position_[s] = {};
    });
    __syncthreads();
  }

  __device__ void move_balls() {
    if constexpr (!Touching) return;
    __syncthreads();
    for (int b = threadIdx.x; b < contacts_.ball_count; b += blockDim.x)
      balls_[b].center = balls_[b].center + balls_[b].motion;
    __syncthreads();
  }

  // a and 1 / D of every vertex, w V of every element, and the smallest a / D
  __device__ void weigh() {
    const T* stiffness = call_.material.stiffness.of(in_.environment);
    weigh_pairs(patch_, stiffness, set_.weighted, weights());
    if (threadIdx.x == 0) control_.progress.done = false;
    pending_ = false;
    __syncthreads();
    double least = HUGE_VAL;
    pass<false>(
        SolidDiagonal{}, [] {},
        [&](int s, const Vec3<T>& elastic) { least = Least{}(least, v_.weigh(s, elastic.x)); });
    energy_ = least;
    all_reduce(Least{});
    if (threadIdx.x == 0) control_.progress.least = control_.total[0];
    if (set_.weighted) weigh_pairs(patch_, stiffness, false, weights());
    __syncthreads();
  }

  // ---- momentum

  __device__ void find_shifts() {
    if constexpr (Many) meet();  // everyone has read the sums of the last time
    each_part([&](int part, int begin, int end) {
      double sum[4];
      sum_part(v_, begin, end, [&](int at) { return local(at); }, sum);
      if (lane() == 0) {
        for (int c = 0; c < 4; ++c) part_sums()[4 * part + c] = sum[c];
      }
    });
    meet();
    each_piece([&](int piece) {
      double sum[4];
      over_parts(plan_, piece, Add{}, [&](int part, int c) { return part_sum(4 * part + c); }, sum);
      if (lane() == 0) shift(piece) = shift_of<T>(sum);
    });
    __syncthreads();
  }

  // a piece that the shift would leave touching a contact gets none
  __device__ void drop_touching_shifts() {
    meet();  // everyone has read the sums
    each_part([&](int part, int begin, int end) {
      const Vec3<T> moved = vec3(shift(plan_.slot_piece[plan_.part_slot[begin]]));
      const auto index = [&](int at) { return local(at); };
      const double least = least_gap(v_, contacts_, begin, end, index, moved);
      if (lane() == 0) part_sums()[4 * part] = least;
    });
    meet();
    each_piece([&](int piece) {
      double least[1];
      over_parts(plan_, piece, Least{}, [&](int part, int) { return part_sum(4 * part); }, least);
      if (lane() == 0 && !(least[0] > 0)) shift(piece) = {};
    });
    __syncthreads();
  }

  // The last warp leads: it is the one that a last round of pairs leaves idle.
  __device__ static bool leads() { return threadIdx.x + warp_size >= blockDim.x; }
  __device__ static bool is_leader() { return threadIdx.x + warp_size == blockDim.x; }
  __device__ static int lane() { return int(threadIdx.x) % warp_size; }
  __device__ int local(int at) const { return plan_.part_slot[at] - patch_.first_slot; }

  // past the first level of cache, which does not see what other blocks wrote
  __device__ double part_sum(int at) const { return __ldcg(part_sums() + at); }

  // a warp for each
  template <class Visit>
  __device__ void each_part(const Visit& visit) const {
    const int warps = blockDim.x / warp_size;
    for (int part = plan_.patch_part[index_] + int(threadIdx.x) / warp_size;
         part < plan_.patch_part[index_ + 1]; part += warps)
      visit(part, plan_.part_start[part], plan_.part_start[part + 1]);
  }

  template <class Visit>
  __device__ void each_piece(const Visit& visit) const {
    const int warps = blockDim.x / warp_size;
    for (int piece = int(threadIdx.x) / warp_size; piece < plan_.pieces; piece += warps)
      visit(piece);
  }

  // ---- results

  __device__ void store(int record) {
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
  int team_;
  const FusedScratch<T>& memory_;
  Control& control_;
  Quad<T>*position_,
      *entries_;  // where elements read vertices, relative to the patch; their forces
  Vertices<T, Touching> v_;
  Plane<T>* planes_;
  Ball<T>* balls_;
  Inputs<T> in_;
  Contacts<T> contacts_;
  Seat seat_;  // with many patches
  T h_, theta_, omega_ = T(1);
  double energy_ = 0, first_ = 0, second_ = 0;  // this thread's part of the sums
  int wanted_ = 0;                              // sums that were left
  unsigned round_ = 0, sum_round_ = 0;          // exchanges so far
  bool finished_ = false, pending_ = false, guarding_ = false, started_ = false;
};

}  // namespace pd::inline PD_TARGET
