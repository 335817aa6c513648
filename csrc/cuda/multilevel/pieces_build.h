// Makes the coarse space of solver/multilevel/pieces.h at an iterate, by a team of blocks; see also
// cpu/multilevel/pieces_build.h.
#pragma once
#include "cuda/elements/tet_per_lane.h"
#include "cuda/multilevel/block_sweeps.h"
#include "cuda/multilevel/piece_sums.h"

namespace pd::inline PD_TARGET {

template <class T>
class PiecesMaker {
 public:
  // `scale`: the material is that of A times this at most
  PD_DEVICE PiecesMaker(const PiecesInput<T>& in, PiecesControl<T>& control, BlockTeam& team,
                        double* scratch, double scale)
      : levels_(control.plan.levels),
        scratch_(scratch + piece_scratch_numbers * (threadIdx.x / warp_size)),
        scale_(scale),
        in_(in),
        m_(control.memory),
        team_(team),
        c_(control),
        sums_(control.plan, in, control.memory),
        sweeps_(levels_.pieces, control.memory, team, control) {}

  // `keeps`: contacts may hold vertices later
  PD_DEVICE void make(bool keeps) const {
    each_task(levels_.piece_row_start[levels_.pieces], [&](int t) { sums_.add_centre(t); });
    const Vec3<T> middle = find_centres();
    for (int i = team_.thread(); i < levels_.vertices; i += team_.threads()) {
      const bool moves = in_.u[i].w > T(0);
      const Vec3<T> arm = (vec3(in_.x[i]) - middle) + vec3(in_.iterate[i]);
      m_.arm[i] = moves ? quad(arm, T(1)) : Quad<T>{T(0), T(0), T(0), T(0)};
    }
    team_.barrier();
    const int pairs = piece_pair(levels_.pieces, 0);
    each_task(levels_.piece_tet_start[pairs], [&](int t) { sums_.add_strains(t); }, false);
    each_task(levels_.piece_row_start[pairs], [&](int t) { sums_.add_moments(t); });
    each_task(pairs, [&](int t) { assemble(TriangleBlock(t, levels_.pieces)); });
    scale_blocks(keeps);
    const bool sound = sweeps_.invert(2);
    if (threadIdx.x == 0) {
      c_.sound = sound;
      c_.held = false;
    }
    __syncthreads();
  }

  // Contacts hold vertices in the directions that they do not leave `free`; the others move on, against A.
  PD_DEVICE void hold(const Mat3<T>* free) const {
    if (!c_.sound) return;
    const int pairs = piece_pair(levels_.pieces, 0);
    each_task(levels_.piece_row_start[pairs], [&](int t) { sums_.add_springs(t, free, scale_); });
    each_task(levels_.pieces, [&](int piece) { add_diagonal(piece); });
    bool some = false;
    for (int n = threadIdx.x; n < piece_modes * levels_.pieces; n += blockDim.x)
      some = some || m_.mode[n] != 0;
    const bool held = __syncthreads_or(some);
    // as it was
    if (!held && !c_.held) return;
    set_energy(held);
    const bool sound = sweeps_.invert(1);
    if (!sound) {
      team_.barrier();
      set_energy(false);
      sweeps_.invert(1);
    }
    if (threadIdx.x == 0) c_.held = held && sound;
    __syncthreads();
  }

 private:
  // visit(task) by a warp each; `last`: then a barrier of the team
  template <class Visit>
  PD_DEVICE void each_task(int count, const Visit& visit, bool last = true) const {
#pragma unroll 1
    for (int t = team_.warp(); t < count; t += team_.warps()) visit(t);
    if (last) team_.barrier();
  }

  // The mean of each piece, by weight, from the middle, which it returns: the mean of all. In every block.
  PD_DEVICE Vec3<T> find_centres() const {
    double* sum = c_.product[0];  // [pieces, centre_sums]
    static_assert(centre_sums * most_pieces * sizeof(double) <= sizeof(c_.product));
    const int count = centre_sums * levels_.pieces;
    for (int n = threadIdx.x; n < count; n += blockDim.x) {
      const int piece = n / centre_sums;
      double total = 0;
#pragma unroll 4
      for (int t = levels_.piece_row_start[piece]; t < levels_.piece_row_start[piece + 1]; ++t)
        total += m_.row_sums[std::int64_t(t) * piece_block + n % centre_sums];
      sum[n] = total;
    }
    __syncthreads();
    double all[4] = {0, 0, 0, 0};
    for (int p = 0; p < levels_.pieces; ++p) {
      for (int c = 0; c < 4; ++c) all[c] += sum[centre_sums * p + c];
    }
    const double share = all[0] > 0 ? 1 / all[0] : 0;
    const Vec3<T> middle = {T(share * all[1]), T(share * all[2]), T(share * all[3])};
    if (int(threadIdx.x) < levels_.pieces) {
      const double* own = sum + centre_sums * threadIdx.x;
      const double each = own[0] > 0 ? 1 / own[0] : 0;
      const auto from = [&](int c, T at) { return T(own[0] > 0 ? each * own[c] - double(at) : 0); };
      m_.centre[threadIdx.x] = {from(4, middle.x), from(5, middle.y), from(6, middle.z), T(0)};
    }
    __syncthreads();
    return middle;
  }

