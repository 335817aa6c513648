// The start of a step: whole bodies move first, each by a common share of its way.
//
// A body takes the straight way of its velocities, if its parts stay apart all along: for every pair within reach one
// direction separates both ends of the way, and so all between, since the gap is concave in the share. Else a body without
// pins takes its rigid motion, an affine map that folds nothing. Planes between bodies bound the share of each.
#pragma once
#include "cpu/contact/run.h"
#include "math/svd.h"

namespace pd::inline PD_TARGET {

constexpr double no_inertia = 1e-12;  // of the largest moment of a body: a line turns about itself

// The rigid part of the ways of a body, by its momenta.
struct RigidWay {
  double mass = 0;
  Vec3<double> center = {0, 0, 0}, mean = {0, 0, 0}, turn = {0, 0, 0};

  Vec3<double> at(const Vec3<double>& place) const { return mean + cross(turn, place - center); }
};

template <class T>
class Approach {
 public:
  using Places = std::vector<Vec3<T>>;

  explicit Approach(const ContactPlan<T>& plan)
      : plan_(plan), way_(plan.vertices), end_(plan.vertices), rigid_(plan.bodies), own_(plan.bodies),
        pinned_(plan.bodies) {}

  // Moves the run's places toward its targets. `mass(vertex)`: of vertices of bodies.
  template <class Mass, class Walls>
  void move(ContactRun<T>& run, const Mass& mass, const Walls& walls) {
    find_rigid_ways(run, mass);
    find_unfolded(run);
    Places& place = run.place();
    for (int v = 0; v < plan_.body_vertices; ++v) {
      const int b = plan_.body[v];
      way_[v] = own_[b] ? run.target()[v] - place[v]
                : pinned_[b] ? Vec3<T>{T(0), T(0), T(0)}
                             : narrow(rigid_[b].at(wide(place[v])));
      end_[v] = own_[b] ? run.target()[v] : place[v] + way_[v];
    }
    for (int v = plan_.body_vertices; v < plan_.vertices; ++v) end_[v] = run.goal()[v];
    find_pairs(run);
    take_shares(run, walls);
  }

 private:
  static Vec3<double> wide(const Vec3<T>& a) { return {double(a.x), double(a.y), double(a.z)}; }
  static Vec3<T> narrow(const Vec3<double>& a) { return {T(a.x), T(a.y), T(a.z)}; }

  template <class Mass>
  void find_rigid_ways(const ContactRun<T>& run_, const Mass& mass) {
    ContactRun<T>& run = const_cast<ContactRun<T>&>(run_);
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
      momentum[b] = multiply_add(m, cross(arm, wide(target[v]) - wide(place[v])), momentum[b]);
      const double square = dot(arm, arm), at[3] = {arm.x, arm.y, arm.z};
      for (int r = 0; r < 3; ++r) {
        Vec3<double> row = {-at[r] * arm.x, -at[r] * arm.y, -at[r] * arm.z};
        (r == 0 ? row.x : r == 1 ? row.y : row.z) += square;
        moment[b].row[r] = multiply_add(m, row, moment[b].row[r]);
      }
    }
    for (int b = 0; b < plan_.bodies; ++b) {
      if (rigid_[b].mass > 0) rigid_[b].turn = turn_of(moment[b], momentum[b]);
    }
  }

  // moment^-1 momentum, 0 about axes without inertia
  static Vec3<double> turn_of(const Mat3<double>& moment, const Vec3<double>& momentum) {
    const SignedSvd<double> svd = signed_svd(moment);
    const Mat3<double> axes = transpose(svd.u);
    Vec3<double> turn = {0, 0, 0};
    for (int n = 0; n < 3; ++n) {
      const double inertia = absolute(svd.s[n]);
      if (inertia > no_inertia * absolute(svd.s[0]))
        turn = multiply_add(dot(axes.row[n], momentum) / inertia, axes.row[n], turn);
    }
    return turn;
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
    for (int b = 0; b < plan_.bodies; ++b) own_[b] = rigid_[b].mass > 0;
    run.search().each_boxed(
        [&](int v) { return Box<T>{place[v], place[v]}; },
        [&](int v) { return reach[v] + T(0.5) * plan_.thickness; },
        [&](int v) { return run.moves_by_hand(v); },
        [&](const ContactPair<T>& pair) {
          const int b = plan_.body[pair.vertex[0]];
          if (b != plan_.body[pair.vertex[3]] || !own_[b]) return;
          Vec3<T> start[4], end[4];
          pair.corners(place, start);
          pair.corners(target, end);
          const Closest<T> near = closest_points(pair.edges, start);
          T side[2] = {T(0), T(0)};
          for (int a = 0; a < 4; ++a) {
            T& most = side[pair.on_a(a) ? 0 : 1];
            most = std::max(most, reach[pair.vertex[a]]);
          }
          if (!(near.distance <= side[0] + side[1] + plan_.thickness)) return;
          own_[b] = own_[b] && keeps_apart(pair, near, start, end);
        });
  }

