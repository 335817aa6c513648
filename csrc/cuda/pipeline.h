// Iterations over many patches as a pipeline, in float32, one block on each multiprocessor. Its warps have three tasks: some
// work on the elements of a patch, while others add up the forces of the patch before and move its vertices, and others bring
// the slots of the next and help with the forces. Two patches take turns in shared memory. So arithmetic and memory need not
// wait for each other, as they do where every warp of a block goes through all of it; and a thread has both tetrahedra of a
// pair, which share loads, the edges of their face and the sums of forces on it. It pays where a multiprocessor has many
// patches one after another, to fill it but once.
#pragma once
#include "cuda/handoff.h"
#include "cuda/stream.h"

namespace pd::inline PD_TARGET {

// In this order: movers, bringers, elements (producer and consumer warps). So many that each thread may have 96 registers,
// which elements want, and that a block of stream_shared has room beside: 640 x 96 + 128 x 32 registers are all 65,536. Of
// the others on an H100: 384, 512, 576 and 640 threads for elements with 64 to 320 for the rest took more time, with or
// without both tetrahedra of a pair in a thread; movers and bringers as one task took more, and so did anything that spilled
// registers, since hardly any cache is left for them. So did, for a million vertices, movers that also move the vertices that
// patches share, as soon as their last patch is done (15 us more than with a kernel of their own after this one; beside it
// that takes 3 us less), and bringers that work out what these are to be from the forces of the pass before (60 us); rest
// positions behind origins, 24 bytes a slot in place of 32 (4 us); both tetrahedra in the frame of their face, a seventh
// fewer instructions, but ten spilled registers (9 us); and forces on shared vertices that the L2 cache is to let go of last
// (16 us; u and the iterate before: no difference).
//
// Movers and bringers take about as long for a patch as elements do, so anything more that they do costs: slots that are
// asked for a whole turn before (8 us), patches by tickets (6 us, though blocks end up to 9 us apart), other rows for movers
// and bringers to add up (one more for movers 9 us, one fewer 4 us). What they no longer do is gained: a warp tells 32 stops
// at once (2.5 us), and entries are added up by fewer instructions (1.5 us), though movers and bringers spill some registers
// for it: the same without spills, but entry by entry where less than four are left, takes 1 us more. Patches of more or
// fewer tetrahedra took 4 to 17 us more. Entries that meet in banks cost: a fifth fewer passes (plan/phases.h) gained 1.8 us. A
// pass that starts before the one before has ended, since whoever reads a vertex sees by the sign of 1 / D of which pass it is,
// gained as much, but not more: the kernel of shared vertices is then what others wait for.
//
// Without any arithmetic an iteration would take 12 % less; schedulers issue in 71 % of their cycles, and DRAM is busy for 46
// % (by a profiler, at 1.6 GHz). Fewer instructions and bytes of elements alone do not help: determinants worked out from
// corners in the frame of their face, 537 instructions and 20 bytes a pair in place of 624 and 28, took as long. Nor did
// slots that one thread has copied in bulk, or all by copies of 16 bytes, or then 512 threads of 80 registers for elements.
//
// A register that is written under a condition is kept from before, all around a loop: so where a thread has no slot, it
// reads what is the first one's.
constexpr int mover_threads = 128, bringer_threads = 128, element_threads = 384;
constexpr int pipeline_threads = mover_threads + bringer_threads + element_threads;

// The patches of a block, of all environments: item after item, from its own number on as far apart as there are blocks.
template <class T, Visit What>
class Pipeline {
  static_assert(
      sizeof(T) == 4,
      "shared memory holds two patches in float32 alone, and SharedSlots knows no other numbers");

 public:
  PD_DEVICE Pipeline(const StreamCall<T>& call, int k, unsigned round, std::byte* shared)
      : call_(call), k_(k), round_(round), shared_(shared) {}

  // All threads of the block, each its own task.
  PD_DEVICE void run() const {
    const bool moves = mover() < mover_threads, brings = !moves && bringer() < bringer_threads;
    if (threadIdx.x == 0) open_signals();
    if (brings) {
      if (call_.step.settings.tolerance > 0) await_kernel_before();
      if (bringer() == 0) ahead() = {int(blockIdx.x), 0};
      if (bringer() < warp_size) tell_stops(0);
    }
    __syncthreads();
    if (told(0).blocks == 0) return await_kernel_before();
    if (moves) {
      move_vertices();
    } else if (brings) {
      bring_slots();
    } else {
      work_on_elements();
    }
  }

