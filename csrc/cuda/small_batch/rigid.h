// Members of SmallBatchRunner that move pieces as rigid bodies, see cuda/rigid/rounds.h.
#pragma once
#include "cuda/rigid/rounds.h"
#include "cuda/small_batch/runner.h"

namespace pd::inline PD_TARGET {

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
struct SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread, FewRegisters>::Rounds {
  SmallBatchRunner& r;

  template <Rigid What>
  PD_DEVICE void find(const Aligning& how) {
    const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
    for (int n = warp; n < r.here_ * r.plan_.parts; n += warps) {
      const WorkItem item = r.item_of(n, r.plan_.parts);
      const Part part(r.plan_, item.at, nullptr, item.environment * r.slots());
      const Piece<T>& piece = r.piece(item.environment, part.piece(r.plan_));
      sum_part<What>(r.v_, r.contacts(item.environment), r.set_, how, part, piece,
                     r.part_sums(item.environment) + PartSums::count * item.at);
    }
    __syncthreads();
    for (int n = warp; n < r.here_ * r.plan_.pieces; n += warps) {
      const WorkItem item = r.item_of(n, r.plan_.pieces);
      move_piece<What>(r.plan_, item.at, r.contacts(item.environment), how,
                       r.part_sums(item.environment), r.piece(item.environment, item.at));
    }
    __syncthreads();
  }

  PD_DEVICE void begin_still() {
    r.each_slot([&](const WorkItem& item, int i) {
      const int number = r.plan_.slot_piece[item.at];
      if (number >= 0 && r.piece(item.environment, number).still)
        r.v_.set(i, r.v_.at(i).current_iterate(r.contacts(item.environment)));
    });
    __syncthreads();
  }

  PD_DEVICE bool some_tip() const {
    return some_piece([](const Piece<T>& p) { return p.tipping.goes_on(); });
  }

  PD_DEVICE bool some_go_on(int leg) const {
    return some_piece([&](const Piece<T>& p) { return p.leg == leg; });
  }

 private:
  template <class Is>
  PD_DEVICE bool some_piece(const Is& is) const {
    return some_of(r.here_ * r.plan_.pieces, [&](int n) {
      const WorkItem item = r.item_of(n, r.plan_.pieces);
      return is(r.piece(item.environment, item.at));
    });
  }
};

template <class T, bool HasContacts, bool HasFreePieces, bool OnePerThread, bool FewRegisters>
PD_DEVICE void SmallBatchRunner<T, HasContacts, HasFreePieces, OnePerThread,
                                FewRegisters>::move_pieces(bool first) {
  Aligning how(plan_, HasContacts, first);
  Rounds rounds{*this};
  do {
    find_in_rounds<HasContacts>(rounds, how, contacts(0).has_multiple());
    each_slot([&](const WorkItem& item, int i) {
      const int number = plan_.slot_piece[item.at];
      if (number < 0 || !(v_.u[i].w > 0)) return;  // of no free piece, or pinned
      const Vec3<T> u = v_.moved(i, piece(item.environment, number).motion);
      move(i, u);
      if (first) v_.set_before(i, u);
    });
    __syncthreads();
    how.go_on();
  } while (HasContacts && rounds.some_go_on(how.leg));
}

}  // namespace pd::inline PD_TARGET
