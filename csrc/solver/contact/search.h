// The search of pairs: boxes of clusters of sides, tested 32 at a time, body by body.
//
// Bodies whose boxes are apart are not asked, nor bodies with themselves whose shape keeps their
// parts apart. What comes near is kept in a list; only if that is full, boxes are tested again.
// Pairs are counted, placed by prefix sums, and lie in the order of their keys.
#pragma once
#include "solver/contact/clusters.h"
#include "solver/contact/environment.h"
#include "solver/contact/shape.h"

namespace pd::inline PD_TARGET {

template <class T>
class ContactSearch {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD explicit ContactSearch(const Env& env) : env_(env), shapes_(env.plan), boxes_(boxes(env)) {}

  PD_HD const RestShapes<T>& shapes() const { return shapes_; }

  // Once in a step, when it is known what moves by hand.
  template <class Team>
  PD_HD void begin(const Team& team) const {
    const ContactPlan<T>& plan = env_.plan;
    team.spread(cluster_size * count_all_groups(plan), [&](int n) {
      env_.a.group[n / cluster_size].set(n % cluster_size, Box<T>::none());
    });
    team.each(plan.bodies, [&](int b) { env_.a.by_hand[b] = 1; });
    team.each(plan.points, [&](int n) {
      const int v = plan.point[n];
      if (!env_.held(v)) env_.a.by_hand[plan.body[v]] = 0;
    });
  }

  // Fits boxes of the bodies that are asked, and returns whether some are: those with itself[body],
  // and, `between`, those whose boxes meet. `box_of(vertex)`, and `reach(vertex)`: by which boxes
  // of its sides are wider.
  template <class Team, class BoxOf, class Reach>
  PD_HD bool fit(const Team& team, const BoxOf& box_of, const Reach& reach, bool between) const {
    const ContactPlan<T>& plan = env_.plan;
    const ContactArrays<T>& a = env_.a;
    ContactNumbers& numbers = env_.numbers();
    const auto fit_cluster = [&](int c, const auto& lanes) {
      const Box<T> hull = boxes_.fit(lanes, c, box_of, reach);
      if (lanes.leads()) boxes_.tree_of(c).set_hull(c, hull);
      return hull;
    };
    team.each(plan.bodies, [&](int b) { a.body_box[b] = Box<T>::none(); });
    team.spread(1, [&](int) { numbers.meets = 0; });
    team.warps(between ? plan.point_clusters : 0, [&](int c, const auto& lanes) {
      const Box<T> hull = fit_cluster(c, lanes);
      if (lanes.leads()) extend(a.body_box[plan.cluster_body[c]], hull);
    });
    team.barrier();
    team.each(plan.bodies, [&](int b) {
      bool asked = a.itself[b] && !a.by_hand[b];
      for (int other = 0; between && !asked && other < plan.bodies; ++other)
        asked = other != b && !(a.by_hand[b] && a.by_hand[other]) &&
                a.body_box[b].meets(a.body_box[other]);
      a.wanted[b] = asked;
      if (asked) numbers.meets = 1;
    });
    const bool meets = numbers.meets != 0;
    if (!meets) {
      team.barrier();  // all have read
      return false;
    }
    const int fitted = between ? plan.point_clusters : 0;
    team.warps(plan.clusters - fitted, [&](int n, const auto& lanes) {
      const int c = fitted + n;
      if (a.wanted[plan.cluster_body[c]]) {
        fit_cluster(c, lanes);
      } else if (lanes.leads()) {
        boxes_.tree_of(c).set_hull(c, Box<T>::none());
      }
    });
    team.barrier();
    boxes_.edges.refit(team);
    boxes_.triangles.refit(team);
    return true;
  }

  // Calls visit(found) for what fitted boxes that meet: found.each(visit(owner, other)), and
  // found.each_closest(sides_of(owner, other), places, visit(owner, other, closest)). Owners are
  // rows of `point`, then edges; of two edges the lesser one. None shares a vertex.
  template <class Team, class Visit>
  PD_HD void each_boxed(const Team& team, const Visit& visit) const {
    team.template walk<T>(
        boxes_,
        [&](int cluster, int own, int other) {
          const bool point = boxes_.has_points(cluster), swaps = !point && other < own;
          return SidePair{(point ? 0 : env_.plan.points) + (swaps ? other : own),
                          swaps ? own : other};
        },
        visit);
  }

  PD_HD ContactPair<T> sides_of(int owner, int other) const {
    const ContactPlan<T>& plan = env_.plan;
    return owner < plan.points ? pair_of_point(plan, plan.point[owner], other)
                               : pair_of_edges(plan, owner - plan.points, other);
  }

  // Whether the pair counts.
  PD_HD bool find_pair(int owner, int other, ContactPair<T>& pair) const {
    pair = sides_of(owner, other);
    return complete(env_.plan, env_.friction, [&](int v) { return env_.held(v); }, pair);
  }

