// The rigid motions of solver/rigid/free_motion.h: reductions over a patch's part of a piece (one warp per
// part), then over the parts (one warp per piece).
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/common/vertices.h"
#include "solver/rigid/rolling_contact.h"

namespace pd::inline PD_TARGET {

// Rounds. start: centroid, and whether a piece starts from its current position (before iterations
// on contacts only). mean: centroid. free: motion without contacts. touching: motion that contacts
// leave. tipping: rolling, in several rounds. beside: cancels a motion that would lead into further
// contacts.
enum class Rigid { start, mean, free, touching, tipping, beside };

// Offsets of a part's values: RigidSums, Touch, and the least gap of the last round. The rounds
// tipping and start reuse the place of Touch.
struct PartSums {
  static constexpr int rigid = 0, touch = RigidSums::count, bounds = touch + Touch::sums;
  static constexpr int touched = bounds + Touch::bounds, least_gap = touched + 1;
  static constexpr int count = least_gap + 1, found = touch, start = touch;
  // behind StartSums: sum of a (v - u), which shifts the centroid of a piece that starts at rest
  static constexpr int back = StartSums::count, starts = back + 3;
  static_assert(Found::count <= Touch::sums && starts <= Touch::sums);
};

template <class T>
struct Piece {
  double sum[RigidSums::count], touch[Touch::sums], bounds[Touch::bounds];  // over all its parts
  double start[PartSums::starts];
  double touched, least_gap;  // one bit per plane; see PartSums
  bool still;                 // starts from its current position
  int leg;                    // the leg that it continues in, 0: none
  Vec3<double> center;
  RigidMotion<T> motion;
  Tipping tipping;
};

// Slots of a part. A vertex lies at its slot, or at `vertex[slot]` if given, with offset `first`.
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

  // calls visit(i) on one lane each
  template <class Visit>
  PD_DEVICE void each(const Visit& visit) const {
    for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size)
      visit(first + (vertex ? vertex[slot[at]] : slot[at]));
  }
};

// Reduces `value` over a warp; lane n gets value n. Each exchange halves the number of values per
// lane.
template <int Count, class Op>
PD_DEVICE double share_out(const double (&value)[Count], Op op) {
  static_assert(Count <= warp_size);
  double left[warp_size];
#pragma unroll
  for (int n = 0; n < warp_size; ++n) left[n] = n < Count ? value[n < Count ? n : 0] : Op::identity;
#pragma unroll
  for (int half = warp_size / 2; half > 0; half /= 2) {
    const bool upper = int(threadIdx.x) & half;
#pragma unroll
    for (int n = 0; n < half; ++n) {
      if (n >= Count) break;  // both halves hold only `identity`
      const double give = upper ? left[n] : left[n + half];
      left[n] = op(upper ? left[n + half] : left[n], __shfl_xor_sync(full_warp, give, half));
    }
  }
  return left[0];
}

// The same, also written to `to`; returns the lane's value.
template <int Count, class Op>
PD_DEVICE double write_shares(const double (&value)[Count], Op op, double* to) {
  const double own = share_out(value, op);
  if (int(threadIdx.x) % warp_size < Count) to[int(threadIdx.x) % warp_size] = own;
  return own;
}

// Settings of all rounds. first: before any iteration. pins: the plan has pins. whole: every part
// is a whole piece, so no round for the centroid is needed. starts: pieces may start from their
// current position. leg: leg of the motion.
struct Aligning {
  bool first, pins, whole, starts;
  int leg = 0;

  template <class T>
  PD_HD Aligning(const DevicePlan<T>& plan, bool touching, bool first)
      : first(first),
        pins(plan.pins > 0),
        whole(plan.parts == plan.pieces),
        starts(touching && first) {}

  PD_HD bool at_once() const { return whole && !starts; }
  PD_HD bool is_last() const { return leg + 1 == motion_legs; }
  PD_HD void go_on() {
    ++leg;
    starts = false;
  }
};

// Whether `is` holds for any of `count`. All threads of the block must call it.
template <class Is>
PD_DEVICE bool some_of(int count, const Is& is) {
  bool some = false;
  for (int n = threadIdx.x; n < count; n += blockDim.x) some = some || is(n);
  return __syncthreads_or(some);
}

// The rounds of a leg. `run` finds the values of a round, resets pieces to their start, and knows
// whether some roll.
template <bool HasContacts, class Run>
PD_DEVICE void find_in_rounds(Run& run, const Aligning& how, bool several_contacts) {
  if constexpr (HasContacts) {
    if (how.starts) {
      run.template find<Rigid::start>(how);
      run.begin_still();
    }
  }
  if (!how.starts && !how.whole) run.template find<Rigid::mean>(how);
  run.template find<Rigid::free>(how);
  if constexpr (HasContacts) {
    run.template find<Rigid::touching>(how);
    while (run.some_tip()) run.template find<Rigid::tipping>(how);
    if (several_contacts) run.template find<Rigid::beside>(how);
  }
}

