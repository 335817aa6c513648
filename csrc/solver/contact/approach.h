// The start of a step: whole bodies move first, each by a common share of its way.
//
// A body takes the straight way of its velocities, if its parts stay apart all along. Else a body
// without pins takes its rigid motion, an affine map that folds nothing. Colliders take their
// screws. First, bodies that may meet go together by one share, so that what moves alike does not
// hinder itself. Then each goes on alone, by the share that planes allow.
//
// Pairs are not stored: each lowers the shares of its bodies to what it allows. A share is then
// tried by all pairs again, until none lowers it.
#pragma once
#include "solver/contact/search.h"

namespace pd::inline PD_TARGET {

constexpr int share_rounds = 8;  // of trials; what still fails stays where it is

// The largest share in [0, limit] that is allowed.
template <class T, class Allowed>
PD_HD T share_below(T limit, const Allowed& allowed) {
  if (allowed(limit)) return limit;
  T least(0), most(1);
  for (int n = 0; n < share_halvings; ++n) {
    const T middle = T(0.5) * (least + most);
    (middle < limit && allowed(middle) ? least : most) = middle;
  }
  return least;
}

template <class T>
class ContactApproach {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD ContactApproach(const Env& env, const ContactSearch<T>& search)
      : env_(env), plan_(env.plan), a_(env.a), search_(search) {}

  // Moves the places toward the targets.
  template <class Team>
  PD_HD void move(const Team& team) const {
    find_rigid_ways(team);
    find_unfolded(team);
    team.spread(plan_.vertices, [&](int v) {
      a_.shift[v] = a_.place[v];
      if (v >= plan_.body_vertices) {
        a_.end[v] = a_.goal[v];
        return;
      }
      const int b = plan_.body[v];
      const Vec3<T> place = a_.place[v];
      way()[v] = a_.own[b]      ? a_.target[v] - place
                 : a_.pinned[b] ? Vec3<T>{T(0), T(0), T(0)}
                                : narrow(a_.rigid[b].at(wide(place)));
      a_.end[v] = a_.own[b] ? a_.target[v] : place + way()[v];
    });
    team.each(plan_.colliders,
              [&](int c) { a_.screw[c] = Screw<T>(a_.hand[c].pose, a_.hand[c].goal); });
    go_together(team);
    team.each(plan_.vertices, [&](int v) { a_.place[v] = at(v, a_.together[plan_.body[v]]); });
    go_alone(team);
    team.each(plan_.bodies, [&](int b) {
      a_.together[b] = a_.together[b] + a_.alone[b] * (T(1) - a_.together[b]);
    });
    team.spread(plan_.vertices, [&](int v) { a_.place[v] = at(v, a_.together[plan_.body[v]]); });
    team.each(plan_.colliders, [&](int c) {
      Hand<T>& hand = a_.hand[c];
      hand.pose = a_.screw[c].at(a_.together[plan_.body[hand.begin]]);
    });
  }

  PD_HD bool was_stopped(int body) const { return a_.together[body] < T(1); }

 private:
  PD_HD static Vec3<double> wide(const Vec3<T>& a) {
    return {double(a.x), double(a.y), double(a.z)};
  }
  PD_HD static Vec3<T> narrow(const Vec3<double>& a) { return {T(a.x), T(a.y), T(a.z)}; }
  PD_HD static int min_of(int a, int b) { return a < b ? a : b; }
  PD_HD static void add_to(double* sum, const Vec3<double>& a) {
    sum[0] = a.x, sum[1] = a.y, sum[2] = a.z;
  }

