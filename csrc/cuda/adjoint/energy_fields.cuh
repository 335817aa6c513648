// Elastic energy and its derivatives at given positions, in one pass over the patches of any plan.
#pragma once
#include "cuda/common/launch.h"
#include "cuda/common/reductions.h"
#include "cuda/common/runtime.h"
#include "cuda/common/slots.h"
#include "cuda/elements/pair_weights.h"
#include "cuda/elements/pairs_per_thread.h"
#include "elements/solid_fields.h"
#include "views/arena.h"
#include "views/shared_memory.h"

#include <stdexcept>

namespace pd::inline PD_TARGET {

constexpr int field_threads = 256;

template <class T>
PD_HD bool own_weights(const DeviceField<T>& field) {
  return has_own_weights(field.stiffness, field.poisson);
}

template <class T>
struct FieldWork {
  using real = T;
  DeviceField<T> field;
  T* weights;             // [batch or 1, blocks, pair_weights, 32]
  Quad<T>* shared_force;  // [batch or teams, slots]

  __device__ const T* weights_of(std::int64_t environment) const {
    const std::int64_t own = own_weights(field) ? environment : 0;
    return weights + own * field.plan.blocks * pair_weights * pair_lanes;
  }
};

// Writes the result of one vertex.
template <int Numbers, class T>
__device__ void write_vertex(const DeviceField<T>& field, std::int64_t environment, int vertex,
                             const Vec3<T>& force) {
  const DevicePlan<T>& plan = field.plan;
  T* to = field.out + (environment * plan.vertices + plan.vertex_order[vertex]) * Numbers;
  if constexpr (Numbers == 3) {
    write3(to, force);
  } else {
    *to = force.x;
  }
}

template <bool Computed, class T>
__global__ void __launch_bounds__(field_threads)
    field_weights(const __grid_constant__ FieldWork<T> work) {
  const DevicePlan<T>& plan = work.field.plan;
  const std::int64_t set = blockIdx.x / plan.patches;
  const Patch<T> patch(plan, int(blockIdx.x % plan.patches));
  const WeightKind kind = work.field.weighted                   ? WeightKind::majoriser
                          : work.field.field == Field::diagonal ? WeightKind::matrix
                                                                : WeightKind::force;
  compute_patch_weights(patch, rest_of<Computed>(patch),
                        Moduli<T>(work.field.stiffness, work.field.poisson, set), kind,
                        work.weights + set * plan.blocks * pair_weights * pair_lanes);
}

// A patch of one environment in shared memory: positions relative to its first vertex and, with two
// Fields, directions.
template <int Fields, class T>
struct PatchFields {
  std::int64_t environment;
  Patch<T> patch;
  Quad<T>* position;  // by slot, with one field
  Slots<T> both;      // with two fields
  Quad<T>* entries;   // behind them

  __device__ PatchFields(const DeviceField<T>& field, std::byte* shared)
      : environment(blockIdx.x / field.plan.patches),
        patch(field.plan, int(blockIdx.x % field.plan.patches)),
        position(reinterpret_cast<Quad<T>*>(shared)),
        both(shared, field.plan.most_slots),
        entries(reinterpret_cast<Quad<T>*>(shared +
                                           slots_bytes(sizeof(T), field.plan.most_slots, Fields))) {
    const auto at = [&](const T* from, int slot) {
      const DevicePlan<T>& plan = field.plan;
      const std::int64_t row = environment * plan.vertices + plan.vertex_order[patch.vertex(slot)];
      return read3(from + 3 * row);
    };
    for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
      Vec3<T> x = {T(0), T(0), T(0)};
      if (field.positions) x = at(field.positions, s) - at(field.positions, 0);
      if (field.displacement) x = x + at(field.displacement, s);
      if constexpr (Fields == 2) {
        both.set(s, x, at(field.direction, s));
      } else {
        position[s] = quad(x);
      }
    }
    __syncthreads();
  }

  // the vectors of a corner's slot, encoded as in pair_corner; element functors call this
  __device__ void operator()(unsigned corner, Vec3<T> (&vectors)[Fields]) const {
    if constexpr (Fields == 2) {
      both(corner, vectors);
    } else {
      vectors[0] = at_corner(position, corner);
    }
  }
};

