// How a piece tips or rolls on the one plane that it touches: it turns about one of its vertices, or the line through two of them.
// They stick, where friction can take back how far they slid, or slide on the way that they slid; without friction freely. Then E is
// least where torques balance: in closed form for those that stick (solver/rigid.h), by Newton's method for those that slide.
//
// What pushes a piece must be a force that contacts have: outward, in sum within the cone of friction, and between the two vertices. As
// such forces are what the iterations converge to as well, nothing moves once they have converged; that two vertices which stick may
// not be able to share the force, where it twists, is left to the iterations. Which they are is found by turns, as in an active set
// method: first the one that lies furthest to where pressure has its centre, then the one that the turn about it takes deepest; of
// three the two remain beyond whose line that centre lies. A turn that takes other vertices into a contact goes as far as that one.
// All that costs a search over the vertices each time, and nothing where a piece touches nothing or rests evenly.
#pragma once
#include "solver/rigid.h"

namespace pd::inline PD_TARGET {

constexpr int tipping_rounds = 5;  // searches, at most
// Of how near a vertex is that lies on the plane: vertices may go so deep, and the piece is lifted by as much.
constexpr double touching_depth = 1e-3;
constexpr double rounded_depth = 0.1;  // what one of those it turns about may go for rounding
constexpr double slips_alike = 0.02;   // distance between directions of slips that count as one
// Square of how far off the centre of pressure of what rests is, by the spread of what lies there: 1/2 at the edges of three vertices, 1
// of four, and 3 of many that lie evenly. Where they crowd at one side a piece may stand with more, or pass for tipping with less.
constexpr double resting = 0.5;
constexpr double slips_onward = 0.9;      // least cosine between a slip before and after
constexpr double pressure_beyond = 1e-6;  // of a line, at its ends
constexpr int balance_steps = 8;          // of Newton's method
constexpr double balanced = 1e-9;         // its last step

// What a search finds: how deep a vertex goes beyond where it is, negative, or how far it lies; its distance from that contact before;
// where it is, and its displacement.
struct Found {
  static constexpr int depth = 0, before = 1, at = 2, way = 5, count = 8;
};

// What vertices are searched for.
template <class R>
struct TippingSearch {
  Vec3<R> normal, away;
  R height, reach;
  R seeks;  // 1: the vertex on the plane that lies furthest `away`; 0: the one that the motion takes deepest into a contact

  // Less is more of that.
  PD_HD void look(const Contacts<R>& contacts, const RigidMotion<R>& motion, const Vec3<R>& y,
                  R& depth, R& before) const {
    const R none(0), far(HUGE_VAL);
    const Vec3<R> way = motion.of(y);
    depth = before = far;
    const auto deeper = [&](const R& gap, const R& after) {
      const R beyond = after - lesser(gap, none);
      const auto takes = beyond < depth;
      before = select(takes, gap, before);
      depth = select(takes, beyond, depth);
    };
    for (int k = 0; k < contacts.plane_count; ++k) {
      const R distance = gap(contacts.planes[k], y);
      // as a difference, so that what stays where it is keeps its distance to the last bit
      deeper(distance, distance + dot(contacts.planes[k].normal, way));
    }
    if (contacts.ball_count > 0)
      deeper(contacts.least_gap(y, contacts.plane_count),
             contacts.least_gap(y + way, contacts.plane_count));
    const R lies = dot(normal, y) - height;
    const R furthest = select(lies < reach, -dot(away, y), far);
    depth = select(seeks > none, furthest, depth);
  }
};

// Keeps a vertex if it is more of what is searched for.
template <class W>
PD_HD void keep_found(W (&found)[Found::count], const W& depth, const W& before, const Vec3<W>& y,
                      const Vec3<W>& u) {
  const auto takes = depth < found[Found::depth];
  const W own[Found::count] = {depth, before, y.x, y.y, y.z, u.x, u.y, u.z};
  for (int n = 0; n < Found::count; ++n) found[n] = select(takes, own[n], found[n]);
}

// By Cayley's formula: about an axis by 2 atan(|v| / 2), less the identity.
PD_HD Mat3<double> small_turn(const Vec3<double>& v) {
  const Mat3<double> half = cross_matrix(0.5 * v), square = half * half;
  const double share = 2.0 / (1.0 + 0.25 * dot(v, v));
  Mat3<double> turn = share * half;
  for (int r = 0; r < 3; ++r) turn.row[r] = multiply_add(share, square.row[r], turn.row[r]);
  return turn;
}

// R - I of about that share of a turn.
PD_HD Mat3<double> part_of_turn(const Mat3<double>& turn, double share) {
  if (share == 1.0) return turn;
  const double trace = turn.row[0].x + turn.row[1].y + turn.row[2].z;
  return small_turn(2.0 * share / (4.0 + trace) * axis_of(turn));
}

// A turn followed by another, all of them R - I.
PD_HD Mat3<double> turned(const Mat3<double>& turn, const Mat3<double>& then) {
  const Mat3<double> both = then * turn;
  return {{turn.row[0] + then.row[0] + both.row[0], turn.row[1] + then.row[1] + both.row[1],
           turn.row[2] + then.row[2] + both.row[2]}};
}

// a - s b c^T
PD_HD Mat3<double> less_outer(Mat3<double> a, double s, const Vec3<double>& b,
                              const Vec3<double>& c) {
  const double row[3] = {b.x, b.y, b.z};
  for (int r = 0; r < 3; ++r) a.row[r] = subtract_product(a.row[r], s * row[r], c);
  return a;
}

struct Tipping {
  enum class Stage { none, seek, turn };