// The first lane of a warp that holds the least number.
PD_DEVICE int lane_of_least(double number) {
  const double least = warp_reduce(number, Min{});
  const unsigned have = __ballot_sync(full_warp, number == least);
  return have ? __ffs(int(have)) - 1 : 0;
}

template <class To, class From>
PD_HD Vec3<To> vector_in(const Vec3<From>& a) {
  return {To(a.x), To(a.y), To(a.z)};
}

template <class To, class From>
PD_HD Plane<To> plane_in(const Plane<From>& p) {
  return {vector_in<To>(p.normal), To(p.height), To(p.friction)};
}

// Whether a piece takes no part in this leg. After round `touching` no other round can change it.
template <Rigid What, class T>
PD_DEVICE bool stands(const Aligning& how, const Piece<T>& piece) {
  return What <= Rigid::touching && how.leg > 0 && piece.leg != how.leg;
}

// `to`: PartSums
template <Rigid What, class T, bool HasContacts>
PD_DEVICE_COLD void sum_part(Vertices<T, HasContacts> v, Contacts<T> contacts,
                             const Settings& settings, Aligning how, Part part,
                             const Piece<T>& piece, double* to) {
  using S = RigidSums;
  if (stands<What>(how, piece)) return;
  const auto wide = [](const Vec3<T>& a) {
    return Vec3<double>{double(a.x), double(a.y), double(a.z)};
  };
  const auto at = [&](int i) { return wide(vec3(v.x[i])) + wide(vec3(v.u[i])); };
  const auto sum_mean = [&] {
    double sum[S::target_offset] = {};
    part.each([&](int i) { add_mean(sum, double(v.inertia(i)), at(i)); });
    return write_shares(sum, Add{}, to + PartSums::rigid);
  };
  if constexpr (What == Rigid::start) {
    sum_mean();
    double sum[StartSums::count] = {}, back[3] = {};
    part.each([&](int i) {
      const auto vertex = v.at(i);
      const Vec3<T> u = vec3(v.u[i]), still = vertex.current_iterate(contacts);
      add_start(sum, contacts, vertex.x, vertex.target, vertex.inertia, vertex.inverse, u, still,
                u - v.predicted(i, settings));
      const Vec3<double> way = double(vertex.inertia) * (wide(still) - wide(u));
      back[0] += way.x;
      back[1] += way.y;
      back[2] += way.z;
    });
    write_shares(sum, Add{}, to + PartSums::start);
    write_shares(back, Add{}, to + PartSums::start + PartSums::back);
  } else if constexpr (What == Rigid::mean) {
    sum_mean();
  } else if constexpr (What == Rigid::free) {
    Vec3<double> center;
    if (how.at_once()) {
      const double own = sum_mean();
      double sum[S::target_offset];
      for (int n = 0; n < S::target_offset; ++n) sum[n] = __shfl_sync(full_warp, own, n);
      center = center_of(sum);
    } else {
      center = piece.center;
    }
    double sum[S::pins - S::target_offset] = {}, held[S::count - S::pins] = {};
    part.each([&](int i) {
      const Vec3<T> target_offset = vec3(v.target[i]) - vec3(v.u[i]);
      add_moments(sum, double(v.inertia(i)), at(i) - center, wide(target_offset));
    });
    write_shares(sum, Add{}, to + PartSums::rigid + S::target_offset);
    if (!how.pins) return;
    part.each([&](int i) { add_pin(held, double(v.inertia(i)), at(i) - center); });
    write_shares(held, Add{}, to + PartSums::rigid + S::pins);
  } else if constexpr (What == Rigid::touching) {
    double sums[Touch::sums] = {}, bounds[Touch::bounds];
    for (double& least : bounds) least = HUGE_VAL;
    unsigned touched = 0;
    const auto near = [&](int k, T gap) { touched |= gap > T(0) ? 0u : 1u << k; };
    part.each([&](int i) {
      const Vec3<T> u = vec3(v.u[i]);
      add_touch(sums, bounds, contacts, vec3(v.x[i]) + u, u, piece.motion, !how.first, near);
    });
    touched = __reduce_or_sync(full_warp, touched);
    if (threadIdx.x % warp_size == 0) to[PartSums::touched] = double(touched);
    write_shares(sums, Add{}, to + PartSums::touch);
    write_shares(bounds, Min{}, to + PartSums::bounds);
  } else if constexpr (What == Rigid::tipping) {
    if (!piece.tipping.goes_on()) return;
    const TippingSearch<double> s =
        piece.tipping.search(plane_in<double>(contacts.planes[piece.tipping.number]));
    const TippingSearch<T> search = {vector_in<T>(s.normal),
                                     vector_in<T>(s.away),
                                     T(s.height),
                                     T(s.reach),
                                     T(s.down),
                                     T(s.seeks)};
    double found[Found::count];
    for (double& number : found) number = HUGE_VAL;
    part.each([&](int i) {
      const Vec3<T> u = vec3(v.u[i]), y = vec3(v.x[i]) + u;
      T order, depth, left;
      search.look(contacts, piece.motion, y, order, depth, left);
      keep_found(found, double(order), double(depth), double(left), wide(y), wide(u));
    });
    if (int(threadIdx.x) % warp_size != lane_of_least(found[Found::order])) return;
    for (int n = 0; n < Found::count; ++n) to[PartSums::found + n] = found[n];
  } else {
    double least = HUGE_VAL;
    const unsigned touched = unsigned(piece.touched);
    const auto touches = [&](int k) { return bool(touched >> k & 1); };
    part.each([&](int i) {
      const Vec3<T> y = vec3(v.x[i]) + vec3(v.u[i]);
      const T beside = least_gap_beside(contacts, y, piece.motion.of(y), !how.first, touches);
      least = Min{}(least, double(beside));
    });
    least = warp_reduce(least, Min{});
    if (threadIdx.x % warp_size == 0) to[PartSums::least_gap] = least;
  }
}

