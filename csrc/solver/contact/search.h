// The search of pairs: static trees of boxes with 32 children a node, made anew from their leaves.
// A thread takes the parts of a surface that may be first in a pair. Pairs are counted, placed by
// prefix sums, and lie in the order of their keys.
#pragma once
#include "solver/contact/environment.h"

namespace pd::inline PD_TARGET {

template <class T>
struct TreeOfBoxes {
  const int* order;  // leaves
  Box<T>* box;
  int count;

  PD_HD int nodes(int level) const { return ((count - 1) >> (5 * level)) + 1; }

  // boxes of a level from those below
  template <class Team>
  PD_HD void refit(const Team& team) const {
    int below = 0;
    for (int n = count; n > 1;) {
      const int nodes = (n + tree_fan - 1) / tree_fan, own = below + n;
      team.each(nodes, [&](int node) {
        Box<T> sum = Box<T>::none();
        const int end = (node + 1) * tree_fan < n ? (node + 1) * tree_fan : n;
        for (int child = node * tree_fan; child < end; ++child) sum.add(box[below + child]);
        box[own + node] = sum;
      });
      below = own;
      n = nodes;
    }
  }
};

// A part of a surface on its way through a tree, node by node.
template <class T>
struct TreeWalk {
  const ContactPlan<T>& plan;
  const TreeOfBoxes<T>* tree;
  Box<T> box;
  int owner, least;  // numbers of other parts must be larger
  int vertex[2];     // of the part
  int top, level, first, n;
  bool ended;

  // Tests the next node; returns the number of a leaf whose box meets that of the part, or -1.
  PD_HD int step() {
    if (tree->box[first + n].meets(box)) {
      if (level > 0) {
        --level;
        first -= tree->nodes(level);
        n *= tree_fan;
        return -1;
      }
      const int other = tree->order[n];
      advance();
      return other > least && is_apart(other) ? other : -1;
    }
    advance();
    return -1;
  }

 private:
  PD_HD void advance() {
    ++n;
    while (level < top && (n % tree_fan == 0 || n >= tree->nodes(level))) {
      n = (n - 1) / tree_fan + 1;
      first += tree->nodes(level);
      ++level;
    }
    ended = level == top && n >= 1;
  }
  // Whether the other part has no vertex of this one.
  PD_HD bool is_apart(int other) const {
    const bool point = owner < plan.points;
    const int count = point ? 3 : 2;
    const int* of = point ? plan.triangle + 3 * other : plan.edge + 2 * other;
    bool apart = true;
    for (int c = 0; c < count; ++c) apart = apart && of[c] != vertex[0] && of[c] != vertex[1];
    return apart;
  }
};

template <class T>
class ContactSearch {
 public:
  using Env = ContactEnvironment<T>;

  PD_HD explicit ContactSearch(const Env& env)
      : env_(env),
        triangles_{env.plan.triangle_order, env.a.triangle_box, env.plan.triangles},
        edges_{env.plan.edge_order, env.a.edge_box, env.plan.edges} {}

  // Boxes of all parts. `box_of(vertex)`, and `reach(vertex)`: by which boxes of its parts are wider.
  template <class Team, class BoxOf, class Reach>
  PD_HD void refit(const Team& team, const BoxOf& box_of, const Reach& reach) const {
    const ContactPlan<T>& plan = env_.plan;
    team.spread(plan.triangles, [&](int i) {
      triangles_.box[i] = side(plan.triangle + 3 * triangles_.order[i], 3, box_of, reach);
    });
    team.each(plan.edges, [&](int i) {
      edges_.box[i] = side(plan.edge + 2 * edges_.order[i], 2, box_of, reach);
    });
    triangles_.refit(team);
    edges_.refit(team);
  }

  // Calls visit(owner, other, pair) for every pair that counts and whose boxes meet, of the owners that `wants(owner)`.
  template <class Team, class BoxOf, class Reach, class Wants, class Visit>
  PD_HD void each_boxed(const Team& team, const BoxOf& box_of, const Reach& reach,
                        const Wants& wants, const Visit& visit) const {
    const ContactPlan<T>& plan = env_.plan;
    team.walk(
        env_.owners(),
        [&](int item) {
          const bool point = item < plan.points;
          const int own = point ? plan.point_order[item] : plan.edge_order[item - plan.points];
          const int* const vertex = point ? plan.point + own : plan.edge + 2 * own;
          const TreeOfBoxes<T>& tree = point ? triangles_ : edges_;
          TreeWalk<T> walk{plan,
                           &tree,
                           {},
                           point ? own : plan.points + own,
                           point ? -1 : own,
                           {vertex[0], vertex[point ? 0 : 1]},
                           0,
                           0,
                           0,
                           0,
                           false};
          walk.ended = tree.count == 0 || !wants(walk.owner);
          if (walk.ended) return walk;
          walk.box = side(vertex, point ? 1 : 2, box_of, reach);
          for (; tree.nodes(walk.top) > 1; ++walk.top) walk.first += tree.nodes(walk.top);
          walk.level = walk.top;
          return walk;
        },
        [&](int owner, int other) {
          ContactPair<T> pair = pair_of(owner, other);
          if (complete(plan, [&](int v) { return env_.held(v); }, pair)) visit(owner, other, pair);
        });
  }

