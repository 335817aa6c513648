// Members of FusedRunner that initialise a call and an environment: memory layout, state and
// weights.
#pragma once
#include "cuda/fused/runner.h"

namespace pd::inline PD_TARGET {

// Sets the pointers to shared memory, and to global memory for arrays that do not fit.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::lay_out(
    const FusedCall<T>& call, std::byte* shared) {
  if constexpr (Clustered) {
    energies_ = reinterpret_cast<double*>(shared + cluster_energy_begin);
    entries_ =
        reinterpret_cast<Quad<T>*>(shared + halo_begin + halo_bytes(sizeof(T), plan_.most_slots));
  } else {
    position_ = reinterpret_cast<Quad<T>*>(shared + fused_control_bytes);
    entries_ = position_ + (Many ? 1 : 2) * plan_.most_slots;
  }
  const auto array = [&](VertexArray a) {
    Quad<T>* const kept = reinterpret_cast<Quad<T>*>(shared + vertices_begin(call.step, Clustered));
    if constexpr (Clustered) return kept + a * plan_.most_interior;
    Quad<T>* const far = call.scratch.vertex[a] + first_slot();
    if constexpr (Kind == Blocks::one) {
      if (a == array_u) return position_ + plan_.most_slots;
      Quad<T>* const near = kept + (a - 1) * plan_.most_slots;
      if constexpr (InShared) return a < block_arrays ? near : far;
      return a < call.kept ? near : far;
    }
    if constexpr (InShared) return kept + a * plan_.most_slots;
    return a < call.kept ? kept + a * plan_.most_slots : far;
  };
  v_ = {array(array_x), array(array_velocity), array(array_target), array(array_u),
        array(array_before)};
  origin_ = array(array_origin);
  spheres_ = reinterpret_cast<Sphere<T>*>(entries_ + (Clustered ? 2 : 1) * plan_.most_entries);
  planes_ = reinterpret_cast<Plane<T>*>(spheres_ + call_.material.spheres_count);
}

// Per-thread data of the patch, constant for the call.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::init(
    std::byte* shared) {
  if constexpr (!InShared) {
    const int threads = blockDim.x;
    outer_pairs_ = min((patch_.outer + threads - 1) / threads * threads, outer_pairs_);
  }
  if constexpr (Clustered) {
    if (OwnHalo::vertex() < patch_.interior) row_ = patch_.row(OwnHalo::vertex());
    halo_.init(patch_);
    if (threadIdx.x == 0) ClusterSums(shared + cluster_sums_begin).init();
    cluster_barrier();
  } else if constexpr (Many) {
    if (int(threadIdx.x) < patch_.slots) row_ = patch_.row(slot_of_item(threadIdx.x));
  }
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::load() {
  if (threadIdx.x == 0) in_.read_contacts(planes_, spheres_);
  contacts_ = {planes_, spheres_, call_.material.planes_count, call_.material.spheres_count};
  each_slot([&](int s) {
    v_.init(s, in_, patch_.vertex(s), h_);
    const Vec3<T> none = {T(0), T(0), T(0)};
    if constexpr (Clustered) {
      return;
    } else {
      position_[s] = quad(none);
    }
  });
  // before other blocks may store a step's result to the same place
  if (Clustered && threadIdx.x == 0) control_.anchor = in_.at_vertex(call_.positions, 0);
  just_loaded_ = true;
  moved_ = false;
  __syncthreads();
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::move_spheres() {
  if constexpr (!HasContacts) return;
  __syncthreads();
  for (int b = threadIdx.x; b < contacts_.sphere_count; b += blockDim.x)
    spheres_[b].center = spheres_[b].center + spheres_[b].motion;
  __syncthreads();
}

// Computes a and 1 / D of every vertex, w V of every element, and the smallest a / D.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void
FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::assemble_diagonal() {
  const Moduli<T> moduli(call_.material.stiffness, call_.poisson, in_.environment);
  constexpr bool own = Clustered && OnePerThread;
  T plain = T(0);
  if constexpr (own) {
    plain = compute_own_weight(moduli.youngs, set_.weighted);
  } else {
    compute_weights(moduli, set_.weighted ? WeightKind::majoriser : WeightKind::matrix);
  }
  if (threadIdx.x == 0) control_.progress.done = false;
  pending_ = false;
  __syncthreads();
  double least = HUGE_VAL;
  pass<false>(
      SolidDiagonal{}, [] {}, false,
      [&](const WorkItem& at, const LoadedVertex&, const Vec3<T>& elastic) {
        least = Min{}(least, v_.set_diagonal(at.slot, elastic.x));
      });
  sums_.all_reduce({least, 0, 0}, 1, Min{});
  if (threadIdx.x == 0) control_.progress.min_share = sums_.total(0);
  if constexpr (own) {
    tet_.weight = plain;
  } else if (set_.weighted || has_poisson_ratio) {
    compute_weights(moduli, WeightKind::force);
  }
  __syncthreads();
}

template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                           HasStencils>::compute_weights(const Moduli<T>& moduli, WeightKind kind) {
  compute_patch_weights(patch_, rest_of<false>(patch_), moduli, kind, weights());
  __syncthreads();  // one lane has written the weights of two
  if constexpr (Many) load_own();
}

// Loads this thread's first tetrahedron or pair.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE void FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared, HasStencils>::load_own() {
  if constexpr (!TetPerLane) {
    pair_ = prefetch_pair(patch_, weights(), threadIdx.x);
    return;
  }
  if constexpr (Clustered && OnePerThread) {
    const T weight = tet_.weight;
    tet_ = load_tet<false, false, T>(patch_, nullptr, threadIdx.x);
    tet_.weight = weight;
  } else {
    tet_ = load_tet<false>(patch_, weights(), threadIdx.x);
  }
  rest_ = tet_rest(patch_, threadIdx.x);
  if constexpr (Clustered) counts_ = counts_energy(threadIdx.x);
}

// The same without global memory, for one tetrahedron per thread; returns its weight without the
// bound l_e.
template <class T, bool HasContacts, bool HasFreePieces, Blocks Kind, bool InShared,
          bool HasStencils>
PD_DEVICE T FusedRunner<T, HasContacts, HasFreePieces, Kind, InShared,
                        HasStencils>::compute_own_weight(const T* stiffness, bool bounded) {
  const PairPlace place = place_of(patch_, min(int(threadIdx.x) / 2, patch_.pairs - 1));
  const int which = int(threadIdx.x) % 2, tet = tet_of(plan_, place, which);
  const auto rest = rest_of<false>(patch_).read(place);
  const T bound = bounded ? plan_.pair_bound[place.in(2) + which * pair_lanes] : T(1);
  T plain = T(0);
  if (tet >= 0) {
    plain = which ? rest.template weight<PairSide<T, 1>>(stiffness[tet])
                  : rest.template weight<PairSide<T, 0>>(stiffness[tet]);
  }
  tet_.weight = bound * plain;
  load_own();
  return plain;
}

}  // namespace pd::inline PD_TARGET
