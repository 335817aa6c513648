// Queries and launches through the CUDA runtime.
#pragma once
#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>

namespace pd {

// Throws on an error and clears it, so that a failed launch does not surface in a later call.
void check(cudaError_t status);

// Resident blocks of a kernel on the current device; also raises the kernel's shared memory limit.
// Returns 0 when `shared_bytes` exceeds the limit of the device.
int resident_blocks(const void* kernel, int threads, std::size_t shared_bytes);

// Throws an error that names the shared memory wanted, the limit and the fix.
[[noreturn]] void refuse_shared_memory(std::size_t shared_bytes);

// Resident clusters of `blocks` blocks on the current device; call resident_blocks first. Returns 0
// when the device supports none, or none so large.
int resident_clusters(const void* kernel, int threads, std::size_t shared_bytes, int blocks);

// Whether the current device runs the kernel's code for compute capability 9.0. Code compiled for
// older targets lacks clusters and overlap.
bool runs_code_for_90(const void* kernel);

// Launches clusters of `cluster` blocks; 0 launches cooperatively, with all blocks resident.
void launch(const void* kernel, unsigned blocks, int threads, void** arguments,
            std::size_t shared_bytes, int cluster, cudaStream_t stream);

int multiprocessors();  // of the current device
std::size_t shared_memory_per_multiprocessor();
std::size_t shared_memory_per_block();  // the opt-in limit of one block

// Converts a number of blocks; throws when one launch cannot hold it.
unsigned blocks_of(std::int64_t count);

}  // namespace pd
