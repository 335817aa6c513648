// How the force and the gap of a loaded pair change with its corners, for the adjoint of a step.
//
// At the end x' of a step from x, a pair of normal force lambda adds -w (x) f to the gradient of the
// step's objective. It keeps its gap d - r, and a pair that sticks keeps its slip too:
//
//   smooth   f = lambda n
//   slides   f = lambda (n - mu s / |s|),   s = (1 - n n^T) sum w (x' - x)
//   sticks   f = lambda n + lambda_t
//
// Weights and normal are those of the closest points, which move with the corners: the derivative of
// w (x) n is the second derivative of the distance. All of it is differentiated by dual numbers.
#pragma once
#include "contact/pairs/closest.h"
#include "math/dual.h"

namespace pd::inline PD_TARGET {

// Share of the friction bound below which a tangential force sticks, and share of it that the slip of one iteration would
// have to take back. A pair whose slip would take back all of it slides.
constexpr double pair_sticking = 1e-3;
// Weights that are negative by less count as zero, so that a foot on the rim of a face is inside.
constexpr double feature_tie = 1e-6;
// Sine of the angle of two edges below which the frame of the pair is kept: their closest points
// jump from end to end.
constexpr double parallel_edges = 0.05;

// The parts of both sides that are nearest to each other. With the unit weights e_k of the corners,
// w = e_plus - e_minus + sum_j share_j (e_to_j - e_from_j), where the shares minimise |sum w x|.
struct PairFeature {
  signed char plus, minus, moves, to[2], from[2];
};

// Those of a point and a triangle, or of two edges, that with most shares first.
constexpr int point_features = 7, edge_features = 9;
PD_HD PairFeature pair_feature(bool edges, int number) {
  constexpr PairFeature points[point_features] = {
      {0, 1, 2, {1, 1}, {2, 3}}, {0, 1, 1, {1}, {2}}, {0, 2, 1, {2}, {3}}, {0, 3, 1, {3}, {1}},
      {0, 1, 0, {}, {}},         {0, 2, 0, {}, {}},   {0, 3, 0, {}, {}}};
  constexpr PairFeature lines[edge_features] = {
      {0, 2, 2, {1, 2}, {0, 3}}, {0, 2, 1, {2}, {3}}, {1, 2, 1, {2}, {3}},
      {0, 2, 1, {1}, {0}},       {0, 3, 1, {1}, {0}}, {0, 2, 0, {}, {}},
      {0, 3, 0, {}, {}},         {1, 2, 0, {}, {}},   {1, 3, 0, {}, {}}};
  return edges ? lines[number] : points[number];
}

// Weights of the closest points of a feature. With two shares and N = v_1 x v_2 the difference is
// along N: share_1 = -(s x v_2).N / N.N, share_2 = -(v_1 x s).N / N.N.
template <class R>
PD_HD void feature_weights(const PairFeature& of, const Vec3<R> (&corner)[4], R (&weight)[4]) {
  const Vec3<R> start = corner[of.plus] - corner[of.minus];
  R share[2];
  if (of.moves == 1) {
    const Vec3<R> along = corner[of.to[0]] - corner[of.from[0]];
    share[0] = -(dot(along, start) / dot(along, along));
  } else if (of.moves == 2) {
    const Vec3<R> first = corner[of.to[0]] - corner[of.from[0]],
                  second = corner[of.to[1]] - corner[of.from[1]], normal = cross(first, second);
    const R square = dot(normal, normal);
    share[0] = -(dot(cross(start, second), normal) / square);
    share[1] = -(dot(cross(first, start), normal) / square);
  }
  for (R& w : weight) w = R(0);
  weight[of.plus] = weight[of.plus] + R(1);
  weight[of.minus] = weight[of.minus] - R(1);
  for (int j = 0; j < of.moves; ++j) {
    weight[of.to[j]] = weight[of.to[j]] + share[j];
    weight[of.from[j]] = weight[of.from[j]] - share[j];
  }
}

// The nearest feature. One with two shares is the nearest wherever its closest points are inside.
template <class T>
PD_HD PairFeature nearest_feature(bool edges, const Vec3<T> (&corner)[4]) {
  const int count = edges ? edge_features : point_features;
  PairFeature best = pair_feature(edges, 0);
  T least = T(HUGE_VAL);
  for (int n = 0; n < count; ++n) {
    const PairFeature feature = pair_feature(edges, n);
    T weight[4];
    feature_weights(feature, corner, weight);
    bool inside = true;
    for (int a = 0; a < 4; ++a) {
      const T signed_weight = a == 0 || (a == 1 && edges) ? weight[a] : -weight[a];
      inside = inside && signed_weight >= T(-feature_tie);
    }
    const Vec3<T> diff = combined(weight, corner);
    const T square = dot(diff, diff);
    if (!inside || !(square < least)) continue;
    best = feature;
    least = square;
    if (best.moves == 2) break;
  }
  return best;
}

enum class PairState : int { smooth, slides, sticks };

// Weights, unit normal and gap of a pair.
template <class R>
struct PairFrame {
  R weight[4];
  Vec3<R> normal;
  R distance;
};

// A pair with its force at the end of a step.
template <class T>
struct LoadedPair {
  bool edges, turns;  // turns: its frame moves with the corners
  PairFeature feature;
  PairState state;
  T friction, normal_force;
  Vec3<T> tangential_force;
  PairFrame<T> frame;
  Vec3<T> basis[2];  // of its surface

