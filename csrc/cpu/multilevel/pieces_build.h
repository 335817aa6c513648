// How the coarse space of solver/multilevel/pieces.h is made of an iterate, on the CPU.
#pragma once
#include "cpu/multilevel/piece_elements.h"
#include "threads/team.h"

namespace pd::inline PD_TARGET {

// One thread's part in the making.
template <class Lanes>
class PiecesMaker {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Work = PiecesWork<Lanes>;
  using Factors = typename Work::Factors;
  using Moments = typename Work::Moments;
  using Block = typename Work::Block;
  using Four = Pack<double, 4>;
  static constexpr int width = Lanes::environments;

 public:
  // `kept`: the second derivatives of stencils where it is made, or null
  PiecesMaker(const Plan<T>& plan, const Team& team, const Workspace<Lanes>& step, Work& work,
              const StencilHessians<T>* kept)
      : plan_(plan), levels_(plan.levels), team_(team), w_(step), work_(work), kept_(kept) {}

  // Makes it for the lanes that ask, of positions x + u: `base` is u. Their material is that of A times `scales` at most.
  void make(const Value* base, const bool (&asks)[width], const double (&scales)[width]) {
    for (int lane = 0; lane < width; ++lane) Lanes::set_lane(wanted_, lane, T(asks[lane] ? 1 : 0));
    find_middle();
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      renew(work_.arm[i], moving(i, (w_.x[i] - middle_) + base[i]));
    team_.barrier();
    find_centres();
    for (int lane = 0; lane < width; ++lane) {
      if (!asks[lane]) continue;
      for (std::int64_t c = team_.begin(work_.chunks.count()); c < team_.end(work_.chunks.count());
           ++c)
        add_moments(int(c), lane);
      add_elements(base, lane);
      team_.barrier();
      if (team_.rank == 0) factorise(lane, scales[lane]);
      team_.barrier();
    }
  }

  // Contacts hold vertices in the directions that they do not leave `free`; the others move on, against A times `scales`.
  void hold(const Mat3<Real>* free, const bool (&has)[width], const double (&scales)[width]) {
    for (int lane = 0; lane < width; ++lane) {
      if (!has[lane]) continue;
      for (std::int64_t c = team_.begin(work_.chunks.count()); c < team_.end(work_.chunks.count());
           ++c)
        add_springs(int(c), free, lane, scales[lane]);
      team_.barrier();
      if (team_.rank == 0) factorise_held(lane);
      team_.barrier();
    }
  }

 private:
  // whether no pin of this step holds a vertex; what M holds moves with no piece
  bool moves(std::int64_t i, int lane) const { return Work::number(w_.inverse[i], lane) > 0; }
  Value moving(std::int64_t i, const Value& a) const {
    const Real none(T(0));
    return select(none < w_.inverse[i], a, Lanes::value({none, none, none}));
  }
  // only in lanes that ask
  void renew(Value& old, const Value& fresh) const {
    old = select(wanted_ > Real(T(0)), fresh, old);
  }
  static Vec3<double> wide(const Value& a, int lane) {
    const Vec3<T> v = Lanes::get_lane(a, lane);
    return {double(v.x), double(v.y), double(v.z)};
  }

  // Any place amid the vertices will do. What is held has no part in it, be it NaN.
  void find_middle() {
    for (int lane = 0; lane < width; ++lane) {
      double sum[3] = {}, count = 0;
      for (int i = 0; i < plan_.vertices; ++i) {
        if (!moves(i, lane)) continue;
        const Vec3<double> x = wide(w_.x[i], lane);
        sum[0] += x.x;
        sum[1] += x.y;
        sum[2] += x.z;
        ++count;
      }
      const double share = count > 0 ? 1 / count : 0;
      Lanes::set_lane(middle_, lane, T(share * sum[0]), T(share * sum[1]), T(share * sum[2]));
    }
  }

