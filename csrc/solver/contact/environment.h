// The contact of one environment while its step runs, for a team of threads that shares its phases.
//
// A phase calls a function for every item: vertex, pair, part of a surface, body. Items of a phase
// do not depend on each other, so any number of threads has the same bits. A team offers
//
//   in_order               whether one thread takes all items in their order
//   spread(count, item)    a phase; each(count, item): and a barrier, after which all see what it wrote
//   once(task)             one thread, and a barrier
//   sum(count, add, sums)  sums of doubles in a fixed order, the same in all threads; scan(numbers, count): prefix sums
//   walk(boxes, sides, visit)  pairs of sides whose boxes meet; see solver/contact/search.h
//   warps(count, visit)    visit(n, lanes) for every n by 32 lanes of solver/contact/clusters.h
//   each_closest(count, pair_at, places, visit)  visit(n, closest points) of pairs, and a barrier
//   blocks<T>(count, visit)  visit(lanes) for blocks of items in vector instructions, and a barrier
//   groups(count, visit)   a group of threads for each number, with sum_range and least_range over items of its own,
//                          select: items in their order, spread_of_group and each_of_group(count, item),
//                          each_below(begin, end, item): item(row, column) of a triangle, and lead(task): one thread
//
// All threads of a team take the same branches: what they decide by is not written in the phase that follows.
#pragma once
#include "contact/pairs/shares.h"
#include "solver/chebyshev.h"
#include "solver/coarse/island.h"
#include "solver/contact/clusters.h"
#include "solver/contact/shared_numbers.h"
#include "solver/step.h"
#include "solver/vertex.h"
#if !defined(__CUDACC__)
#include "math/pack.h"
#endif

#include <cstddef>
#include <cstdint>

namespace pd::inline PD_TARGET {

// Numbers of an environment, one of each.
struct ContactNumbers {
  double checked_energy;
  double slope, least_slope;  // of the steps of colliders that pairs couple
  int pairs, known, most_pairs, searches, shortened, frozen;
  int searched_at;
  int waits, checked;
  // of an iteration
  int active, outside, loaded, cut, stopped, meets, changed, couples;
  int listed;                                     // near pairs that were found, listed or not
  int corrects, searching, leaves, cuts, pushes;  // of a coarse correction
  int moved, changes[contact_sweeps];  // vertices of active pairs; whether sweeps change a force
};

// Four numbers, for loads of 16 bytes.
template <class T>
struct alignas(4 * sizeof(T) > 16 ? 16 : 4 * sizeof(T)) Four {
  T x, y, z, w;
};

// Two sides: a row of `point` or, above these, an edge; and a triangle, or a later edge.
struct SidePair {
  int owner, other;
};

#if defined(__CUDACC__)
template <class T>
PD_HD Four<T> multiply_add(T s, const Four<T>& a, const Four<T>& b) {
  return {multiply_add(s, a.x, b.x), multiply_add(s, a.y, b.y), multiply_add(s, a.z, b.z), T(0)};
}
#else
template <class T>
PD_HD Four<T> multiply_add(T s, const Four<T>& a, const Four<T>& b) {
  using P = Pack<T, 4>;
  Four<T> sum;
  multiply_add(P(s), P::load(&a.x), P::load(&b.x)).store(&sum.x);
  return sum;
}
#endif

// What an active pair keeps over the sweeps of an iteration: numbers side by side with those of others.
template <class T>
struct ActiveRow {
  static constexpr int weight = 0, moves = 4,  // of the corners; theta omega w / D
      between = 8, before = 11, normal = 14,   // sums w x of targets, and at the step's start
      tangential = 17, normal_force = 20, force = 21, beta = 24, thickness = 25, friction = 26,
                       count = 27, integers_count = 5;
  static constexpr int stride = 192;  // pairs of a chunk; a multiple of all lanes
  static constexpr std::int64_t chunk =
      count * stride +
      (integers_count * stride * int(sizeof(int)) + int(sizeof(T)) - 1) / int(sizeof(T));

  T* numbers;
  int* integers;  // pair, vertices

