// The start of a step: whole bodies move first, each by a common share of its way.
//
// A body takes the straight way of its velocities, if its parts stay apart all along. Else a body without pins takes its
// rigid motion, an affine map that folds nothing. Colliders take their screws. Parts stay apart along straight ways if one
// direction separates both ends: the gap along it is concave in the share. First, bodies that may meet go together by one
// share, so that what moves alike does not hinder itself. Then each goes on alone, by the share that planes allow.
#pragma once
#include "cpu/contact/run.h"

namespace pd::inline PD_TARGET {

template <class T>
class Approach {
 public:
  using Places = std::vector<Vec3<T>>;

  explicit Approach(const ContactPlan<T>& plan)
      : plan_(plan),
        way_(plan.vertices),
        end_(plan.vertices),
        rigid_(plan.bodies),
        own_(plan.bodies),
        pinned_(plan.bodies) {}

  // Moves the run's places toward its targets. `mass(vertex)`: of vertices of bodies.
  template <class Mass, class Walls>
  void move(ContactRun<T>& run, const Mass& mass, const Walls& walls) {
    find_rigid_ways(run, mass);
    find_unfolded(run);
    Places& place = run.place();
    for (int v = 0; v < plan_.body_vertices; ++v) {
      const int b = plan_.body[v];
      way_[v] = own_[b]      ? run.target()[v] - place[v]
                : pinned_[b] ? Vec3<T>{T(0), T(0), T(0)}
                             : narrow(rigid_[b].at(wide(place[v])));
      end_[v] = own_[b] ? run.target()[v] : place[v] + way_[v];
    }
    for (int v = plan_.body_vertices; v < plan_.vertices; ++v) end_[v] = run.goal()[v];
    start_ = place;
    for (std::size_t c = 0; c < run.hands().size(); ++c) {
      Hand<T>& hand = run.hands()[c];
      const Screw<T> screw(hand.pose, hand.goal);
      if (screws_.size() <= c) screws_.push_back(screw);
      screws_[c] = screw;
    }
    together_.assign(plan_.bodies, T(0));
    alone_.assign(plan_.bodies, T(1));
    go_together(run, walls);
    for (int v = 0; v < plan_.vertices; ++v) place[v] = at(run, v, together_[plan_.body[v]]);
    go_alone(run, walls);
    for (int b = 0; b < plan_.bodies; ++b)
      together_[b] = together_[b] + alone_[b] * (T(1) - together_[b]);
    for (int v = 0; v < plan_.vertices; ++v) place[v] = at(run, v, together_[plan_.body[v]]);
    for (std::size_t c = 0; c < run.hands().size(); ++c) {
      Hand<T>& hand = run.hands()[c];
      hand.pose = screws_[c].at(together_[plan_.body[hand.begin]]);
    }
  }

  // Whether a body came less far than it wanted.
  bool was_stopped(int body) const { return together_[body] < T(1); }

 private:
  static T larger_rounding(const Vec3<T>& a, const Vec3<T>& b) {
    return std::max(place_rounding(a), place_rounding(b));
  }

  static Vec3<double> wide(const Vec3<T>& a) { return {double(a.x), double(a.y), double(a.z)}; }
  static Vec3<T> narrow(const Vec3<double>& a) { return {T(a.x), T(a.y), T(a.z)}; }

  template <class Mass>
  void find_rigid_ways(ContactRun<T>& run, const Mass& mass) {
    const Places &place = run.place(), &target = run.target();
    std::fill(rigid_.begin(), rigid_.end(), RigidWay{});
    std::fill(pinned_.begin(), pinned_.end(), 0);
    for (int v = 0; v < plan_.body_vertices; ++v) {
      RigidWay& body = rigid_[plan_.body[v]];
      const double m = mass(v);
      body.mass += m;
      body.center = multiply_add(m, wide(place[v]), body.center);
      body.mean = multiply_add(m, wide(target[v]) - wide(place[v]), body.mean);
      if (run.moves_by_hand(v)) pinned_[plan_.body[v]] = 1;
    }
    for (RigidWay& body : rigid_) {
      const double share = body.mass > 0 ? 1 / body.mass : 0;
      body.center = share * body.center;
      body.mean = share * body.mean;
    }
    std::vector<Mat3<double>> moment(plan_.bodies, Mat3<double>{});
    std::vector<Vec3<double>> momentum(plan_.bodies, Vec3<double>{0, 0, 0});
    for (int v = 0; v < plan_.body_vertices; ++v) {
      const int b = plan_.body[v];
      const double m = mass(v);
      const Vec3<double> arm = wide(place[v]) - rigid_[b].center;
      add_moment(m, arm, wide(target[v]) - wide(place[v]), moment[b], momentum[b]);
    }
    for (int b = 0; b < plan_.bodies; ++b) {
      if (rigid_[b].mass > 0) rigid_[b].turn = turn_of(moment[b], momentum[b]);
    }
  }

