// The rigid motions of solver/rigid.h: sums over every patch's part of a piece, a warp a part, then over the parts, a warp a piece.
#pragma once
#include "cuda/collect.h"
#include "cuda/vertices.h"
#include "solver/rigid.h"

namespace pd::inline PD_TARGET {

// Four rounds: where a piece is, its motion if it touches nothing, what contacts leave of that, and nothing where that leads into
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

// visit(i, x + u, u) of vertices i = index(begin) ... index(end - 1), each by one lane.
template <class T, bool Touching, class Index, class Visit>
PD_DEVICE void each_of_part(const Vertices<T, Touching>& v, int begin, int end, const Index& index,
                            const Visit& visit) {
  for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size) {
    const int i = index(at);
    visit(i, vec3(v.x[i]) + vec3(v.u[i]), vec3(v.u[i]));
  }
}

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

template <int Count, class Op>
PD_DEVICE void write_shares(const double (&value)[Count], Op op, double* to) {
  const double own = share_out(value, op);
  if (int(threadIdx.x) % warp_size < Count) to[int(threadIdx.x) % warp_size] = own;
}

template <Rigid What, class T, bool Touching, class Index>
PD_DEVICE void sum_part(const Vertices<T, Touching>& v, const Contacts<T>& contacts, bool pins,
                        int begin, int end, const Index& index, const Piece<T>& piece, double* to) {
  using S = RigidSums;
  const auto wide = [](const Vec3<T>& a) {
    return Vec3<double>{double(a.x), double(a.y), double(a.z)};
  };
  const auto at = [&](int i) { return wide(vec3(v.x[i])) + wide(vec3(v.u[i])); };
  if constexpr (What == Rigid::mean) {
    double sum[S::lag] = {};
    each_of_part(v, begin, end, index, [&](int i, const Vec3<T>&, const Vec3<T>&) {
      add_mean(sum, double(v.inertia(i)), at(i));
    });
    write_shares(sum, Add{}, to + PartSums::rigid);
  } else if constexpr (What == Rigid::free) {
    double sum[S::pins - S::lag] = {}, held[S::count - S::pins] = {};
    each_of_part(v, begin, end, index, [&](int i, const Vec3<T>&, const Vec3<T>& u) {
      add_moments(sum, double(v.inertia(i)), at(i) - piece.center, wide(vec3(v.target[i]) - u));
    });
    write_shares(sum, Add{}, to + PartSums::rigid + S::lag);
    if (pins) {
      each_of_part(v, begin, end, index, [&](int i, const Vec3<T>&, const Vec3<T>&) {
        add_pin(held, double(v.inertia(i)), at(i) - piece.center);
      });
    }
    write_shares(held, Add{}, to + PartSums::rigid + S::pins);
  } else if constexpr (What == Rigid::touching) {
    double slips[Touch::slips] = {}, bounds[Touch::bounds];
    for (double& least : bounds) least = HUGE_VAL;
    unsigned touched = 0;
    const auto near = [&](int k, T gap) { touched |= gap > T(0) ? 0u : 1u << k; };
    each_of_part(v, begin, end, index, [&](int, const Vec3<T>& y, const Vec3<T>& u) {
      add_touch(slips, bounds, contacts, y, u, piece.motion, near);
    });
    touched = __reduce_or_sync(whole_warp, touched);
    if (threadIdx.x % warp_size == 0) to[PartSums::touched] = double(touched);
    write_shares(slips, Add{}, to + PartSums::slips);
    write_shares(bounds, Least{}, to + PartSums::bounds);
  } else {
    double least = HUGE_VAL;
    const auto touches = [&](int k) { return bool(piece.touched >> k & 1); };
    each_of_part(v, begin, end, index, [&](int, const Vec3<T>& y, const Vec3<T>&) {
      const T beside = least_gap_beside(contacts, y + piece.motion.of(y), touches);
      least = Least{}(least, double(beside));
    });
    least = across_warp(least, Least{});
    if (threadIdx.x % warp_size == 0) to[PartSums::least_gap] = least;
  }
}

// Combines what `read(part, first + n)` gives for the parts of a piece, in all lanes.
template <int Count, class T, class Op, class Read>
PD_DEVICE void over_parts(const DevicePlan<T>& plan, int piece, Op op, int first, const Read& read,
                          double (&sum)[Count]) {
  for (int n = 0; n < Count; ++n) sum[n] = Op::none;
  for (int at = plan.piece_start[piece] + int(threadIdx.x) % warp_size;
       at < plan.piece_start[piece + 1]; at += warp_size) {
    for (int n = 0; n < Count; ++n) sum[n] = op(sum[n], read(plan.piece_part[at], first + n));
  }
  const double own = share_out(sum, op);
  for (int n = 0; n < Count; ++n) sum[n] = __shfl_sync(whole_warp, own, n);
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

template <Rigid What, class T, class Read>
PD_DEVICE void move_piece(const DevicePlan<T>& plan, int piece, const Contacts<T>& contacts,
                          const Read& read, Piece<T>& to) {
  const bool leader = threadIdx.x % warp_size == 0;
  if constexpr (What == Rigid::mean) {
    double sum[RigidSums::lag];
    over_parts(plan, piece, Add{}, PartSums::rigid, read, sum);
    if (leader) to.center = center_of(sum);
  } else if constexpr (What == Rigid::beside) {
    double least[1];
    over_parts(plan, piece, Least{}, PartSums::least_gap, read, least);
    if (leader && !(least[0] > 0)) to.motion.turn = {}, to.motion.shift = {};
  } else {
    double sum[RigidSums::count];
    over_parts(plan, piece, Add{}, PartSums::rigid, read, sum);
    if constexpr (What == Rigid::free) {
      if (leader) to.motion = motion_in<T>(RigidFit(sum).free());
    } else {
      double bits[1], slips[Touch::slips], bounds[Touch::bounds];
      over_parts(plan, piece, Or{}, PartSums::touched, read, bits);
      over_parts(plan, piece, Add{}, PartSums::slips, read, slips);
      over_parts(plan, piece, Least{}, PartSums::bounds, read, bounds);
      if (!leader) return;
      const unsigned touched = unsigned(bits[0]);
      to.touched = touched;
      if (touched == 0) return;
      const auto plane = [&](int k) {
        const Plane<T>& p = contacts.planes[k];
        return Plane<double>{vector_in<double>(p.normal), double(p.height), double(p.friction)};
      };
      to.motion = motion_in<T>(motion_on_contacts(RigidFit(sum), touched, slips, bounds, plane));
    }
  }
}

}  // namespace pd::inline PD_TARGET
