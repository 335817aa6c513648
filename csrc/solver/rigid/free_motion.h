// Rigid motions of a connected piece. They strain nothing, so along them E is the sum of a / 2 |u - s|^2 alone, springs included,
// least where the piece fits its targets best: a weighted fit of two sets of points, known in closed form (Kabsch 1976, Horn 1987).
// With positions y = x + u, targets z = x + s and means weighted by a
//   u += (R - I) (y - mean y) + mean (z - y),   R = argmax over rotations of tr(R^T H),   H = sum a (z - mean z) (y - mean y)^T
// Few iterations cannot turn or shift a stiff piece as a whole; after this its momentum is right, linear and angular. Pins that hold
// a piece at one point p leave it the turn about p, with p in place of both means; pins along a line the turn about that.
//
// Contacts push the vertices of its straight course out each for itself, which squeezes a piece; few iterations do not undo that
// where it is stiff. Such a piece starts from where it is instead, and its rigid motions take it on.
//
// What a piece touches balances part of its momentum. A plane leaves it the turn about the normal and the way along the plane;
// planes that meet leave the way along their edge. Neither moves any vertex towards a plane; solver/rigid/rolling_contact.h has what may. With
// friction the way along a plane, or the edge of two, is shortened by friction times the way that the plane stops, which is Coulomb's law
// for the sum of all forces where all vertices slide the same way; turns are left to the iterations. A motion that ends where it comes to a contact goes
// on from there, on what the piece touches then.
#pragma once
#include "contact/plane_sphere.h"
#include "math/rotation.h"

namespace pd::inline PD_TARGET {

// Sums over the vertices of a piece, in double. First those that give the mean of y; then the others, about that mean, so that far
// from the origin, or where a stiff spring outweighs all other vertices, nothing cancels.
struct RigidSums {
  static constexpr int weight = 0, position = 1, target_offset = 4, second_moment = 7, turn = 13;
  static constexpr int pins = 22, pin_position = 23, pin_second_moment = 26, count = 32;
};

// Adds a vertex of weight a at y to the sums from `weight` on, over a and a y.
template <class W>
PD_HD void add_mean(W* sum, const W& a, const Vec3<W>& y) {
  sum[0] = sum[0] + a;
  sum[1] = multiply_add(a, y.x, sum[1]);
  sum[2] = multiply_add(a, y.y, sum[2]);
  sum[3] = multiply_add(a, y.z, sum[3]);
}

// Adds a vertex to the sums from `target_offset` on: a (z - y); a r r^T; a (z - y) r^T. Here r = `lever_arm` is its
// position from the mean, and z - y = `target_offset` leads to its target.
template <class W>
PD_HD void add_moments(W* sum, const W& a, const Vec3<W>& lever_arm, const Vec3<W>& target_offset) {
  constexpr int second_moment = RigidSums::second_moment - RigidSums::target_offset,
                turn = RigidSums::turn - RigidSums::target_offset;
  const W at[3] = {lever_arm.x, lever_arm.y, lever_arm.z},
          way[3] = {a * target_offset.x, a * target_offset.y, a * target_offset.z};
  int n = second_moment;
  for (int r = 0; r < 3; ++r) {
    const W moment = a * at[r];
    sum[r] = sum[r] + way[r];
    for (int c = r; c < 3; ++c, ++n) sum[n] = multiply_add(moment, at[c], sum[n]);
    for (int c = 0; c < 3; ++c)
      sum[turn + 3 * r + c] = multiply_add(way[r], at[c], sum[turn + 3 * r + c]);
  }
}

// Adds a vertex that a pin holds on its target (a = 0) to the sums from `pins` on: 1; r; r r^T, with r = `lever_arm`.
template <class W>
PD_HD void add_pin(W* sum, const W& a, const Vec3<W>& lever_arm) {
  const W at[3] = {lever_arm.x, lever_arm.y, lever_arm.z},
          pinned = select(a > W(0.0), W(0.0), W(1.0));
  sum[0] = sum[0] + pinned;
  int n = RigidSums::pin_second_moment - RigidSums::pins;
  for (int r = 0; r < 3; ++r) {
    const W held = pinned * at[r];
    sum[1 + r] = sum[1 + r] + held;
    for (int c = r; c < 3; ++c, ++n) sum[n] = multiply_add(held, at[c], sum[n]);
  }
}

// The mean of y, from the first sums.
PD_HD Vec3<double> center_of(const double* sum) {
  const double share = sum[0] > 0 ? 1.0 / sum[0] : 0.0;
  return {share * sum[1], share * sum[2], share * sum[3]};
}

// y += turn (y - center) + shift
template <class T>
struct RigidMotion {
  Mat3<T> turn;  // R - I
  Vec3<T> center, shift;

