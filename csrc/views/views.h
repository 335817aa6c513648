// What a kernel sees: plain structs of pointers, made from the tables. Knows neither torch nor a device.
#pragma once

#include "math/device.h"

#include <cstdint>

namespace pd {

using int16 = std::int16_t;
using int32 = std::int32_t;

// Numbers of a plan's array of sizes.
enum PlanSize : int {
  plan_vertices,
  plan_tets,
  plan_pins,
  plan_groups,
  plan_blocks,
  plan_patches,
  plan_slots,
  plan_shared,
  plan_most_slots,
  plan_size_count
};

// Numbers of a preconditioner's array of sizes; without a middle level its numbers are 0.
enum LevelSize : int {
  level_fine_entries,
  level_fine_lifts,
  level_fine_nodes,  // below the fine level
  level_middle_entries,
  level_middle_lifts,
  level_middle_nodes,  // below the middle level
  level_direct,        // 1: no levels, A itself is solved directly
  level_size_count
};

// A multilevel approximation of A^-1: see plan/multilevel/build.h and solver/multilevel/lbfgs.h. All null where there is none.
template <class T>
struct Levels {
  using real = T;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/multilevel.def"
#undef X
  int vertices = 0, fine_nodes = 0, middle_nodes = 0;
  bool direct = false;

  PD_HD bool there() const { return fine_start != nullptr; }
  PD_HD bool has_middle() const { return middle_nodes > 0; }
  PD_HD int coarse_unknowns() const {
    return direct ? vertices : 4 * (has_middle() ? middle_nodes : fine_nodes);
  }
};

// Its counts, from its array of sizes; without the other arrays.
template <class T>
Levels<T> count_levels(const int32* sizes, int vertices) {
  Levels<T> levels;
  levels.vertices = vertices;
  levels.fine_nodes = sizes[level_fine_nodes];
  levels.middle_nodes = sizes[level_middle_nodes];
  levels.direct = sizes[level_direct] != 0;
  return levels;
}

template <class T>
struct Plan {
  using real = T;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/cpu_plan.def"
#undef X
  int vertices = 0, tets = 0, pins = 0, groups = 0, blocks = 0, patches = 0, slots = 0, shared = 0;
  int most_slots = 0;  // of any patch
  Levels<T> levels;
};

// Of a pair of tetrahedra in pair_rest, see gpu_plan.def.
constexpr int pair_rest_numbers = 12;

// Numbers of DevicePlan::sizes, as DevicePlan itself has them too.
enum DeviceSize : int {
#define X(name, meaning) size_##name,
#include "views/gpu_sizes.def"
#undef X
  size_count
};

// The constant arrays on a GPU. All but `sizes` are in its memory.
template <class T>
struct DevicePlan {
  using real = T;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/gpu_plan.def"
#undef X
#define X(name, meaning) int name = 0;
#include "views/gpu_sizes.def"
#undef X
  Levels<T> levels;
};

// Its counts, from its array of sizes; without the other arrays.
template <class T>
DevicePlan<T> count_device_plan(const int32* sizes) {
  DevicePlan<T> plan;
#define X(name, meaning) plan.name = sizes[size_##name];
#include "views/gpu_sizes.def"
#undef X
  return plan;
}

// Of pairs, by which kernels count the corners of all of them, 5 times 32 of a block, in 32 bits (cuda/elements/pairs_per_thread.h).
constexpr std::int64_t most_blocks = (std::int64_t(1) << 32) / (5 * 32);

// Numbers in a row of each array of the material.
enum MaterialWidth : int {
#define X(name, width, rows, meaning) name##_numbers = width,
#include "views/material.def"
#undef X
};

// Where the columns of such a row begin.
enum MaterialColumn : int {
#define X(name, width, rows, meaning) name##_before = -1,
#define COLUMN(array, name, width, meaning) \
  array##_##name, array##_##name##_last = array##_##name + width - 1,
#include "views/material.def"
#undef X
};

// One array of the material: the same for all environments when stride is 0.
template <class T>
struct Values {
  const T* data = nullptr;
  std::int64_t stride = 0;  // numbers from one environment to the next

  PD_HD const T* of(std::int64_t environment) const { return data + environment * stride; }
};

template <class T>
struct Material {
#define X(name, width, rows, meaning) Values<T> name;
#include "views/material.def"
#undef X
  int planes_count = 0, spheres_count = 0;
};

// from lbfgs on multilevel
enum class ScheduleKind : int {
  jacobi = 0,
  classic = 1,
  guarded = 2,
  lbfgs = 3,
  momentum = 4,
  corotated = 5
};
enum class StartKind : int { velocity = 0, inertial = 1, given = 2 };

struct Settings {
  int steps = 1, every = 1;  // steps to take, and how many of them lie between two records
#define X(name, type, usual, holds, contract, meaning) type name = usual;
#include "views/settings.def"
#undef X

