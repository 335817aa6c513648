// Members of SeveralRunner that move pieces as rigid bodies, see cuda/rigid.h.
#pragma once
#include "cuda/rigid.h"
#include "cuda/several.h"

namespace pd::inline PD_TARGET {

template <class T, bool Touching, bool Loose, bool Once, bool Lean>
struct SeveralRunner<T, Touching, Loose, Once, Lean>::Rounds {
  SeveralRunner& r;

  template <Rigid What>
  PD_DEVICE void find(const Aligning& how) {
    const int warp = int(threadIdx.x) / warp_size, warps = blockDim.x / warp_size;
    for (int n = warp; n < r.here_ * r.plan_.parts; n += warps) {
      const Seat at = r.seat_of(n, r.plan_.parts);
      const Part part(r.plan_, at.at, nullptr, at.environment * r.slots());
      const Piece<T>& piece = r.piece(at.environment, part.piece(r.plan_));
      sum_part<What>(r.v_, r.contacts(at.environment), r.set_, how, part, piece,
                     r.part_sums(at.environment) + PartSums::count * at.at);
    }
    __syncthreads();
    for (int n = warp; n < r.here_ * r.plan_.pieces; n += warps) {
      const Seat at = r.seat_of(n, r.plan_.pieces);
      move_piece<What>(r.plan_, at.at, r.contacts(at.environment), how, r.part_sums(at.environment),
                       r.piece(at.environment, at.at));
    }
    __syncthreads();
  }

  PD_DEVICE void begin_still() {
    r.each_slot([&](const Seat& seat, int i) {
      const int number = r.plan_.slot_piece[seat.at];
      if (number >= 0 && r.piece(seat.environment, number).still)
        r.v_.set(i, r.v_.at(i).still(r.contacts(seat.environment)));
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
      const Seat at = r.seat_of(n, r.plan_.pieces);
      return is(r.piece(at.environment, at.at));
    });
  }
};

template <class T, bool Touching, bool Loose, bool Once, bool Lean>
PD_DEVICE void SeveralRunner<T, Touching, Loose, Once, Lean>::move_pieces(bool first) {
  Aligning how(plan_, Touching, first);
  Rounds rounds{*this};
  do {
    find_in_rounds<Touching>(rounds, how, contacts(0).has_several());
    each_slot([&](const Seat& seat, int i) {
      const int number = plan_.slot_piece[seat.at];
      if (number < 0 || !(v_.u[i].w > 0)) return;  // of no piece, or pinned
      const Vec3<T> u = v_.moved(i, piece(seat.environment, number).motion);
      move(i, u);
      if (first) v_.set_before(i, u);
    });
    __syncthreads();
    how.go_on();
  } while (Touching && rounds.some_go_on(how.leg));
}

}  // namespace pd::inline PD_TARGET
