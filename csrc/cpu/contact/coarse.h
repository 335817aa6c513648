// The coarse correction of bodies in contact: rigid motions that the listed pairs join, as far as other bodies let them.
//
// An island, the bodies that pairs join, goes by one common share of its motions, else it would lose momentum. A share turns
// each body about its axis by less, so no distance within a body changes: pairs of a body with itself bound nothing. Pairs of
// different bodies bound the share. One direction each keeps their sides apart at both ends, and so on the straight way. Pairs
// that are not listed are safe while vertices stay in their balls. A longer way finds the pairs of its swept boxes itself, and
// a search must follow.
#pragma once
#include "cpu/contact/approach.h"
#include "cpu/step/rigid.h"
#include "solver/coarse/island.h"

namespace pd::inline PD_TARGET {

// Of the chord of a turn up to a right angle: how far a share of it leaves the straight way.
constexpr double turn_bow = 0.25;
constexpr int coarse_halvings =
    6;  // of the interval of a share: another motion follows one that is cut

template <class T>
class CoarseContact {
  using Lanes = Single<T>;

 public:
  using Places = std::vector<Vec3<T>>;

  CoarseContact(const ContactPlan<T>& contact, const Plan<T>& plan)
      : contact_(contact),
        plan_(plan),
        inside_(plan.vertices),
        component_(contact.vertices, -1),
        members_(plan.components),
        local_(plan.components),
        motion_(plan.components),
        several_(contact.bodies, 0) {
    for (int i = 0; i < plan.vertices; ++i) {
      const int g = plan.vertex_component[i];
      inside_[plan.vertex_order[i]] = i;
      component_[plan.vertex_order[i]] = g;
      if (g >= 0) members_[g].push_back(i);
    }
    std::vector<int> first(contact.bodies, -1);
    for (int v = 0; v < contact.body_vertices; ++v) {
      int& of = first[contact.body[v]];
      if (of < 0) of = v;
      if (component_[v] != component_[of])
        several_[contact.body[v]] = contact.touches_itself[contact.body[v]] != 0;
    }
  }

  // -1: no pin leaves the vertex a rigid motion, or it is none of a body
  int component(int vertex) const { return component_[vertex]; }

  // Whether a way since the last search left the list.
  bool leaves_list() const { return swept_; }

  // Islands of the components that listed pairs join.
  void begin(ContactRun<T>& run) {
    swept_ = false;
    next_ = run.place();
    root_.resize(plan_.components);
    for (int g = 0; g < plan_.components; ++g) root_[g] = g;
    each_joining(run, [&](int, int a, int b) {
      if (a >= 0 && b >= 0) root_[std::max(root(a), root(b))] = std::min(root(a), root(b));
    });
    pairs_.assign(plan_.components, {});
    each_joining(run, [&](int p, int a, int b) { pairs_[root(a >= 0 ? a : b)].push_back(p); });
    bodies_.assign(plan_.components, {});
    for (int g = 0; g < plan_.components; ++g) bodies_[root(g)].push_back(g);
  }

  bool is_island(int root) const { return !bodies_[root].empty(); }
  bool has_pairs(int root) const { return !pairs_[root].empty(); }

  // Finds the motions of an island with the least energy.
  template <bool HasContacts>
  void find(ContactRun<T>& run, Workspace<Lanes>& w, int root, const Contacts<T>& contacts) {
    island_.bodies.clear();
    for (int g : bodies_[root]) {
      local_[g] = int(island_.bodies.size());
      island_.bodies.push_back(CoarseBody(RigidBody(w.body_sums[g].rigid)));
    }
    island_.pairs.clear();
    for (int p : pairs_[root]) island_.pairs.push_back(coarse_pair(run, w, p));
    island_.begin();
    while (!island_.is_done()) {
      for (int g : bodies_[root]) {
        BodySums<double>& sums = w.body_sums[g];
        std::fill(std::begin(sums.contact), std::end(sums.contact), 0.0);
        if constexpr (HasContacts) {
          const CoarseTrial<double> trial = island_.trial(local_[g]);
          for (int i : members_[g])
            each_contact_term(contacts, coarse_vertex(w, i), trial,
                              VertexForces<Lanes>{w, plan_.vertices, i},
                              [&](bool adds, const auto& terms) {
                                if (adds) add_terms(sums.contact, terms());
                              });
        }
      }
      island_.pass([&](int n) -> const double (&)[ContactSums::count] {
        return w.body_sums[bodies_[root][n]].contact;
      });
    }
  }

