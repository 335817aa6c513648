// What the threads of a team share of the coarse space of solver/multilevel/pieces.h.
#pragma once
#include "cpu/multilevel/dense_factor.h"
#include "cpu/step/workspace.h"
#include "solver/multilevel/pieces.h"

#include <algorithm>
#include <cstdint>
#include <vector>

namespace pd::inline PD_TARGET {

// Parts of a scene, patches or chunks of vertices: which pieces each has, and where its numbers stand.
struct PieceParts {
  std::vector<PieceMask> mask;
  std::vector<std::int64_t> piece{0}, pair{0};  // pieces, and pairs of pieces, of the parts before
  int most = 0;                                 // pieces of a part

  void add(PieceMask of) {
    const int count = count_pieces(of);
    mask.push_back(of);
    piece.push_back(piece.back() + count);
    pair.push_back(pair.back() + piece_pair(count, 0));
    most = std::max(most, count);
  }
  int count() const { return int(mask.size()); }
  std::int64_t pieces() const { return piece.back(); }
  std::int64_t pairs() const { return pair.back(); }
};

// Number of a piece among those of a mask.
inline int rank_of(PieceMask mask, int piece) {
  return count_pieces(mask & ((PieceMask(1) << piece) - 1));
}

// visit(rank, piece)
template <class Visit>
void each_piece(PieceMask mask, const Visit& visit) {
  for (int rank = 0; mask; mask &= mask - 1, ++rank) visit(rank, __builtin_ctzll(mask));
}

// Zeroed items, aligned for vectors.
template <class Item>
class Row {
 public:
  Row() = default;
  explicit Row(std::size_t count)
      : storage_(allocate_zeroed(count * sizeof(Item))),
        items_(reinterpret_cast<Item*>(storage_.get())) {}

  Item& operator[](std::size_t i) const { return items_[i]; }
  Item* begin() const { return items_; }

 private:
  Storage storage_;
  Item* items_ = nullptr;
};

// Memory of it, for all threads of a team; none where it is not `wanted`.
template <class Lanes>
struct PiecesWork {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  static constexpr int width = Lanes::environments, chunk = 256;

  // Sums of a (1, r_i) (1, r_j)^T, r from the centres of two pieces.
  struct Moments {
    double matrix[4][4], inertia[4][4];
  };
  struct Block {
    double at[piece_block];
  };
  struct Factors {
    DenseFactor energy, matrix;        // of Hc and Ac in the scale of the diagonal of Ac
    DenseFactor unheld;                // Hc there before contacts hold it; none without contacts
    std::vector<double> scale;         // 1 / sqrt(Ac_ii), 0 for a mode that moves nothing
    std::vector<double> own, image;    // Z^T q, and what a product needs
    bool sound = false, held = false;  // whether it could be made; whether Hc has contacts
  };
  // what a thread needs of a patch
  struct Slots {
    Row<Quad<T>> position;  // [slots]
    Row<PieceMask> mask;    // [slots]
    Row<T> weight;          // [pieces, slots]
    Row<Pack<T,
             native_width<T>>>  // blocks of pairs; at most nine numbers of a mode and their duals
        sums, strains, stresses;
  };

  int pieces, unknowns;
  std::vector<PieceMask> vertex;  // [vertices]
  std::vector<int> first_pack;    // [patches + 1] of tetrahedra
  PieceParts patches, chunks;     // those of a chunk: of its rows of A
  Row<Value> arm;                 // [vertices] positions from the middle
  Row<Value> field;               // [vertices] Z q, and A times that
  Row<Value> sums;                // [pieces of chunks, 2]
  Row<Value> motion;              // [pieces, 2] of a vertex at the middle, and turns
  Row<Value> centre;              // [pieces] from the middle
  Row<Moments> moments;           // [pairs of chunks]
  Row<Block> strains;             // [pairs of patches]
  Row<Block> springs;             // [pairs of chunks]; none without contacts
  std::vector<Factors> factors;   // [environments]
  std::vector<Slots> slots;       // [threads]
  // of one environment, where they differ: of tetrahedra, twice with Poisson's ratio, and of stencils
  Row<T> weights, numbers;