  struct Vertex {
    Vec3<double> at, slip;
  };

  Stage stage;
  bool tips;                 // its motion is one of these
  int number, count, round;  // of the plane; of vertices that it turns about; of searches
  double reach, share;       // of the turn
  // where pressure has its centre if nothing moves, from the middle of what lies there, and in all
  Vec3<double> away, pressure;
  Vertex on[2];

  PD_HD void end() {
    stage = Stage::none;
    tips = false;
  }
  PD_HD bool goes_on() const { return stage != Stage::none; }

  // `sums`: of the vertices that lie on the plane, see Touch. With none the piece is to land: the first vertex is the one that
  // its free motion takes deepest, which is what a search finds with that.
  PD_HD void begin(const RigidFit& fit, int plane_number, const Plane<double>& plane,
                   const double (&sums)[Touch::sums]) {
    end();
    const Vec3<double> n = plane.normal;
    reach = -lies_within * dot(fit.shift, n);
    if (fit.hold != Hold::none || !(reach > 0.0)) return;
    number = plane_number;
    count = round = 0;
    share = 1.0;
    const bool lands = !(sums[Touch::lying] > 0.0);
    const double each = lands ? 0.0 : 1.0 / sums[Touch::lying];
    const double* at = sums + Touch::arm;
    const Vec3<double> middle = lands ? -gap(plane, fit.center) * n
                                      : Vec3<double>{each * at[0], each * at[1], each * at[2]};
    // at rest: torque about the middle is that about the mean, and that of the force there
    const Vec3<double> force = -fit.weight * fit.shift;
    const Vec3<double> torque = -axis_of(fit.covariance) - cross(middle, force);
    away = (1.0 / dot(force, n)) * cross(n, torque);
    pressure = fit.center + middle + away;
    stage = lands ? Stage::turn : Stage::seek;
    if (lands) return;
    const Mat3<double> spread =
        less_outer(each * symmetric(sums + Touch::spread), 1.0, middle, middle);
    const double least = pins_apart * pins_apart * fit.square;
    const Mat3<double> minors = cofactor(spread);
    const double across = minors.row[0].x + minors.row[1].y + minors.row[2].z;
    const double trace = spread.row[0].x + spread.row[1].y + spread.row[2].z;
    // on a point or a line nothing rests
    if (across <= least * (trace + least)) return;
    if (!(dot(away, solve(less_identity(spread, -least), away)) > resting)) stage = Stage::none;
  }

  PD_HD TippingSearch<double> search(const Plane<double>& plane) const {
    return {plane.normal, away, plane.height, reach, stage == Stage::seek ? 1.0 : 0.0};
  }

  // Goes on by what a search has found: `motion` is where the piece goes, if this is the end, or what to search with. False where
  // this is no case of tipping.
  PD_HD bool next(const RigidFit& fit, const Plane<double>& plane,
                  const double (&found)[Found::count], RigidMotion<double>& motion) {
    const bool seeks = stage == Stage::seek;
    stage = Stage::none;
    const double depth = found[Found::depth], before = found[Found::before];
    if (!(depth < HUGE_VAL)) return false;
    const Vec3<double> u = read(found + Found::way);
    const Vertex vertex = {read(found + Found::at), tangential(u, plane.normal)};
    const double allowed = (has(vertex) ? rounded_depth : touching_depth) * reach;
    if (count > 0 && depth >= -allowed) {
      const Trial trial = turn_about(fit, plane);
      motion = trial.motion;
      if (depth < 0.0) motion.shift = subtract_product(motion.shift, depth, plane.normal);
      return tips = trial.holds;
    }
    // how much further they are than what comes to lie on the plane
    const double down = count > 0 ? drop(plane) : 0.0, left = before - down;
    if (count == 0 || left < reach) {
      const bool lies = gap(plane, vertex.at) - down < reach;
      if (((seeks || count > 0) && !lies) || share < 1.0 || !take(vertex, plane.normal))
        return false;
    } else if (left > depth) {
      share *= left / (left - depth);
    } else {
      return false;
    }
    if (++round == tipping_rounds) return false;
    motion = turn_about(fit, plane).motion;
    stage = Stage::turn;
    return true;
  }

