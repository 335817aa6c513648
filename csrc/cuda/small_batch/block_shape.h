// Environments and threads per block for a small mesh, without CUDA.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace pd::inline PD_TARGET {

// Threads that fit in a multiprocessor's registers: by default, and with so few registers each that
// some spill.
constexpr int small_batch_threads = 640, few_registers_threads = 768;

constexpr int lanes_of_warp = 32;

// The sizes of a mesh that determine the shape of a block.
struct SmallMesh {
  int pairs, slots;
};

// Shape of a block: its environments and threads.
struct SmallBatchShape {
  int per_block, threads;
  bool few_registers;

  int warps() const { return threads / lanes_of_warp; }
  int rounds(int each) const { return (per_block * each + threads - 1) / threads; }
  bool once(const SmallMesh& mesh) const { return rounds(mesh.pairs) == 1; }

  // Time of an iteration of `blocks` blocks on a multiprocessor: a block's latency plus the issue
  // time of all blocks. The unit is the issue time of a warp's round of pairs. A kernel with one
  // pair per thread (`single`) issues a sixth less; `few_registers` adds a twelfth.
  double time(const SmallMesh& mesh, int blocks, bool single) const {
    const double many = per_block;
    const double latency = 6 + 8 * rounds(mesh.pairs) + 3.5 * rounds(mesh.slots) +
                           3 * std::ceil(many / warps()) + 0.5 * warps();
    const double issue =
        std::ceil(many * mesh.pairs / lanes_of_warp) * (single ? 1 : 1.2) + 0.1 * many;
    return (latency + blocks * issue) * (few_registers ? 1.08 : 1);
  }
};

// Limits of a device.
struct DeviceLimits {
  int multiprocessors;
  std::size_t shared;        // per multiprocessor
  std::size_t block_shared;  // maximum per block
};

constexpr int most_per_block = 4;

// Calls visit(shape, resident blocks per multiprocessor) for every shape that fits on the device.
// `bytes(per_block)`: shared memory.
template <class Bytes, class Visit>
void each_shape(const SmallMesh& mesh, const DeviceLimits& limits, const Bytes& bytes,
                const Visit& visit) {
  constexpr int most_threads = 224, most_rounds = 2, most_blocks = 32;
  constexpr std::size_t reserved = 1024;  // shared memory that the device reserves per block
  for (int per_block = 1; per_block <= most_per_block; ++per_block) {
    const std::size_t shared = bytes(per_block);
    if (shared > limits.block_shared) return;
    const int fit = std::max(1, int(limits.shared / (shared + reserved)));
    for (int threads = lanes_of_warp; threads <= most_threads; threads += lanes_of_warp) {
      for (const bool few_registers : {false, true}) {
        const SmallBatchShape shape{per_block, threads, few_registers};
        if (shape.rounds(mesh.pairs) > (few_registers ? 1 : most_rounds)) continue;
        const int resident =
            (few_registers ? few_registers_threads : small_batch_threads) / threads;
        visit(shape, std::min({fit, resident, most_blocks}));
      }
    }
  }
}

// The shape for a batch. `time` is fitted to 1800 runs on an H100, with 3 to 192 pairs and batches
// of 1 to 8192. The chosen shape took 0.6 % longer than the best on average, and 6 % at most.
template <class Bytes>
SmallBatchShape small_batch_shape(const SmallMesh& mesh, std::int64_t batch,
                                  const DeviceLimits& limits, const Bytes& bytes) {
  const auto whole = [](std::int64_t a, std::int64_t b) { return (a + b - 1) / b; };
  SmallBatchShape best{};
  double least = HUGE_VAL;
  each_shape(mesh, limits, bytes, [&](const SmallBatchShape& shape, int fit) {
    if (shape.per_block > batch) return;
    const bool single = shape.once(mesh);
    // blocks share the last partial wave equally
    const std::int64_t blocks = std::int64_t(fit) * limits.multiprocessors;
    const std::int64_t waves = batch / (blocks * shape.per_block);
    const std::int64_t left = batch - waves * blocks * shape.per_block, each = whole(left, blocks);
    double time = double(waves) * shape.time(mesh, fit, single);
    if (left > 0) {
      const SmallBatchShape last{int(each), shape.threads, shape.few_registers};
      time += last.time(mesh, int(whole(whole(left, each), limits.multiprocessors)), single);
    }
    // among equal times, the first and smallest `per_block`: larger ones would leave blocks idle
    if (time < least) {
      least = time;
      best = shape;
    }
  });
  return best;
}

// The most environments resident on a device, over all batches and shapes.
template <class Bytes>
std::int64_t most_at_work(const SmallMesh& mesh, const DeviceLimits& limits, const Bytes& bytes) {
  std::int64_t most = 0;
  each_shape(mesh, limits, bytes, [&](const SmallBatchShape& shape, int fit) {
    most = std::max(most, std::int64_t(fit) * limits.multiprocessors * shape.per_block);
  });
  return most;
}

}  // namespace pd::inline PD_TARGET