  // Whether the motions found are to be made.
  bool is_valid() const { return island_.is_valid(); }

  // Moves an island as far along its motions as other bodies let it, with the forces of its pairs; returns the share.
  double move(ContactRun<T>& run, const Workspace<Lanes>& w, int root) {
    place(w, root, 1);
    find_bounds(run, w, root);
    const auto allowed = [&](double s) {
      place(w, root, s);
      return keeps_apart();
    };
    const double share = largest_share<double>(allowed, coarse_halvings);
    place(w, root, share);
    each_moving(w, root, [&](int, int v) {
      if (share > 0) run.place()[v] = next_[v];
      next_[v] = run.place()[v];
    });
    const auto motion = [&](int n) -> const RigidMotion<double>& {
      return motion_[bodies_[root][n]];
    };
    for (const CoarsePair& pair : island_.pairs) {
      const Vec3<double> force =
          share < 1 ? island_.force_after(pair, motion) : island_.force(pair);
      const double normal = dot(force, pair.normal);
      run.set_force(pair.number,
                    {T(normal > 0 ? normal : 0.0), narrow(tangential(force, pair.normal))});
    }
    return share;
  }

  // Displacement of a vertex by the whole motion of its body.
  Vec3<double> way(const Workspace<Lanes>& w, int i) const {
    const CoarseVertex<double> v = coarse_vertex(w, i);
    return motion_of(plan_.vertex_component[i]).of(v.x + v.u);
  }

  template <class Visit>
  void each_vertex(int root, const Visit& visit) const {
    for (int g : bodies_[root])
      for (int i : members_[g]) visit(i);
  }

 private:
  static Vec3<T> narrow(const Vec3<double>& a) { return {T(a.x), T(a.y), T(a.z)}; }
  static Vec3<double> wide(const Vec3<T>& a) { return widened<double>(a); }
  static double length(const Vec3<double>& a) { return square_root(dot(a, a)); }

  const RigidMotion<double>& motion_of(int component) const {
    return island_.bodies[local_[component]].motion();
  }

  int root(int g) const {
    while (root_[g] != g) g = root_[g];
    return g;
  }

  // visit(number, component of A, of B) for the pairs of different components that can yield
  template <class Visit>
  void each_joining(ContactRun<T>& run, const Visit& visit) const {
    const auto& pairs = run.list().pairs;
    for (int p = 0; p < int(pairs.size()); ++p) {
      const int a = component_[pairs[p].vertex[0]], b = component_[pairs[p].vertex[3]];
      if (a != b && pairs[p].freedom(run.inverse()) > T(least_yield)) visit(p, a, b);
    }
  }

  CoarsePair coarse_pair(ContactRun<T>& run, const Workspace<Lanes>& w, int p) const {
    const ContactPair<T>& of = run.list().pairs[p];
    CoarsePair pair;
    pair.number = p;
    for (int s = 0; s < 2; ++s) {
      const int g = component_[of.vertex[s == 0 ? 0 : 3]];
      pair.side[s] = {g < 0 ? -1 : local_[g], {0, 0, 0}};
      if (g < 0) continue;
      const Vec3<double> center = island_.bodies[local_[g]].motion().center;
      for (int a = 0; a < 4; ++a) {
        if (of.on_a(a) != (s == 0)) continue;
        const CoarseVertex<double> v = coarse_vertex(w, inside_[of.vertex[a]]);
        const double share = s == 0 ? double(of.near.weight[a]) : -double(of.near.weight[a]);
        pair.side[s].arm = multiply_add(share, (v.x + v.u) - center, pair.side[s].arm);
      }
    }
    pair.normal = wide(of.normal);
    pair.slip = wide(of.slip(run.place(), run.begin_places(), of.near));
    pair.force = multiply_add(double(of.force.normal), pair.normal,
                              tangential(wide(of.force.tangential), pair.normal));
    pair.gap = double(of.near.distance) - double(of.thickness);
    pair.yielding = double(of.yielding(run.inverse()));
    pair.friction = double(of.friction);
    return pair;
  }

