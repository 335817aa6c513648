// The pairs of bodies in contact in the solve of an environment by a team of blocks.
#pragma once
#include "cuda/adjoint/pair_team.cuh"
#include "cuda/common/launch.h"
#include "solver/adjoint/pairs.h"
#include "views/arena.h"

#include <algorithm>

namespace pd::inline PD_TARGET {

// Memory of all teams for pairs, of the same size each.
struct PairArena {
  std::byte* memory = nullptr;
  std::int64_t stride = 0;

  template <class T>
  PD_HD static void arrange(Arena& arena, const LoadedPairs<T>& pairs, PairMemory& memory,
                            PairFactors& factors) {
    const PairSizes sizes = pair_sizes(pairs);
    memory.arrange(arena, sizes);
    factors.arrange(arena, sizes.rows() * sizes.columns(), sizes.columns() * sizes.columns());
  }
};

template <class T>
std::int64_t bytes_of_pairs(const LoadedPairs<T>& pairs) {
  Arena arena(nullptr);
  PairMemory memory;
  PairFactors factors;
  PairArena::arrange(arena, pairs, memory, factors);
  return arena.size();
}

// Teams whose pairs have place in all.
template <class T>
std::int64_t most_teams(const LoadedPairs<T>& pairs) {
  return std::max<std::int64_t>(1, most_pair_bytes / bytes_of_pairs(pairs));
}

// A Work that adds the pairs to another one.
template <class Base>
struct WithPairs : Base {
  static constexpr bool has_pairs = true;
  LoadedPairs<typename Base::real> pairs;
  PairArena arena;
};

// Where the arrays of a team are, in shared memory.
struct PairPlaces {
  PairMemory memory;
  PairFactors factors;
};

// Nothing, without pairs.
template <class Work, bool = Work::has_pairs>
struct BodyPairs {
  __device__ BodyPairs(const Work&, BlockTeam&, const PairPlaces*, std::int64_t) {}
};

template <class Work>
struct BodyPairs<Work, true> {
  using T = typename Work::real;

  PairTeam team;
  const PairPlaces& places;
  AdjointPairs<T, PairTeam> all;

  __device__ BodyPairs(const Work& work, BlockTeam& blocks, const PairPlaces* at,
                       std::int64_t environment)
      : team(blocks),
        places(*at),
        all(work.pairs, work.call.plan.vertex_order, team, at->memory, environment) {}

  static __device__ Vec3<double> in_double(const Vec3<T>& a) {
    return {double(a.x), double(a.y), double(a.z)};
  }
  static __device__ void add(Quad<T>& to, const Vec3<double>& a) {
    to = quad(Vec3<T>{T(double(to.x) + a.x), T(double(to.y) + a.y), T(double(to.z) + a.z)}, to.w);
  }

  // The part of a field that no pair takes.
  __device__ void leave(Quad<T>* field) const {
    all.rows().project([&](int i) { return in_double(vec3(field[i])); },
                       [&](int i, const Vec3<double>& a) { add(field[i], a); });
  }
  // Moves that the forces of all pairs do not resist.
  __device__ void slant(int rounds, Quad<T>* field) const {
    all.rows().slant(
        rounds, [&](int i) { return in_double(vec3(field[i])); },
        [&](int i, const Vec3<double>& a) { add(field[i], a); });
  }
  // Adds what the pairs have of the matrix, transposed or by its positive part, times a field.
  template <class Field, class Projector>
  __device__ void multiply(bool positive, const Field& field, const Projector& projector,
                           Quad<T>* to) const {
    all.multiply(
        positive, [&](int i) { return in_double(field(i)); },
        [&](int i, const Vec3<double>& a) {
          const Vec3<T> free = project(Vec3<T>{T(a.x), T(a.y), T(a.z)}, projector(i));
          to[i] = quad(vec3(to[i]) + free, to[i].w);
        });
  }
};

}  // namespace pd::inline PD_TARGET