  // Bodies whose parts stay apart along their ways. A rigid motion shortens no distance, so only pairs within reach of the
  // rest of the ways can meet.
  void find_unfolded(ContactRun<T>& run) {
    const Places &place = run.place(), &target = run.target();
    std::vector<T> reach(plan_.vertices, T(0));
    for (int v = 0; v < plan_.body_vertices; ++v) {
      const Vec3<T> rest = target[v] - place[v] - narrow(rigid_[plan_.body[v]].at(wide(place[v])));
      reach[v] = square_root(dot(rest, rest));
    }
    const T none(0);
    std::vector<char> searches(plan_.bodies, 0);
    for (int b = 0; b < plan_.bodies; ++b) {
      own_[b] = rigid_[b].mass > 0;
      if (!own_[b] || !plan_.touches_itself[b]) continue;
      T most(0);
      run.near().shapes().each_of(b, [&](int v) { most = reach[v] > most ? reach[v] : most; });
      const T room = run.near().shapes().apart(b, place) - T(1.0 + slack_share) * plan_.thickness;
      searches[b] = !(T(2) * most <= room);
    }
    if (std::none_of(searches.begin(), searches.end(), [](char s) { return s; })) return;
    run.near().each_meeting(
        [&](int v) { return Box<T>{place[v], place[v]}; },
        [&](int v) { return reach[v] + T(0.5) * plan_.thickness; },
        [&](int b) { return searches[b] != 0; }, [](int, int) { return false; },
        [&](const PairSides& sides) {
          const T thickness = run.near().search().thickness_of(sides);
          if (!own_[plan_.body[sides.vertex[0]]] || !(thickness > none)) return;
          const ContactPair<T> pair = run.near().search().pair_of(sides, thickness);
          Vec3<T> start[4], end[4];
          pair.corners(place, start);
          pair.corners(target, end);
          own_[plan_.body[pair.vertex[0]]] =
              stays_apart(pair, start, end, [&](int v) { return reach[v]; }, plan_.thickness);
        });
  }

  // Places after a share of the ways.
  Vec3<T> at(ContactRun<T>& run, int v, T share) const {
    if (v >= plan_.body_vertices)
      return screws_[plan_.collider[v]].at(share).place(local_point(plan_, v));
    if (own_[plan_.body[v]] && share >= T(1)) return end_[v];
    (void)run;
    return share > T(0) ? multiply_add(share, way_[v], start_[v]) : start_[v];
  }

  // Pairs of different bodies that may meet on the way from the run's places to the ends.
  template <class Visit>
  void each_between(ContactRun<T>& run, const Visit& visit) {
    const Places& place = run.place();
    const auto swept = [&](int v) {
      Box<T> box{place[v], place[v]};
      box.add(end_[v]);
      return box;
    };
    const auto reach = [&](int v) {
      // a helix leaves the box of its ends by half a chord at most
      const Vec3<T> chord = end_[v] - place[v];
      const T bow = v < plan_.body_vertices ? T(0) : T(0.5) * square_root(dot(chord, chord));
      return bow + T(0.5) * plan_.thickness;
    };
    run.near().each_meeting(
        swept, reach, [](int) { return false; }, [](int, int) { return true; },
        [&](const PairSides& sides) {
          const T thickness = run.near().search().thickness_of(sides);
          if (!(thickness > T(0))) return;
          ContactPair<T> pair = run.near().search().pair_of(sides, thickness);
          visit(pair);
        });
  }

  // Groups of moving bodies that pairs couple: each goes by one share.
  int group(int body) const {
    while (group_[body] != body) body = group_[body];
    return body;
  }

