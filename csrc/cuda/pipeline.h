// Iterations over many patches as a pipeline, one block on each multiprocessor. Its warps have three tasks: some work on the
// elements of a patch, while others add up the forces of the patch before and move its vertices, and others bring the slots of
// the next. Two patches take turns in shared memory. So arithmetic and memory need not wait for each other, as they do where
// every warp of a block goes through all of it; and a thread has both tetrahedra of a pair, which costs a sixth fewer
// instructions than one each. It pays where a multiprocessor has many patches one after another, to fill it but once.
#pragma once
#include "cuda/stream.h"

namespace pd::inline PD_TARGET {

// In this order: movers, bringers, elements. So many that each thread may have 96 registers, which elements want. Of the others
// on an H100: 384, 512, 576 and 640 threads for elements with 64 to 320 for the rest took more time, with or without both
// tetrahedra of a pair in a thread; and so did anything that spilled registers, since hardly any cache is left for them.
constexpr int mover_threads = 128, bringer_threads = 128, element_threads = 384;
constexpr int pipeline_threads = mover_threads + bringer_threads + element_threads;

// Barriers of a block beside that of __syncthreads, of either half of shared memory: its slots are there and its entries are
// free (elements wait), the forces in it are there (movers wait), its slots are free (bringers wait); and one of the movers
// alone.
enum Meeting { slots_ready = 1, forces_ready = 3, slots_free = 5, movers_meet = 7 };

// Who comes to each of them.
template <Meeting Which>
constexpr int comers = Which == slots_ready    ? pipeline_threads
                       : Which == forces_ready ? element_threads + mover_threads
                       : Which == slots_free   ? element_threads + bringer_threads
                                               : mover_threads;

// Tells those who wait there that this warp's part is done, and goes on.
template <Meeting Which>
PD_DEVICE void arrive(unsigned turn) {
  __syncwarp();
  asm volatile("bar.arrive %0, %1;" ::"r"(int(Which) + int(turn & 1)), "n"(comers<Which>)
               : "memory");
}
template <Meeting Which>
PD_DEVICE void meet(unsigned turn) {
  __syncwarp();
  asm volatile("bar.sync %0, %1;" ::"r"(int(Which) + int(turn & 1)), "n"(comers<Which>) : "memory");
}

// The patches of a block, of all environments: item after item, from its own number on as far apart as there are blocks.
template <class T, Visit What>
class Pipeline {
 public:
  PD_DEVICE Pipeline(const StreamCall<T>& call, int k, std::byte* shared)
      : call_(call), k_(k), shared_(shared) {}

  // All threads of the block, each its own task.
  PD_DEVICE void run() const {
    const bool moves = mover() < mover_threads, brings = !moves && bringer() < bringer_threads;
    Stop first{};
    if (brings) {
      first = stop(int(blockIdx.x));
      tell(0, first);
    }
    __syncthreads();
    if (told(0).blocks == 0) return;
    if (moves) {
      move_vertices();
    } else if (brings) {
      bring_slots(first);
    } else {
      work_on_elements();
    }
  }

 private:
  using Work = StreamWork<T, false>;
  using Seen = typename Vertices<T, false>::Seen;

  static constexpr int element_warps = element_threads / warp_size;
  // Slots that the threads of a task have in registers at once; those of larger patches follow one by one.
  static constexpr int usual_slots = 640;
  static constexpr int brought = usual_slots / bringer_threads, moved = usual_slots / mover_threads;

  PD_DEVICE static int mover() { return int(threadIdx.x); }
  PD_DEVICE static int bringer() { return int(threadIdx.x) - mover_threads; }
  PD_DEVICE static int element_warp() {
    return (int(threadIdx.x) - mover_threads - bringer_threads) / warp_size;
  }

  PD_DEVICE int items() const { return int(call_.step.batch) * call_.step.plan.patches; }
  PD_DEVICE Work work(int item) const { return Work(call_, item / call_.step.plan.patches); }
  // this item, or the next one whose environment goes on
  PD_DEVICE int next(int item) const {
    while (item < items() && skips<What>(work(item))) item += int(gridDim.x);
    return item;
  }