 private:
  struct Trial {
    RigidMotion<double> motion;
    bool holds;
  };

  PD_HD static Vec3<double> read(const double* a) { return {a[0], a[1], a[2]}; }

  PD_HD static Vec3<double> solve(const Mat3<double>& a, const Vec3<double>& b) {
    const Mat3<double> c = cofactor(a);
    return (1.0 / dot(a.row[0], c.row[0])) * (b * c);
  }

  PD_HD static bool same(const Vertex& a, const Vertex& b) {
    return a.at.x == b.at.x && a.at.y == b.at.y && a.at.z == b.at.z;
  }

  PD_HD bool has(const Vertex& vertex) const {
    return (count > 0 && same(on[0], vertex)) || (count > 1 && same(on[1], vertex));
  }

  // One more vertex, in place of one of two; false where that changes nothing.
  PD_COLD bool take(const Vertex& vertex, const Vec3<double>& normal) {
    if (has(vertex)) return false;
    if (count < 2) {
      on[count++] = vertex;
      return true;
    }
    const Vertex three[3] = {on[0], on[1], vertex};
    double most = 0.0;
    int left = 2;  // of those two the first
    for (int i = 0; i < 3; ++i) {
      const Vec3<double> a = three[i].at, b = three[(i + 1) % 3].at, c = three[(i + 2) % 3].at;
      const Vec3<double> across = cross(normal, b - a);
      const double side = dot(c - a, across), length = square_root(dot(across, across));
      const double beyond = (side > 0.0 ? -1.0 : 1.0) * dot(pressure - a, across) / length;
      if (side != 0.0 && beyond > most) {
        most = beyond;
        left = i;
      }
    }
    if (!(most > 0.0) || left == 0) return false;
    on[0] = three[left];
    on[1] = three[(left + 1) % 3];
    return true;
  }

  PD_HD Vec3<double> line() const {
    const Vec3<double> way = on[1].at - on[0].at;
    return (1.0 / square_root(dot(way, way))) * way;
  }

  // How far above the plane they are.
  PD_HD double drop(const Plane<double>& plane) const {
    return lesser(gap(plane, on[0].at), gap(plane, on[count - 1].at));
  }

  // Whether a torque about the first of two vertices is that of a push between them.
  PD_HD bool between(const Vec3<double>& normal, const Vec3<double>& torque, double push) const {
    if (count < 2) return true;
    const Vec3<double> way = on[1].at - on[0].at;
    const double square = dot(way, way), along = dot(cross(normal, torque), way) / push;
    return along >= -pressure_beyond * square && along <= (1.0 + pressure_beyond) * square;
  }

  PD_COLD Trial turn_about(const RigidFit& fit, const Plane<double>& plane) const {
    if (!(plane.friction > 0.0)) return sliding(fit, plane, {0, 0, 0});
    const Trial stuck = sticking(fit, plane);
    if (stuck.holds) return stuck;
    // the way that they slide, if that is known
    Vec3<double> way = {0, 0, 0};
    for (int i = 0; i < count; ++i) {
      const double length = square_root(dot(on[i].slip, on[i].slip));
      if (!(length > reach)) return stuck;
      const Vec3<double> own = (1.0 / length) * on[i].slip;
      if (i == 0) way = own;
      const Vec3<double> apart = own - way;
      if (!(dot(apart, apart) <= slips_alike * slips_alike)) return stuck;
    }
    const Trial slid = sliding(fit, plane, way);
    return slid.holds ? slid : stuck;
  }