// Value n of a part from `from` [parts, PartSums::count]. It bypasses the L1 cache, which may not
// hold the writes of other blocks.
template <class T>
PD_DEVICE double read_part(const DevicePlan<T>& plan, const double* from, int at, int n) {
  return __ldcg(from + PartSums::count * plan.piece_part[at] + n);
}

// Lane n gets value n reduced over many parts; each lane reads every 32nd part.
template <int Count, class T, class Op>
PD_DEVICE_COLD double reduce_over_many_parts(const DevicePlan<T>& plan, int begin, int end,
                                             const double* from, Op op) {
  double part[Count];
  for (int n = 0; n < Count; ++n) part[n] = Op::identity;
  for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size) {
    for (int n = 0; n < Count; ++n) part[n] = op(part[n], read_part(plan, from, at, n));
  }
  return share_out(part, op);
}

// Reduces Count values from `first` on over the parts of a piece, into memory that all lanes can
// read. Broadcasts one by one would take longer. With few parts, each lane reduces one value over
// all of them.
template <int Count, class T, class Op>
PD_DEVICE void reduce_over_parts(const DevicePlan<T>& plan, int piece, const double* part_sum,
                                 Op op, int first, double* total) {
  constexpr int few = 16;
  const int lane = int(threadIdx.x) % warp_size;
  const int begin = plan.piece_start[piece], end = plan.piece_start[piece + 1];
  const double* from = part_sum + first;
  double own = Op::identity;
  if (end - begin <= few) {
    for (int at = begin; at < end && lane < Count; ++at)
      own = op(own, read_part(plan, from, at, lane));
  } else {
    own = reduce_over_many_parts<Count>(plan, begin, end, from, op);
  }
  if (lane < Count) total[lane] = own;
  __syncwarp();
}

template <class T>
PD_DEVICE RigidMotion<T> motion_in(const RigidMotion<double>& m) {
  return {{{vector_in<T>(m.turn.row[0]), vector_in<T>(m.turn.row[1]), vector_in<T>(m.turn.row[2])}},
          vector_in<T>(m.center),
          vector_in<T>(m.shift)};
}

// Bitwise or of integers stored as doubles.
struct Or {
  static constexpr double identity = 0;
  PD_DEVICE double operator()(double a, double b) const {
    return double(unsigned(a) | unsigned(b));
  }
};

// The best result over the parts of a piece, for all lanes.
template <class T>
PD_DEVICE void find_over_parts(const DevicePlan<T>& plan, int piece, const double* part_sum,
                               double (&found)[Found::count]) {
  const int lane = int(threadIdx.x) % warp_size;
  const double* from = part_sum + PartSums::found;
  int best = plan.piece_start[piece];
  double least = HUGE_VAL;
  for (int at = best + lane; at < plan.piece_start[piece + 1]; at += warp_size) {
    const double order = read_part(plan, from, at, Found::order);
    if (order < least) best = at, least = order;
  }
  best = __shfl_sync(full_warp, best, lane_of_least(least));
  for (int n = 0; n < Found::count; ++n) found[n] = read_part(plan, from, best, n);
}

