// The preconditioner M of solver/multilevel/lbfgs.h on a GPU: one V-cycle or a direct solve, by a team of
// blocks, with sums in a fixed order.
#pragma once
#include "cuda/common/block_team.h"
#include "solver/multilevel/lbfgs.h"

namespace pd::inline PD_TARGET {

// Right-hand side, result, and two work vectors, which a direct solve does not need.
template <class T>
struct LevelFields {
  Quad<T>*right, *z, *residual, *initial;
};

template <class T>
struct CycleMemory {
  LevelFields<T> fine, middle;  // [vertices], [4 fine nodes]
  Quad<T>*coarse_in, *coarse_half, *coarse_out;
};

// The arrays of one team.
template <class T>
PD_DEVICE CycleMemory<T> cycle_of_team(const Levels<T>& levels, CycleMemory<T> m, int team) {
  const auto move = [team](LevelFields<T>& f, std::int64_t size) {
    f = {f.right + team * size, f.z + team * size, f.residual + team * size,
         f.initial + team * size};
  };
  const std::int64_t coarse = std::int64_t(levels.coarse_unknowns()) * team;
  move(m.fine, levels.vertices);
  move(m.middle, levels.has_middle() ? 4 * std::int64_t(levels.fine_nodes) : 0);
  m.coarse_in += coarse;
  m.coarse_half += coarse;
  m.coarse_out += coarse;
  return m;
}

template <class T>
PD_DEVICE Vec3<T> sum_over_lanes(Vec3<T> sum, int most, int least) {
  for (int distance = most; distance >= least; distance /= 2) {
    sum = sum + Vec3<T>{__shfl_xor_sync(full_warp, sum.x, distance),
                        __shfl_xor_sync(full_warp, sum.y, distance),
                        __shfl_xor_sync(full_warp, sum.z, distance)};
  }
  return sum;
}

// Maximum number of warps per node; every block's number of warps is a multiple of it.
constexpr int most_parts = 8;

template <class T>
class DeviceCycle {
 public:
  // `warp_sums`: shared memory for four vectors per warp of the block
  PD_DEVICE DeviceCycle(const Levels<T>& levels, const CycleMemory<T>& memory, BlockTeam& team,
                        Quad<T>* warp_sums)
      : levels_(levels), m_(memory), team_(team), warp_sums_(warp_sums) {}

  // Sets the right-hand side at a vertex. All vertices are set, followed by a team barrier, before
  // a run.
  PD_DEVICE void set(int i, const Vec3<T>& right) const {
    const T inverse = levels_.fine_inverse[i];
    if (levels_.direct) {
      // pinned vertices are excluded, since they may be NaN
      m_.fine.right[i] = quad(inverse > T(0) ? right : Vec3<T>{T(0), T(0), T(0)});
      return;
    }
    m_.fine.right[i] = quad(right);
    m_.fine.initial[i] = quad(T(Smoother::first) * inverse * right);
  }
  PD_DEVICE const Quad<T>* right_sides() const { return m_.fine.right; }
  PD_DEVICE Vec3<T> right_side(int i) const { return vec3(m_.fine.right[i]); }
  PD_DEVICE Vec3<T> result(int i) const { return vec3(m_.fine.z[i]); }
  PD_DEVICE void set_result(int i, const Vec3<T>& z) const { m_.fine.z[i] = quad(z); }

  // Calls visit(vertex, A x there), whose results are visible to the whole team on return.
  template <class Visit>
  PD_DEVICE void multiply(const Quad<T>* x, const Visit& visit) {
    each_product(fine_level(levels_), x, visit);
    team_.barrier();
  }

  // Computes result = M times the right-hand side, visible to the whole team on return.
  PD_DEVICE void run() {
    run_but_last();
    finish();
  }

  // All of M but its last phase, which finish() or run_last() completes. Work between two barriers
  // is independent.
  PD_DEVICE void run_but_last() {
    const Level<1, T> fine = fine_level(levels_);
    const Level<4, T> middle = middle_level(levels_);
    const bool direct = levels_.direct, three = levels_.has_middle();
    if (!direct) {
      restrict_to(fine, m_.fine, three ? m_.middle.right : m_.coarse_in,
                  three ? m_.middle.initial : nullptr);
      smooth(fine, m_.fine);
      team_.barrier();
      compute_residual(fine, m_.fine);
    }
    if (three) {
      restrict_to(middle, m_.middle, m_.coarse_in, nullptr);
      smooth(middle, m_.middle);
      team_.barrier();
      compute_residual(middle, m_.middle);
    }
    solve_rows();
    team_.barrier();
    if (direct) return;
    solve_columns();
    smooth_residual(fine, m_.fine);
    if (three) {
      smooth_residual(middle, m_.middle);
      team_.barrier();
      prolongate(middle, m_.middle, m_.coarse_out);
    }
    team_.barrier();
  }