  template <class Walls>
  void go_together(ContactRun<T>& run, const Walls& walls) {
    std::vector<char> moves(plan_.bodies, 0);
    for (int v = 0; v < plan_.vertices; ++v) {
      const Vec3<T> way = end_[v] - run.place()[v];
      if (way.x != T(0) || way.y != T(0) || way.z != T(0)) moves[plan_.body[v]] = 1;
    }
    group_.resize(plan_.bodies);
    for (int b = 0; b < plan_.bodies; ++b) group_[b] = b;
    list_.pairs.clear();
    kept_.clear();
    each_between(run, [&](ContactPair<T>& pair) {
      Vec3<T> start[4], end[4];
      pair.corners(run.place(), start);
      pair.corners(end_, end);
      kept_.push_back(direction_of(pair, start, end));
      list_.pairs.push_back(pair);
      const int a = plan_.body[pair.vertex[0]], b = plan_.body[pair.vertex[3]];
      if (moves[a] && moves[b]) group_[std::max(group(a), group(b))] = std::min(group(a), group(b));
    });
    for (int g = 0; g < plan_.bodies; ++g) {
      if (group(g) != g || !moves[g]) continue;
      const T share = largest_share<T>([&](T s) { return goes(run, g, s, walls); });
      for (int b = 0; b < plan_.bodies; ++b)
        if (group(b) == g) together_[b] = share;
    }
    for (int b = 0; b < plan_.bodies; ++b)
      if (!moves[b]) together_[b] = T(1);
  }

  // Whether a group may take a share of its ways, as others stand still.
  template <class Walls>
  bool goes(ContactRun<T>& run, int g, T share, const Walls& walls) const {
    const auto place = [&](int v) {
      return group(plan_.body[v]) == g ? at(run, v, share) : start_[v];
    };
    for (std::size_t n = 0; n < kept_.size(); ++n) {
      const ContactPair<T>& pair = list_.pairs[n];
      if (group(plan_.body[pair.vertex[0]]) != g && group(plan_.body[pair.vertex[3]]) != g)
        continue;
      Vec3<T> corner[4];
      for (int a = 0; a < 4; ++a) corner[a] = place(pair.vertex[a]);
      if (!kept_[n].allows(pair.edges, corner)) return false;
    }
    const Ball<T> anywhere{{T(0), T(0), T(0)}, T(HUGE_VAL)};
    for (int v = 0; v < plan_.body_vertices; ++v) {
      if (group(plan_.body[v]) != g || own_[plan_.body[v]]) continue;
      const T margin = larger_rounding(start_[v], end_[v]);
      const bool fine = is_allowed(place(v), anywhere, [&](const auto& visit) {
        walls(v, start_[v], [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
      });
      if (!fine) return false;
    }
    return true;
  }

  template <class Walls>
  void go_alone(ContactRun<T>& run, const Walls& walls) {
    const auto arrived = [](T share) { return share >= T(1); };
    if (std::all_of(together_.begin(), together_.end(), arrived)) return;
    const Places& place = run.place();
    list_.pairs.clear();
    each_between(run, [&](ContactPair<T>& pair) {
      Vec3<T> corner[4];
      pair.corners(place, corner);
      make_plane(pair, place, end_, closest_points(pair.edges, corner), Vec3<T>{});
      list_.pairs.push_back(pair);
    });
    list_.index(plan_.vertices);
    const Ball<T> anywhere{{T(0), T(0), T(0)}, T(HUGE_VAL)};
    for (int b = 0; b < plan_.bodies; ++b) {
      const T done = together_[b], rest = T(1) - done;
      if (!(rest > T(0))) continue;
      bool stuck = false;
      each_of(b, [&](int v) { stuck = stuck || list_.is_stuck(v); });
      alone_[b] = stuck ? T(0) : largest_share<T>([&](T s) {
        bool fine = true;
        each_of(b, [&](int v) {
          if (!fine) return;
          const T margin = larger_rounding(place[v], end_[v]);
          fine = is_allowed(at(run, v, done + s * rest), anywhere, [&](const auto& visit) {
            list_.each_space(v, visit);
            if (!own_[b])
              walls(v, place[v],
                    [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
          });
        });
        return fine;
      });
    }
  }

  template <class Visit>
  void each_of(int body, const Visit& visit) const {
    for (int v = 0; v < plan_.vertices; ++v)
      if (plan_.body[v] == body) visit(v);
  }

  const ContactPlan<T>& plan_;
  PairList<T> list_;
  std::vector<Kept<T>> kept_;     // of the pairs of a group
  std::vector<Screw<T>> screws_;  // of colliders
  std::vector<T> together_, alone_;
  std::vector<int> group_;
  Places way_, end_, start_;
  std::vector<RigidWay> rigid_;
  std::vector<char> own_, pinned_;
};

}  // namespace pd::inline PD_TARGET