  PD_HD Vec3<T> of(const Vec3<T>& y) const { return turn * (y - center) + shift; }
};

// Pins lie at one point, or on one line, that are no further off than this share of the piece's size.
constexpr double pins_apart = 1e-4;

// R - I is not known better, in double.
constexpr double least_turn = 4e-15;

// What pins leave to a piece.
enum class Hold { none, point, line, all };

PD_HD Mat3<double> symmetric(const double* s) {
  return {{{s[0], s[1], s[2]}, {s[1], s[3], s[4]}, {s[2], s[4], s[5]}}};
}

PD_HD Mat3<double> less_identity(Mat3<double> a, double share) {
  a.row[0].x -= share;
  a.row[1].y -= share;
  a.row[2].z -= share;
  return a;
}

// Less is rounding, which would keep what drifts from coming to rest.
PD_HD Mat3<double> beyond_rounding(const Mat3<double>& turn) {
  return frobenius(turn, turn) < least_turn * least_turn ? Mat3<double>{} : turn;
}

// R - I of the rotation R that makes tr(R^T H) largest.
PD_COLD inline Mat3<double> best_turn(const Mat3<double>& covariance) {
  const double size = square_root(frobenius(covariance, covariance));
  const Mat3<double> r = nearest_rotation((1.0 / (size > 0 ? size : 1.0)) * covariance);
  return beyond_rounding(less_identity(r, 1.0));
}

// The same of rotations about n alone: R - I = sin [n]x + (1 - cos) (n n^T - I).
PD_COLD inline Mat3<double> best_turn_about(const Mat3<double>& covariance, const Vec3<double>& n) {
  const Vec3<double> image = covariance * n;
  const double along =
      covariance.row[0].x + covariance.row[1].y + covariance.row[2].z - dot(n, image);
  const double across = dot(n, axis_of(covariance));
  const double size = square_root(along * along + across * across);
  if (!(size > 0)) return {};
  const double sine = across / size, lift = 1.0 - along / size;
  Mat3<double> turn = sine * cross_matrix(n);
  const double axis[3] = {n.x, n.y, n.z};
  for (int r = 0; r < 3; ++r) turn.row[r] = multiply_add(lift * axis[r], n, turn.row[r]);
  return beyond_rounding(less_identity(turn, lift));
}

// By Cayley's formula: about an axis by 2 atan(|v| / 2), less the identity.
PD_HD Mat3<double> small_turn(const Vec3<double>& v) {
  const Mat3<double> half = cross_matrix(0.5 * v), square = half * half;
  const double share = 2.0 / (1.0 + 0.25 * dot(v, v));
  Mat3<double> turn = share * half;
  for (int r = 0; r < 3; ++r) turn.row[r] = multiply_add(share, square.row[r], turn.row[r]);
  return turn;
}

// 4 cos^2(angle / 2), at most, of what counts as half a turn.
constexpr double half_turn = 1e-6;

// R - I of about that share of a turn; none of half a turn, which has no axis.
PD_HD Mat3<double> part_of_turn(const Mat3<double>& turn, double share) {
  if (share == 1.0) return turn;
  const double left = 4.0 + turn.row[0].x + turn.row[1].y + turn.row[2].z;
  return left > half_turn ? small_turn(2.0 * share / left * axis_of(turn)) : Mat3<double>{};
}

// What the sums say about a piece: where it turns, its shift, H, the square of its size, and the line along which pins hold it.
struct RigidFit {
  Hold hold = Hold::none;
  double weight, square;
  Vec3<double> center, shift, axis = {0, 0, 0};
  Mat3<double> covariance;