  PD_HD int rows() const { return state == PairState::sticks ? 3 : 1; }

  template <class R>
  PD_HD PairFrame<R> frame_at(const Vec3<R> (&corner)[4]) const {
    PairFrame<R> at;
    if (!turns) {
      for (int a = 0; a < 4; ++a) at.weight[a] = R(frame.weight[a]);
      at.normal = {R(frame.normal.x), R(frame.normal.y), R(frame.normal.z)};
      at.distance = dot(at.normal, combined(at.weight, corner));
      return at;
    }
    feature_weights(feature, corner, at.weight);
    const Vec3<R> diff = combined(at.weight, corner);
    at.distance = square_root(dot(diff, diff));
    at.normal = (R(1) / at.distance) * diff;
    return at;
  }
};

// The force on side A, the gap, and the slip along the basis.
template <class R>
struct PairTerms {
  PairFrame<R> frame;
  Vec3<R> force;
  R slip[2];
};

// Along the surface, between two places.
template <class R>
PD_HD Vec3<R> pair_slip(const PairFrame<R>& at, const Vec3<R> (&end)[4],
                        const Vec3<R> (&start)[4]) {
  Vec3<R> moved[4];
  for (int a = 0; a < 4; ++a) moved[a] = end[a] - start[a];
  const Vec3<R> between = combined(at.weight, moved);
  return subtract_product(between, dot(at.normal, between), at.normal);
}

template <class T, class R>
PD_HD PairTerms<R> pair_terms(const LoadedPair<T>& pair, const Vec3<R> (&end)[4],
                              const Vec3<R> (&start)[4]) {
  const auto constant = [](const Vec3<T>& a) { return Vec3<R>{R(a.x), R(a.y), R(a.z)}; };
  PairTerms<R> terms{pair.frame_at(end), {}, {R(0), R(0)}};
  const R lambda(pair.normal_force);
  terms.force = lambda * terms.frame.normal;
  if (pair.state == PairState::smooth) return terms;
  const Vec3<R> slip = pair_slip(terms.frame, end, start);
  if (pair.state == PairState::slides) {
    const R against = (R(pair.friction) * lambda) / square_root(dot(slip, slip));
    terms.force = subtract_product(terms.force, against, slip);
    return terms;
  }
  terms.force = terms.force + constant(pair.tangential_force);
  for (int k = 0; k < 2; ++k) terms.slip[k] = dot(constant(pair.basis[k]), slip);
  return terms;
}

// The pair at its corners. `inverse`: 1 / D of the corners [m/N], 0 for what moves by hand.
template <class T>
PD_HD LoadedPair<T> loaded_pair(bool edges, const Vec3<T> (&end)[4], const Vec3<T> (&start)[4],
                                const T (&inverse)[4], T friction, T normal_force,
                                const Vec3<T>& tangential_force) {
  LoadedPair<T> pair{edges,
                     true,
                     nearest_feature(edges, end),
                     PairState::smooth,
                     friction,
                     normal_force,
                     tangential_force,
                     {},
                     {}};
  pair.frame = pair.frame_at(end);
  if (edges) {
    const Vec3<T> first = end[1] - end[0], second = end[3] - end[2], normal = cross(first, second);
    pair.turns = dot(normal, normal) >
                 T(parallel_edges * parallel_edges) * dot(first, first) * dot(second, second);
  }
  const Vec3<T>& n = pair.frame.normal;
  // the axis that is farthest from the normal, without its part along the normal
  const T x = absolute(n.x), y = absolute(n.y), z = absolute(n.z);
  const Vec3<T> axis = {T(x <= y && x <= z), T(y < x && y <= z), T(z < x && z < y)};
  const Vec3<T> across = cross(n, axis);
  pair.basis[0] = (T(1) / square_root(dot(across, across))) * across;
  pair.basis[1] = cross(n, pair.basis[0]);
  const T bound = friction * normal_force;
  if (!(bound > T(0))) return pair;
  T yielding(0);
  for (int a = 0; a < 4; ++a)
    yielding = multiply_add(pair.frame.weight[a] * pair.frame.weight[a], inverse[a], yielding);
  const Vec3<T> slip = pair_slip(pair.frame, end, start);
  const T pull = square_root(dot(tangential_force, tangential_force));
  const T slipped = square_root(dot(slip, slip)), reach = bound * yielding;
  const bool slides = slipped > T(pair_sticking) * reach &&
                      (pull >= T(1 - pair_sticking) * bound || slipped > reach);
  pair.state = slides ? PairState::slides : PairState::sticks;
  return pair;
}

// Derivatives of a loaded pair by one number of its corners, at the end or at the start. Number
// 3 a + i is component i of corner a.
template <class T>
struct PairSlope {
  T load[12];  // of -w (x) f
  T row[3];    // of the gap and of the slips

