// The rigid motions of cuda/rigid/rounds.h for kernel `stream`, in one launch; a team of blocks works on
// one environment at a time.
#pragma once
#include "cuda/common/block_team.h"
#include "cuda/stream/kernels.h"

namespace pd::inline PD_TARGET {

constexpr int rounds_threads = 128;

template <class T>
struct RoundsCall {
  StreamCall<T> stream;
  Aligning how;
  int teams, blocks;  // blocks of a team
  unsigned* counter;  // [teams], zero at the launch
};

// A warp keeps its parts over all rounds, and a lane its vertices, so each lane reads its own
// writes without a barrier.
template <class T, bool HasContacts>
class StreamRounds {
 public:
  PD_DEVICE StreamRounds(const StreamWork<T, HasContacts>& w, BlockTeam& team)
      : w_(w), team_(team) {}

  PD_DEVICE void run(Aligning how) {
    do {
      find_in_rounds<HasContacts>(*this, how, w_.contacts.has_multiple());
      each_vertex([&](int i, const Piece<T>& piece) {
        if (!(w_.v.u[i].w > 0)) return;  // pinned
        const Vec3<T> u = w_.v.moved(i, piece.motion);
        w_.v.set(i, u);
        if (how.first) w_.v.set_before(i, u);
      });
      how.go_on();
    } while (HasContacts && some_piece([&](const Piece<T>& p) { return p.leg == how.leg; }));
    team_.barrier();  // blocks start an environment together
  }

  template <Rigid What>
  PD_DEVICE void find(const Aligning& how) {
    each_part([&](const Part& part, int n) {
      sum_part<What>(w_.v, w_.contacts, w_.settings(), how, part, w_.piece(part.piece(w_.plan)),
                     w_.part_sums() + PartSums::count * n);
    });
    team_.barrier();
    for (int n = team_.warp(); n < w_.plan.pieces; n += team_.warps())
      move_piece<What>(w_.plan, n, w_.contacts, how, w_.part_sums(), w_.piece(n));
    team_.barrier();
  }

  PD_DEVICE void begin_still() {
    each_vertex([&](int i, const Piece<T>& piece) {
      if (piece.still) w_.v.set(i, w_.v.at(i).current_iterate(w_.contacts));
    });
  }

  PD_DEVICE bool some_tip() const {
    return some_piece([](const Piece<T>& p) { return p.tipping.goes_on(); });
  }

 private:
  // The same in every block of the team: pieces change only after the next team barrier.
  template <class Is>
  PD_DEVICE bool some_piece(const Is& is) const {
    return some_of(w_.plan.pieces, [&](int n) { return is(w_.piece(n)); });
  }

  template <class Visit>
  PD_DEVICE void each_part(const Visit& visit) const {
    for (int n = team_.warp(); n < w_.plan.parts; n += team_.warps())
      visit(Part(w_.plan, n, w_.plan.slot_vertex, 0), n);
  }

  template <class Visit>
  PD_DEVICE void each_vertex(const Visit& visit) const {
    each_part([&](const Part& part, int) {
      const Piece<T>& piece = w_.piece(part.piece(w_.plan));
      part.each([&](int i) { visit(i, piece); });
    });
  }

  const StreamWork<T, HasContacts>& w_;
  BlockTeam& team_;
};

template <class T, bool HasContacts>
__global__ void __launch_bounds__(rounds_threads)
    stream_rounds(const __grid_constant__ RoundsCall<T> call) {
  const int number = int(blockIdx.x) / call.blocks;
  BlockTeam team(int(blockIdx.x) % call.blocks, call.blocks, call.counter + number);
  for (std::int64_t e = number; e < call.stream.step.batch; e += call.teams) {
    const StreamWork<T, HasContacts> w(call.stream, e);
    StreamRounds<T, HasContacts>(w, team).run(call.how);
  }
}

}  // namespace pd::inline PD_TARGET
