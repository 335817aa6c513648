// Hc of the elements for the coarse space of solver/multilevel/pieces.h: one environment, whichever way lanes run elsewhere.
#pragma once
#include "cpu/multilevel/pieces_workspace.h"
#include "cpu/multilevel/stencil_hessians.h"
#include "elements/solid.h"

namespace pd::inline PD_TARGET {

// Adds what the pieces of a patch have in common, pack by pack. A pack has the pieces of all its lanes; weights are zero elsewhere.
// Tetrahedra that the same pieces move share their packs.
template <class T, class Work>
class PieceElements {
  using R = Pack<T, native_width<T>>;
  using Slots = typename Work::Slots;
  using Block = typename Work::Block;

 public:
  PieceElements(const Plan<T>& plan, const Work& work, const Slots& slots,
                const ElementWeights<T>& weights, T* numbers, bool dissipates_too,
                const StencilHessians<T>* kept)
      : plan_(plan),
        work_(work),
        slots_(slots),
        weights_(weights),
        numbers_(numbers),
        dissipates_too_(dissipates_too),
        kept_(kept) {}

  // `position(slot)`: relative to the patch; `shift_of(piece)`: of that to the centre of a piece;
  // `moves(vertex)`: whether no pin holds it
  template <class Position, class Shift, class Moves>
  void add(int patch, const Position& position, const Shift& shift_of, const Moves& moves) {
    mask_ = work_.patches.mask[patch];
    read_slots(patch, position, moves);
    each_piece(mask_, [&](int rank, int piece) { shift_[rank] = shift_of(piece); });
    const int pairs = piece_pair(count_pieces(mask_), 0);
    for (int n = 0; n < pairs * piece_block; ++n) slots_.sums[n] = R(T(0));
    const Quad<T>* const fields[1] = {slots_.position.begin()};
    for (int pack = work_.first_pack[patch]; pack < work_.first_pack[patch + 1]; ++pack) {
      const int32* tets = plan_.levels.piece_pack_tet + std::int64_t(pack) * block_lanes;
      for (int lane = 0; lane < block_lanes && tets[lane] >= 0; lane += R::width)
        add_tets(Tets(plan_, weights_, tets + lane));
    }
    if (plan_.stencil_blocks) {
      LaneSums<Single<T>> unused;
      each_stencil<Single<T>>(plan_, patch, [&](auto kind, const StencilPart<T>& part) {
        using Kind = decltype(kind);
        if (dissipates<Kind> && !dissipates_too_) return;
        add_stencils<Kind>(
            StencilsAcross<Kind, 1, Single<T>>{part, fields, numbers_, true, nullptr, unused});
      });
    }
    for (int n = 0; n < pairs * piece_block; ++n) {
      double sum = 0;
      for (int lane = 0; lane < R::width; ++lane) sum += double(slots_.sums[n].v[lane]);
      work_.strains[work_.patches.pair[patch] + n / piece_block].at[n % piece_block] = sum;
    }
  }

 private:
  template <class Position, class Moves>
  void read_slots(int patch, const Position& position, const Moves& moves) const {
    const int first = plan_.patch_slot[patch], count = plan_.patch_slot[patch + 1] - first;
    std::fill_n(slots_.weight.begin(), std::int64_t(count_pieces(mask_)) * plan_.most_slots, T(0));
    for (int slot = 0; slot < count; ++slot) {
      const int vertex = plan_.slot_vertex[first + slot];
      slots_.position[slot] = position(first + slot);
      slots_.mask[slot] = work_.vertex[vertex];
      if (!moves(vertex)) continue;
      Work::each_share(plan_.levels, vertex, [&](int, int piece, T weight) {
        slots_.weight[std::int64_t(rank_of(mask_, piece)) * plan_.most_slots + slot] = weight;
      });
    }
  }

  // The pieces of a pack, by their ranks in the patch.
  template <int Corners, class Part>
  int find_pieces(const Part& part) {
    PieceMask mask = 0;
    for (int c = 0; c < Corners; ++c) {
      const int16* corner = part.corner(c);
      for (int lane = 0; lane < R::width; ++lane) mask |= slots_.mask[corner[lane]];
    }
    each_piece(mask, [&](int n, int piece) { rank_[n] = rank_of(mask_, piece); });
    return count_pieces(mask);
  }

  template <int Corners, class Part>
  void read_piece(const Part& part, const Vec3<R> (&x)[Corners], int rank, Vec3<R> (&arm)[Corners],
                  R (&weight)[Corners]) const {
    const T* of = &slots_.weight[std::int64_t(rank) * plan_.most_slots];
    const Vec3<T>& s = shift_[rank];
    const Vec3<R> shift = {R(s.x), R(s.y), R(s.z)};
    for (int c = 0; c < Corners; ++c) {
      const int16* corner = part.corner(c);
      for (int lane = 0; lane < R::width; ++lane) weight[c].v[lane] = of[corner[lane]];
      arm[c] = x[c] + shift;
    }
  }

  // The tetrahedra of a pack; lanes without any repeat the first one, with no weight.
  struct Tets {
    int16 slot[4][R::width];
    Mat3<R> inverse;
    R weight, pressure;

    Tets(const Plan<T>& plan, const ElementWeights<T>& weights, const int32* tets)
        : pressure(T(0)) {
      R number[6];
      for (int lane = 0; lane < R::width; ++lane) {
        const int tet = tets[lane] < 0 ? tets[0] : tets[lane];
        const BlockPart<T> part{&plan, tet / block_lanes, tet % block_lanes};
        for (int c = 0; c < 4; ++c) slot[c][lane] = *part.corner(c);
        for (int n = 0; n < 6; ++n) number[n].v[lane] = *part.rest(n);
        weight.v[lane] = tets[lane] < 0 ? T(0) : weights.weight[tet];
        if (weights.pressure) pressure.v[lane] = tets[lane] < 0 ? T(0) : weights.pressure[tet];
      }
      inverse = read_rest<R>([&](int n) { return number[n]; }).inverse(0);
    }
    const int16* corner(int c) const { return slot[c]; }
  };

