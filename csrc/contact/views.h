// What contact between bodies reads and writes: surfaces of all bodies in one array of vertices, colliders last.
#pragma once
#include <cstdint>

namespace pd {

constexpr int rigid_numbers = 13;

// The constant arrays of a scene with contact. Vertices have the user's numbers, those of bodies first.
template <class T>
struct ContactPlan {
  const int *triangle, *edge, *point;  // [triangles, 3], [edges, 2], [points]
  const int *body, *collider;          // [vertices]; -1 for vertices of bodies
  const int* touches_itself;           // [bodies]
  // Clusters of up to 32 sides of one body: of points, then of edges, then of triangles. A cluster
  // has the numbers of its sides, -1 past the last one, and their corners, the last one repeated.
  const int *leaves, *cluster_body;       // [clusters, 4, 32]; [clusters]
  const int *body_start, *surface_start;  // [bodies + 1] first vertex; first row of `point`
  const std::int64_t*
      rest_key;             // [rest_pairs] of pairs that are closer than 2 r at rest, increasing
  const T* rest_thickness;  // [rest_pairs]
  // [body_vertices, 3] about the middle of the surface of each body; [bodies] least distance of parts of a solid that share
  // no vertex, or 0
  const T *rest, *rest_apart;
  const T *local, *cell;  // [vertices, 3] of colliders; [vertices]
  const T* friction;      // [bodies, bodies], or one table for each environment
  // [batch, colliders, 13] m / h^2, centre of mass, moment of inertia over h^2 (xx xy xz yy yz zz) and angular momentum over
  // h, about that centre in world axes; 0 for colliders without a mass; null if none has
  const T* rigid = nullptr;
  int vertices = 0, body_vertices = 0, triangles = 0, edges = 0, points = 0, bodies = 0,
      colliders = 0, capacity = 0, clusters = 0, point_clusters = 0, edge_clusters = 0;
  std::int64_t rest_pairs = 0;
  std::int64_t friction_stride =
      0;  // from the friction of an environment to that of the next; 0: all have one
  T thickness = 0;
  bool can_be_free = false;  // whether all bodies that may meet themselves have `rest_apart`
};

// What a step leaves for the next one, of every environment.
template <class T>
struct ContactHistory {
  const T* poses;            // [batch, colliders, 7]
  const std::int64_t* keys;  // [batch, capacity], increasing, -1 pads at the end
  const T* forces;           // [batch, capacity, 4]: lambda, lambda_t
  T* next_poses;
  std::int64_t* next_keys;
  T* next_forces;
};

// Numbers about the contact of an environment in the last step.
enum ContactInfo : int {
  contact_gap,             // least d / r, inf without pairs
  contact_overflow,        // pairs that the capacity lacks
  contact_pins_held_back,  // m
  // share of the forces that is not balanced, of colliders with a mass, and from the op the larger of it and that of bodies;
  // NaN unless requested
  contact_residual,
  contact_pairs,  // most pairs in a list
  contact_searches,
  contact_shortened,  // vertices whose way was cut, summed over iterations
  contact_frozen,     // vertices that no plane let move, summed over iterations
  contact_info_count
};

template <class T>
struct ContactCall {
  ContactPlan<T> plan;
  ContactHistory<T> history;
  const T*
      poses;  // [batch, colliders, 7] at the step's end; of colliders with a mass, at that of their free motion
  double* info;  // [batch, contact_info_count]
  T* held_back;  // [batch, colliders] m
  T* forces;     // [batch, vertices, 3] N of contact on every vertex at the end of the step
  bool report;   // whether the residual is wanted
};

}  // namespace pd