  // Number n of the tasks of a pair, added up.
  PD_DEVICE double add_up(const double* sums, const int32* start, int row, int column,
                          int n) const {
    const int pair = piece_list(levels_.pieces, row, column);
    double sum = 0;
#pragma unroll 4
    for (int t = start[pair]; t < start[pair + 1]; ++t)
      sum += sums[std::int64_t(t) * piece_block + n];
    return sum;
  }

  // An entry of a block; a symmetric one has but its lower triangle.
  PD_DEVICE static int place(const TriangleBlock& at, int e) {
    const int i = e / piece_modes, j = e % piece_modes;
    return at.row == at.column && i < j ? piece_modes * j + i : e;
  }

  // Blocks of Ac and Hc, and the scale. Called by a warp.
  PD_DEVICE void assemble(const TriangleBlock& at) const {
    using Moments = double[4][4];
    const int lane = threadIdx.x % warp_size;
    auto* k = reinterpret_cast<Moments*>(scratch_);
    scratch_[lane] = add_up(m_.row_sums, levels_.piece_row_start, at.row, at.column, lane);
    __syncwarp();
    for (int e = lane; e < piece_block; e += warp_size) {
      const int from = place(at, e), i = from / piece_modes, j = from % piece_modes;
      const std::int64_t to = std::int64_t(at.pair()) * piece_block + e;
      const double matrix = rigid_entry(k[0], i, j);
      m_.block[1][to] = matrix;
      m_.block[0][to] = rigid_entry(k[1], i, j) +
                        add_up(m_.strains, levels_.piece_tet_start, at.row, at.column, from);
      if (at.row == at.column && i == e % piece_modes && i == j)
        m_.scale[piece_modes * at.row + i] =
            mode_scale<T>(i, matrix, k[0][0][0], widened(m_.centre[at.row]));
    }
    __syncwarp();
  }

  // visit(matrix, block, entry) for this thread's entries
  template <class Visit>
  PD_DEVICE void each_entry(int matrices, const Visit& visit) const {
    const int count = piece_pair(levels_.pieces, 0) * piece_block;
#pragma unroll 1
    for (int t = team_.thread(); t < matrices * count; t += team_.threads())
      visit(t / count, TriangleBlock(t % count / piece_block, levels_.pieces), t % piece_block);
    team_.barrier();
  }

  // 1 / sqrt(Ac_ii) of the row of an entry, times that of its column
  PD_DEVICE double scale_of(const TriangleBlock& at, int e) const {
    return m_.scale[piece_modes * at.row + e / piece_modes] *
           m_.scale[piece_modes * at.column + e % piece_modes];
  }

  PD_DEVICE void store(int matrix, const TriangleBlock& at, int e, double value) const {
    m_.block[matrix][std::int64_t(at.pair()) * piece_block + e] = value;
    if (at.column == 0) sweeps_.panel(0, matrix)[std::int64_t(at.row) * piece_block + e] = value;
  }

  // Both matrices in the scale of Ac; one where a mode moves nothing.
  PD_DEVICE void scale_blocks(bool keeps) const {
    each_entry(2, [&](int matrix, const TriangleBlock& at, int e) {
      const std::int64_t from = std::int64_t(at.pair()) * piece_block + e;
      const double scale = scale_of(at, e);
      double value = m_.block[matrix][from] * scale;
      if (at.row == at.column && e / piece_modes == e % piece_modes)
        value = scale > 0 ? value + (matrix == 0 ? scale_ : 1.0) * piece_noise<T>() : 1;
      store(matrix, at, e, value);
      if (keeps && matrix == 0) m_.unheld[from] = value;
    });
  }

  // What contacts add to the diagonal of Hc. Called by a warp.
  PD_DEVICE void add_diagonal(int piece) const {
    const int mode = int(threadIdx.x) % warp_size;
    if (mode < piece_modes)
      m_.mode[piece_modes * piece + mode] =
          add_up(m_.row_sums, levels_.piece_row_start, piece, piece, (piece_modes + 1) * mode);
  }

  // Hc in the scale of Ac, with the contacts or without.
  PD_DEVICE void set_energy(bool held) const {
    each_entry(1, [&](int, const TriangleBlock& at, int e) {
      double value = m_.unheld[std::int64_t(at.pair()) * piece_block + e];
      if (held)
        value += scale_of(at, e) *
                 add_up(m_.row_sums, levels_.piece_row_start, at.row, at.column, place(at, e));
      store(0, at, e, value);
    });
  }

  const Levels<T>& levels_;
  double* scratch_;  // of this warp, in shared memory
  double scale_;
  const PiecesInput<T>& in_;
  const PiecesMemory<T>& m_;
  BlockTeam& team_;
  PiecesControl<T>& c_;
  PieceSums<T> sums_;
  BlockSweeps<T> sweeps_;
};

// Out of line, so that the iterations keep their registers. All inputs are values or in shared memory, since kernel
// parameters are slow to read here. Returns the team's state.
template <class T>
__device__ __noinline__ BlockTeam make_pieces(PiecesInput<T> in, PiecesControl<T>& control,
                                              BlockTeam team, double* scratch, double scale,
                                              bool keeps) {
  PiecesMaker<T>(in, control, team, scratch, scale).make(keeps);
  return team;
}

// The same with contacts.
template <class T>
__device__ __noinline__ BlockTeam hold_pieces(PiecesInput<T> in, const Mat3<T>* free,
                                              PiecesControl<T>& control, BlockTeam team,
                                              double* scratch, double scale) {
  PiecesMaker<T>(in, control, team, scratch, scale).hold(free);
  return team;
}

}  // namespace pd::inline PD_TARGET