 private:
  using Work = StreamWork<T, false>;
  using Seen = typename Vertices<T, false>::Seen;

  static constexpr int element_warps = element_threads / warp_size;
  // Slots that bringers have in registers at once; those of larger patches follow one by one.
  static constexpr int usual_slots = 640;
  static constexpr int brought = usual_slots / bringer_threads;
  // From left_slots on bringers add up the forces of slots that are not inside the patch.
  static constexpr int moved = 3, left_slots = moved * mover_threads;
  // Of moved, so many are mostly inside a patch: what a visit wants is asked for before it is wanted.
  static constexpr int soon = 2;

  PD_DEVICE static int mover() { return int(threadIdx.x); }
  PD_DEVICE static int bringer() { return int(threadIdx.x) - mover_threads; }
  PD_DEVICE static int element_warp() {
    return (int(threadIdx.x) - mover_threads - bringer_threads) / warp_size;
  }

  PD_DEVICE const DevicePlan<T>& plan() const { return call_.step.plan; }

  // ---- who waits for whom, for either half of shared memory

  // Slots are there and entries are free (elements wait); forces are there and slots are free (movers and bringers wait).
  enum Event { slots_ready, forces_ready, events };

  PD_DEVICE Signal signal(Event event, unsigned n) const {
    __shared__ std::uint64_t words[2 * events];
    return Signal(words + 2 * event + (n & 1));
  }
  PD_DEVICE void open_signals() const {
    for (unsigned n = 0; n < 2; ++n) {
      signal(slots_ready, n).open(mover_threads + bringer_threads);
      signal(forces_ready, n).open(element_threads);
    }
  }
  PD_DEVICE void give(Event event, unsigned n) const { signal(event, n).give(); }
  PD_DEVICE void await(Event event, unsigned n) const { signal(event, n).await(n / 2); }

  // ---- stops of the block

  // Where a patch lies in the arrays.
  struct Stop {
    int environment, patch, first_vertex, interior, first_slot, slots, first_block;
    int blocks;        // of pairs; 0: there is no such patch
    int first_warp;    // of the elements' warps, which has the first of them
    T patch_weight;    // StreamMemory::patch_weight
    unsigned weights;  // blocks of them before those of its environment
  };

  PD_DEVICE Work work(int environment) const { return Work(call_, environment); }

  // Stop `n` of the block. Whoever wants to know reads it there, since registers for it would be too many. A warp tells as many
  // at once as it has lanes, in turn n of bringers those from n + 16 on, in place of n - 48 to n - 17: nobody is so far behind,
  // since movers are past n - 4 and elements past n - 2 by then.
  static constexpr unsigned told_at_once = warp_size;
  PD_DEVICE Stop& told(unsigned n) const {
    __shared__ Stop stops[2 * told_at_once];
    return stops[n % (2 * told_at_once)];
  }
  // what comes after the stops that are told
  struct Ahead {
    int item, first_warp;
  };
  PD_DEVICE Ahead& ahead() const {
    __shared__ Ahead stops;
    return stops;
  }

