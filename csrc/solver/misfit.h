// How far the material of a step is from that which M of solver/multilevel.h was made of.
#pragma once
#include "math/config.h"

#include <cmath>

namespace pd::inline PD_TARGET {

// Ratios of one to the other.
struct Range {
  double least = HUGE_VAL, largest = 0;

  PD_HD void count(double ratio) { add({ratio, ratio}); }

  PD_HD void add(const Range& other) {
    least = other.least < least ? other.least : least;
    largest = other.largest > largest ? other.largest : largest;
  }
};

constexpr double known_inertia =
    4;  // times what M was made of and the elements have become: more is left to the diagonal

struct Misfit {
  double scale = 1;        // s of A <= s A_0, strangers aside
  double spread = 0;       // 1 - q / s, q A_0 <= A <= s A_0 with them
  double trusted = 1;      // ratio of inertias up to known_inertia times which M is believed
  bool strangers = false;  // whether there are vertices beyond, or that M alone holds

  Misfit() = default;

  PD_HD Misfit(const Range& elements, const Range& inertias)
      : trusted(larger(elements.largest, smaller(inertias.least, inertias.largest))),
        strangers(inertias.largest > known_inertia * trusted) {}

  // `common`: the inertias that are no strangers'; `other_pins`: the step holds other vertices than M does
  PD_HD void conclude(const Range& elements, const Range& inertias, const Range& common,
                      bool other_pins) {
    scale = larger(elements.largest, common.largest);
    const double least = smaller(elements.least, common.least);
    spread = other_pins ? 1 : 1 - least / larger(elements.largest, inertias.largest);
    strangers = strangers || other_pins;
  }

  PD_HD static double larger(double a, double b) { return a < b ? b : a; }
  PD_HD static double smaller(double a, double b) { return b < a ? b : a; }
};

}  // namespace pd::inline PD_TARGET
