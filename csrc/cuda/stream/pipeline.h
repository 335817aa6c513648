// Iterations over many patches as a pipeline in float32, with one block per multiprocessor. Its
// warps have three tasks. Element warps compute the elements of a patch. Updaters sum the forces of
// the previous patch and update its vertices. Loaders load the slots of the next patch and help to
// sum forces.
//
// Two patches are in shared memory at a time, so arithmetic overlaps with memory access. A thread
// computes both tetrahedra of a pair, which share loads, face edges and force sums. The pipeline
// pays off when a multiprocessor processes many patches, since it fills only once.
#pragma once
#include "cuda/stream/kernel_overlap.h"
#include "cuda/stream/kernels.h"

namespace pd::inline PD_TARGET {

// Warp roles, in this order: updaters, loaders, elements. The sizes leave 96 registers per thread,
// which elements need, and room for a block of stream_shared: 640 x 96 + 128 x 32 = 65,536
// registers. The cache has little room for spilled registers: ten spills in the element code cost
// more than a seventh of its instructions saves.
//
// Updaters and loaders take about as long per patch as elements, so any extra work in them costs
// time. On an H100 with a million vertices, one more row of forces costs 9 us per iteration in the
// updaters, or 4 us in the loaders.
//
// Therefore one warp schedules 32 patches at once, in 16-byte words. Sums of entries use few
// instructions, although updaters and loaders spill some registers. Loads are issued before any
// wait. Shared vertices have a kernel of their own. Bank conflicts between entries also cost time
// (plan/gpu/bank_conflicts.h). Patches are assigned in advance: blocks end up to 9 us apart, but a work queue
// would cost more.
//
// By clocks inside the kernel, elements wait for 13 % of their time, updaters for 9 % and loaders
// for 30 %. Further gains need fewer element instructions, or more warps, for which there are no
// registers.
//
// A register written under a condition stays live around the loop. So a thread without a slot reads
// the first slot instead. A write to a register also waits for a load into it that is in flight,
// which includes the unused fourth component of a 16-byte load.
constexpr int updater_threads = 128, loader_threads = 128, element_threads = 384;
constexpr int pipeline_threads = updater_threads + loader_threads + element_threads;

// The patches of a block over all environments: from the block's own index on, with the number of
// blocks as stride.
template <class T, Visit What>
class Pipeline {
  static_assert(
      sizeof(T) == 4,
      "shared memory holds two patches in float32 alone, and SharedSlots knows no other numbers");

 public:
  PD_DEVICE Pipeline(const StreamCall<T>& call, int k, unsigned round, std::byte* shared)
      : call_(call), k_(k), round_(round), shared_(shared) {}

  // Called by all threads of the block; each warp runs its task.
  PD_DEVICE void run() const {
    const bool updates = updater() < updater_threads, loads = !updates && loader() < loader_threads;
    if (threadIdx.x == 0) init_signals();
    if (loads) {
      if (call_.stops) wait_for_previous_kernel();
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
  // slots that loaders hold in registers at once; larger patches load the rest one by one
  static constexpr int usual_slots = 640;
  static constexpr int loaded_slots = usual_slots / loader_threads;
  // from updated_slots on, loaders sum the forces on slots outside the interior
  static constexpr int updated = 3, updated_slots = updated * updater_threads;
  // of the `updated` slots, so many load their vertex before the wait for forces, the others after
  // it
  static constexpr int prefetched = 2;

  PD_DEVICE static int updater() { return int(threadIdx.x); }
  PD_DEVICE static int loader() { return int(threadIdx.x) - updater_threads; }
  PD_DEVICE static int element_warp() {
    return (int(threadIdx.x) - updater_threads - loader_threads) / warp_size;
  }

  PD_DEVICE const DevicePlan<T>& plan() const { return call_.step.plan; }

  // ---- signals, for either half of shared memory

  // slots_ready: slots are loaded and entries are free (elements wait). forces_ready: forces are
  // written and slots are free (updaters and loaders wait).
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

  // ---- schedule of the block

  // Offsets of a patch in the arrays. Arrays with data per environment are indexed from the first
  // environment, which takes one instruction. 32 bits suffice (StreamRunner::pipe).
  struct alignas(16) ScheduledPatch {
    unsigned vertex, slot, place;  // offset of the environment
    int first_vertex, interior;    // in the plan, as are the next three
    int first_slot, slots, first_place;
    int environment, patch;
    int first_block, blocks;  // of pairs; blocks = 0 ends the schedule
    int first_warp;           // element warp that takes the first block
    T patch_weight;           // StreamMemory::patch_weight
    unsigned weights;         // offset of the environment's weights, in blocks
    T unit;                   // of rest positions [m]
  };

  PD_DEVICE Work work(int environment = 0) const { return Work(call_, environment); }

  // Entry `n` of the block's schedule, in shared memory, since it would take too many registers.
  // One warp adds as many entries as it has lanes. In round n of the loaders it writes entries n +
  // 16 to n + 47, over the entries n - 48 to n - 17. No warp still reads those: by then updaters
  // have passed n - 4 and elements n - 2.
  static constexpr unsigned schedule_chunk = warp_size;
  PD_DEVICE ScheduledPatch& scheduled(unsigned n) const {
    __shared__ ScheduledPatch table[2 * schedule_chunk];
    return table[n % (2 * schedule_chunk)];
  }
  // where the schedule continues
  struct ScheduleCursor {
    int item, first_warp;
  };
  PD_DEVICE ScheduleCursor& schedule_cursor() const {
    __shared__ ScheduleCursor table;
    return table;
  }

  PD_DEVICE void extend_schedule(unsigned first) const;  // cuda/stream/pipeline_schedule.h

  PD_DEVICE std::byte* half(unsigned n) const {
    return shared_ +
           (n & 1) * pipeline_half_bytes(sizeof(T), plan().most_slots, plan().most_entries);
  }
  PD_DEVICE Slots<T> slots_of(unsigned n) const { return Slots<T>(half(n), plan().most_slots); }

  // Two components of every entry, then the third component of every entry.
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
  // energy sum of each element warp
  PD_DEVICE double* energies_of(unsigned n) const {
    __shared__ double energies[2][element_warps];
    return energies[n & 1];
  }

  PD_DEVICE unsigned place_of_force(const ScheduledPatch& at, int s) const {
    return at.place + unsigned(plan().shared_place[at.first_place + s]);
  }

  // ---- loaders: cuda/stream/pipeline_load.h

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

  // ---- elements: cuda/stream/pipeline_elements.h

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

  // ---- updaters: cuda/stream/pipeline_update.h

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