  // Stops from `first` on, by a warp: items of environments that go on.
  PD_DEVICE void tell_stops(unsigned first) const {
    __syncwarp();
    Ahead next = ahead();
    const int lane = bringer(), patches = plan().patches, stride = int(gridDim.x);
    const bool own = call_.step.material.stiffness.stride != 0;
    int found = 0;
    while (found < int(told_at_once)) {
      const int item = next.item + lane * stride;
      const int environment = item / patches, patch = item - environment * patches;
      const bool there = environment < call_.step.batch;
      const unsigned goes_on =
          __ballot_sync(whole_warp, there && !skips<What>(work(there ? environment : 0)));
      const int rank = found + __popc(goes_on & ((1u << lane) - 1));
      const bool mine = (goes_on >> lane & 1) && rank < int(told_at_once);
      Stop s{};
      if (mine) {
        s.environment = environment;
        s.patch = patch;
        s.first_vertex = plan().patch_vertex[patch];
        s.interior = plan().patch_vertex[patch + 1] - s.first_vertex;
        s.first_slot = plan().patch_slot[patch];
        s.slots = plan().patch_slot[patch + 1] - s.first_slot;
        s.first_block = plan().patch_block[patch];
        s.blocks = plan().patch_block[patch + 1] - s.first_block;
        s.weights = own ? unsigned(environment) * unsigned(plan().blocks) : 0;
        s.patch_weight = work(environment).patch_weight[patch];
      }
      // the guard's energies are summed alike in any batch
      if (What == Visit::update) {
        int until = s.blocks;
#pragma unroll
        for (int distance = 1; distance < warp_size; distance *= 2) {
          const int before = __shfl_up_sync(whole_warp, until, distance);
          if (lane >= distance) until += before;
        }
        s.first_warp = (next.first_warp + until - s.blocks) % element_warps;
        next.first_warp =
            (next.first_warp + __shfl_sync(whole_warp, until, warp_size - 1)) % element_warps;
      }
      if (mine) told(first + unsigned(rank)) = s;
      found += __popc(goes_on);
      if (!__any_sync(whole_warp, there)) {
        if (found + lane < int(told_at_once)) told(first + unsigned(found + lane)) = Stop{};
        break;
      }
      next.item =
          __reduce_max_sync(whole_warp, mine || found < int(told_at_once) ? item : 0) + stride;
    }
    if (lane == 0) ahead() = next;
  }

  PD_DEVICE std::byte* half(unsigned n) const {
    return shared_ +
           (n & 1) * pipeline_half_bytes(sizeof(T), plan().most_slots, plan().most_entries);
  }
  PD_DEVICE Slots<T> slots_of(unsigned n) const { return Slots<T>(half(n), plan().most_slots); }

  // Two numbers of every entry, then the third of every entry.
  struct Entries {
    struct alignas(2 * sizeof(T)) Two {
      T x, y;
    };
    const Two* first;
    const T* third;

    PD_DEVICE Entries operator+(unsigned count) const { return {first + count, third + count}; }
    PD_DEVICE Entries& operator+=(unsigned count) { return *this = *this + count; }
    PD_DEVICE Quad<T> operator[](unsigned entry) const {
      const Two two = first[entry];
      return {two.x, two.y, third[entry], T(0)};
    }
  };
  PD_DEVICE Entries entries_of(unsigned n) const {
    const std::byte* entries = half(n) + slots_bytes(sizeof(T), plan().most_slots, 2);
    const auto* first = reinterpret_cast<const typename Entries::Two*>(entries);
    return {first, reinterpret_cast<const T*>(first + plan().most_entries)};
  }
  // what each warp has met of the elements' energy
  PD_DEVICE double* energies_of(unsigned n) const {
    __shared__ double energies[2][element_warps];
    return energies[n & 1];
  }

  // ---- slots