  // The mean of each piece, by weight.
  void find_centres() {
    if (team_.rank == 0) {
      for (int lane = 0; lane < width; ++lane) {
        double sum[most_pieces][4] = {};
        for (int i = 0; i < plan_.vertices; ++i) {
          if (!moves(i, lane)) continue;
          const Vec3<double> y = wide(work_.arm[i], lane);
          Work::each_share(levels_, i, [&](int, int piece, T weight) {
            double (&s)[4] = sum[piece];
            s[0] += double(weight);
            s[1] += double(weight) * y.x;
            s[2] += double(weight) * y.y;
            s[3] += double(weight) * y.z;
          });
        }
        for (int q = 0; q < work_.pieces; ++q) {
          const double share = sum[q][0] > 0 ? 1 / sum[q][0] : 0;
          Value centre;
          Lanes::set_lane(centre, lane, T(share * sum[q][1]), T(share * sum[q][2]),
                          T(share * sum[q][3]));
          const Vec3<T> own = Lanes::get_lane(centre, lane);
          if (Work::number(wanted_, lane) > 0)
            Lanes::set_lane(work_.centre[q], lane, own.x, own.y, own.z);
        }
      }
    }
    team_.barrier();
  }

  // (1, r) of a vertex, from the middle
  Four arm_of(std::int64_t i, int lane) const {
    const Vec3<double> r = wide(work_.arm[i], lane);
    return Four(Four::Vector{1, r.x, r.y, r.z});
  }
  // (1, r) from the centre of a piece, for sums of those from the middle
  Four centred(const Four& sum, int piece, int lane) const {
    const Vec3<double> c = wide(work_.centre[piece], lane);
    return sum - Four(sum.v[0]) * Four(Four::Vector{0, c.x, c.y, c.z});
  }

  // Sums over the rows of a chunk: of A, and of the inertia of this step.
  void add_moments(int chunk, int lane) const {
    const PieceMask mask = work_.chunks.mask[chunk];
    Moments* to = &work_.moments[work_.chunks.pair[chunk]];
    std::fill_n(to, work_.chunks.pair[chunk + 1] - work_.chunks.pair[chunk], Moments{});
    Work::each_of_chunk(plan_.vertices, chunk, [&](std::int64_t i) {
      if (!moves(i, lane)) return;
      Four image[most_pieces];  // A (1, r), by ranks
      PieceMask there = 0;
      for (int32 p = levels_.fine_start[i]; p < levels_.fine_start[i + 1]; ++p) {
        const std::int64_t j = levels_.fine_column[p];
        if (!moves(j, lane)) continue;
        const Four arm = Four(double(levels_.fine_value[p])) * arm_of(j, lane);
        Work::each_share(levels_, j, [&](int, int piece, T weight) {
          Four& sum = image[rank_of(mask, piece)];
          if (!(there >> piece & 1)) sum = Four(0.0);
          there |= PieceMask(1) << piece;
          sum = multiply_add(Four(double(weight)), arm, sum);
        });
      }
      add_row(i, lane, mask, there, image, to);
    });
  }

  void add_row(std::int64_t i, int lane, PieceMask mask, PieceMask there, Four* image,
               Moments* to) const {
    each_piece(there, [&](int, int piece) {
      Four& sum = image[rank_of(mask, piece)];
      sum = centred(sum, piece, lane);
    });
    const Four arm = arm_of(i, lane);
    const double inertia = Work::number(w_.inertia[i], lane);
    Work::each_share(levels_, i, [&](int, int row, T weight) {
      const int own = rank_of(mask, row);
      const Four left = Four(double(weight)) * centred(arm, row, lane);
      each_piece(there, [&](int, int column) {
        if (column <= row)
          add_product(left, image[rank_of(mask, column)],
                      to[piece_pair(own, rank_of(mask, column))].matrix);
      });
      Work::each_share(levels_, i, [&](int, int column, T share) {
        if (column > row) return;
        const Four right = Four(inertia * double(share)) * centred(arm, column, lane);
        add_product(left, right, to[piece_pair(own, rank_of(mask, column))].inertia);
      });
    });
  }