  // Where a patch lies in the arrays.
  struct Stop {
    int item, first_vertex, interior, first_slot, slots, first_block;
    int blocks;        // of pairs; 0: there is no such patch
    unsigned weights;  // first of its blocks there
  };
  PD_DEVICE Stop stop(int from) const {
    const DevicePlan<T>& plan = call_.step.plan;
    Stop s{};
    s.item = next(from);
    if (s.item >= items()) return s;
    const Patch<T> patch(plan, s.item % plan.patches);
    s.first_vertex = patch.first_vertex;
    s.interior = patch.interior;
    s.first_slot = patch.first_slot;
    s.slots = patch.slots;
    s.first_block = patch.first_block;
    s.blocks = plan.patch_block[patch.index + 1] - patch.first_block;
    const bool own = call_.step.material.stiffness.stride != 0;
    s.weights = unsigned(own ? s.item / plan.patches : 0) * unsigned(plan.blocks) +
                unsigned(patch.first_block);
    return s;
  }

  // Stop `n` of the block, told before the slots of the one before it are ready. Others read it when they want it, since
  // registers for it would be too many; movers may be four behind the one that is told.
  PD_DEVICE volatile Stop& told(unsigned n) const {
    constexpr unsigned kept = 8;
    __shared__ volatile Stop stops[kept];
    return stops[n % kept];
  }
  PD_DEVICE void tell(unsigned n, const Stop& stop) const {
    if (bringer() != 0) return;
    volatile Stop& to = told(n);
    to.first_vertex = stop.first_vertex;
    to.interior = stop.interior;
    to.first_slot = stop.first_slot;
    to.slots = stop.slots;
    to.first_block = stop.first_block;
    to.blocks = stop.blocks;
    to.weights = stop.weights;
  }

  PD_DEVICE std::byte* half(unsigned n) const {
    const DevicePlan<T>& plan = call_.step.plan;
    return shared_ + (n & 1) * pass_shared_bytes(sizeof(T), plan.most_slots, plan.most_entries, 2);
  }
  PD_DEVICE Slots<T> slots_of(unsigned n) const {
    return Slots<T>(half(n), call_.step.plan.most_slots);
  }
  PD_DEVICE Quad<T>* entries_of(unsigned n) const {
    return reinterpret_cast<Quad<T>*>(half(n) +
                                      slots_bytes(sizeof(T), call_.step.plan.most_slots, 2));
  }
  // what each warp has met of the elements' energy
  PD_DEVICE double* energies_of(unsigned n) const {
    __shared__ double energies[2][element_warps];
    return energies[n & 1];
  }

  // ---- slots

  PD_DEVICE void bring_slots(Stop at) const {
    int vertex[brought];
    find(at, vertex);
#pragma unroll 1
    for (unsigned n = 0; at.blocks > 0; ++n) {
      Held held;
      ask(at, vertex, held);
      const Stop later = stop(at.item + int(gridDim.x));
      find(later, vertex);
      if (n >= 2) meet<slots_free>(n);
      put(at, held, n);
      tell(n + 1, later);
      arrive<slots_ready>(n);
      at = later;
      if (at.blocks > 0) continue;
      // nobody is left behind who has arrived
      if (n >= 1) meet<slots_free>(n - 1);
      meet<slots_free>(n);
    }
  }

  // What is on its way to the slots.
  struct Held {
    Vec3<T> u[brought], origin[brought];
    RestPoint<T> rest[brought];
  };

  PD_DEVICE int vertex_of(const Stop& at, int slot) const {
    return slot < at.interior ? at.first_vertex + slot
                              : call_.step.plan.slot_vertex[at.first_slot + slot];
  }
  PD_DEVICE void find(const Stop& at, int (&vertex)[brought]) const {
#pragma unroll
    for (int r = 0; r < brought; ++r) {
      const int s = bringer() + r * bringer_threads;
      // not vertex_of, which would keep the vertex that was there where there is no slot
      vertex[r] = at.first_vertex + s;
      if (s >= at.interior && s < at.slots)
        vertex[r] = call_.step.plan.slot_vertex[at.first_slot + s];
    }
  }

