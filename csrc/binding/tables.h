// The tables that Python reads: constant arrays, material, settings and kinds of stencils.
#pragma once
#include "binding/settings.h"
#include "elements/kinds.h"
#include "views/views.h"

#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <span>
#include <string>
#include <vector>

namespace pd::python {

namespace py = pybind11;

// The shape of a kind of stencils, see elements/stencil.h.
struct KindShape {
  const char* name;
  int corners, dims, constants, numbers;
  bool of_tets;  // whether it reads the material of tetrahedra
  std::vector<std::string> rows;
  const char* meaning;
  bool large;     // see elements/stencil.h
  int quadratic;  // arrays that make its energy quadratic; 0: none do
  bool on_gpu;    // whether a GPU has kernels for it
  bool keeps_axes;
};

inline std::vector<KindShape> kind_shapes() {
  std::vector<KindShape> kinds;
#define KIND(name, type, what)                     \
  kinds.push_back({#name,                          \
                   pd::type::corners,              \
                   pd::type::dims,                 \
                   pd::type::constants,            \
                   pd::type::numbers,              \
                   pd::reads_tets<pd::type>,       \
                   {},                             \
                   what,                           \
                   pd::is_large<pd::type>,         \
                   pd::quadratic_arrays<pd::type>, \
                   pd::runs_on_gpu<pd::type>,      \
                   pd::keeps_axes<pd::type>});
#define PARAMETER(name, array) kinds.back().rows.push_back(#array);
#include "elements/kinds.def"
#undef KIND
  return kinds;
}

// Tables of constant arrays, in the order in which ops take them.
struct TableRow {
  const char *name, *type;
  int width;
  const char *rows, *meaning;
};

#define X(name, type, width, rows, meaning) TableRow{#name, #type, width, #rows, meaning},
constexpr TableRow plan_rows[] = {
#include "views/cpu_plan.def"
};
constexpr TableRow stencil_rows[] = {
#include "views/cpu_stencils.def"
};
constexpr TableRow multilevel_rows[] = {
#include "views/multilevel.def"
};
constexpr TableRow device_plan_rows[] = {
#include "views/gpu_plan.def"
};
constexpr TableRow device_stencil_rows[] = {
#include "views/gpu_stencils.def"
#include "views/gpu_step_rows.def"
};
#undef X

inline py::list table(std::span<const TableRow> rows) {
  py::list all;
  for (const TableRow& row : rows)
    all.append(py::make_tuple(row.name, row.type, row.width, row.rows, row.meaning));
  return all;
}

inline py::list material_table() {
  py::list rows;
#define X(name, width, rows_, meaning) \
  rows.append(py::make_tuple(#name, width, #rows_, meaning, false, false));
#define EFFECT(name, width, rows_, meaning) \
  rows.append(py::make_tuple(#name, width, #rows_, meaning, true, false));
#define HISTORY(name, width, rows_, meaning) \
  rows.append(py::make_tuple(#name, width, #rows_, meaning, true, true));
#include "views/material.def"
#undef X
  return rows;
}

inline py::list material_columns() {
  py::list columns;
#define X(name, width, rows, meaning)
#define COLUMN(array, name, width, meaning) \
  columns.append(py::make_tuple(#array, #name, int(pd::array##_##name), width, meaning));
#include "views/material.def"
#undef X
  return columns;
}

inline py::list settings_table() {
  py::list rows;
#define X(name, type, usual, holds, contract, meaning) \
  rows.append(py::make_tuple(#name, schema_type<type>, Given<type>(usual), contract, meaning));
#include "views/settings.def"
#undef X
  return rows;
}

inline py::list kind_table() {
  py::list rows;
  for (const KindShape& kind : kind_shapes())
    rows.append(py::make_tuple(kind.name, kind.corners, kind.dims, kind.constants,
                               py::tuple(py::cast(kind.rows)), kind.meaning, kind.quadratic,
                               kind.on_gpu));
  return rows;
}

inline py::list device_sizes() {
  py::list names;
#define X(name, meaning) names.append(#name);
#include "views/gpu_sizes.def"
#undef X
  return names;
}

}  // namespace pd::python
