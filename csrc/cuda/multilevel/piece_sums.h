// Sums of the tasks of solver/multilevel/pieces.h, each by a warp: a vertex or a tetrahedron a lane.
#pragma once
#include "cuda/elements/tet_per_lane.h"
#include "cuda/multilevel/pieces.h"

namespace pd::inline PD_TARGET {

constexpr int centre_sums = 7;  // weight, and the weighted x and x + u

// Inputs of one environment: x; 1 / D in the w of u; a in the w of `inertia`; the iterate; x from the anchor of each
// patch; and w V of every pair.
template <class T>
struct PiecesInput {
  const Quad<T>*x, *u, *inertia, *iterate, *origin;
  const T* weights;
};

template <class T>
class PieceSums {
 public:
  PD_DEVICE PieceSums(const DevicePlan<T>& plan, const PiecesInput<T>& in,
                      const PiecesMemory<T>& memory)
      : plan_(plan), levels_(plan.levels), in_(in), m_(memory) {}

  // A task of a piece with itself. What a pin holds has no part in it, be it NaN.
  PD_DEVICE void add_centre(int number) const {
    double sum[centre_sums] = {};
    each_row(number, [&](const PieceTask& task, int i) {
      if (!(in_.u[i].w > T(0))) return;
      const double weight = double(share_of(levels_, i, task.row));
      const Vec3<double> x = widened(in_.x[i]), y = x + widened(in_.iterate[i]);
      const double part[centre_sums] = {1, x.x, x.y, x.z, y.x, y.y, y.z};
#pragma unroll
      for (int c = 0; c < centre_sums; ++c) sum[c] += weight * part[c];
    });
    write_warp_sums(sum, row_sums(number));
  }

  // Products (1, r_i) (1, r_j)^T with A, then with the inertia of this step.
  PD_DEVICE void add_moments(int number) const {
    double sum[32] = {};
    each_row(number, [&](const PieceTask& task, int i) {
      const Quad<T> at = m_.arm[i];
      if (!(at.w > T(0))) return;
      double image[4] = {0, 0, 0, 0};
      each_neighbour(i, task.column, [&](int, const Quad<T>& arm, double value) {
        image[0] += value;
        image[1] += value * double(arm.x);
        image[2] += value * double(arm.y);
        image[3] += value * double(arm.z);
      });
      const Vec3<double> c = widened(m_.centre[task.column]);
      const double a = double(in_.inertia[i].w) * double(share_of(levels_, i, task.column));
      const Vec3<double> own = widened(at) - widened(m_.centre[task.row]), other = widened(at) - c;
      const double weight = double(share_of(levels_, i, task.row));
      const double left[4] = {weight, weight * own.x, weight * own.y, weight * own.z};
      const double right[2][4] = {{image[0], image[1] - image[0] * c.x, image[2] - image[0] * c.y,
                                   image[3] - image[0] * c.z},
                                  {a, a * other.x, a * other.y, a * other.z}};
#pragma unroll
      for (int n = 0; n < 32; ++n) sum[n] += left[n / 4 % 4] * right[n / 16][n % 4];
    });
    write_warp_sums(sum, row_sums(number));
  }

  // e^T A e of what contacts hold, e = (I - P) of the modes.
  PD_DEVICE void add_springs(int number, const Mat3<T>* free, double scale) const {
    double sum[piece_block] = {};
    each_row(number, [&](const PieceTask& task, int i) {
      // hardly any vertex is held
      if (!(m_.arm[i].w > T(0)) || leaves_all(free[i])) return;
      Vec3<double> force[piece_modes] = {};
      each_neighbour(i, task.column, [&](int j, const Quad<T>& arm, double value) {
        if (!leaves_all(free[j])) add_held(free[j], arm, task.column, scale * value, force);
      });
      Vec3<double> own[piece_modes] = {};
      add_held(free[i], m_.arm[i], task.row, double(share_of(levels_, i, task.row)), own);
#pragma unroll
      for (int n = 0; n < piece_block; ++n)
        sum[n] += dot(own[n / piece_modes], force[n % piece_modes]);
    });
    write_warp_sums(sum, row_sums(number));
  }

