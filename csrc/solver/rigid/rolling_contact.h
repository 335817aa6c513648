// How a piece tips or rolls on the one plane that it touches: it turns about one of its vertices, or the line through two of them.
// They stick, where friction can take back how far they slid, or slide on the way that they slid; without friction freely. Then E is
// least where torques balance: in closed form for those that stick (solver/rigid/free_motion.h), by Newton's method for those that slide.
//
// What pushes a piece must be a force that contacts have: outward, in sum within the cone of friction, and between the two vertices. As
// such forces are what the iterations converge to as well, nothing moves once they have converged; that two vertices which stick may
// not be able to share the force, where it twists, is left to the iterations. Which they are is found by turns, as in an active set
// method: first the one that lies furthest to where pressure has its centre, then the one that the turn about it takes deepest; of
// three the two remain beyond whose line that centre lies. A turn that takes other vertices into a contact goes as far as the first of
// them, and on from there by another; but those which lie on one already stay there. Before any iteration nothing has slid, friction
// acts against the way that a piece would slide, and what is out of balance will do if it lowers E.
//
// A line of more than two vertices bends, and slips along it differ in direction. What is within that is no reason to move either: a
// piece does not roll whose pressure, next to the line, is within what touches there, which one more search tells; and with friction
// that balances all but for those differences it does not slide on.
//
// All that costs a search over the vertices each time, and nothing where a piece touches nothing or rests evenly.
#pragma once
#include "solver/rigid/free_motion.h"

namespace pd::inline PD_TARGET {

constexpr int tipping_rounds = 8;  // searches for other vertices, at most
// Of how near a vertex is that lies on the plane: vertices may go so deep, and the piece is lifted by as much.
constexpr double touching_depth = 1e-3;
constexpr double rounded_depth = 0.1;  // what one of those it turns about may go for rounding
constexpr double slips_alike = 0.02;   // distance between directions of slips that count as one
// Square of how far off the centre of pressure of what rests is, by the spread of what lies there: 1/2 at the edges of three vertices, 1
// of four, and 3 of many that lie evenly. Where they crowd at one side a piece may stand with more, or pass for tipping with less.
constexpr double resting = 0.5;
constexpr double in_line = 1e-6;      // of three vertices, by how far one is off: the ends remain
constexpr double slips_onward = 0.9;  // least cosine between a slip before and after
constexpr double pressure_beyond = 1e-6;  // of a line, at its ends
constexpr double pressure_near = 1e-3;    // how far off it may be, by the spread of what lies there
// Of friction whose direction differs between two vertices, by that difference.
constexpr double friction_doubt = 2.0;
constexpr int balance_steps = 8;   // of Newton's method
constexpr double balanced = 1e-9;  // its last step
constexpr double uphill = 1e-9;    // what rounding may add to E, of that of the way that it goes

// What a search finds: the vertex of the least order; how deep it goes beyond where it is, negative, or how far it lies; its distance
// from that contact, before and once it has dropped; where it is, and its displacement.
struct Found {
  static constexpr int order = 0, depth = 1, left = 2, at = 3, way = 6, count = 9;
};

// What vertices are searched for.
template <class R>
struct TippingSearch {
  Vec3<R> normal, away;
  R height, reach, down;  // down: how far the vertices drop that it turns about
  R seeks;  // 1: the vertex on the plane that lies furthest `away`; 0: the one that stops the motion first

  // Less is more of that. Of what stops a motion: first what lies on a contact and would leave it, the deepest; then what comes to one
  // after the least share of the motion.
  PD_HD R order_of(const R& left, const R& beyond) const {
    const R one(1), two(2), three(3), deep = -beyond, scaled = beyond / reach;
    const auto lies = left < reach;
    const auto sinks = lies && deep > R(scalar_of<R>(rounded_depth)) * reach;
    const auto comes = !lies && deep > R(scalar_of<R>(touching_depth)) * reach;
    const R share = left / select(comes, left + deep, one);
    return select(comes, share - two, select(sinks, scaled - three, scaled));
  }