// Writes the sums of a patch's entries: to interior vertices, and for field_shared.
template <int Numbers, int Fields, class T>
__device__ void write_patch(const FieldWork<T>& work, const PatchFields<Fields, T>& fields) {
  const DevicePlan<T>& plan = work.field.plan;
  const std::int64_t environment = fields.environment;
  const Patch<T>& patch = fields.patch;
  for (int s = threadIdx.x; s < patch.slots; s += blockDim.x) {
    const int slot = patch.first_slot + s;
    const Vec3<T> force = sum_entries(fields.entries, plan.slot_row[slot]);
    if (s < patch.interior) {
      write_vertex<Numbers>(work.field, environment, patch.first_vertex + s, force);
    } else if (plan.shared > 0) {  // a cluster has none: owners hold the complete force
      work.shared_force[environment * plan.slots + slot] = quad(force);
    }
  }
}

// Fields: vectors that an element reads per vertex. Numbers: values that a vertex gets.
template <bool Computed, class Element, int Fields, int Numbers, class T>
__global__ void __launch_bounds__(field_threads)
    field_vertices(const __grid_constant__ FieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  const PatchFields<Fields, T> fields(work.field, shared);
  const Patch<T>& patch = fields.patch;
  each_pair<Fields>(patch, fields, rest_of<Computed>(patch), work.weights_of(fields.environment),
                    fields.entries, Element{});
  __syncthreads();
  write_patch<Numbers>(work, fields);
}

template <int Numbers, class T>
__global__ void __launch_bounds__(field_threads)
    field_shared(const __grid_constant__ FieldWork<T> work) {
  const DevicePlan<T>& plan = work.field.plan;
  const int blocks = (plan.shared + field_threads - 1) / field_threads;
  const std::int64_t environment = blockIdx.x / blocks;
  const int i = int(blockIdx.x % blocks) * field_threads + int(threadIdx.x);
  if (i >= plan.shared) return;
  Vec3<T> force = {T(0), T(0), T(0)};
  for (int at = plan.shared_start[i]; at < plan.shared_start[i + 1]; ++at)
    force = force + vec3(work.shared_force[environment * plan.slots + plan.shared_slot[at]]);
  write_vertex<Numbers>(work.field, environment, plan.patch_vertex[plan.patches] + i, force);
}

// Product: the derivative of the energy along the direction; otherwise the energy.
template <bool Computed, bool Product, class T>
__global__ void __launch_bounds__(field_threads)
    field_elements(const __grid_constant__ FieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  const DevicePlan<T>& plan = work.field.plan;
  constexpr int wanted = Product ? 2 : 1;
  const PatchFields<wanted, T> fields(work.field, shared);
  const std::int64_t environment = fields.environment;
  const Patch<T>& patch = fields.patch;
  const T* weights = work.weights_of(environment);
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x) {
    const PairPlace place = place_of(patch, number);
    const PairInputs<T> pair = load_pair(patch.plan, weights, place);
    const auto numbers = rest_of<Computed>(patch).read(place, pair);
    const Mat3<T> rest[2] = {numbers.face.inverse(0), numbers.face.inverse(1)};
    for (int e = 0; e < 2; ++e) {
      const int tet = plan.pair_tet[place.in(2) + e * pair_lanes];
      if (tet < 0) continue;  // no tetrahedron, or another patch writes it
      Vec3<T> x[4], dx[4];
      for (int c = 0; c < 4; ++c) {
        Vec3<T> vectors[wanted];
        fields(pair.corner[c < 3 ? c : 3 + e], vectors);
        x[c] = vectors[0];
        if constexpr (Product) dx[c] = vectors[1];
      }
      const T weight = pair.weight[e];
      T& out = work.field.out[environment * plan.tets + tet];
      if constexpr (Product) {
        out = element_energy_product(x, dx, rest[e], weight);
      } else {
        const Mat3<T> d = strain(x, rest[e]);
        out = T(0.5) * weight * frobenius(d, d);
      }
    }
  }
}

