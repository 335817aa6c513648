#include "cuda/contact/rigid_motion.h"

#include "cuda/common/runtime.h"
#include "solver/contact/rigid_motion.h"

namespace pd::inline PD_TARGET {

constexpr int motion_threads = 64;

// One thread per collider.
template <class Motion, class T>
__global__ void __launch_bounds__(motion_threads)
    find_motions(const __grid_constant__ RigidMotionCall<T> call) {
  const std::int64_t row = std::int64_t(blockIdx.x) * motion_threads + threadIdx.x;
  if (row < call.batch * call.colliders) find_motion<Motion>(call, row);
}

// One thread per collider and number that it reads.
template <class Motion, class T>
__global__ void __launch_bounds__(motion_threads)
    differentiate_motions(const __grid_constant__ RigidMotionCall<T> call) {
  const std::int64_t thread = std::int64_t(blockIdx.x) * motion_threads + threadIdx.x,
                     row = thread / Motion::inputs;
  if (row < call.batch * call.colliders)
    differentiate_motion<Motion>(call, row, int(thread % Motion::inputs));
}

template <class T>
void run_motions(void (*kernel)(RigidMotionCall<T>), const RigidMotionCall<T>& call,
                 std::int64_t threads, Stream stream) {
  const unsigned blocks = blocks_of((threads + motion_threads - 1) / motion_threads);
  kernel<<<blocks, motion_threads, 0, static_cast<cudaStream_t>(stream)>>>(call);
  check(cudaGetLastError());
}

template <class Motion, class T>
void run_find_motion(const RigidMotionCall<T>& call, Stream stream) {
  run_motions(find_motions<Motion, T>, call, call.batch * call.colliders, stream);
}

template <class Motion, class T>
void run_differentiate_motion(const RigidMotionCall<T>& call, Stream stream) {
  run_motions(differentiate_motions<Motion, T>, call, call.batch * call.colliders * Motion::inputs,
              stream);
}

template void run_find_motion<FreeMotionOfRigid>(const RigidMotionCall<float>&, Stream);
template void run_find_motion<FreeMotionOfRigid>(const RigidMotionCall<double>&, Stream);
template void run_find_motion<MotionAfterStep>(const RigidMotionCall<float>&, Stream);
template void run_find_motion<MotionAfterStep>(const RigidMotionCall<double>&, Stream);
template void run_differentiate_motion<FreeMotionOfRigid>(const RigidMotionCall<float>&, Stream);
template void run_differentiate_motion<FreeMotionOfRigid>(const RigidMotionCall<double>&, Stream);
template void run_differentiate_motion<MotionAfterStep>(const RigidMotionCall<float>&, Stream);
template void run_differentiate_motion<MotionAfterStep>(const RigidMotionCall<double>&, Stream);

}  // namespace pd::inline PD_TARGET