  PD_HD explicit RigidFit(const double (&sum)[RigidSums::count])
      : weight(sum[RigidSums::weight]), center(center_of(sum)) {
    using S = RigidSums;
    const double share = weight > 0 ? 1.0 / weight : 0.0;
    shift = {share * sum[S::target_offset], share * sum[S::target_offset + 1],
             share * sum[S::target_offset + 2]};
    const Mat3<double> second_moment = symmetric(sum + S::second_moment);
    const double* turn = sum + S::turn;
    for (int r = 0; r < 3; ++r)
      covariance.row[r] =
          second_moment.row[r] + Vec3<double>{turn[3 * r], turn[3 * r + 1], turn[3 * r + 2]};
    square = share * (second_moment.row[0].x + second_moment.row[1].y + second_moment.row[2].z);
    if (sum[S::pins] > 0) turn_about_pins(sum, pins_apart * pins_apart * square);
  }

  PD_HD RigidMotion<double> still() const { return {{}, center, {0, 0, 0}}; }

  // Of a piece that touches nothing.
  PD_HD RigidMotion<double> free() const {
    if (hold == Hold::all) return still();
    if (hold == Hold::line) return {best_turn_about(covariance, axis), center, shift};
    return {best_turn(covariance), center, shift};
  }

 private:
  // The middle of the pins becomes the center; `apart`: square of how far from a point or a line they may be.
  PD_COLD void turn_about_pins(const double (&sum)[RigidSums::count], double apart) {
    using S = RigidSums;
    const double share = 1.0 / sum[S::pins];
    const double* at = sum + S::pin_position;
    const double centroid[3] = {share * at[0], share * at[1], share * at[2]};
    const Vec3<double> pivot = {centroid[0], centroid[1], centroid[2]};  // from the mean
    Mat3<double> second_moment = share * symmetric(sum + S::pin_second_moment);
    for (int r = 0; r < 3; ++r)
      second_moment.row[r] = subtract_product(second_moment.row[r], centroid[r], pivot);
    const SignedSvd<double> svd = signed_svd(second_moment);
    hold = svd.s[1] > apart ? Hold::all : svd.s[0] > apart ? Hold::line : Hold::point;
    axis = {svd.u.row[0].x, svd.u.row[1].x, svd.u.row[2].x};
    const Vec3<double> reach = sum[S::weight] * (shift - pivot);
    const double out[3] = {reach.x, reach.y, reach.z};
    for (int r = 0; r < 3; ++r)
      covariance.row[r] = subtract_product(covariance.row[r], out[r], pivot);
    center = center + pivot;
    shift = {0, 0, 0};
  }
};

// What a piece would touch if it moved freely: a bit for each of the first planes, and one for all other contacts together. Sums over
// the vertices that lie on those planes: of the slips and of 1 where there is friction; of 1, of their arms from the middle of the
// piece, and of products of these. The least of the slips and of their negatives, axis by axis; and of the shares of that motion after
// which vertices come to those planes.
struct Touch {
  static constexpr int planes = 8;
  static constexpr unsigned others = 1u << planes;
  static constexpr int slip = 0, rubbing = 3, lying = 4, lever_arm = 5, second_moment = 8,
                       sums = 14;
  static constexpr int share = 6, bounds = 7;
};

// Sums over the vertices of a piece that say from where it starts: of a |u - s|^2 and a |v - s|^2, u being its course out of the
// contacts, v where it is; of k = D - a, k p and k |p|^2, p being how far contacts have pushed; of a, and of k where they have; and how
// many vertices pins hold, or forces would lead into other contacts than the first planes.
struct StartSums {
  static constexpr int left = 0, before = 1, stiffness = 2, push = 3, square = 6, weight = 7;
  static constexpr int pushed = 8, beside = 9, count = 10;
};

// Adds a vertex to these; `still`: v.
template <class W, class R>
PD_HD void add_start(W (&sum)[StartSums::count], const Contacts<R>& contacts, const Vec3<R>& x,
                     const Vec3<R>& target, const R& inertia, const R& inverse, const Vec3<R>& u,
                     const Vec3<R>& still, const Vec3<R>& push) {
  using S = StartSums;
  const auto wide = [](const Vec3<R>& a) {
    return Vec3<W>{convert<double>(a.x), convert<double>(a.y), convert<double>(a.z)};
  };
  const R none(0), one(1);
  const int distinct_planes =
      contacts.plane_count < Touch::planes ? contacts.plane_count : Touch::planes;
  const R apart = select(contacts.least_gap(x + target, distinct_planes) > none, none, one);
  const R beside = select(inverse > none, apart, one);
  const W a = convert<double>(inertia);
  const W stiffness = W(1.0) / convert<double>(select(inverse > none, inverse, one)) - a;
  const Vec3<W> left = wide(u) - wide(target), before = wide(still) - wide(target);
  const Vec3<W> p = wide(push), pull = stiffness * p;
  const W square = dot(p, p), pushed = select(square > W(0.0), stiffness, W(0.0));
  const W add[S::count] = {a * dot(left, left),
                           a * dot(before, before),
                           stiffness,
                           pull.x,
                           pull.y,
                           pull.z,
                           stiffness * square,
                           a,
                           pushed,
                           convert<double>(beside)};
  for (int n = 0; n < S::count; ++n) sum[n] = sum[n] + add[n];
}

// Of the most that pushes may squeeze a piece by.
constexpr double likely_squeeze = 0.5;
// Of what it costs to shift a piece as a whole by how far contacts push: so little is no reason to give up the course of what is soft.
constexpr double likely_lift = 6.0;
// Less of what is left is no reason to give up the course, be it rounding of what lies on a plane.
constexpr double least_squeeze = 0.01;

// Whether a piece starts from where it is, since on its course more energy would be left than there, or than rigid motions leave that go
// on from there: a shift by how far contacts push, d, out of them costs sum a / 2 d^2. As far as that is told beforehand: strain that there
// is already is not counted, and the squeeze is estimated by what pushes p differ. For any c it is at most sum k / 2 |p - c|^2, by
// A <= D of solver/step.h, where D is the weighted diagonal.
PD_HD bool starts_still(const double (&sum)[StartSums::count]) {
  using S = StartSums;
  if (!(sum[S::stiffness] > 0) || sum[S::beside] > 0) return false;
  const double* p = sum + S::push;
  const double mean = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) / sum[S::stiffness];
  const double squeeze = likely_squeeze * (sum[S::square] - mean);
  const double far = sum[S::pushed] > 0 ? sum[S::square] / sum[S::pushed] : 0.0;
  const double gain = sum[S::before] - sum[S::left], lift = likely_lift * sum[S::weight] * far;
  return squeeze > (gain < lift ? gain : lift) && squeeze > least_squeeze * sum[S::left];
}

