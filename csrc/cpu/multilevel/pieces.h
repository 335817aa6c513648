// How the coarse space of solver/multilevel/pieces.h acts on vectors, on the CPU.
#pragma once
#include "cpu/multilevel/pieces_build.h"
#include "cpu/multilevel/v_cycle.h"

namespace pd::inline PD_TARGET {

// One thread's part in it.
template <class Lanes>
class PiecesOfTeam {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Work = PiecesWork<Lanes>;
  using Factors = typename Work::Factors;
  static constexpr int width = Lanes::environments;

 public:
  PiecesOfTeam(const Plan<T>& plan, const Team& team, const Workspace<Lanes>& step, Work& work)
      : plan_(plan), team_(team), w_(step), work_(work) {}

  bool there() const { return work_.pieces > 0; }

  // `kept`: the second derivatives of stencils at `base`, or null
  void make(const Value* base, const bool (&asks)[width], const double (&scales)[width],
            const StencilHessians<T>* kept = nullptr) const {
    PiecesMaker<Lanes>(plan_, team_, w_, work_, kept).make(base, asks, scales);
  }
  // With contacts: the lanes that have it, where these leave the directions `free`.
  void hold(const Mat3<Real>* free, const bool (&has)[width], const double (&scales)[width]) const {
    PiecesMaker<Lanes>(plan_, team_, w_, work_, nullptr).hold(free, has, scales);
  }
  bool is_held(int lane) const { return there() && work_.factors[lane].held; }

  void forget() const {
    if (team_.rank == 0) {
      for (Factors& f : work_.factors) f.sound = f.held = false;
    }
  }

  // Before M: keeps Z^T q, and takes from q what M is not to see of it in lanes where the space goes `around` it. Nothing of it is
  // left at vertices that pins hold and M does not: the force there would move the body away as a whole.
  void before(Value* q, const bool (&around)[width], bool some) const {
    restrict_to(q, [](Factors& f) -> std::vector<double>& { return f.own; });
    if (!some) return;
    set_motion([&](int lane, const Factors& f, double* x) {
      if (around[lane]) add_solution(f.matrix, f.scale, f.own, 1, x);
    });
    each_vertex([&](std::int64_t i) { work_.field[i] = moved(i); });
    const Level<1, T> level = fine_level(plan_.levels);
    each_vertex([&](std::int64_t i) {
      q[i] = moving(i, q[i] - row_product<Real>(level, work_.field.begin(), int(i)));
    });
  }

  // After it: adds what its result lacks, in other lanes Z (Hc^-1 - Ac^-1) Z^T q. q came multiplied by `scale`.
  void after(Value* z, const bool (&around)[width], bool some, const Real& scale) const {
    if (some) {
      each_vertex([&](std::int64_t i) { z[i] = moving(i, z[i]); });
      const Level<1, T> level = fine_level(plan_.levels);
      each_vertex([&](std::int64_t i) { work_.field[i] = row_product<Real>(level, z, int(i)); });
      restrict_to(work_.field.begin(), [](Factors& f) -> std::vector<double>& { return f.image; });
    }
    set_motion([&](int lane, const Factors& f, double* x) {
      add_solution(f.energy, f.scale, f.own, 1 / Work::number(scale, lane), x);
      add_solution(f.matrix, f.scale, around[lane] ? f.image : f.own, -1, x);
    });
    each_vertex([&](std::int64_t i) { z[i] = z[i] + moved(i); });
  }

 private:
  template <class Visit>
  void each_vertex(const Visit& visit) const {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) visit(i);
    team_.barrier();
  }

  // Z^T of a field, chunk by chunk: neither threads nor the batch change the order of a sum.
  template <class Where>
  void restrict_to(const Value* field, const Where& where) const {
    const Real none(T(0));
    for (std::int64_t c = team_.begin(work_.chunks.count()); c < team_.end(work_.chunks.count());
         ++c) {
      const PieceMask mask = work_.chunks.mask[c];
      Value* sum = &work_.sums[2 * work_.chunks.piece[c]];
      std::fill_n(sum, 2 * count_pieces(mask), Lanes::value({none, none, none}));
      Work::each_of_chunk(plan_.vertices, c, [&](std::int64_t i) {
        if (!any(none < w_.inverse[i])) return;
        const Vec3<Real> q = Lanes::vec3(moving(i, field[i]));
        const Value push = Lanes::value(q),
                    turn = Lanes::value(cross(Lanes::vec3(work_.arm[i]), q));
        Work::each_share(plan_.levels, i, [&](int, int piece, T weight) {
          Value* to = sum + 2 * rank_of(mask, piece);
          to[0] = multiply_add(Real(weight), push, to[0]);
          to[1] = multiply_add(Real(weight), turn, to[1]);
        });
      });
    }
    team_.barrier();
    if (team_.rank == 0) {
      for (int lane = 0; lane < width; ++lane) add_up(lane, where(work_.factors[lane]));
    }
    team_.barrier();
  }

