#include "cuda/runtime.h"

#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <tuple>

namespace pd {

void check(cudaError_t status) {
  if (status == cudaSuccess) return;
  cudaGetLastError();
  throw std::runtime_error(std::string("torchpd: CUDA says: ") + cudaGetErrorString(status));
}

static int ask_for_resident_blocks(const void* kernel, int device, int threads,
                                   std::size_t shared_bytes) {
  int most_shared = 0, multiprocessors = 0, blocks = 0;
  check(cudaDeviceGetAttribute(&most_shared, cudaDevAttrMaxSharedMemoryPerBlockOptin, device));
  check(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, device));
  cudaFuncAttributes attributes;
  check(cudaFuncGetAttributes(&attributes, kernel));
  const int most_dynamic = most_shared - int(attributes.sharedSizeBytes);
  if (shared_bytes > std::size_t(most_dynamic)) return 0;
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, most_dynamic));
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernel, threads, shared_bytes));
  return blocks * multiprocessors;
}

int resident_blocks(const void* kernel, int threads, std::size_t shared_bytes) {
  static std::mutex lock;
  static std::map<std::tuple<const void*, int, int, std::size_t>, int> known;
  int device = 0;
  check(cudaGetDevice(&device));
  const std::lock_guard guard(lock);
  const auto [found, is_new] = known.try_emplace({kernel, device, threads, shared_bytes}, 0);
  if (is_new) {
    try {
      found->second = ask_for_resident_blocks(kernel, device, threads, shared_bytes);
    } catch (...) {
      known.erase(found);
      throw;
    }
  }
  return found->second;
}

std::size_t shared_memory_per_multiprocessor() {
  int device = 0, bytes = 0;
  check(cudaGetDevice(&device));
  check(cudaDeviceGetAttribute(&bytes, cudaDevAttrMaxSharedMemoryPerMultiprocessor, device));
  return std::size_t(bytes);
}

unsigned blocks_of(std::int64_t count) {
  if (count > 0x7fffffff)
    throw std::runtime_error("torchpd: the batch needs " + std::to_string(count) +
                             " blocks, more than one launch can have; split it");
  return unsigned(count);
}

}  // namespace pd