// Adds a vertex at y = x + u, whose piece would move by `motion`, to these; `near(k, gap)` learns how far from the first planes it
// would come, and at last from the other contacts. `settled`: after the iterations. Then spheres, which curve away from a piece that they
// hold, count by remaining_gap, in numbers of 0 and less that are no distances.
template <class W, class R, class Near>
PD_HD void add_touch(W (&sums)[Touch::sums], W (&bounds)[Touch::bounds],
                     const Contacts<R>& contacts, const Vec3<R>& y, const Vec3<R>& u,
                     const RigidMotion<R>& motion, bool settled, const Near& near) {
  const R none(0), one(1), far(HUGE_VAL);
  const Vec3<R> way = motion.of(y), moved = y + way, lever_arm = y - motion.center;
  // in double, since their spread is a difference
  const Vec3<W> wide_lever_arm = {convert<double>(lever_arm.x), convert<double>(lever_arm.y),
                                  convert<double>(lever_arm.z)};
  const int distinct_planes =
      contacts.plane_count < Touch::planes ? contacts.plane_count : Touch::planes;
  for (int k = 0; k < distinct_planes; ++k) {
    const Plane<R>& plane = contacts.planes[k];
    const R before = gap(plane, y), after = gap(plane, moved);
    near(k, after);
    const auto comes = before > none && !(after > none);
    const R share = before / select(comes, before - after, one);
    bounds[Touch::share] =
        lesser(bounds[Touch::share],
               convert<double>(select(after > none, far, select(comes, share, none))));
    const R reach = -R(scalar_of<R>(contact_tolerance)) * dot(motion.shift, plane.normal);
    const R lies = select(before < reach, one, none);
    const R rubs = select(plane.friction > none, lies, none);
    const Vec3<R> slip = rubs * tangential(u, plane.normal);
    const W there = convert<double>(lies);
    const Vec3<W> at = there * wide_lever_arm;
    const W add[Touch::sums] = {convert<double>(slip.x),
                                convert<double>(slip.y),
                                convert<double>(slip.z),
                                convert<double>(rubs),
                                there,
                                at.x,
                                at.y,
                                at.z,
                                at.x * wide_lever_arm.x,
                                at.x * wide_lever_arm.y,
                                at.x * wide_lever_arm.z,
                                at.y * wide_lever_arm.y,
                                at.y * wide_lever_arm.z,
                                at.z * wide_lever_arm.z};
    for (int n = 0; n < Touch::sums; ++n) sums[n] = sums[n] + add[n];
    const R slips[3] = {slip.x, slip.y, slip.z};
    for (int n = 0; n < 3; ++n) {
      const R least = select(rubs > none, slips[n], far);
      const R most = select(rubs > none, -slips[n], far);
      bounds[n] = lesser(bounds[n], convert<double>(least));
      bounds[3 + n] = lesser(bounds[3 + n], convert<double>(most));
    }
  }
  near(Touch::planes, contacts.least_remaining_gap(y, way, distinct_planes, settled));
}

