#include "cuda/common/runtime.h"

#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <tuple>

namespace pd {

// The fix, when this build has no code for the current device.
static std::string remedy(cudaError_t status) {
  if (status != cudaErrorNoKernelImageForDevice && status != cudaErrorInvalidDeviceFunction &&
      status != cudaErrorUnsupportedPtxVersion)
    return "";
  int device = 0, major = 0, minor = 0;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device);
  cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, device);
  const std::string capability = std::to_string(major) + "." + std::to_string(minor);
  return "; this build has no code for the GPU, of compute capability " + capability +
         ": build torchpd again with TORCH_CUDA_ARCH_LIST=" + capability + " in the environment";
}

void check(cudaError_t status) {
  if (status == cudaSuccess) return;
  const std::string words = cudaGetErrorString(status) + remedy(status);
  cudaGetLastError();
  throw std::runtime_error("torchpd: CUDA says: " + words);
}

void refuse_shared_memory(std::size_t shared_bytes) {
  throw std::runtime_error("torchpd: a patch of the plan wants " + std::to_string(shared_bytes) +
                           " bytes of shared memory, and a block of this device has up to " +
                           std::to_string(shared_memory_per_block()) +
                           ": the plan is for another GPU; sim.to(\"cpu\").to(\"cuda\") "
                           "compiles the scene for this one");
}

static int query_resident_blocks(const void* kernel, int device, int threads,
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

// Caches a query by device and launch configuration; every `Query` type has a cache of its own.
template <class Query>
static int cached(const void* kernel, int threads, std::size_t shared_bytes, int cluster,
                  const Query& query) {
  static std::mutex lock;
  static std::map<std::tuple<const void*, int, int, std::size_t, int>, int> results;
  int device = 0;
  check(cudaGetDevice(&device));
  const std::lock_guard guard(lock);
  const std::tuple key{kernel, device, threads, shared_bytes, cluster};
  if (const auto found = results.find(key); found != results.end()) return found->second;
  return results[key] = query(device);
}

int resident_blocks(const void* kernel, int threads, std::size_t shared_bytes) {
  return cached(kernel, threads, shared_bytes, 0, [&](int device) {
    return query_resident_blocks(kernel, device, threads, shared_bytes);
  });
}

// A launch whose blocks synchronise, with the attribute that its configuration points to: clusters,
// or with `cluster` 0 a cooperative launch.
struct GroupLaunch {
  cudaLaunchAttribute attribute = {};
  cudaLaunchConfig_t config = {};

  GroupLaunch(unsigned blocks, int threads, std::size_t shared_bytes, int cluster) {
    attribute.id = cluster ? cudaLaunchAttributeClusterDimension : cudaLaunchAttributeCooperative;
    if (cluster) {
      attribute.val.clusterDim.x = unsigned(cluster);
      attribute.val.clusterDim.y = attribute.val.clusterDim.z = 1;
    } else {
      attribute.val.cooperative = 1;
    }
    config.gridDim = dim3(blocks);
    config.blockDim = dim3(unsigned(threads));
    config.dynamicSmemBytes = shared_bytes;
    config.attrs = &attribute;
    config.numAttrs = 1;
  }
  GroupLaunch(const GroupLaunch&) = delete;
};

static bool has_code_for_90(const void* kernel, int device) {
  int major = 0;
  check(cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device));
  cudaFuncAttributes attributes;
  check(cudaFuncGetAttributes(&attributes, kernel));
  constexpr int first = 90;
  return major * 10 >= first && attributes.ptxVersion >= first && attributes.binaryVersion >= first;
}

bool runs_code_for_90(const void* kernel) {
  return cached(kernel, 0, 0, 0,
                [&](int device) { return int(has_code_for_90(kernel, device)); }) != 0;
}

static int query_resident_clusters(const void* kernel, int device, int threads,
                                   std::size_t shared_bytes, int blocks) {
  int clusters = 0;
  if (!has_code_for_90(kernel, device)) return 0;
  constexpr int portable = 8;
  if (blocks > portable &&
      cudaFuncSetAttribute(kernel, cudaFuncAttributeNonPortableClusterSizeAllowed, 1) !=
          cudaSuccess) {
    cudaGetLastError();
    return 0;
  }
  const GroupLaunch launch(unsigned(blocks), threads, shared_bytes, blocks);
  if (cudaOccupancyMaxActiveClusters(&clusters, kernel, &launch.config) != cudaSuccess) {
    cudaGetLastError();
    return 0;
  }
  return clusters;
}

int resident_clusters(const void* kernel, int threads, std::size_t shared_bytes, int blocks) {
  return cached(kernel, threads, shared_bytes, blocks, [&](int device) {
    return query_resident_clusters(kernel, device, threads, shared_bytes, blocks);
  });
}

void launch(const void* kernel, unsigned blocks, int threads, void** arguments,
            std::size_t shared_bytes, int cluster, cudaStream_t stream) {
  GroupLaunch group(blocks, threads, shared_bytes, cluster);
  group.config.stream = stream;
  check(cudaLaunchKernelExC(&group.config, kernel, arguments));
}

static int device_attribute(cudaDeviceAttr which) {
  int device = 0, value = 0;
  check(cudaGetDevice(&device));
  check(cudaDeviceGetAttribute(&value, which, device));
  return value;
}

int multiprocessors() { return device_attribute(cudaDevAttrMultiProcessorCount); }

std::size_t shared_memory_per_multiprocessor() {
  return std::size_t(device_attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor));
}

std::size_t shared_memory_per_block() {
  return std::size_t(device_attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin));
}

unsigned blocks_of(std::int64_t count) {
  constexpr std::int64_t most = 0x7fffffff;
  if (count > most)
    throw std::runtime_error("torchpd: the batch needs " + std::to_string(count) +
                             " thread blocks, and one launch has up to " + std::to_string(most) +
                             ": split it into several calls");
  return unsigned(count);
}

}  // namespace pd