  PD_HD StartKind start() const { return inertial; }
  PD_HD bool multilevel() const { return schedule >= ScheduleKind::lbfgs; }
  // by L-BFGS
  PD_HD bool learns() const { return multilevel() && schedule != ScheduleKind::momentum; }
};

// Numbers of an info row, double each. A step leaves residual and energy NaN and inverted -1; a report fills them in.
enum InfoField : int {
  info_residual,
  info_energy,
  info_iterations,
  info_restarts,
  info_converged,
  info_rho,
  info_inverted,
  info_count
};

// Everything one call of step or rollout works on. Positions in the user's order, [batch, vertices, 3].
template <class T, class P = Plan<T>>
struct StepCall {
  P plan;
  Material<T> material;
  Settings settings;
  std::int64_t batch = 0;
  const T* positions = nullptr;
  const T* velocities = nullptr;
  const T* forces = nullptr;   // may be null
  const T* start = nullptr;    // first iterate, with StartKind::given
  T* out_positions = nullptr;  // [records, batch, vertices, 3]
  T* out_velocities = nullptr;
  double* info = nullptr;  // [records, batch, info_count], may be null
};

template <class T>
using DeviceStep = StepCall<T, DevicePlan<T>>;

// Elastic energy and its derivatives at given positions, and the diagonal that bounds its second ones.
enum class Field : int {
  gradient,
  hessian_product,
  element_energy,
  element_energy_product,
  diagonal,
  report  // see SolidReport
};

template <class T, class P = Plan<T>>
struct FieldCall {
  P plan;
  Field field = Field::gradient;
  Values<T> stiffness;
  std::int64_t batch = 0;
  bool weighted = false;         // with l_e, by the diagonal
  const T* positions = nullptr;  // [batch, vertices, 3], by all but the diagonal
  const T* displacement =
      nullptr;  // [batch, vertices, 3] on top of the positions, whose sum is not rounded; may be null
  const T* direction = nullptr;  // [batch, vertices, 3], by the products
  T* out =
      nullptr;  // [batch, vertices, 3], [batch, tets] of element energies, [batch, vertices] of the diagonal
};

// Sums over the vertices of an environment that a report is made of, see solver/report.h.
enum ReportSum : int {
  report_energy,
  report_unbalanced,
  report_force,
  report_rounding,
  report_inverted,
  report_wrong,
  report_sums
};

// Vertices that one row of sums covers.
constexpr int report_chunk = 256;

// What a step that was taken says of itself, by the user's numbers of vertices.
template <class T, class P = Plan<T>>
struct ReportCall {
  P plan;
  Material<T> material;
  Values<T> elastic;  // [vertices] diagonal of elasticity, as the step had it
  std::int64_t batch = 0;
  double time_step = 0;
  const T* positions = nullptr;  // [batch, vertices, 3] each, at the start of the step
  const T* velocities = nullptr;
  const T* forces = nullptr;        // may be null
  const T* displacement = nullptr;  // u
  const T* elastic_gradient = nullptr;
  const T* elements = nullptr;  // Field::report
  double* sums = nullptr;       // [batch, chunks, report_sums]
  double* info = nullptr;       // [batch, info_count], of the step, whose blanks are filled in

