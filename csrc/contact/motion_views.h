// What the motion of colliders with a mass reads and writes (solver/contact/rigid_motion.h).
#pragma once
#include "contact/views.h"

#include <cstdint>

namespace pd {

// Numbers of a collider in the arrays of a call.
constexpr int motion_pose = 7;  // place of the origin [m], unit quaternion (w, x, y, z)
constexpr int motion_rates =
    6;  // m/s of the centre of mass; rad/s or, in `rates`, kg m^2/s about it
constexpr int motion_wrench = 6;   // N, then N m about the origin
constexpr int motion_gravity = 3;  // m/s^2
// kg, 0 for colliders without a mass; centre of mass [m] and moment of inertia about it [kg m^2] (xx xy xz yy yz zz), in
// axes of the collider
constexpr int motion_body = 10;
constexpr int motion_row = rigid_numbers;
constexpr int motion_arrays = 6, motion_results = 3;

// [batch, colliders, numbers], which may be expanded; null: zeros.
template <class T>
struct MotionArray {
  const T* data = nullptr;
  std::int64_t of_environment = 0, of_collider = 0, of_number = 0;  // strides
};

template <class T>
struct RigidMotionCall {
  MotionArray<T> in[motion_arrays];
  const T* gradient[motion_results] = {};  // [batch, colliders, numbers] of each result
  T* out[motion_results] =
      {};  // results; or [batch, colliders, numbers], by all numbers that are read
  std::int64_t batch = 0, colliders = 0;
  double time_step = 0;
};

}  // namespace pd
