// The rounds of the coarse correction of solver/coarse: sums over a patch's part of a piece (one warp per
// part), then over the parts (one warp per piece).
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/rigid/contact_forces.h"
#include "cuda/rigid/warp_terms.h"

namespace pd::inline PD_TARGET {

// mean: of the positions. moments: about the mean; they begin the search for a motion, and without
// contacts end it. contacts: one pass of every piece that still searches. rises: energy of the
// corrected guess relative to the corrected present shape.
enum class Round { mean, moments, contacts, rises };

// Values of a part: RigidSums, ContactSums, or a rise.
struct PartSums {
  static constexpr int count = RigidSums::count;
  static_assert(ContactSums::count <= count);
};

struct Piece {
  double sum[RigidSums::count], contact[ContactSums::count], rise;  // over all its parts
  // of the correction before
  double reached;
  RigidMotion<double> motion_before;
  CoarseBody body;
};

// Whether every part is a whole piece, so no round for the mean is needed.
template <class T>
PD_DEVICE bool has_whole_parts(const DevicePlan<T>& plan) {
  return plan.parts == plan.pieces;
}

// Slots of a part.
struct Part {
  const int *slot, *vertex;
  int begin, end;
  bool by_vertex;  // vertices lie at their number, else at their slot, with offset `first`
  int first;

  template <class T>
  PD_DEVICE Part(const DevicePlan<T>& plan, int part, bool by_vertex, int first)
      : slot(plan.part_slot),
        vertex(plan.slot_vertex),
        begin(plan.part_start[part]),
        end(plan.part_start[part + 1]),
        by_vertex(by_vertex),
        first(first) {}

  template <class T>
  PD_DEVICE int piece(const DevicePlan<T>& plan) const {
    return plan.slot_piece[slot[begin]];
  }

  // calls visit(place, vertex) on one lane each
  template <class Visit>
  PD_DEVICE void each(const Visit& visit) const {
    for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size) {
      const int number = vertex[slot[at]];
      visit(first + (by_vertex ? number : slot[at]), number);
    }
  }
};

// Sums over a warp; lane n gets value n. Each exchange halves the number of values per lane.
template <int Count>
PD_DEVICE double share_out(const double (&value)[Count]) {
  static_assert(Count <= warp_size);
  double left[warp_size];
#pragma unroll
  for (int n = 0; n < warp_size; ++n) left[n] = n < Count ? value[n < Count ? n : 0] : 0;
#pragma unroll
  for (int half = warp_size / 2; half > 0; half /= 2) {
    const bool upper = int(threadIdx.x) & half;
#pragma unroll
    for (int n = 0; n < half; ++n) {
      if (n >= Count) break;  // both halves hold only zeros
      const double give = upper ? left[n] : left[n + half];
      left[n] = (upper ? left[n + half] : left[n]) + __shfl_xor_sync(full_warp, give, half);
    }
  }
  return left[0];
}

// The same, also written to `to`; returns the lane's value.
template <int Count>
PD_DEVICE double write_shares(const double (&value)[Count], double* to) {
  const double own = share_out(value);
  if (int(threadIdx.x) % warp_size < Count) to[int(threadIdx.x) % warp_size] = own;
  return own;
}

// The rounds that find the motions of all pieces. `run` takes the sums of a round, and knows whether
// some piece still searches.
template <bool HasContacts, class T, class Run>
PD_DEVICE void find_motions(const DevicePlan<T>& plan, Run& run) {
  if (!has_whole_parts(plan)) run.template find<Round::mean>();
  run.template find<Round::moments>();
  if constexpr (HasContacts) {
    while (run.some_search()) run.template find<Round::contacts>();
  }
}

// Whether `is` holds for any of `count`. All threads of the block must call it.
template <class Is>
PD_DEVICE bool some_of(int count, const Is& is) {
  bool some = false;
  for (int n = threadIdx.x; n < count; n += blockDim.x) some = some || is(n);
  return __syncthreads_or(some);
}