  // Whether one direction separates the sides at both ends, no nearer than before or than the floor.
  static bool keeps_apart(const ContactPair<T>& pair, const Closest<T>& near, const Vec3<T> (&start)[4],
                          const Vec3<T> (&end)[4]) {
    const bool edges = pair.edges;
    const Separation<T> first = separate(edges, start, near, Vec3<T>{}),
                        last = separate(edges, end, closest_points(edges, end), Vec3<T>{});
    const T least = std::min(first.gap, pair.floor());
    for (const Separation<T>& by : {first, last}) {
      const T before = gap_along(edges, by.normal, start), after = gap_along(edges, by.normal, end);
      if (before > by.bound && after > by.bound && before >= least && after >= least) return true;
    }
    return false;
  }

  // Pairs of different bodies whose boxes, swept over the whole way, meet.
  void find_pairs(ContactRun<T>& run) {
    const Places& place = run.place();
    list_.pairs.clear();
    run.search().each_boxed(
        [&](int v) {
          Box<T> box{place[v], place[v]};
          box.add(end_[v]);
          return box;
        },
        [&](int v) {
          // a helix leaves the box of its ends by half a chord at most
          const Vec3<T> chord = end_[v] - place[v];
          const T bow = v < plan_.body_vertices ? T(0) : T(0.5) * square_root(dot(chord, chord));
          return bow + T(0.5) * plan_.thickness;
        },
        [&](int v) { return run.moves_by_hand(v); },
        [&](ContactPair<T>& pair) {
          if (plan_.body[pair.vertex[0]] == plan_.body[pair.vertex[3]]) return;
          Vec3<T> corner[4];
          pair.corners(place, corner);
          make_plane(pair, place, end_, closest_points(pair.edges, corner), Vec3<T>{});
          list_.pairs.push_back(pair);
        });
    list_.index(plan_.vertices);
  }

  template <class Walls>
  void take_shares(ContactRun<T>& run, const Walls& walls) {
    Places& place = run.place();
    const Ball<T> anywhere{{T(0), T(0), T(0)}, T(HUGE_VAL)};
    const auto allowed = [&](int v, const Vec3<T>& to, bool by_walls) {
      const T margin = place_margin(place[v]);
      return is_allowed(to, anywhere, [&](const auto& visit) {
        list_.each_space(v, visit);
        if (by_walls)
          walls(v, place[v], [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
      });
    };
    Places moved = place;
    for (int b = 0; b < plan_.bodies; ++b) {
      if (!(rigid_[b].mass > 0)) continue;
      const auto at = [&](int v, T share) {
        return own_[b] && share >= T(1) ? end_[v] : multiply_add(share, way_[v], place[v]);
      };
      const T share = share_of(b, 0, plan_.body_vertices, [&](int v, T s) { return allowed(v, at(v, s), !own_[b]); });
      each_of(b, 0, plan_.body_vertices, [&](int v) { moved[v] = share > T(0) ? at(v, share) : place[v]; });
    }
    for (Hand<T>& hand : run.hands_to_move()) {
      const Screw<T> screw(hand.pose, hand.goal);
      bool stuck = false;
      for (int v = hand.begin; v < hand.end; ++v) stuck = stuck || list_.is_stuck(v);
      const T share = stuck ? T(0) : largest_share<T>([&](T s) {
        const Pose<T> pose = screw.at(s);
        for (int v = hand.begin; v < hand.end; ++v)
          if (!allowed(v, pose.place(local_point(plan_, v)), false)) return false;
        return true;
      });
      hand.pose = screw.at(share);
      for (int v = hand.begin; v < hand.end; ++v) moved[v] = hand.pose.place(local_point(plan_, v));
    }
    place = moved;
  }

  template <class Visit>
  void each_of(int body, int begin, int end, const Visit& visit) const {
    for (int v = begin; v < end; ++v)
      if (plan_.body[v] == body) visit(v);
  }

  template <class Allowed>
  T share_of(int body, int begin, int end, const Allowed& allowed) const {
    bool stuck = false;
    each_of(body, begin, end, [&](int v) { stuck = stuck || list_.is_stuck(v); });
    if (stuck) return T(0);
    return largest_share<T>([&](T s) {
      bool fine = true;
      each_of(body, begin, end, [&](int v) { fine = fine && allowed(v, s); });
      return fine;
    });
  }

  const ContactPlan<T>& plan_;
  PairList<T> list_;
  Places way_, end_;
  std::vector<RigidWay> rigid_;
  std::vector<char> own_, pinned_;
};

}  // namespace pd::inline PD_TARGET