  // A list of what came near, as far as there is room; `value`: of the caller
  PD_HD void list(int owner, int other, T value) const {
    const int at = count_one(&env_.numbers().listed);
    if (at >= count_near(env_.plan)) return;
    env_.a.near_side[at] = {owner, other};
    env_.a.near_value[at] = value;
  }
  PD_HD bool is_whole() const { return env_.numbers().listed <= count_near(env_.plan); }

  // Lists the pairs that may come near while no vertex leaves its ball. A ball reaches over what
  // its vertex wants and the thickness. Where that is less than half of the room to the nearest
  // other side, it takes that: no pair more is listed. Forces are those of the list before, or of
  // the history in a `first` search.
  template <class Team>
  PD_HD void find(const Team& team, bool first) const {
    find_by(env_, team, first);
  }

 private:
  // Arguments by value: what has its address taken is kept in memory by all callers.
  template <class Team>
  PD_CALLED static void find_by(Env env, Team team, bool first) {
    ContactSearch(env).list_pairs(team, first);
  }

  template <class Team>
  PD_HD void list_pairs(const Team& team, bool first) const {
    const ContactPlan<T>& plan = env_.plan;
    const ContactArrays<T>& a = env_.a;
    ContactNumbers& numbers = env_.numbers();
    const int before = first ? 0 : numbers.pairs;
    team.spread(before, [&](int p) {
      a.known_key[p] = a.pair[p].key;
      a.known_force[p] = a.pair[p].force;
    });
    team.spread(plan.vertices, [&](int v) { a.room[v] = T(HUGE_VAL), a.cursor[v] = 0; });
    team.spread(env_.owners(), [&](int n) { a.owner_near[n] = 0, a.owner_start[n] = 0; });
    team.spread(1, [&](int) { numbers.listed = 0; });
    plan_balls(team);
    const auto most = [&](int v) { return a.ball_most[plan.body[v]]; };
    const bool meets = fit(
        team, [&](int v) { return Box<T>{a.place[v], a.place[v]}; },
        [&](int v) { return most(v) + T(0.5) * plan.thickness; }, true);
    if (meets) {
      each_near(team, most, [&](int owner, int other, T distance) {
        for (int v : sides_of(owner, other).vertex) lower(a.room + v, distance);
        list(owner, other, distance);
      });
    }
    team.each(plan.vertices, [&](int v) {
      const bool held = env_.held(v);
      const T wanted = wanted_reach(v),
              roomy = held ? T(0) : T(ball_room) * (a.room[v] - plan.thickness),
              larger = wanted < roomy ? roomy : wanted, bound = most(v);
      a.ball[v].center = a.place[v];
      // inside bodies nothing meets
      a.ball[v].radius = a.surface[v] ? (bound < larger ? bound : larger) : T(HUGE_VAL);
    });
    const auto radius = [&](int v) { return a.ball[v].radius; };
    const int listed = meets ? numbers.listed : 0;
    const bool whole = is_whole();
    const auto each_listed = [&](const auto& visit) {
      if (!whole) return each_near(team, radius, visit);
      team.each(listed, [&](int n) {
        const SidePair of = a.near_side[n];
        ContactPair<T> pair = sides_of(of.owner, of.other);
        pair.near.distance = a.near_value[n];
        if (pair.is_within(radius, plan.thickness)) visit(of.owner, of.other, T(0));
      });
    };
    int found = 0;
    if (listed > 0) {
      each_listed([&](int owner, int, T) { count_one(a.owner_start + owner); });
      team.scan(a.owner_start, env_.owners());
      found = a.owner_start[env_.owners()];
    }
    const int count = found > plan.capacity ? 0 : found;
    team.once([&] {
      numbers.pairs = count;
      numbers.most_pairs = found > numbers.most_pairs ? found : numbers.most_pairs;
      ++numbers.searches;
    });
    if (count > 0) {
      each_listed([&](int owner, int other, T) {
        const int at = a.owner_start[owner] + count_one(a.owner_near + owner);
        a.partner[at] = other;
        a.owner[at] = owner;
      });
      team.each(env_.owners(), [&](int n) {
        int* const partner = a.partner + a.owner_start[n];
        const int own = a.owner_start[n + 1] - a.owner_start[n];
        for (int k = 1; k < own; ++k) place_in_order(partner, k, partner[k]);
      });
    }
    team.each(count, [&](int p) { find_pair(a.owner[p], a.partner[p], a.pair[p]); });
    team.each_closest(
        count, [&](int p) -> const auto& { return a.pair[p]; }, a.place,
        [&](int p, const Closest<T>& near) {
          ContactPair<T>& pair = a.pair[p];
          pair.near = near;
          make_plane(pair, a.place, a.target, pair.near, Vec3<T>{});
          pair.normal = pair.normal_at(pair.near);
          pair.force = force_of(pair.key, first, before);
          pair.force.tangential = tangential(pair.force.tangential, pair.normal);
          for (int v : pair.vertex) count_one(a.cursor + v);
        });
    index(team, count);
  }