  static void add_product(const Four& a, const Four& b, double (&sum)[4][4]) {
    for (int m = 0; m < 4; ++m) multiply_add(Four(a.v[m]), b, Four::load(sum[m])).store(sum[m]);
  }

  void add_elements(const Value* base, int lane) const {
    // where environments differ the team is one thread
    ElementWeights<T> weights = w_.weights();
    T* numbers = w_.numbers;
    if (width > 1 && !w_.shared_weight) {
      const std::int64_t elements = std::int64_t(plan_.blocks) * block_lanes;
      T *weight = work_.weights.begin(), *pressure = w_.pressure ? weight + elements : nullptr;
      for (std::int64_t e = 0; e < elements; ++e) {
        weight[e] = w_.weight[e * width + lane];
        if (pressure) pressure[e] = w_.pressure[e * width + lane];
      }
      weights = {weight, pressure, true};
    }
    if (width > 1 && !w_.shared_numbers) {
      numbers = work_.numbers.begin();
      for (std::int64_t n = 0; n < std::int64_t(plan_.stencil_numbers) * block_lanes; ++n)
        numbers[n] = w_.numbers[n * width + lane];
    }
    PieceElements<T, Work> elements(plan_, work_, work_.slots[team_.rank], weights, numbers,
                                    w_.per_time > T(0), kept_);
    for (int patch = team_.begin(plan_.patches); patch < team_.end(plan_.patches); ++patch) {
      const Value anchor = w_.x[plan_.slot_vertex[plan_.patch_slot[patch]]] - middle_;
      elements.add(
          patch,
          [&](int slot) {
            const Vec3<T> x =
                Lanes::get_lane(w_.origin[slot] + base[plan_.slot_vertex[slot]], lane);
            return to_quad(x.x, x.y, x.z);
          },
          [&](int piece) { return Lanes::get_lane(anchor - work_.centre[piece], lane); },
          [&](int vertex) { return moves(vertex, lane); });
    }
  }

  // to(i, j, block) for the blocks of all parts, in their order; `write` the lower triangle alone
  template <class Blocks, class Add>
  static void each_block(const PieceParts& parts, const Blocks& blocks, const Add& add) {
    for (int part = 0; part < parts.count(); ++part) {
      each_piece(parts.mask[part], [&](int row, int p) {
        each_piece(parts.mask[part], [&](int column, int q) {
          if (column <= row) add(p, q, blocks[parts.pair[part] + piece_pair(row, column)]);
        });
      });
    }
  }

  template <class Entry>
  static void add_block(DenseFactor& to, int p, int q, const Entry& entry) {
    for (int i = 0; i < piece_modes; ++i) {
      for (int j = 0; j < (p == q ? i + 1 : piece_modes); ++j)
        to.at(piece_modes * p + i, piece_modes * q + j) += entry(i, j);
    }
  }

  void factorise(int lane, double times) const {
    Factors& f = work_.factors[lane];
    f.energy.clear();
    f.matrix.clear();
    each_block(work_.chunks, work_.moments, [&](int p, int q, const Moments& moments) {
      add_block(f.matrix, p, q, [&](int i, int j) { return rigid_entry(moments.matrix, i, j); });
      add_block(f.energy, p, q, [&](int i, int j) { return rigid_entry(moments.inertia, i, j); });
    });
    add_blocks(f.energy, work_.patches, work_.strains);
    for (int i = 0; i < work_.unknowns; ++i) {
      const int piece = i / piece_modes, first = piece_modes * piece;
      f.scale[i] = mode_scale<T>(i - first, f.matrix.at(i, i), f.matrix.at(first, first),
                                 wide(work_.centre[piece], lane));
    }
    rescale(f.energy, f.scale, times * piece_noise<T>());
    rescale(f.matrix, f.scale, piece_noise<T>());
    if (f.unheld.size() > 0) f.unheld = f.energy;
    f.held = false;
    f.sound = f.energy.factorise() && f.matrix.factorise();
  }