  template <class Team>
  PD_HD void find_rigid_ways(const Team& team) const {
    team.each(plan_.bodies, [&](int b) { a_.pinned[b] = 0; });
    team.each(plan_.body_vertices, [&](int v) {
      if (env_.held(v)) a_.pinned[plan_.body[v]] = 1;
    });
    team.groups(plan_.bodies, [&](int b, const auto& group) {
      const int begin = plan_.body_start[b],
                end = min_of(plan_.body_start[b + 1], plan_.body_vertices);
      double sums[7] = {};
      group.sum_range(
          begin, end,
          [&](int v, double (&sum)[7]) {
            const double m = double(env_.body.mass[v]);
            const Vec3<double> way = wide(a_.target[v]) - wide(a_.place[v]);
            sum[0] += m;
            add_to(sum + 1,
                   multiply_add(m, wide(a_.place[v]), Vec3<double>{sum[1], sum[2], sum[3]}));
            add_to(sum + 4, multiply_add(m, way, Vec3<double>{sum[4], sum[5], sum[6]}));
          },
          sums);
      const double share = sums[0] > 0 ? 1 / sums[0] : 0;
      RigidWay rigid;
      rigid.mass = sums[0];
      rigid.center = share * Vec3<double>{sums[1], sums[2], sums[3]};
      rigid.mean = share * Vec3<double>{sums[4], sums[5], sums[6]};
      double turns[12] = {};
      group.sum_range(
          begin, end,
          [&](int v, double (&sum)[12]) {
            const Vec3<double> way = wide(a_.target[v]) - wide(a_.place[v]);
            Mat3<double> moment = {
                {{sum[0], sum[1], sum[2]}, {sum[3], sum[4], sum[5]}, {sum[6], sum[7], sum[8]}}};
            Vec3<double> momentum = {sum[9], sum[10], sum[11]};
            add_moment(double(env_.body.mass[v]), wide(a_.place[v]) - rigid.center, way, moment,
                       momentum);
            for (int r = 0; r < 3; ++r) add_to(sum + 3 * r, moment.row[r]);
            add_to(sum + 9, momentum);
          },
          turns);
      if (!group.leads()) return;
      if (rigid.mass > 0)
        rigid.turn = turn_of({{{turns[0], turns[1], turns[2]},
                               {turns[3], turns[4], turns[5]},
                               {turns[6], turns[7], turns[8]}}},
                             {turns[9], turns[10], turns[11]});
      a_.rigid[b] = rigid;
      a_.own[b] = rigid.mass > 0;
    });
  }

  // Bodies whose parts stay apart along their ways. A rigid motion shortens no distance, so only
  // pairs within reach of the rest of the ways can meet.
  template <class Team>
  PD_HD void find_unfolded(const Team& team) const {
    team.each(plan_.vertices, [&](int v) {
      a_.weight[v] = T(0);
      if (v >= plan_.body_vertices) return;
      const Vec3<T> place = a_.place[v],
                    rest = a_.target[v] - place - narrow(a_.rigid[plan_.body[v]].at(wide(place)));
      a_.weight[v] = square_root(dot(rest, rest));
    });
    team.groups(plan_.bodies, [&](int b, const auto& group) {
      bool asked = a_.own[b] && plan_.touches_itself[b];
      if (asked && plan_.rest_apart[b] > T(0)) {
        double most[1] = {0};
        group.least_range(
            plan_.surface_start[b], plan_.surface_start[b + 1],
            [&](int n, double (&low)[1]) {
              const double own = -double(a_.weight[plan_.point[n]]);
              low[0] = own < low[0] ? own : low[0];
            },
            most);
        const T room =
            search_.shapes().apart(group, b, a_.place) - T(1.0 + slack_share) * plan_.thickness;
        asked = !(T(-2) * T(most[0]) <= room);
      }
      if (group.leads()) a_.itself[b] = asked;
    });
    const bool asks = search_.fit(
        team, [&](int v) { return Box<T>{a_.place[v], a_.place[v]}; },
        [&](int v) { return a_.weight[v] + T(0.5) * plan_.thickness; }, false);
    if (asks)
      search_.each_boxed(team, [&](const auto& found) {
        found.each([&](int owner, int other) { unfold(owner, other); });
      });
    // between bodies alone from now on
    team.each(plan_.bodies, [&](int b) { a_.itself[b] = 0; });
  }

  PD_CALLED void unfold(int owner, int other) const {
    ContactPair<T> pair;
    const int b = plan_.body[search_.sides_of(owner, other).vertex[0]];
    if (!a_.own[b] || !search_.find_pair(owner, other, pair)) return;
    Vec3<T> start[4], end[4];
    pair.corners(a_.place, start);
    pair.corners(a_.target, end);
    const auto own_reach = [&](int v) { return a_.weight[v]; };
    if (!stays_apart(pair, start, end, own_reach, plan_.thickness)) a_.own[b] = 0;
  }

  // of vertices of bodies, from `shift`, where the step began; checks come later
  PD_HD Vec3<T>* way() const { return a_.checked; }