  void add_tets(const Tets& tets) {
    const int pieces = find_pieces<4>(tets);
    Vec3<R> x[4], arm[4];
    R share[4];
    for (int c = 0; c < 4; ++c)
      x[c] = gather_corner<T, R::width>(slots_.position.begin(), tets.slot[c]);
    const PieceFrame<R> frame(deformation_gradient(x, tets.inverse), tets.weight, tets.pressure);
    auto* strains = reinterpret_cast<PieceStrain<R>*>(slots_.strains.begin());
    for (int k = 0; k < pieces; ++k) {
      read_piece(tets, x, rank_[k], arm, share);
      strains[k] = PieceStrain<R>(tets.inverse, frame, arm, share);
    }
    if (weights_.pressure) {
      add_strains<true>(strains, pieces, tets.weight, tets.pressure);
    } else {
      add_strains<false>(strains, pieces, tets.weight, tets.pressure);
    }
  }

  template <bool Dilates>
  void add_strains(const PieceStrain<R>* strains, int pieces, const R& weight, const R& pressure) {
    for (int k = 0; k < pieces; ++k) {
      const PieceStrain<R> stress = strains[k].template stressed<Dilates>(weight, pressure);
      for (int l = 0; l <= k; ++l) {
        add_strain_products<Dilates>(
            stress, strains[l],
            &slots_.sums[std::int64_t(piece_pair(rank_[k], rank_[l])) * piece_block]);
      }
    }
  }

  // dF of the modes of each piece, and K dF, with the positive part of K
  template <class Kind, class Stencils>
  void add_stencils(const Stencils& stencils) {
    constexpr int n = Kind::corners, rows = second_rows<Kind>;
    using Change = R[piece_modes][rows];
    const int pieces = find_pieces<n>(stencils.part);
    const StencilNumbers<Kind, Stencils> own(stencils);
    Vec3<R> x[n], arm[n], f[Kind::dims];
    R share[n], second[rows][rows];
    stencils.corners(0, x);
    if (kept_) {
      kept_->template get<Kind>(stencils.part, second);
    } else {
      deform<Kind>(x, own.g, f);
      positive_second_derivative<Kind>(f, own, second);
    }
    auto* changes = reinterpret_cast<Change*>(slots_.strains.begin());
    auto* stresses = reinterpret_cast<Change*>(slots_.stresses.begin());
    for (int k = 0; k < pieces; ++k) {
      read_piece(stencils.part, x, rank_[k], arm, share);
      find_changes<Kind>(arm, share, own.g, changes[k]);
      for (int i = 0; i < piece_modes; ++i) {
        for (int r = 0; r < rows; ++r) {
          R sum(T(0));
          for (int c = 0; c < rows; ++c) sum = multiply_add(second[r][c], changes[k][i][c], sum);
          stresses[k][i][r] = sum;
        }
      }
    }
    for (int k = 0; k < pieces; ++k) {
      for (int l = 0; l <= k; ++l) {
        R* to = &slots_.sums[std::int64_t(piece_pair(rank_[k], rank_[l])) * piece_block];
        for (int i = 0; i < piece_modes; ++i) {
          for (int j = 0; j < piece_modes; ++j) {
            R sum = to[piece_modes * i + j];
            for (int r = 0; r < rows; ++r)
              sum = multiply_add(stresses[k][i][r], changes[l][j][r], sum);
            to[piece_modes * i + j] = sum;
          }
        }
      }
    }
  }

  // e G^T of a translation along e, and e x N of a turn: G = sum w_c g_c, N = sum w_c r_c g_c^T
  template <class Kind, class Stored>
  static void find_changes(const Vec3<R> (&arm)[Kind::corners], const R (&share)[Kind::corners],
                           const Stored& g, R (&change)[piece_modes][3 * Kind::dims]) {
    const R none(T(0));
    Vec3<R> push[Kind::corners], turn[Kind::corners], sum[Kind::dims], arms[Kind::dims];
    for (int c = 0; c < Kind::corners; ++c) {
      push[c] = {share[c], none, none};
      turn[c] = share[c] * arm[c];
    }
    deform<Kind>(push, g, sum);
    deform<Kind>(turn, g, arms);
    for (int j = 0; j < Kind::dims; ++j) {
      const Vec3<R>& n = arms[j];
      const Vec3<R> turned[3] = {{none, -n.z, n.y}, {n.z, none, -n.x}, {-n.y, n.x, none}};
      for (int i = 0; i < 3; ++i) {
        for (int a = 0; a < 3; ++a) change[i][3 * j + a] = a == i ? sum[j].x : none;
        change[3 + i][3 * j] = turned[i].x;
        change[3 + i][3 * j + 1] = turned[i].y;
        change[3 + i][3 * j + 2] = turned[i].z;
      }
    }
  }

  const Plan<T>& plan_;
  const Work& work_;
  const Slots& slots_;
  ElementWeights<T> weights_;
  T* numbers_;
  bool dissipates_too_;
  const StencilHessians<T>* kept_;  // at these positions, or null
  PieceMask mask_ = 0;
  Vec3<T> shift_[most_pieces];  // by rank in the patch
  int rank_[most_pieces];
};

}  // namespace pd::inline PD_TARGET