  static void add_blocks(DenseFactor& to, const PieceParts& parts, const Row<Block>& blocks) {
    each_block(parts, blocks, [&](int p, int q, const Block& own) {
      add_block(to, p, q, [&](int i, int j) { return own.at[piece_modes * i + j]; });
    });
  }

  // one where a mode moves nothing
  static void rescale(DenseFactor& x, const std::vector<double>& scale, double noise) {
    for (int i = 0; i < x.size(); ++i) {
      for (int j = 0; j < i; ++j) x.at(i, j) *= scale[i] * scale[j];
      x.at(i, i) = scale[i] > 0 ? scale[i] * scale[i] * x.at(i, i) + noise : 1;
    }
  }

  void add_springs(int chunk, const Mat3<Real>* free, int lane, double times) const {
    const PieceMask mask = work_.chunks.mask[chunk];
    Block* to = &work_.springs[work_.chunks.pair[chunk]];
    std::fill_n(to, work_.chunks.pair[chunk + 1] - work_.chunks.pair[chunk], Block{});
    // hardly any vertex is held in any lane
    const auto held = [&](std::int64_t i) { return !leaves_all(free[i]) && moves(i, lane); };
    Work::each_of_chunk(plan_.vertices, chunk, [&](std::int64_t i) {
      if (!held(i)) return;
      for (int32 n = levels_.fine_start[i]; n < levels_.fine_start[i + 1]; ++n) {
        const std::int64_t j = levels_.fine_column[n];
        if (!held(j)) continue;
        const double stiffness = times * double(levels_.fine_value[n]);
        Work::each_share(levels_, i, [&](int, int p, T weight) {
          Vec3<double> own[piece_modes], other[piece_modes];
          held_modes(i, p, double(weight) * stiffness, free[i], lane, own);
          Work::each_share(levels_, j, [&](int, int q, T share) {
            if (q > p) return;
            held_modes(j, q, double(share), free[j], lane, other);
            Block& block = to[piece_pair(rank_of(mask, p), rank_of(mask, q))];
            for (int m = 0; m < piece_block; ++m)
              block.at[m] += dot(own[m / piece_modes], other[m % piece_modes]);
          });
        });
      }
    });
  }

  // (1 - P) of the displacements by all modes
  void held_modes(std::int64_t i, int piece, double weight, const Mat3<Real>& free, int lane,
                  Vec3<double> (&mode)[piece_modes]) const {
    Vec3<double> held[3];
    for (int a = 0; a < 3; ++a) {
      const Vec3<Real>& row = free.row[a];
      held[a] = {(a == 0) - Work::number(row.x, lane), (a == 1) - Work::number(row.y, lane),
                 (a == 2) - Work::number(row.z, lane)};
    }
    const Four arm = centred(arm_of(i, lane), piece, lane);
    for (int m = 0; m < piece_modes; ++m) {
      const Vec3<double> moved = rigid_motion(m, Vec3<double>{arm.v[1], arm.v[2], arm.v[3]});
      mode[m] = {weight * dot(held[0], moved), weight * dot(held[1], moved),
                 weight * dot(held[2], moved)};
    }
  }

  void factorise_held(int lane) const {
    Factors& f = work_.factors[lane];
    if (!f.sound) return;
    bool held = false;
    for (std::int64_t p = 0; p < work_.chunks.pairs() && !held; ++p) {
      for (const double x : work_.springs[p].at) held = held || x != 0;
    }
    // as it was
    if (!held && !f.held) return;
    f.energy.clear();
    if (held) {
      add_blocks(f.energy, work_.chunks, work_.springs);
      rescale(f.energy, f.scale, 0);
    }
    f.held = held && f.energy.add_and_factorise(f.unheld);
    if (f.held) return;
    f.energy = f.unheld;
    f.energy.factorise();
  }

  const Plan<T>& plan_;
  const Levels<T>& levels_;
  const Team& team_;
  const Workspace<Lanes>& w_;
  Work& work_;
  const StencilHessians<T>* kept_;
  Real wanted_{T(0)};
  Value middle_;
};

}  // namespace pd::inline PD_TARGET