  PD_HD PairSlope(const LoadedPair<T>& pair, const Vec3<T> (&end)[4], const Vec3<T> (&start)[4],
                  bool by_end, int j) {
    using D = Dual<T>;
    const auto number = [&](T value, int own, bool varies) {
      return D(value, T(varies && own == j ? 1 : 0));
    };
    Vec3<D> after[4], before[4];
    for (int a = 0; a < 4; ++a) {
      after[a] = {number(end[a].x, 3 * a, by_end), number(end[a].y, 3 * a + 1, by_end),
                  number(end[a].z, 3 * a + 2, by_end)};
      before[a] = {number(start[a].x, 3 * a, !by_end), number(start[a].y, 3 * a + 1, !by_end),
                   number(start[a].z, 3 * a + 2, !by_end)};
    }
    const PairTerms<D> terms = pair_terms(pair, after, before);
    for (int a = 0; a < 4; ++a) {
      const Vec3<D> of = terms.frame.weight[a] * terms.force;
      load[3 * a] = -of.x.slope, load[3 * a + 1] = -of.y.slope, load[3 * a + 2] = -of.z.slope;
    }
    row[0] = terms.frame.distance.slope;
    row[1] = terms.slip[0].slope, row[2] = terms.slip[1].slope;
  }
};

// First derivatives of a loaded pair.
template <class T>
struct PairSlopes {
  T load[12][12];   // of -w (x) f, by the corners at the end
  T row[3][12];     // of the gap and of the slips, by these: C
  T column[3][12];  // of w (x) f by the multipliers: B
  Vec3<T> force;    // f
  // of a pair that slides, else 0: mu lambda / |s| [N/m], by which its slip turns across
  T stiffness;
  Vec3<T> across;

  // All but the derivatives, which `differentiate` finds.
  PD_HD void set(const LoadedPair<T>& pair, const Vec3<T> (&end)[4], const Vec3<T> (&start)[4]) {
    const PairTerms<T> terms = pair_terms(pair, end, start);
    const T lambda = pair.normal_force;
    const bool slides = pair.state == PairState::slides;
    const Vec3<T> first = slides ? (T(1) / lambda) * terms.force : terms.frame.normal;
    const Vec3<T> along[3] = {first, pair.basis[0], pair.basis[1]};
    for (int k = 0; k < 3; ++k) {
      for (int a = 0; a < 4; ++a) {
        const Vec3<T> of = terms.frame.weight[a] * along[k];
        column[k][3 * a] = of.x, column[k][3 * a + 1] = of.y, column[k][3 * a + 2] = of.z;
      }
    }
    force = terms.force;
    const Vec3<T> slip = pair_slip(terms.frame, end, start);
    const T length = square_root(dot(slip, slip));
    stiffness = slides ? pair.friction * lambda / length : T(0);
    across = (slides ? T(1) / length : T(0)) * cross(terms.frame.normal, slip);
  }

  // Derivatives by number j of the corners at the end.
  PD_HD void differentiate(const LoadedPair<T>& pair, const Vec3<T> (&end)[4],
                           const Vec3<T> (&start)[4], int j) {
    const PairSlope<T> slope(pair, end, start, true, j);
    for (int i = 0; i < 12; ++i) load[i][j] = slope.load[i];
    for (int k = 0; k < 3; ++k) row[k][j] = slope.row[k];
  }
};

}  // namespace pd::inline PD_TARGET
