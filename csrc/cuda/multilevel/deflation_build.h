// Builds the coarse problem of solver/multilevel/deflation.h at an iterate, by a team of blocks; see also
// cpu/multilevel/deflation_build.h.
#pragma once
#include "cuda/elements/tet_per_lane.h"
#include "cuda/multilevel/call.h"
#include "cuda/multilevel/deflation_tile.h"

namespace pd::inline PD_TARGET {

// Inputs of one environment: x; 1 / D in the w of u; a in the w of `inertia`; the iterate; and w V
// of every pair.
template <class T>
struct CorotationInput {
  const Quad<T>*x, *u, *inertia, *iterate;
  const T* weights;
};

template <class T>
class CorotationMaker {
  static constexpr int threads_of_row = 4;  // of A

 public:
  PD_DEVICE CorotationMaker(const CorotationInput<T>& in, const CorotationMemory<T>& memory,
                            BlockTeam& team, std::byte* scratch, std::size_t scratch_bytes,
                            double stiffness_ratio, CorotationControl<T>& control)
      : plan_(control.plan),
        scratch_(scratch),
        scratch_bytes_(scratch_bytes),
        stiffness_ratio_(stiffness_ratio),
        in_(in),
        m_(memory),
        team_(team),
        c_(control) {}

  PD_DEVICE void make() const {
    const Vec3<T> centroid = find_centroid();
    for (int i = team_.thread(); i < plan_.vertices; i += team_.threads())
      set(i, (vec3(in_.x[i]) - centroid) + vec3(in_.iterate[i]), in_.u[i].w > T(0));
    team_.barrier();
    multiply();
    team_.barrier();
#pragma unroll 1
    for (int c = team_.rank(); c < turning_chunks(plan_.vertices); c += team_.blocks())
      add_products(c);
#pragma unroll 1
    for (int patch = team_.rank(); patch < plan_.patches; patch += team_.blocks())
      add_strains(patch);
    team_.barrier();
    add_up();
    team_.barrier();
    solve();
  }

  // Adds contacts to Hc: each vertex gets a spring with the stiffness of its diagonal, in the
  // directions that are not `free`.
  PD_DEVICE void hold(const Mat3<T>* free) const {
    if (!c_.sound) return;
#pragma unroll 1
    for (int c = team_.warp(); c < turning_chunks(plan_.vertices); c += team_.warps())
      add_springs(c, free);
    team_.barrier();
    const bool held = sum_energy(true);
    // unchanged
    if (!held && !c_.held) return;
    const bool sound = invert(energy(), 1) && held;
    if (held && !sound) {
      __syncthreads();
      sum_energy(false);
      invert(energy(), 1);
    }
    if (threadIdx.x == 0) c_.held = sound;
    __syncthreads();
  }

 private:
  // Any point amid the vertices will do. Pinned vertices are excluded, since they may be NaN.
  PD_DEVICE Vec3<T> find_centroid() const {
    const int warp = threadIdx.x / warp_size, lane = threadIdx.x % warp_size;
    const int count = turning_chunk(plan_.vertices), chunks = turning_chunks(plan_.vertices);
    double* of_chunk = m_.products;  // m_.products is not in use yet
    double sum[4];
#pragma unroll 1
    for (int c = team_.warp(); c < chunks; c += team_.warps()) {
      for (double& s : sum) s = 0;
      const int end = min((c + 1) * count, plan_.vertices);
#pragma unroll 4
      for (int i = c * count + lane; i < end; i += warp_size) {
        const bool moves = in_.u[i].w > T(0);
        const Vec3<T> x = vec3(in_.x[i]);
        sum[0] += moves ? double(x.x) : 0;
        sum[1] += moves ? double(x.y) : 0;
        sum[2] += moves ? double(x.z) : 0;
        sum[3] += moves ? 1 : 0;
      }
      write_warp_sums(sum, of_chunk + 4 * c);
    }
    team_.barrier();
    double* total = reinterpret_cast<double*>(scratch_);
    if (warp == 0) {
      for (double& s : sum) s = 0;
#pragma unroll 1
      for (int c = lane; c < chunks; c += warp_size) {
#pragma unroll
        for (int n = 0; n < 4; ++n) sum[n] += of_chunk[4 * c + n];
      }
      write_warp_sums(sum, total);
    }
    __syncthreads();
    const double share = total[3] > 0 ? 1 / total[3] : 0;
    return {T(share * total[0]), T(share * total[1]), T(share * total[2])};
  }

