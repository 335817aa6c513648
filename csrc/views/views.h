// The plain structs of pointers that kernels read, made from the tables. Independent of torch and of any device.
#pragma once

#include "math/device.h"

#include <cstdint>

namespace pd {

using int16 = std::int16_t;
using int32 = std::int32_t;

// Entries of a plan's array of sizes.
enum PlanSize : int {
  plan_vertices,
  plan_tets,
  plan_pins,
  plan_components,
  plan_blocks,
  plan_patches,
  plan_slots,
  plan_shared,
  plan_most_slots,
  plan_members,
  plan_solid_components,
  plan_size_count
};

// Entries of a preconditioner's array of sizes; without a middle level its entries are 0.
enum LevelSize : int {
  level_fine_entries,
  level_fine_prolongations,
  level_fine_nodes,  // below the fine level
  level_middle_entries,
  level_middle_prolongations,
  level_middle_nodes,     // below the middle level
  level_direct,           // 1: no levels, A itself is solved directly
  level_pieces,           // of the coarse space of L-BFGS
  level_piece_packs,      // of tetrahedra that the same pieces move; 0 on a GPU
  level_piece_row_tasks,  // on a GPU: for sums of pairs of pieces over rows of A, and their rows
  level_piece_rows,
  level_piece_tet_tasks,  // the same over tetrahedra
  level_piece_tets,
  level_size_count
};

// A multilevel approximation of A^-1: see plan/multilevel/build.h and solver/multilevel/lbfgs.h. Without one all are null.
template <class T>
struct Levels {
  using real = T;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/multilevel.def"
#undef X
  int vertices = 0, fine_nodes = 0, middle_nodes = 0, pieces = 0, piece_packs = 0;
  int piece_row_tasks = 0, piece_tet_tasks = 0;
  bool direct = false;

  PD_HD bool there() const { return fine_start != nullptr; }
  PD_HD bool has_middle() const { return middle_nodes > 0; }
  PD_HD int coarse_unknowns() const {
    return direct ? vertices : 4 * (has_middle() ? middle_nodes : fine_nodes);
  }
};

// The counts of a plan or its levels, from their array of sizes; without the other arrays.
template <class T>
Levels<T> count_levels(const int32* sizes, int vertices) {
  Levels<T> levels;
  levels.vertices = vertices;
  levels.fine_nodes = sizes[level_fine_nodes];
  levels.middle_nodes = sizes[level_middle_nodes];
  levels.direct = sizes[level_direct] != 0;
  levels.pieces = sizes[level_pieces];
  levels.piece_packs = sizes[level_piece_packs];
  levels.piece_row_tasks = sizes[level_piece_row_tasks];
  levels.piece_tet_tasks = sizes[level_piece_tet_tasks];
  return levels;
}

// Entries of a plan's array of sizes of stencils; then the number of stencils of each kind.
enum StencilSize : int {
  stencil_blocks,
  stencil_corner_rows,
  stencil_stored_rows,
  stencil_number_rows,
  stencil_size_count
};

// Entries of a GPU plan's array of sizes of rows.
enum RowSize : int {
  row_lines,  // rows of row_neighbour
  row_blocks,
  row_terms,
  row_slots,          // slots of all patches
  row_pair_blocks,    // blocks of pairs of tetrahedra
  row_corner_rows,    // rows of step_corner
  row_step_entries,   // most entries of a step in a patch, padding included
  row_step_stencils,  // blocks of stencils that are elements of a step
  row_kinds,          // bit k: the stencils of kind k are rows
  row_size_count
};

template <class T>
struct EffectViews;
template <class T>
struct DeviceEffectViews;

template <class T>
struct Plan {
  using real = T;
  using EffectViews = pd::EffectViews<T>;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/cpu_plan.def"
#include "views/cpu_stencils.def"
#undef X
  int vertices = 0, tets = 0, pins = 0, components = 0, solid_components = 0, blocks = 0,
      patches = 0, slots = 0, shared = 0;
  int most_slots = 0;  // of any patch
  int members = 1;     // tetrahedra of a group that averages its trace: 1, 2 or 4
  int stencil_blocks = 0,
      stencil_numbers = 0;  // blocks of 16 stencils; rows of 16 numbers of a step
  bool remembers = false;   // some stencils have numbers of the start of a step
  Levels<T> levels;
};

// Numbers of a pair of tetrahedra in pair_rest, see gpu_plan.def.
constexpr int pair_rest_numbers = 12;

// Entries of DevicePlan::sizes, which are members of DevicePlan too.
enum DeviceSize : int {
#define X(name, meaning) size_##name,
#include "views/gpu_sizes.def"
#undef X
  size_count
};

// The constant arrays of a GPU plan for tetrahedra. All but `sizes` are in the GPU's memory.
template <class T>
struct DevicePlan {
  using real = T;
  using EffectViews = DeviceEffectViews<T>;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/gpu_plan.def"
#undef X
#define X(name, meaning) int name = 0;
#include "views/gpu_sizes.def"
#undef X
  Levels<T> levels;
};

// The constant arrays of its stencils. All but `stencil_sizes` are in the GPU's memory.
template <class T>
struct DeviceStencils {
  using real = T;
#define X(name, type, width, rows, meaning) const type* name = nullptr;
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
#undef X
  const int32* stencil_end = nullptr;  // [patches] end of the blocks of stencils that are elements
  int blocks = 0, number_rows = 0;     // blocks of 32 stencils; rows of 32 numbers of a step
  bool remembers = false;              // some stencils have numbers of the start of a step
  bool reads_tets = false;             // some read the material of tetrahedra
  int rows[row_size_count] = {};

