// The rigid motions of solver/rigid.h: sums over every patch's part of a piece, a warp a part, then over the parts, a warp a piece.
#pragma once
#include "cuda/collect.h"
#include "cuda/vertices.h"
#include "solver/rigid.h"

namespace pd::inline PD_TARGET {

// Up to four rounds: where a piece is, its motion if it touches nothing, what contacts leave of that, and nothing where that leads into
// further contacts.
enum class Rigid { mean, free, touching, beside };

// The numbers of a part, see RigidSums and Touch, and the least gap of the last round.
struct PartSums {
  static constexpr int rigid = 0, touched = RigidSums::count, least_gap = touched + 1;
  static constexpr int slips = least_gap + 1, bounds = slips + Touch::slips;
  static constexpr int count = bounds + Touch::bounds;
};

template <class T>
struct Piece {
  Vec3<double> center;
  RigidMotion<T> motion;
  unsigned touched;  // a bit for each of the first planes
};

// Slots of a part, and where the arrays have the vertex of one: at the slot itself, or where `vertex` says, from `first` on.
struct Part {
  const int *slot, *vertex;
  int begin, end, first;

  template <class T>
  PD_DEVICE Part(const DevicePlan<T>& plan, int part, const int* vertex, int first)
      : slot(plan.part_slot),
        vertex(vertex),
        begin(plan.part_start[part]),
        end(plan.part_start[part + 1]),
        first(first) {}

  template <class T>
  PD_DEVICE int piece(const DevicePlan<T>& plan) const {
    return plan.slot_piece[slot[begin]];
  }

  // visit(i), each by one lane
  template <class Visit>
  PD_DEVICE void each(const Visit& visit) const {
    for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size)
      visit(first + (vertex ? vertex[slot[at]] : slot[at]));
  }
};

// Lane n gets value n of all lanes together. Each exchange halves how many values a lane is left with.
template <int Count, class Op>
PD_DEVICE double share_out(const double (&value)[Count], Op op) {
  static_assert(Count <= warp_size);
  double left[warp_size];
#pragma unroll
  for (int n = 0; n < warp_size; ++n) left[n] = n < Count ? value[n < Count ? n : 0] : Op::none;
#pragma unroll
  for (int half = warp_size / 2; half > 0; half /= 2) {
    const bool upper = int(threadIdx.x) & half;
#pragma unroll
    for (int n = 0; n < half; ++n) {
      if (n >= Count) break;  // nothing but `none` in both halves
      const double give = upper ? left[n] : left[n + half];
      left[n] = op(upper ? left[n + half] : left[n], __shfl_xor_sync(whole_warp, give, half));
    }
  }
  return left[0];
}

// Returns what share_out does.
template <int Count, class Op>
PD_DEVICE double write_shares(const double (&value)[Count], Op op, double* to) {
  const double own = share_out(value, op);
  if (int(threadIdx.x) % warp_size < Count) to[int(threadIdx.x) % warp_size] = own;
  return own;
}

// Every part is a whole piece, whose mean needs no round of its own.
template <class T>
PD_HD bool parts_are_pieces(const DevicePlan<T>& plan) {
  return plan.parts == plan.pieces;
}

// `to`: PartSums
template <Rigid What, class T, bool Touching>
PD_DEVICE_COLD void sum_part(Vertices<T, Touching> v, Contacts<T> contacts, bool pins, bool whole,
                             Part part, const Piece<T>& piece, double* to) {
  using S = RigidSums;
  const auto wide = [](const Vec3<T>& a) {
    return Vec3<double>{double(a.x), double(a.y), double(a.z)};
  };
  const auto at = [&](int i) { return wide(vec3(v.x[i])) + wide(vec3(v.u[i])); };
  const auto sum_mean = [&] {
    double sum[S::lag] = {};
    part.each([&](int i) { add_mean(sum, double(v.inertia(i)), at(i)); });
    return write_shares(sum, Add{}, to + PartSums::rigid);
  };
  if constexpr (What == Rigid::mean) {
    sum_mean();
  } else if constexpr (What == Rigid::free) {
    Vec3<double> center;
    if (whole) {
      const double own = sum_mean();
      double sum[S::lag];
      for (int n = 0; n < S::lag; ++n) sum[n] = __shfl_sync(whole_warp, own, n);
      center = center_of(sum);
    } else {
      center = piece.center;
    }
    double sum[S::pins - S::lag] = {}, held[S::count - S::pins] = {};
    part.each([&](int i) {
      const Vec3<T> lag = vec3(v.target[i]) - vec3(v.u[i]);
      add_moments(sum, double(v.inertia(i)), at(i) - center, wide(lag));
    });
    write_shares(sum, Add{}, to + PartSums::rigid + S::lag);
    if (!pins) return;
    part.each([&](int i) { add_pin(held, double(v.inertia(i)), at(i) - center); });
    write_shares(held, Add{}, to + PartSums::rigid + S::pins);
  } else if constexpr (What == Rigid::touching) {
    double slips[Touch::slips] = {}, bounds[Touch::bounds];
    for (double& least : bounds) least = HUGE_VAL;
    unsigned touched = 0;
    const auto near = [&](int k, T gap) { touched |= gap > T(0) ? 0u : 1u << k; };
    part.each([&](int i) {
      const Vec3<T> u = vec3(v.u[i]);
      add_touch(slips, bounds, contacts, vec3(v.x[i]) + u, u, piece.motion, near);
    });
    touched = __reduce_or_sync(whole_warp, touched);
    if (threadIdx.x % warp_size == 0) to[PartSums::touched] = double(touched);
    write_shares(slips, Add{}, to + PartSums::slips);
    write_shares(bounds, Least{}, to + PartSums::bounds);
  } else {
    double least = HUGE_VAL;
    const auto touches = [&](int k) { return bool(piece.touched >> k & 1); };
    part.each([&](int i) {
      const Vec3<T> y = vec3(v.x[i]) + vec3(v.u[i]);
      const T beside = least_gap_beside(contacts, y + piece.motion.of(y), touches);
      least = Least{}(least, double(beside));
    });
    least = across_warp(least, Least{});
    if (threadIdx.x % warp_size == 0) to[PartSums::least_gap] = least;
  }
}

