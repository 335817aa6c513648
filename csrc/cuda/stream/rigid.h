// The rounds of cuda/rigid/rounds.h for kernel `stream`, in one launch; a team of blocks works on one
// environment at a time.
#pragma once
#include "cuda/common/block_team.h"
#include "cuda/stream/kernels.h"

namespace pd::inline PD_TARGET {

constexpr int rounds_threads = 128;

template <class T>
struct RoundsCall {
  StreamCall<T> stream;
  Iterate from;
  int teams, blocks;  // blocks of a team
  unsigned* counter;  // [teams], zero at the launch
};

// A warp keeps its parts over all rounds, and a lane its vertices, so each lane reads its own
// writes without a barrier.
template <class T, bool HasContacts>
class StreamRounds {
 public:
  PD_DEVICE StreamRounds(const StreamWork<T, HasContacts>& w, Iterate from, BlockTeam& team)
      : w_(w), of_(w.correction(from)), team_(team) {}

  PD_DEVICE void run() {
    find_motions<HasContacts>(w_.plan, *this);
    each_vertex([&](int i, const Piece& piece) { w_.v.set(i, of_.corrected(i, i, piece.body)); });
    if (has_choice(w_.plan, of_.from)) {
      find<Round::rises>();
      each_vertex(
          [&](int i, const Piece& piece) { w_.v.set(i, of_.chosen(i, piece.body, piece.rise)); });
    }
    team_.barrier();  // blocks start an environment together
  }

  template <Round What>
  PD_DEVICE void find() {
    each_part([&](const Part& part, int n) {
      sum_part<What>(of_, w_.plan, part, w_.piece(part.piece(w_.plan)),
                     w_.part_sums() + std::int64_t(w_.plan.part_row[n]) * PartSums::count);
    });
    team_.barrier();
    for (int level = 0; level < w_.plan.sum_levels; ++level) {
      const int first = w_.plan.level_sum[level] + team_.warp();
      for (int n = first; n < w_.plan.level_sum[level + 1]; n += team_.warps())
        sum_rows<What>(w_.plan, n, w_.part_sums());
      team_.barrier();
    }
    for (int n = team_.warp(); n < w_.plan.pieces; n += team_.warps()) {
      sum_piece<What>(w_.plan, n, w_.part_sums(), w_.piece(n));
      __syncwarp();
      if (threadIdx.x % warp_size == 0)
        move_piece<What>(w_.plan, n, of_.from, HasContacts, w_.piece(n));
    }
    team_.barrier();
  }

  // The same in every block of the team: pieces change only after the next team barrier.
  PD_DEVICE bool some_search() const {
    return some_of(w_.plan.pieces, [&](int n) { return !w_.piece(n).body.is_done(); });
  }

 private:
  template <class Visit>
  PD_DEVICE void each_part(const Visit& visit) const {
    for (int n = team_.warp(); n < w_.plan.parts; n += team_.warps())
      visit(Part(w_.plan, n, true, 0), n);
  }

  template <class Visit>
  PD_DEVICE void each_vertex(const Visit& visit) const {
    each_part([&](const Part& part, int) {
      const Piece& piece = w_.piece(part.piece(w_.plan));
      part.each([&](int i, int) {
        if (w_.v.u[i].w > 0) visit(i, piece);  // pins hold others
      });
    });
  }

  const StreamWork<T, HasContacts>& w_;
  const Correction<T, HasContacts> of_;
  BlockTeam& team_;
};

template <class T, bool HasContacts>
__global__ void __launch_bounds__(rounds_threads)
    stream_rounds(const __grid_constant__ RoundsCall<T> call) {
  const int number = int(blockIdx.x) / call.blocks;
  BlockTeam team(int(blockIdx.x) % call.blocks, call.blocks, call.counter + number);
  for (std::int64_t e = number; e < call.stream.step.batch; e += call.teams) {
    if (call.stream.skipped && call.stream.skipped[e]) continue;
    const StreamWork<T, HasContacts> w(call.stream, e);
    StreamRounds<T, HasContacts>(w, call.from, team).run();
  }
}

// Moves the vertices of pieces to the present shape, one warp per part.
template <class T, bool HasContacts>
__global__ void __launch_bounds__(rounds_threads)
    stream_present(const __grid_constant__ StreamCall<T> call) {
  const std::int64_t number = thread_number() / warp_size, parts = call.step.plan.parts;
  if (number >= call.step.batch * parts) return;
  const StreamWork<T, HasContacts> w(call, number / parts);
  const auto present = w.correction(Iterate::present);
  Part(w.plan, int(number % parts), true, 0).each([&](int i, int) {
    w.v.set(i, present.present(i));
  });
}

}  // namespace pd::inline PD_TARGET