  PD_HD bool has_rows() const { return rows[row_blocks] > 0; }
  // numbers of the rows: t of all neighbours, and two diagonals
  PD_HD std::int64_t numbers_of_rows() const {
    return 64 * (std::int64_t(rows[row_lines]) + rows[row_blocks]);
  }
};

// A call on a GPU with what only scenes with stencils have; blocks = 0 without them.
template <class Call>
struct Mixed : Call, EffectViews<typename Call::real> {
  DeviceStencils<typename Call::real> stencils;
};

// A step's call, with its own entries where the plan has rows.
template <class Call>
Mixed<Call> with_rows(Mixed<Call> step) {
  auto& stencils = step.stencils;
  if (!stencils.has_rows()) return step;
  step.plan.slot_row = stencils.step_row;
  step.plan.pair_corner = stencils.step_pair_corner;
  step.plan.most_entries = stencils.rows[row_step_entries];
  stencils.stencil_corner = stencils.step_corner;
  stencils.stencil_end = stencils.patch_element;
  return step;
}

// The counts of a plan or its levels, from their array of sizes; without the other arrays.
template <class T>
DevicePlan<T> count_device_plan(const int32* sizes) {
  DevicePlan<T> plan;
#define X(name, meaning) plan.name = sizes[size_##name];
#include "views/gpu_sizes.def"
#undef X
  return plan;
}

// Largest number of blocks: kernels count the corners of all pairs, 5 times 32 a block, in 32 bits (cuda/elements/pairs_per_thread.h).
constexpr std::int64_t most_blocks = (std::int64_t(1) << 32) / (5 * 32);

// Numbers in a row of each array of the material.
enum MaterialWidth : int {
#define X(name, width, rows, meaning) name##_numbers = width,
#define EFFECT X
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

// The arrays that stencils read: the stiffness of tetrahedra, and those that only some scenes have. Data is null where
// a scene lacks them.
template <class T>
struct Effects {
  Values<T> stiffness;
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning) Values<T> name;
#include "views/material.def"
#undef X
};

enum EffectNumber : int {
  effect_stiffness,
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning) effect_##name,
#include "views/material.def"
#undef X
  effect_count
};

// The arrays of the effects, as a base of calls. On a GPU only scenes with stencils pass them: see Mixed.
template <class T>
struct EffectViews {
  Effects<T> effects;
  // Field::effect_products: for each array of the effects [batch, rows], null if not wanted. Field::next_history: what
  // is kept
  T* products[effect_count] = {};
  const T* history_gradients[effect_count] = {};  // Field::next_history_product
};
// On a GPU, of tetrahedra; data is null without Poisson's ratio.
template <class T>
struct DeviceEffectViews {
  Values<T> poisson;
};

template <class T>
struct Material {
#define X(name, width, rows, meaning) Values<T> name;
#include "views/material.def"
#undef X
  int planes_count = 0, spheres_count = 0;
};

// Whether all environments have the same arrays.
template <class T>
bool shares_effects(const Effects<T>& effects) {
  bool shared = true;
#define X(name, width, rows, meaning)
#define EFFECT(name, width, rows, meaning) shared = shared && effects.name.stride == 0;
#include "views/material.def"
#undef X
  return shared;
}

// from lbfgs on, the solver is multilevel
enum class ScheduleKind : int {
  jacobi = 0,
  classic = 1,
  guarded = 2,
  lbfgs = 3,
  momentum = 4,
  newton = 5
};
enum class StartKind : int { velocity = 0, inertial = 1, given = 2 };

struct Settings {
  int steps = 1, every = 1;  // steps to take, and how many of them lie between two records
#define X(name, type, usual, holds, contract, meaning) type name = usual;
#include "views/settings.def"
#undef X

