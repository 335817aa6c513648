// The preconditioner M of solver/multilevel.h on a GPU: one V-cycle by a team of blocks, in a fixed order of sums.
#pragma once
#include "cuda/block_team.h"
#include "solver/multilevel.h"

namespace pd::inline PD_TARGET {

// Right side, result, and two to work with.
template <class T>
struct LevelFields {
  Quad<T>*in, *z, *rest, *part;
};

template <class T>
struct CycleMemory {
  LevelFields<T> fine, middle;  // [vertices], [4 fine nodes]
  Quad<T>*coarse_in, *coarse_half, *coarse_out;
};

// The arrays of one of several teams.
template <class T>
PD_DEVICE CycleMemory<T> cycle_of_team(const Levels<T>& levels, CycleMemory<T> m, int team) {
  const auto move = [team](LevelFields<T>& f, std::int64_t size) {
    f = {f.in + team * size, f.z + team * size, f.rest + team * size, f.part + team * size};
  };
  const std::int64_t coarse = 4 * std::int64_t(levels.coarse_nodes()) * team;
  move(m.fine, levels.vertices);
  move(m.middle, levels.has_middle() ? 4 * std::int64_t(levels.fine_nodes) : 0);
  m.coarse_in += coarse;
  m.coarse_half += coarse;
  m.coarse_out += coarse;
  return m;
}

template <class T>
PD_DEVICE Vec3<T> across_lanes(Vec3<T> sum, int most, int least) {
  for (int distance = most; distance >= least; distance /= 2) {
    sum = sum + Vec3<T>{__shfl_xor_sync(whole_warp, sum.x, distance),
                        __shfl_xor_sync(whole_warp, sum.y, distance),
                        __shfl_xor_sync(whole_warp, sum.z, distance)};
  }
  return sum;
}

template <class T>
class DeviceCycle {
 public:
  PD_DEVICE DeviceCycle(const Levels<T>& levels, const CycleMemory<T>& memory, BlockTeam& team)
      : levels_(levels), m_(memory), team_(team) {}

  // The right side at a vertex. All are set, and met by a barrier, before a run.
  PD_DEVICE void set(int i, const Vec3<T>& right) const {
    m_.fine.in[i] = quad(right);
    m_.fine.part[i] = quad(T(Smoother::first) * levels_.fine_inverse[i] * right);
  }
  PD_DEVICE Vec3<T> result(int i) const { return vec3(m_.fine.z[i]); }

  // result = M times what was set, there for all of the team when it returns
  PD_DEVICE void run() {
    const bool middle = levels_.has_middle();
    descend(fine_level(levels_), m_.fine);
    restrict_to(fine_level(levels_), m_.fine.rest, middle ? m_.middle.in : m_.coarse_in,
                levels_.middle_inverse, middle ? m_.middle.part : nullptr);
    if (middle) {
      descend(middle_level(levels_), m_.middle);
      restrict_to(middle_level(levels_), m_.middle.rest, m_.coarse_in, nullptr, nullptr);
    }
    solve_coarse();
    if (middle) ascend(middle_level(levels_), m_.middle, m_.coarse_out);
    ascend(fine_level(levels_), m_.fine, middle ? m_.middle.z : m_.coarse_out);
  }

 private:
  // Sums over the entries of rows, `Lanes` threads a sum, for which `term` gives what an entry adds: all of it is on the
  // way from memory at once. visit(unknown, sum) in one of these threads.
  template <int Lanes, int Together, int B, class Term, class Visit>
  PD_DEVICE void each_sum(const Level<B, T>& level, const int32* start, const Term& term,
                          const Visit& visit) {
    constexpr int per_warp = warp_size / Lanes;
    const int count = level.rows * B, lane = int(threadIdx.x) % Lanes;
    const int own = int(threadIdx.x) % warp_size / Lanes;
#pragma unroll 1
    for (int first = team_.warp() * per_warp; first < count; first += team_.warps() * per_warp) {
      const int at = min(first + own, count - 1), row = at / B, i = at % B;
      const int end = start[row + 1];
      Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 1
      for (int p = start[row] + lane; p < end; p += Together * Lanes) {
        Vec3<T> part[Together];
#pragma unroll
        for (int u = 0; u < Together; ++u) {
          const int entry = p + u * Lanes;
          part[u] = term(min(entry, end - 1), i);
          if (entry >= end) part[u] = {T(0), T(0), T(0)};
        }
#pragma unroll
        for (int u = 0; u < Together; ++u) sum = sum + part[u];
      }
      sum = across_lanes(sum, Lanes / 2, 1);
      if (lane == 0 && first + own < count) visit(at, sum);
    }
    team_.barrier();
  }

  // row of a table of fours, times four vectors
  PD_DEVICE static Vec3<T> four_products(const T* table, std::int64_t row, const Quad<T>* x) {
    const Quad<T> a = reinterpret_cast<const Quad<T>*>(table)[row];
    const Vec3<T> one = multiply_add(a.y, vec3(x[1]), a.x * vec3(x[0]));
    return one + multiply_add(a.w, vec3(x[3]), a.z * vec3(x[2]));
  }

  // visit(unknown, (A x) there)
  template <int B, class Visit>
  PD_DEVICE void each_product(const Level<B, T>& level, const Quad<T>* x, const Visit& visit) {
    each_sum<(B == 1 ? 4 : 8), (B == 1 ? 4 : 2)>(
        level, level.start,
        [&](int p, int i) {
          const std::int64_t from = std::int64_t(level.column[p]) * B;
          if constexpr (B == 1) {
            return level.value[p] * vec3(x[from]);
          } else {
            return four_products(level.value, std::int64_t(p) * B + i, x + from);
          }
        },
        visit);
  }

