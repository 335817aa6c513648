// One pass over the mesh: element forces patch by patch, then one visit of every vertex with its force.
//
// Interior vertices are visited right after their patch, while it is in the cache. Shared ones follow in a second
// pass that adds the patches' forces in patch order. The plan fixes the partition, so the bits do not depend on
// threads.
#pragma once
#include "cpu/step/stencil_blocks.h"
#include "cpu/step/workspace.h"
#include "elements/solid.h"
#include "threads/team.h"

#include <vector>

namespace pd::inline PD_TARGET {

// Positions, directions and forces of the slots of one patch, one per thread.
template <class Lanes>
struct Scratch {
  using Value = typename Lanes::Value;
  Value *x, *direction, *force;

  explicit Scratch(int slots) : storage_(allocate_zeroed(3 * sizeof(Value) * (slots + 1))) {
    x = reinterpret_cast<Value*>(storage_.get());
    direction = x + slots;
    force = direction + slots;
  }

 private:
  Storage storage_;
};

template <class Lanes, class T>
std::vector<Scratch<Lanes>> make_scratches(const Plan<T>& plan, int threads) {
  std::vector<Scratch<Lanes>> scratches;
  for (int i = 0; i < threads; ++i) scratches.emplace_back(plan.most_slots);
  return scratches;
}

// Sums over the visits of one part; components are added up at its end.
template <class Lanes>
struct Sums {
  typename Lanes::Value energy, first, second;
  typename Lanes::Real least;
};

// One operation on all elements: of tetrahedra, see each_element, and of stencils, see elements/stencil.h.
template <class Solid, class Stencil>
struct Elements {
  Solid solid;
  Stencil stencil;
};

template <bool Energy>
constexpr Elements<SolidGradient<Energy>, StencilGradient<Energy>> elastic_gradient(
    bool wanted = true) {
  return {{wanted}, {wanted}};
}

template <class Lanes>
struct Sweep {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  using Value = typename Lanes::Value;
  using Wide = typename Lanes::Wide;
  using Work = Workspace<Lanes>;

  const Plan<T>& plan;
  Work& work;
  Scratch<Lanes>& scratch;
  const Team& team;

  static Wide add_components(const Value& a) {
    const Vec3<Real> v = Lanes::vec3(a);
    return (Lanes::widen(v.x) + Lanes::widen(v.y)) + Lanes::widen(v.z);
  }

  static Sums<Lanes> no_sums() {
    const Real zero(T(0));
    const Value none = Lanes::value({zero, zero, zero});
    return {none, none, none, Real(T(HUGE_VAL))};
  }

  void record(int parity, int part, const Sums<Lanes>& sums, Wide elements) {
    work.parts[parity][part] = {Wide(0.5) * add_components(sums.energy) + elements,
                                add_components(sums.first), add_components(sums.second),
                                sums.least};
  }

  // the second field is the direction; visit(vertex, force, sums)
  template <int Fields = 1, class Solid, class Stencil, class Visit>
  void run(int parity, const Elements<Solid, Stencil>& element, Visit visit) {
    for (int patch = team.begin(plan.patches); patch < team.end(plan.patches); ++patch) {
      LaneSums<Lanes> lanes;
      lanes.clear();
      elements_of<Fields>(patch, lanes, element);
      Sums<Lanes> sums = no_sums();
      visit_interior(patch, visit, sums);
      record(parity, patch, sums, lanes.total());
    }
    team.barrier();
    const int chunks = work.part_count - plan.patches;
    for (int chunk = team.begin(chunks); chunk < team.end(chunks); ++chunk) {
      Sums<Lanes> sums = no_sums();
      visit_shared(chunk, visit, sums);
      record(parity, plan.patches + chunk, sums, Wide(0.0));
    }
    team.barrier();
  }

  // Numbers of a step of every element: the weights of tetrahedra, and those of the stencils.
  // `environment_of(lane)`: the environment whose material a lane has
  template <class EnvironmentOf>
  void set_weights(const Values<T>& stiffness, const Effects<T>& effects, WeightKind kind,
                   const EnvironmentOf& environment_of) {
    const int lanes = work.shared_weight ? 1 : Lanes::environments;
    const std::int64_t elements = std::int64_t(plan.blocks) * block_lanes;
    for (std::int64_t e = team.begin(elements); e < team.end(elements); ++e) {
      for (int lane = 0; lane < lanes; ++lane)
        work.set_weight(plan, stiffness, effects, environment_of(lane), e, e * lanes + lane, kind);
    }
  }

  // The numbers of all stencils but their memory.
  template <class EnvironmentOf>
  void set_stencil_numbers(const Effects<T>& effects, const EnvironmentOf& environment_of) {
    const int lanes = work.shared_numbers ? 1 : Lanes::environments;
    for (std::int64_t b = team.begin(plan.stencil_blocks); b < team.end(plan.stencil_blocks); ++b) {
      with_kind(plan.stencil_block[4 * b], [&](auto kind) {
        using Kind = decltype(kind);
        for (int lane = 0; lane < lanes; ++lane) {
          const MaterialRows<Kind, T> rows(effects, environment_of(lane));
          for (int first = 0; first < block_lanes; ++first) {
            const StencilPart<T> part{&plan, int(b), first};
            T number[Kind::numbers];
            rows.read(plan.stencil_row[part.stencil()], measure<Kind>(part), number);
            for (int i = 0; i < Kind::numbers - memory_of<Kind>; ++i)
              work.numbers[part.number(i) * lanes + lane] = number[i];
          }
        }
      });
    }
  }

