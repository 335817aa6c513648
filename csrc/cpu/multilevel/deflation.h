// How the small problem of solver/multilevel/deflation.h acts on vectors, on the CPU.
#pragma once
#include "cpu/multilevel/deflation_build.h"
#include "cpu/step/workspace.h"
#include "threads/team.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

// One thread's part in it.
template <class Lanes>
class Corotation {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Shared = CorotationWork<Lanes>;
  static constexpr int width = Lanes::environments;

 public:
  Corotation(const Plan<T>& plan, const Team& team, const Workspace<Lanes>& work, Shared& shared)
      : plan_(plan), team_(team), w_(work), shared_(shared) {}

  void make(const Value* base, const bool (&asks)[width], const double (&scales)[width]) const {
    CorotationMaker<Lanes>(plan_, team_, w_, shared_).make(base, asks, scales);
  }

  // With contacts: the lanes that have it, where these leave the directions `free`.
  void hold(const Mat3<Real>* free, const bool (&has)[width], const double (&scales)[width]) const {
    CorotationMaker<Lanes>(plan_, team_, w_, shared_).hold(free, has, scales);
  }

  bool is_held(int lane) const { return shared_.unheld[lane].held; }

  void forget(int lane) const {
    if (team_.rank == 0) shared_.inverse[lane] = {};
  }

  // Before M: V^T q, and what M is not to see of q in lanes where the small problem goes `around` it.
  void measure(const Value* q, const bool (&around)[width]) {
    sum_up(shared_.numbers, q, own_);
    double part[width][turning_modes] = {};
    for (int lane = 0; lane < width; ++lane) {
      if (around[lane]) shared_.inverse[lane].matrix.multiply(own_[lane], part[lane]);
    }
    set_vectors(part);
  }
  // (I - A V Ac^-1 V^T) q
  Value without(std::int64_t i, Value q) const {
    for (int m = 0; m < turning_numbers; ++m)
      q = subtract_product(q, shared_.images[i].of[m], vector_[m]);
    return q;
  }

  // After it: what its result lacks, in other lanes V (Hc^-1 - Ac^-1) V^T q. q came multiplied by `scale`.
  void answer(const Value* z, const bool (&around)[width], bool some, const Real& scale) {
    double image[width][turning_modes];
    if (some) sum_up(shared_.images, z, image);
    for (int lane = 0; lane < width; ++lane) {
      if (!around[lane]) std::copy_n(own_[lane], turning_modes, image[lane]);
    }
    set_lacking(image, scale);
  }
  Value with(std::int64_t i, Value z) const {
    for (int m = 0; m < turning_numbers; ++m)
      z = multiply_add(shared_.numbers[i].of[m], vector_[m], z);
    return z;
  }

 private:
  // sums of the sixteen numbers times a field, as modes, chunk by chunk: neither threads nor the batch change their order
  void sum_up(const Row<typename Shared::Numbers>& numbers, const Value* field,
              double (&modes)[width][turning_modes]) const {
    const Real none(T(0));
    for (std::int64_t c = team_.begin(shared_.chunks); c < team_.end(shared_.chunks); ++c) {
      Value sum[turning_numbers];
      for (Value& s : sum) s = Lanes::value({none, none, none});
      shared_.each_of_chunk(plan_.vertices, c, [&](std::int64_t i) {
        for (int m = 0; m < turning_numbers; ++m)
          sum[m] = multiply_add(numbers[i].of[m], field[i], sum[m]);
      });
      std::copy_n(sum, turning_numbers, &shared_.sums[c * turning_numbers]);
    }
    team_.barrier();
    for (int lane = 0; lane < width; ++lane) {
      double total[turning_numbers][3] = {};
      for (int c = 0; c < shared_.chunks; ++c) {
        for (int m = 0; m < turning_numbers; ++m) {
          const Vec3<T> sum = Lanes::get_lane(shared_.sums[c * turning_numbers + m], lane);
          total[m][0] += double(sum.x);
          total[m][1] += double(sum.y);
          total[m][2] += double(sum.z);
        }
      }
      modes_of(total, modes[lane]);
    }
    team_.barrier();
  }

  // V (Hc^-1 / scale V^T q - Ac^-1 image)
  void set_lacking(const double (&image)[width][turning_modes], const Real& scale) {
    double soft[turning_modes], part[width][turning_modes];
    for (int lane = 0; lane < width; ++lane) {
      shared_.inverse[lane].energy.multiply(own_[lane], soft);
      shared_.inverse[lane].matrix.multiply(image[lane], part[lane]);
      for (int m = 0; m < turning_modes; ++m)
        part[lane][m] = soft[m] / Shared::number(scale, lane) - part[lane][m];
    }
    set_vectors(part);
  }

  void set_vectors(const double (&modes)[width][turning_modes]) {
    for (int lane = 0; lane < width; ++lane) {
      double vector[turning_numbers][3];
      vectors_of(modes[lane], vector);
      for (int m = 0; m < turning_numbers; ++m)
        Lanes::set_lane(vector_[m], lane, T(vector[m][0]), T(vector[m][1]), T(vector[m][2]));
    }
  }

  const Plan<T>& plan_;
  const Team& team_;
  const Workspace<Lanes>& w_;
  Shared& shared_;
  double own_[width][turning_modes] = {};
  Value vector_[turning_numbers];
};

}  // namespace pd::inline PD_TARGET
