// What the adjoint of a step reads of the pairs with forces at its end, and what it writes.
#pragma once
#include "contact/views.h"
#include "views/views.h"

#include <cstdint>

namespace pd {

// All of [batch, ...]; bodies by the user's numbers.
template <class T>
struct LoadedPairs {
  ContactPlan<T> plan;
  const T *before, *after;  // [vertices, 3] of bodies
  // [colliders, 7]; free: where colliders go that nothing is in the way of
  const T *poses_before, *poses_after, *poses_free;
  const std::int64_t* keys;  // [capacity], -1 pads at the end
  const T* forces;           // [capacity, 4]
  std::int64_t most = 0;     // loaded pairs of any environment, or more
};

// Derivatives of a loss by what the pairs of a solved adjoint depend on.
template <class T>
struct PairGradients {
  T *end, *start;  // [batch, vertices, 3] of bodies: K^T l + C^T nu, by the places then
  T *poses_end,
      *poses_start;  // [batch, colliders, 7], as if all colliders moved by hand at the end
  // of colliders with a mass that leave their free motion, else 0: [batch, colliders, 7], and 13
  T *poses_free, *rigid;
  T* friction;   // [batch, bodies, bodies]
  T* thickness;  // [batch]
};

// A solved adjoint, as in a ConjugateCall; [batch, vertices, 3] each. Colliders with a mass are two vertices more.
template <class T>
struct PairGradientsCall {
  using real = T;
  const int* vertex_order;  // of a plan
  int vertices = 0;
  LoadedPairs<T> pairs;
  Values<T> inertia, inverse;  // [vertices]
  std::int64_t batch = 0;
  const T *right, *multiplier;
  const T* elastic;              // elastic Hessian times the multiplier
  const T *projector, *sliding;  // may be null
  PairGradients<T> out;
};

}  // namespace pd