  PD_HD StartKind start() const { return inertial; }
  PD_HD bool multilevel() const { return schedule >= ScheduleKind::lbfgs; }
  PD_HD bool newton() const { return schedule == ScheduleKind::newton; }
  // whether a line search takes directions of L-BFGS or Newton
  PD_HD bool learns() const { return multilevel() && schedule != ScheduleKind::momentum; }
};

// Entries of an info row, double each. A step leaves residual and energy NaN and inverted -1; a report fills them in.
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

// Inputs and outputs of a call of step or rollout. Positions are in the user's order, [batch, vertices, 3].
template <class T, class P = Plan<T>>
struct StepCall : P::EffectViews {
  using real = T;
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

// Fields of the elastic energy at given positions: its derivatives, and the diagonal that bounds the second ones.
enum class Field : int {
  gradient,
  hessian_product,
  element_energy,
  element_energy_product,
  diagonal,
  report,             // see SolidReport
  effect_energy,      // elastic energy of all elements
  lame_product,       // derivatives by E and nu, of gradient times direction or else of the energy
  effect_products,    // derivatives by the arrays of the effects
  stiffness_at_rest,  // of every element, as preconditioners take it
  // the same of the energies that a step dissipates, with per_time: see dissipates in elements/stencil.h
  damping_gradient,
  damping_product,  // Hessian times direction
  damping_start,  // derivative of gradient times direction by the positions at the start of the step
  damping_products,
  // what stencils keep for the next step, of length 1 / per_time, at its end; and derivatives of its product with given
  // gradients: by the arrays of the effects, and by the positions
  next_history,
  next_history_product
};

inline bool is_of_damping(Field field) {
  return field == Field::damping_gradient || field == Field::damping_product ||
         field == Field::damping_start || field == Field::damping_products;
}

template <class T, class P = Plan<T>>
struct FieldCall : P::EffectViews {
  using real = T;
  P plan;
  Field field = Field::gradient;
  Values<T> stiffness;
  std::int64_t batch = 0;
  bool weighted = false;         // weighted by l_e; for the diagonal
  T per_time = 0;                // 1 / h, or 0 without a step: `positions` are those at its start
  const T* positions = nullptr;  // [batch, vertices, 3], for all but the diagonal
  const T* displacement =
      nullptr;  // [batch, vertices, 3] added to the positions without rounding the sum; may be null
  const T* direction = nullptr;  // [batch, vertices, 3], for the products
  T* out =
      nullptr;  // [batch, vertices, 3], [batch, tets] of element energies, [batch, tets, 2] of lame_product,
                // [batch, vertices] of the diagonal
  // stiffness_at_rest: [batch, elements], tetrahedra and then stencils kind by kind
};

// Sums over the vertices of an environment for a report, see solver/report.h.
enum ReportSum : int {
  report_energy,
  report_residual,
  report_force,
  report_rounding,
  report_inverted,
  report_invalid,
  report_sums
};

// Vertices in one row of sums.
constexpr int report_chunk = 256;

// The report of a solved step, by the user's numbers of vertices.
template <class T, class P = Plan<T>>
struct ReportCall {
  P plan;
  Material<T> material;
  Values<T> elastic;  // [vertices] elastic diagonal, as in the step
  std::int64_t batch = 0;
  double time_step = 0;
  const T* positions = nullptr;  // [batch, vertices, 3] each, at the start of the step
  const T* velocities = nullptr;
  const T* forces = nullptr;        // may be null
  const T* displacement = nullptr;  // u
  const T* elastic_gradient = nullptr;
  const T* elements = nullptr;  // Field::report
  const T* contact = nullptr;   // forces between bodies [batch, contact_rows, 3], or null
  std::int64_t contact_rows = 0;
  double* sums = nullptr;  // [batch, chunks, report_sums]
  double* info = nullptr;  // [batch, info_count] of the step; the report fills in its blanks