// Of the contacts that a piece does not touch: `touches(k)` says which of the first planes it does.
template <class R, class Touches>
PD_HD R least_gap_beside(const Contacts<R>& contacts, const Vec3<R>& y, const Vec3<R>& way,
                         bool settled, const Touches& touches) {
  constexpr int most = Touch::planes;
  const int distinct_planes = contacts.plane_count < most ? contacts.plane_count : most;
  R least = contacts.least_remaining_gap(y, way, distinct_planes, settled);
  for (int k = 0; k < distinct_planes; ++k)
    least = lesser(least, select(touches(k), R(HUGE_VAL), gap(contacts.planes[k], y + way)));
  return least;
}

// Along rough planes, whose friction can stop so much of the way: `along` is how far a piece would go there, `mean` how far its vertices
// slide. Where their slips differ by up to d, friction acts along none of them alone: of its force a share of up to 2 d / |slip| is in
// doubt, and what is within that is left to the iterations, so that nothing moves once they have converged. So it is where friction
// could stop the whole piece, which it then does.
PD_COLD inline Vec3<double> slide(const Vec3<double>& mean, const Vec3<double>& along, double rub,
                                  const double (&bounds)[Touch::bounds]) {
  double square = 0;
  for (int a = 0; a < 3; ++a) square += (bounds[a] + bounds[3 + a]) * (bounds[a] + bounds[3 + a]);
  const double apart = 2.0 * square_root(square);
  const Vec3<double> free = mean + along;
  const double length = square_root(dot(free, free)), left = length - rub;
  const double slip = square_root(dot(mean, mean));
  if (!(left > 0)) return slip > apart && slip * slip > apart * rub ? -mean : Vec3<double>{};
  const Vec3<double> way = (left / length) * free - mean;
  const double doubt = apart < 2.0 * left ? rub * apart / left : 2.0 * rub;
  const double size = square_root(dot(way, way));
  if (!(size > doubt)) return {};
  return (1.0 - doubt / size) * way;
}

