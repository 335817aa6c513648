// Application of the coarse space of solver/multilevel/pieces.h to vectors on a GPU; cuda/multilevel/pieces_build.h makes it.
#pragma once
#include "cuda/multilevel/v_cycle.h"
#include "solver/multilevel/pieces.h"
#include "views/shared_memory.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

constexpr int most_piece_unknowns = piece_modes * most_pieces;

// Device memory of a team. Tasks are those of the plan (plan/multilevel/piece_lists.h).
template <class T>
struct PiecesMemory {
  Quad<T>* arm;     // [vertices] position from the middle, and 1, or 0 where a pin holds the vertex
  Quad<T>* field;   // [vertices] Z times modes, or A times a field
  Quad<T>* centre;  // [pieces] from the middle
  double* row_sums;  // [tasks of rows, piece_block]
  double* strains;   // [tasks of tetrahedra, piece_block]
  double* mode;      // [unknowns] of Z; where it is made, springs on the diagonal of Hc
  double* scale;     // [unknowns] 1 / sqrt(Ac_ii), 0 for a mode that moves nothing
  double* block[2];  // [pairs, piece_block] Hc and Ac in that scale, then their inverses
  double* unheld;    // [pairs, piece_block] Hc in that scale before contacts hold it
  double* panel;     // [2, 2, pieces, piece_block] a column of both, double-buffered
};

// The arrays of one team.
template <class T>
PD_DEVICE PiecesMemory<T> pieces_of_team(const Levels<T>& levels, PiecesMemory<T> m,
                                         std::int64_t team) {
  const std::int64_t pieces = levels.pieces, unknowns = piece_modes * pieces;
  const std::int64_t blocks = team * piece_pair(levels.pieces, 0) * piece_block;
  m.arm += team * levels.vertices;
  m.field += team * levels.vertices;
  m.centre += team * pieces;
  m.row_sums += team * levels.piece_row_tasks * piece_block;
  m.strains += team * levels.piece_tet_tasks * piece_block;
  m.mode += team * unknowns;
  m.scale += team * unknowns;
  for (double** block : {&m.block[0], &m.block[1], &m.unheld}) *block += blocks;
  m.panel += team * 4 * pieces * piece_block;
  return m;
}

// State of the coarse space in shared memory, the same in every block.
template <class T>
struct PiecesControl {
  double product[2][most_piece_unknowns];  // Z^T q, and that of A M q
  double pivot[2][piece_block];
  T motion[most_piece_unknowns];  // of each piece: of a vertex at the middle, and its turn
  DevicePlan<T> plan;
  PiecesMemory<T> memory;
  bool sound, held;  // whether it could be made; whether Hc includes contacts
  bool positive[2];  // pivots

  // Copies what functions out of line need, by all threads.
  PD_DEVICE void begin(const DevicePlan<T>& of_call, const PiecesMemory<T>& all, int team) {
    constexpr int words = sizeof(plan) / sizeof(std::uint64_t);
    static_assert(sizeof(plan) % sizeof(std::uint64_t) == 0);
    for (int i = threadIdx.x; i < words; i += blockDim.x)
      reinterpret_cast<std::uint64_t*>(&plan)[i] =
          reinterpret_cast<const std::uint64_t*>(&of_call)[i];
    if (threadIdx.x == 0) memory = pieces_of_team(of_call.levels, all, team);
    __syncthreads();
  }
};
static_assert(sizeof(PiecesControl<double>) <= pieces_bytes);

template <class T>
PD_DEVICE Vec3<double> widened(const Quad<T>& a) {
  return {double(a.x), double(a.y), double(a.z)};
}

// A part of the items of a pair of pieces, for a warp.
struct alignas(16) PieceTask {
  int32 row, column, first, end;

  PD_DEVICE static PieceTask of(const int32* tasks, int number) {
    return reinterpret_cast<const PieceTask*>(tasks)[number];
  }
};