  // The last phase, by the team.
  PD_DEVICE void finish() {
    if (levels_.direct) {
      solve_columns();
    } else {
      prolongate(fine_level(levels_), m_.fine, below_fine());
    }
    team_.barrier();
  }

  // The last phase at the vertices row(0 ... count - 1) that exist, for the threads of this block;
  // a block barrier must follow. `count` is a multiple of 32, and rows are consecutive from each
  // multiple of 32 on.
  template <class Row>
  PD_DEVICE void run_last(int count, const Row& row);  // cuda/multilevel/dense_solve.h

 private:
  template <int B>
  static constexpr int prolongation_lanes = B == 1 ? 4 : 8;
  // entries of a node that a lane loads at once
  static constexpr int in_flight = sizeof(T) == 4 ? 8 : 4;
  // and has at most, before more warps share a node
  static constexpr int most_entries_per_lane = 16;

  // One entry of a row: its vectors and their factors.
  template <int Count>
  struct Entry {
    const Quad<T>* from;
    T factor[Count];
  };

  // A lane's partial sum over the entries of a row, for unknown i; `read` loads an entry. A lane
  // loads `InFlight` entries, then all of their vectors.
  template <int Lanes, int InFlight, int Count, class Read>
  PD_DEVICE static Vec3<T> sum_of(const int32* start, int row, int i, int lane, const Read& read) {
    const int end = start[row + 1];
    Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 1
    for (int p = start[row] + lane; p < end; p += InFlight * Lanes) {
      Entry<Count> entry[InFlight];
      Vec3<T> x[InFlight][Count];
#pragma unroll
      for (int u = 0; u < InFlight; ++u) read(min(p + u * Lanes, end - 1), i, entry[u]);
#pragma unroll
      for (int u = 0; u < InFlight; ++u) {
#pragma unroll
        for (int c = 0; c < Count; ++c) x[u][c] = vec3(entry[u].from[c]);
      }
#pragma unroll
      for (int u = 0; u < InFlight; ++u) {
        const Vec3<T> part = product(entry[u].factor, x[u]);
        const bool in = p + u * Lanes < end;
        sum = {select(in, sum.x + part.x, sum.x), select(in, sum.y + part.y, sum.y),
               select(in, sum.z + part.z, sum.z)};
      }
    }
    return sum;
  }

  // Calls visit(unknown, sum) for the unknowns of a level, on one of the `Lanes` threads that
  // compute its partial sums part(row, unknown in the row, lane). It starts from the last warps,
  // since concurrent work keeps the first warps busy.
  template <int Lanes, int B, class Part, class Visit>
  PD_DEVICE void each_sum(const Level<B, T>& level, const Part& part, const Visit& visit) {
    constexpr int per_warp = warp_size / Lanes;
    const int count = level.rows * B, lane = int(threadIdx.x) % Lanes;
    const int own = int(threadIdx.x) % warp_size / Lanes;
#pragma unroll 1
    for (int first = (team_.warps() - 1 - team_.warp()) * per_warp; first < count;
         first += team_.warps() * per_warp) {
      const int at = min(first + own, count - 1);
      const Vec3<T> sum = sum_over_lanes(part(at / B, at % B, lane), Lanes / 2, 1);
      if (lane == 0 && first + own < count) visit(at, sum);
    }
  }

  PD_DEVICE static Vec3<T> product(const T (&a)[1], const Vec3<T> (&x)[1]) { return a[0] * x[0]; }
  PD_DEVICE static Vec3<T> product(const T (&a)[4], const Vec3<T> (&x)[4]) {
    return multiply_add(a[1], x[1], a[0] * x[0]) + multiply_add(a[3], x[3], a[2] * x[2]);
  }

