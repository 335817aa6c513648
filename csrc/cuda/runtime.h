// What the launches ask of the CUDA runtime.
#pragma once
#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>

namespace pd {

// Throws what went wrong; the error of a launch does not stay behind to surprise others.
void check(cudaError_t status);

// Blocks of a kernel that the current device runs at once; also lets it have that much shared memory. 0: too much for it.
int resident_blocks(const void* kernel, int threads, std::size_t shared_bytes);

// Throws that a patch wants too much, and what to do; the plan is for a device that has more.
[[noreturn]] void refuse_shared_memory(std::size_t shared_bytes);

// Clusters of so many blocks that the current device runs at once, after resident_blocks; 0: it has none, or none so large.
int resident_clusters(const void* kernel, int threads, std::size_t shared_bytes, int blocks);

// Whether the current device runs a kernel's code for compute capability 9.0: older code, translated for it, lacks what is new.
bool runs_code_for_90(const void* kernel);

// Launches clusters of `cluster` blocks; with 0 instead blocks that are all there at once.
void launch(const void* kernel, unsigned blocks, int threads, void** arguments,
            std::size_t shared_bytes, int cluster, cudaStream_t stream);

int multiprocessors();  // of the current device
std::size_t shared_memory_per_multiprocessor();
std::size_t shared_memory_per_block();  // the most that one may ask for

// A number of blocks, refused when one launch cannot have so many.
unsigned blocks_of(std::int64_t count);

}  // namespace pd
