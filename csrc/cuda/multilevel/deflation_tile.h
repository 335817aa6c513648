// Tetrahedra in a block's shared memory for the strain products of solver/multilevel/deflation.h, and warp
// sums of 36 values.
#pragma once
#include "cuda/common/memory.h"
#include "cuda/common/reductions.h"
#include "cuda/elements/group_lanes.h"
#include "solver/multilevel/deflation.h"
#include "views/shared_memory.h"

namespace pd::inline PD_TARGET {

// Sums 36 values over a warp; on return each lane holds one or two of the sums in front.
template <class T>
PD_DEVICE void spread_sums(T (&value)[36]) {
  const int lane = int(threadIdx.x) % warp_size;
  int size = 36;
#pragma unroll
  for (int distance = warp_size / 2; distance > 0; distance /= 2) {
    const bool upper = lane & distance;
    const int half = (size + 1) / 2;
#pragma unroll
    for (int n = 0; n < half; ++n) {
      const T other = half + n < size ? value[min(half + n, 35)] : T(0);
      const T keep = select(upper, other, value[n]), give = select(upper, value[n], other);
      value[n] = keep + __shfl_xor_sync(full_warp, give, distance);
    }
    size = half;
  }
}
// Indices of a lane's sums.
struct KeptSums {
  int first = 0, count = 36;

  PD_DEVICE explicit KeptSums(int lane) {
    int size = count;
    for (int distance = warp_size / 2; distance > 0; distance /= 2) {
      const int half = (size + 1) / 2;
      const bool upper = lane & distance;
      if (upper) first += half;
      count = upper ? max(count - half, 0) : min(count, half);
      size = half;
    }
  }
};

// Data of a tetrahedron for strain products: g and p of each group, w V, and V lambda with Poisson's ratio. Neighbouring
// tetrahedra are adjacent in memory.
template <class T>
class TurningTile {
  static constexpr int of_group = 12, of_groups = turning_groups * of_group;
  static constexpr int numbers = of_groups + (has_poisson_ratio ? 2 : 1);
  static_assert(of_groups + 1 == turning_tile_numbers);

 public:
  PD_DEVICE TurningTile(std::byte* shared, std::size_t bytes)
      : memory_(reinterpret_cast<T*>(shared)),
        size_(min(int(bytes / (numbers * sizeof(T))), int(blockDim.x)) / warp_size * warp_size) {}

  PD_DEVICE int size() const { return size_; }

  PD_DEVICE void set(int e, int group, const TurningGradient<T>& of) const {
    const T number[of_group] = {of.g.x,        of.g.y,        of.g.z,        of.p.row[0].x,
                                of.p.row[0].y, of.p.row[0].z, of.p.row[1].x, of.p.row[1].y,
                                of.p.row[1].z, of.p.row[2].x, of.p.row[2].y, of.p.row[2].z};
    for (int n = 0; n < of_group; ++n) at(e, group, n) = number[n];
  }
  PD_DEVICE TurningStrain<T> strain(int e, int group) const {
    const auto row = [&](int n) {
      return Vec3<T>{at(e, group, n), at(e, group, n + 1), at(e, group, n + 2)};
    };
    return TurningStrain<T>(TurningGradient<T>(row(0), {{row(3), row(6), row(9)}}));
  }
  PD_DEVICE T& weight(int e) const { return memory_[of_groups * size_ + e]; }
  PD_DEVICE T& pressure(int e) const { return memory_[(of_groups + 1) * size_ + e]; }

 private:
  PD_DEVICE T& at(int e, int group, int n) const {
    return memory_[(group * of_group + n) * size_ + e];
  }

  T* memory_;
  int size_;
};

}  // namespace pd::inline PD_TARGET