// Numbers of every tetrahedron with Poisson's ratio, from element.run<N>(group, write).
template <bool Computed, class Element, int Fields, int Numbers, class T>
__global__ void __launch_bounds__(field_threads)
    field_groups(const __grid_constant__ FieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  const DevicePlan<T>& plan = work.field.plan;
  const PatchFields<Fields, T> fields(work.field, shared);
  const std::int64_t environment = fields.environment;
  const Patch<T>& patch = fields.patch;
  const T* weights = work.weights_of(environment);
  const Moduli<T> moduli(work.field.stiffness, work.field.poisson, environment);
  for (int number = threadIdx.x; number < patch.pairs; number += blockDim.x) {
    const PairPlace place = place_of(patch, number);
    const PairInputs<T> inputs = load_pair(patch.plan, weights, place);
    const auto numbers = rest_of<Computed>(patch).read(place, inputs);
    Pair<T, Fields> pair;
    for (int c = 0; c < 5; ++c) {
      Vec3<T> vectors[Fields];
      fields(inputs.corner[c], vectors);
      for (int f = 0; f < Fields; ++f) pair.corner[f][c] = vectors[f];
    }
    const auto write = [&](const auto& group, int s, const auto&... number) {
      const int e = group.first + s, tet = plan.pair_tet[place.in(2) + e * pair_lanes];
      if (tet < 0) return;
      const T found[Numbers] = {number...};
      T* to = work.field.out + (environment * plan.tets + tet) * Numbers;
      for (int n = 0; n < Numbers; ++n) to[n] = found[n];
      if constexpr (Numbers == 2) {
        if (plan.pair_bound[place.in(2) + e * pair_lanes] < T(0)) to[1] = T(0);  // without lambda
        const T volume = e == 0 ? numbers.template weight<PairSide<T, 0>>(T(1))
                                : numbers.template weight<PairSide<T, 1>>(T(1));
        LameSlopes<T>(moduli.youngs[tet], moduli.poisson[tet]).chain(volume, to);
      }
    };
    T unused = T(0);
    each_group_of_pair(pair, numbers.face, inputs, plan.members,
                       lanes_of_pair(plan.members, inputs.coupled, (number ^ 1) < patch.pairs),
                       unused, [&](const auto& group) {
                         constexpr int members = std::remove_cvref_t<decltype(group)>::members;
                         Element{}.template run<members>(group, write);
                       });
  }
}

// `teams`: environments in progress at a time.
template <class T>
FieldWork<T> arrange(Arena& arena, const DeviceField<T>& field, std::int64_t teams) {
  const DevicePlan<T>& plan = field.plan;
  FieldWork<T> work{field, nullptr, nullptr};
  arena.place(work.weights,
              (own_weights(field) ? field.batch : 1) * plan.blocks * pair_weights * pair_lanes);
  arena.place(work.shared_force, plan.shared ? teams * plan.slots : 0);
  return work;
}

template <class T>
std::int64_t field_bytes(const DeviceField<T>& field) {
  Arena arena(nullptr);
  arrange(arena, field, field.batch);
  return arena.size();
}

// `Work`: FieldWork, or one that adds to it
template <class Work>
void launch_field(void (*kernel)(Work), const Work& work, int fields, cudaStream_t stream) {
  using T = typename Work::real;
  const DevicePlan<T>& plan = work.field.plan;
  const std::size_t bytes =
      pass_shared_bytes(sizeof(T), plan.most_slots, plan.most_entries, fields);
  if (resident_blocks(reinterpret_cast<const void*>(kernel), field_threads, bytes) == 0)
    refuse_shared_memory(bytes);
  kernel<<<blocks_of(work.field.batch * plan.patches), field_threads, bytes, stream>>>(work);
  check(cudaGetLastError());
}

// Adds up what patches have on shared vertices.
template <int Numbers, class T>
void run_shared(const FieldWork<T>& work, cudaStream_t stream) {
  if (work.field.plan.shared == 0) return;
  const std::int64_t blocks = (work.field.plan.shared + field_threads - 1) / field_threads;
  field_shared<Numbers, T>
      <<<blocks_of(work.field.batch * blocks), field_threads, 0, stream>>>(work);
  check(cudaGetLastError());
}

