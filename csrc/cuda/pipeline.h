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
constexpr int updater_threads = 128, loader_threads = 128, element_threads = 384;
constexpr int pipeline_threads = updater_threads + loader_threads + element_threads;

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
    const bool updates = updater() < updater_threads, loads = !updates && loader() < loader_threads;
    if (threadIdx.x == 0) init_signals();
    if (loads) {
      if (call_.step.settings.tolerance > 0) wait_for_previous_kernel();
      if (loader() == 0) schedule_cursor() = {int(blockIdx.x), 0};
      if (loader() < warp_size) extend_schedule(0);
    }
    __syncthreads();
    if (scheduled(0).blocks == 0) return wait_for_previous_kernel();
    if (updates) {
      update_vertices();
    } else if (loads) {
      load_slots();
    } else {
      process_elements();
    }
  }

 private:
  using Work = StreamWork<T, false>;
  using LoadedVertex = typename Vertices<T, false>::LoadedVertex;

  static constexpr int element_warps = element_threads / warp_size;
  // Slots that bringers have in registers at once; those of larger patches follow one by one.
  static constexpr int usual_slots = 640;
  static constexpr int loaded_slots = usual_slots / loader_threads;
  // From left_slots on bringers add up the forces of slots that are not inside the patch.
  static constexpr int updated = 3, updated_slots = updated * updater_threads;
  // Of moved, what visits of so many want is asked for before forces are awaited, that of the others after.
  static constexpr int prefetched = 2;

  PD_DEVICE static int updater() { return int(threadIdx.x); }
  PD_DEVICE static int loader() { return int(threadIdx.x) - updater_threads; }
  PD_DEVICE static int element_warp() {
    return (int(threadIdx.x) - updater_threads - loader_threads) / warp_size;
  }

  PD_DEVICE const DevicePlan<T>& plan() const { return call_.step.plan; }

  // ---- who waits for whom, for either half of shared memory

  // Slots are there and entries are free (elements wait); forces are there and slots are free (movers and bringers wait).
  enum Event { slots_ready, forces_ready, events };

  PD_DEVICE Signal signal(Event event, unsigned n) const {
    __shared__ std::uint64_t words[2 * events];
    return Signal(words + 2 * event + (n & 1));
  }
  PD_DEVICE void init_signals() const {
    for (unsigned n = 0; n < 2; ++n) {
      signal(slots_ready, n).init(updater_threads + loader_threads);
      signal(forces_ready, n).init(element_threads);
    }
  }
  PD_DEVICE void arrive(Event event, unsigned n) const { signal(event, n).arrive(); }
  PD_DEVICE void wait(Event event, unsigned n) const { signal(event, n).wait(n / 2); }

  // ---- stops of the block

  // Where a patch lies in the arrays. Those that have numbers for every environment are read as one array of all of them, from
  // that of the first on, which takes one instruction; 32 bits count them (StreamRunner::pipe).
  struct alignas(16) ScheduledPatch {
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
  static constexpr unsigned schedule_chunk = warp_size;
  PD_DEVICE ScheduledPatch& scheduled(unsigned n) const {
    __shared__ ScheduledPatch table[2 * schedule_chunk];
    return table[n % (2 * schedule_chunk)];
  }
  // what comes after the stops that are told
  struct ScheduleCursor {
    int item, first_warp;
  };
  PD_DEVICE ScheduleCursor& schedule_cursor() const {
    __shared__ ScheduleCursor table;
    return table;
  }

  PD_DEVICE void extend_schedule(unsigned first) const;  // cuda/pipeline_stops.h

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

  PD_DEVICE unsigned place_of_force(const ScheduledPatch& at, int s) const {
    return at.place + unsigned(plan().shared_place[at.first_place + s]);
  }

  // ---- slots: cuda/pipeline_bring.h

  struct SlotData;
  struct RemainingForce;
  PD_DEVICE void load_slots() const;
  PD_DEVICE static int first_remaining(const ScheduledPatch& at);
  PD_DEVICE RemainingForce remaining_at(const ScheduledPatch& at, int s) const;
  PD_DEVICE void sum_remaining(unsigned n, RemainingForce remaining) const;
  PD_DEVICE unsigned vertex_of(const ScheduledPatch& at, int slot) const;
  PD_DEVICE void load_vertices(const ScheduledPatch& in, unsigned (&vertex)[loaded_slots]) const;
  PD_DEVICE void load_slot_data(const ScheduledPatch& in, const unsigned (&vertex)[loaded_slots],
                                SlotData& data) const;
  PD_DEVICE void store_slots(int slots, unsigned n, const SlotData& data) const;

  // ---- elements: cuda/pipeline_elements.h

  struct PairData;
  struct Share;
  class SharedSlots;
  PD_DEVICE void process_elements() const;
  PD_DEVICE Share share_of(unsigned n) const;
  PD_DEVICE PairData read(const Share& share) const;
  PD_DEVICE const T* weights_of(unsigned block, unsigned weights) const;
  PD_DEVICE static void finish_load(PairData& now, const PairData& read, T patch_weight);
  PD_DEVICE void prefetch_pairs(unsigned n) const;
  template <class ReadNext>
  PD_DEVICE void process_pair(const PairData& now, const SharedSlots& slots, T unit, T& energy,
                              const ReadNext& read_next) const;

  // ---- vertices: cuda/pipeline_move.h

  PD_DEVICE void update_vertices() const;
  PD_DEVICE void update_patch(unsigned n) const;
  PD_DEVICE void prefetch_patch(unsigned n) const;
  PD_DEVICE void write_updater_sums(const ThreadSums& sums, unsigned n, double* row) const;
  PD_DEVICE static void sync_updaters();

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
