// Arrays of the loaded pairs of one environment in the adjoint of its step.
#pragma once
#include "contact/pairs/curvature.h"
#include "solver/adjoint/rigid_nodes.h"

#include <cstdint>

namespace pd::inline PD_TARGET {

// Unknowns that a pair has at most: of three vertices of a body, and both of a collider with a mass.
constexpr int most_slots = 5;

// A pair, its multipliers and the derivatives by its corners at the end.
//
// Nodes are the vertices of bodies by the internal numbers of a plan, then two of each collider in scenes with masses
// (solver/adjoint/rigid_nodes.h). The slots of a pair are its nodes: one a vertex of a body, two a side of a collider that
// moves.
struct PairItem {
  int vertex[4];
  int slot[4];             // of each corner, the first of two, -1: of none
  Vec3<double> arm[4];     // of corners of colliders that move: from the centre, over the size
  int node[most_slots];    // -1 pads
  int corner[most_slots];  // the first one
  int moves[most_slots];   // its node, -1 where it does not move
  LoadedPair<double> pair;
  PairSlopes<double> slopes;
  double step;  // of its multipliers in a sweep
  int bodies;   // place in the table of friction
  bool has_scene_thickness;
};

// Rows that share no vertex with others, directly or through others.
struct PairPatch {
  int begin, end;  // rows
  int first_pivot, rank;
  std::int64_t low, square;  // places in PairFactors
};

struct PairCounts {
  int pairs, rows, patches, pivots;
  int changed;               // labels
  int skewed;                // rows whose B differs from C
  std::int64_t low, square;  // numbers of the factors, at most
};

// Of one environment, at most.
struct PairSizes {
  std::int64_t vertices = 0;   // of bodies
  std::int64_t colliders = 0;  // in scenes with masses
  std::int64_t keys = 0;       // of the history
  std::int64_t pairs = 0;      // loaded ones
  std::int64_t bodies = 0;

  PD_HD std::int64_t nodes() const { return vertices + 2 * colliders; }
  PD_HD int slots() const { return colliders > 0 ? most_slots : 4; }
  PD_HD std::int64_t rows() const { return 3 * pairs; }
  PD_HD std::int64_t columns() const { return rows() < 3 * nodes() ? rows() : 3 * nodes(); }
};

struct PairMemory {
  int slots;  // of a pair
  PairItem* item;
  RigidNode* rigid;            // [colliders]
  int *first, *end;            // [pairs] rows
  Vec3<double>*held, *pushed;  // [slots rows] C and B at the nodes that move
  int *of_item, *as_pivot;     // [rows] item, and number among the independent rows, or -1
  int* moves;                  // [slots rows] nodes that move, or -1
  PairPatch* patch;
  int* slot;                  // [keys + 1] items before each key
  int* internal;              // [vertices] internal numbers of the user's
  int *start, *entry;         // of the nodes: slots item + slot
  int *least, *cursor;        // [nodes]
  int *label, *other, *size;  // [pairs]
  int *pivot, *of_patch;      // [columns] rows, and patches
  int* order;                 // [columns]
  PairCounts* counts;
  double* inverse;                                // [nodes] 1 / D
  double* spread;                                 // [nodes]
  Vec3<double>* field;                            // [nodes]
  Vec3<double>*part, *part_of_start;              // [4 pairs]
  double *whole, *left, *column, *along, *found;  // [rows]
  double *sums, *turned;                          // [columns]
  double* friction;                               // [bodies, bodies]

  template <class Arena>
  PD_HD void arrange(Arena& arena, const PairSizes& s) {
    slots = s.slots();
    arena.place(item, s.pairs);
    arena.place(rigid, s.colliders);
    for (int** array : {&first, &end}) arena.place(*array, s.pairs);
    for (Vec3<double>** array : {&held, &pushed}) arena.place(*array, slots * s.rows());
    for (int** array : {&of_item, &as_pivot}) arena.place(*array, s.rows());
    arena.place(moves, slots * s.rows());
    arena.place(patch, s.pairs);
    arena.place(slot, s.keys + 1);
    arena.place(internal, s.vertices);
    arena.place(start, s.nodes() + 1);
    arena.place(entry, slots * s.pairs);
    for (int** array : {&least, &cursor}) arena.place(*array, s.nodes());
    for (int** array : {&label, &other, &size}) arena.place(*array, s.pairs);
    for (int** array : {&pivot, &of_patch, &order}) arena.place(*array, s.columns());
    arena.place(counts, 1);
    arena.place(inverse, s.nodes());
    arena.place(spread, s.nodes());
    arena.place(field, s.nodes());
    for (Vec3<double>** array : {&part, &part_of_start}) arena.place(*array, 4 * s.pairs);
    for (double** array : {&whole, &left, &column, &along, &found}) arena.place(*array, s.rows());
    for (double** array : {&sums, &turned}) arena.place(*array, s.columns());
    arena.place(friction, s.bodies * s.bodies);
  }
};

// Factors of all patches: L by columns [rank, rows], and per patch [rank, rank] of both squares.
struct PairFactors {
  double* low;
  double* inverse_lower;  // of L_r: below the diagonal, and mirrored above
  double* mixed;          // the inverse of L^T B^T D^-1 C_r^T

  template <class Arena>
  PD_HD void arrange(Arena& arena, std::int64_t low_count, std::int64_t square_count) {
    arena.place(low, low_count);
    arena.place(inverse_lower, square_count);
    arena.place(mixed, square_count);
  }
};

}  // namespace pd::inline PD_TARGET