template <bool Computed, class Element, int Fields, int Numbers, class T>
void run_vertices(const FieldWork<T>& work, cudaStream_t stream) {
  launch_field(field_vertices<Computed, Element, Fields, Numbers, T>, work, Fields, stream);
  run_shared<Numbers>(work, stream);
}

template <bool Computed, class T>
void compute_field_weights(const FieldWork<T>& work, cudaStream_t stream) {
  const std::int64_t sets = own_weights(work.field) ? work.field.batch : 1;
  field_weights<Computed, T>
      <<<blocks_of(sets * work.field.plan.patches), field_threads, 0, stream>>>(work);
  check(cudaGetLastError());
}

template <bool Computed, class T>
void run_elements(const FieldWork<T>& work, cudaStream_t stream) {
  const DeviceField<T>& field = work.field;
  const bool product = field.field == Field::element_energy_product;
  if constexpr (!has_poisson_ratio) {
    return product ? launch_field(field_elements<Computed, true, T>, work, 2, stream)
                   : launch_field(field_elements<Computed, false, T>, work, 1, stream);
  } else if (field.field == Field::element_energy) {
    return launch_field(field_groups<Computed, ElementEnergy, 1, 1, T>, work, 1, stream);
  } else if (product) {
    return launch_field(field_groups<Computed, ElementEnergyProduct, 2, 1, T>, work, 2, stream);
  } else if (field.direction) {
    return launch_field(field_groups<Computed, LameProduct, 2, 2, T>, work, 2, stream);
  } else {
    return launch_field(field_groups<Computed, LameSlope, 1, 2, T>, work, 1, stream);
  }
}

template <bool Computed, class T>
void run_field_with(const FieldWork<T>& work, cudaStream_t stream) {
  compute_field_weights<Computed>(work, stream);
  const DeviceField<T>& field = work.field;
  switch (field.field) {
    case Field::gradient:
      return run_vertices<Computed, SolidGradient<false>, 1, 3>(work, stream);
    case Field::diagonal:
      return run_vertices<Computed, SolidDiagonal, 1, 1>(work, stream);
    case Field::report:
      return run_vertices<Computed, SolidReport, 1, 3>(work, stream);
    case Field::hessian_product:
      return run_vertices<Computed, SolidHessian, 2, 3>(work, stream);
    case Field::element_energy:
    case Field::element_energy_product:
    case Field::lame_product:
      return run_elements<Computed>(work, stream);
    default:
      return;  // only run_mixed_field has the others
  }
}

template <class T>
void run_field(const DeviceField<T>& field, void* memory, Stream to) {
  const auto stream = static_cast<cudaStream_t>(to);
  Arena arena(memory);
  const FieldWork<T> work = arrange(arena, field, field.batch);
  if (computes_rests(field.plan)) {
    run_field_with<true>(work, stream);
  } else {
    run_field_with<false>(work, stream);
  }
}

template <class T>
__global__ void __launch_bounds__(field_threads)
    rotate(const __grid_constant__ RotationCall<T> call) {
  const std::int64_t i = std::int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= call.count) return;
  const auto read = [&](const T* from) {
    return Mat3<T>{{read3(from + 9 * i), read3(from + 9 * i + 3), read3(from + 9 * i + 6)}};
  };
  const Mat3<T> f = read(call.matrices);
  Mat3<T> r = polished_rotation(f);
  if (call.direction) r = rotation_differential(f, r, read(call.direction));
  for (int row = 0; row < 3; ++row) write3(call.out + 9 * i + 3 * row, r.row[row]);
}

template <class T>
void run_rotation(const RotationCall<T>& call, Stream to) {
  const std::int64_t blocks = (call.count + field_threads - 1) / field_threads;
  rotate<T><<<blocks_of(blocks), field_threads, 0, static_cast<cudaStream_t>(to)>>>(call);
  check(cudaGetLastError());
}

}  // namespace pd::inline PD_TARGET
