// Halo exchange of a cluster. Every vertex has one owner, which stores its new position in the
// shared memory of all patches whose tetrahedra touch it. Elements read the position there, so one
// exchange per iteration suffices and no forces are exchanged.
#pragma once
#include "cuda/common/cluster.h"
#include "cuda/common/reductions.h"
#include "cuda/elements/pairs_per_thread.h"

namespace pd::inline PD_TARGET {

// The positions of slots, as elements read them.
template <class T>
struct SlotPositions {
  const Quad<T>* first;

  // takes slots as pair_corner encodes them
  PD_DEVICE Quad<T> load(unsigned slot_times_8) const {
    const auto* bytes = reinterpret_cast<const std::byte*>(first);
    return *reinterpret_cast<const Quad<T>*>(bytes + slot_times_8 * (unsigned(sizeof(*first)) / 8));
  }
};

// Several lanes of a warp share an own vertex: with four vertices per warp, they are lane, lane +
// 4, lane + 8, ... Each sums some of the forces and sends to some of the patches; all hold the same
// vertex and apply the same update. Layout in shared memory (halo_bytes): two barriers, positions
// [2, slots].
template <class T, int Lanes>
class Halo {
  static constexpr int vertices = warp_size / Lanes;               // per warp
  static constexpr int most_places = most_cluster_blocks / Lanes;  // targets per lane

 public:
  PD_DEVICE Halo(std::byte* shared, int slots)
      : barrier_(reinterpret_cast<std::uint64_t*>(shared)),
        position_(reinterpret_cast<Quad<T>*>(shared + barriers_bytes)),
        slots_(slots) {}

  // The own vertex of this lane, that of its warp's first lane, and the lane's rank among those of
  // its vertex.
  PD_DEVICE static int vertex() { return first_vertex() + int(threadIdx.x) % vertices; }
  PD_DEVICE static int first_vertex() { return int(threadIdx.x) / warp_size * vertices; }
  PD_DEVICE static int part() { return int(threadIdx.x) % warp_size / vertices; }

  // Called by all threads, before a cluster barrier.
  PD_DEVICE void init(const Patch<T>& patch) {
    if (vertex() < patch.interior) {
      const int32* copies =
          patch.plan.slot_copy + (patch.first_vertex + vertex()) * int(most_cluster_blocks);
      for (int j = 0; j < most_places; ++j) {
        // the owner's own slot comes first; valid targets come before missing ones
        const int n = j * Lanes + part();
        const int place = n == 0 ? patch.index << 16 | vertex() : copies[max(n - 1, 0)];
        place_[j] = max(place, 0);
        places_ += place >= 0;
      }
    }
    most_ = __reduce_max_sync(full_warp, places_);
    expected_ = patch.slots * int(sizeof(Quad<T>));
    if (threadIdx.x == 0) {
      for (int round = 0; round < 2; ++round) barrier(round).init();
    }
  }

  PD_DEVICE SlotPositions<T> positions(unsigned round) const { return {place(round)}; }

  // Called by whole warps with own vertices, once per round (from 1), after the wait for the
  // previous round.
  PD_DEVICE void send(const Vec3<T>& position, unsigned round) const {
    const Quad<T> payload = quad(position);
    const Quad<T>* const row = place(round);
    const SharedAddress barrier_address = barrier(round).address();
    if (threadIdx.x == 0) barrier(round).expect(expected_);
#pragma unroll
    for (int j = 0; j < most_places; ++j) {
      if (j > 0 && j >= most_) break;
      const int patch = place_[j] >> 16, slot = place_[j] & 0xffff;
      pd::send(at_block(shared_address(row + slot), patch), at_block(barrier_address, patch),
               payload, j < places_);
    }
    __syncwarp();
  }

  // Waits until the positions of all slots have arrived.
  PD_DEVICE void wait(unsigned round) const { barrier(round).wait((round - 1) >> 1 & 1); }

  // Called by whole warps: the force on this lane's vertex. Its lanes take the entries in turn,
  // four loads at a time.
  PD_DEVICE static Vec3<T> sum_entries(const Quad<T>* entries, int row) {
    constexpr int in_flight = 4, step = Lanes * entry_stride;
    const int count = row >> 16 & 0x7fff;
    const Quad<T>* entry = entries + (unsigned(row) & 0xffff) + part() * entry_stride;
    Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 1
    for (int j = part(); j < count; j += in_flight * Lanes, entry += in_flight * step) {
      Vec3<T> force[in_flight];
#pragma unroll
      for (int i = 0; i < in_flight; ++i) {
        force[i] = {T(0), T(0), T(0)};
        if (j + i * Lanes < count) force[i] = vec3(entry[i * step]);
      }
#pragma unroll
      for (int i = 0; i < in_flight; ++i) sum = sum + force[i];
    }
    __syncwarp();
#pragma unroll
    for (int distance = vertices; distance < warp_size; distance *= 2) {
      sum = sum + Vec3<T>{__shfl_xor_sync(full_warp, sum.x, distance),
                          __shfl_xor_sync(full_warp, sum.y, distance),
                          __shfl_xor_sync(full_warp, sum.z, distance)};
    }
    return sum;
  }

 private:
  static constexpr int barriers_bytes = 16;

  PD_DEVICE ByteBarrier barrier(unsigned round) const {
    return ByteBarrier(barrier_ + (round & 1));
  }
  PD_DEVICE Quad<T>* place(unsigned round) const { return position_ + (round & 1) * slots_; }

  std::uint64_t* barrier_;
  Quad<T>* position_;
  int slots_;
  int place_[most_places] = {};  // targets of the vertex, see slot_copy
  int places_ = 0, most_ = 0;    // number of targets, and its maximum over the warp
  int expected_ = 0;             // bytes per round
};

}  // namespace pd::inline PD_TARGET
