// The ops: schemas, checks, tensors to views. The only file that knows both torch and the physics.
#include "cpu/dispatch.h"

#include <ATen/ATen.h>
#include <ATen/Parallel.h>
#include <c10/util/Exception.h>
#include <torch/library.h>

#include <optional>
#include <string>

namespace pd {
namespace {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;

template <class T>
constexpr at::ScalarType scalar_type = sizeof(T) == 4 ? at::kFloat : at::kDouble;
template <>
constexpr at::ScalarType scalar_type<int32> = at::kInt;
template <>
constexpr at::ScalarType scalar_type<int16> = at::kShort;

std::string describe(const Tensor& t) {
  return c10::str(at::toString(t.scalar_type()), " ", t.sizes(), " on ", t.device().str());
}

// A contiguous CPU tensor of the given type, else an error that says what the argument is.
void check_storage(const Tensor& t, at::ScalarType type, const std::string& name,
                   const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == type, name, " must be ", at::toString(type), " (", meaning,
                   "), got ", describe(t));
  TORCH_CHECK_VALUE(t.device().is_cpu(), name, " must be on cpu like the other arguments (",
                    meaning, "), got ", describe(t));
  TORCH_CHECK_VALUE(t.is_contiguous(), name, " must be contiguous (", meaning, "), got strides ",
                    t.strides());
}

#define X(name, type, width, rows, meaning) +1
constexpr int plan_arrays = 0
#include "plan/plan.def"
    ;
#undef X

template <class T>
Plan<T> plan_view(at::TensorList arrays) {
  TORCH_CHECK_VALUE(arrays.size() == plan_arrays, "plan must be the ", plan_arrays,
                    " arrays of Plan.arrays, got ", arrays.size());
  Plan<T> plan;
  int at = 0;
  using real = T;
#define X(name, type, width, rows, meaning)                                                        \
  check_storage(arrays[at], scalar_type<type>, "plan." #name, meaning);                            \
  TORCH_CHECK_VALUE(                                                                               \
      arrays[at].dim() == (width > 1 ? 2 : 1) && (width == 1 || arrays[at].size(1) == width),      \
      "plan." #name " must be [" #rows, width > 1 ? ", " #width "] (" : "] (", meaning, "), got ", \
      describe(arrays[at]));                                                                       \
  const int name##_rows = int(arrays[at].size(0));                                                 \
  plan.name = arrays[at++].const_data_ptr<type>();
#include "plan/plan.def"
#undef X
  TORCH_CHECK_VALUE(
      patch_block_rows >= 2 && patch_vertex_rows == patch_block_rows &&
          patch_slot_rows == patch_block_rows && tet_rest_rows == tet_order_rows &&
          tet_volume_rows == tet_order_rows && tet_bound_rows == tet_order_rows &&
          tet_corner_rows == tet_order_rows && vertex_group_rows == vertex_order_rows &&
          shared_start_rows >= 1,
      "plan: arrays that belong together have different lengths; compile the scene again");
  plan.vertices = vertex_order_rows;
  plan.blocks = tet_order_rows;
  plan.pins = pin_vertex_rows;
  plan.groups = group_size_rows;
  plan.patches = patch_block_rows - 1;
  plan.slots = slot_vertex_rows;
  plan.shared = shared_start_rows - 1;
  for (int p = 0; p < plan.patches; ++p) {
    plan.most_slots = std::max(plan.most_slots, plan.patch_slot[p + 1] - plan.patch_slot[p]);
  }
  TORCH_CHECK_VALUE(plan.patch_block[plan.patches] == plan.blocks &&
                        plan.patch_slot[plan.patches] == plan.slots &&
                        plan.patch_vertex[plan.patches] + plan.shared == plan.vertices &&
                        plan.shared_start[plan.shared] == shared_slot_rows,
                    "plan: the ends of the patches do not match the lengths of the arrays; compile "
                    "the scene again");
  return plan;
}

template <class T>
Values<T> values_view(const Tensor& t, std::int64_t rows, std::int64_t width, bool single,
                      std::int64_t batch, const char* name, const char* meaning) {
  check_storage(t, scalar_type<T>, std::string("material.") + name, meaning);
  std::vector<std::int64_t> shape;
  if (!single) shape.push_back(rows);
  if (width > 1) shape.push_back(width);
  const at::IntArrayRef sizes = t.sizes();
  const bool own = sizes.size() == shape.size() + 1 && (sizes[0] == batch || sizes[0] == 1);
  TORCH_CHECK_VALUE((own ? sizes.slice(1) : sizes) == at::IntArrayRef(shape), "material.", name,
                    " must be ", at::IntArrayRef(shape), " or the same after a batch of ", batch,
                    " (", meaning, "), got ", describe(t));
  return {t.const_data_ptr<T>(), own && sizes[0] == batch ? rows * width : 0};
}

struct Rows {
  std::int64_t tet, vertex, pin, plane, sphere, one = 1;
};

#define X(name, width, rows, meaning) +1
constexpr int material_arrays = 0
#include "plan/material.def"
    ;
#undef X

std::int64_t rows_of(const Tensor& t, int width, const char* name) {
  const int own = width > 1 ? 2 : 1;
  TORCH_CHECK_VALUE(t.dim() == own || t.dim() == own + 1, "material.", name, " must have ", own,
                    " dimensions, or ", own + 1, " with a batch, got ", describe(t));
  return t.size(width > 1 ? -2 : -1);
}

template <class T>
Material<T> material_view(at::TensorList arrays, std::int64_t vertices, std::int64_t pins,
                          std::int64_t batch) {
  TORCH_CHECK_VALUE(arrays.size() == material_arrays, "material must be ", material_arrays,
                    " arrays, got ", arrays.size());
  Material<T> material;
  Rows count{0, vertices, pins, 0, 0};
  int at = 0;
#define X(name, width, rows, meaning)                                                          \
  if (std::string(#rows) == "tet") count.tet = rows_of(arrays[at], width, #name);              \
  if (std::string(#rows) == "plane") count.plane = rows_of(arrays[at], width, #name);          \
  if (std::string(#rows) == "sphere") count.sphere = rows_of(arrays[at], width, #name);        \
  material.name = values_view<T>(arrays[at++], count.rows, width, std::string(#rows) == "one", \
                                 batch, #name, meaning);
#include "plan/material.def"
#undef X
  material.planes_count = int(count.plane);
  material.spheres_count = int(count.sphere);
  return material;
}

// Elements that the stiffness must have: what the order of the plan reaches.
template <class T>
void check_tets(Plan<T>& plan, std::int64_t tets) {
  plan.tets = int(tets);
  TORCH_CHECK_VALUE(tets <= std::int64_t(plan.blocks) * 16 &&
                        tets > (std::int64_t(plan.blocks) - plan.patches) * 16 - 1,
                    "stiffness must have one value per tetrahedron of the plan (at most ",
                    std::int64_t(plan.blocks) * 16, "), got ", tets);
}

void check_state(const Tensor& t, const Tensor& like, const char* name, const char* meaning) {
  TORCH_CHECK_TYPE(t.scalar_type() == like.scalar_type(), name, " must be ",
                   at::toString(like.scalar_type()), " like positions (", meaning, "), got ",
                   describe(t));
  TORCH_CHECK_VALUE(t.sizes() == like.sizes(), name, " must be ", like.sizes(), " like positions (",
                    meaning, "), got ", describe(t));
  TORCH_CHECK_VALUE(t.device() == like.device(), name, " must be on ", like.device().str(),
                    " like positions (", meaning, "), got ", describe(t));
}

void check_positions(const Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must be float32 or float64 [batch, vertices, 3] (m), got ", describe(t));
  TORCH_CHECK_VALUE(t.dim() == 3 && t.size(2) == 3, name, " must be [batch, vertices, 3] (m), got ",
                    describe(t));
}

void check_vertices(const Tensor& positions, std::int64_t vertices) {
  TORCH_CHECK_VALUE(positions.size(1) == vertices, "positions must have the ", vertices,
                    " vertices of the plan, got ", describe(positions));
}

// What a step is told besides tensors, in the order of the schemas.
struct Numbers {
  std::int64_t schedule, iterations;
  double time_step, relaxation, rho;
  std::int64_t delay;
  bool weighted;
  double tolerance;
  bool inertial, report;
};

Settings settings_of(const Numbers& n, bool given, std::int64_t steps, std::int64_t every) {
  TORCH_CHECK_VALUE(n.schedule >= 0 && n.schedule <= 2,
                    "schedule must be 0 (jacobi), 1 (classic) or 2 (guarded), got ", n.schedule);
  TORCH_CHECK_VALUE(n.iterations >= 0 && n.iterations <= 1'000'000'000,
                    "iterations must be 0..1e9, got ", n.iterations);
  TORCH_CHECK_VALUE(n.time_step > 0 && std::isfinite(n.time_step),
                    "time_step must be positive and finite [s], got ", n.time_step);
  TORCH_CHECK_VALUE(n.relaxation > 0 && n.relaxation < 2, "relaxation must lie in (0, 2), got ",
                    n.relaxation);
  TORCH_CHECK_VALUE(n.rho >= 0 && n.rho < 1, "rho must lie in [0, 1), got ", n.rho);
  TORCH_CHECK_VALUE(n.delay >= 0, "delay must be >= 0, got ", n.delay);
  TORCH_CHECK_VALUE(n.tolerance >= 0, "tolerance must be >= 0, got ", n.tolerance);
  TORCH_CHECK_VALUE(steps >= 0 && every >= 1, "steps must be >= 0 and every >= 1, got ", steps,
                    " and ", every);
  Settings s;
  s.steps = int(steps);
  s.every = int(every);
  s.iterations = int(n.iterations);
  s.schedule = ScheduleKind(n.schedule);
  s.start = given ? StartKind::given : n.inertial ? StartKind::inertial : StartKind::velocity;
  s.time_step = n.time_step;
  s.relaxation = n.relaxation;
  s.rho = n.rho;
  s.tolerance = n.tolerance;
  s.delay = int(std::min<std::int64_t>(n.delay, 1'000'000'000));
  s.weighted = n.weighted;
  s.report = n.report;
  return s;
}

struct StepTensors {
  Tensor positions, velocities;
  OptionalTensor forces, start;
  at::TensorList material, plan;
  Tensor out_positions, out_velocities, info;
};

template <class T>
void step_typed(const StepTensors& t, const Settings& settings,
                void (*kernel)(const StepCall<T>&, int)) {
  StepCall<T> call;
  call.plan = plan_view<T>(t.plan);
  call.batch = t.positions.size(0);
  check_vertices(t.positions, call.plan.vertices);
  call.material = material_view<T>(t.material, call.plan.vertices, call.plan.pins, call.batch);
  check_tets(call.plan, t.material[0].size(-1));
  call.settings = settings;
  const Tensor x = t.positions.contiguous(), v = t.velocities.contiguous();
  const Tensor f = t.forces ? t.forces->contiguous() : Tensor(),
               s = t.start ? t.start->contiguous() : Tensor();
  call.positions = x.const_data_ptr<T>();
  call.velocities = v.const_data_ptr<T>();
  call.forces = f.defined() ? f.const_data_ptr<T>() : nullptr;
  call.start = s.defined() ? s.const_data_ptr<T>() : nullptr;
  call.out_positions = t.out_positions.mutable_data_ptr<T>();
  call.out_velocities = t.out_velocities.mutable_data_ptr<T>();
  call.info = t.info.mutable_data_ptr<double>();
  if (call.batch > 0 && settings.steps > 0) kernel(call, at::get_num_threads());
}

void run_step(const StepTensors& t, const Settings& settings) {
  check_positions(t.positions, "positions");
  check_state(t.velocities, t.positions, "velocities", "m/s");
  if (t.forces) check_state(*t.forces, t.positions, "forces", "N");
  if (t.start) check_state(*t.start, t.positions, "start", "first iterate, m");
  if (t.positions.scalar_type() == at::kFloat) {
    step_typed<float>(t, settings, kernels().step32);
  } else {
    step_typed<double>(t, settings, kernels().step64);
  }
}

Tensor info_for(const Tensor& positions, at::IntArrayRef records) {
  std::vector<std::int64_t> shape(records.begin(), records.end());
  shape.push_back(positions.size(0));
  shape.push_back(info_count);
  return at::empty(shape, positions.options().dtype(at::kDouble));
}

std::tuple<Tensor, Tensor, Tensor> step(const Tensor& positions, const Tensor& velocities,
                                        const OptionalTensor& forces, const OptionalTensor& start,
                                        at::TensorList material, at::TensorList plan,
                                        std::int64_t schedule, std::int64_t iterations,
                                        double time_step, double relaxation, double rho,
                                        std::int64_t delay, bool weighted, double tolerance,
                                        bool inertial, bool report) {
  check_positions(positions, "positions");
  const Numbers n{schedule, iterations, time_step, relaxation, rho,
                  delay,    weighted,   tolerance, inertial,   report};
  const Tensor x = at::empty(positions.sizes(), positions.options()), v = at::empty_like(x);
  const Tensor info = info_for(positions, {});
  run_step({positions, velocities, forces, start, material, plan, x, v, info},
           settings_of(n, start.has_value(), 1, 1));
  return {x, v, info};
}

void step_inplace(const Tensor& positions, const Tensor& velocities, const Tensor& info,
                  const OptionalTensor& forces, const OptionalTensor& start,
                  at::TensorList material, at::TensorList plan, std::int64_t schedule,
                  std::int64_t iterations, double time_step, double relaxation, double rho,
                  std::int64_t delay, bool weighted, double tolerance, bool inertial, bool report) {
  check_positions(positions, "positions");
  const Numbers n{schedule, iterations, time_step, relaxation, rho,
                  delay,    weighted,   tolerance, inertial,   report};
  TORCH_CHECK_VALUE(positions.is_contiguous() && velocities.is_contiguous(),
                    "step_: positions and velocities must be contiguous");
  TORCH_CHECK_VALUE(info.scalar_type() == at::kDouble && info.is_contiguous() && info.dim() == 2 &&
                        info.size(0) == positions.size(0) && info.size(1) == info_count,
                    "info must be a contiguous float64 [", positions.size(0), ", ", int(info_count),
                    "], got ", describe(info));
  // the state is read before it is written: loads and stores of an environment do not overlap in time
  run_step({positions, velocities, forces, start, material, plan, positions, velocities, info},
           settings_of(n, start.has_value(), 1, 1));
}

std::tuple<Tensor, Tensor, Tensor> rollout(
    const Tensor& positions, const Tensor& velocities, const OptionalTensor& forces,
    at::TensorList material, at::TensorList plan, std::int64_t steps, std::int64_t every,
    std::int64_t schedule, std::int64_t iterations, double time_step, double relaxation, double rho,
    std::int64_t delay, bool weighted, double tolerance, bool inertial, bool report) {
  check_positions(positions, "positions");
  const Numbers n{schedule, iterations, time_step, relaxation, rho,
                  delay,    weighted,   tolerance, inertial,   report};
  const Settings settings = settings_of(n, false, steps, every);
  const std::int64_t records = steps / every;
  const Tensor x =
      at::empty({records, positions.size(0), positions.size(1), 3}, positions.options());
  const Tensor v = at::empty_like(x), info = info_for(positions, {records});
  run_step({positions, velocities, forces, {}, material, plan, x, v, info}, settings);
  return {x, v, info};
}

template <class T>
void field_typed(Field field, const Tensor& positions, const Tensor& direction,
                 const Tensor& stiffness, at::TensorList plan, const Tensor& out,
                 void (*kernel)(const FieldCall<T>&, int)) {
  FieldCall<T> call;
  call.plan = plan_view<T>(plan);
  call.field = field;
  call.batch = positions.size(0);
  check_vertices(positions, call.plan.vertices);
  TORCH_CHECK_VALUE(stiffness.dim() == 1 || stiffness.dim() == 2,
                    "stiffness must be [tet] or [batch, tet] (Pa), got ", describe(stiffness));
  check_tets(call.plan, stiffness.size(-1));
  const Tensor w = stiffness.contiguous(), x = positions.contiguous();
  const Tensor d = direction.defined() ? direction.contiguous() : Tensor();
  call.stiffness =
      values_view<T>(w, call.plan.tets, 1, false, call.batch, "stiffness", "Young's modulus [Pa]");
  call.positions = x.const_data_ptr<T>();
  call.direction = d.defined() ? d.const_data_ptr<T>() : nullptr;
  call.out = out.mutable_data_ptr<T>();
  if (call.batch > 0) kernel(call, at::get_num_threads());
}

Tensor run_field(Field field, const Tensor& positions, const Tensor& direction,
                 const Tensor& stiffness, at::TensorList plan) {
  check_positions(positions, "positions");
  if (direction.defined()) check_state(direction, positions, "direction", "m");
  const bool per_element = field >= Field::element_energy;
  TORCH_CHECK_VALUE(stiffness.dim() >= 1, "stiffness must be [tet] or [batch, tet] (Pa), got ",
                    describe(stiffness));
  const Tensor out = per_element
                         ? at::empty({positions.size(0), stiffness.size(-1)}, positions.options())
                         : at::empty(positions.sizes(), positions.options());
  if (positions.scalar_type() == at::kFloat) {
    field_typed<float>(field, positions, direction, stiffness, plan, out, kernels().field32);
  } else {
    field_typed<double>(field, positions, direction, stiffness, plan, out, kernels().field64);
  }
  return out;
}

Tensor gradient(const Tensor& positions, const Tensor& stiffness, at::TensorList plan) {
  return run_field(Field::gradient, positions, {}, stiffness, plan);
}

Tensor hessian_product(const Tensor& positions, const Tensor& direction, const Tensor& stiffness,
                       at::TensorList plan) {
  return run_field(Field::hessian_product, positions, direction, stiffness, plan);
}

Tensor element_energy(const Tensor& positions, const Tensor& stiffness, at::TensorList plan) {
  return run_field(Field::element_energy, positions, {}, stiffness, plan);
}

Tensor element_energy_product(const Tensor& positions, const Tensor& direction,
                              const Tensor& stiffness, at::TensorList plan) {
  return run_field(Field::element_energy_product, positions, direction, stiffness, plan);
}

void check_matrices(const Tensor& t, const char* name) {
  TORCH_CHECK_TYPE(t.scalar_type() == at::kFloat || t.scalar_type() == at::kDouble, name,
                   " must be float32 or float64 [..., 3, 3], got ", describe(t));
  TORCH_CHECK_VALUE(t.dim() >= 2 && t.size(-1) == 3 && t.size(-2) == 3, name,
                    " must be [..., 3, 3], got ", describe(t));
}

template <class T>
void rotation_typed(const Tensor& matrices, const Tensor& direction, const Tensor& out,
                    void (*kernel)(const RotationCall<T>&, int)) {
  const Tensor f = matrices.contiguous(),
               d = direction.defined() ? direction.contiguous() : Tensor();
  const RotationCall<T> call{f.numel() / 9, f.const_data_ptr<T>(),
                             d.defined() ? d.const_data_ptr<T>() : nullptr,
                             out.mutable_data_ptr<T>()};
  if (call.count > 0) kernel(call, at::get_num_threads());
}

Tensor run_rotation(const Tensor& matrices, const Tensor& direction) {
  check_matrices(matrices, "matrices");
  if (direction.defined()) {
    check_matrices(direction, "direction");
    TORCH_CHECK_VALUE(
        direction.sizes() == matrices.sizes() && direction.scalar_type() == matrices.scalar_type(),
        "direction must be ", describe(matrices), " like matrices, got ", describe(direction));
  }
  const Tensor out = at::empty(matrices.sizes(), matrices.options());
  if (matrices.scalar_type() == at::kFloat) {
    rotation_typed<float>(matrices, direction, out, kernels().rotation32);
  } else {
    rotation_typed<double>(matrices, direction, out, kernels().rotation64);
  }
  return out;
}

Tensor nearest_rotation(const Tensor& matrices) { return run_rotation(matrices, {}); }

Tensor rotation_differential(const Tensor& matrices, const Tensor& direction) {
  return run_rotation(matrices, direction);
}

const std::string step_numbers =
    "int schedule, int iterations, float time_step, float relaxation, float rho, int delay, bool "
    "weighted, "
    "float tolerance, bool inertial, bool report";

}  // namespace

TORCH_LIBRARY(torchpd, m) {
  m.def(("step(Tensor positions, Tensor velocities, Tensor? forces, Tensor? start, Tensor[] "
         "material, Tensor[] plan, *, " +
         step_numbers + ") -> (Tensor, Tensor, Tensor)")
            .c_str());
  m.def(("step_(Tensor(a!) positions, Tensor(b!) velocities, Tensor(c!) info, Tensor? forces, "
         "Tensor? start, "
         "Tensor[] material, Tensor[] plan, *, " +
         step_numbers + ") -> ()")
            .c_str());
  m.def(("rollout(Tensor positions, Tensor velocities, Tensor? forces, Tensor[] material, Tensor[] "
         "plan, *, int steps, "
         "int every, " +
         step_numbers + ") -> (Tensor, Tensor, Tensor)")
            .c_str());
  m.def("gradient(Tensor positions, Tensor stiffness, Tensor[] plan) -> Tensor");
  m.def(
      "hessian_product(Tensor positions, Tensor direction, Tensor stiffness, Tensor[] plan) -> "
      "Tensor");
  m.def("element_energy(Tensor positions, Tensor stiffness, Tensor[] plan) -> Tensor");
  m.def(
      "element_energy_product(Tensor positions, Tensor direction, Tensor stiffness, Tensor[] plan) "
      "-> Tensor");
  m.def("nearest_rotation(Tensor matrices) -> Tensor");
  m.def("rotation_differential(Tensor matrices, Tensor direction) -> Tensor");
}

TORCH_LIBRARY_IMPL(torchpd, CPU, m) {
  m.impl("step", &step);
  m.impl("step_", &step_inplace);
  m.impl("rollout", &rollout);
  m.impl("gradient", &gradient);
  m.impl("hessian_product", &hessian_product);
  m.impl("element_energy", &element_energy);
  m.impl("element_energy_product", &element_energy_product);
  m.impl("nearest_rotation", &nearest_rotation);
  m.impl("rotation_differential", &rotation_differential);
}

}  // namespace pd