  // About where they were before they slid.
  PD_COLD Trial sticking(const RigidFit& fit, const Plane<double>& plane) const {
    const Vec3<double> n = plane.normal;
    const Vec3<double> back = subtract_product(-on[0].slip, drop(plane), n);
    const Vec3<double> arm = on[0].at - fit.center, goal = arm + back;
    const Mat3<double> covariance = less_outer(fit.covariance, fit.weight, fit.shift - goal, arm);
    const Mat3<double> turn =
        count < 2 ? best_turn(covariance) : best_turn_about(covariance, line());
    const Mat3<double> part = part_of_turn(turn, share);
    const Vec3<double> force = fit.weight * (back - part * arm - fit.shift);
    const double push = dot(force, n);
    const Vec3<double> rub = subtract_product(force, push, n);
    const Vec3<double> apart = on[0].slip - on[count - 1].slip;
    const double most = plane.friction * push;
    const Vec3<double> torque = -axis_of(turned_covariance(covariance, turn));
    const bool holds = push > 0.0 && dot(rub, rub) <= most * most &&
                       dot(apart, apart) <= reach * reach && between(n, torque, push);
    return {{part, on[0].at, back}, holds};
  }

  // C R^T
  PD_HD static Mat3<double> turned_covariance(const Mat3<double>& c, const Mat3<double>& turn) {
    const Mat3<double> more = c * transpose(turn);
    return {{c.row[0] + more.row[0], c.row[1] + more.row[1], c.row[2] + more.row[2]}};
  }

  // Along `way`, or freely.
  PD_COLD Trial sliding(const RigidFit& fit, const Plane<double>& plane,
                        const Vec3<double>& way) const {
    const Vec3<double> n = plane.normal, arm = on[0].at - fit.center;
    const Vec3<double> along = subtract_product(n, plane.friction, way);  // of the force
    Mat3<double> turn = {};
    bool found = false;
    PD_ROLLED
    for (int step = 0; step < balance_steps && !found; ++step) {
      const Vec3<double> at = arm + turn * arm;
      const Mat3<double> product = turned_covariance(fit.covariance, turn);
      const double push = fit.weight * lift_of(fit, plane, turn * arm);
      const Vec3<double> torque = axis_of(product) + push * cross(at, along);
      const double trace = product.row[0].x + product.row[1].y + product.row[2].z;
      const Mat3<double> stiffness =
          less_identity(-1.0 * transpose(product), -trace - push * dot(at, along));
      const Mat3<double> slope = less_outer(less_outer(stiffness, push, at, along), -fit.weight,
                                            cross(at, along), cross(at, n));
      Vec3<double> size;
      if (count < 2) {
        size = solve(slope, torque);
        turn = turned(turn, small_turn(size));
      } else {
        const Vec3<double> axis = line(), roll = axis + turn * axis;
        const double rr = dot(roll, slope * roll), rn = dot(roll, slope * n);
        const double nr = dot(n, slope * roll), nn = dot(n, slope * n);
        const double r = dot(roll, torque), y = dot(n, torque), share = 1.0 / (rr * nn - rn * nr);
        size = {share * (nn * r - rn * y), share * (rr * y - nr * r), 0.0};
        turn = turned(turned(turn, small_turn(size.x * roll)), small_turn(size.y * n));
      }
      found = dot(size, size) < balanced * balanced;
    }
    const double lift = lift_of(fit, plane, turn * arm), push = fit.weight * lift;
    const Vec3<double> shift = multiply_add(lift, along, fit.shift);
    const Vec3<double> at = arm + turn * arm;
    const Vec3<double> torque =
        -axis_of(turned_covariance(fit.covariance, turn)) - push * cross(at, along);
    bool holds = found && push > 0.0 && between(n, torque, push);
    if (plane.friction > 0.0) {
      const Vec3<double> after = tangential(on[0].slip + turn * arm + shift, n);
      holds = holds && dot(after, way) > slips_onward * square_root(dot(after, after));
    }
    const Mat3<double> part = part_of_turn(turn, share);
    return {{part, fit.center, multiply_add(lift_of(fit, plane, part * arm), along, fit.shift)},
            holds};
  }

  // How far a piece goes up from its free way, so that the vertex which moves by `turn` besides comes to lie on the plane.
  PD_HD double lift_of(const RigidFit& fit, const Plane<double>& plane,
                       const Vec3<double>& turn) const {
    return -dot(plane.normal, turn + fit.shift) - drop(plane);
  }
};

// Begins where a piece touches one plane of the first, alone.
template <class PlaneAt>
PD_HD void begin_tipping(Tipping& tipping, const RigidFit& fit, unsigned touched,
                         const double (&sums)[Touch::sums], const PlaneAt& plane) {
  tipping.end();
  if (touched == 0 || touched >= Touch::others || (touched & (touched - 1)) != 0) return;
  int number = 0;
  while (touched >> number > 1) ++number;
  tipping.begin(fit, number, plane(number), sums);
}

}  // namespace pd::inline PD_TARGET
