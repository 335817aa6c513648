// How many environments of a small mesh a block has, and with how many threads: known without a GPU.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace pd {

// Threads that a multiprocessor has registers for: usually, and with so few each that some are spilled.
constexpr int small_batch_threads = 640, few_registers_threads = 768;

constexpr int lanes_of_warp = 32;

// A mesh as the shape of a block is chosen for it.
struct SmallMesh {
  int pairs, slots;
};

// A block: how many environments it has, and with how many threads.
struct SmallBatchShape {
  int per_block, threads;
  bool few_registers;

  int warps() const { return threads / lanes_of_warp; }
  int rounds(int each) const { return (per_block * each + threads - 1) / threads; }
  bool once(const SmallMesh& mesh) const { return rounds(mesh.pairs) == 1; }

  // Time of an iteration of so many blocks on a multiprocessor, in units of what its warps' rounds of pairs take to issue: what a
  // block waits for, and what all of them issue. In a kernel for one pair a thread (`single`) they issue a sixth less; with few
  // registers all takes a twelfth more.
  double time(const SmallMesh& mesh, int blocks, bool single) const {
    const double many = per_block;
    const double latency = 6 + 8 * rounds(mesh.pairs) + 3.5 * rounds(mesh.slots) +
                           3 * std::ceil(many / warps()) + 0.5 * warps();
    const double issue =
        std::ceil(many * mesh.pairs / lanes_of_warp) * (single ? 1 : 1.2) + 0.1 * many;
    return (latency + blocks * issue) * (few_registers ? 1.08 : 1);
  }
};

// What a device has for blocks.
struct DeviceLimits {
  int multiprocessors;
  std::size_t shared;        // memory of a multiprocessor,
  std::size_t block_shared;  // and the most of a block
};

constexpr int most_per_block = 4;

// visit(shape, blocks that a multiprocessor runs), for every shape that a device has room for; `bytes(together)`: of shared memory.
template <class Bytes, class Visit>
void each_shape(const SmallMesh& mesh, const DeviceLimits& limits, const Bytes& bytes,
                const Visit& visit) {
  constexpr int most_threads = 224, most_rounds = 2, most_blocks = 32;
  constexpr std::size_t reserved = 1024;  // of shared memory, that the device keeps of every block
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

// The shape for a batch. `time` is fitted to 1800 runs on an H100, of 3 to 192 pairs in batches of 1 to 8192; what this chooses
// took 0.6 % more than the best shape on average and 6 % at most.
template <class Bytes>
SmallBatchShape small_batch_shape(const SmallMesh& mesh, std::int64_t batch,
                                  const DeviceLimits& limits, const Bytes& bytes) {
  const auto whole = [](std::int64_t a, std::int64_t b) { return (a + b - 1) / b; };
  SmallBatchShape best{};
  double least = HUGE_VAL;
  each_shape(mesh, limits, bytes, [&](const SmallBatchShape& shape, int fit) {
    if (shape.per_block > batch) return;
    const bool single = shape.once(mesh);
    // the last of what blocks do together they share out equally
    const std::int64_t blocks = std::int64_t(fit) * limits.multiprocessors;
    const std::int64_t waves = batch / (blocks * shape.per_block);
    const std::int64_t left = batch - waves * blocks * shape.per_block, each = whole(left, blocks);
    double time = double(waves) * shape.time(mesh, fit, single);
    if (left > 0) {
      const SmallBatchShape last{int(each), shape.threads, shape.few_registers};
      time += last.time(mesh, int(whole(whole(left, each), limits.multiprocessors)), single);
    }
    // of as good ones the one that shares the least: the others would leave blocks without any
    if (time < least) {
      least = time;
      best = shape;
    }
  });
  return best;
}

// Environments that a device works on at a time, at most, whatever the batch and so the shape.
template <class Bytes>
std::int64_t most_at_work(const SmallMesh& mesh, const DeviceLimits& limits, const Bytes& bytes) {
  std::int64_t most = 0;
  each_shape(mesh, limits, bytes, [&](const SmallBatchShape& shape, int fit) {
    most = std::max(most, std::int64_t(fit) * limits.multiprocessors * shape.per_block);
  });
  return most;
}

}  // namespace pd