  PD_HD ActiveRow(T* of_chunk, int at)
      : numbers(of_chunk + at), integers(reinterpret_cast<int*>(of_chunk + count * stride) + at) {}

  PD_HD T* place(int n) const { return numbers + n * stride; }
  PD_HD T& operator[](int n) const { return numbers[n * stride]; }
  PD_HD int& pair() const { return integers[0]; }
  PD_HD int& vertex(int corner) const { return integers[(1 + corner) * stride]; }
};

// Those of all active pairs, chunk by chunk. The first chunk may be elsewhere.
template <class T>
struct ActiveRows {
  T *first, *chunks;

  PD_HD static std::int64_t size(int capacity) {
    const int stride = ActiveRow<T>::stride;
    return (std::int64_t(capacity) + stride) / stride * ActiveRow<T>::chunk;
  }
  PD_HD ActiveRow<T> operator[](int q) const {
    const int stride = ActiveRow<T>::stride, chunk = q / stride;
    return {chunk == 0 ? first : chunks + chunk * ActiveRow<T>::chunk, q % stride};
  }
};

// Whether planes that are new since the last move may cut the way of a vertex, or whether it must stay: targets have been
// compared with all others.
enum Limits : int { limits_none, limits_planes, limits_stuck };

// A collider with a mass; see solver/contact/rigid.h. `weight` 0: moves by hand.
struct RigidCollider {
  double weight;
  Vec3<double> center;    // of mass, about its origin
  Mat3<double> inertia;   // J
  Vec3<double> momentum;  // L
  // in an iteration: the centre at the present pose, 1 / size, minus the derivative of E there, and the motion from it
  Vec3<double> at;
  double length;
  Vec3<double> pull, torque, shift, turn;
  // of a step: the lower triangle of its matrix row by row, what it lacks to balance, the step, and conjugate gradients
  double matrix[21], left[6], way[6], direction[6], product[6];
  double energy;
  // at the end of a step: squares of what is not balanced, of all, and of places and turns in N [N^2]
  double unbalanced, whole, rounding;
};

// Arrays of an environment. Vertices have the user's numbers, those of colliders last.
template <class T>
struct ContactArrays {
  Vec3<T>*begin, *place, *target, *goal, *shift, *checked, *end;  // [vertices] m
  Ball<T>* ball;                                                  // [vertices]
  T *inverse, *weight, *room;                                     // [vertices]
  unsigned char *held, *cut, *surface;                            // [vertices]
  int *limits, *touched, *moved;  // [vertices] Limits; of an active pair; those in any order
  Four<T>* moved_by;              // [vertices] by active pairs, m
  // Entries of vertices: corners of their pairs, in the order of the pairs.
  int *start, *cursor;  // [vertices + 1] first entry of each; counts
  // [4 capacity] pair * 4 + corner in any order; the entry of each corner; and the corner of each entry
  int *entry, *slot, *corner;
  Four<T>*push,
      *space;  // [4 capacity] by entry: force of the pair and weight; normal and bound of a half-space
  T* margin;                            // [4 capacity] of the half-space
  T *rows, *first_rows;                 // ActiveRows
  int* row_of;                          // [capacity] of a pair, -1: none
  ContactPair<T>* pair;                 // [capacity] in the order of their keys
  std::int64_t* known_key;              // [capacity] of the list before
  Multiplier<T>* known_force;           // [capacity]
  int *owner, *partner;                 // [capacity] parts of a pair
  int* owner_start;                     // [owners + 1] pairs of each vertex, then of each edge
  int* owner_near;                      // [owners]
  RigidWay* rigid;                      // [bodies]
  Box<T>* body_box;                     // [bodies]
  T *together, *alone, *joint, *limit;  // [bodies] shares of ways
  int* joined;                          // [bodies] links to lesser bodies of a group
  unsigned char *own, *pinned, *moves;  // [bodies]
  Hand<T>* hand;                        // [colliders]
  Screw<T>* screw;                      // [colliders]
  T *share, *least, *bound;             // [colliders]
  int* barred;                          // [colliders]
  RigidCollider* rigid_collider;        // [colliders] if one has a mass
  // of the coarse correction
  int *inside,
      *component;  // [vertices] internal number, of bodies; component that moves rigidly, or -1
  CoarseBody* coarse_body;               // [components]
  CoarseIsland* island;                  // [components] by its least member
  RigidMotion<double>* motion;           // [components]
  double *coarse_sum, *newton, *matrix;  // [components, 31], [components, 18], of islands
  double *coarse_share, *coarse_joint, *coarse_limit;   // [components]
  int *root, *size, *first, *local, *member;            // [components] of islands
  int *component_begin, *component_end, *coarse_group;  // [components]
  int *side_start, *side_pair;  // [components + 1], [2 capacity] pairs of each component
  unsigned char *valid, *touches, *goes, *couple,
      *joins;        // [components], [components^2], [capacity]
  PairTerms* terms;  // [capacity]
  double* radius;    // [capacity] of friction; of a check, psi
  T* most;           // [colliders + 2]: held back, pins held back, least d / r
  // of the search
  Cluster<T>*cluster, *group;  // [clusters] boxes of sides; [groups] of trees over clusters
  SidePair* near_side;         // [near pairs] in any order
  T* near_value;               // [near pairs]
  T* ball_most;                // [bodies] largest radius of balls
  // [bodies] asked: with itself, with any; moves by hand
  unsigned char *itself, *wanted, *by_hand;
  ContactNumbers* numbers;
};

template <class T>
PD_HD int count_all_groups(const ContactPlan<T>& plan) {
  return count_groups(plan.point_clusters) + count_groups(plan.edge_clusters) +
         count_groups(plan.clusters - plan.point_clusters - plan.edge_clusters);
}

// Room of the list of near pairs: balls reach a part of them.
template <class T>
PD_HD int count_near(const ContactPlan<T>& plan) {
  return 2 * plan.capacity;
}

// `arena`: place(array, count)
template <class T, class Arena>
void arrange(Arena& arena, const ContactPlan<T>& plan, int components, ContactArrays<T>& a) {
  const std::int64_t v = plan.vertices, m = plan.capacity, b = plan.bodies, c = plan.colliders,
                     owners = std::int64_t(plan.points) + plan.edges;
  for (Vec3<T>** array : {&a.begin, &a.place, &a.target, &a.goal, &a.shift, &a.checked, &a.end})
    arena.place(*array, v);
  arena.place(a.ball, v);
  for (T** array : {&a.inverse, &a.weight, &a.room}) arena.place(*array, v);
  for (unsigned char** array : {&a.held, &a.cut, &a.surface}) arena.place(*array, v);
  for (int** array : {&a.limits, &a.touched, &a.moved}) arena.place(*array, v);
  arena.place(a.moved_by, v);
  for (int** array : {&a.start, &a.cursor}) arena.place(*array, v + 1);
  arena.place(a.entry, 4 * m + 1);
  arena.place(a.slot, 4 * m);
  arena.place(a.corner, 4 * m);
  for (Four<T>** array : {&a.push, &a.space}) arena.place(*array, 4 * m);
  arena.place(a.margin, 4 * m);
  arena.place(a.rows, ActiveRows<T>::size(plan.capacity));
  a.first_rows = a.rows;
  arena.place(a.row_of, m);
  arena.place(a.pair, m);
  arena.place(a.known_key, m);
  arena.place(a.known_force, m);
  for (int** array : {&a.owner, &a.partner}) arena.place(*array, m);
  arena.place(a.owner_start, owners + 1);
  arena.place(a.owner_near, owners);
  arena.place(a.rigid, b);
  arena.place(a.body_box, b);
  for (T** array : {&a.together, &a.alone, &a.joint, &a.limit}) arena.place(*array, b);
  arena.place(a.joined, b);
  for (unsigned char** array : {&a.own, &a.pinned, &a.moves}) arena.place(*array, b);
  arena.place(a.hand, c);
  arena.place(a.screw, c);
  for (T** array : {&a.share, &a.least, &a.bound}) arena.place(*array, c);
  arena.place(a.barred, c);
  arena.place(a.rigid_collider, plan.rigid ? c : 0);
  const std::int64_t g = components + (plan.rigid ? c : 0);
  for (int** array : {&a.inside, &a.component}) arena.place(*array, v);
  arena.place(a.coarse_body, g);
  arena.place(a.island, g);
  arena.place(a.motion, g);
  arena.place(a.coarse_sum, ContactSums::count * g);
  arena.place(a.newton, 18 * g);
  arena.place(a.matrix, CoarseIsland::entries_of(int(g)));
  for (double** array : {&a.coarse_share, &a.coarse_joint, &a.coarse_limit}) arena.place(*array, g);
  for (int** array : {&a.root, &a.size, &a.first, &a.local, &a.member, &a.component_begin,
                      &a.component_end, &a.coarse_group})
    arena.place(*array, g);
  arena.place(a.side_start, g + 1);
  arena.place(a.side_pair, g > 0 ? 2 * m : 0);
  for (unsigned char** array : {&a.valid, &a.touches, &a.goes}) arena.place(*array, g);
  arena.place(a.couple, g * g);
  arena.place(a.joins, g > 0 ? m : 0);
  arena.place(a.terms, g > 0 ? m : 0);
  arena.place(a.radius, m);
  arena.place(a.most, c + 2);
  arena.place(a.cluster, plan.clusters);
  arena.place(a.group, count_all_groups(plan));
  arena.place(a.near_side, count_near(plan));
  arena.place(a.near_value, count_near(plan));
  arena.place(a.ball_most, b);
  for (unsigned char** array : {&a.itself, &a.wanted, &a.by_hand}) arena.place(*array, b);
  arena.place(a.numbers, 1);
}

constexpr int contact_array_pointers = int(sizeof(ContactArrays<float>) / sizeof(void*));

// The deforming vertices of a step, by internal number: four numbers each, but for `inverse` and `inertia`.
template <class T>
struct BodyState {
  const int *order, *component;  // user's number; component that moves rigidly, or -1
  const T* x;                    // at the start of the step
  T *u, *before;                 // displacement of the iterate, and of the one before
  T *target, *saved,
      *free;  // s; before a coarse correction; of the free iterate, with planes and spheres
  const T *inverse, *inertia;  // every `stride` numbers
  const T* mass;               // by the user's number
  int stride, vertices, components;