  PD_HD int chunks() const { return (plan.vertices + report_chunk - 1) / report_chunk; }
};

// The system of a step's adjoint, by the user's numbers of vertices.
template <class T, class P = Plan<T>>
struct AdjointSystemCall {
  P plan;
  Material<T> material;
  Values<T> elastic;       // [vertices] weighted diagonal of elasticity
  std::int64_t batch = 0;  // of the right sides
  std::int64_t rows =
      1;  // of inertia and inverse: 1, where environments share all that they come from, or the batch
  double time_step = 0;
  const T* grad_positions = nullptr;  // [batch, vertices, 3] each
  const T* grad_velocities = nullptr;
  T* right = nullptr;
  T* inertia = nullptr;  // [rows, vertices]
  T* inverse = nullptr;
  // what only contacts ask for, else null: the step [batch, vertices, 3], the gradient of its elastic energy, and what of every
  // vertex is free
  const T* after = nullptr;
  const T* positions = nullptr;
  const T* velocities = nullptr;
  const T* forces = nullptr;  // may be null
  const T* elastic_gradient = nullptr;
  T* projector = nullptr;  // [batch, vertices, 3, 3]
  bool* stuck = nullptr;   // [batch, vertices]
  T* sliding = nullptr;    // [batch, vertices, slide_count, 3]
};

// Vectors of a vertex that slides against the friction of one contact, else zero: friction times the direction of slip; the
// normal; the direction across both, times the square root of what the turning of the slip adds to H there. Of a surface that
// curves also the direction of slip, times the square root of what that takes off; and the third of them, times the motion
// along the normal over the radius, by which the slip turns less.
enum Slide : int { slide_along, slide_normal, slide_across, slide_bend, slide_lean, slide_count };

// What a solved adjoint says of the contacts that hold vertices.
template <class T, class P = Plan<T>>
struct ContactGradientsCall {
  AdjointSystemCall<T, P> step;   // whose outputs are not written
  const T* multiplier = nullptr;  // [batch, vertices, 3] each
  const T* elastic = nullptr;     // elastic Hessian times the multiplier
  // of every vertex, by the columns of views/material.def; zeros where it touches nothing; null where nobody wants them
  T* planes = nullptr;   // [batch, vertices, planes, planes_numbers]
  T* spheres = nullptr;  // [batch, vertices, spheres, spheres_numbers]
};

// What a solved adjoint says of the state before the step.
template <class T>
struct AdjointResultCall {
  Values<T> masses, damping;
  std::int64_t batch = 0, vertices = 0;
  double time_step = 0;
  const T* multiplier = nullptr;  // [batch, vertices, 3] each
  const T* grad_velocities = nullptr;
  const double* error = nullptr;  // of each environment
  std::int64_t error_stride = 1;
  // of a scene with contacts, else null: dL/dx', elastic Hessian times the multiplier, what contacts let through, and which
  // vertices friction holds
  const T* grad_positions = nullptr;
  const T* elastic = nullptr;
  const T* projector = nullptr;  // [batch, vertices, 3, 3]
  const bool* stuck = nullptr;   // [batch, vertices]
  const T* sliding = nullptr;    // [batch, vertices, slide_count, 3]
  T* out_positions = nullptr;
  T* out_velocities = nullptr;
  T* out_multiplier = nullptr;
};

// Numbers of an environment in the progress of a solve: r . z, |right side|, 1 while it goes on, 0 after, -1 before, and the
// residual relative to the right side. Before, the first iteration works out the others, by a residual that is the right side.
// No number for an error: something in right side or positions is infinite or no number.
enum ConjugateProgress : int {
  progress_product,
  progress_scale,
  progress_active,
  progress_error,
  progress_count
};

// Numbers of an environment in the progress of the solve that follows where vertices slide against friction, zero before: what it
// does next (FrictionStage), s . r of BiCGStab, the true residual relative to the right side, and products that are left.
enum FrictionProgress : int {
  friction_stage,
  friction_product,
  friction_error,
  friction_left,
  friction_count
};

// Iterations of conjugate gradients on (inertia + elastic Hessian) solution = right side, for each environment by itself;
// preconditioned by a diagonal, or by a plan's levels where it has them. With `friction` those of solver/adjoint/friction.h follow
// where something slides, and what it ends with is the multiplier.
template <class T, class P = Plan<T>>
struct ConjugateCall {
  P plan;
  Values<T> stiffness;
  Values<T> inertia, inverse;  // [vertices]; inverse diagonal, 0 where a vertex does not move
  std::int64_t batch = 0;
  const T* positions = nullptr;  // [batch, vertices, 3]
  const T* projector =
      nullptr;  // [batch, vertices, 3, 3] of what contacts let through; may be null
  const T* sliding =
      nullptr;  // [batch, vertices, slide_count, 3], whose slide_across H has; may be null
  const T* right = nullptr;    // [batch, vertices, 3], with friction
  double* friction = nullptr;  // [batch, friction_count]; null: no friction
  T* solution = nullptr;       // [batch, vertices, 3] each, from zero
  T* residual = nullptr;
  T* direction = nullptr;
  double* progress = nullptr;  // [batch, progress_count]
  double tolerance = 0;        // of the residual, relative to the right side
  int iterations = 0;          // products, where friction follows
};

// The approximation of A^-1 of a vector for each vertex.
template <class T>
struct PreconditionCall {
  Levels<T> levels;
  const int32* vertex_order = nullptr;
  std::int64_t batch = 0;
  const T* field = nullptr;  // [batch, vertices, 3]
  T* out = nullptr;          // [batch, vertices, 3]
};

template <class T>
struct RotationCall {
  std::int64_t count = 0;
  const T* matrices = nullptr;  // [count, 3, 3] F
  const T* direction =
      nullptr;       // [count, 3, 3]; null: the rotations, else their derivative along it
  T* out = nullptr;  // [count, 3, 3]
};

}  // namespace pd