  // V of a stencil; V / h where its energy dissipates.
  template <class Kind>
  T measure(const StencilPart<T>& part) const {
    const T volume = plan.stencil_measure[part.stencil()];
    return dissipates<Kind> ? volume * work.per_time : volume;
  }

  // The memory of all stencils, from the positions that `set_origins` took.
  void begin_stencils() {
    if (!plan.remembers) return;
    for (int patch = team.begin(plan.patches); patch < team.end(plan.patches); ++patch) {
      const int first = plan.patch_slot[patch], count = plan.patch_slot[patch + 1] - first;
      for (int slot = 0; slot < count; ++slot) scratch.x[slot] = work.origin[first + slot];
      stencils_of<1>(patch, StencilBegin{});
    }
  }

  // A pass over the stencils of a patch that adds no force; the slots stand in the scratch.
  template <int Fields, class Stencil>
  void stencils_of(int patch, const Stencil& stencil) {
    LaneSums<Lanes> unused;
    each_work<Fields>(patch, unused, stencil);
  }

  // Positions relative to the first vertex of each patch keep their last bits however far from the origin.
  void set_origins() {
    for (int patch = team.begin(plan.patches); patch < team.end(plan.patches); ++patch) {
      const int first = plan.patch_slot[patch], end = plan.patch_slot[patch + 1];
      const Value anchor = work.x[plan.slot_vertex[first]];
      for (int slot = first; slot < end; ++slot) {
        work.origin[slot] = work.x[plan.slot_vertex[slot]] - anchor;
      }
    }
  }

  // Copies the vertices of a patch's slots, for elements to read.
  template <int Fields>
  void gather_slots(int patch) {
    const int first = plan.patch_slot[patch], count = plan.patch_slot[patch + 1] - first;
    for (int slot = 0; slot < count; ++slot) {
      scratch.x[slot] = work.origin[first + slot] + work.u[plan.slot_vertex[first + slot]];
      if constexpr (Fields == 2)
        scratch.direction[slot] = work.before[plan.slot_vertex[first + slot]];
    }
  }

 private:
  template <int Fields, class Solid, class Stencil>
  void elements_of(int patch, LaneSums<Lanes>& lanes, const Elements<Solid, Stencil>& element) {
    gather_slots<Fields>(patch);
    const int count = plan.patch_slot[patch + 1] - plan.patch_slot[patch];
    const Real zero(T(0));
    const Value none = Lanes::value({zero, zero, zero});
    for (int slot = 0; slot < count; ++slot) scratch.force[slot] = none;
    const Value* fields[Fields];
    fields[0] = scratch.x;
    if constexpr (Fields == 2) fields[1] = scratch.direction;
    const auto& corners = const_cast<const Value* const(&)[Fields]>(fields);
    if (work.pressure) {
      groups_of<Fields>(patch, corners, lanes, element.solid);
    } else {
      using Tets = typename ElementsOf<Fields, Lanes, 0>::type;
      each_element(plan, patch, Tets(plan, corners, work.weights(), scratch.force, lanes),
                   element.solid);
    }
    if (plan.stencil_blocks) each_work<Fields>(patch, lanes, element.stencil);
  }

  template <int Fields, class Stencil>
  void each_work(int patch, LaneSums<Lanes>& lanes, const Stencil& stencil) {
    const Value* fields[Fields];
    fields[0] = scratch.x;
    if constexpr (Fields == 2) fields[1] = scratch.direction;
    const auto& corners = const_cast<const Value* const(&)[Fields]>(fields);
    each_stencil<Lanes>(plan, patch, [&](auto kind, const StencilPart<T>& part) {
      using Kind = decltype(kind);
      // without a step nothing dissipates, and no memory is there
      if (dissipates<Kind> && !(work.per_time > T(0))) return;
      stencil.template run<Kind>(StencilsAcross<Kind, Fields, Lanes>{
          part, corners, work.numbers, work.shared_numbers, scratch.force, lanes});
    });
  }

  // Tetrahedra with Poisson's ratio: apart, so that the loops without it stay as they are.
  template <int Fields, class Solid>
  [[gnu::noinline]] void groups_of(int patch, const Value* const (&corners)[Fields],
                                   LaneSums<Lanes>& lanes, const Solid& solid) {
    with_members(plan.members, [&]<int Members>() {
      using Tets = typename ElementsOf<Fields, Lanes, Members>::type;
      each_element(plan, patch, Tets(plan, corners, work.weights(), scratch.force, lanes), solid);
    });
  }

  template <class Visit>
  void visit_interior(int patch, Visit& visit, Sums<Lanes>& sums) {
    const int begin = plan.patch_vertex[patch], interior = plan.patch_vertex[patch + 1] - begin;
    const int first = plan.patch_slot[patch], count = plan.patch_slot[patch + 1] - first;
    for (int slot = 0; slot < interior; ++slot) visit(begin + slot, scratch.force[slot], sums);
    for (int slot = interior; slot < count; ++slot)
      work.shared_force[first + slot] = scratch.force[slot];
  }

  template <class Visit>
  void visit_shared(int chunk, Visit& visit, Sums<Lanes>& sums) {
    const int begin = chunk * shared_chunk;
    const int end = begin + shared_chunk < plan.shared ? begin + shared_chunk : plan.shared;
    const int first_vertex = plan.patch_vertex[plan.patches];
    for (int i = begin; i < end; ++i) {
      Value force = work.shared_force[plan.shared_slot[plan.shared_start[i]]];
      for (int s = plan.shared_start[i] + 1; s < plan.shared_start[i + 1]; ++s) {
        force = force + work.shared_force[plan.shared_slot[s]];
      }
      visit(first_vertex + i, force, sums);
    }
  }
};

}  // namespace pd::inline PD_TARGET
