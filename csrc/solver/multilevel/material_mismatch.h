// How far the material of a step is from the reference material of the preconditioner M (solver/multilevel/lbfgs.h).
#pragma once
#include "math/config.h"
#include "views/views.h"

#include <cmath>

namespace pd::inline PD_TARGET {

// RatioRange of the ratios of the step's values to the reference values.
struct RatioRange {
  double least = HUGE_VAL, largest = 0;

  PD_HD void count(double ratio) { add({ratio, ratio}); }

  PD_HD void add(const RatioRange& other) {
    least = other.least < least ? other.least : least;
    largest = other.largest > largest ? other.largest : largest;
  }
};

constexpr double outlier_ratio =
    4;  // times the reference and the elements' change: vertices beyond are outliers

struct MaterialMismatch {
  double scale = 1;           // s of A <= s A_0, without outliers
  double spread = 0;          // 1 - q / s for q A_0 <= A <= s A_0, with outliers
  double trusted = 1;         // ratio of inertias that M can represent, within outlier_ratio
  bool has_outliers = false;  // some vertices are outliers, or held by M alone

  MaterialMismatch() = default;

  PD_HD MaterialMismatch(const RatioRange& elements, const RatioRange& inertias)
      : trusted(larger(elements.largest, smaller(inertias.least, inertias.largest))),
        has_outliers(inertias.largest > outlier_ratio * trusted) {}

  // `common`: ratios of all vertices but outliers; `other_pins`: the step holds other vertices than M does
  PD_HD void conclude(const RatioRange& elements, const RatioRange& inertias,
                      const RatioRange& common, bool other_pins) {
    scale = larger(elements.largest, common.largest);
    const double least = smaller(elements.least, common.least);
    spread = other_pins ? 1 : 1 - least / larger(elements.largest, inertias.largest);
    has_outliers = has_outliers || other_pins;
  }

  PD_HD static double larger(double a, double b) { return a < b ? b : a; }
  PD_HD static double smaller(double a, double b) { return b < a ? b : a; }
};

constexpr int ranges_count = 2;  // ranges that threads reduce at a time

// Measures with all threads of a team. The runner supplies each_element(visit(w, n)), w the stiffness at rest of the
// element whose reference is the n-th, and each_vertex(visit(i, a)) over the thread's share, with a = 0 where the step
// holds the vertex. Its reduce(ranges) combines the ranges of all threads.
#if defined(__CUDACC__)
#pragma nv_exec_check_disable
#endif
template <class Runner, class T>
PD_HD MaterialMismatch measure_mismatch(Runner& run, const Levels<T>& levels) {
  RatioRange first[ranges_count], second[ranges_count];
  RatioRange &elements = first[0], &inertias = first[1], &common = second[0], &differ = second[1];
  run.each_element([&](T stiffness, std::int64_t n) {
    elements.count(double(stiffness) / double(levels.reference_stiffness[n]));
  });
  // visit(a / a_0) for vertices that neither the step nor M holds; counts those that only one of them holds
  const auto each_inertia = [&](const auto& visit) {
    run.each_vertex([&](std::int64_t i, double a) {
      const bool free = levels.fine_inverse[i] > T(0);
      if (a > 0 && free) visit(a / double(levels.reference_inertia[i]));
      if ((a > 0) != free) differ.count(1);
    });
  };
  each_inertia([&](double ratio) { inertias.count(ratio); });
  run.reduce(first);
  MaterialMismatch mismatch(elements, inertias);
  const double most = outlier_ratio * mismatch.trusted;
  each_inertia([&](double ratio) {
    if (!(ratio > most)) common.count(ratio);
  });
  run.reduce(second);
  mismatch.conclude(elements, inertias, common, differ.largest > 0);
  return mismatch;
}

}  // namespace pd::inline PD_TARGET