  PD_HD static Vec3<T> read(const T* of, int i) {
    const Four<T> f = reinterpret_cast<const Four<T>*>(of)[i];
    return {f.x, f.y, f.z};
  }
  PD_HD static void write(T* to, int i, const Vec3<T>& value) {
    T* p = to + 4 * std::int64_t(i);
    p[0] = value.x, p[1] = value.y, p[2] = value.z;
  }
  PD_HD Vec3<T> place(int i, const Vec3<T>& displacement) const {
    return read(x, i) + displacement;
  }
  // The displacement to a place: the bits of the free iterate where it leads there.
  PD_HD Vec3<T> displacement_to(const Vec3<T>& to, int i) const {
    const Vec3<T> own = read(free, i), there = place(i, own);
    const bool same = there.x == to.x && there.y == to.y && there.z == to.z;
    return same ? own : to - read(x, i);
  }
  PD_HD T inverse_of(int i) const { return inverse[std::int64_t(i) * stride]; }
  PD_HD T inertia_of(int i) const { return inertia[std::int64_t(i) * stride]; }
  PD_HD Vertex<Thread<T>, true> vertex(int i) const {
    return {read(x, i), read(target, i), inertia_of(i), inverse_of(i)};
  }
};

// Poses, forces and numbers of the contact of an environment, for the caller.
template <class T>
struct ContactOutput {
  T* poses;
  std::int64_t* keys;
  T *forces, *held_back, *vertex_forces;
  double* info;
  bool report;