  // The place after a share of the way.
  PD_HD Vec3<T> at(int v, T share) const {
    if (v >= plan_.body_vertices)
      return a_.screw[plan_.collider[v]].at(share).place(local_point(plan_, v));
    if (a_.own[plan_.body[v]] && share >= T(1)) return a_.end[v];
    return share > T(0) ? multiply_add(share, way()[v], a_.shift[v]) : a_.shift[v];
  }

  PD_HD Box<T> swept(int v) const {
    Box<T> box{a_.place[v], a_.place[v]};
    box.add(a_.end[v]);
    return box;
  }
  PD_HD T bow(int v) const {
    // a helix leaves the box of its ends by half a chord at most
    const Vec3<T> chord = a_.end[v] - a_.place[v];
    const T side = v < plan_.body_vertices ? T(0) : T(0.5) * square_root(dot(chord, chord));
    return side + T(0.5) * plan_.thickness;
  }

  // Calls visit(owner, other, last) for pairs of different bodies that may meet on the way from the
  // places to the ends, round after round, while it lowers shares. Bodies of a group have one share,
  // `limit` at the start of a round.
  template <class Team, class Visit>
  PD_HD void each_between(const Team& team, T* shares, const Visit& visit) const {
    ContactNumbers& numbers = env_.numbers();
    const bool meets =
        search_.fit(team, [&](int v) { return swept(v); }, [&](int v) { return bow(v); }, true);
    if (meets) {
      team.once([&] { numbers.listed = 0; });
      search_.each_boxed(team, [&](const auto& found) {
        found.each([&](int owner, int other) { search_.list(owner, other, T(0)); });
      });
      const bool whole = search_.is_whole();
      const int listed = numbers.listed;
      for (int round = 0; round < share_rounds; ++round) {
        const bool last = round + 1 == share_rounds;
        set_limits(team, shares);
        if (whole) {
          team.each(listed,
                    [&](int n) { visit(a_.near_side[n].owner, a_.near_side[n].other, last); });
        } else {
          search_.each_boxed(team, [&](const auto& found) {
            found.each([&](int owner, int other) { visit(owner, other, last); });
          });
        }
        const bool changed = numbers.changed != 0;
        team.barrier();
        if (!changed) break;
      }
    }
    set_limits(team, shares);
    team.each(plan_.bodies, [&](int b) { shares[b] = a_.limit[b]; });
  }

  template <class Team>
  PD_HD void set_limits(const Team& team, const T* shares) const {
    team.spread(1, [&](int) { env_.numbers().changed = 0; });
    team.each(plan_.bodies, [&](int b) { a_.joint[b] = T(1); });
    team.each(plan_.bodies, [&](int b) { lower(a_.joint + root_of(a_.joined, b), shares[b]); });
    team.each(plan_.bodies, [&](int b) { a_.limit[b] = a_.joint[root_of(a_.joined, b)]; });
  }

  // Lowers the share of a body; in the `last` round to 0.
  PD_HD void take(T* shares, int body, T limit, T share, bool last) const {
    if (!(share < limit)) return;
    env_.numbers().changed = 1;
    lower(shares + body, last ? T(0) : share);
  }