// `to`: PartSums
template <Round What, class T, bool HasContacts>
PD_DEVICE_COLD void sum_part(const Correction<T, HasContacts>& of, const DevicePlan<T>& plan,
                             Part part, const Piece& piece, double* to) {
  using S = RigidSums;
  const Vertices<T, HasContacts> v = of.v;
  const auto wide = [](const Quad<T>& a) { return widened<double>(vec3(a)); };
  const auto at = [&](int i) { return wide(v.x[i]) + wide(v.u[i]); };
  const auto sum_mean = [&] {
    double sum[S::target_offset] = {};
    part.each([&](int i, int) { add_mean(sum, double(v.inertia(i)), at(i)); });
    return write_shares(sum, to + S::weight);
  };
  if constexpr (What == Round::mean) {
    sum_mean();
  } else if constexpr (What == Round::moments) {
    double mean[S::target_offset];
    const bool whole = has_whole_parts(plan);
    const double own = whole ? sum_mean() : 0;
    for (int n = 0; n < S::target_offset; ++n)
      mean[n] = whole ? __shfl_sync(full_warp, own, n) : piece.sum[n];
    const Vec3<double> center = center_of(mean);
    double sum[S::pins - S::target_offset] = {}, held[S::count - S::pins] = {};
    part.each([&](int i, int) {
      const Vec3<T> target_offset = vec3(v.target[i]) - vec3(v.u[i]);
      add_moments(sum, double(v.inertia(i)), at(i) - center, widened<double>(target_offset));
    });
    write_shares(sum, to + S::target_offset);
    if (plan.pins == 0) return;
    part.each([&](int i, int) { add_pin(held, double(v.inertia(i)), at(i) - center); });
    write_shares(held, to + S::pins);
  } else if constexpr (What == Round::contacts) {
    if (piece.body.is_done()) return;
    double sum[ContactSums::count] = {};
    const CoarseTrial<double> trial = piece.body.trial();
    part.each([&](int i, int vertex) {
      add_contacts(sum, of.contacts, coarse_vertex(v.at(i), vec3(v.u[i])), trial,
                   of.forces.at(vertex));
    });
    write_shares(sum, to);
  } else {
    double sum[1] = {};
    part.each([&](int i, int vertex) {
      sum[0] += of.rise_of(i, vertex, piece.motion_before, piece.body.motion());
    });
    write_shares(sum, to);
  }
}

// Value n of a part from `from` [parts, PartSums::count]. It bypasses the L1 cache, which may not
// hold the writes of other blocks.
template <class T>
PD_DEVICE double read_part(const DevicePlan<T>& plan, const double* from, int at, int n) {
  return __ldcg(from + PartSums::count * plan.piece_part[at] + n);
}

// Lane n gets value n summed over many parts; each lane reads every 32nd part.
template <int Count, class T>
PD_DEVICE_COLD double sum_over_many_parts(const DevicePlan<T>& plan, int begin, int end,
                                          const double* from) {
  double part[Count] = {};
  for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size) {
    for (int n = 0; n < Count; ++n) part[n] += read_part(plan, from, at, n);
  }
  return share_out(part);
}

// Sums Count values from `first` on over the parts of a piece, into memory that all lanes can read.
// Broadcasts one by one would take longer. With few parts, each lane sums one value over all of them.
template <int Count, class T>
PD_DEVICE void sum_over_parts(const DevicePlan<T>& plan, int piece, const double* part_sum,
                              int first, double* total) {
  constexpr int few = 16;
  const int lane = int(threadIdx.x) % warp_size;
  const int begin = plan.piece_start[piece], end = plan.piece_start[piece + 1];
  const double* from = part_sum + first;
  double own = 0;
  if (end - begin <= few) {
    for (int at = begin; at < end && lane < Count; ++at) own += read_part(plan, from, at, lane);
  } else {
    own = sum_over_many_parts<Count>(plan, begin, end, from);
  }
  if (lane < Count) total[lane] = own;
  __syncwarp();
}

// A body that all lanes change alike: each on its own copy.
template <class Change>
PD_DEVICE void of_the_warp(CoarseBody& body, const Change& change) {
  CoarseBody copy = body;
  change(copy);
  __syncwarp();
  if (threadIdx.x % warp_size == 0) body = copy;
  __syncwarp();
}

// `part_sum`: [parts, PartSums::count]. A warp for a piece. `early`: before the iterations.
template <Round What, class T>
PD_DEVICE_COLD void move_piece(const DevicePlan<T>& plan, int piece, bool has_contacts, bool early,
                               const double* part_sum, Piece& to) {
  using S = RigidSums;
  const bool leader = threadIdx.x % warp_size == 0;
  if constexpr (What == Round::mean) {
    sum_over_parts<S::target_offset>(plan, piece, part_sum, 0, to.sum);
  } else if constexpr (What == Round::moments) {
    constexpr int moments = S::pins - S::target_offset, pins = S::count - S::pins;
    if (has_whole_parts(plan)) sum_over_parts<S::target_offset>(plan, piece, part_sum, 0, to.sum);
    sum_over_parts<moments>(plan, piece, part_sum, S::target_offset, to.sum + S::target_offset);
    if (plan.pins > 0) sum_over_parts<pins>(plan, piece, part_sum, S::pins, to.sum + S::pins);
    if (leader) {
      for (int n = S::pins; n < S::count && plan.pins == 0; ++n) to.sum[n] = 0;
      to.reached = to.body.reached();
      to.motion_before = to.body.motion();
      to.body = CoarseBody(RigidBody(to.sum), early);
    }
    __syncwarp();
    if (!has_contacts) of_the_warp(to.body, [](CoarseBody& body) { body.move_free<WarpTerms>(); });
  } else if constexpr (What == Round::contacts) {
    if (to.body.is_done()) return;
    sum_over_parts<ContactSums::count>(plan, piece, part_sum, 0, to.contact);
    of_the_warp(to.body, [&](CoarseBody& body) { body.pass<WarpTerms>(to.contact); });
  } else {
    sum_over_parts<1>(plan, piece, part_sum, 0, &to.rise);
    if (leader)
      to.rise = piece < plan.solid_pieces ? to.rise + (to.body.reached() - to.reached) : -1;
  }
}

}  // namespace pd::inline PD_TARGET