  PD_HD int chunks() const { return (plan.vertices + report_chunk - 1) / report_chunk; }
};

// The system of a step's adjoint, by the user's numbers of vertices.
template <class T, class P = Plan<T>>
struct AdjointSystemCall {
  P plan;
  Material<T> material;
  Values<T> elastic;       // [vertices] weighted diagonal of elasticity
  std::int64_t batch = 0;  // batch of the right sides
  std::int64_t rows =
      1;  // rows of inertia and inverse: 1 if environments share all their inputs, else the batch
  double time_step = 0;
  const T* grad_positions = nullptr;  // [batch, vertices, 3] each
  const T* grad_velocities = nullptr;
  T* right = nullptr;
  T* inertia = nullptr;  // [rows, vertices]
  T* inverse = nullptr;
  // inputs of contacts, else null: the step [batch, vertices, 3], the gradient of its elastic energy, and outputs
  // that say which directions of a vertex are free
  const T* after = nullptr;
  const T* positions = nullptr;
  const T* velocities = nullptr;
  const T* forces = nullptr;  // may be null
  const T* elastic_gradient = nullptr;
  T* projector = nullptr;  // [batch, vertices, 3, 3]
  bool* stuck = nullptr;   // [batch, vertices]
  T* sliding = nullptr;    // [batch, vertices, slide_count, 3]
};

// Vectors of a vertex that slides against the friction of one contact, else zero.
//   along    friction times the direction of slip
//   normal   the contact normal
//   across   third direction, times the square root of the term that the slip's rotation adds to H
//   bend     direction of slip, times the square root of the term that a curved surface takes from H
//   lean     across, times the motion along the normal over the radius: the slip rotates less by it
enum Slide : int { slide_along, slide_normal, slide_across, slide_bend, slide_lean, slide_count };

// Gradients by the contacts that hold vertices, from a solved adjoint.
template <class T, class P = Plan<T>>
struct ContactGradientsCall {
  AdjointSystemCall<T, P> step;   // its outputs are not written
  const T* multiplier = nullptr;  // [batch, vertices, 3] each
  const T* elastic = nullptr;     // elastic Hessian times the multiplier
  // for every vertex, by the columns of views/material.def; zeros where it touches nothing; null if not requested
  T* planes = nullptr;   // [batch, vertices, planes, planes_numbers]
  T* spheres = nullptr;  // [batch, vertices, spheres, spheres_numbers]
};

// Gradients by the state before the step, from a solved adjoint.
template <class T>
struct AdjointResultCall {
  Values<T> masses, damping;
  std::int64_t batch = 0, vertices = 0;
  double time_step = 0;
  const T* multiplier = nullptr;  // [batch, vertices, 3] each
  const T* grad_velocities = nullptr;
  const double* error = nullptr;  // error of each environment
  std::int64_t error_stride = 1;
  // only with contacts, else null: dL/dx', elastic Hessian times the multiplier, projector on the free directions,
  // and the vertices that friction holds
  const T* grad_positions = nullptr;
  const T* elastic = nullptr;
  const T* projector = nullptr;  // [batch, vertices, 3, 3]
  const bool* stuck = nullptr;   // [batch, vertices]
  const T* sliding = nullptr;    // [batch, vertices, slide_count, 3]
  T* out_positions = nullptr;
  T* out_velocities = nullptr;
  T* out_multiplier = nullptr;
};

template <class T>
struct LoadedPairs;  // solver/adjoint/pair_views.h

// An environment's entries in the progress of a solve: r . z; |right side|; 1 while it runs, 0 after, -1 before; and
// the residual relative to the right side. The first iteration computes the other entries from a residual that equals
// the right side. The error is NaN if right side or positions are infinite or NaN.
enum ConjugateProgress : int {
  progress_product,
  progress_scale,
  progress_active,
  progress_error,
  progress_count
};

// An environment's entries in the progress of the BiCGStab solve, zero before: its next stage (FrictionStage), s . r,
// the true residual relative to the right side, and the products left.
enum FrictionProgress : int {
  friction_stage,
  friction_product,
  friction_error,
  friction_products_left,
  friction_count
};

// Conjugate gradients on (inertia + elastic Hessian) solution = right side, for each environment by itself. The
// preconditioner is a diagonal, or a plan's levels where it has them. With `friction` the solve of
// solver/adjoint/friction.h follows where vertices slide; its solution is the multiplier.
template <class T, class P = Plan<T>>
struct ConjugateCall : P::EffectViews {
  using real = T;
  P plan;
  Values<T> stiffness;
  Values<T> inertia, inverse;  // [vertices]; inverse diagonal, 0 where a vertex does not move
  std::int64_t batch = 0;
  T per_time = 0;                // 1 / h, or 0 without dissipation
  const T* positions = nullptr;  // [batch, vertices, 3]
  const T* start = nullptr;      // the same at the start of the step, with per_time
  const T* projector = nullptr;  // [batch, vertices, 3, 3] on the free directions; may be null
  const T* sliding =
      nullptr;  // [batch, vertices, slide_count, 3], slide_across being part of H; may be null
  const T* right = nullptr;    // [batch, vertices, 3], with friction
  double* friction = nullptr;  // [batch, friction_count]; null: no friction
  T* solution = nullptr;       // [batch, vertices, 3] each, from zero
  T* residual = nullptr;
  T* direction = nullptr;
  double* progress = nullptr;             // [batch, progress_count]
  double tolerance = 0;                   // of the residual, relative to the right side
  int iterations = 0;                     // counts products if friction follows
  const LoadedPairs<T>* pairs = nullptr;  // of surfaces; may be null
};

// Applies the approximation of A^-1 to a vector for each vertex.
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
