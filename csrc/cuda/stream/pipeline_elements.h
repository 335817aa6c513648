// Members of Pipeline that compute the elements of a patch, one pair of tetrahedra per thread.
#pragma once
#include "cuda/stream/pipeline.h"

namespace pd::inline PD_TARGET {

template <class T, Visit What>
struct Pipeline<T, What>::PairData : PairInputs<T> {
  T factor[2];  // pair_factor
};

// A warp's blocks of pairs in a scheduled patch, with the number of warps as stride. The next patch
// continues with the warp after the last one, so that all warps get equal work.
template <class T, Visit What>
struct Pipeline<T, What>::Share {
  unsigned block, end;  // none left if block >= end
  unsigned weights;     // of its scheduled patch
  T patch_weight;
};

// 32-bit shared addresses of a half's slots and entries, which stay in registers; with pointers,
// the compiler would recompute the addresses. A slot takes three instructions and an entry two,
// since pipeline_slots leaves bits 13 to 15 of a corner zero.
template <class T, Visit What>
class Pipeline<T, What>::SharedSlots {
 public:
  PD_DEVICE SharedSlots(const Pipeline& p, unsigned n) {
    const unsigned slots = unsigned(p.plan().most_slots), entries = p.plan().most_entries;
    first_ = in_register(shared_address(p.half(n)));
    second_ = in_register(first_ + 16 * slots);
    entry_ = in_register(first_ + unsigned(slots_bytes(sizeof(T), slots, 2)));
    third_ = in_register(entry_ + 8 * entries);
  }

  // `corner`: of PairInputs. The asm is volatile to keep its order, so no load moves before the
  // wait.
  PD_DEVICE void load(unsigned corner, Vec3<T>& position, RestPoint<T>& rest) const {
    const SharedAddress slot_times_8 = in_register(corner & 0xffff);
    Quad<T> loaded;
    Vec3<T> bits;
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
                 : "=f"(loaded.x), "=f"(loaded.y), "=f"(loaded.z), "=f"(bits.x)
                 : "r"(first_ + 2 * slot_times_8));
    asm volatile("ld.shared.v2.f32 {%0, %1}, [%2];"
                 : "=f"(bits.y), "=f"(bits.z)
                 : "r"(second_ + slot_times_8));
    position = vec3(loaded);
    rest = RestPoint<T>::of(bits);
  }
  // Writes nothing if the corner has no entry.
  PD_DEVICE void write_entry(unsigned corner, const Vec3<T>& force) const {
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

template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::process_elements() const {
  Share share = share_of(0);
  PairData now;
  finish_load(now, read(share), share.patch_weight);
#pragma unroll 1
  for (unsigned n = 0;; ++n) {
    prefetch_pairs(n + 1);
    wait(slots_ready, n);
    const SharedSlots slots(*this, n);
    T energy = T(0);
    const T unit = scheduled(n).unit;
    bool more = share.block < share.end;
    // otherwise the last round has already loaded the first pairs of the next patch
    if (!more) {
      share = share_of(n + 1);
      finish_load(now, read(share), share.patch_weight);
    }
#pragma unroll 1
    while (more) {
      PairData then;
      process_pair(now, slots, unit, energy, [&] {
        share.block += element_warps;
        more = share.block < share.end;
        if (!more) share = share_of(n + 1);
        then = read(share);
      });
      finish_load(now, then, share.patch_weight);
    }
    if constexpr (What == Visit::update_guarded) {
      const double sum = warp_reduce(double(energy), Add{});
      if (threadIdx.x % warp_size == 0) energies_of(n)[element_warp()] = sum;
    }
    arrive(forces_ready, n);
    if (scheduled(n + 1).blocks == 0) return;
  }
}

template <class T, Visit What>
PD_DEVICE typename Pipeline<T, What>::Share Pipeline<T, What>::share_of(unsigned n) const {
  const ScheduledPatch& in = scheduled(n);
  unsigned turn = unsigned(element_warp() + element_warps - in.first_warp);
  if (turn >= unsigned(element_warps)) turn -= element_warps;
  const auto first = unsigned(in.first_block);
  const bool none = turn >= unsigned(in.blocks);
  return {none ? first : first + turn, none ? first : first + unsigned(in.blocks), in.weights,
          in.patch_weight};
}

// Loads one pair per lane of the next block. If no block is left, it loads valid data that is
// unused.
template <class T, Visit What>
PD_DEVICE typename Pipeline<T, What>::PairData Pipeline<T, What>::read(const Share& share) const {
  const unsigned lane = threadIdx.x % warp_size, block = share.block;
  const int32* corner = plan().pair_corner + (block * (5 * pair_lanes) + lane);
  const T* factor = plan().pair_factor + (block * (2 * pair_lanes) + lane);
  PairData pair;
  // streaming loads, since each pair is read once per pass
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
template <class T, Visit What>
PD_DEVICE const T* Pipeline<T, What>::weights_of(unsigned block, unsigned weights) const {
  return call_.memory.weights + std::size_t(block + weights) * (2 * pair_lanes);
}

// Uses the loaded data only at the end of a round, since moving a register waits for its load.
// `patch_weight`: of the scheduled patch.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::finish_load(PairData& now, const PairData& read, T patch_weight) {
  for (int c = 0; c < 5; ++c) now.corner[c] = in_register(read.corner[c]);
  for (int e = 0; e < 2; ++e) now.factor[e] = in_register(read.factor[e]);
  for (int e = 0; e < 2; ++e) {
    const T found = tet_weight(patch_weight, now.factor[e]);
    const bool there = now.corner[3 + e] < unsigned(no_entry) << 16;
    now.weight[e] = in_register(patch_weight < T(0) ? read.weight[e] : there ? found : T(0));
  }
}

// Prefetches all pairs of a scheduled patch into the L2 cache.
template <class T, Visit What>
PD_DEVICE void Pipeline<T, What>::prefetch_pairs(unsigned n) const {
  const ScheduledPatch in = scheduled(n);
  const auto prefetch = [](const auto* items, int count) {
    bulk_prefetch_to_l2(items, count, int(threadIdx.x) - updater_threads - loader_threads,
                        element_threads);
  };
  constexpr int two = 2 * pair_lanes, five = 5 * pair_lanes;
  prefetch(plan().pair_corner + std::size_t(in.first_block) * five, in.blocks * five);
  prefetch(plan().pair_factor + std::size_t(in.first_block) * two, in.blocks * two);
  if (in.patch_weight < T(0))
    prefetch(weights_of(unsigned(in.first_block), in.weights), in.blocks * two);
}

// Calls `read_next` between the two tetrahedra. Lanes past the last pair write no force and have
// weight zero.
template <class T, Visit What>
template <class ReadNext>
PD_DEVICE void Pipeline<T, What>::process_pair(const PairData& now, const SharedSlots& slots,
                                               T unit, T& energy, const ReadNext& read_next) const {
  const auto load = [&](int c, Vec3<T>& position, RestPoint<T>& rest) {
    slots.load(now.corner[c], position, rest);
  };
  const auto write_entry = [&](int c, const Vec3<T>& force) {
    slots.write_entry(now.corner[c], force);
  };
  solid_pair_gradient<What == Visit::update_guarded, RestPoint<T>>(
      now.factor, now.weight, unit, energy, load, write_entry, read_next);
}

}  // namespace pd::inline PD_TARGET
