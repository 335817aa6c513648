// Entry points of the motion of colliders with a mass (solver/contact/rigid_motion.h).
#pragma once
#include "contact/motion_views.h"
#include "cuda/common/launch.h"

namespace pd::inline PD_TARGET {

template <class Motion, class T>
void run_find_motion(const RigidMotionCall<T>& call, Stream stream);
template <class Motion, class T>
void run_differentiate_motion(const RigidMotionCall<T>& call, Stream stream);

}  // namespace pd::inline PD_TARGET