  // one row of a table with four columns
  PD_DEVICE static void read_quad(const T* table, std::int64_t row, T (&factor)[4]) {
    const Quad<T> a = reinterpret_cast<const Quad<T>*>(table)[row];
    factor[0] = a.x;
    factor[1] = a.y;
    factor[2] = a.z;
    factor[3] = a.w;
  }

  // visit(unknown, (A x) there)
  template <int B, class Visit>
  PD_DEVICE void each_product(const Level<B, T>& level, const Quad<T>* x, const Visit& visit) {
    constexpr int lanes = B == 1 ? 4 : 8, together = B == 1 || sizeof(T) == 4 ? 4 : 2;
    const auto read = [&](int p, int i, Entry<B>& entry) {
      entry.from = x + std::int64_t(level.column[p]) * B;
      if constexpr (B == 1) {
        entry.factor[0] = level.value[p];
      } else {
        read_quad(level.value, std::int64_t(p) * B + i, entry.factor);
      }
    };
    const auto part = [&](int row, int i, int lane) {
      return sum_of<lanes, together, B>(level.start, row, i, lane, read);
    };
    each_sum<lanes>(level, part, visit);
  }

  // z = S r, from zero
  template <int B>
  PD_DEVICE void smooth(const Level<B, T>& level, const LevelFields<T>& f) {
    each_product(level, f.initial, [&](int at, const Vec3<T>& product) {
      f.z[at] = quad(smoothed(level, f, vec3(f.right[at]), at, product));
    });
  }

  // the residual r - A z
  template <int B>
  PD_DEVICE void compute_residual(const Level<B, T>& level, const LevelFields<T>& f) {
    each_product(level, f.z, [&](int at, const Vec3<T>& product) {
      const Vec3<T> residual = vec3(f.right[at]) - product;
      f.residual[at] = quad(residual);
      f.initial[at] = quad(T(Smoother::first) * level.inverse[at] * residual);
    });
  }

  // z += S residual
  template <int B>
  PD_DEVICE void smooth_residual(const Level<B, T>& level, const LevelFields<T>& f) {
    each_product(level, f.initial, [&](int at, const Vec3<T>& product) {
      f.z[at] = quad(vec3(f.z[at]) + smoothed(level, f, vec3(f.residual[at]), at, product));
    });
  }

  // a lane's partial sum of (F y) at unknown i of a row; y is the result of the coarser level
  template <int B>
  PD_DEVICE static Vec3<T> prolongated(const Level<B, T>& level, const Quad<T>* below, int row,
                                       int i, int lane) {
    const auto read = [&](int p, int number, Entry<4>& entry) {
      entry.from = below + std::int64_t(level.prolongation_node[p]) * 4;
      read_quad(level.prolongation_weight, std::int64_t(p) * B + number, entry.factor);
    };
    return sum_of<prolongation_lanes<B>, 2, 4>(level.prolongation_start, row, i, lane, read);
  }

  // z += F y
  template <int B>
  PD_DEVICE void prolongate(const Level<B, T>& level, const LevelFields<T>& f,
                            const Quad<T>* below) {
    const auto part = [&](int row, int i, int lane) {
      return prolongated(level, below, row, i, lane);
    };
    each_sum<prolongation_lanes<B>>(
        level, part, [&](int at, const Vec3<T>& sum) { f.z[at] = quad(vec3(f.z[at]) + sum); });
  }
  PD_DEVICE const Quad<T>* below_fine() const {
    return levels_.has_middle() ? m_.middle.z : m_.coarse_out;
  }

  // keep w + second / D (r - A w), with w = f.initial and `product` = A w
  template <int B>
  PD_DEVICE static Vec3<T> smoothed(const Level<B, T>& level, const LevelFields<T>& f,
                                    const Vec3<T>& right, int at, const Vec3<T>& product) {
    const T scale = T(Smoother::second) * level.inverse[at];
    return multiply_add(T(Smoother::keep), vec3(f.initial[at]), scale * (right - product));
  }

