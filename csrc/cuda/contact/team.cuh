// The team of solver/contact on a GPU: some blocks, or one, that work on an environment.
#pragma once
#include "cuda/common/block_team.h"

namespace pd::inline PD_TARGET {

constexpr int contact_threads = 128;
constexpr int contact_chunk = 1024;  // items of a sum that one block adds up
constexpr int most_contact_sums = 36;

// Sums do not depend on the number of blocks: every chunk is added up by one, and all add up the chunks alike.
class ContactTeam {
 public:
  // `partial`: [chunks, 2], `counts`: [chunks]
  PD_DEVICE ContactTeam(BlockTeam& team, double* partial, int* counts)
      : team_(team), partial_(partial), counts_(counts) {}

  template <class Item>
  PD_DEVICE void spread(std::int64_t count, const Item& item) const {
#pragma unroll 1
    for (std::int64_t i = team_.thread(); i < count; i += team_.threads()) item(int(i));
  }
  template <class Item>
  PD_DEVICE void each(std::int64_t count, const Item& item) const {
    spread(count, item);
    barrier();
  }
  // The lanes of a warp step through the tree together. What they find waits in a queue, until
  // there is something to visit for every lane.
  template <class Start, class Visit>
  PD_DEVICE void walk(std::int64_t count, const Start& start, const Visit& visit) const {
    const int lane = int(threadIdx.x) % warp_size;
    int2* const queue = queue_of_warp();
    std::int64_t base = team_.thread() - lane;
    int queued = 0;
    while (base < count || queued > 0) {
      auto walk = start(int(min(base + lane, count - 1)));
      bool walks = base + lane < count && !walk.ended;
      base += team_.threads();
      const bool last = base >= count;
#pragma unroll 1
      while (true) {
        const int other = walks ? walk.step() : -1;
        walks = walks && !walk.ended;
        const unsigned found = __ballot_sync(full_warp, other >= 0);
        if (other >= 0)
          queue[queued + __popc(found & ((1u << lane) - 1))] = make_int2(walk.owner, other);
        queued += __popc(found);
        const bool active = __any_sync(full_warp, walks);
        if (queued >= warp_size || (last && !active && queued > 0)) {
          __syncwarp();
          const int now = min(queued, warp_size);
          if (lane < now) visit(queue[lane].x, queue[lane].y);
          queued -= now;
          __syncwarp();
          if (lane < queued) queue[lane] = queue[warp_size + lane];
          __syncwarp();
        }
        if (!active && (queued == 0 || !last)) break;
      }
    }
    barrier();
  }
  template <class Task>
  PD_DEVICE void once(const Task& task) const {
    if (team_.thread() == 0) task();
    barrier();
  }
  PD_DEVICE void barrier() const { team_.barrier(); }

  template <int Count, class Add>
  PD_DEVICE void sum(std::int64_t count, const Add& add, double (&sums)[Count]) const {
    static_assert(Count <= 2);
    const int chunks = int((count + contact_chunk - 1) / contact_chunk);
#pragma unroll 1
    for (int chunk = team_.rank(); chunk < chunks; chunk += team_.blocks()) {
      const std::int64_t begin = std::int64_t(chunk) * contact_chunk,
                         end = min(begin + contact_chunk, count);
      double own[Count] = {};
#pragma unroll 1
      for (std::int64_t i = begin + threadIdx.x; i < end; i += contact_threads) add(int(i), own);
      block_sum(own);
      if (threadIdx.x == 0) {
        for (int n = 0; n < Count; ++n) partial_[2 * chunk + n] = own[n];
      }
    }
    barrier();
    double all[Count] = {};
    for (int chunk = threadIdx.x; chunk < chunks; chunk += contact_threads) {
      for (int n = 0; n < Count; ++n) all[n] += partial_[2 * chunk + n];
    }
    block_sum(all);
    for (int n = 0; n < Count; ++n) sums[n] += all[n];
  }

