#include "cpu/dispatch.h"

#include <cstdlib>
#include <stdexcept>

namespace pd {

extern const Kernels kernels_avx512, kernels_avx2, kernels_portable;

static std::vector<const Kernels*> supported() {
  std::vector<const Kernels*> found;
#if defined(__x86_64__) && !defined(__clang__)
#ifndef TORCHPD_WITHOUT_AVX512
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq")) {
    found.push_back(&kernels_avx512);
  }
#endif
#ifndef TORCHPD_WITHOUT_AVX2
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    found.push_back(&kernels_avx2);
#endif
#endif
  found.push_back(&kernels_portable);
  return found;
}

std::vector<std::string> supported_simd() {
  std::vector<std::string> names;
  for (const Kernels* k : supported()) names.emplace_back(k->name);
  return names;
}

static const Kernels& choose() {
  const char* wanted = std::getenv("TORCHPD_SIMD");
  const auto found = supported();
  if (wanted == nullptr || *wanted == '\0') return *found.front();
  std::string names;
  for (const Kernels* k : found) {
    if (std::string(wanted) == k->name) return *k;
    names += std::string(names.empty() ? "" : ", ") + k->name;
  }
  throw std::runtime_error("TORCHPD_SIMD must be one of " + names + " on this processor, got " +
                           wanted);
}

const Kernels& kernels() {
  static const Kernels& chosen = choose();
  return chosen;
}

}  // namespace pd