  PD_HD void write_force(int at, std::int64_t key, const Multiplier<T>& of) const {
    keys[at] = key;
    T* const f = forces + 4 * std::int64_t(at);
    f[0] = of.normal, f[1] = of.tangential.x, f[2] = of.tangential.y, f[3] = of.tangential.z;
  }
};

template <class T>
PD_HD ContactOutput<T> contact_output(const ContactCall<T>& contact, std::int64_t e) {
  const ContactPlan<T>& plan = contact.plan;
  const ContactHistory<T>& history = contact.history;
  const std::int64_t c = e * plan.colliders, m = e * plan.capacity;
  return {history.next_poses + 7 * c,
          history.next_keys + m,
          history.next_forces + 4 * m,
          contact.held_back + c,
          contact.forces + 3 * e * plan.vertices,
          contact.info + e * contact_info_count,
          contact.report};
}

// What a team works on.
template <class T>
struct ContactEnvironment {
  const ContactPlan<T>& plan;
  const ContactArrays<T>& a;
  BodyState<T> body;
  Contacts<T> walls;
  const T *poses, *goal_poses;      // [colliders, 7] at the start, and of the step's end
  const std::int64_t* history_key;  // [capacity]
  const T* history_force;           // [capacity, 4]
  const T* rigid;                   // [colliders, 13] as in ContactPlan
  const T* friction;                // [bodies, bodies]