  PD_DEVICE void scan(int* numbers, std::int64_t count) const {
    constexpr int each = contact_chunk / contact_threads;
    const int chunks = int((count + contact_chunk - 1) / contact_chunk);
    const int thread = int(threadIdx.x);
    const auto add_up = [&](std::int64_t first, int (&own)[each]) {
      int sum = 0;
      for (int n = 0; n < each; ++n) {
        own[n] = first + n < count ? numbers[first + n] : 0;
        sum += own[n];
      }
      return sum;
    };
    int own[each];
#pragma unroll 1
    for (int chunk = team_.rank(); chunk < chunks; chunk += team_.blocks()) {
      int total;
      block_scan(add_up(std::int64_t(chunk) * contact_chunk + thread * each, own), total);
      if (thread == 0) counts_[chunk] = total;
    }
    barrier();
#pragma unroll 1
    for (int chunk = team_.rank(); chunk < chunks; chunk += team_.blocks()) {
      int before = 0, base, total;
      for (int n = thread; n < chunk; n += contact_threads) before += counts_[n];
      block_scan(before, base);
      const std::int64_t first = std::int64_t(chunk) * contact_chunk + thread * each;
      int at = base + block_scan(add_up(first, own), total);
      for (int n = 0; n < each; ++n) {
        if (first + n < count) numbers[first + n] = at;
        at += own[n];
      }
      if (chunk + 1 == chunks && thread == 0) numbers[count] = base + total;
    }
    if (chunks == 0 && team_.thread() == 0) numbers[0] = 0;
    barrier();
  }

  template <class Visit>
  PD_DEVICE void groups(int count, const Visit& visit) const {
#pragma unroll 1
    for (int n = team_.rank(); n < count; n += team_.blocks()) visit(n, *this);
    barrier();
  }
  template <int Count, class Add>
  PD_DEVICE void sum_range(int begin, int end, const Add& add, double (&sums)[Count]) const {
#pragma unroll 1
    for (int i = begin + int(threadIdx.x); i < end; i += contact_threads) add(i, sums);
    block_sum(sums);
  }
  template <int Count, class Take>
  PD_DEVICE void least_range(int begin, int end, const Take& take, double (&least)[Count]) const {
#pragma unroll 1
    for (int i = begin + int(threadIdx.x); i < end; i += contact_threads) take(i, least);
    block_reduce(least, Min{});
  }
  template <class Is>
  PD_DEVICE void select(int count, const Is& is, int* out) const {
    int before = 0;
#pragma unroll 1
    for (int begin = 0; begin < count; begin += contact_threads) {
      const int i = begin + int(threadIdx.x);
      const bool own = i < count && is(i);
      int total;
      const int at = before + block_scan(own, total);
      if (own) out[at] = i;
      before += total;
    }
    __syncthreads();
  }
  PD_DEVICE bool leads() const { return threadIdx.x == 0; }

 private:
  // One for all walks of a kernel.
  PD_DEVICE static int2* queue_of_warp() {
    __shared__ int2 queues[contact_threads / warp_size][2 * warp_size];
    return queues[threadIdx.x / warp_size];
  }

  template <int Count>
  PD_DEVICE static void block_sum(double (&value)[Count]) {
    block_reduce(value, Add{});
  }

  // All threads get the same bits.
  template <int Count, class Op>
  PD_DEVICE static void block_reduce(double (&value)[Count], Op op) {
    static_assert(Count <= most_contact_sums);
    constexpr int warps = contact_threads / warp_size;
    __shared__ double of_warp[warps][most_contact_sums];
    for (int n = 0; n < Count; ++n) value[n] = warp_reduce(value[n], op);
    if (threadIdx.x % warp_size == 0) {
      for (int n = 0; n < Count; ++n) of_warp[threadIdx.x / warp_size][n] = value[n];
    }
    __syncthreads();
    for (int n = 0; n < Count; ++n) {
      value[n] = of_warp[0][n];
      for (int warp = 1; warp < warps; ++warp) value[n] = op(value[n], of_warp[warp][n]);
    }
    __syncthreads();
  }

  // The sum over earlier threads of the block; `total`: over all.
  PD_DEVICE static int block_scan(int value, int& total) {
    constexpr int warps = contact_threads / warp_size;
    __shared__ int of_warp[warps];
    const int lane = int(threadIdx.x) % warp_size, warp = int(threadIdx.x) / warp_size;
    int sum = value;
    for (int distance = 1; distance < warp_size; distance *= 2) {
      const int other = __shfl_up_sync(full_warp, sum, distance);
      if (lane >= distance) sum += other;
    }
    if (lane == warp_size - 1) of_warp[warp] = sum;
    __syncthreads();
    int before = 0;
    total = 0;
    for (int n = 0; n < warps; ++n) {
      before += n < warp ? of_warp[n] : 0;
      total += of_warp[n];
    }
    __syncthreads();
    return before + sum - value;
  }

  BlockTeam& team_;
  double* partial_;
  int* counts_;
};

}  // namespace pd::inline PD_TARGET
