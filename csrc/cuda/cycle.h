// The preconditioner M of solver/multilevel.h on a GPU: one V-cycle, or a direct solve, by a team of blocks, in a fixed order of sums.
#pragma once
#include "cuda/block_team.h"
#include "solver/multilevel.h"

namespace pd::inline PD_TARGET {

// Right side, result, and two to work with that a direct solve does without.
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
  const std::int64_t coarse = std::int64_t(levels.coarse_unknowns()) * team;
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
    const T inverse = levels_.fine_inverse[i];
    if (levels_.direct) {
      // what is held has no part in a product, be it NaN
      m_.fine.in[i] = quad(inverse > T(0) ? right : Vec3<T>{T(0), T(0), T(0)});
      return;
    }
    m_.fine.in[i] = quad(right);
    m_.fine.part[i] = quad(T(Smoother::first) * inverse * right);
  }
  PD_DEVICE Vec3<T> right_side(int i) const { return vec3(m_.fine.in[i]); }
  PD_DEVICE Vec3<T> result(int i) const { return vec3(m_.fine.z[i]); }
  PD_DEVICE void set_result(int i, const Vec3<T>& z) const { m_.fine.z[i] = quad(z); }

  // result = M times what was set, there for all of the team when it returns
  PD_DEVICE void run() {
    const bool middle = levels_.has_middle(), direct = levels_.direct;
    if (!direct) {
      descend(fine_level(levels_), m_.fine);
      restrict_to(fine_level(levels_), m_.fine.rest, middle ? m_.middle.in : m_.coarse_in,
                  levels_.middle_inverse, middle ? m_.middle.part : nullptr);
    }
    if (middle) {
      descend(middle_level(levels_), m_.middle);
      restrict_to(middle_level(levels_), m_.middle.rest, m_.coarse_in, nullptr, nullptr);
    }
    solve_coarse(direct ? m_.fine.in : m_.coarse_in, direct ? m_.fine.z : m_.coarse_out);
    if (middle) ascend(middle_level(levels_), m_.middle, m_.coarse_out);
    if (!direct) ascend(fine_level(levels_), m_.fine, middle ? m_.middle.z : m_.coarse_out);
  }

 private:
  // One entry of a row: where its vectors stand, and their factors.
  template <int Count>
  struct Entry {
    const Quad<T>* from;
    T factor[Count];
  };

  // Sums over the entries of rows, `Lanes` threads a sum, for which `read` gives an entry. A thread asks for `Together` entries,
  // then for all of their vectors. visit(unknown, sum) in one of these threads.
  template <int Lanes, int Together, int Count, int B, class Read, class Visit>
  PD_DEVICE void each_sum(const Level<B, T>& level, const int32* start, const Read& read,
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
        Entry<Count> entry[Together];
        Vec3<T> x[Together][Count];
#pragma unroll
        for (int u = 0; u < Together; ++u) read(min(p + u * Lanes, end - 1), i, entry[u]);
#pragma unroll
        for (int u = 0; u < Together; ++u) {
#pragma unroll
          for (int c = 0; c < Count; ++c) x[u][c] = vec3(entry[u].from[c]);
        }
#pragma unroll
        for (int u = 0; u < Together; ++u) {
          const Vec3<T> part = product(entry[u].factor, x[u]);
          const bool in = p + u * Lanes < end;
          sum = {select(in, sum.x + part.x, sum.x), select(in, sum.y + part.y, sum.y),
                 select(in, sum.z + part.z, sum.z)};
        }
      }
      sum = across_lanes(sum, Lanes / 2, 1);
      if (lane == 0 && first + own < count) visit(at, sum);
    }
    team_.barrier();
  }

  PD_DEVICE static Vec3<T> product(const T (&a)[1], const Vec3<T> (&x)[1]) { return a[0] * x[0]; }
  PD_DEVICE static Vec3<T> product(const T (&a)[4], const Vec3<T> (&x)[4]) {
    return multiply_add(a[1], x[1], a[0] * x[0]) + multiply_add(a[3], x[3], a[2] * x[2]);
  }

  // a row of a table of fours
  PD_DEVICE static void read_four(const T* table, std::int64_t row, T (&factor)[4]) {
    const Quad<T> a = reinterpret_cast<const Quad<T>*>(table)[row];
    factor[0] = a.x;
    factor[1] = a.y;
    factor[2] = a.z;
    factor[3] = a.w;
  }

  // visit(unknown, (A x) there)
  template <int B, class Visit>
  PD_DEVICE void each_product(const Level<B, T>& level, const Quad<T>* x, const Visit& visit) {
    each_sum<(B == 1 ? 4 : 8), (B == 1 ? 4 : 2), B>(
        level, level.start,
        [&](int p, int i, Entry<B>& entry) {
          entry.from = x + std::int64_t(level.column[p]) * B;
          if constexpr (B == 1) {
            entry.factor[0] = level.value[p];
          } else {
            read_four(level.value, std::int64_t(p) * B + i, entry.factor);
          }
        },
        visit);
  }

  // visit(unknown, (P x) there)
  template <int B, class Visit>
  PD_DEVICE void each_lift(const Level<B, T>& level, const Quad<T>* x, const Visit& visit) {
    each_sum<4, (B == 1 ? 1 : 2), 4>(
        level, level.lift_start,
        [&](int p, int i, Entry<4>& entry) {
          entry.from = x + std::int64_t(level.lift_node[p]) * 4;
          read_four(level.lift_weight, std::int64_t(p) * B + i, entry.factor);
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
#pragma unroll
      for (int j = 0; j < 4; ++j) {
        const Vec3<T> total = across_lanes(sum[j], warp_size / 2, 1);
        if (lane != j) continue;
        const int at = 4 * node + j;
        in[at] = quad(total);
        if (part) part[at] = quad(T(Smoother::first) * inverse[at] * total);
      }
    }
    team_.barrier();
  }

  // L^-T (L^-1 r): symmetric and positive in any precision. A warp a row, then a warp a column.
  PD_DEVICE void solve_coarse(const Quad<T>* in, Quad<T>* out) {
    const int n = levels_.coarse_unknowns();
    each_dot(n, in, m_.coarse_half, [&](int i) {
      return Stretch{levels_.coarse_factor + std::int64_t(i) * (i + 1) / 2, 0, i + 1};
    });
    each_dot(n, m_.coarse_half, out, [&](int j) {
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
    if (n <= team_.warps()) {
      dots<1>(n, x, out, of);
    } else {
      dots<4>(n, x, out, of);
    }
    team_.barrier();
  }

  // `Rows` neighbouring stretches by a warp, chunk by chunk of a number for each lane.
  template <int Rows, class Of>
  PD_DEVICE void dots(int n, const Quad<T>* x, Quad<T>* out, const Of& of) {
    const int lane = int(threadIdx.x) % warp_size;
#pragma unroll 1
    for (int i = team_.warp() * Rows; i < n; i += team_.warps() * Rows) {
      Stretch stretch[Rows];
      Vec3<T> sum[Rows];
#pragma unroll
      for (int r = 0; r < Rows; ++r) {
        stretch[r] = of(min(i + r, n - 1));
        sum[r] = {T(0), T(0), T(0)};
      }
      // rows end where they are, columns begin there; chunks that all of them fill lie between
      const Stretch &one = stretch[0], &other = stretch[Rows - 1];
      const int full = (other.first + warp_size - 1) / warp_size, part = one.end / warp_size;
      int chunk = one.first / warp_size;
#pragma unroll 1
      for (; chunk < min(full, part); ++chunk) add_part(n, x, stretch, chunk, sum);
      constexpr int together = Rows == 1 ? 8 : 4;
#pragma unroll 1
      for (; chunk + together <= part; chunk += together)
        add_chunks<together>(x, stretch, chunk * warp_size + lane, sum);
#pragma unroll 1
      for (; chunk < part; ++chunk) add_chunks<1>(x, stretch, chunk * warp_size + lane, sum);
#pragma unroll 1
      for (; chunk * warp_size < other.end; ++chunk) add_part(n, x, stretch, chunk, sum);
#pragma unroll
      for (int r = 0; r < Rows; ++r) {
        const Vec3<T> total = across_lanes(sum[r], warp_size / 2, 1);
        if (lane == 0 && i + r < n) out[i + r] = quad(total);
      }
    }
  }

  // chunks from number j on; everything is asked for before it is used
  template <int Count, int Rows>
  PD_DEVICE static void add_chunks(const Quad<T>* x, const Stretch (&stretch)[Rows], int j,
                                   Vec3<T> (&sum)[Rows]) {
    T number[Count][Rows];
    Vec3<T> at[Count];
#pragma unroll
    for (int u = 0; u < Count; ++u) {
      at[u] = vec3(x[j + u * warp_size]);
#pragma unroll
      for (int r = 0; r < Rows; ++r) number[u][r] = stretch[r].number[j + u * warp_size];
    }
#pragma unroll
    for (int u = 0; u < Count; ++u) {
#pragma unroll
      for (int r = 0; r < Rows; ++r) sum[r] = multiply_add(number[u][r], at[u], sum[r]);
    }
  }

  // a chunk of which some stretches have a part
  template <int Rows>
  PD_DEVICE static void add_part(int n, const Quad<T>* x, const Stretch (&stretch)[Rows], int chunk,
                                 Vec3<T> (&sum)[Rows]) {
    const int j = chunk * warp_size + int(threadIdx.x) % warp_size;
    const Vec3<T> at = vec3(x[min(j, n - 1)]);
    T number[Rows];
#pragma unroll
    for (int r = 0; r < Rows; ++r)
      number[r] = stretch[r].number[min(max(j, stretch[r].first), stretch[r].end - 1)];
#pragma unroll
    for (int r = 0; r < Rows; ++r) {
      const bool in = j >= stretch[r].first && j < stretch[r].end;
      const Vec3<T> more = multiply_add(number[r], at, sum[r]);
      sum[r] = {select(in, more.x, sum[r].x), select(in, more.y, sum[r].y),
                select(in, more.z, sum[r].z)};
    }
  }

  const Levels<T>& levels_;
  const CycleMemory<T>& m_;
  BlockTeam& team_;
};

}  // namespace pd::inline PD_TARGET