  // Products of the strains of tetrahedra.
  PD_DEVICE void add_strains(int number) const {
    const PieceTask task = PieceTask::of(levels_.piece_tet_task, number);
    T sum[piece_block] = {};
#pragma unroll 1
    for (int n = task.first + lane(); n < task.end; n += warp_size)
      add_tet(task, reinterpret_cast<const int2*>(levels_.piece_tet)[n], sum);
    __syncwarp();
    write_warp_sums(sum, m_.strains + std::int64_t(number) * piece_block);
  }

 private:
  PD_DEVICE static int lane() { return int(threadIdx.x) % warp_size; }
  PD_DEVICE double* row_sums(int number) const {
    return m_.row_sums + std::int64_t(number) * piece_block;
  }

  // visit(task, vertex) on the lanes of a warp
  template <class Visit>
  PD_DEVICE void each_row(int number, const Visit& visit) const {
    const PieceTask task = PieceTask::of(levels_.piece_row_task, number);
#pragma unroll 1
    for (int n = task.first + lane(); n < task.end; n += warp_size)
      visit(task, levels_.piece_row[n]);
    __syncwarp();
  }

  // visit(vertex, arm, A_ij times its weight) for the vertices of a row that a piece moves
  template <class Visit>
  PD_DEVICE void each_neighbour(int row, int piece, const Visit& visit) const {
#pragma unroll 1
    for (int p = levels_.fine_start[row]; p < levels_.fine_start[row + 1]; ++p) {
      const int j = levels_.fine_column[p];
      const Quad<T> arm = m_.arm[j];
      const T weight = share_of(levels_, j, piece);
      if (weight > T(0) && arm.w > T(0))
        visit(j, arm, double(levels_.fine_value[p]) * double(weight));
    }
  }

  // adds the part of all modes that contacts hold, times a factor
  PD_DEVICE void add_held(const Mat3<T>& free, const Quad<T>& at, int piece, double factor,
                          Vec3<double> (&sum)[piece_modes]) const {
    const Vec3<double> arm = widened(at) - widened(m_.centre[piece]);
    const Vec3<double> row[3] = {widened(quad(free.row[0])), widened(quad(free.row[1])),
                                 widened(quad(free.row[2]))};
#pragma unroll
    for (int m = 0; m < piece_modes; ++m) {
      const Vec3<double> d = rigid_motion(m, arm);
      sum[m] = sum[m] + factor * Vec3<double>{d.x - dot(row[0], d), d.y - dot(row[1], d),
                                              d.z - dot(row[2], d)};
    }
  }

  // `place`: of a tetrahedron among all, and its patch
  PD_DEVICE void add_tet(const PieceTask& task, const int2& place, T (&sum)[piece_block]) const {
    const Patch<T> patch(plan_, place.y);
    const int number = place.x - 2 * pair_lanes * patch.first_block;
    const TetInputs<T> numbers = load_tet<true>(patch, in_.weights, number);
    const ComputedRest<T> rest = rest_of<true>(patch);
    const Mat3<T> inverse = tet_rest(numbers, T(1) / rest.unit, rest.position).inverse(0);
    Vec3<T> x[4], arm[2][4];
    T share[2][4], pressure = T(0);
    if constexpr (has_poisson_ratio) pressure = numbers.pressure;
    const Vec3<T> centre[2] = {vec3(m_.centre[task.row]), vec3(m_.centre[task.column])};
    for (int c = 0; c < 4; ++c) {
      const int slot = int(numbers.slot_times_8(c)) / 8, vertex = patch.vertex(slot);
      x[c] = vec3(in_.origin[patch.first_slot + slot]) + vec3(in_.iterate[vertex]);
      const Quad<T> at = m_.arm[vertex];
      for (int side = 0; side < 2; ++side) {
        arm[side][c] = vec3(at) - centre[side];
        share[side][c] = at.w * share_of(levels_, vertex, side ? task.column : task.row);
      }
    }
    const PieceFrame<T> frame(deformation_gradient(x, inverse), numbers.weight, pressure);
    const PieceStrain<T> row(inverse, frame, arm[0], share[0]),
        column(inverse, frame, arm[1], share[1]);
    add_strain_products<has_poisson_ratio>(
        row.template stressed<has_poisson_ratio>(numbers.weight, pressure), column, sum);
  }

  const DevicePlan<T>& plan_;
  const Levels<T>& levels_;
  const PiecesInput<T>& in_;
  const PiecesMemory<T>& m_;
};

}  // namespace pd::inline PD_TARGET
