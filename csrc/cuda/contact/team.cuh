// The team of solver/contact on a GPU: some blocks, or one, that work on an environment.
#pragma once
#include "cuda/common/block_team.h"
#include "solver/contact/environment.h"

namespace pd::inline PD_TARGET {

constexpr int contact_threads = 128;
constexpr int contact_chunk = 1024;  // items of a sum that one block adds up
constexpr int most_contact_sums = 36;

// Lanes of solver/contact/clusters.h: those of a warp.
struct WarpLanes {
  PD_DEVICE int lane() const { return int(threadIdx.x) % warp_size; }
  template <class Test>
  PD_DEVICE unsigned which(const Test& test) const {
    return __ballot_sync(full_warp, test(lane()));
  }
  template <class T, class BoxAt>
  PD_DEVICE Box<T> unite(const BoxAt& box_at) const {
    Box<T> whole = box_at(lane());
#pragma unroll
    for (int distance = warp_size / 2; distance > 0; distance /= 2) {
      const auto other = [&](T number) { return __shfl_xor_sync(full_warp, number, distance); };
      whole.add(Box<T>{{other(whole.low.x), other(whole.low.y), other(whole.low.z)},
                       {other(whole.high.x), other(whole.high.y), other(whole.high.z)}});
    }
    return whole;
  }
  PD_DEVICE bool leads() const { return lane() == 0; }
};

// A thread's item.
template <class T>
struct SingleLane {
  using Number = T;
  int item;

  PD_DEVICE int begin() const { return item; }
  PD_DEVICE static T load(const T* from) { return *from; }
  PD_DEVICE static void store(T* to, T value) { *to = value; }
  template <class Get>
  PD_DEVICE Vec3<T> vector(const Get& get) const {
    const auto of = get(item);
    return {of.x, of.y, of.z};
  }
  template <class Visit>
  PD_DEVICE void each(const Visit& visit) const {
    visit(item);
  }
  PD_DEVICE static bool all(bool holds) { return holds; }
};

// What a warp keeps in shared memory: sides of a cluster that meet the hull of another one.
template <class T>
struct WalkBench {
  Four<T> low[warp_size], high[warp_size];
  int corner[3][warp_size], number[warp_size];
  SidePair queue[2 * warp_size];
};
template <class T>
constexpr std::size_t bench_bytes = sizeof(WalkBench<T>) * (contact_threads / warp_size);

// The dynamic shared memory of a task.
PD_DEVICE std::byte* contact_shared() {
  extern __shared__ __align__(16) std::byte shared[];
  return shared;
}

// Sums do not depend on the number of blocks: every chunk is added up by one, and all add up the chunks alike.
class ContactTeam {
 public:
  static constexpr bool in_order = false;

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
  template <class Visit>
  PD_DEVICE void warps(int count, const Visit& visit) const {
#pragma unroll 1
    for (int n = team_.warp(); n < count; n += team_.warps()) visit(n, WarpLanes());
  }
  template <class T, class Visit>
  PD_DEVICE void blocks(int count, const Visit& visit) const {
    each(count, [&](int n) { visit(SingleLane<T>{n}); });
  }
  template <class T, class PairAt, class Visit>
  PD_DEVICE void each_closest(int count, const PairAt& pair_at, const Vec3<T>* places,
                              const Visit& visit) const {
    each(count, [&](int n) { visit(n, closest_of(pair_at(n), places)); });
  }

