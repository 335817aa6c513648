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

constexpr int strip_columns = 8;  // of the dense level that a block adds up together
constexpr int strip_rows = warp_size / strip_columns;
constexpr int strip_warps = 12;  // of a block, at most

// In shared memory: what the warps of a block have of a strip.
template <class T>
struct StripSums {
  Vec3<T> warp[strip_warps][strip_columns];
};

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
  PD_DEVICE DeviceCycle(const Levels<T>& levels, const CycleMemory<T>& memory, BlockTeam& team,
                        StripSums<T>& strip)
      : levels_(levels), m_(memory), team_(team), strip_(strip) {}

  // The right side at a vertex. All are set, and met by a barrier, before a run.
  PD_DEVICE void set(int i, const Vec3<T>& right) const {
    m_.fine.in[i] = quad(right);
    m_.fine.part[i] = quad(T(Smoother::first) * levels_.fine_inverse[i] * right);
  }
  PD_DEVICE Vec3<T> result(int i) const { return vec3(m_.fine.z[i]); }

  // result = M times what was set, there for all of the team when it returns
  PD_DEVICE void run() {
    const Level<1, T> fine = fine_level(levels_);
    if (levels_.has_middle()) {
      const Level<4, T> middle = middle_level(levels_);
      descend(fine, m_.fine);
      restrict_to(fine, m_.fine.rest, m_.middle.in, levels_.middle_inverse, m_.middle.part);
      descend(middle, m_.middle);
      restrict_to(middle, m_.middle.rest, m_.coarse_in, nullptr, nullptr);
      solve_coarse();
      ascend(middle, m_.middle, m_.coarse_out);
      ascend(fine, m_.fine, m_.middle.z);
    } else {
      descend(fine, m_.fine);
      restrict_to(fine, m_.fine.rest, m_.coarse_in, nullptr, nullptr);
      solve_coarse();
      ascend(fine, m_.fine, m_.coarse_out);
    }
  }

 private:
  // visit(row, which of its unknowns, unknown)
  template <int B, class Visit>
  PD_DEVICE void each_unknown(const Level<B, T>& level, const Visit& visit) {
    for (int at = team_.thread(); at < level.rows * B; at += team_.threads())
      visit(at / B, at % B, at);
    team_.barrier();
  }

  // smooth from zero, and what that leaves
  template <int B>
  PD_DEVICE void descend(const Level<B, T>& level, const LevelFields<T>& f) {
    each_unknown(level, [&](int row, int i, int at) {
      f.z[at] = quad(smooth(level, f, vec3(f.in[at]), row, i));
    });
    each_unknown(level, [&](int row, int i, int at) {
      f.rest[at] = quad(subtract_unknown(level, reader(f.z), row, i, vec3(f.in[at])));
    });
  }

  // correct by what the level below has found, and smooth
  template <int B>
  PD_DEVICE void ascend(const Level<B, T>& level, const LevelFields<T>& f, const Quad<T>* below) {
    each_unknown(level, [&](int row, int i, int at) {
      f.z[at] = quad(lift_unknown(level, reader(below), row, i, vec3(f.z[at])));
    });
    each_unknown(level, [&](int row, int i, int at) {
      const Vec3<T> rest = subtract_unknown(level, reader(f.z), row, i, vec3(f.in[at]));
      f.rest[at] = quad(rest);
      f.part[at] = quad(T(Smoother::first) * level.inverse[at] * rest);
    });
    each_unknown(level, [&](int row, int i, int at) {
      f.z[at] = quad(vec3(f.z[at]) + smooth(level, f, vec3(f.rest[at]), row, i));
    });
  }

  // keep w + second / D (r - A w), w being f.part
  template <int B>
  PD_DEVICE static Vec3<T> smooth(const Level<B, T>& level, const LevelFields<T>& f,
                                  const Vec3<T>& right, int row, int i) {
    const int at = row * B + i;
    const Vec3<T> rest = subtract_unknown(level, reader(f.part), row, i, right);
    const T scale = T(Smoother::second) * level.inverse[at];
    return multiply_add(T(Smoother::keep), vec3(f.part[at]), scale * rest);
  }

  PD_DEVICE static auto reader(const Quad<T>* x) {
    return [x](std::int64_t at) { return vec3(x[at]); };
  }

  // A warp a node. `inverse`, `part`: what smoothing on the level below begins with; null for the dense one.
  template <int B>
  PD_DEVICE void restrict_to(const Level<B, T>& level, const Quad<T>* rest, Quad<T>* in,
                             const T* inverse, Quad<T>* part) {
    const int lane = int(threadIdx.x) % warp_size;
    for (int node = team_.warp(); node < level.nodes; node += team_.warps()) {
      Vec3<T> sum[4] = {};
      for (int p = level.node_start[node] + lane; p < level.node_start[node + 1]; p += warp_size) {
        const std::int64_t row = level.node_row[p];
        const T* weight = level.lift_weight + std::int64_t(level.node_lift[p]) * B * 4;
        for (int i = 0; i < B; ++i) {
          const Vec3<T> from = vec3(rest[row * B + i]);
          for (int j = 0; j < 4; ++j) sum[j] = multiply_add(weight[i * 4 + j], from, sum[j]);
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

  PD_DEVICE const T* factor_row(int i) const {
    return levels_.coarse_factor + std::int64_t(i) * (i + 1) / 2;
  }

  // L^-T (L^-1 r): symmetric and positive in any precision
  PD_DEVICE void solve_coarse() {
    const int n = 4 * levels_.coarse_nodes(), lane = int(threadIdx.x) % warp_size;
    for (int i = team_.warp(); i < n; i += team_.warps()) {
      const T* row = factor_row(i);
      Vec3<T> sum = {T(0), T(0), T(0)};
      for (int j = lane; j <= i; j += warp_size)
        sum = multiply_add(row[j], vec3(m_.coarse_in[j]), sum);
      sum = across_lanes(sum, warp_size / 2, 1);
      if (lane == 0) m_.coarse_half[i] = quad(sum);
    }
    team_.barrier();
    for (int first = team_.rank() * strip_columns; first < n;
         first += team_.blocks() * strip_columns)
      add_up_strip(first, n);
    team_.barrier();
  }

  // Columns first ... of L^-1 times half, by all warps of a block.
  PD_DEVICE void add_up_strip(int first, int n) {
    const int lane = int(threadIdx.x) % warp_size, warp = int(threadIdx.x) / warp_size;
    const int warps = int(blockDim.x) / warp_size, column = lane % strip_columns;
    Vec3<T> sum = {T(0), T(0), T(0)};
    for (int i = first + warp * strip_rows + lane / strip_columns; i < n; i += warps * strip_rows) {
      if (first + column <= i)
        sum = multiply_add(factor_row(i)[first + column], vec3(m_.coarse_half[i]), sum);
    }
    sum = across_lanes(sum, warp_size / 2, strip_columns);
    if (lane < strip_columns) strip_.warp[warp][column] = sum;
    __syncthreads();
    if (int(threadIdx.x) < strip_columns && first + column < n) {
      Vec3<T> total = strip_.warp[0][column];
      for (int w = 1; w < warps; ++w) total = total + strip_.warp[w][column];
      m_.coarse_out[first + column] = quad(total);
    }
    __syncthreads();
  }

  const Levels<T>& levels_;
  const CycleMemory<T>& m_;
  BlockTeam& team_;
  StripSums<T>& strip_;
};

}  // namespace pd::inline PD_TARGET