  // The same by planes and spheres of the scene, for rigid motions of bodies that `wants(body)`.
  template <class Team, class Wants, class At>
  PD_HD void lower_by_walls(const Team& team, T* shares, const Wants& wants, const At& at) const {
    if (!env_.walls.exist()) return;
    const Ball<T> anywhere{{T(0), T(0), T(0)}, T(HUGE_VAL)};
    team.each(plan_.body_vertices, [&](int v) {
      const int b = plan_.body[v];
      if (a_.own[b] || !wants(b)) return;
      const T one = place_rounding(a_.place[v]), other = place_rounding(a_.end[v]),
              margin = one < other ? other : one;
      const T share = largest_share<T>([&](T s) {
        return is_allowed(at(v, s), anywhere, [&](const auto& visit) {
          env_.each_wall(v, a_.place[v],
                         [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
        });
      });
      lower(shares + b, share);
    });
  }

  template <class Team>
  PD_HD void go_together(const Team& team) const {
    team.each(plan_.bodies, [&](int b) {
      a_.moves[b] = 0, a_.joined[b] = b;
      a_.together[b] = a_.alone[b] = T(1);
    });
    team.each(plan_.vertices, [&](int v) {
      const Vec3<T> way = a_.end[v] - a_.place[v];
      if (way.x != T(0) || way.y != T(0) || way.z != T(0)) a_.moves[plan_.body[v]] = 1;
    });
    lower_by_walls(
        team, a_.together, [&](int b) { return a_.moves[b] != 0; },
        [&](int v, T s) { return at(v, s); });
    each_between(team, a_.together,
                 [&](int owner, int other, bool last) { lower_together(owner, other, last); });
  }

  // Lowers the common shares of the bodies of a pair to what it allows.
  PD_CALLED void lower_together(int owner, int other, bool last) const {
    ContactPair<T> pair;
    if (!search_.find_pair(owner, other, pair)) return;
    const int bodies[2] = {plan_.body[pair.vertex[0]], plan_.body[pair.vertex[3]]};
    const bool moves[2] = {a_.moves[bodies[0]] != 0, a_.moves[bodies[1]] != 0};
    if (!moves[0] && !moves[1]) return;
    if (moves[0] && moves[1]) join(a_.joined, bodies[0], bodies[1]);
    Vec3<T> start[4], end[4];
    pair.corners(a_.place, start);
    pair.corners(a_.end, end);
    const Kept<T> kept = direction_of(pair, start, end);
    T limit(1);
    for (int side = 0; side < 2; ++side)
      limit = moves[side] ? lesser(limit, a_.limit[bodies[side]]) : limit;
    const T share = share_below(limit, [&](T s) {
      Vec3<T> corner[4];
      for (int c = 0; c < 4; ++c) {
        const int v = pair.vertex[c];
        corner[c] = a_.moves[plan_.body[v]] ? at(v, s) : a_.shift[v];
      }
      return kept.allows(pair.edges, corner);
    });
    for (int side = 0; side < 2; ++side)
      if (moves[side]) take(a_.together, bodies[side], limit, share, last);
  }

  template <class Team>
  PD_HD void go_alone(const Team& team) const {
    ContactNumbers& numbers = env_.numbers();
    team.once([&] { numbers.changed = 0; });
    team.each(plan_.bodies, [&](int b) {
      a_.joined[b] = b;
      if (has_rest(b)) numbers.changed = 1;
    });
    const bool rests = numbers.changed != 0;
    team.barrier();
    if (!rests) return;
    lower_by_walls(
        team, a_.alone, [&](int b) { return has_rest(b); },
        [&](int v, T s) { return after(v, s); });
    each_between(team, a_.alone,
                 [&](int owner, int other, bool last) { lower_alone(owner, other, last); });
  }

  PD_HD bool has_rest(int b) const { return T(1) - a_.together[b] > T(0); }
  // The place after a share of the rest of the way.
  PD_HD Vec3<T> after(int v, T s) const {
    const T done = a_.together[plan_.body[v]];
    return at(v, done + s * (T(1) - done));
  }

  // Lowers the shares of the bodies of a pair to what its plane allows.
  PD_CALLED void lower_alone(int owner, int other, bool last) const {
    ContactPair<T> pair = search_.sides_of(owner, other);
    if (!has_rest(plan_.body[pair.vertex[0]]) && !has_rest(plan_.body[pair.vertex[3]])) return;
    if (!search_.find_pair(owner, other, pair)) return;
    const Ball<T> anywhere{{T(0), T(0), T(0)}, T(HUGE_VAL)};
    Vec3<T> corner[4];
    pair.corners(a_.place, corner);
    make_plane(pair, a_.place, a_.end, closest_points(pair.edges, corner), Vec3<T>{});
    for (int c = 0; c < 4; ++c) {
      const int v = pair.vertex[c], b = plan_.body[v];
      if (!has_rest(b)) continue;
      const T limit = a_.limit[b];
      const T share = pair.plane.frozen ? T(0) : share_below(limit, [&](T s) {
        return is_allowed(after(v, s), anywhere,
                          [&](const auto& visit) { visit_space(pair.plane, pair.on_a(c), visit); });
      });
      take(a_.alone, b, limit, share, last);
    }
  }

  const Env& env_;
  const ContactPlan<T>& plan_;
  const ContactArrays<T>& a_;
  const ContactSearch<T>& search_;
};

}  // namespace pd::inline PD_TARGET
