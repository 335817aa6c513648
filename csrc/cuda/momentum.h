// Shifts of free pieces that minimise E along their translation: sum a (s - u) / sum a, as in exact arithmetic the momentum
// balance demands. First the sums of every patch's part of a piece, a warp a part, then of the parts, a warp a piece.
#pragma once
#include "cuda/collect.h"
#include "cuda/vertices.h"

namespace pd::inline PD_TARGET {

// Weight and moment of vertices index(begin) ... index(end - 1), in all lanes.
template <class T, bool Touching, class Index>
PD_DEVICE void sum_part(const Vertices<T, Touching>& v, int begin, int end, const Index& index,
                        double (&sum)[4]) {
  for (int c = 0; c < 4; ++c) sum[c] = 0;
  for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size) {
    const int i = index(at);
    const double a = double(v.inertia(i));
    const Vec3<T> lag = vec3(v.target[i]) - vec3(v.u[i]);
    sum[0] += a;
    sum[1] += a * double(lag.x);
    sum[2] += a * double(lag.y);
    sum[3] += a * double(lag.z);
  }
  for (int c = 0; c < 4; ++c) sum[c] = across_warp(sum[c], Add{});
}

template <class T>
PD_DEVICE Quad<T> shift_of(const double (&sum)[4]) {
  return {T(sum[1] / sum[0]), T(sum[2] / sum[0]), T(sum[3] / sum[0]), T(0)};
}

// Least distance of the vertices from all contacts after a shift, in all lanes.
template <class T, bool Touching, class Index>
PD_DEVICE double least_gap(const Vertices<T, Touching>& v, const Contacts<T>& contacts, int begin,
                           int end, const Index& index, const Vec3<T>& shift) {
  double least = HUGE_VAL;
  for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size) {
    const int i = index(at);
    const Vec3<T> moved = (vec3(v.x[i]) + vec3(v.u[i])) + shift;
    least = Least{}(least, double(contacts.least_gap(moved)));
  }
  return across_warp(least, Least{});
}

// Combines what `read(part, c)` gives for the parts of a piece, in all lanes.
template <int Count, class T, class Op, class Read>
PD_DEVICE void over_parts(const DevicePlan<T>& plan, int piece, Op op, const Read& read,
                          double (&sum)[Count]) {
  for (int c = 0; c < Count; ++c) sum[c] = Op::none;
  for (int at = plan.piece_start[piece] + int(threadIdx.x) % warp_size;
       at < plan.piece_start[piece + 1]; at += warp_size) {
    for (int c = 0; c < Count; ++c) sum[c] = op(sum[c], read(plan.piece_part[at], c));
  }
  for (int c = 0; c < Count; ++c) sum[c] = across_warp(sum[c], op);
}

}  // namespace pd::inline PD_TARGET