  // Past the last stop, too: nothing is brought, but the forces of the two before are there.
  PD_DEVICE void bring_slots() const {
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

  // The forces that movers leave to bringers, who have the time.
  struct Left {
    int row, place;
  };
  PD_DEVICE static int first_left(const Stop& at) {
    return max(left_slots, at.interior) + bringer();
  }
  PD_DEVICE Left left_at(const Stop& at, int s) const {
    if (s >= at.slots) return {0, 0};
    return {plan().slot_row[at.first_slot + s], place_of_force(at, s)};
  }
  PD_DEVICE void sum_shared(unsigned n, Left left) const {
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

  PD_DEVICE int place_of_force(const Stop& at, int s) const {
    return pd::place_of_force(plan(), at.first_slot, at.first_vertex + at.interior, s);
  }

  // What is on its way to the slots.
  struct Held {
    Vec3<T> u[brought], origin[brought];
    RestPoint<T> rest[brought];
  };

  PD_DEVICE int vertex_of(const Stop& at, int slot) const {
    return slot < at.interior ? at.first_vertex + slot : plan().slot_vertex[at.first_slot + slot];
  }
  PD_DEVICE void find(const Stop& at, int (&vertex)[brought]) const {
#pragma unroll
    for (int r = 0; r < brought; ++r) {
      const int s = bringer() + r * bringer_threads;
      vertex[r] = at.first_vertex + (s < at.interior ? s : 0);
      if (s >= at.interior && s < at.slots) vertex[r] = plan().slot_vertex[at.first_slot + s];
    }
  }

  PD_DEVICE void ask(const Stop& at, const int (&vertex)[brought], Held& held) const {
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

  PD_DEVICE void put(const Stop& at, const Held& held, unsigned n) const {
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

  // ---- elements

  struct PairInputs : PairNumbers<T> {
    T factor[2];  // pair_factor
  };

  // What a warp has of a stop: blocks of pairs, as far apart as there are warps. They go on with the next stop's where the
  // last one's end, so that none of them has more to do than others.
  struct Share {
    unsigned block, end;  // none left: block >= end
    unsigned weights;     // as of its stop
    T patch_weight;
  };
  PD_DEVICE Share share_of(unsigned n) const {
    const Stop& in = told(n);
    unsigned turn = unsigned(element_warp() + element_warps - in.first_warp);
    if (turn >= unsigned(element_warps)) turn -= element_warps;
    const auto first = unsigned(in.first_block);
    const bool none = turn >= unsigned(in.blocks);
    return {none ? first : first + turn, none ? first : first + unsigned(in.blocks), in.weights,
            in.patch_weight};
  }

  // A lane a pair, of the next block; where none is left, some of the stop's that nobody wants.
  PD_DEVICE PairInputs read(const Share& share) const {
    const unsigned lane = threadIdx.x % warp_size, block = share.block;
    const int32* corner = plan().pair_corner + (block * (5 * pair_lanes) + lane);
    const T* factor = plan().pair_factor + (block * (2 * pair_lanes) + lane);
    PairInputs pair;
    // once a patch: the caches had better keep something else
    for (int c = 0; c < 5; ++c) pair.corner[c] = unsigned(__ldcs(corner + c * pair_lanes));
    for (int e = 0; e < 2; ++e) pair.factor[e] = __ldcs(factor + e * pair_lanes);
    for (int e = 0; e < 2; ++e) pair.weight[e] = T(0);
    if (share.patch_weight < T(0)) {
      const T* weight = weights_of(share.block, share.weights) + lane;
      for (int e = 0; e < 2; ++e) pair.weight[e] = __ldcs(weight + e * pair_lanes);
    }
    return pair;
  }

  // of a block of pairs
  PD_DEVICE const T* weights_of(unsigned block, unsigned weights) const {
    return call_.memory.weights + std::size_t(block + weights) * (2 * pair_lanes);
  }

  // Not before its end is what was read looked at, since whoever moves a number waits for it. `patch_weight`: of its stop.
  PD_DEVICE static void take(PairInputs& now, const PairInputs& read, T patch_weight) {
    for (int c = 0; c < 5; ++c) now.corner[c] = in_register(read.corner[c]);
    for (int e = 0; e < 2; ++e) now.factor[e] = in_register(read.factor[e]);
    for (int e = 0; e < 2; ++e) {
      const T found = tet_weight(patch_weight, now.factor[e]);
      const bool there = now.corner[3 + e] < unsigned(no_entry) << 16;
      now.weight[e] = in_register(patch_weight < T(0) ? read.weight[e] : there ? found : T(0));
    }
  }

  // Has all pairs of a stop brought into the L2 cache.
  PD_DEVICE void bring_pairs_near(unsigned n) const {
    const Stop& in = told(n);
    const auto near = [](const auto* items, int count) {
      bring_near(items, count, int(threadIdx.x) - mover_threads - bringer_threads, element_threads);
    };
    constexpr int two = 2 * pair_lanes, five = 5 * pair_lanes;
    near(plan().pair_corner + std::size_t(in.first_block) * five, in.blocks * five);
    near(plan().pair_factor + std::size_t(in.first_block) * two, in.blocks * two);
    if (in.patch_weight < T(0))
      near(weights_of(unsigned(in.first_block), in.weights), in.blocks * two);
  }

  PD_DEVICE void work_on_elements() const {
    Share share = share_of(0);
    PairInputs now;
    take(now, read(share), share.patch_weight);
#pragma unroll 1
    for (unsigned n = 0;; ++n) {
      bring_pairs_near(n + 1);
      await(slots_ready, n);
      const SharedSlots slots(*this, n);
      T energy = T(0);
      bool more = share.block < share.end;
      // else the last turn has read the first pairs of the next stop
      if (!more) {
        share = share_of(n + 1);
        take(now, read(share), share.patch_weight);
      }
#pragma unroll 1
      while (more) {
        PairInputs then;
        work_on_pair(now, slots, energy, [&] {
          share.block += element_warps;
          more = share.block < share.end;
          if (!more) share = share_of(n + 1);
          then = read(share);
        });
        take(now, then, share.patch_weight);
      }
      if constexpr (What == Visit::update_guarded) {
        const double sum = across_warp(double(energy), Add{});
        if (threadIdx.x % warp_size == 0) energies_of(n)[element_warp()] = sum;
      }
      give(forces_ready, n);
      if (told(n + 1).blocks == 0) return;
    }
  }

  // Slots and entries of a half by 32-bit addresses, which stay in registers; by pointers they would be worked out again for
  // each of them. Three instructions find a slot, and two an entry, since pipeline_slots leaves bits 13 to 15 of a corner 0.
  class SharedSlots {
   public:
    PD_DEVICE SharedSlots(const Pipeline& p, unsigned n) {
      const unsigned slots = unsigned(p.plan().most_slots), entries = p.plan().most_entries;
      first_ = in_register(shared_address(p.half(n)));
      second_ = in_register(first_ + 16 * slots);
      entry_ = in_register(first_ + unsigned(slots_bytes(sizeof(T), slots, 2)));
      third_ = in_register(entry_ + 8 * entries);
    }

    // `corner`: of PairNumbers. What is volatile keeps its order, so nothing is looked at before it is awaited.
    PD_DEVICE void look(unsigned corner, Vec3<T>& position, RestPoint<T>& rest) const {
      const SharedAddress slot_times_8 = in_register(corner & 0xffff);
      Quad<T> seen;
      Vec3<T> bits;
      asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
                   : "=f"(seen.x), "=f"(seen.y), "=f"(seen.z), "=f"(bits.x)
                   : "r"(first_ + 2 * slot_times_8));
      asm volatile("ld.shared.v2.f32 {%0, %1}, [%2];"
                   : "=f"(bits.y), "=f"(bits.z)
                   : "r"(second_ + slot_times_8));
      position = vec3(seen);
      rest = RestPoint<T>::of(bits);
    }
    // Unless the corner has no entry.
    PD_DEVICE void leave(unsigned corner, const Vec3<T>& force) const {
      asm volatile(
          "{.reg .pred p; setp.lt.u32 p, %0, 0xffff0000; @p st.shared.v2.f32 [%1], {%3, %4}; "
          "@p st.shared.f32 [%2], %5;}" ::"r"(corner),
          "r"(entry_ + (corner >> 13)), "r"(third_ + (corner >> 14)), "f"(force.x), "f"(force.y),
          "f"(force.z)
          : "memory");
    }

   private:
    SharedAddress first_, second_, entry_, third_;
  };

  // `read_next`: between its tetrahedra, where the fewest registers are in use. Lanes past the last pair leave no force, and
  // what they strain weighs nothing.
  template <class ReadNext>
  PD_DEVICE void work_on_pair(const PairInputs& now, const SharedSlots& slots, T& energy,
                              const ReadNext& read_next) const {
    const typename ElementOf<What>::type element;
    Pair<T, 1> pair;
    RestPoint<T> rest[5];
    const auto look = [&](int c) { slots.look(now.corner[c], pair.corner[0][c], rest[c]); };
    const auto leave = [&](int c) { slots.leave(now.corner[c], pair.force[c]); };
    for (int c = 0; c < 4; ++c) look(c);
    element.template run<1>(PairElement<T, 1, OneOf<T, 0>>{
        pair, ComputedRest<T>::inverse_between({rest[0], rest[1], rest[2], rest[3]}, now.factor[0]),
        now.weight[0], energy});
    leave(3);
    read_next();
    look(4);
    element.template run<1>(PairElement<T, 1, OneOf<T, 1>>{
        pair, ComputedRest<T>::inverse_between({rest[0], rest[1], rest[2], rest[4]}, now.factor[1]),
        now.weight[1], energy});
    for (int c = 0; c < 3; ++c) leave(c);
    leave(4);
  }

  // ---- vertices

  PD_DEVICE void move_vertices() const {
    // the entries of both halves are free
    for (unsigned n = 0; n < 2; ++n) give(slots_ready, n);
    bring_patch_near(0);
    await_kernel_before();
    // not before, see handoff.h
    if (mover() == 0) let_next_kernel_start();
#pragma unroll 1
    for (unsigned n = 0; told(n).blocks > 0; ++n) move_patch(n);
  }

  PD_DEVICE void move_patch(unsigned n) const {
    const Stop& at = told(n);
    const Work w = work(at.environment);
    const Entries entries = entries_of(n);
    const int interior = at.interior, first_vertex = at.first_vertex;
    const int slots = at.slots, first_slot = at.first_slot;
    ThreadSums sums = no_sums<What>();
    const auto slot = [](int r) { return mover() + r * mover_threads; };
    const auto see_slot = [&](int s) {
      return see<What>(w, first_vertex + (s < interior ? s : 0));
    };
    const auto visit_slot = [&](int s, const Vec3<T>& force, const auto& seen_there) {
      if (s < interior) {
        visit<What>(w, first_vertex + s, seen_there(), force, k_, sums);
      } else if (s < slots) {
        w.leave_force(place_of_force(at, s), force, round_);
      }
    };
    int row[moved];
    Vec3<T> force[moved];
    Seen seen[soon];
#pragma unroll
    for (int r = 0; r < moved; ++r)
      row[r] = slot(r) < slots ? w.plan.slot_row[first_slot + slot(r)] : 0;
#pragma unroll
    for (int r = 0; r < soon; ++r) seen[r] = see_slot(slot(r));
    bring_patch_near(n + 1);
    await(forces_ready, n);
    if (What == Visit::update_guarded && mover() < element_warps)
      sums.value[0] += energies_of(n)[mover()];
    // first what frees the half
#pragma unroll
    for (int r = 0; r < moved; ++r) force[r] = sum_entries_briefly<T>(entries, row[r]);
    const auto visit_late = [&](int s, const Vec3<T>& summed) {
      visit_slot(s, summed, [&] { return see_slot(s); });
    };
#pragma unroll 1
    for (int s = slot(moved); s < interior; s += mover_threads)
      visit_late(s, sum_entries_briefly<T>(entries, w.plan.slot_row[first_slot + s]));
    give(slots_ready, n);
#pragma unroll
    for (int r = 0; r < soon; ++r) visit_slot(slot(r), force[r], [&] { return seen[r]; });
#pragma unroll
    for (int r = soon; r < moved; ++r) visit_late(slot(r), force[r]);
    if (wants_sums<What>(w)) write_mover_sums(sums, n, w.sum_row(at.patch));
  }

  // Has what movers read of a patch brought into the L2 cache.
  PD_DEVICE void bring_patch_near(unsigned n) const {
    const Stop& at = told(n);
    const Work w = work(at.environment);
    bring_near(w.v.before + at.first_vertex, at.interior, mover(), mover_threads);
    bring_near(w.v.target + at.first_vertex, at.interior, mover(), mover_threads);
    bring_near(w.plan.slot_row + at.first_slot, at.slots, mover(), mover_threads);
  }

  PD_DEVICE void write_mover_sums(const ThreadSums& sums, unsigned n, double* row) const {
    constexpr int warps = mover_threads / warp_size;
    // those who are ahead write the others while somebody still reads
    __shared__ double both[2][sums_count][warps];
    double (&warp_sum)[sums_count][warps] = both[n & 1];
    for (int i = 0; i < sums_count; ++i) {
      const double sum = across_warp(sums.value[i], Add{});
      if (mover() % warp_size == 0) warp_sum[i][mover() / warp_size] = sum;
    }
    meet_movers();
    if (mover() < sums_count) {
      double sum = 0;
      for (int i = 0; i < warps; ++i) sum += warp_sum[mover()][i];
      row[mover()] = sum;
    }
  }
  PD_DEVICE static void meet_movers() {
    __syncwarp();
    asm volatile("bar.sync 1, %0;" ::"n"(mover_threads) : "memory");
  }

  const StreamCall<T>& call_;
  int k_;
  unsigned round_;
  std::byte* shared_;
};

// Visit::update and Visit::update_guarded of stream_patches, without contacts.
template <Visit What, class T>
__global__ void __launch_bounds__(pipeline_threads, 1)
    stream_pipeline(const __grid_constant__ StreamCall<T> call, int k, unsigned round) {
  extern __shared__ __align__(16) std::byte shared[];
  Pipeline<T, What>(call, k, round, shared).run();
}

}  // namespace pd::inline PD_TARGET