// How far a piece goes along one plane or the edge of two, by Coulomb's law for the sum of forces. A plane pushes by how much of the way it
// stops: two together by l1 n1 + l2 n2, which leaves the way along their edge.
PD_COLD inline Vec3<double> slide_on(const Plane<double> (&planes)[2], int count,
                                     const Vec3<double>& shift, const double (&sums)[Touch::sums],
                                     const double (&bounds)[Touch::bounds]) {
  if (!(sums[Touch::rubbing] > 0)) return {};
  const double share = 1.0 / sums[Touch::rubbing];
  const Vec3<double> mean =
      share * Vec3<double>{sums[Touch::slip], sums[Touch::slip + 1], sums[Touch::slip + 2]};
  const Vec3<double> n = planes[0].normal, m = planes[1].normal;
  const double stopped = -dot(shift, n);
  if (count == 1) {
    const Vec3<double> along = multiply_add(stopped, n, shift);
    return stopped > 0 ? slide(mean, along, planes[0].friction * stopped, bounds) : along;
  }
  // by the cross product, which nothing cancels in where the planes are nearly parallel or the normals not quite of length 1
  const Vec3<double> across = cross(n, m);
  const double square = dot(across, across), other = -dot(shift, m), nm = dot(n, m);
  const double push = (dot(m, m) * stopped - nm * other) / square;
  const double back = (dot(n, n) * other - nm * stopped) / square;
  if (!(push > 0 && back > 0)) return {};
  const Vec3<double> edge = (1.0 / square_root(square)) * across;
  return slide(dot(mean, edge) * edge, dot(shift, edge) * edge,
               planes[0].friction * push + planes[1].friction * back, bounds);
}

// Parts of a motion that contacts end one after the other, at most: over a corner and an edge on to a face there are three.
constexpr int motion_legs = 4;

// Whether a motion ends at the first of the planes, since the piece is above all that it would touch.
PD_HD bool comes_to_plane(unsigned touched, const double (&bounds)[Touch::bounds]) {
  return touched != 0 && touched < Touch::others && bounds[Touch::share] > contact_tolerance;
}

// The motion that contacts leave to a piece that touches some of them; `plane(k)` are the first of them. From above all of these it
// goes as far as the first.
template <class PlaneAt>
PD_HD RigidMotion<double> motion_on_contacts(const RigidFit& fit, unsigned touched,
                                             const double (&sums)[Touch::sums],
                                             const double (&bounds)[Touch::bounds],
                                             const PlaneAt& plane) {
  constexpr double parallel = 1e-12;  // square of what a normal adds to others
  if (touched == 0) return fit.free();
  RigidMotion<double> motion = fit.still();
  if (touched & Touch::others) return motion;
  if (comes_to_plane(touched, bounds)) {
    motion = fit.free();
    motion.turn = part_of_turn(motion.turn, bounds[Touch::share]);
    motion.shift = bounds[Touch::share] * motion.shift;
    return motion;
  }
  if (fit.hold != Hold::none) return motion;
  Vec3<double> normals[3];
  Plane<double> planes[2] = {};
  int count = 0, touches = 0;
  double friction = 0;
  PD_ROLLED
  for (int k = 0; k < Touch::planes; ++k) {
    if (!(touched >> k & 1)) continue;
    const Plane<double> p = plane(k);
    if (touches < 2) planes[touches] = p;
    ++touches;
    if (p.friction > friction) friction = p.friction;
    Vec3<double> n = p.normal;
    for (int j = 0; j < count; ++j) n = subtract_product(n, dot(n, normals[j]), normals[j]);
    const double square = dot(n, n);
    if (count < 3 && square > parallel) normals[count++] = (1.0 / square_root(square)) * n;
  }
  if (count == 3 || (friction > 0 && touches != count)) return motion;
  if (friction > 0) {
    motion.shift = slide_on(planes, count, fit.shift, sums, bounds);
    return motion;
  }
  motion.shift = fit.shift;
  for (int j = 0; j < count; ++j)
    motion.shift = subtract_product(motion.shift, dot(motion.shift, normals[j]), normals[j]);
  if (count == 1) motion.turn = best_turn_about(fit.covariance, normals[0]);
  return motion;
}

}  // namespace pd::inline PD_TARGET