  PiecesWork(const Plan<T>& plan, bool wanted, bool touching, bool poisson, int threads)
      : pieces(wanted ? plan.levels.pieces : 0), unknowns(piece_modes * pieces) {
    if (pieces == 0) return;
    find_masks(plan);
    arm = Row<Value>(plan.vertices);
    field = Row<Value>(plan.vertices);
    sums = Row<Value>(2 * chunks.pieces());
    motion = Row<Value>(2 * pieces);
    centre = Row<Value>(pieces);
    moments = Row<Moments>(chunks.pairs());
    strains = Row<Block>(patches.pairs());
    if (touching) springs = Row<Block>(chunks.pairs());
    factors.resize(width);
    for (Factors& f : factors) {
      for (DenseFactor* x : {&f.energy, &f.matrix}) x->resize(unknowns);
      if (touching) f.unheld.resize(unknowns);
      for (auto* x : {&f.scale, &f.own, &f.image}) x->resize(unknowns);
    }
    slots.resize(threads);
    for (Slots& s : slots) allocate(plan, s);
    if (width == 1) return;
    weights = Row<T>(std::size_t(plan.blocks) * block_lanes * (poisson ? 2 : 1));
    numbers = Row<T>(std::size_t(plan.stencil_numbers) * block_lanes);
  }

  static double number(const Real& of, int lane) { return Lanes::lane(Lanes::widen(of), lane); }

  // visit(place, piece, weight) for the pieces that move a vertex
  template <class Visit>
  static void each_share(const Levels<T>& levels, std::int64_t i, const Visit& visit) {
    for (int k = 0; k < pieces_of_vertex; ++k) {
      const T weight = levels.piece_weight[pieces_of_vertex * i + k];
      if (weight > T(0)) visit(k, levels.piece_of[pieces_of_vertex * i + k], weight);
    }
  }

  // visit(vertex) of a chunk
  template <class Visit>
  static void each_of_chunk(int vertices, std::int64_t which, const Visit& visit) {
    const std::int64_t end = std::min<std::int64_t>(vertices, (which + 1) * chunk);
    for (std::int64_t i = which * chunk; i < end; ++i) visit(i);
  }

 private:
  void find_masks(const Plan<T>& plan) {
    const Levels<T>& levels = plan.levels;
    vertex.assign(plan.vertices, 0);
    for (std::int64_t i = 0; i < plan.vertices; ++i)
      each_share(levels, i, [&](int, int piece, T) { vertex[i] |= PieceMask(1) << piece; });
    first_pack.assign(plan.patches + 1, 0);
    for (int pack = 0; pack < levels.piece_packs; ++pack)
      ++first_pack[levels.piece_pack_patch[pack] + 1];
    for (int patch = 0; patch < plan.patches; ++patch) {
      first_pack[patch + 1] += first_pack[patch];
      PieceMask mask = 0;
      for (int s = plan.patch_slot[patch]; s < plan.patch_slot[patch + 1]; ++s)
        mask |= vertex[plan.slot_vertex[s]];
      patches.add(mask);
    }
    for (std::int64_t c = 0; c * chunk < plan.vertices; ++c) {
      PieceMask mask = 0;
      each_of_chunk(plan.vertices, c, [&](std::int64_t i) {
        for (int32 p = levels.fine_start[i]; p < levels.fine_start[i + 1]; ++p)
          mask |= vertex[levels.fine_column[p]];
      });
      chunks.add(mask);
    }
  }

  void allocate(const Plan<T>& plan, Slots& s) const {
    using Packs = Row<Pack<T, native_width<T>>>;
    s.position = Row<Quad<T>>(plan.most_slots);
    s.mask = Row<PieceMask>(plan.most_slots);
    s.weight = Row<T>(std::size_t(patches.most) * plan.most_slots);
    s.sums = Packs(std::size_t(piece_pair(patches.most, 0)) * piece_block);
    for (Packs* packs : {&s.strains, &s.stresses})
      *packs = Packs(std::size_t(patches.most) * piece_modes * 9);
  }
};

}  // namespace pd::inline PD_TARGET