  // vertices pinned here, or in the preconditioner's scene, take part in no rotation
  PD_DEVICE void set(int i, const Vec3<T>& arm, bool moves) const {
    m_.arm[i] = quad(arm);
    const bool has_part = moves && plan_.levels.fine_inverse[i] > T(0);
    const Quad<T> w = reinterpret_cast<const Quad<T>*>(plan_.levels.turning_weight)[i];
    const T weight[turning_groups] = {w.x, w.y, w.z, w.w};
    for (int k = 0; k < turning_groups; ++k) {
      Quad<T> numbers = {T(0), T(0), T(0), T(0)};
      if (has_part) numbers = {weight[k], weight[k] * arm.x, weight[k] * arm.y, weight[k] * arm.z};
      m_.numbers[at(k, i)] = numbers;
    }
  }

  PD_DEVICE void multiply() const {
    const Level<1, T> level = fine_level(plan_.levels);
    const int lane = int(threadIdx.x) % threads_of_row;
    const int own = int(threadIdx.x) % warp_size / threads_of_row;
    constexpr int rows = warp_size / threads_of_row;
#pragma unroll 1
    for (int first = team_.warp() * rows; first < level.rows; first += team_.warps() * rows) {
      const int row = min(first + own, level.rows - 1);
      Quad<T> sum[turning_groups] = {};
#pragma unroll 2
      for (int p = level.start[row] + lane; p < level.start[row + 1]; p += threads_of_row) {
        const T a = level.value[p];
        for (int k = 0; k < turning_groups; ++k)
          sum[k] = multiply_add(a, m_.numbers[at(k, level.column[p])], sum[k]);
      }
      // each lane of a row keeps one group
      static_assert(threads_of_row == turning_groups);
      const bool high = lane & 2, odd = lane & 1;
      const Quad<T> total = exchange_halves(odd, exchange_halves(high, sum[0], sum[2], 2),
                                            exchange_halves(high, sum[1], sum[3], 2), 1);
      if (first + own < level.rows) m_.images[at(lane, row)] = total;
    }
  }

  // Sums the products of a chunk's vertex numbers with a times themselves, and with their images.
  PD_DEVICE void add_products(int chunk) const {
    constexpr int together = 64, stride = together + 1;  // vertices in shared memory at a time
    constexpr int vectors = 2 * turning_groups, sums = 2;
    static_assert(2 * turning_products <= sums * small_multilevel_threads);
    Quad<T>* loaded = reinterpret_cast<Quad<T>*>(scratch_);  // [vectors, stride]
    T* inertia = reinterpret_cast<T*>(loaded + vectors * stride);
    static_assert((4 * vectors * stride + together) * sizeof(double) <= turning_scratch_bytes);
    const int count = turning_chunk(plan_.vertices);
    const int end = min((chunk + 1) * count, plan_.vertices);
    double sum[sums] = {0, 0};
#pragma unroll 1
    for (int begin = chunk * count; begin < end; begin += together) {
      const int here = min(together, end - begin);
      __syncthreads();
      for (int t = threadIdx.x; t < vectors * together; t += blockDim.x) {
        const int group = t / together, i = t % together;
        if (i >= here) continue;
        const Quad<T>* from = group < turning_groups ? m_.numbers : m_.images;
        loaded[group * stride + i] = from[at(group % turning_groups, begin + i)];
        if (group == 0) inertia[i] = in_.inertia[begin + i].w;
      }
      __syncthreads();
#pragma unroll
      for (int s = 0; s < sums; ++s) {
        const int t = int(threadIdx.x) + s * int(blockDim.x);
        if (t >= 2 * turning_products) break;
        const bool of_matrix = t >= turning_products;
        const int m = t / turning_numbers % turning_numbers, n = t % turning_numbers;
        const T* one = &loaded[m / 4 * stride].x + m % 4;
        const T* other = &loaded[(n / 4 + (of_matrix ? turning_groups : 0)) * stride].x + n % 4;
#pragma unroll 4
        for (int i = 0; i < here; ++i) {
          const double a = of_matrix ? 1.0 : double(inertia[i]);
          sum[s] += a * double(one[4 * i]) * double(other[4 * i]);
        }
      }
    }
    double* to = m_.products + std::int64_t(chunk) * 2 * turning_products;
    for (int s = 0; s < sums; ++s) {
      const int t = int(threadIdx.x) + s * int(blockDim.x);
      if (t < 2 * turning_products) to[t] = sum[s];
    }
  }

