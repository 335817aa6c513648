// How many environments of a small mesh a block has, and with how many threads: known without a GPU.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace pd {

// Threads that a multiprocessor has registers for: usually, and with so few each that some are spilled.
constexpr int several_threads = 640, lean_threads = 768;

constexpr int lanes_of_warp = 32;

// A mesh as the shape of a block is chosen for it.
struct SmallMesh {
  int pairs, slots;
};

// A block: how many environments it has, and with how many threads.
struct SeveralShape {
  int together, threads;
  bool lean;

  int warps() const { return threads / lanes_of_warp; }
  int rounds(int each) const { return (together * each + threads - 1) / threads; }
  bool once(const SmallMesh& mesh) const { return rounds(mesh.pairs) == 1; }

  // Time of an iteration of so many blocks on a multiprocessor, in units of what its warps' rounds of pairs take to issue: what a
  // block waits for, and what all of them issue. Where no thread has a second pair a sixth less, with few registers a twelfth more.
  double time(const SmallMesh& mesh, int blocks) const {
    const double many = together;
    const double waits = 6 + 8 * rounds(mesh.pairs) + 3.5 * rounds(mesh.slots) +
                         3 * std::ceil(many / warps()) + 0.5 * warps();
    const double issues =
        std::ceil(many * mesh.pairs / lanes_of_warp) * (once(mesh) ? 1 : 1.2) + 0.1 * many;
    return (waits + blocks * issues) * (lean ? 1.08 : 1);
  }
};

// The shape for a batch, of `bytes(together)` of shared memory. `time` is fitted to 1800 runs on an H100, of 3 to 192 pairs in
// batches of 1 to 8192; what this chooses took 0.6 % more than the best shape on average and 6 % at most.
template <class Bytes>
SeveralShape several_shape(const SmallMesh& mesh, std::int64_t batch, int multiprocessors,
                           std::size_t shared_memory, std::size_t most_shared, const Bytes& bytes) {
  constexpr int most_together = 4, most_threads = 224, most_rounds = 2, most_blocks = 32;
  constexpr std::size_t reserved = 1024;  // of shared memory, that the device keeps of every block
  const auto whole = [](std::int64_t a, std::int64_t b) { return (a + b - 1) / b; };
  SeveralShape best{};
  double least = HUGE_VAL;
  for (int together = 1; together <= std::min<std::int64_t>(most_together, batch); ++together) {
    const std::size_t shared = bytes(together);
    if (shared > most_shared) break;
    for (int threads = lanes_of_warp; threads <= most_threads; threads += lanes_of_warp) {
      for (const bool lean : {false, true}) {
        const SeveralShape shape{together, threads, lean};
        const int rounds = shape.rounds(mesh.pairs);
        if (rounds > (lean ? 1 : most_rounds)) continue;
        const int fit = std::min({(lean ? lean_threads : several_threads) / threads, most_blocks,
                                  int(shared_memory / (shared + reserved))});
        if (fit == 0) continue;
        // the last of what blocks do together they share out equally
        const std::int64_t blocks = std::int64_t(fit) * multiprocessors;
        const std::int64_t waves = batch / (blocks * together);
        const std::int64_t left = batch - waves * blocks * together, each = whole(left, blocks);
        double time = double(waves) * shape.time(mesh, fit);
        if (left > 0)
          time += SeveralShape{int(each), threads, lean}.time(
              mesh, int(whole(whole(left, each), multiprocessors)));
        if (time < least) {
          least = time;
          best = shape;
        }
      }
    }
  }
  return best;
}

}  // namespace pd