  PD_HD bool held(int v) const { return a.held[v] != 0; }
  // components that move rigidly: those of bodies, then colliders if one has a mass
  PD_HD int components() const { return body.components + (plan.rigid ? plan.colliders : 0); }
  PD_HD int owners() const { return plan.points + plan.edges; }
  PD_HD ContactNumbers& numbers() const { return *a.numbers; }

  PD_HD bool is_stuck(int v) const { return a.limits[v] == limits_stuck; }
  // The half-spaces of the corners of a pair.
  PD_HD void keep_spaces(int p) const {
    const ContactPair<T>& pair = a.pair[p];
    for (int corner = 0; corner < 4; ++corner) {
      const int n = a.slot[4 * p + corner];
      visit_space(pair.plane, pair.on_a(corner), [&](const Vec3<T>& normal, T bound, T margin) {
        a.space[n] = {normal.x, normal.y, normal.z, bound};
        a.margin[n] = margin;
      });
      raise(a.limits + pair.vertex[corner], int(pair.plane.frozen ? limits_stuck : limits_planes));
    }
  }
  // The force of a pair, by entries.
  PD_HD void keep_pushes(int p) const {
    const ContactPair<T>& pair = a.pair[p];
    const Vec3<T> force = multiply_add(pair.force.normal, pair.normal, pair.force.tangential);
    for (int corner = 0; corner < 4; ++corner)
      a.push[a.slot[4 * p + corner]] = {force.x, force.y, force.z, pair.near.weight[corner]};
  }
  // The force of all pairs on a vertex, after keep_pushes.
  PD_HD Vec3<T> force_on(int v) const {
    Vec3<T> force = {T(0), T(0), T(0)};
    for (int n = a.start[v]; n < a.start[v + 1]; ++n) {
      const Four<T> push = a.push[n];
      force = multiply_add(push.w, Vec3<T>{push.x, push.y, push.z}, force);
    }
    return force;
  }
  // calls visit(normal, bound) for the planes and spheres of the scene
  template <class Visit>
  PD_HD void each_wall(int v, const Vec3<T>& place, const Visit& visit) const {
    if (v >= plan.body_vertices || held(v)) return;
    pd::each_wall(walls, place, visit);
  }
  // calls visit(normal, bound, margin) for all half-spaces of a vertex
  template <class Visit>
  PD_HD void each_space(int v, const Visit& visit) const {
    PD_UNROLL_4
    for (int n = a.start[v]; n < a.start[v + 1]; ++n) {
      const Four<T> space = a.space[n];
      visit(Vec3<T>{space.x, space.y, space.z}, space.w, a.margin[n]);
    }
    if (!walls.exist()) return;
    const T here = place_rounding(a.place[v]), there = place_rounding(a.target[v]),
            margin = here < there ? there : here;
    each_wall(v, a.place[v], [&](const Vec3<T>& normal, T bound) { visit(normal, bound, margin); });
  }
};

}  // namespace pd::inline PD_TARGET