  // Sums the products of all modes' strains over a patch.
  PD_DEVICE void add_strains(int number) const {
    // one warp per pair of groups k >= l and per slice; the sums overwrite c_.inverse, which is no
    // longer needed
    constexpr int group_pairs = turning_groups * (turning_groups + 1) / 2, slices = 3;
    double* const sum = c_.at(0);
    static_assert(slices * turning_pairs * sizeof(double) <= sizeof(c_.inverse));
    const Patch<T> patch(plan_, number);
    const TurningTile<T> tile(scratch_, scratch_bytes_);
    __syncthreads();
    for (int p = threadIdx.x; p < slices * turning_pairs; p += blockDim.x) sum[p] = 0;
#pragma unroll 1
    for (int first = 0; first < 2 * patch.pairs; first += tile.size()) {
      __syncthreads();
      if (int(threadIdx.x) < tile.size()) fill_tile(patch, first, tile);
      __syncthreads();
      const int count = min(tile.size(), 2 * patch.pairs - first);
#pragma unroll 1
      for (int task = threadIdx.x / warp_size; task < slices * group_pairs;
           task += int(blockDim.x) / warp_size) {
        const int b = task / slices, slice = task % slices;
        const int k = b < 1 ? 0 : b < 3 ? 1 : b < 6 ? 2 : 3, l = b - k * (k + 1) / 2;
        multiply_strains<slices>(tile, slice, count, k, l, sum + slice * turning_pairs);
      }
    }
    __syncthreads();
    double* to = m_.strains + std::int64_t(number) * turning_pairs;
    for (int p = threadIdx.x; p < turning_pairs; p += blockDim.x) {
      double total = 0;
      for (int slice = 0; slice < slices; ++slice) total += sum[slice * turning_pairs + p];
      to[p] = total;
    }
  }

  // Writes a tetrahedron of the patch to place threadIdx.x of the tile.
  PD_DEVICE void fill_tile(const Patch<T>& patch, int first, const TurningTile<T>& tile) const {
    const int place = threadIdx.x, tet = first + place;
    const TetInputs<T> numbers = load_tet<true>(patch, in_.weights, tet);
    const bool there = tet < 2 * patch.pairs && numbers.weight > T(0);
    Vec3<T> x[4];
    T weight[turning_groups][4];
    for (int c = 0; c < 4; ++c) {
      const int vertex = patch.vertex(int(numbers.slot_times_8(c)) / 8);
      x[c] = vec3(m_.arm[vertex]);
      for (int k = 0; k < turning_groups; ++k) weight[k][c] = m_.numbers[at(k, vertex)].x;
    }
    const ComputedRest<T> rest = rest_of<true>(patch);
    Mat3<T> inverse = tet_rest(numbers, T(1) / rest.unit, rest.position).inverse(0);
    Mat3<T> f = deformation_gradient(x, inverse);
    // data of missing tetrahedra is arbitrary
    const auto keep = [&](T& a, T other) { a = select(there, a, other); };
    for (int r = 0; r < 3; ++r) {
      for (T* a : {&inverse.row[r].x, &inverse.row[r].y, &inverse.row[r].z}) keep(*a, T(0));
      keep(f.row[r].x, T(r == 0));
      keep(f.row[r].y, T(r == 1));
      keep(f.row[r].z, T(r == 2));
    }
    for (Vec3<T>& corner : x) {
      for (T* a : {&corner.x, &corner.y, &corner.z}) keep(*a, T(0));
    }
    const Mat3<T> back = transpose(nearest_rotation(f));
    for (int k = 0; k < turning_groups; ++k)
      tile.set(place, k, TurningGradient<T>(inverse, back, x, weight[k]));
    tile.weight(place) = select(there, numbers.weight, T(0));
    if constexpr (has_poisson_ratio) tile.pressure(place) = select(there, numbers.pressure, T(0));
  }