// Weight of a vertex in the motion of a piece.
template <class T>
PD_DEVICE T share_of(const Levels<T>& levels, int vertex, int piece) {
  static_assert(pieces_of_vertex == 4);
  const int4 of = reinterpret_cast<const int4*>(levels.piece_of)[vertex];
  const Quad<T> weight = reinterpret_cast<const Quad<T>*>(levels.piece_weight)[vertex];
  // unused places have no weight
  return ((of.x == piece ? weight.x : T(0)) + (of.y == piece ? weight.y : T(0))) +
         ((of.z == piece ? weight.z : T(0)) + (of.w == piece ? weight.w : T(0)));
}

// Z times the modes, at a vertex
template <class T>
PD_DEVICE Vec3<T> moved_by_pieces(const PiecesControl<T>& c, const Levels<T>& levels, int i) {
  const Quad<T> arm = c.memory.arm[i];
  Vec3<T> push = {T(0), T(0), T(0)}, turn = push;
  if (!(arm.w > T(0))) return push;
  const int4 of = reinterpret_cast<const int4*>(levels.piece_of)[i];
  const Quad<T> weight = reinterpret_cast<const Quad<T>*>(levels.piece_weight)[i];
  const auto add = [&](int piece, T w) {
    if (!(w > T(0))) return;
    const T* motion = c.motion + piece_modes * piece;
    push = multiply_add(w, read3(motion), push);
    turn = multiply_add(w, read3(motion + 3), turn);
  };
  add(of.x, weight.x);
  add(of.y, weight.y);
  add(of.z, weight.z);
  add(of.w, weight.w);
  return push + cross(turn, vec3(arm));
}

// What an application is for: all of Z (Hc^-1 - Ac^-1) Z^T q; what M is not to see of q; what it lacks after it.
enum class PiecesPart { all, before, after };

template <class T>
class PiecesApplication {
 public:
  PD_DEVICE PiecesApplication(PiecesControl<T>& control, BlockTeam& team)
      : levels_(control.plan.levels), m_(control.memory), team_(team), c_(control) {}

  // Sets motions of the pieces. `field`: q, which was multiplied by `scale`, or after M what A makes of its result.
  PD_DEVICE void run(PiecesPart part, const Quad<T>* field, double scale) const {
    double* product = c_.product[part == PiecesPart::after ? 1 : 0];
    restrict_to(field, product);
#pragma unroll 1
    for (int n = team_.warp(); n < piece_modes * levels_.pieces; n += team_.warps()) {
      double x = 0;
      if (c_.sound) {
        x = row(1, n, product);
        if (part != PiecesPart::before) x = row(0, n, c_.product[0]) / scale - x;
      }
      if (threadIdx.x % warp_size == 0) m_.mode[n] = x;
    }
    team_.barrier();
    set_motion();
  }

 private:
  // Z^T of a field, in every block
  PD_DEVICE void restrict_to(const Quad<T>* field, double* modes) const {
#pragma unroll 1
    for (int t = team_.warp(); t < levels_.piece_row_start[levels_.pieces]; t += team_.warps())
      add_task(t, field);
    team_.barrier();
    const int* start = levels_.piece_row_start;
    for (int n = threadIdx.x; n < piece_modes * levels_.pieces; n += blockDim.x) {
      const int piece = n / piece_modes;
      double sum = 0;
#pragma unroll 4
      for (int t = start[piece]; t < start[piece + 1]; ++t)
        sum += m_.row_sums[std::int64_t(t) * piece_block + n % piece_modes];
      modes[n] = sum;
    }
    __syncthreads();
    // turns about the centre of the piece
    if (int(threadIdx.x) < levels_.pieces) {
      double* m = modes + piece_modes * threadIdx.x;
      const Vec3<double> turn =
          cross(widened(m_.centre[threadIdx.x]), Vec3<double>{m[0], m[1], m[2]});
      m[3] -= turn.x;
      m[4] -= turn.y;
      m[5] -= turn.z;
    }
    __syncthreads();
  }

