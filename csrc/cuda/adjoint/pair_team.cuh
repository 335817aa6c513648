// The team of solver/adjoint's pairs on a GPU: the blocks that work on an environment.
#pragma once
#include "cuda/common/block_team.h"
#include "solver/adjoint/one_thread.h"

namespace pd::inline PD_TARGET {

// Members are those of OneThread. A sum is that of one warp, so the bits do not depend on the number of blocks.
class PairTeam {
 public:
  PD_DEVICE explicit PairTeam(BlockTeam& team) : team_(team) {}

  template <class Item>
  PD_DEVICE void each(std::int64_t count, const Item& item) const {
#pragma unroll 1
    for (std::int64_t i = team_.thread(); i < count; i += team_.threads()) item(int(i));
    team_.barrier();
  }
  template <class Item>
  PD_DEVICE void strips(int count, const Item& item) const {
    each(count, [&](int i) { item(i, std::integral_constant<int, 1>()); });
  }
  template <class Item>
  PD_DEVICE void grid(int rows, int columns, const Item& item) const {
    each(std::int64_t(rows) * columns, [&](int n) { item(n / columns, n % columns); });
  }
  template <class Of, class Take>
  PD_DEVICE void dots(std::int64_t count, const Of& of, const Take& take) const {
    each_warp(count, [&](int n, int lane) {
      const DotProduct product = of(n);
      double sum = 0;
      for (int p = lane; p < product.length; p += warp_size) sum += product.a[p] * product.b[p];
      sum = warp_reduce(sum, Add());
      if (lane == 0) take(n, sum);
    });
  }
  template <class Term, class Take>
  PD_DEVICE void sums(std::int64_t count, int length, const Term& term, const Take& take) const {
    each_warp(count, [&](int n, int lane) {
      double sum = 0;
      for (int p = lane; p < length; p += warp_size) sum += term(n, p);
      sum = warp_reduce(sum, Add());
      if (lane == 0) take(n, sum);
    });
  }
  // Every block looks at all.
  template <class Value>
  PD_DEVICE Largest largest(int count, double least, const Value& value) const {
    __shared__ Largest of_warp[warp_size];
    Largest found{least, -1};
#pragma unroll 1
    for (int i = int(threadIdx.x); i < count; i += int(blockDim.x)) {
      const double own = value(i);
      if (own > found.value) found = {own, i};
    }
    for (int distance = warp_size / 2; distance > 0; distance /= 2) {
      found = larger(found, {__shfl_xor_sync(full_warp, found.value, distance),
                             __shfl_xor_sync(full_warp, found.index, distance)});
    }
    if (threadIdx.x % warp_size == 0) of_warp[threadIdx.x / warp_size] = found;
    __syncthreads();
    found = of_warp[0];
    for (int warp = 1; warp < int(blockDim.x) / warp_size; ++warp)
      found = larger(found, of_warp[warp]);
    team_.barrier();
    return found;
  }
  // by one warp
  PD_DEVICE void scan(int* numbers, std::int64_t count) const {
    if (team_.rank() == 0 && threadIdx.x < warp_size) {
      const int lane = int(threadIdx.x);
      int before = 0;
#pragma unroll 1
      for (std::int64_t first = 0; first < count; first += warp_size) {
        const int own = first + lane < count ? numbers[first + lane] : 0;
        int sum = own;
        for (int distance = 1; distance < warp_size; distance *= 2) {
          const int other = __shfl_up_sync(full_warp, sum, distance);
          if (lane >= distance) sum += other;
        }
        if (first + lane < count) numbers[first + lane] = before + sum - own;
        before += __shfl_sync(full_warp, sum, warp_size - 1);
      }
      if (lane == 0) numbers[count] = before;
    }
    team_.barrier();
  }
  template <class Task>
  PD_DEVICE void once(const Task& task) const {
    if (team_.thread() == 0) task();
    team_.barrier();
  }
  PD_DEVICE void barrier() const { team_.barrier(); }
  PD_DEVICE int add(int* to, int more) const { return atomicAdd(to, more); }

 private:
  template <class Visit>
  PD_DEVICE void each_warp(std::int64_t count, const Visit& visit) const {
    const int lane = int(threadIdx.x) % warp_size;
#pragma unroll 1
    for (std::int64_t n = team_.warp(); n < count; n += team_.warps()) visit(int(n), lane);
    team_.barrier();
  }
  // the earlier one of equals
  PD_DEVICE static Largest larger(const Largest& a, const Largest& b) {
    if (b.index < 0 || a.value > b.value) return a;
    if (a.index < 0 || b.value > a.value) return b;
    return b.index < a.index ? b : a;
  }

  BlockTeam& team_;
};

}  // namespace pd::inline PD_TARGET