  // Called by a warp, which processes every `Slices`-th group of 32 tetrahedra.
  template <int Slices>
  PD_DEVICE static void multiply_strains(const TurningTile<T>& tile, int slice, int count, int k,
                                         int l, double* sum) {
    const int lane = int(threadIdx.x) % warp_size;
    T part[36] = {};
#pragma unroll 1
    for (int e = slice * warp_size + lane; e < count; e += Slices * warp_size) {
      const TurningStrain<T> own = tile.strain(e, k), other = tile.strain(e, l);
      const T w = tile.weight(e);
#pragma unroll
      for (int i = 0; i < 6; ++i) {
        T row[6];
#pragma unroll
        for (int c = 0; c < 6; ++c) row[c] = w * own.h[i][c];
        if constexpr (has_poisson_ratio) add_dilation(own.h[i], tile.pressure(e), row);
#pragma unroll
        for (int j = 0; j < 6; ++j)
          add_strain_product<has_poisson_ratio>(row, i, other.h[j], j, part[6 * i + j]);
      }
    }
    spread_sums(part);
    const KeptSums kept(lane);
    for (int n = 0; n < 2; ++n) {
      const int i = 6 * k + (kept.first + n) / 6, j = 6 * l + (kept.first + n) % 6;
      if (n < kept.count && j <= i) sum[turning_pair(i, j)] += double(part[n]);
    }
  }

  // One warp per total; all row counts are below 2^31.
  PD_DEVICE void add_up() const {
    const int lane = int(threadIdx.x) % warp_size;
#pragma unroll 1
    for (int t = team_.warp(); t < turning_totals; t += team_.warps()) {
      const bool of_strain = t >= 2 * turning_products;
      const int width = of_strain ? turning_pairs : 2 * turning_products;
      const int rows = of_strain ? plan_.patches : turning_chunks(plan_.vertices);
      const double* from = of_strain ? m_.strains + (t - 2 * turning_products) : m_.products + t;
      double sum = 0;
#pragma unroll 4
      for (int row = lane; row < rows; row += warp_size) sum += from[std::int64_t(row) * width];
      sum = warp_reduce(sum, Add{});
      if (lane == 0) m_.totals[t] = sum;
    }
  }

  // A lane holds one mode, and sums its products with all modes over the chunk's vertices in
  // contact.
  PD_DEVICE void add_springs(int chunk, const Mat3<T>* free) const {
    const int lane = int(threadIdx.x) % warp_size, count = turning_chunk(plan_.vertices);
    const int end = min((chunk + 1) * count, plan_.vertices);
    Vec3<double>* force =
        reinterpret_cast<Vec3<double>*>(scratch_) + int(threadIdx.x) / warp_size * turning_modes;
    static_assert(multilevel_warps * turning_modes * sizeof(*force) <= turning_scratch_bytes);
    double sum[turning_modes] = {};
#pragma unroll 1
    for (int first = chunk * count; first < end; first += warp_size) {
      const int i = first + lane;
      unsigned held =
          __ballot_sync(full_warp, i < end && in_.u[i].w > T(0) && !leaves_all(free[i]));
#pragma unroll 1
      for (; held; held &= held - 1) {
        const int vertex = first + __ffs(int(held)) - 1;
        const Vec3<double> mode = held_mode(free[vertex], vertex, min(lane, turning_modes - 1));
        __syncwarp();
        if (lane < turning_modes) force[lane] = (1 / double(in_.u[vertex].w)) * mode;
        __syncwarp();
#pragma unroll
        for (int m = 0; m < turning_modes; ++m) sum[m] += dot(force[m], mode);
      }
    }
    double* to = m_.springs + std::int64_t(chunk) * turning_entries + lane;
    for (int m = 0; m < turning_modes; ++m) {
      if (lane < turning_modes) to[m * turning_modes] = sum[m];
    }
  }