  PD_DEVICE void add_task(int number, const Quad<T>* field) const {
    const PieceTask task = PieceTask::of(levels_.piece_row_task, number);
    T sum[piece_modes] = {};
#pragma unroll 2
    for (int n = task.first + int(threadIdx.x) % warp_size; n < task.end; n += warp_size) {
      const int i = levels_.piece_row[n];
      const Quad<T> arm = m_.arm[i];
      const Vec3<T> q = vec3(field[i]);
      const T weight = share_of(levels_, i, task.row);
      if (!(arm.w > T(0))) continue;  // q may be NaN
      const Vec3<T> turn = cross(vec3(arm), q);
      const T part[piece_modes] = {q.x, q.y, q.z, turn.x, turn.y, turn.z};
#pragma unroll
      for (int c = 0; c < piece_modes; ++c) sum[c] = multiply_add(weight, part[c], sum[c]);
    }
    __syncwarp();
    write_warp_sums(sum, m_.row_sums + std::int64_t(number) * piece_block);
  }

  // Row n of an inverse times x. Called by a warp, a piece of the columns a lane.
  PD_DEVICE double row(int which, int n, const double* x) const {
    const int piece = n / piece_modes, mode = n % piece_modes;
    double sum = 0;
    for (int other = int(threadIdx.x) % warp_size; other < levels_.pieces; other += warp_size) {
      const bool lower = other <= piece;
      const int pair = lower ? piece_pair(piece, other) : piece_pair(other, piece);
      const double* block = m_.block[which] + std::int64_t(pair) * piece_block;
#pragma unroll
      for (int b = 0; b < piece_modes; ++b)
        sum += block[lower ? piece_modes * mode + b : piece_modes * b + mode] *
               x[piece_modes * other + b];
    }
    return warp_reduce(sum, Add{});
  }

  // in every block
  PD_DEVICE void set_motion() const {
    if (int(threadIdx.x) < levels_.pieces) {
      const int piece = threadIdx.x;
      const double* m = m_.mode + piece_modes * piece;
      const Vec3<double> turn = {m[3], m[4], m[5]}, back = cross(turn, widened(m_.centre[piece]));
      T* motion = c_.motion + piece_modes * piece;
      write3(motion, {T(m[0] - back.x), T(m[1] - back.y), T(m[2] - back.z)});
      write3(motion + 3, {T(turn.x), T(turn.y), T(turn.z)});
    }
    __syncthreads();
  }

  const Levels<T>& levels_;
  const PiecesMemory<T>& m_;
  BlockTeam& team_;
  PiecesControl<T>& c_;
};

// Out of line, so that the iterations keep their registers. Returns the team's state.
template <class T>
__device__ __noinline__ BlockTeam apply_pieces(PiecesControl<T>& control, BlockTeam team,
                                               PiecesPart part, const Quad<T>* field,
                                               double scale) {
  PiecesApplication<T>(control, team).run(part, field, scale);
  return team;
}

// The same: takes A Z times the modes from the right-hand side of a cycle, which is 0 where a pin holds a vertex.
template <class T>
__device__ __noinline__ BlockTeam hide_pieces(PiecesControl<T>& control, CycleMemory<T> memory,
                                              BlockTeam team) {
  const Levels<T>& levels = control.plan.levels;
  Quad<T>* field = control.memory.field;
#pragma unroll 1
  for (int i = team.thread(); i < levels.vertices; i += team.threads())
    field[i] = quad(moved_by_pieces(control, levels, i));
  team.barrier();
  DeviceCycle<T> cycle(levels, memory, team, nullptr);
  cycle.multiply(field, [&](int i, const Vec3<T>& product) {
    const bool moves = control.memory.arm[i].w > T(0);
    cycle.set(i, moves ? cycle.right_side(i) - product : Vec3<T>{T(0), T(0), T(0)});
  });
  return team;
}

// The same: A times the result of a cycle, in `field`; the result becomes 0 where a pin holds a vertex.
template <class T>
__device__ __noinline__ BlockTeam multiply_result(PiecesControl<T>& control, CycleMemory<T> memory,
                                                  BlockTeam team) {
  Quad<T>* field = control.memory.field;
  DeviceCycle<T> cycle(control.plan.levels, memory, team, nullptr);
#pragma unroll 1
  for (int i = team.thread(); i < control.plan.levels.vertices; i += team.threads()) {
    if (!(control.memory.arm[i].w > T(0))) cycle.set_result(i, {T(0), T(0), T(0)});
  }
  team.barrier();
  cycle.multiply(memory.fine.z, [&](int i, const Vec3<T>& product) { field[i] = quad(product); });
  return team;
}

}  // namespace pd::inline PD_TARGET