  PD_HD ContactPair<T> pair_of(int owner, int other) const {
    const ContactPlan<T>& plan = env_.plan;
    return owner < plan.points ? pair_of_point(plan, plan.point[owner], other)
                               : pair_of_edges(plan, owner - plan.points, other);
  }

  // Lists the pairs that may come near while no vertex leaves its ball. A ball reaches over what
  // its vertex wants and the thickness. Where that is less than half of the room to the nearest
  // other side, it takes that: no pair more is listed. Forces are those of the list before, or of
  // the history in a `first` search.
  template <class Team>
  PD_HD void find(const Team& team, bool first) const {
    const ContactPlan<T>& plan = env_.plan;
    const ContactArrays<T>& a = env_.a;
    ContactNumbers& numbers = env_.numbers();
    const auto most = [&](int v) { return T(ball_cells) * plan.cell[v]; };
    const auto box_of = [&](int v) { return Box<T>{a.place[v], a.place[v]}; };
    const auto reach = [&](int v) { return most(v) + T(0.5) * plan.thickness; };
    const int before = first ? 0 : numbers.pairs;
    team.spread(before, [&](int p) {
      a.known_key[p] = a.pair[p].key;
      a.known_force[p] = a.pair[p].force;
    });
    team.spread(plan.vertices, [&](int v) { a.room[v] = T(HUGE_VAL), a.cursor[v] = 0; });
    team.spread(env_.owners(), [&](int n) { a.owner_near[n] = 0, a.owner_start[n] = 0; });
    team.spread(1, [&](int) { numbers.near = numbers.stuck = 0; });
    refit(team, box_of, reach);
    each_boxed(
        team, box_of, reach, [](int) { return true; },
        [&](int owner, int, ContactPair<T>& pair) {
          measure(pair);
          if (!pair.is_within(most, plan.thickness)) return;
          for (int v : pair.vertex) lower(a.room + v, pair.near.distance);
          a.owner_near[owner] = numbers.near = 1;
        });
    team.each(plan.vertices, [&](int v) {
      const Vec3<T> way = a.target[v] - a.place[v];
      const bool held = env_.held(v);
      const T wanted = T(ball_reach) * square_root(dot(way, way)) + (held ? T(0) : plan.thickness),
              roomy = held ? T(0) : T(ball_room) * (a.room[v] - plan.thickness),
              larger = wanted < roomy ? roomy : wanted, bound = most(v);
      a.ball[v].center = a.place[v];
      // inside bodies nothing meets
      a.ball[v].radius = a.surface[v] ? (bound < larger ? bound : larger) : T(HUGE_VAL);
    });
    const auto radius = [&](int v) { return a.ball[v].radius; };
    const auto each_listed = [&](const auto& wants, const auto& visit) {
      each_boxed(team, box_of, reach, wants, [&](int owner, int other, ContactPair<T>& pair) {
        measure(pair);
        if (pair.is_within(radius, plan.thickness)) visit(owner, other);
      });
    };
    int found = 0;
    if (numbers.near) {
      each_listed([&](int owner) { return a.owner_near[owner] != 0; },
                  [&](int owner, int) { count_one(a.owner_start + owner); });
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
      team.each(env_.owners(), [&](int n) { a.owner_near[n] = 0; });
      each_listed([&](int owner) { return a.owner_start[owner] < a.owner_start[owner + 1]; },
                  [&](int owner, int other) {
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
    team.each(count, [&](int p) {
      ContactPair<T>& pair = a.pair[p];
      pair = pair_of(a.owner[p], a.partner[p]);
      complete(plan, [&](int v) { return env_.held(v); }, pair);
      measure(pair);
      make_plane(pair, a.place, a.target, pair.near, Vec3<T>{});
      pair.normal = pair.normal_at(pair.near);
      pair.force = force_of(pair.key, first, before);
      pair.force.tangential = tangential(pair.force.tangential, pair.normal);
      for (int v : pair.vertex) count_one(a.cursor + v);
    });
    index(team, count);
  }

 private:
  template <class BoxOf, class Reach>
  PD_HD static Box<T> side(const int* vertex, int count, const BoxOf& box_of, const Reach& reach) {
    Box<T> box = Box<T>::none();
    T widest(0);
    for (int n = 0; n < count; ++n) {
      box.add(box_of(vertex[n]));
      const T own = reach(vertex[n]);
      widest = widest < own ? own : widest;
    }
    return box.widened(widest);
  }

  PD_HD void measure(ContactPair<T>& pair) const {
    Vec3<T> corner[4];
    pair.corners(env_.a.place, corner);
    pair.near = closest_points(pair.edges, corner);
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
    });
    team.each(count, [&](int p) {
      a.active[p] = 0;
      env_.keep_spaces(p);
      env_.keep_pushes(p, false);
    });
  }

  const Env& env_;
  TreeOfBoxes<T> triangles_, edges_;
};

}  // namespace pd::inline PD_TARGET