// Combines Count numbers, from the `first` on, of the parts of a piece, and gives them to all lanes. With few parts a lane adds up
// one number of all of them; with many it adds up all numbers of every 32nd part.
template <int Count, class T, class Op, int All>
PD_DEVICE void over_parts(const DevicePlan<T>& plan, int piece, const double* part_sum, Op op,
                          int first, double (&sum)[All]) {
  constexpr int few = 16;
  const int lane = int(threadIdx.x) % warp_size;
  const int begin = plan.piece_start[piece], end = plan.piece_start[piece + 1];
  // past the first level of cache, which does not see what other blocks wrote
  const auto read = [&](int at, int n) {
    return __ldcg(part_sum + PartSums::count * plan.piece_part[at] + first + n);
  };
  double own = Op::none;
  if (end - begin <= few) {
    for (int at = begin; at < end && lane < Count; ++at) own = op(own, read(at, lane));
  } else {
    double part[Count];
    for (int n = 0; n < Count; ++n) part[n] = Op::none;
    for (int at = begin + lane; at < end; at += warp_size) {
      for (int n = 0; n < Count; ++n) part[n] = op(part[n], read(at, n));
    }
    own = share_out(part, op);
  }
  __syncwarp();
  for (int n = 0; n < Count; ++n) sum[n] = __shfl_sync(whole_warp, own, n);
}

// RigidSums of a piece.
template <class T>
PD_DEVICE void rigid_sums(const DevicePlan<T>& plan, int piece, const double* part_sum,
                          double (&sum)[RigidSums::count]) {
  if (plan.pins > 0) {
    over_parts<RigidSums::count>(plan, piece, part_sum, Add{}, PartSums::rigid, sum);
    return;
  }
  for (int n = RigidSums::pins; n < RigidSums::count; ++n) sum[n] = 0;
  over_parts<RigidSums::pins>(plan, piece, part_sum, Add{}, PartSums::rigid, sum);
}

template <class To, class From>
PD_HD Vec3<To> vector_in(const Vec3<From>& a) {
  return {To(a.x), To(a.y), To(a.z)};
}

template <class T>
PD_DEVICE RigidMotion<T> motion_in(const RigidMotion<double>& m) {
  return {{{vector_in<T>(m.turn.row[0]), vector_in<T>(m.turn.row[1]), vector_in<T>(m.turn.row[2])}},
          vector_in<T>(m.center),
          vector_in<T>(m.shift)};
}

// Of bits in numbers.
struct Or {
  static constexpr double none = 0;
  PD_DEVICE double operator()(double a, double b) const {
    return double(unsigned(a) | unsigned(b));
  }
};

// `part_sum`: [parts, PartSums::count]
template <Rigid What, class T>
PD_DEVICE_COLD void move_piece(const DevicePlan<T>& plan, int piece, Contacts<T> contacts,
                               const double* part_sum, Piece<T>& to) {
  const bool leader = threadIdx.x % warp_size == 0;
  if constexpr (What == Rigid::mean) {
    double sum[RigidSums::lag];
    over_parts<RigidSums::lag>(plan, piece, part_sum, Add{}, PartSums::rigid, sum);
    if (leader) to.center = center_of(sum);
  } else if constexpr (What == Rigid::beside) {
    double least[1];
    over_parts<1>(plan, piece, part_sum, Least{}, PartSums::least_gap, least);
    if (leader && !(least[0] > 0)) to.motion.turn = {}, to.motion.shift = {};
  } else {
    double sum[RigidSums::count];
    if constexpr (What == Rigid::free) {
      rigid_sums(plan, piece, part_sum, sum);
      if (leader) to.motion = motion_in<T>(RigidFit(sum).free());
    } else {
      double bits[1], slips[Touch::slips], bounds[Touch::bounds];
      over_parts<1>(plan, piece, part_sum, Or{}, PartSums::touched, bits);
      const unsigned touched = unsigned(bits[0]);
      if (leader) to.touched = touched;
      if (touched == 0) return;
      rigid_sums(plan, piece, part_sum, sum);
      over_parts<Touch::slips>(plan, piece, part_sum, Add{}, PartSums::slips, slips);
      over_parts<Touch::bounds>(plan, piece, part_sum, Least{}, PartSums::bounds, bounds);
      if (!leader) return;
      const auto plane = [&](int k) {
        const Plane<T>& p = contacts.planes[k];
        return Plane<double>{vector_in<double>(p.normal), double(p.height), double(p.friction)};
      };
      to.motion = motion_in<T>(motion_on_contacts(RigidFit(sum), touched, slips, bounds, plane));
    }
  }
}

}  // namespace pd::inline PD_TARGET
