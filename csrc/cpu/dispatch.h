// Which compiled instruction set this machine runs.
#pragma once
#include "contact/views.h"
#include "solver/adjoint/pair_views.h"
#include "views/views.h"

#include <string>
#include <vector>

namespace pd {

// One instruction set's compiled physics.
struct Kernels {
  const char* name;
  void (*step32)(const StepCall<float>&, int threads);
  void (*step64)(const StepCall<double>&, int threads);
  void (*contact_step32)(const StepCall<float>&, const ContactCall<float>&, int threads);
  void (*contact_step64)(const StepCall<double>&, const ContactCall<double>&, int threads);
  void (*field32)(const FieldCall<float>&, int threads);
  void (*field64)(const FieldCall<double>&, int threads);
  void (*report32)(const ReportCall<float>&, int threads);
  void (*report64)(const ReportCall<double>&, int threads);
  void (*rotation32)(const RotationCall<float>&, int threads);
  void (*rotation64)(const RotationCall<double>&, int threads);
  void (*precondition32)(const PreconditionCall<float>&, int threads);
  void (*precondition64)(const PreconditionCall<double>&, int threads);
  void (*conjugate32)(const ConjugateCall<float>&, int threads);
  void (*conjugate64)(const ConjugateCall<double>&, int threads);
  void (*adjoint_system32)(const AdjointSystemCall<float>&, int threads);
  void (*adjoint_system64)(const AdjointSystemCall<double>&, int threads);
  void (*contact_gradients32)(const ContactGradientsCall<float>&, int threads);
  void (*contact_gradients64)(const ContactGradientsCall<double>&, int threads);
  void (*adjoint_result32)(const AdjointResultCall<float>&, int threads);
  void (*adjoint_result64)(const AdjointResultCall<double>&, int threads);
  void (*contact_conjugate32)(const ConjugateCall<float>&, int threads);
  void (*contact_conjugate64)(const ConjugateCall<double>&, int threads);
  void (*pair_gradients32)(const PairGradientsCall<float>&, int threads);
  void (*pair_gradients64)(const PairGradientsCall<double>&, int threads);
  void (*flops)(float* seconds, std::int64_t* operations);  // multiply-add loop, for calibration
};

// The fastest instruction set of this processor; the environment variable TORCHPD_SIMD names a slower one for tests.
const Kernels& kernels();

std::vector<std::string> supported_simd();

}  // namespace pd