  // a projector with any blocked direction has a smaller trace
  PD_DEVICE static bool leaves_all(const Mat3<T>& free) {
    return !((free.row[0].x + free.row[1].y) + free.row[2].z < T(2.5));
  }

  // place of Hc, which invert() reads before it overwrites it
  PD_DEVICE TurningMatrix* energy() const { return reinterpret_cast<TurningMatrix*>(scratch_) + 3; }

  // Computes Hc with or without contact springs; returns whether any spring is nonzero.
  PD_DEVICE bool sum_energy(bool springs) const {
    const int chunks = springs ? turning_chunks(plan_.vertices) : 0;
    bool some = false;
    for (int e = threadIdx.x; e < turning_entries; e += blockDim.x) {
      double sum = 0;
#pragma unroll 4
      for (int c = 0; c < chunks; ++c) sum += m_.springs[std::int64_t(c) * turning_entries + e];
      const int i = e / turning_modes, j = e % turning_modes;
      energy()->at[i][j] = entry(m_.totals, 0, i, j) + sum;
      some = some || sum != 0;
    }
    return __syncthreads_or(some);
  }

  // the blocked part of a mode's displacement of a vertex
  PD_DEVICE Vec3<double> held_mode(const Mat3<T>& free, int vertex, int mode) const {
    const Quad<T> n = m_.numbers[at(mode / 6, vertex)];
    const int a = mode % 3;
    const T w = n.x;
    const Vec3<T> displacement =
        mode % 6 < 3 ? Vec3<T>{a == 0 ? w : T(0), a == 1 ? w : T(0), a == 2 ? w : T(0)}
        : a == 0     ? Vec3<T>{T(0), -n.w, n.z}
        : a == 1     ? Vec3<T>{n.w, T(0), -n.y}
                     : Vec3<T>{-n.z, n.y, T(0)};
    const auto wide = [](const Vec3<T>& v) {
      return Vec3<double>{double(v.x), double(v.y), double(v.z)};
    };
    const Vec3<double> d = wide(displacement);
    return {d.x - dot(wide(free.row[0]), d), d.y - dot(wide(free.row[1]), d),
            d.z - dot(wide(free.row[2]), d)};
  }

  // An entry of Hc or Ac, from the totals.
  PD_DEVICE static double entry(const double* totals, int of, int i, int j) {
    using Products = double[turning_numbers][turning_numbers];
    const auto* products = reinterpret_cast<const Products*>(totals);
    const double* strains = totals + 2 * turning_products;
    const double strain = of == 0 ? strains[i < j ? turning_pair(j, i) : turning_pair(i, j)] : 0;
    return mode_product(products[of], i, j) + strain;
  }

  // Every block solves the same problem from the same totals.
  PD_DEVICE void solve() const {
    double* totals = reinterpret_cast<double*>(scratch_);
    static_assert(turning_totals * sizeof(double) <= turning_scratch_bytes);
    for (int t = threadIdx.x; t < turning_totals; t += blockDim.x) totals[t] = m_.totals[t];
    __syncthreads();
    each_entry(2, [&](int of, int i, int j) { c_.inverse[of].at[i][j] = entry(totals, of, i, j); });
    __syncthreads();
    if (threadIdx.x < turning_modes)
      c_.scale[threadIdx.x] = turning_scale(c_.inverse[1], int(threadIdx.x));
    __syncthreads();
    const bool sound = invert(c_.inverse, 2);
    if (!sound) c_.clear();
    if (threadIdx.x == 0) {
      c_.sound = sound;
      c_.held = false;
    }
    __syncthreads();
  }

  PD_DEVICE std::int64_t at(int group, int i) const {
    return std::int64_t(group) * plan_.vertices + i;
  }