  // visit(unknown, (P x) there)
  template <int B, class Visit>
  PD_DEVICE void each_lift(const Level<B, T>& level, const Quad<T>* x, const Visit& visit) {
    each_sum<4, (B == 1 ? 1 : 2)>(
        level, level.lift_start,
        [&](int p, int i) {
          const std::int64_t from = std::int64_t(level.lift_node[p]) * 4;
          return four_products(level.lift_weight, std::int64_t(p) * B + i, x + from);
        },
        visit);
  }

  // smooth from zero, and what that leaves
  template <int B>
  PD_DEVICE void descend(const Level<B, T>& level, const LevelFields<T>& f) {
    each_product(level, f.part, [&](int at, const Vec3<T>& product) {
      f.z[at] = quad(smooth(level, f, vec3(f.in[at]), at, product));
    });
    each_product(level, f.z, [&](int at, const Vec3<T>& product) {
      f.rest[at] = quad(vec3(f.in[at]) - product);
    });
  }

  // correct by what the level below has found, and smooth
  template <int B>
  PD_DEVICE void ascend(const Level<B, T>& level, const LevelFields<T>& f, const Quad<T>* below) {
    each_lift(level, below,
              [&](int at, const Vec3<T>& lift) { f.z[at] = quad(vec3(f.z[at]) + lift); });
    each_product(level, f.z, [&](int at, const Vec3<T>& product) {
      const Vec3<T> rest = vec3(f.in[at]) - product;
      f.rest[at] = quad(rest);
      f.part[at] = quad(T(Smoother::first) * level.inverse[at] * rest);
    });
    each_product(level, f.part, [&](int at, const Vec3<T>& product) {
      f.z[at] = quad(vec3(f.z[at]) + smooth(level, f, vec3(f.rest[at]), at, product));
    });
  }

  // keep w + second / D (r - A w), w being f.part and `product` A w
  template <int B>
  PD_DEVICE static Vec3<T> smooth(const Level<B, T>& level, const LevelFields<T>& f,
                                  const Vec3<T>& right, int at, const Vec3<T>& product) {
    const T scale = T(Smoother::second) * level.inverse[at];
    return multiply_add(T(Smoother::keep), vec3(f.part[at]), scale * (right - product));
  }

  // A warp a node. `inverse`, `part`: what smoothing on the level below begins with; null for the dense one.
  template <int B>
  PD_DEVICE void restrict_to(const Level<B, T>& level, const Quad<T>* rest, Quad<T>* in,
                             const T* inverse, Quad<T>* part) {
    const int lane = int(threadIdx.x) % warp_size;
#pragma unroll 1
    for (int node = team_.warp(); node < level.nodes; node += team_.warps()) {
      Vec3<T> sum[4] = {};
#pragma unroll(B == 1 ? 4 : 1)
      for (int p = level.node_start[node] + lane; p < level.node_start[node + 1]; p += warp_size) {
        const std::int64_t row = level.node_row[p];
        const auto* weights = reinterpret_cast<const Quad<T>*>(level.lift_weight) +
                              std::int64_t(level.node_lift[p]) * B;
        for (int i = 0; i < B; ++i) {
          const Vec3<T> from = vec3(rest[row * B + i]);
          const Quad<T> weight = weights[i];
          sum[0] = multiply_add(weight.x, from, sum[0]);
          sum[1] = multiply_add(weight.y, from, sum[1]);
          sum[2] = multiply_add(weight.z, from, sum[2]);
          sum[3] = multiply_add(weight.w, from, sum[3]);
        }
      }
      for (int j = 0; j < 4; ++j) {
        sum[j] = across_lanes(sum[j], warp_size / 2, 1);
        if (lane != j) continue;
        const int at = 4 * node + j;
        in[at] = quad(sum[j]);
        if (part) part[at] = quad(T(Smoother::first) * inverse[at] * sum[j]);
      }
    }
    team_.barrier();
  }

  // L^-T (L^-1 r): symmetric and positive in any precision. A warp a row, then a warp a column.
  PD_DEVICE void solve_coarse() {
    const int n = 4 * levels_.coarse_nodes();
    each_dot(n, m_.coarse_in, m_.coarse_half, [&](int i) {
      return Stretch{levels_.coarse_factor + std::int64_t(i) * (i + 1) / 2, 0, i + 1};
    });
    each_dot(n, m_.coarse_half, m_.coarse_out, [&](int j) {
      // so that the numbers of row i are at i
      const std::int64_t diagonal = std::int64_t(j) * n - std::int64_t(j) * (j - 1) / 2;
      return Stretch{levels_.coarse_columns + diagonal - j, j, n};
    });
  }

  // Numbers first ... end - 1 of a row or column.
  struct Stretch {
    const T* number;
    int first, end;
  };

  template <class Of>
  PD_DEVICE void each_dot(int n, const Quad<T>* x, Quad<T>* out, const Of& of) {
    const int lane = int(threadIdx.x) % warp_size;
#pragma unroll 1
    for (int i = team_.warp(); i < n; i += team_.warps()) {
      const Stretch stretch = of(i);
      Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll 8
      for (int j = stretch.first + lane; j < stretch.end; j += warp_size)
        sum = multiply_add(stretch.number[j], vec3(x[j]), sum);
      sum = across_lanes(sum, warp_size / 2, 1);
      if (lane == 0) out[i] = quad(sum);
    }
    team_.barrier();
  }

  const Levels<T>& levels_;
  const CycleMemory<T>& m_;
  BlockTeam& team_;
};

}  // namespace pd::inline PD_TARGET
