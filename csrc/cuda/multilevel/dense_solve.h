// Members of DeviceCycle that multiply by L^-1, by rows or by columns, and the last phase of a cycle.
#pragma once
#include "cuda/multilevel/v_cycle.h"

namespace pd::inline PD_TARGET {

// Numbers first ... end - 1 of a row or column.
template <class T>
struct DeviceCycle<T>::Segment {
  const T* number;
  int first, end;
};

// L^-1 by rows or by columns, with the vectors [n] of a product.
template <class T>
struct DeviceCycle<T>::TriangularFactor {
  const T* numbers;
  const Quad<T>* x;
  Quad<T>* out;
  int n;
  bool by_columns;

  PD_DEVICE Segment segment(int i) const {
    if (!by_columns) return {numbers + std::int64_t(i) * (i + 1) / 2, 0, i + 1};
    // offset so that the number of row i is at index i
    const std::int64_t diagonal = std::int64_t(i) * n - std::int64_t(i) * (i - 1) / 2;
    return {numbers + diagonal - i, i, n};
  }
};

// L^-T (L^-1 r), symmetric and positive in any precision: one warp per row, then one warp per
// column.
template <class T>
PD_DEVICE void DeviceCycle<T>::solve_rows() {
  const Quad<T>* in = levels_.direct ? m_.fine.right : m_.coarse_in;
  multiply_factor({levels_.coarse_factor, in, m_.coarse_half, levels_.coarse_unknowns(), false});
}

template <class T>
PD_DEVICE void DeviceCycle<T>::solve_columns() {
  multiply_factor(columns());
}

template <class T>
PD_DEVICE typename DeviceCycle<T>::TriangularFactor DeviceCycle<T>::columns() const {
  Quad<T>* out = levels_.direct ? m_.fine.z : m_.coarse_out;
  return {levels_.coarse_columns, m_.coarse_half, out, levels_.coarse_unknowns(), true};
}

template <class T>
PD_DEVICE void DeviceCycle<T>::multiply_factor(const TriangularFactor& a) {
  if (a.n <= team_.warps()) {
    if (team_.warp() < a.n) multiply_rows<1>(a, team_.warp());
  } else {
#pragma unroll 1
    for (int i = team_.warp() * 4; i < a.n; i += team_.warps() * 4) multiply_rows<4>(a, i);
  }
}

template <class T>
template <class Row>
PD_DEVICE void DeviceCycle<T>::run_last(int count, const Row& row) {
  if (levels_.direct) {
    constexpr int together = 4;
    const int warps = int(blockDim.x) / warp_size;
#pragma unroll 1
    for (int t = int(threadIdx.x) / warp_size * together; t < count; t += warps * together) {
      if (row(t) < levels_.vertices) multiply_rows<together>(columns(), row(t));
    }
    return;
  }
  constexpr int lanes = prolongation_lanes<1>;
  const int last = levels_.vertices - 1, lane = int(threadIdx.x) % lanes;
  const Level<1, T> fine = fine_level(levels_);
#pragma unroll 1
  for (int t = int(threadIdx.x) / lanes; t < count; t += int(blockDim.x) / lanes) {
    const int at = min(row(t), last);
    const Vec3<T> sum = sum_over_lanes(prolongated(fine, below_fine(), at, 0, lane), lanes / 2, 1);
    if (lane == 0 && row(t) <= last) m_.fine.z[at] = quad(vec3(m_.fine.z[at]) + sum);
  }
}

// Computes `Rows` neighbouring segments from i on by one warp, in chunks of one number per lane.
// Out of line, since it has many callers.
template <class T>
template <int Rows>
__device__ __noinline__ void DeviceCycle<T>::multiply_rows(TriangularFactor a, int i) {
  const int n = a.n, lane = int(threadIdx.x) % warp_size;
  const Quad<T>* x = a.x;
  Segment segment[Rows];
  Vec3<T> sum[Rows];
#pragma unroll
  for (int r = 0; r < Rows; ++r) {
    segment[r] = a.segment(min(i + r, n - 1));
    sum[r] = {T(0), T(0), T(0)};
  }
  // rows end and columns begin at different places; chunks between full and part are complete in
  // all segments
  const Segment &one = segment[0], &other = segment[Rows - 1];
  const int full = (other.first + warp_size - 1) / warp_size, part = one.end / warp_size;
  int chunk = one.first / warp_size;
#pragma unroll 1
  for (; chunk < min(full, part); ++chunk) add_part(n, x, segment, chunk, sum);
  constexpr int together = Rows == 1 ? 8 : 4;
#pragma unroll 1
  for (; chunk + together <= part; chunk += together)
    add_chunks<together>(x, segment, chunk * warp_size + lane, sum);
#pragma unroll 1
  for (; chunk < part; ++chunk) add_chunks<1>(x, segment, chunk * warp_size + lane, sum);
#pragma unroll 1
  for (; chunk * warp_size < other.end; ++chunk) add_part(n, x, segment, chunk, sum);
#pragma unroll
  for (int r = 0; r < Rows; ++r) {
    const Vec3<T> total = sum_over_lanes(sum[r], warp_size / 2, 1);
    if (lane == 0 && i + r < n) a.out[i + r] = quad(total);
  }
}

// from number j on; all loads come before their first use
template <class T>
template <int Count, int Rows>
PD_DEVICE void DeviceCycle<T>::add_chunks(const Quad<T>* x, const Segment (&segment)[Rows], int j,
                                          Vec3<T> (&sum)[Rows]) {
  T number[Count][Rows];
  Vec3<T> at[Count];
#pragma unroll
  for (int u = 0; u < Count; ++u) {
    at[u] = vec3(x[j + u * warp_size]);
#pragma unroll
    for (int r = 0; r < Rows; ++r) number[u][r] = segment[r].number[j + u * warp_size];
  }
#pragma unroll
  for (int u = 0; u < Count; ++u) {
#pragma unroll
    for (int r = 0; r < Rows; ++r) sum[r] = multiply_add(number[u][r], at[u], sum[r]);
  }
}

// a chunk that only some segments cover
template <class T>
template <int Rows>
PD_DEVICE void DeviceCycle<T>::add_part(int n, const Quad<T>* x, const Segment (&segment)[Rows],
                                        int chunk, Vec3<T> (&sum)[Rows]) {
  const int j = chunk * warp_size + int(threadIdx.x) % warp_size;
  const Vec3<T> at = vec3(x[min(j, n - 1)]);
  T number[Rows];
#pragma unroll
  for (int r = 0; r < Rows; ++r)
    number[r] = segment[r].number[min(max(j, segment[r].first), segment[r].end - 1)];
#pragma unroll
  for (int r = 0; r < Rows; ++r) {
    const bool in = j >= segment[r].first && j < segment[r].end;
    const Vec3<T> more = multiply_add(number[r], at, sum[r]);
    sum[r] = {select(in, more.x, sum[r].x), select(in, more.y, sum[r].y),
              select(in, more.z, sum[r].z)};
  }
}

}  // namespace pd::inline PD_TARGET