  PD_DEVICE static Quad<T> multiply_add(T a, const Quad<T>& b, const Quad<T>& c) {
    return {pd::multiply_add(a, b.x, c.x), pd::multiply_add(a, b.y, c.y),
            pd::multiply_add(a, b.z, c.z), pd::multiply_add(a, b.w, c.w)};
  }

  // each lane keeps one of two sums and adds its neighbour's
  PD_DEVICE static Quad<T> exchange_halves(bool upper, const Quad<T>& a, const Quad<T>& b,
                                           int distance) {
    const auto half = [&](T x, T y) {
      return select(upper, y, x) + __shfl_xor_sync(full_warp, select(upper, x, y), distance);
    };
    return {half(a.x, b.x), half(a.y, b.y), half(a.z, b.z), half(a.w, b.w)};
  }

  // visit(matrix, i, j) for this thread's entries of one or two matrices
  template <class Visit>
  PD_DEVICE static void each_entry(int matrices, const Visit& visit) {
    for (int e = threadIdx.x; e < matrices * turning_entries; e += blockDim.x) {
      const int of = e >= turning_entries, i = e / turning_modes - of * turning_modes;
      visit(of, i, e % turning_modes);
    }
  }

  // Inverts Hc, or Hc and Ac, scaled by c_.scale; returns false if a pivot is not positive. Called
  // by all threads.
  PD_DEVICE bool invert(const TurningMatrix* matrix, int matrices) const {
    TurningMatrix *now = reinterpret_cast<TurningMatrix*>(scratch_), *next = now + 2;
    static_assert(4 * sizeof(TurningMatrix) <= turning_scratch_bytes);
    const double* scale = c_.scale;
    each_entry(matrices, [&](int of, int i, int j) {
      now[of].at[i][j] = scaled_entry(matrix[of], scale[i], scale[j], i, j,
                                      of ? turning_noise : stiffness_ratio_ * turning_noise);
    });
    __syncthreads();
#pragma unroll 1
    for (int k = 0; k < turning_modes; ++k) {
      const double pivot[2] = {now[0].at[k][k], matrices == 2 ? now[1].at[k][k] : 1};
      if (!(pivot[0] > 0 && pivot[1] > 0)) return false;
      const double share[2] = {1 / pivot[0], 1 / pivot[1]};
      each_entry(matrices, [&](int of, int i, int j) {
        next[of].at[i][j] = swept(now[of], k, of ? share[1] : share[0], i, j);
      });
      __syncthreads();
      TurningMatrix* const done = now;
      now = next;
      next = done;
    }
    each_entry(matrices, [&](int of, int i, int j) {
      c_.inverse[of].at[i][j] = -scale[i] * scale[j] * now[of].at[i][j];
    });
    __syncthreads();
    return true;
  }

  const DevicePlan<T>& plan_;
  std::byte* scratch_;  // in shared memory
  std::size_t scratch_bytes_;
  double stiffness_ratio_;  // upper bound of the ratio between the material and that of A
  const CorotationInput<T>& in_;
  const CorotationMemory<T>& m_;
  BlockTeam& team_;
  CorotationControl<T>& c_;
};

// Out of line, so that the iterations keep their registers. All inputs are values or in shared
// memory, since kernel parameters are slow to read here. Returns the team's state.
template <class T>
__device__ __noinline__ BlockTeam make_corotation(CorotationInput<T> in, CorotationMemory<T> memory,
                                                  BlockTeam team, std::byte* scratch,
                                                  std::size_t scratch_bytes, double stiffness_ratio,
                                                  CorotationControl<T>& control) {
  CorotationMaker<T>(in, memory, team, scratch, scratch_bytes, stiffness_ratio, control).make();
  return team;
}

// The same for the contact springs.
template <class T>
__device__ __noinline__ BlockTeam hold_corotation(CorotationInput<T> in, const Mat3<T>* free,
                                                  CorotationMemory<T> memory, BlockTeam team,
                                                  std::byte* scratch, double stiffness_ratio,
                                                  CorotationControl<T>& control) {
  CorotationMaker<T>(in, memory, team, scratch, turning_scratch_bytes, stiffness_ratio, control)
      .hold(free);
  return team;
}

}  // namespace pd::inline PD_TARGET