  PD_HD static ClusterBoxes<T> boxes(const Env& env) {
    const ContactPlan<T>& plan = env.plan;
    const ContactArrays<T>& a = env.a;
    const int points = plan.point_clusters, edges = plan.edge_clusters;
    Cluster<T>*const of_edges = a.group + count_groups(points), *const of_triangles =
                                                                    of_edges + count_groups(edges);
    return {plan.leaves,
            plan.cluster_body,
            a.cluster,
            {a.group, 0, points},
            {of_edges, points, edges},
            {of_triangles, points + edges, plan.clusters - points - edges},
            a.itself,
            a.wanted,
            a.by_hand};
  }

  PD_HD static void extend(Box<T>& box, const Box<T>& by) {
    lower(&box.low.x, by.low.x), lower(&box.low.y, by.low.y), lower(&box.low.z, by.low.z);
    raise(&box.high.x, by.high.x), raise(&box.high.y, by.high.y), raise(&box.high.z, by.high.z);
  }

  // What a vertex wants to reach, with a margin.
  PD_HD T wanted_reach(int v) const {
    const Vec3<T> way = env_.a.target[v] - env_.a.place[v];
    return multiply_add(T(ball_reach), square_root(dot(way, way)),
                        env_.held(v) ? T(0) : env_.plan.thickness);
  }

  // The largest balls of every body. If they may be so small that its own parts cannot meet, these
  // are not asked.
  template <class Team>
  PD_HD void plan_balls(const Team& team) const {
    const ContactPlan<T>& plan = env_.plan;
    const ContactArrays<T>& a = env_.a;
    team.groups(plan.bodies, [&](int b, const auto& group) {
      const int begin = plan.surface_start[b], end = plan.surface_start[b + 1];
      T most = begin < end ? T(ball_cells) * plan.cell[plan.point[begin]] : T(0);
      bool itself = plan.touches_itself[b] != 0;
      if (itself && !a.by_hand[b] && plan.rest_apart[b] > T(0)) {
        double least[1] = {0};
        group.least_range(
            begin, end,
            [&](int n, double (&low)[1]) {
              const double own = -double(wanted_reach(plan.point[n]));
              low[0] = own < low[0] ? own : low[0];
            },
            least);
        const T wanted = T(-least[0]), needed = wanted < most ? wanted : most,
                room = T(0.5) *
                       (shapes_.apart(group, b, a.place) - T(1.0 + slack_share) * plan.thickness);
        if (room >= needed) {
          itself = false;
          most = room < most ? room : most;
        }
      }
      if (group.leads()) a.itself[b] = itself, a.ball_most[b] = most;
    });
  }

  // Calls visit(owner, other, distance) for pairs that count within reach of balls.
  template <class Team, class Radius, class Visit>
  PD_HD void each_near(const Team& team, const Radius& radius, const Visit& visit) const {
    each_boxed(team, [&](const auto& found) {
      found.each_closest(
          [&](int owner, int other) { return sides_of(owner, other); }, env_.a.place,
          [&](int owner, int other, const Closest<T>& near) {
            ContactPair<T> pair = sides_of(owner, other);
            pair.near.distance = near.distance;
            if (pair.is_within(radius, env_.plan.thickness) && find_pair(owner, other, pair))
              visit(owner, other, near.distance);
          });
    });
  }

  // Inserts a number among `count` increasing ones.
  PD_HD static void place_in_order(int* numbers, int count, int number) {
    int at = count;
    for (; at > 0 && numbers[at - 1] > number; --at) numbers[at] = numbers[at - 1];
    numbers[at] = number;
  }

  PD_HD Multiplier<T> force_of(std::int64_t key, bool first, int known) const {
    const ContactArrays<T>& a = env_.a;
    const std::int64_t* const keys = first ? env_.history_key : a.known_key;
    const int count = first ? env_.numbers().known : known;
    const std::int64_t at = find_sorted(keys, count, key);
    if (at >= count || keys[at] != key) return {};
    if (!first) return a.known_force[at];
    const T* f = env_.history_force + 4 * at;
    return {f[0], {f[1], f[2], f[3]}};
  }

  // Entries of every vertex in the order of the pairs: each finds its place among those of its
  // vertex. `cursor`: their numbers
  template <class Team>
  PD_HD void index(const Team& team, int count) const {
    const ContactArrays<T>& a = env_.a;
    const int vertices = env_.plan.vertices;
    team.each(vertices, [&](int v) { a.start[v] = a.cursor[v], a.cursor[v] = 0; });
    team.scan(a.start, vertices);
    team.each(4 * std::int64_t(count), [&](int e) {
      const int v = a.pair[e / 4].vertex[e % 4];
      a.entry[a.start[v] + count_one(a.cursor + v)] = e;
    });
    team.each(4 * std::int64_t(count), [&](int e) {
      const int v = a.pair[e / 4].vertex[e % 4], begin = a.start[v];
      int rank = 0;
      for (int n = begin; n < a.start[v + 1]; ++n) rank += a.entry[n] < e;
      a.slot[e] = begin + rank;
      a.corner[begin + rank] = e;
    });
    team.each(count, [&](int p) { env_.keep_spaces(p); });
  }

  const Env& env_;
  const RestShapes<T> shapes_;
  const ClusterBoxes<T> boxes_;
};

}  // namespace pd::inline PD_TARGET