  // Also has what others want to read of the patch brought into the L2 cache.
  PD_DEVICE void ask(const Stop& at, const int (&vertex)[brought], Held& held) const {
    const Work w = work(at.item);
    const RestPoint<T>* rest = rest_positions(w.plan, at.first_slot);
#pragma unroll
    for (int r = 0; r < brought; ++r) {
      const int s = bringer() + r * bringer_threads;
      if (s >= at.slots) break;
      held.u[r] = vec3(w.v.u[vertex[r]]);
      held.origin[r] = vec3(w.origin[at.first_slot + s]);
      held.rest[r] = rest[s];
    }
    const auto near = [](const auto* items, int count) {
      bring_near(items, count, bringer(), bringer_threads);
    };
    near(w.v.before + at.first_vertex, at.interior);
    near(w.v.target + at.first_vertex, at.interior);
    near(w.plan.slot_row + at.first_slot, at.slots);
    constexpr int two = 2 * pair_lanes, five = 5 * pair_lanes;
    near(w.plan.pair_corner + std::size_t(at.first_block) * five, at.blocks * five);
    near(w.plan.pair_factor + std::size_t(at.first_block) * two, at.blocks * two);
    near(weights_of(at.weights), at.blocks * two);
  }

  PD_DEVICE void put(const Stop& at, const Held& held, unsigned n) const {
    const Work w = work(at.item);
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

  PD_DEVICE const T* weights_of(unsigned block) const {
    return call_.memory.weights + std::size_t(block) * (2 * pair_lanes);
  }

  // A lane a pair, of a block of stop `n`, or of its first one where it has none of that number.
  PD_DEVICE PairInputs read(unsigned n, int block) const {
    const DevicePlan<T>& plan = call_.step.plan;
    const volatile Stop& in = told(n);
    if (block >= in.blocks) block = 0;
    const unsigned lane = threadIdx.x % warp_size, at = unsigned(in.first_block + block);
    const int32* corner = plan.pair_corner + (at * (5 * pair_lanes) + lane);
    const T* factor = plan.pair_factor + (at * (2 * pair_lanes) + lane);
    const T* weight = weights_of(in.weights + unsigned(block)) + lane;
    PairInputs pair;
    for (int c = 0; c < 5; ++c) pair.corner[c] = unsigned(corner[c * pair_lanes]);
    for (int e = 0; e < 2; ++e) pair.weight[e] = weight[e * pair_lanes];
    for (int e = 0; e < 2; ++e) pair.factor[e] = factor[e * pair_lanes];
    return pair;
  }

  PD_DEVICE void work_on_elements() const {
    const auto blocks_of = [&](unsigned n) { return told(n).blocks; };
    PairInputs now = read(0, element_warp());
#pragma unroll 1
    for (unsigned n = 0;; ++n) {
      meet<slots_ready>(n);
      T energy = T(0);
      // else the last block has read the first one of the next stop
      if (element_warp() >= blocks_of(n)) now = read(n + 1, element_warp());
#pragma unroll 1
      for (int block = element_warp(); block < blocks_of(n); block += element_warps) {
        PairInputs then;
        work_on_pair(now, n, energy, [&] {
          const bool last = block + element_warps >= blocks_of(n);
          then = read(last ? n + 1 : n, last ? element_warp() : block + element_warps);
        });
        // not before its end, since whoever moves a number waits for it
        for (int c = 0; c < 5; ++c) now.corner[c] = unsigned(in_register(int(then.corner[c])));
        for (int e = 0; e < 2; ++e) now.weight[e] = in_register(then.weight[e]);
        for (int e = 0; e < 2; ++e) now.factor[e] = in_register(then.factor[e]);
      }
      if constexpr (What == Visit::update_guarded) {
        const double sum = across_warp(double(energy), Add{});
        if (threadIdx.x % warp_size == 0) energies_of(n)[element_warp()] = sum;
      }
      arrive<slots_free>(n);
      arrive<forces_ready>(n);
      if (blocks_of(n + 1) == 0) return;
    }
  }

  // `read_next`: between its tetrahedra, where the fewest registers are in use. Lanes past the last pair leave no force, and
  // what they strain weighs nothing.
  template <class ReadNext>
  PD_DEVICE void work_on_pair(const PairInputs& now, unsigned n, T& energy,
                              const ReadNext& read_next) const {
    const typename ElementOf<What>::type element;
    const Slots<T> slots = slots_of(n);
    Quad<T>* const entries = entries_of(n);
    Pair<T, 1> pair;
    RestPoint<T> rest[5];
    const auto look = [&](int c) {
      const unsigned slot = now.corner[c] & 0xffff;
      const Quad<T> seen = slots.look(slot);
      pair.corner[0][c] = vec3(seen);
      rest[c] = RestPoint<T>::of(slots.second(slot, seen));
    };
    const auto leave = [&](int c) {
      if (now.entry(c) != no_entry) entries[now.entry(c)] = quad(pair.force[c]);
    };
    for (int c = 0; c < 4; ++c) look(c);
    element.template run<1>(PairElement<T, 1, OneOf<T, 0>>{
        pair, ComputedRest<T>::between({rest[0], rest[1], rest[2], rest[3]}, now.factor[0]),
        now.weight[0], energy});
    leave(3);
    read_next();
    look(4);
    element.template run<1>(PairElement<T, 1, OneOf<T, 1>>{
        pair, ComputedRest<T>::between({rest[0], rest[1], rest[2], rest[4]}, now.factor[1]),
        now.weight[1], energy});
    for (int c = 0; c < 3; ++c) leave(c);
    leave(4);
  }

  // ---- vertices

  PD_DEVICE int after(int item) const { return next(item + int(gridDim.x)); }

  PD_DEVICE void move_vertices() const {
    int item = next(int(blockIdx.x));
    // the entries of both halves are free
    arrive<slots_ready>(0);
    if (after(item) < items()) arrive<slots_ready>(1);
#pragma unroll 1
    for (unsigned n = 0; item < items(); ++n, item = after(item)) move_patch(item, n);
  }

  PD_DEVICE void move_patch(int item, unsigned n) const {
    const Work w = work(item);
    const Quad<T>* entries = entries_of(n);
    const volatile Stop& at = told(n);
    const int interior = at.interior, first_vertex = at.first_vertex;
    const int slots = at.slots, first_slot = at.first_slot;
    ThreadSums sums = no_sums<What>();
    const auto slot = [](int r) { return mover() + r * mover_threads; };
    const auto see_slot = [&](int s, Seen& seen) {
      if (s < interior) seen = see<What>(w, first_vertex + s);
    };
    const auto visit_slot = [&](int s, const Seen& seen, const Vec3<T>& force) {
      if (s < interior) {
        visit<What>(w, first_vertex + s, seen, force, k_, sums);
      } else if (s < slots) {
        w.shared_force[first_slot + s] = quad(force);
      }
    };
    int row[moved];
    Vec3<T> force[moved];
    Seen seen[2];
#pragma unroll
    for (int r = 0; r < moved; ++r)
      row[r] = slot(r) < slots ? w.plan.slot_row[first_slot + slot(r)] : 0;
    see_slot(slot(0), seen[0]);
    meet<forces_ready>(n);
    if (What == Visit::update_guarded && mover() < element_warps)
      sums.value[0] += energies_of(n)[mover()];
    // first what frees the half
#pragma unroll
    for (int r = 0; r < moved; ++r) force[r] = sum_entries(entries, row[r]);
#pragma unroll 1
    for (int s = slot(moved); s < slots; s += mover_threads) {
      Seen late{};
      see_slot(s, late);
      visit_slot(s, late, sum_entries(entries, w.plan.slot_row[first_slot + s]));
    }
    if (after(after(item)) < items()) arrive<slots_ready>(n);
#pragma unroll
    for (int r = 0; r < moved; ++r) {
      if (r + 1 < moved) see_slot(slot(r + 1), seen[(r + 1) % 2]);
      visit_slot(slot(r), seen[r % 2], force[r]);
    }
    if (wants_sums<What>(w)) write_mover_sums(sums, w.sum_row(item % w.plan.patches));
  }

  PD_DEVICE void write_mover_sums(const ThreadSums& sums, double* row) const {
    constexpr int warps = mover_threads / warp_size;
    __shared__ double warp_sum[sums_count][warps];
    for (int n = 0; n < sums_count; ++n) {
      const double sum = across_warp(sums.value[n], Add{});
      if (mover() % warp_size == 0) warp_sum[n][mover() / warp_size] = sum;
    }
    meet<movers_meet>(0);
    if (mover() < sums_count) {
      double sum = 0;
      for (int i = 0; i < warps; ++i) sum += warp_sum[mover()][i];
      row[mover()] = sum;
    }
  }

  const StreamCall<T>& call_;
  int k_;
  std::byte* shared_;
};

// Visit::update and Visit::update_guarded of stream_patches, without contacts.
template <Visit What, class T>
__global__ void __launch_bounds__(pipeline_threads, 1)
    stream_pipeline(const __grid_constant__ StreamCall<T> call, int k) {
  extern __shared__ __align__(16) std::byte shared[];
  Pipeline<T, What>(call, k, shared).run();
}

}  // namespace pd::inline PD_TARGET