  // A warp takes a cluster and tests the boxes of another one, each lane its own box against all.
  // What meets waits in a queue, until there is something to visit for every lane.
  template <class T, class Sides, class Visit>
  PD_DEVICE void walk(const ClusterBoxes<T>& boxes, const Sides& sides, const Visit& visit) const {
    const WarpLanes lanes;
    const int lane = lanes.lane();
    Bench<T>& bench = bench_of_warp<T>();
    ClusterPairs<T> pairs(team_.warp(), team_.warps());
    int queued = 0, number = 0;
    unsigned meets = 0;
    bool more = true;
    while (true) {
      while (queued < warp_size && more) {
        if (__any_sync(full_warp, meets != 0)) {
          const bool found = meets != 0;
          const unsigned all = __ballot_sync(full_warp, found);
          if (found)
            bench.queue[queued + __popc(all & ((1u << lane) - 1))] =
                sides(pairs.own, number, bench.number[take_lowest(meets)]);
          queued += __popc(all);
          continue;
        }
        more = pairs.next(lanes, boxes);
        if (!more) break;
        number = boxes.leaf(pairs.own)[lane];
        meets = meeting(lanes, boxes, pairs, bench);
      }
      if (queued == 0) break;
      __syncwarp();
      const int now = min(queued, warp_size);
      if (lane < now) visit(Found{bench.queue[lane]});
      queued -= now;
      __syncwarp();
      if (lane < queued) bench.queue[lane] = bench.queue[warp_size + lane];
      __syncwarp();
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
    barrier();  // before another sum overwrites the parts
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
    add_range(begin, end, [&](int i) { add(i, sums); });
    block_sum(sums);
  }
  template <class Add>
  PD_DEVICE void add_range(int begin, int end, const Add& add) const {
#pragma unroll 1
    for (int i = begin + int(threadIdx.x); i < end; i += contact_threads) add(i);
  }
  template <int Count>
  PD_DEVICE void add_up(double (&sums)[Count]) const {
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
  template <class Task>
  PD_DEVICE void lead(const Task& task) const {
    if (leads()) task();
    __syncthreads();
  }
  template <class Item>
  PD_DEVICE void spread_of_group(int count, const Item& item) const {
#pragma unroll 1
    for (int i = int(threadIdx.x); i < count; i += contact_threads) item(i);
  }
  template <class Item>
  PD_DEVICE void each_of_group(int count, const Item& item) const {
    spread_of_group(count, item);
    __syncthreads();
  }
  template <class Item>
  PD_DEVICE void each_below(int begin, int end, const Item& item) const {
    const int side = end - begin;
    each_of_group(side * side, [&](int at) {
      const int row = at % side, column = at / side;
      if (row >= column) item(begin + row, begin + column);
    });
  }

 private:
  // What a lane found.
  struct Found {
    SidePair side;

    template <class Visit>
    PD_DEVICE void each(const Visit& visit) const {
      visit(side.owner, side.other);
    }
    template <class T, class SidesOf, class Visit>
    PD_DEVICE void each_closest(const SidesOf& sides_of, const Vec3<T>* places,
                                const Visit& visit) const {
      visit(side.owner, side.other, closest_of(sides_of(side.owner, side.other), places));
    }
  };
  template <class Pair, class T>
  PD_DEVICE static Closest<T> closest_of(const Pair& pair, const Vec3<T>* places) {
    Vec3<T> corner[4];
    pair.corners(places, corner);
    return closest_points(pair.edges, corner);
  }

  template <class T>
  using Bench = WalkBench<T>;
  // One for all walks of a kernel.
  template <class T>
  PD_DEVICE static Bench<T>& bench_of_warp() {
    return reinterpret_cast<Bench<T>*>(contact_shared())[threadIdx.x / warp_size];
  }

  // Bits of the sides on the bench whose boxes meet that of the lane, and that share no vertex.
  template <class T>
  PD_DEVICE static unsigned meeting(const WarpLanes& lanes, const ClusterBoxes<T>& boxes,
                                    const ClusterPairs<T>& pairs, Bench<T>& bench) {
    const int lane = lanes.lane();
    const int *own_leaf = boxes.leaf(pairs.own), *leaf = boxes.leaf(pairs.other);
    const Box<T> box = boxes.box[pairs.other].box(lane), own = boxes.box[pairs.own].box(lane);
    const bool touches = box.meets(pairs.hull);
    const unsigned all = __ballot_sync(full_warp, touches);
    const int count = __popc(all);
    __syncwarp();
    if (touches) {
      const int at = __popc(all & ((1u << lane) - 1));
      bench.low[at] = {box.low.x, box.low.y, box.low.z, T(0)};
      bench.high[at] = {box.high.x, box.high.y, box.high.z, T(0)};
      for (int c = 0; c < 3; ++c) bench.corner[c][at] = leaf[warp_size * (c + 1) + lane];
      bench.number[at] = leaf[lane];
    }
    __syncwarp();
    const bool point = boxes.has_points(pairs.own);
    unsigned meets = 0;
#pragma unroll 2
    for (int n = 0; n < count; ++n) {
      const Four<T> low = bench.low[n], high = bench.high[n];
      const bool is = own.meets({{low.x, low.y, low.z}, {high.x, high.y, high.z}}) &
                      boxes.share_none(point, own_leaf, lane, &bench.corner[0][0] - warp_size, n);
      meets |= unsigned(is) << n;
    }
    // of a cluster with itself each two once
    if (pairs.own == pairs.other) {
      const int before = __popc(all & ((2u << lane) - 1));  // no later than the lane's own
      meets = before < warp_size ? meets & (~0u << before) : 0;
    }
    return meets;
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
    double (&of_warp)[warps][most_contact_sums] = sums_of_warps();
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

  // One for all sums of a kernel: a function of a template would have one for each kind.
  PD_DEVICE static auto sums_of_warps()
      -> double (&)[contact_threads / warp_size][most_contact_sums] {
    __shared__ double sums[contact_threads / warp_size][most_contact_sums];
    return sums;
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