  PD_HD void look(const Contacts<R>& contacts, const RigidMotion<R>& motion, const Vec3<R>& y,
                  R& order, R& depth, R& left) const {
    const R none(0), far(HUGE_VAL);
    const Vec3<R> way = motion.of(y);
    order = depth = left = far;
    const auto meet = [&](const R& gap, const R& after, const R& dropped) {
      const R beyond = after - lesser(gap, none), own = order_of(dropped, beyond);
      const auto takes = own < order;
      left = select(takes, dropped, left);
      depth = select(takes, beyond, depth);
      order = select(takes, own, order);
    };
    for (int k = 0; k < contacts.plane_count; ++k) {
      const Vec3<R> n = contacts.planes[k].normal;
      const R distance = gap(contacts.planes[k], y);
      // as a difference, so that what stays where it is keeps its distance to the last bit
      meet(distance, distance + dot(n, way), subtract_product(distance, down, dot(n, normal)));
    }
    if (contacts.sphere_count > 0) {
      const R distance = contacts.least_gap(y, contacts.plane_count);
      meet(distance, contacts.least_gap(y + way, contacts.plane_count), distance);
    }
    const R lies = dot(normal, y) - height;
    const R furthest = select(lies < reach, -dot(away, y), far);
    order = select(seeks > none, furthest, order);
    depth = select(seeks > none, furthest, depth);
  }
};

// Keeps a vertex if it is more of what is searched for.
template <class W>
PD_HD void keep_found(W (&found)[Found::count], const W& order, const W& depth, const W& left,
                      const Vec3<W>& y, const Vec3<W>& u) {
  const auto takes = order < found[Found::order];
  const W own[Found::count] = {order, depth, left, y.x, y.y, y.z, u.x, u.y, u.z};
  for (int n = 0; n < Found::count; ++n) found[n] = select(takes, own[n], found[n]);
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
  enum class Stage { none, seek, probe, turn };

  struct Vertex {
    Vec3<double> at, slip;
  };

  Stage stage;
  bool tips, first;  // its motion is one of these; before any iteration
  // It turns about its vertex or line; else, sliding, about the normal alone, and sticking not at all.
  bool rolls;
  int number, count, round;   // of the plane; of vertices that it turns about; of searches
  double reach, near, share;  // of the turn
  // where pressure has its centre if nothing moves, from the middle of what lies there, and in all
  Vec3<double> away, pressure;
  Vertex on[2];

  PD_HD void end() {
    stage = Stage::none;
    tips = false;
  }
  PD_HD bool goes_on() const { return stage != Stage::none; }
  // Its motion ends where the piece comes to a contact.
  PD_HD bool comes() const { return tips && share < 1.0; }

  // `sums`: of the vertices that lie on the plane, see Touch.
  PD_HD void begin(bool first_of_step, const RigidFit& fit, int plane_number,
                   const Plane<double>& plane, const double (&sums)[Touch::sums]) {
    end();
    first = first_of_step;
    const Vec3<double> n = plane.normal;
    reach = -contact_tolerance * dot(fit.shift, n);
    if (fit.hold != Hold::none || !(reach > 0.0) || !(sums[Touch::lying] > 0.0)) return;
    number = plane_number;
    count = round = 0;
    share = 1.0;
    const double each = 1.0 / sums[Touch::lying];
    const double* at = sums + Touch::lever_arm;
    const Vec3<double> centroid = {each * at[0], each * at[1], each * at[2]};
    // at rest: torque about the middle is that about the mean, and that of the force there
    const Vec3<double> force = -fit.weight * fit.shift;
    const Vec3<double> torque = -axis_of(fit.covariance) - cross(centroid, force);
    away = (1.0 / dot(force, n)) * cross(n, torque);
    pressure = fit.center + centroid + away;
    stage = Stage::seek;
    const Mat3<double> second_moment =
        less_outer(each * symmetric(sums + Touch::second_moment), 1.0, centroid, centroid);
    const double least = pins_apart * pins_apart * fit.square;
    const Mat3<double> minors = cofactor(second_moment);
    const double across = trace(minors), size = trace(second_moment);
    near = pressure_near * square_root(size > 0.0 ? size : 0.0);
    // on a point or a line nothing rests
    if (across <= least * (size + least)) return;
    if (!(dot(away, solve(less_identity(second_moment, -least), away)) > resting))
      stage = Stage::none;
  }

  PD_HD TippingSearch<double> search(const Plane<double>& plane) const {
    if (stage == Stage::seek) return {plane.normal, away, plane.height, reach, 0.0, 1.0};
    const double down = drop(plane);
    if (stage == Stage::turn) return {plane.normal, away, plane.height, reach, down, 0.0};
    return {plane.normal, off(plane.normal), plane.height + down, touching_depth * reach, down,
            1.0};
  }

  // Goes on by what a search has found: `motion` is where the piece goes, if this is the end, or what to search with. False where
  // this is no case of tipping.
  PD_HD bool next(const RigidFit& fit, const Plane<double>& plane,
                  const double (&found)[Found::count], RigidMotion<double>& motion) {
    const bool probed = stage == Stage::probe;
    stage = Stage::none;
    motion = fit.still();
    const double depth = found[Found::depth], left = found[Found::left];
    const bool has_found = depth < HUGE_VAL;
    if (!has_found && !probed) return false;
    const Vec3<double> u = read(found + Found::way);
    const Vertex vertex = {read(found + Found::at), tangential(u, plane.normal)};
    if (probed) {
      const Vec3<double> beside = off(plane.normal);
      // in float even what it turns about may not count as touching
      rolls = !has_found || dot(vertex.at - on[0].at, beside) < dot(beside, beside);
      motion = turn_about(fit, plane).motion;
      stage = Stage::turn;
      return true;
    }
    const double allowed = (has(vertex) ? rounded_depth : touching_depth) * reach;
    if (count > 0 && depth >= -allowed) {
      const Trial trial = turn_about(fit, plane);
      motion = trial.motion;
      if (depth < 0.0) motion.shift = subtract_product(motion.shift, depth, plane.normal);
      return tips = (trial.holds && !climbs(fit, plane, motion)) ||
                    (first && trial.pushes && gain(fit, motion) < 0.0);
    }
    bool probes = false;
    if (count == 0 || left < reach) {
      const bool lies = gap(plane, vertex.at) - (count > 0 ? drop(plane) : 0.0) < reach;
      if (!lies || !take(vertex, plane.normal)) return false;
      const Vec3<double> beside = off(plane.normal);
      rolls = dot(beside, beside) > near * near;
      probes = !rolls;
    } else if (left > depth) {
      share *= left / (left - depth);
    } else {
      return false;
    }
    if (++round == tipping_rounds) return false;
    stage = probes ? Stage::probe : Stage::turn;
    if (!probes) motion = turn_about(fit, plane).motion;
    return true;
  }

 private:
  struct Trial {
    RigidMotion<double> motion;
    bool pushes, holds;  // the contact; as a contact can
  };

  PD_HD static Vec3<double> read(const double* a) { return {a[0], a[1], a[2]}; }

  PD_HD static double trace(const Mat3<double>& a) { return a.row[0].x + a.row[1].y + a.row[2].z; }

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
      const bool aligned = square_root(side * side) <= in_line * length * length;
      const double own = aligned ? length : beyond;
      if (own > most) {
        most = own;
        left = i;
      }
    }
    if (!(most > 0.0) || left == 0) return false;
    on[0] = three[left];
    on[1] = three[(left + 1) % 3];
    return true;
  }

  PD_HD Vec3<double> line() const { return direction_of(on[1].at - on[0].at); }

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
    Trial stuck = pivot(fit, plane, least_slip());
    const Vec3<double> slipped = on[0].slip - on[count - 1].slip;
    stuck.holds = stuck.holds && dot(slipped, slipped) <= reach * reach &&
                  within_friction(fit, plane, stuck.motion);
    if (stuck.holds) return stuck;
    // the way that they slide, if that is known
    Vec3<double> slips[2] = {on[0].slip, on[count - 1].slip};
    if (first && !(slides(slips[0]) && slides(slips[1]))) {
      const RigidMotion<double> free = fit.free();
      for (int i = 0; i < 2; ++i)
        slips[i] = slips[i] + tangential(free.of(on[i < count ? i : 0].at), plane.normal);
    }
    if (!slides(slips[0]) || !slides(slips[1])) return stuck;
    const Vec3<double> way = direction_of(slips[0]), differs = direction_of(slips[1]) - way;
    const double apart = square_root(dot(differs, differs));
    if (!(apart <= slips_alike)) return stuck;
    if (rubs(fit, plane, way, apart)) return pivot(fit, plane, {0, 0, 0});
    const Trial slid = sliding(fit, plane, way);
    return slid.holds ? slid : stuck;
  }

  // What a motion adds to E.
  PD_HD static double gain(const RigidFit& fit, const RigidMotion<double>& motion) {
    const Vec3<double> left = motion.of(fit.center) - fit.shift;
    const double shifted = 0.5 * fit.weight * (dot(left, left) - dot(fit.shift, fit.shift));
    return shifted - frobenius(motion.turn, fit.covariance);
  }

  // Whether a motion adds to E more than it spares friction, by more than rounding: balances of torques may lie uphill.
  PD_HD bool climbs(const RigidFit& fit, const Plane<double>& plane,
                    const RigidMotion<double>& motion) const {
    const Vec3<double> force = fit.weight * (motion.of(fit.center) - fit.shift);
    const Vec3<double> way = on[count - 1].at - on[0].at;
    const double far = dot(pressure - on[0].at, way), square = dot(way, way);
    const double within = !(far > 0.0) ? 0.0 : far < square ? far / square : 1.0;
    const double slid = (1.0 - within) * slides_on(on[0], plane, motion) +
                        within * slides_on(on[count - 1], plane, motion);
    const double rub = plane.friction * dot(force, plane.normal) * slid;
    return gain(fit, motion) + rub > uphill * fit.weight * dot(fit.shift, fit.shift);
  }

  // How much further a motion takes a vertex from where it was.
  PD_HD static double slides_on(const Vertex& vertex, const Plane<double>& plane,
                                const RigidMotion<double>& motion) {
    const Vec3<double> after = vertex.slip + tangential(motion.of(vertex.at), plane.normal);
    return square_root(dot(after, after)) - square_root(dot(vertex.slip, vertex.slip));
  }

  PD_HD bool slides(const Vec3<double>& slip) const { return dot(slip, slip) > reach * reach; }

  PD_HD static Vec3<double> direction_of(const Vec3<double>& a) {
    return (1.0 / square_root(dot(a, a))) * a;
  }

  // How far the centre of pressure, if nothing moves, is off the vertex or line that it turns about.
  PD_HD Vec3<double> off(const Vec3<double>& normal) const {
    const Vec3<double> away = pressure - on[0].at;
    if (count < 2) return away;
    const Vec3<double> across = cross(normal, line());
    return dot(across, away) * across;
  }

  // Of the slips between those of two vertices; none if they differ by as much.
  PD_HD Vec3<double> least_slip() const {
    const Vec3<double> way = on[count - 1].slip - on[0].slip;
    const double square = dot(way, way);
    const double nearest = square > 0.0 ? -dot(on[0].slip, way) / square : 0.0;
    const double within = nearest < 0.0 ? 0.0 : nearest > 1.0 ? 1.0 : nearest;
    const Vec3<double> least = multiply_add(within, way, on[0].slip);
    return dot(least, least) > square ? least : Vec3<double>{0, 0, 0};
  }

  // Whether, if nothing moves, friction balances it, but for what slips that differ leave unknown of that.
  PD_HD bool rubs(const RigidFit& fit, const Plane<double>& plane, const Vec3<double>& way,
                  double apart) const {
    const Vec3<double> n = plane.normal, force = -fit.weight * fit.shift, beside = off(n);
    const double push = dot(force, n), doubt = friction_doubt * apart * plane.friction * push;
    const Vec3<double> left =
        subtract_product(force, push, subtract_product(n, plane.friction, way));
    const double twist = dot(n, axis_of(fit.covariance) + cross(pressure - fit.center, force));
    const Vec3<double> lever_arm = on[count - 1].at - on[0].at;
    return dot(left, left) <= doubt * doubt &&
           twist * twist <= doubt * doubt * dot(lever_arm, lever_arm) &&
           dot(beside, beside) <= near * near;
  }

  // Whether the force for a motion is within the cone of friction.
  PD_HD static bool within_friction(const RigidFit& fit, const Plane<double>& plane,
                                    const RigidMotion<double>& motion) {
    const Vec3<double> force = fit.weight * (motion.of(fit.center) - fit.shift);
    const double push = dot(force, plane.normal), most = plane.friction * push;
    const Vec3<double> rub = subtract_product(force, push, plane.normal);
    return dot(rub, rub) <= most * most;
  }

  // Turns about its vertices, moved back by `slip` and down on to the plane.
  PD_COLD Trial pivot(const RigidFit& fit, const Plane<double>& plane,
                      const Vec3<double>& slip) const {
    const Vec3<double> n = plane.normal;
    const Vec3<double> back = subtract_product(-slip, drop(plane), n);
    const Vec3<double> lever_arm = on[0].at - fit.center, goal = lever_arm + back;
    const Mat3<double> covariance =
        less_outer(fit.covariance, fit.weight, fit.shift - goal, lever_arm);
    Mat3<double> turn = {};
    if (rolls) turn = count < 2 ? best_turn(covariance) : best_turn_about(covariance, line());
    const Mat3<double> part = part_of_turn(turn, share);
    const double push = fit.weight * dot(n, back - part * lever_arm - fit.shift);
    const Vec3<double> torque = -axis_of(turned_covariance(covariance, turn));
    const bool holds = push > 0.0 && between(n, torque, push);
    return {{part, on[0].at, back}, push > 0.0, holds};
  }

  // C R^T
  PD_HD static Mat3<double> turned_covariance(const Mat3<double>& c, const Mat3<double>& turn) {
    const Mat3<double> more = c * transpose(turn);
    return {{c.row[0] + more.row[0], c.row[1] + more.row[1], c.row[2] + more.row[2]}};
  }

  // Along `way`, or freely. Friction acts where the push has its centre: where that is on a line the torque is not known across both the
  // line and the force.
  PD_COLD Trial sliding(const RigidFit& fit, const Plane<double>& plane,
                        const Vec3<double>& way) const {
    const Vec3<double> n = plane.normal, lever_arm = on[0].at - fit.center;
    const Vec3<double> along = subtract_product(n, plane.friction, way);  // of the force
    Mat3<double> turn = {};
    bool found = false, done = false;
    PD_ROLLED
    for (int step = 0; step < balance_steps && !done; ++step) {
      done = found;  // the step after the last one takes what that leaves
      const Vec3<double> at = lever_arm + turn * lever_arm;
      const Mat3<double> product = turned_covariance(fit.covariance, turn);
      const double push = fit.weight * lift_of(fit, plane, turn * lever_arm);
      const Vec3<double> torque = axis_of(product) + push * cross(at, along);
      const Mat3<double> stiffness =
          less_identity(-1.0 * transpose(product), -trace(product) - push * dot(at, along));
      const Mat3<double> slope = less_outer(less_outer(stiffness, push, at, along), -fit.weight,
                                            cross(at, along), cross(at, n));
      Vec3<double> size;
      if (!rolls) {
        size = {0.0, dot(along, torque) / dot(along, slope * n), 0.0};
        turn = turned(turn, small_turn(size.y * n));
      } else if (count < 2) {
        size = solve(slope, torque);
        turn = turned(turn, small_turn(size));
      } else {
        const Vec3<double> axis = line(), roll = axis + turn * axis;
        const Vec3<double> yawed = slope * n, rolled = slope * roll;
        const double rr = dot(roll, rolled), rn = dot(roll, yawed) - dot(cross(n, roll), torque);
        const double fr = dot(along, rolled), fn = dot(along, yawed);
        const double r = dot(roll, torque), f = dot(along, torque),
                     scale = 1.0 / (rr * fn - rn * fr);
        size = {scale * (fn * r - rn * f), scale * (rr * f - fr * r), 0.0};
        turn = turned(turned(turn, small_turn(size.x * roll)), small_turn(size.y * n));
      }
      found = dot(size, size) < balanced * balanced;
    }
    const double lift = lift_of(fit, plane, turn * lever_arm), push = fit.weight * lift;
    const Vec3<double> shift = multiply_add(lift, along, fit.shift);
    const Vec3<double> at = lever_arm + turn * lever_arm;
    const Vec3<double> torque =
        -axis_of(turned_covariance(fit.covariance, turn)) - push * cross(at, along);
    bool holds = found && push > 0.0 && between(n, torque, push);
    if (plane.friction > 0.0) {
      const Vec3<double> after = tangential(on[0].slip + turn * lever_arm + shift, n);
      holds = holds && dot(after, way) > slips_onward * square_root(dot(after, after));
    }
    const Mat3<double> part = part_of_slide(turn, n);
    return {
        {part, fit.center, multiply_add(lift_of(fit, plane, part * lever_arm), along, fit.shift)},
        push > 0.0,
        holds};
  }

  // A share of how it rolls and of how it turns about the normal, so that the line of two vertices stays level.
  PD_COLD Mat3<double> part_of_slide(const Mat3<double>& turn, const Vec3<double>& n) const {
    if (share == 1.0 || count < 2) return part_of_turn(turn, share);
    const Vec3<double> axis = line(), after = axis + turn * axis;
    const Mat3<double> yaw = best_turn_about({{after.x * axis, after.y * axis, after.z * axis}}, n);
    const Mat3<double> roll = turned(turn, transpose(yaw));
    return turned(part_of_turn(roll, share), part_of_turn(yaw, share));
  }

  // How far a piece goes up from its free way, so that the vertex which moves by `turn` besides comes to lie on the plane.
  PD_HD double lift_of(const RigidFit& fit, const Plane<double>& plane,
                       const Vec3<double>& turn) const {
    return -dot(plane.normal, turn + fit.shift) - drop(plane);
  }
};

// Begins where a piece touches one plane of the first, alone.
template <class PlaneAt>
PD_HD void begin_tipping(Tipping& tipping, bool first, const RigidFit& fit, unsigned touched,
                         const double (&sums)[Touch::sums], const PlaneAt& plane) {
  tipping.end();
  if (touched == 0 || touched >= Touch::others || (touched & (touched - 1)) != 0) return;
  int number = 0;
  while (touched >> number > 1) ++number;
  tipping.begin(first, fit, number, plane(number), sums);
}

}  // namespace pd::inline PD_TARGET
