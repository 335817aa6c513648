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
// which elements want, and that a block of stream_shared has room beside: 640 x 96 + 128 x 32 registers are all 65,536. Hardly
// any cache is left for registers that spill: ten of elements outweigh a seventh of their instructions.
//
// Movers and bringers take about as long for a patch as elements do, so anything more that they do costs: one more row for
// movers to add up 9 us, one more for bringers in its place 4 us, of an iteration of a million vertices on an H100. So a warp
// tells 32 stops at once, in words of 16 bytes; entries are added up by few instructions, though movers and bringers spill some
// registers for it; what is read from memory is asked for before anything that waits; and vertices that patches share have a kernel
// of their own. Entries that meet in banks cost, too (plan/phases.h). Patches are dealt out beforehand: blocks end up to 9 us
// apart, but tickets would cost more.
//
// By clocks inside the kernel elements wait for 13 % of their time, movers for 9 % and bringers for 30 %: what is left to gain is
// in the instructions of elements, and in warps for which there are no registers.
//
// A register that is written under a condition is kept from before, all around a loop: so where a thread has no slot, it
// reads what is the first one's. And whoever writes to a register waits for a load that is on its way there, the fourth number of
// 16 bytes included, which nobody reads.
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
  // Of moved, what visits of so many want is asked for before forces are awaited, that of the others after.
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

  // Where a patch lies in the arrays. Those that have numbers for every environment are read as one array of all of them, from
  // that of the first on, which takes one instruction; 32 bits count them (StreamRunner::pipe).
  struct alignas(16) Stop {
    unsigned vertex, slot, place;  // the first of those before the environment's
    int first_vertex, interior;    // of the plan, as are the next three
    int first_slot, slots, first_place;
    int environment, patch;
    int first_block, blocks;  // of pairs; blocks 0: there is no such patch
    int first_warp;           // of the elements' warps, which has the first of them
    T patch_weight;           // StreamMemory::patch_weight
    unsigned weights;         // blocks of them before those of its environment
    T unit;                   // of rest positions [m]
  };

  PD_DEVICE Work work(int environment = 0) const { return Work(call_, environment); }

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

  PD_DEVICE void tell_stops(unsigned first) const;  // cuda/pipeline_stops.h

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

  PD_DEVICE unsigned place_of_force(const Stop& at, int s) const {
    return at.place + unsigned(plan().shared_place[at.first_place + s]);
  }

  // ---- slots: cuda/pipeline_bring.h

  struct Held;
  struct Left;
  PD_DEVICE void bring_slots() const;
  PD_DEVICE static int first_left(const Stop& at);
  PD_DEVICE Left left_at(const Stop& at, int s) const;
  PD_DEVICE void sum_shared(unsigned n, Left left) const;
  PD_DEVICE unsigned vertex_of(const Stop& at, int slot) const;
  PD_DEVICE void find(const Stop& in, unsigned (&vertex)[brought]) const;
  PD_DEVICE void ask(const Stop& in, const unsigned (&vertex)[brought], Held& held) const;
  PD_DEVICE void put(int slots, unsigned n, const Held& held) const;

  // ---- elements: cuda/pipeline_elements.h

  struct PairInputs;
  struct Share;
  class SharedSlots;
  PD_DEVICE void work_on_elements() const;
  PD_DEVICE Share share_of(unsigned n) const;
  PD_DEVICE PairInputs read(const Share& share) const;
  PD_DEVICE const T* weights_of(unsigned block, unsigned weights) const;
  PD_DEVICE static void take(PairInputs& now, const PairInputs& read, T patch_weight);
  PD_DEVICE void bring_pairs_near(unsigned n) const;
  template <class ReadNext>
  PD_DEVICE void work_on_pair(const PairInputs& now, const SharedSlots& slots, T unit, T& energy,
                              const ReadNext& read_next) const;

  // ---- vertices: cuda/pipeline_move.h

  PD_DEVICE void move_vertices() const;
  PD_DEVICE void move_patch(unsigned n) const;
  PD_DEVICE void bring_patch_near(unsigned n) const;
  PD_DEVICE void write_mover_sums(const ThreadSums& sums, unsigned n, double* row) const;
  PD_DEVICE static void meet_movers();

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