  // visit(i, v) for the vertices of an island that pins do not hold
  template <class Visit>
  void each_moving(const Workspace<Lanes>& w, int root, const Visit& visit) const {
    each_vertex(root, [&](int i) {
      if (w.inverse[i] > T(0)) visit(i, plan_.vertex_order[i]);
    });
  }

  // Places of an island after a share of its motions.
  void place(const Workspace<Lanes>& w, int root, double share) {
    for (int g : bodies_[root]) {
      const RigidMotion<double>& whole = motion_of(g);
      motion_[g] = whole;
      if (share < 1) {
        motion_[g].turn = small_turn(share * island_.turn(local_[g]));
        motion_[g].shift = share * whole.shift;
      }
    }
    each_moving(w, root, [&](int i, int v) {
      const CoarseVertex<double> at = coarse_vertex(w, i);
      const auto u =
          w.u[i] + Lanes::value(narrow(motion_[plan_.vertex_component[i]].of(at.x + at.u)));
      next_[v] = Lanes::vec3(w.x[i] + u);
    });
  }

  // Pairs that bound the ways of an island from the run's places to `next_`, with the gaps to keep.
  void find_bounds(ContactRun<T>& run, const Workspace<Lanes>& w, int root) {
    const Places& places = run.place();
    moves_.assign(contact_.vertices, 0);
    bool leaves = swept_;
    each_moving(w, root, [&](int, int v) {
      moves_[v] = 1;
      leaves = leaves || run.leaves_ball(v, next_[v]);
    });
    swept_ = leaves;
    across_.clear();
    const auto consider = [&](const ContactPair<T>& pair) {
      const int a = pair.vertex[0], b = pair.vertex[3];
      if (component_[a] == component_[b]) return;
      bool moves = false;
      for (int v : pair.vertex) moves = moves || moves_[v];
      if (moves) across_.push_back(pair);
    };
    if (!leaves) {
      for (const ContactPair<T>& pair : run.list().pairs) consider(pair);
    } else {
      const auto swept = [&](int v) {
        Box<T> box{places[v], places[v]};
        box.add(next_[v]);
        return box;
      };
      const auto reach = [&](int v) {
        if (!moves_[v]) return T(0.5) * contact_.thickness;
        const RigidMotion<double>& motion = motion_of(component_[v]);
        return T(turn_bow *
                 length(motion_[component_[v]].turn * (wide(places[v]) - motion.center))) +
               T(0.5) * contact_.thickness;
      };
      run.near().each_meeting(
          swept, reach, [&](int b) { return several_[b] != 0; }, [](int, int) { return true; },
          [&](const PairSides& sides) {
            const T thickness = run.near().search().thickness_of(sides);
            if (thickness > T(0)) consider(run.near().search().pair_of(sides, thickness));
          });
    }
    kept_.clear();
    for (const ContactPair<T>& pair : across_) {
      Vec3<T> start[4], end[4];
      pair.corners(places, start);
      pair.corners(next_, end);
      kept_.push_back(direction_of(pair, start, end));
    }
  }

  // Whether the pairs that bound a way are apart at its end.
  bool keeps_apart() const {
    for (std::size_t n = 0; n < across_.size(); ++n) {
      Vec3<T> corner[4];
      across_[n].corners(next_, corner);
      const T gap = gap_along(across_[n].edges, kept_[n].normal, corner);
      if (gap < kept_[n].least || gap <= gap_bound(corner)) return false;
    }
    return true;
  }

  const ContactPlan<T>& contact_;
  const Plan<T>& plan_;
  std::vector<int> inside_, component_;  // of the user's vertices: internal number; component
  std::vector<std::vector<int>> members_, bodies_, pairs_;  // of components; of islands by root
  std::vector<int> local_, root_;  // of components: number in the island; a step to the root
  std::vector<RigidMotion<double>> motion_;  // of components: a share
  CoarseIsland island_;
  Places next_;
  std::vector<char> moves_;
  std::vector<ContactPair<T>> across_;
  std::vector<Kept<T>> kept_;
  std::vector<char>
      several_;  // of bodies that touch themselves: whether they have several components
  bool swept_ = false;
};

}  // namespace pd::inline PD_TARGET
