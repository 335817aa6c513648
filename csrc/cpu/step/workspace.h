// Memory of one running step: the state of one environment, or of W side by side.
#pragma once
#include "contact/plane_sphere.h"
#include "cpu/step/element_blocks.h"
#include "elements/lame.h"
#include "solver/coarse/newton.h"

#include <cmath>
#include <cstdint>
#include <memory>
#include <new>

namespace pd::inline PD_TARGET {

struct FreeAligned {
  void operator()(std::byte* p) const { ::operator delete[](p, std::align_val_t{64}); }
};
using Storage = std::unique_ptr<std::byte[], FreeAligned>;

// Zeroed, because vector loads read the unused fourth component of a quad.
inline Storage allocate_zeroed(std::size_t bytes) {
  return Storage(new (std::align_val_t{64}) std::byte[bytes]());
}

// sums of a body that moves rigidly, see solver/coarse
template <class Wide>
struct BodySums {
  Wide rigid[RigidSums::count], contact[ContactSums::count];
  Vec3<Wide> center;
  Wide moves;    // 1, or 0 where pins clamp it
  Wide rise;     // of the energy, from the first to the second first iterate
  bool goes_on;  // in some environment
};

constexpr int shared_chunk = 256;  // shared vertices that one sum covers

template <class Lanes>
struct Workspace {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;

  // sums of one part (a patch, or a chunk of shared vertices) over an iteration
  struct Part {
    Wide energy, first, second;
    Real least;
  };

  Value *x, *velocity, *force, *target, *u, *before;  // [vertices]
  Real *inertia, *inverse;                            // [vertices] a, 1 / D (0: does not move)
  Value *origin, *shared_force;                       // [slots]
  Part* parts[2];  // iterations alternate, so that no thread overwrites sums that others read
  BodySums<Wide>* body_sums;         // [components]
  CoarseBody* bodies;                // [components, environments]
  CoarseTrial<Wide>* trial;          // [components]
  RigidMotion<Wide>* motion;         // [components]
  RigidMotion<Wide>* motion_before;  // [components] of the first of both first iterates
  double* reached;       // [components, environments] Phi of the first of both first iterates
  Real* work;            // [vertices] of the mean elastic force, from the first to the second
  Value* contact_force;  // [contacts, vertices], like the next
  Real* friction_radius;
  Plane<Real>* planes;
  Sphere<Real>* spheres;
  // [elements], or [elements, W] when stiffness differs between environments: w V, where w is Young's modulus, or 2 mu
  // with Poisson's ratio; and then V lambda, else null
  T *weight, *pressure;
  T* numbers;  // the same of stencils: [rows of 16 numbers of a step]
  int part_count;
  bool shared_weight, shared_numbers;
  T per_time;  // 1 / h of the step, or 0 where energies that dissipate do not count

  explicit Workspace(const StepCall<T>& call)
      : Workspace(call.plan, call.material, call.effects,
                  call.material.stiffness.stride == 0 && shares_effects(call.effects),
                  call.forces != nullptr, T(1 / call.settings.time_step)) {}

  explicit Workspace(const FieldCall<T>& call)
      : Workspace(call.plan, {}, call.effects, true, false, call.per_time) {}

  explicit Workspace(const ConjugateCall<T>& call)
      : Workspace(call.plan, {}, call.effects, true, true, call.per_time) {}

  ElementWeights<T> weights() const { return {weight, pressure, shared_weight}; }

  // Sets the weights of lane `e` of the plan's blocks, at place `at`, to those of an environment.
  void set_weight(const Plan<T>& plan, const Values<T>& stiffness, const Effects<T>& effects,
                  std::int64_t environment, std::int64_t e, std::int64_t at,
                  WeightKind kind) const {
    const T youngs = stiffness.of(environment)[plan.tet_order[e]], volume = plan.tet_volume[e];
    const T signed_bound = plan.tet_bound[e];
    const T bound = kind == WeightKind::majoriser ? std::abs(signed_bound) : T(1);
    if (!pressure) {
      weight[at] = (volume * bound) * youngs;
      return;
    }
    Lame<T> lame(youngs, effects.poisson.of(environment)[plan.tet_order[e]]);
    if (signed_bound < 0 && kind != WeightKind::matrix) lame.lambda = 0;
    weight[at] = volume * lame.of(kind, bound);
    pressure[at] = volume * lame.lambda;
  }

 private:
  static constexpr std::size_t alignment = 64;

  Workspace(const Plan<T>& plan, const Material<T>& material, const Effects<T>& effects,
            bool same_stiffness, bool forces, T steps_per_time) {
    const bool has_pressure = effects.poisson.data != nullptr;
    shared_weight = Lanes::environments == 1 || same_stiffness;
    shared_numbers = Lanes::environments == 1 || (same_stiffness && !plan.remembers);
    per_time = steps_per_time;
    part_count = plan.patches + (plan.shared + shared_chunk - 1) / shared_chunk;
    arrange(plan, material, has_pressure, forces, nullptr);
    storage_ = allocate_zeroed(size_);
    arrange(plan, material, has_pressure, forces, storage_.get());
  }

  template <class Item>
  void place(Item*& array, std::int64_t count, std::byte* base) {
    array = reinterpret_cast<Item*>(base + size_);
    size_ += (count * sizeof(Item) + alignment - 1) / alignment * alignment;
  }

  void arrange(const Plan<T>& plan, const Material<T>& material, bool has_pressure, bool forces,
               std::byte* base) {
    size_ = 0;
    for (Value** array : {&x, &velocity, &target, &u, &before}) place(*array, plan.vertices, base);
    place(force, forces ? plan.vertices : 0, base);
    for (Real** array : {&inertia, &inverse}) place(*array, plan.vertices, base);
    place(origin, plan.slots, base);
    place(shared_force, plan.shared ? plan.slots : 0, base);
    for (Part*& array : parts) place(array, part_count, base);
    place(body_sums, plan.components, base);
    place(bodies, plan.components * Lanes::environments, base);
    place(motion, plan.components, base);
    place(motion_before, plan.components, base);
    place(reached, plan.components * Lanes::environments, base);
    place(work, plan.components > 0 ? plan.vertices : 0, base);
    const std::int64_t contacts =
        plan.components > 0 ? material.planes_count + material.spheres_count : 0;
    place(trial, contacts > 0 ? plan.components : 0, base);
    place(contact_force, contacts * plan.vertices, base);
    place(friction_radius, contacts * plan.vertices, base);
    place(planes, material.planes_count, base);
    place(spheres, material.spheres_count, base);
    const std::int64_t weights =
        std::int64_t(plan.blocks) * block_lanes * (shared_weight ? 1 : Lanes::environments);
    place(weight, weights, base);
    place(pressure, has_pressure ? weights : 0, base);
    if (!has_pressure) pressure = nullptr;
    place(numbers,
          std::int64_t(plan.stencil_numbers) * block_lanes *
              (shared_numbers ? 1 : Lanes::environments),
          base);
  }

  std::size_t size_ = 0;
  Storage storage_;
};

}  // namespace pd::inline PD_TARGET
