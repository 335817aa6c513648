// The rounds of the coarse correction of solver/coarse: sums over parts of pieces, a warp a part, and of these up a tree, a
// warp a sum; then a thread decides for a piece.
#pragma once
#include "cuda/common/reductions.h"
#include "cuda/rigid/contact_forces.h"

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

// Whether the corrected guess follows the corrected present shape, and the one of less energy is kept.
template <class T>
PD_DEVICE bool has_choice(const DevicePlan<T>& plan, Iterate from) {
  return from == Iterate::guess && plan.solid_pieces > 0;
}

// Rows of sums: of parts, and of sums of rows.
template <class T>
PD_HD std::int64_t count_rows(const DevicePlan<T>& plan) {
  return std::int64_t(plan.parts) + plan.sums;
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

  PD_DEVICE int vertex_of(int at) const { return vertex[slot[at]]; }
  PD_DEVICE int place_of(int at) const { return first + (by_vertex ? vertex_of(at) : slot[at]); }

  // calls visit(place, vertex) on one lane each
  template <class Visit>
  PD_DEVICE void each(const Visit& visit) const {
    for (int at = begin + int(threadIdx.x) % warp_size; at < end; at += warp_size)
      visit(place_of(at), vertex_of(at));
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

// The numbers that a round sums, in their order in PartSums.
struct RowNumbers {
  int begin, end;

  template <class T>
  PD_DEVICE RowNumbers(Round what, const DevicePlan<T>& plan)
      : begin(what == Round::moments && !has_whole_parts(plan) ? RigidSums::target_offset : 0),
        end(what == Round::mean       ? RigidSums::target_offset
            : what == Round::moments  ? RigidSums::count
            : what == Round::contacts ? ContactSums::count
                                      : 1) {}
  PD_DEVICE bool has(int n) const { return begin <= n && n < end; }
};

// Lane n gets the sum of number n over rows. It bypasses the L1 cache, which may not hold the writes
// of other blocks.
PD_DEVICE double sum_over_rows(RowNumbers numbers, const double* row, int begin, int end) {
  const int lane = int(threadIdx.x) % warp_size;
  double own = 0;
#pragma unroll 8
  for (int at = begin; at < end; ++at) {
    if (numbers.has(lane)) own += __ldcg(row + std::int64_t(at) * PartSums::count + lane);
  }
  return own;
}

// Sum n of a tree. `row`: [count_rows, PartSums::count]
template <Round What, class T>
PD_DEVICE void sum_rows(const DevicePlan<T>& plan, int n, double* row) {
  const RowNumbers numbers(What, plan);
  const int lane = int(threadIdx.x) % warp_size;
  const double own = sum_over_rows(numbers, row, plan.sum_rows[2 * n], plan.sum_rows[2 * n + 1]);
  if (numbers.has(lane)) row[(std::int64_t(plan.parts) + n) * PartSums::count + lane] = own;
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

// Calls add(whether a contact adds anything, what it adds) for every contact of a vertex of the part.
template <class T, bool HasContacts, class Add>
PD_DEVICE void each_term_of(const Correction<T, HasContacts>& of, const Part& part, int at,
                            const CoarseTrial<double>& trial, const Add& add) {
  const int i = part.place_of(at);
  each_contact_term(of.contacts, coarse_vertex(of.v.at(i), vec3(of.v.u[i])), trial,
                    of.forces.at(part.vertex_of(at)), add);
}

// Lane n gets the sum of number n of ContactSums over `count` vertices of a part, at most one a lane.
template <class T, bool HasContacts>
PD_DEVICE_COLD double sum_terms(const Correction<T, HasContacts>& of, const Part& part,
                                const CoarseBody& body, const int* at, int count) {
  const int lane = int(threadIdx.x) % warp_size;
  double own = 0;
  each_term_of(of, part, at[lane < count ? lane : 0], body.trial(),
               [&](bool adds, const auto& terms) {
                 adds = adds && lane < count;
                 if (!__any_sync(full_warp, adds)) return;
                 double sum[ContactSums::count] = {};
                 if (adds) add_terms(sum, terms());
                 own += share_out(sum);
               });
  return own;
}

// Few vertices touch something, anywhere in the part: they are queued until there is one for every lane. `to`: ContactSums;
// before, the queue.
template <class T, bool HasContacts>
PD_DEVICE void sum_contacts(const Correction<T, HasContacts>& of, const Part& part,
                            const CoarseBody& body, double* to) {
  static_assert(sizeof(double) * PartSums::count >= sizeof(int) * 2 * warp_size);
  const int lane = int(threadIdx.x) % warp_size;
  int* const queue = reinterpret_cast<int*>(to);
  const CoarseTrial<double> trial = body.trial();
  double own = 0;
  int queued = 0;
  for (int begin = part.begin; begin < part.end + warp_size; begin += warp_size) {
    bool touches = false;
    if (begin + lane < part.end)
      each_term_of(of, part, begin + lane, trial,
                   [&](bool adds, const auto&) { touches = touches || adds; });
    const unsigned touching = __ballot_sync(full_warp, touches);
    if (touches) queue[queued + __popc(touching & ((1u << lane) - 1))] = begin + lane;
    queued += __popc(touching);
    __syncwarp();
    if (queued < (begin < part.end ? warp_size : 1)) continue;
    own += sum_terms(of, part, body, queue, queued);
    queued -= warp_size;
    __syncwarp();
    if (lane < queued) queue[lane] = queue[warp_size + lane];
    __syncwarp();
  }
  if (lane < ContactSums::count) to[lane] = own;
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
    if (plan.pins > 0) part.each([&](int i, int) { add_pin(held, double(v.inertia(i)), at(i)); });
    write_shares(held, to + S::pins);
  } else if constexpr (What == Round::contacts) {
    if (!piece.body.is_done()) sum_contacts(of, part, piece.body, to);
  } else {
    double sum[1] = {};
    part.each([&](int i, int vertex) {
      sum[0] += of.rise_of(i, vertex, piece.motion_before, piece.body.motion());
    });
    write_shares(sum, to);
  }
}

// Sums over a piece, by a warp. `row`: [count_rows, PartSums::count]
template <Round What, class T>
PD_DEVICE void sum_piece(const DevicePlan<T>& plan, int piece, const double* row, Piece& to) {
  const int lane = int(threadIdx.x) % warp_size;
  const RowNumbers numbers(What, plan);
  const int* of = plan.piece_rows + 2 * piece;
  const double own = sum_over_rows(numbers, row, of[0], of[1]);
  double* const total = What == Round::contacts ? to.contact
                        : What == Round::rises  ? &to.rise
                                                : to.sum;
  if (numbers.has(lane)) total[lane] = own;
}

// What follows from them, by a thread.
template <Round What, class T>
PD_DEVICE_COLD void move_piece(const DevicePlan<T>& plan, int piece, Iterate from,
                               bool has_contacts, Piece& of) {
  if constexpr (What == Round::moments) {
    if (has_choice(plan, from)) {
      of.reached = of.body.reached();
      of.motion_before = of.body.motion();
    }
    of.body = CoarseBody(RigidBody(of.sum));
    for (double& sum : of.contact) sum = 0;
    while (!has_contacts && !of.body.is_done()) of.body.pass(of.contact);
  } else if constexpr (What == Round::contacts) {
    if (!of.body.is_done()) of.body.pass(of.contact);
  } else if constexpr (What == Round::rises) {
    of.rise = piece < plan.solid_pieces ? of.rise + (of.body.reached() - of.reached) : -1;
  }
}

}  // namespace pd::inline PD_TARGET
