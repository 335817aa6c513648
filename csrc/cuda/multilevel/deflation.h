// Application of the coarse problem of solver/multilevel/deflation.h to vectors on a GPU;
// cuda/multilevel/deflation_build.h builds it.
#pragma once
#include "cuda/common/memory.h"
#include "solver/multilevel/deflation.h"
#include "views/shared_memory.h"
#include "views/views.h"

namespace pd::inline PD_TARGET {

constexpr int turning_products = turning_numbers * turning_numbers;
constexpr int turning_entries = turning_modes * turning_modes;
constexpr int turning_totals = 2 * turning_products + turning_pairs;

// Vertices whose products are summed together. The plan alone decides, so that the bits are fixed.
PD_HD int turning_chunk(int vertices) { return vertices < 64 * 128 ? 64 : (vertices + 127) / 128; }
PD_HD int turning_chunks(int vertices) {
  return (vertices + turning_chunk(vertices) - 1) / turning_chunk(vertices);
}

// Device memory of a team. Each vertex has sixteen numbers, (w_k, w_k r) for each group k, and
// sixteen images, A times these numbers.
template <class T>
struct CorotationMemory {
  Quad<T>* arm;              // [vertices] lever arm r, relative to the centroid
  Quad<T>*numbers, *images;  // [groups, vertices]
  double* products;          // [chunks, 2, turning_products] with the inertia, and with A
  double* strains;           // [patches, turning_pairs]
  double* totals;            // [turning_totals]
  double* springs;           // [chunks, turning_entries] contact springs; empty without contacts
};

// State of the coarse problem in shared memory, the same in every block.
template <class T>
struct CorotationControl {
  TurningMatrix inverse[2];  // Hc^-1, Ac^-1
  double projection[turning_modes], scale[turning_modes];
  T mode[turning_modes];
  DevicePlan<T> plan;  // for CorotationMaker
  bool sound, held;    // sound: positive definite; held: Hc includes contact springs

  PD_DEVICE double* at(int which) { return &inverse[which].at[0][0]; }

  // Makes the correction zero.
  PD_DEVICE void clear() {
    for (int i = threadIdx.x; i < turning_modes * turning_modes; i += blockDim.x)
      at(0)[i] = at(1)[i] = 0;
    __syncthreads();
  }
};

static_assert(sizeof(CorotationControl<double>) <= corotation_bytes);

template <class T>
class DeviceCorotation {
 public:
  PD_DEVICE DeviceCorotation(int vertices, const CorotationMemory<T>& memory, std::byte* shared)
      : vertices_(vertices), m_(memory), c_(*reinterpret_cast<CorotationControl<T>*>(shared)) {}

  // The control for CorotationMaker, with a copy of the plan, written by all threads.
  PD_DEVICE CorotationControl<T>& with_plan(const DevicePlan<T>& plan) const {
    constexpr int words = sizeof(plan) / sizeof(std::uint64_t);
    static_assert(sizeof(plan) % sizeof(std::uint64_t) == 0);
    for (int i = threadIdx.x; i < words; i += blockDim.x)
      reinterpret_cast<std::uint64_t*>(&c_.plan)[i] =
          reinterpret_cast<const std::uint64_t*>(&plan)[i];
    __syncthreads();
    return c_;
  }

  // the control as built
  PD_DEVICE CorotationControl<T>& control() const { return c_; }

  // Products of all modes with a field at a vertex, added to the sums.
  PD_DEVICE void multiply_modes(int i, const Vec3<T>& q, T (&sum)[turning_modes]) const {
    products(m_.numbers, i, q, sum);
  }
  PD_DEVICE void multiply_images(int i, const Vec3<T>& z, T (&sum)[turning_modes]) const {
    products(m_.images, i, z, sum);
  }

  // Before M, from the sums V^T q, where q was multiplied by `scale`. With deflation (`around` M),
  // a second step follows. Otherwise the correction of M's result is complete: V (Hc^-1 - Ac^-1)
  // V^T q.
  PD_DEVICE void compute_modes(const double* sum, bool around, double scale) const {
    if (threadIdx.x < turning_modes) {
      const int i = threadIdx.x;
      const double part = row(c_.inverse[1], i, sum);
      c_.projection[i] = sum[i];
      c_.mode[i] = T(around ? part : row(c_.inverse[0], i, sum) / scale - part);
    }
    __syncthreads();
  }
  // (I - A V Ac^-1 V^T) q
  PD_DEVICE Vec3<T> deflated(int i, const Vec3<T>& q) const { return q - moved(m_.images, i); }

  // After M, from the sums (A V)^T z: the remaining correction of z.
  PD_DEVICE void complete_modes(const double* sum, double scale) const {
    if (threadIdx.x < turning_modes) {
      const int i = threadIdx.x;
      c_.mode[i] = T(row(c_.inverse[0], i, c_.projection) / scale - row(c_.inverse[1], i, sum));
    }
    __syncthreads();
  }
  PD_DEVICE Vec3<T> corrected(int i, const Vec3<T>& z) const { return z + moved(m_.numbers, i); }

 private:
  PD_DEVICE void products(const Quad<T>* numbers, int i, const Vec3<T>& field,
                          T (&sum)[turning_modes]) const {
#pragma unroll
    for (int k = 0; k < turning_groups; ++k) {
      const Quad<T> n = numbers[std::int64_t(k) * vertices_ + i];
      const Vec3<T> push = n.x * field, turn = cross(Vec3<T>{n.y, n.z, n.w}, field);
      const T part[6] = {push.x, push.y, push.z, turn.x, turn.y, turn.z};
#pragma unroll
      for (int c = 0; c < 6; ++c) sum[6 * k + c] = part[c];
    }
  }

  PD_DEVICE Vec3<T> moved(const Quad<T>* numbers, int i) const {
    Vec3<T> sum = {T(0), T(0), T(0)};
#pragma unroll
    for (int k = 0; k < turning_groups; ++k) {
      const Quad<T> n = numbers[std::int64_t(k) * vertices_ + i];
      const T* mode = c_.mode + 6 * k;
      sum = multiply_add(n.x, read3(mode), sum) + cross(read3(mode + 3), Vec3<T>{n.y, n.z, n.w});
    }
    return sum;
  }

  // one row of a symmetric matrix, read by columns so that neighbouring threads read neighbouring
  // numbers
  PD_DEVICE static double row(const TurningMatrix& a, int i, const double* x) {
    double sum = 0;
    for (int j = 0; j < turning_modes; ++j) sum += a.at[j][i] * x[j];
    return sum;
  }

  int vertices_;
  const CorotationMemory<T>& m_;
  CorotationControl<T>& c_;
};

}  // namespace pd::inline PD_TARGET
