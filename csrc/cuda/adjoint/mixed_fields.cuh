// Fields of energy_fields.cuh for scenes with stencils, and what belongs to the stencils alone.
#pragma once
#include "cuda/adjoint/sums.cuh"
#include "cuda/common/stencil_numbers.h"

namespace pd::inline PD_TARGET {

template <class T>
struct MixedFieldWork : FieldWork<T> {
  StencilWork<T> stencils;
  EffectViews<T> effects;
  double* energies;                    // [batch, patches] of the stencils
  int counts[int(KindNumber::count)];  // stencils of each kind
};

template <bool Computed, class Element, int Fields, int Numbers, class T>
__global__ void __launch_bounds__(field_threads)
    mixed_vertices(const __grid_constant__ MixedFieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  const PatchFields<Fields, T> fields(work.field, shared);
  const Patch<T>& patch = fields.patch;
  each_pair_and_stencil<Fields>(patch, fields, rest_of<Computed>(patch),
                                work.weights_of(fields.environment), work.stencils,
                                fields.environment, work.field.weighted, fields.entries, Element{});
  __syncthreads();
  write_patch<Numbers>(work, fields);
}

template <class T>
__global__ void __launch_bounds__(field_threads)
    stencil_energies(const __grid_constant__ MixedFieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  __shared__ WarpSums warp_sums;
  const PatchFields<1, T> fields(work.field, shared);
  double sum[1] = {double(each_stencil<1>(work.stencils, fields.environment, fields.patch.index, 0,
                                          fields, fields.entries, StencilGradient<true>{}))};
  block_reduce<Add>(sum, warp_sums);
  if (threadIdx.x == 0)
    work.energies[fields.environment * work.field.plan.patches + fields.patch.index] = sum[0];
}

// One block per environment.
template <class T>
__global__ void __launch_bounds__(field_threads)
    sum_energies(const __grid_constant__ MixedFieldWork<T> work) {
  __shared__ WarpSums warp_sums;
  double sum[1];
  const int patches = work.field.plan.patches;
  const PartialSums<Add, 1> parts{work.energies + blockIdx.x * std::int64_t(patches), patches};
  parts.reduce(sum, warp_sums);
  if (threadIdx.x == 0) work.field.out[blockIdx.x] = T(sum[0]);
}

// Adds the derivatives of a stencil by the rows of its material. `Product`: of the product with the direction, else the
// energy.
template <class Kind, bool Product, int Fields, class T>
__device__ void write_products(const MixedFieldWork<T>& work, const PatchFields<Fields, T>& fields,
                               const StencilPlace<T>& place) {
  constexpr ArraysOf<Kind> arrays;
  const DeviceStencils<T>& plan = work.stencils.plan;
  T measure = plan.stencil_measure[place.stencil()];
  if (measure == T(0)) return;  // padding
  if (dissipates<Kind>) measure = measure * work.stencils.per_time;
  const std::int64_t number = plan.stencil_row[place.stencil()];
  const std::int64_t count =
      reads_tets<Kind> ? work.field.plan.tets : work.counts[kind_number<Kind>];
  const MaterialRows<Kind, T> rows(work.effects.effects, fields.environment);
  T g[gradient_numbers<Kind>], c[constant_slots<Kind>] = {}, row[Kind::rows] = {};
  for (int i = 0; i < gradient_numbers<Kind>; ++i) g[i] = place.stored(i);
  for (int i = 0; i < Kind::constants; ++i) c[i] = place.stored(gradient_numbers<Kind> + i);
  rows.values(number, row);
  Vec3<T> vectors[Kind::corners][Fields], x[Kind::corners], f[Kind::dims], df[Kind::dims] = {};
  for (int a = 0; a < Kind::corners; ++a) fields(place.corner(a), vectors[a]);
  for (int a = 0; a < Kind::corners; ++a) x[a] = vectors[a][0];
  deform<Kind>(x, g, f);
  if constexpr (Product) {
    for (int a = 0; a < Kind::corners; ++a) x[a] = vectors[a][1];
    deform<Kind>(x, g, df);
  }
  T memory[memory_of<Kind> + 1];
  const T* const numbers = work.stencils.numbers_of(fields.environment);
  for (int i = 0; i < memory_of<Kind>; ++i)
    memory[i] = numbers[place.number_of_step(Kind::numbers - memory_of<Kind> + i)];
  for (int a = 0; a < arrays.count; ++a) {
    T* out = work.effects.products[arrays.effect[a]];
    if (!out) continue;
    const int width = arrays.width(a);
    out += (fields.environment * count + number) * width;
    for (int i = 0; i < width; ++i) {
      const RowDerivative<Kind, T> by(arrays.first[a] + i, row, measure, f, df, c, memory);
      out[i] = out[i] + (Product ? by.product : by.energy);
    }
  }
}

// `Kinds`: has(kind) of those whose turn it is.
template <class Kinds, bool Product, class T>
__global__ void __launch_bounds__(field_threads)
    stencil_products(const __grid_constant__ MixedFieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  constexpr int wanted = Product ? 2 : 1;
  const PatchFields<wanted, T> fields(work.field, shared);
  each_stencil_block(work.stencils.plan, fields.patch.index, 0,
                     [&](auto kind, const StencilPlace<T>& place) {
                       using Kind = decltype(kind);
                       if constexpr (Kinds::template has<Kind>)
                         write_products<Kind, Product>(work, fields, place);
                     });
}

// Kinds with rows of their own; those that share the rows of tetrahedra take turns.
struct OwnRows {
  template <class Kind>
  static constexpr bool has = !reads_tets<Kind>;
};
template <class Turn>
struct RowsOfTets {
  template <class Kind>
  static constexpr bool has = std::is_same_v<Kind, Turn>;
};

// The work of `Element` on the stencils alone.
template <class Element, int Fields, class T>
__global__ void __launch_bounds__(field_threads)
    stencil_vertices(const __grid_constant__ MixedFieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  const PatchFields<Fields, T> fields(work.field, shared);
  const Patch<T>& patch = fields.patch;
  for (int s = threadIdx.x; s < patch.slots; s += blockDim.x)
    clear_entries(fields.entries, work.field.plan.slot_row[patch.first_slot + s]);
  __syncthreads();
  each_stencil<Fields>(work.stencils, fields.environment, patch.index, 0, fields, fields.entries,
                       Element{});
  __syncthreads();
  write_patch<3>(work, fields);
}

// Replaces the memory by the slope by it.
template <class T>
__global__ void __launch_bounds__(field_threads)
    stencil_slopes(const __grid_constant__ MixedFieldWork<T> work) {
  extern __shared__ __align__(16) std::byte shared[];
  const PatchFields<2, T> fields(work.field, shared);
  each_stencil<2>(work.stencils, fields.environment, fields.patch.index, 0, fields, fields.entries,
                  StencilMemorySlope{});
}

// The stiffness at rest of tetrahedra, then of stencils kind by kind, per measure.
template <class T>
__global__ void __launch_bounds__(field_threads)
    element_stiffness(const __grid_constant__ MixedFieldWork<T> work, std::int64_t elements) {
  const DeviceStencils<T>& plan = work.stencils.plan;
  const std::int64_t tets = work.field.plan.tets;
  const std::int64_t blocks = (tets + stencil_lanes - 1) / stencil_lanes + plan.blocks;
  const std::int64_t thread = std::int64_t(blockIdx.x) * field_threads + threadIdx.x;
  const std::int64_t environment = thread / stencil_lanes / blocks;
  if (environment >= work.field.batch) return;
  T* const out = work.field.out + environment * elements;
  const std::int64_t block = thread / stencil_lanes % blocks;
  if (block >= plan.blocks) {
    const std::int64_t t = (block - plan.blocks) * stencil_lanes + thread % stencil_lanes;
    const Moduli<T> moduli(work.field.stiffness, work.field.poisson, environment);
    if (t >= tets) return;
    out[t] = has_poisson_ratio ? moduli.lame(t).matrix() : moduli.youngs[t];
    return;
  }
  const StencilPlace<T> place(plan, int(block));
  if (plan.stencil_measure[place.stencil()] == T(0)) return;  // padding
  std::int64_t first = tets;
  for (int kind = 0; kind < place.block.kind; ++kind) first += work.counts[kind];
  const std::int64_t row = plan.stencil_row[place.stencil()];
  T* const to = out + first + plan.stencil_order[place.stencil()];
  with_compiled_kind(place.block.kind, [&](auto kind) {
    using Kind = decltype(kind);
    T numbers[Kind::numbers];
    MaterialRows<Kind, T>(work.effects.effects, environment)
        .read(row, dissipates<Kind> ? work.stencils.per_time : T(1), numbers);
    *to = rest_weight<Kind>(numbers);
  });
}

// instantiated in fields_float.cu and fields_double.cu
extern template void run_field(const DeviceField<float>&, void*, Stream);
extern template void run_field(const DeviceField<double>&, void*, Stream);

template <class T>
MixedFieldWork<T> arrange_mixed(Arena& arena, const MixedField<T>& field) {
  const DeviceField<T>& call = field;
  MixedFieldWork<T> work;
  static_cast<FieldWork<T>&>(work) = arrange(arena, call, field.batch);
  work.stencils =
      arrange_stencils(arena, field.stencils, field.effects, field.batch, field.per_time);
  work.effects = field;
  const bool sums = field.field == Field::effect_energy;
  arena.place(work.energies, sums ? field.batch * field.plan.patches : 0);
  for (int kind = 0; kind < int(KindNumber::count); ++kind)
    work.counts[kind] = field.stencils.stencil_sizes[stencil_size_count + kind];
  return work;
}

template <class T>
std::int64_t mixed_field_bytes(const MixedField<T>& field) {
  Arena arena(nullptr);
  arrange_mixed(arena, field);
  return arena.size();
}

template <bool Computed, class Element, int Fields, int Numbers, class T>
void run_mixed_vertices(const MixedFieldWork<T>& work, cudaStream_t stream) {
  launch_field(mixed_vertices<Computed, Element, Fields, Numbers, T>, work, Fields, stream);
  run_shared<Numbers, T>(work, stream);
}

template <class T>
void run_energies(const MixedFieldWork<T>& work, cudaStream_t stream) {
  launch_field(stencil_energies<T>, work, 1, stream);
  sum_energies<T><<<blocks_of(work.field.batch), field_threads, 0, stream>>>(work);
  check(cudaGetLastError());
}

template <class T>
void run_stiffness(const MixedFieldWork<T>& work, cudaStream_t stream) {
  const std::int64_t tets = work.field.plan.tets;
  std::int64_t elements = tets;
  for (const int count : work.counts) elements += count;
  const std::int64_t blocks =
      work.stencils.plan.blocks + (tets + stencil_lanes - 1) / stencil_lanes;
  const std::int64_t threads = work.field.batch * blocks * stencil_lanes;
  element_stiffness<T>
      <<<blocks_of((threads + field_threads - 1) / field_threads), field_threads, 0, stream>>>(
          work, elements);
  check(cudaGetLastError());
}

// Derivatives by the rows of all kinds that dissipate, or of all others.
template <bool Product, class T>
void run_products(const MixedFieldWork<T>& work, bool damping, cudaStream_t stream) {
  constexpr int wanted = Product ? 2 : 1;
  if (!damping) launch_field(stencil_products<OwnRows, Product, T>, work, wanted, stream);
  for (int number = 0; number < int(KindNumber::count); ++number) {
    if (work.counts[number] == 0) continue;
    with_kind(number, [&](auto kind) {
      using Kind = decltype(kind);
      if constexpr (is_compiled<Kind> && reads_tets<Kind>) {
        if (dissipates<Kind> == damping)
          launch_field(stencil_products<RowsOfTets<Kind>, Product, T>, work, wanted, stream);
      }
    });
  }
}

template <class Element, int Fields, class T>
void run_stencil_vertices(const MixedFieldWork<T>& work, cudaStream_t stream) {
  launch_field(stencil_vertices<Element, Fields, T>, work, Fields, stream);
  run_shared<3, T>(work, stream);
}

// What belongs to energies that a step dissipates.
template <class T>
void run_damping(const MixedFieldWork<T>& work, cudaStream_t stream) {
  if constexpr (has_large_kinds) {
    switch (work.field.field) {
      case Field::damping_gradient:
        return run_stencil_vertices<Dissipating<StencilGradient<false>>, 1>(work, stream);
      case Field::damping_product:
        return run_stencil_vertices<Dissipating<StencilHessian>, 2>(work, stream);
      case Field::damping_products:
        return run_products<true>(work, true, stream);
      default:
        break;
    }
    // by the positions at the start: first by the memory of each stencil, then by them
    launch_field(stencil_slopes<T>, work, 2, stream);
    MixedFieldWork<T> start = work;
    start.field.displacement = nullptr;
    run_stencil_vertices<StencilStartSlope, 1>(start, stream);
  }
}

template <bool Computed, class T>
void run_mixed_field_with(const MixedFieldWork<T>& work, cudaStream_t stream) {
  compute_field_weights<Computed, T>(work, stream);
  switch (work.field.field) {
    case Field::gradient:
      return run_mixed_vertices<Computed, SolidGradient<false>, 1, 3>(work, stream);
    case Field::diagonal:
      return run_mixed_vertices<Computed, SolidDiagonal, 1, 1>(work, stream);
    case Field::report:
      return run_mixed_vertices<Computed, SolidReport, 1, 3>(work, stream);
    case Field::hessian_product:
      return run_mixed_vertices<Computed, SolidHessian, 2, 3>(work, stream);
    default:
      return;
  }
}

template <class T>
void run_mixed_field(const MixedField<T>& field, void* memory, Stream to) {
  // of tetrahedra alone
  if (field.field == Field::element_energy || field.field == Field::element_energy_product ||
      field.field == Field::lame_product)
    return run_field<T>(field, memory, to);
  const auto stream = static_cast<cudaStream_t>(to);
  Arena arena(memory);
  const MixedFieldWork<T> work = arrange_mixed(arena, field);
  if (field.field == Field::stiffness_at_rest) return run_stiffness(work, stream);
  compute_stencil_numbers(work.stencils, field.effects, field.batch, stream);
  // a diagonal has no positions, and needs no memory
  if (field.positions)
    begin_stencils(work.stencils, field.plan, field.positions, field.batch, stream);
  if (field.field == Field::effect_energy) return run_energies(work, stream);
  if (field.field == Field::effect_products) {
    return field.direction ? run_products<true>(work, false, stream)
                           : run_products<false>(work, false, stream);
  }
  if (is_of_damping(field.field)) return run_damping(work, stream);
  if (computes_rests(field.plan)) {
    run_mixed_field_with<true>(work, stream);
  } else {
    run_mixed_field_with<false>(work, stream);
  }
}

}  // namespace pd::inline PD_TARGET
