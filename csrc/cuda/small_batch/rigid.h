// Members of SmallBatchRunner for the coarse correction, see cuda/rigid/rounds.h.
#pragma once
#include "cuda/rigid/rounds.h"
#include "cuda/small_batch/runner.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
struct SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread, FewRegisters>::Rounds {
  SmallBatchRunner& r;
  Iterate from;

  template <Round What>
  PD_DEVICE void find() {
    const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
    for (int n = warp; n < r.here_ * r.plan_.parts; n += warps) {
      const WorkItem item = r.item_of(n, r.plan_.parts);
      const Part part(r.plan_, item.at, false, item.environment * r.slots());
      const Piece& piece = r.piece(item.environment, part.piece(r.plan_));
      sum_part<What>(r.correction(item.environment, from), r.plan_, part, piece,
                     r.part_sums(item.environment) + PartSums::count * r.plan_.part_row[item.at]);
    }
    __syncthreads();
    for (int level = 0; level < r.plan_.sum_levels; ++level) {
      const int first = r.plan_.level_sum[level], sums = r.plan_.level_sum[level + 1] - first;
      for (int n = warp; n < r.here_ * sums; n += warps) {
        const WorkItem item = r.item_of(n, sums);
        sum_rows<What>(r.plan_, first + item.at, r.part_sums(item.environment));
      }
      __syncthreads();
    }
    for (int n = warp; n < r.here_ * r.plan_.pieces; n += warps) {
      const WorkItem item = r.item_of(n, r.plan_.pieces);
      sum_piece<What>(r.plan_, item.at, r.part_sums(item.environment),
                      r.piece(item.environment, item.at));
    }
    __syncthreads();
    for (int n = threadIdx.x; n < r.here_ * r.plan_.pieces; n += blockDim.x) {
      const WorkItem item = r.item_of(n, r.plan_.pieces);
      move_piece<What>(r.plan_, item.at, from, HasContacts, r.piece(item.environment, item.at));
    }
    __syncthreads();
  }

  PD_DEVICE bool some_search() const {
    return some_of(r.here_ * r.plan_.pieces, [&](int n) {
      const WorkItem item = r.item_of(n, r.plan_.pieces);
      return !r.piece(item.environment, item.at).body.is_done();
    });
  }
};

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
PD_DEVICE void SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread,
                                FewRegisters>::correct_pieces(bool first) {
  prefetch_pair(first_pair_);
  const bool both = first && plan_.solid_pieces > 0;
  if (both) {
    each_slot_of_a_piece([&](const WorkItem& item, int i, const Piece&) {
      move(i, correction(item.environment, Iterate::present).present(i));
    });
  }
#pragma unroll 1
  for (int n = both ? 0 : 1; n < 2; ++n) {
    const Iterate from = iterate_of(n, first);
    if (HasContacts || first) keep_forces(from);
    Rounds rounds{*this, from};
    find_motions<HasContacts>(plan_, rounds);
    each_slot_of_a_piece([&](const WorkItem& item, int i, const Piece& piece) {
      move(i, correction(item.environment, from).corrected(i, item.at, piece.body));
    });
    if (!has_choice(plan_, from)) continue;
    rounds.template find<Round::rises>();
    each_slot_of_a_piece([&](const WorkItem& item, int i, const Piece& piece) {
      move(i, correction(item.environment, from).chosen(i, piece.body, piece.rise));
    });
  }
}

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
template <class Visit>
PD_DEVICE void SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread,
                                FewRegisters>::each_slot_of_a_piece(const Visit& visit) {
  each_slot([&](const WorkItem& item, int i) {
    const int number = plan_.slot_piece[item.at];
    // pins hold others
    if (number >= 0 && v_.u[i].w > 0) visit(item, i, piece(item.environment, number));
  });
  __syncthreads();
}

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
PD_DEVICE void SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread,
                                FewRegisters>::keep_forces(Iterate from) {
  each_pair<false>(SolidGradient<false>{});
  __syncthreads();
  each_slot([&](const WorkItem& item, int i) {
    if (plan_.slot_piece[item.at] < 0) return;
    correction(item.environment, from).keep_forces(i, item.at, force_on(item));
  });
  __syncthreads();
}

}  // namespace pd::inline PD_TARGET