  void add_up(int lane, std::vector<double>& modes) const {
    std::fill(modes.begin(), modes.end(), 0.0);
    for (int c = 0; c < work_.chunks.count(); ++c) {
      each_piece(work_.chunks.mask[c], [&](int rank, int piece) {
        const Value* sum = &work_.sums[2 * (work_.chunks.piece[c] + rank)];
        for (int part = 0; part < 2; ++part) {
          const Vec3<T> own = Lanes::get_lane(sum[part], lane);
          double* to = &modes[piece_modes * piece + 3 * part];
          to[0] += double(own.x);
          to[1] += double(own.y);
          to[2] += double(own.z);
        }
      });
    }
    // turns about the centre of the piece
    for (int p = 0; p < work_.pieces; ++p) {
      double* m = &modes[piece_modes * p];
      const Vec3<double> turn = cross(centre(p, lane), Vec3<double>{m[0], m[1], m[2]});
      m[3] -= turn.x;
      m[4] -= turn.y;
      m[5] -= turn.z;
    }
  }

  Vec3<double> centre(int piece, int lane) const {
    const Vec3<T> c = Lanes::get_lane(work_.centre[piece], lane);
    return {double(c.x), double(c.y), double(c.z)};
  }

  // x += factor X^-1 right
  static void add_solution(const DenseFactor& of, const std::vector<double>& scale,
                           const std::vector<double>& right, double factor, double* x) {
    std::vector<double> found(right.size());
    for (std::size_t i = 0; i < right.size(); ++i) found[i] = scale[i] * right[i];
    of.solve(found.data());
    for (std::size_t i = 0; i < right.size(); ++i) x[i] += factor * scale[i] * found[i];
  }

  // Motions of the pieces, at the middle, where add(lane, factors, x) adds the modes to x.
  template <class Add>
  void set_motion(const Add& add) const {
    if (team_.rank == 0) {
      std::vector<double> x(work_.unknowns);
      for (int lane = 0; lane < width; ++lane) {
        const Factors& f = work_.factors[lane];
        std::fill(x.begin(), x.end(), 0.0);
        if (f.sound) add(lane, f, x.data());
        for (int p = 0; p < work_.pieces; ++p) {
          const double* m = &x[piece_modes * p];
          const Vec3<double> turn = {m[3], m[4], m[5]}, back = cross(turn, centre(p, lane));
          Lanes::set_lane(work_.motion[2 * p], lane, T(m[0] - back.x), T(m[1] - back.y),
                          T(m[2] - back.z));
          Lanes::set_lane(work_.motion[2 * p + 1], lane, T(turn.x), T(turn.y), T(turn.z));
        }
      }
    }
    team_.barrier();
  }

  // 0 where a pin holds the vertex, be it NaN
  Value moving(std::int64_t i, const Value& a) const {
    const Real none(T(0));
    return select(none < w_.inverse[i], a, Lanes::value({none, none, none}));
  }

  // Z x at a vertex
  Value moved(std::int64_t i) const {
    const Real none(T(0));
    Value push = Lanes::value({none, none, none}), turn = push;
    Work::each_share(plan_.levels, i, [&](int, int piece, T weight) {
      push = multiply_add(Real(weight), work_.motion[2 * piece], push);
      turn = multiply_add(Real(weight), work_.motion[2 * piece + 1], turn);
    });
    const Vec3<Real> along =
        Lanes::vec3(push) + cross(Lanes::vec3(turn), Lanes::vec3(work_.arm[i]));
    return moving(i, Lanes::value(along));
  }

  const Plan<T>& plan_;
  const Team& team_;
  const Workspace<Lanes>& w_;
  Work& work_;
};

}  // namespace pd::inline PD_TARGET