template <class T>
PD_DEVICE void go_on(const Aligning& how, Piece<T>& to) {
  to.leg = how.is_last() ? 0 : how.leg + 1;
}

template <class T>
PD_DEVICE void stand_still(Piece<T>& to) {
  to.motion.turn = {};
  to.motion.shift = {};
  to.leg = 0;
}

// The motion that contacts leave to a piece that does not roll, by one lane.
template <class T>
PD_DEVICE_COLD void move_on_contacts(const Contacts<T>& contacts, Aligning how, Piece<T>& to) {
  const auto plane = [&](int k) { return plane_in<double>(contacts.planes[k]); };
  const unsigned touched = unsigned(to.touched);
  if (comes_to_plane(touched, to.bounds)) go_on(how, to);
  to.motion =
      motion_in<T>(motion_on_contacts(RigidFit(to.sum), touched, to.touch, to.bounds, plane));
}

// `part_sum`: [parts, PartSums::count]
template <Rigid What, class T>
PD_DEVICE_COLD void move_piece(const DevicePlan<T>& plan, int piece, Contacts<T> contacts,
                               Aligning how, const double* part_sum, Piece<T>& to) {
  const bool leader = threadIdx.x % warp_size == 0;
  const auto plane = [&](int k) { return plane_in<double>(contacts.planes[k]); };
  using S = RigidSums;
  if (stands<What>(how, to)) {
    if (What == Rigid::free && leader) stand_still(to);
    return;
  }
  if constexpr (What == Rigid::start) {
    reduce_over_parts<S::target_offset>(plan, piece, part_sum, Add{}, PartSums::rigid, to.sum);
    reduce_over_parts<PartSums::starts>(plan, piece, part_sum, Add{}, PartSums::start, to.start);
    if (!leader) return;
    double sum[StartSums::count];
    for (int n = 0; n < StartSums::count; ++n) sum[n] = to.start[n];
    to.still = starts_still(sum);
    for (int n = 0; n < 3 && to.still; ++n) to.sum[S::position + n] += to.start[PartSums::back + n];
    to.center = center_of(to.sum);
  } else if constexpr (What == Rigid::mean) {
    reduce_over_parts<S::target_offset>(plan, piece, part_sum, Add{}, PartSums::rigid, to.sum);
    if (leader) to.center = center_of(to.sum);
  } else if constexpr (What == Rigid::free) {
    if (how.at_once())
      reduce_over_parts<S::target_offset>(plan, piece, part_sum, Add{}, PartSums::rigid, to.sum);
    reduce_over_parts<S::pins - S::target_offset>(plan, piece, part_sum, Add{},
                                                  PartSums::rigid + S::target_offset,
                                                  to.sum + S::target_offset);
    if (how.pins)
      reduce_over_parts<S::count - S::pins>(plan, piece, part_sum, Add{}, PartSums::rigid + S::pins,
                                            to.sum + S::pins);
    if (!leader) return;
    if (!how.pins) {
      for (int n = S::pins; n < S::count; ++n) to.sum[n] = 0;
    }
    to.motion = motion_in<T>(RigidFit(to.sum).free());
  } else if constexpr (What == Rigid::touching) {
    reduce_over_parts<1>(plan, piece, part_sum, Or{}, PartSums::touched, &to.touched);
    if (leader) to.tipping.end(), to.leg = 0;
    if (to.touched == 0) return;
    reduce_over_parts<Touch::sums>(plan, piece, part_sum, Add{}, PartSums::touch, to.touch);
    reduce_over_parts<Touch::bounds>(plan, piece, part_sum, Min{}, PartSums::bounds, to.bounds);
    if (!leader) return;
    begin_tipping(to.tipping, how.first, RigidFit(to.sum), unsigned(to.touched), to.touch, plane);
    if (!to.tipping.goes_on()) move_on_contacts(contacts, how, to);
  } else if constexpr (What == Rigid::tipping) {
    if (!to.tipping.goes_on()) return;
    double found[Found::count];
    find_over_parts(plan, piece, part_sum, found);
    if (!leader) return;
    RigidMotion<double> motion;
    if (to.tipping.next(RigidFit(to.sum), plane(to.tipping.number), found, motion)) {
      to.motion = motion_in<T>(motion);
      if (to.tipping.comes()) go_on(how, to);
    } else {
      move_on_contacts(contacts, how, to);
    }
  } else {
    reduce_over_parts<1>(plan, piece, part_sum, Min{}, PartSums::least_gap, &to.least_gap);
    if (leader && !to.tipping.tips && !(to.least_gap > 0)) stand_still(to);
  }
}

}  // namespace pd::inline PD_TARGET