  // Restriction F^T r: one warp per node, or several warps of a block for nodes with many entries,
  // decided by the plan alone. `initial`: the coarser level's first smoothing vector, null for the
  // dense level. Called by all threads.
  template <int B>
  PD_DEVICE void restrict_to(const Level<B, T>& level, const LevelFields<T>& f, Quad<T>* in,
                             Quad<T>* initial) {
    const std::int64_t entries = std::int64_t(level.prolongation_start[level.rows]) * B;
    int parts = 1;
    while (parts < most_parts &&
           entries > std::int64_t(parts) * level.nodes * warp_size * most_entries_per_lane)
      parts *= 2;
    // blocks have a multiple of most_parts warps
    const int warp = int(threadIdx.x) / warp_size, lane = int(threadIdx.x) % warp_size;
    const int together = int(blockDim.x) / warp_size / parts;
    const auto keep = [&](int at, const Vec3<T>& sum) {
      in[at] = quad(sum);
      if (initial) initial[at] = quad(T(Smoother::first) * levels_.middle_inverse[at] * sum);
    };
#pragma unroll 1
    for (int first = 0; first < level.nodes; first += together * team_.blocks()) {
      const auto node_of = [&](int number) {
        return first + number * team_.blocks() + team_.rank();
      };
      const int node = node_of(warp / parts);
      Vec3<T> sum[4] = {};
      if (node < level.nodes)
        add_node(level, f.right, node, warp % parts * warp_size + lane, parts * warp_size, sum);
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        const Vec3<T> total = sum_over_lanes(sum[j], warp_size / 2, 1);
        if (lane != j) continue;
        if (parts > 1) {
          warp_sums_[warp * 4 + j] = quad(total);
        } else if (node < level.nodes) {
          keep(4 * node + j, total);
        }
      }
      if (parts == 1) continue;
      __syncthreads();
      const int number = int(threadIdx.x) / 4, j = int(threadIdx.x) % 4;
      if (number < together && node_of(number) < level.nodes) {
        Vec3<T> total = {T(0), T(0), T(0)};
        for (int p = 0; p < parts; ++p)
          total = total + vec3(warp_sums_[(number * parts + p) * 4 + j]);
        keep(4 * node_of(number) + j, total);
      }
      __syncthreads();
    }
  }

  // Sums over the entries first, first + stride, ... of a node.
  template <int B>
  PD_DEVICE static void add_node(const Level<B, T>& level, const Quad<T>* from, int node, int first,
                                 int stride, Vec3<T> (&sum)[4]) {
    const auto* weights = reinterpret_cast<const Quad<T>*>(level.node_weight);
    const std::int64_t begin = std::int64_t(level.node_start[node]) * B;
    const int count = (level.node_start[node + 1] - level.node_start[node]) * B;
#pragma unroll 1
    for (int p = first; p < count; p += in_flight * stride) {
      Vec3<T> x[in_flight];
      Quad<T> weight[in_flight];
      int row[in_flight];
#pragma unroll
      for (int u = 0; u < in_flight; ++u) {
        const std::int64_t at = begin + min(p + u * stride, count - 1);
        row[u] = level.node_row[at / B] * B + int(at % B);
        weight[u] = weights[at];
      }
#pragma unroll
      for (int u = 0; u < in_flight; ++u) x[u] = vec3(from[row[u]]);
#pragma unroll
      for (int u = 0; u < in_flight; ++u) {
        if (p + u * stride >= count) continue;
        const T w[4] = {weight[u].x, weight[u].y, weight[u].z, weight[u].w};
#pragma unroll
        for (int j = 0; j < 4; ++j) sum[j] = multiply_add(w[j], x[u], sum[j]);
      }
    }
  }

  // ---- multiplication by L^-1: cuda/multilevel/dense_solve.h

  struct Segment;
  struct TriangularFactor;
  PD_DEVICE void solve_rows();
  PD_DEVICE void solve_columns();
  PD_DEVICE TriangularFactor columns() const;
  PD_DEVICE void multiply_factor(const TriangularFactor& a);
  template <int Rows>
  static __device__ __noinline__ void multiply_rows(TriangularFactor a, int i);
  template <int Count, int Rows>
  PD_DEVICE static void add_chunks(const Quad<T>* x, const Segment (&segment)[Rows], int j,
                                   Vec3<T> (&sum)[Rows]);
  template <int Rows>
  PD_DEVICE static void add_part(int n, const Quad<T>* x, const Segment (&segment)[Rows], int chunk,
                                 Vec3<T> (&sum)[Rows]);

  const Levels<T>& levels_;
  const CycleMemory<T>& m_;
  BlockTeam& team_;
  Quad<T>* warp_sums_;
};

}  // namespace pd::inline PD_TARGET
