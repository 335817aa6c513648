// Elastic energy and its derivatives at given positions, and their diagonal, environment by environment.
#pragma once
#include "cpu/step/sweep.h"
#include "elements/solid_fields.h"

namespace pd::inline PD_TARGET {

template <class T>
class FieldPass {
  using Lanes = Single<T>;
  using Sum = Sums<Lanes>;

 public:
  FieldPass(const FieldCall<T>& call, Workspace<Lanes>& work, Scratch<Lanes>& scratch,
            const Team& team)
      : call_(call),
        plan_(call.plan),
        w_(work),
        scratch_(scratch),
        team_(team),
        sweep_{plan_, work, scratch, team} {}

  void run(std::int64_t environment) {
    const auto none = one_by_one([](const auto&, int) {});
    load(environment);
    if (call_.field == Field::gradient) {
      vertex_field<1, 3>(environment, elastic_gradient<false>());
    } else if (call_.field == Field::diagonal) {
      vertex_field<1, 1>(environment, Elements{SolidDiagonal{}, StencilDiagonal{call_.weighted}});
    } else if (call_.field == Field::report) {
      vertex_field<1, 3>(environment, Elements{SolidReport{}, StencilReport{}});
    } else if (call_.field == Field::hessian_product) {
      vertex_field<2, 3>(environment, Elements{SolidHessian{}, StencilHessian{}});
    } else if (call_.field == Field::effect_energy) {
      sum_energy(environment);
    } else if (call_.field == Field::stiffness_at_rest) {
      write_stiffness(environment);
    } else if (call_.field == Field::effect_products || call_.field == Field::damping_products) {
      differentiate_by_effects(environment);
    } else if (call_.field == Field::damping_gradient) {
      vertex_field<1, 3>(environment, Elements{none, Dissipating<StencilGradient<false>>{}});
    } else if (call_.field == Field::damping_product) {
      vertex_field<2, 3>(environment, Elements{none, Dissipating<StencilHessian>{}});
    } else if (call_.field == Field::damping_start) {
      differentiate_by_start(environment);
    } else if (call_.field == Field::next_history) {
      each_history([&](auto kind, const StencilPart<T>& part) {
        keep_history<decltype(kind)>(environment, part);
      });
    } else if (call_.field == Field::next_history_product) {
      differentiate_history(environment);
    } else if (call_.field == Field::element_energy) {
      element_field<1, 1>(environment, ElementEnergy{});
    } else if (call_.field == Field::element_energy_product) {
      element_field<2, 1>(environment, ElementEnergyProduct{});
    } else if (call_.direction) {
      element_field<2, 2>(environment, LameProduct{});
    } else {
      element_field<1, 2>(environment, LameSlope{});
    }
    team_.barrier();
  }

 private:
  Quad<T> read(const T* from, std::int64_t environment, std::int64_t i) const {
    const T* p = from + (environment * plan_.vertices + plan_.vertex_order[i]) * 3;
    return to_quad(p[0], p[1], p[2]);
  }

  // Positions relative to each patch's first vertex, and displacements on top of them, as in a step.
  void load(std::int64_t environment) {
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i) {
      if (call_.positions) w_.x[i] = read(call_.positions, environment, i);
      if (call_.displacement) w_.u[i] = read(call_.displacement, environment, i);
      if (call_.direction) w_.before[i] = read(call_.direction, environment, i);
    }
    const auto environment_of = [&](int) { return environment; };
    const WeightKind kind = call_.field != Field::diagonal ? WeightKind::force
                            : call_.weighted               ? WeightKind::majoriser
                                                           : WeightKind::matrix;
    sweep_.set_weights(call_.stiffness, call_.effects, kind, environment_of);
    sweep_.set_stencil_numbers(call_.effects, environment_of);
    team_.barrier();
    sweep_.set_origins();
    team_.barrier();
    if (!plan_.remembers) return;
    sweep_.begin_stencils();
    team_.barrier();
  }

  template <int Fields, int Components, class Element>
  void vertex_field(std::int64_t environment, Element element) {
    sweep_.template run<Fields>(0, element, [&](std::int64_t i, const Quad<T>& force, Sum&) {
      T* to = call_.out + (environment * plan_.vertices + plan_.vertex_order[i]) * Components;
      for (int c = 0; c < Components; ++c) to[c] = force.q.v[c];
    });
  }

  void sum_energy(std::int64_t environment) {
    sweep_.run(0, elastic_gradient<true>(), [](std::int64_t, const Quad<T>&, Sum&) {});
    if (team_.rank != 0) return;
    double sum = 0;
    for (int part = 0; part < w_.part_count; ++part) sum += w_.parts[0][part].energy;
    call_.out[environment] = T(sum);
  }

  void write_stiffness(std::int64_t environment) {
    std::int64_t elements = plan_.tets;
    for (int k = 0; plan_.stencil_blocks && k < int(KindNumber::count); ++k)
      elements += plan_.stencil_sizes[stencil_size_count + k];
    T* const out = call_.out + environment * elements;
    const MatrixStiffness<T> stiffness(call_.stiffness, call_.effects, environment);
    for (std::int64_t t = team_.begin(plan_.tets); t < team_.end(plan_.tets); ++t)
      out[t] = stiffness(t);
    each_stencil_stiffness(plan_, call_.effects, environment, call_.per_time,
                           team_.begin(plan_.stencil_blocks), team_.end(plan_.stencil_blocks),
                           [&](T w, std::int64_t n) { out[n] = w; });
  }

  // By the positions at the start: first by the memory of each stencil, which stands in its place, then by them.
  void differentiate_by_start(std::int64_t environment) {
    for (int patch = team_.begin(plan_.patches); patch < team_.end(plan_.patches); ++patch) {
      sweep_.template gather_slots<2>(patch);
      sweep_.template stencils_of<2>(patch, StencilMemorySlope{});
    }
    team_.barrier();
    const Quad<T> zero = to_quad<T>(0, 0, 0);
    for (std::int64_t i = team_.begin(plan_.vertices); i < team_.end(plan_.vertices); ++i)
      w_.u[i] = zero;
    team_.barrier();
    const auto none = one_by_one([](const auto&, int) {});
    vertex_field<1, 3>(environment, Elements{none, StencilStartSlope{}});
  }

  // Each stencil adds to its own row of an array. Kinds may share the rows of tetrahedra, and take turns.
  void differentiate_by_effects(std::int64_t environment) {
    if (plan_.stencil_blocks == 0) return;
    const bool damping = call_.field == Field::damping_products;
    for (int number = 0; number < int(KindNumber::count); ++number) {
      if (plan_.stencil_sizes[stencil_size_count + number] == 0) continue;
      for (int patch = team_.begin(plan_.patches); patch < team_.end(plan_.patches); ++patch) {
        call_.direction ? sweep_.template gather_slots<2>(patch)
                        : sweep_.template gather_slots<1>(patch);
        each_stencil<Batch<T, 1>>(plan_, patch, [&](auto kind, const StencilPart<T>& part) {
          using Kind = decltype(kind);
          if (kind_number<Kind> == number && dissipates<Kind> == damping &&
              plan_.stencil_measure[part.stencil()] != T(0))
            add_products<Kind>(environment, part);
        });
      }
      team_.barrier();
    }
  }

  template <class Kind>
  void add_products(std::int64_t environment, const StencilPart<T>& part) {
    constexpr ArraysOf<Kind> arrays;
    const int number = plan_.stencil_row[part.stencil()];
    T g[gradient_numbers<Kind>], c[constant_slots<Kind>] = {}, row[Kind::rows] = {};
    for (int i = 0; i < gradient_numbers<Kind>; ++i) g[i] = *part.stored(i);
    for (int i = 0; i < Kind::constants; ++i) c[i] = *part.stored(gradient_numbers<Kind> + i);
    MaterialRows<Kind, T>(call_.effects, environment).values(number, row);
    T memory[memory_of<Kind> + 1];
    for (int i = 0; i < memory_of<Kind>; ++i)
      memory[i] = w_.numbers[part.number(Kind::numbers - memory_of<Kind> + i)];
    Vec3<T> x[Kind::corners], f[Kind::dims], df[Kind::dims] = {};
    for (int a = 0; a < Kind::corners; ++a) x[a] = to_vec3(scratch_.x[*part.corner(a)]);
    deform<Kind>(x, g, f);
    if (call_.direction) {
      for (int a = 0; a < Kind::corners; ++a) x[a] = to_vec3(scratch_.direction[*part.corner(a)]);
      deform<Kind>(x, g, df);
    }
    const std::int64_t count =
        reads_tets<Kind> ? plan_.tets : plan_.stencil_sizes[stencil_size_count + kind_number<Kind>];
    for (int a = 0; a < arrays.count; ++a) {
      if (!call_.products[arrays.effect[a]]) continue;
      T* out = call_.products[arrays.effect[a]] + (environment * count + number) * arrays.width(a);
      for (int i = 0; i < arrays.width(a); ++i) {
        const RowDerivative<Kind, T> by(arrays.first[a] + i, row,
                                        sweep_.template measure<Kind>(part), f, df, c, memory);
        out[i] = out[i] + (call_.direction ? by.product : by.energy);
      }
    }
  }

  // visit(kind, part) for every stencil that keeps a history, lane by lane, with padding; the slots stand in the scratch.
  template <class Visit>
  void each_history(const Visit& visit) {
    for (int patch = team_.begin(plan_.patches); patch < team_.end(plan_.patches); ++patch) {
      sweep_.template gather_slots<1>(patch);
      each_stencil<Batch<T, 1>>(plan_, patch, [&](auto kind, const StencilPart<T>& part) {
        if constexpr (history_of<decltype(kind)> > 0) visit(kind, part);
      });
    }
    team_.barrier();
  }

  // F and the rows of a stencil
  template <class Kind>
  void read_stencil(std::int64_t environment, const StencilPart<T>& part, Vec3<T> (&f)[Kind::dims],
                    T (&row)[Kind::rows]) const {
    T g[gradient_numbers<Kind>];
    Vec3<T> x[Kind::corners];
    for (int i = 0; i < gradient_numbers<Kind>; ++i) g[i] = *part.stored(i);
    for (int a = 0; a < Kind::corners; ++a) x[a] = to_vec3(scratch_.x[*part.corner(a)]);
    deform<Kind>(x, g, f);
    MaterialRows<Kind, T>(call_.effects, environment)
        .values(plan_.stencil_row[part.stencil()], row);
  }

  // Number of a stencil of a kind among those of all environments.
  template <class Kind>
  std::int64_t place_of(std::int64_t environment, const StencilPart<T>& part) const {
    return environment * plan_.stencil_sizes[stencil_size_count + kind_number<Kind>] +
           plan_.stencil_row[part.stencil()];
  }

  template <class Kind>
  void keep_history(std::int64_t environment, const StencilPart<T>& part) const {
    if (plan_.stencil_measure[part.stencil()] == T(0)) return;
    Vec3<T> f[Kind::dims];
    T row[Kind::rows] = {}, next[Kind::history];
    read_stencil<Kind>(environment, part, f, row);
    Kind::finish(f, row, T(1) / call_.per_time, next);
    T* out =
        call_.products[history_effect<Kind>] + place_of<Kind>(environment, part) * Kind::history;
    for (int i = 0; i < Kind::history; ++i) out[i] = next[i];
  }

  // First by the stress of each stencil, which stands in place of its numbers, then by the positions.
  void differentiate_history(std::int64_t environment) {
    each_history([&](auto kind, const StencilPart<T>& part) {
      add_history_products<decltype(kind)>(environment, part);
    });
    const auto none = one_by_one([](const auto&, int) {});
    vertex_field<1, 3>(environment, Elements{none, StencilStored{}});
  }

  template <class Kind>
  void add_history_products(std::int64_t environment, const StencilPart<T>& part) {
    using D = Dual<T>;
    constexpr ArraysOf<Kind> arrays;
    constexpr int columns = 3 * Kind::dims;
    const bool padding = plan_.stencil_measure[part.stencil()] == T(0);
    const std::int64_t place = place_of<Kind>(environment, part);
    const T* gradient = call_.history_gradients[history_effect<Kind>] + place * Kind::history;
    Vec3<T> f[Kind::dims];
    T row[Kind::rows] = {};
    read_stencil<Kind>(environment, part, f, row);
    // of the columns of F, then of the row
    const auto slope_by = [&](int which) {
      const auto number = [&](T value, int own) { return D(value, T(own == which ? 1 : 0)); };
      Vec3<D> at[Kind::dims];
      D rows[Kind::rows], next[Kind::history];
      for (int j = 0; j < Kind::dims; ++j)
        at[j] = {number(f[j].x, 3 * j), number(f[j].y, 3 * j + 1), number(f[j].z, 3 * j + 2)};
      for (int i = 0; i < Kind::rows; ++i) rows[i] = number(row[i], columns + i);
      Kind::finish(at, rows, D(T(1) / call_.per_time), next);
      T sum(0);
      for (int i = 0; i < Kind::history; ++i) sum = multiply_add(gradient[i], next[i].slope, sum);
      return sum;
    };
    for (int i = 0; i < columns; ++i) w_.numbers[part.number(i)] = padding ? T(0) : slope_by(i);
    for (int a = 0; !padding && a < arrays.count; ++a) {
      if (!call_.products[arrays.effect[a]]) continue;
      T* out = call_.products[arrays.effect[a]] + place * arrays.width(a);
      for (int i = 0; i < arrays.width(a); ++i) out[i] = slope_by(columns + arrays.first[a] + i);
    }
  }

  // Numbers of every element: `Numbers` a lane, from element.run<N>(elements, write).
  template <int Fields, int Numbers, class Element>
  void element_field(std::int64_t environment, const Element& element) {
    for (int patch = team_.begin(plan_.patches); patch < team_.end(plan_.patches); ++patch) {
      sweep_.template gather_slots<Fields>(patch);
      const Quad<T>* fields[Fields];
      fields[0] = scratch_.x;
      if constexpr (Fields == 2) fields[1] = scratch_.direction;
      const auto& corners = const_cast<const Quad<T>* const(&)[Fields]>(fields);
      with_members(w_.pressure ? plan_.members : 0, [&]<int Members>() {
        LaneSums<Lanes> unused;
        const auto write = [&](const auto& elements, int s, const auto&... number) {
          write_lanes<Numbers>(environment, elements.part(s), {number...});
        };
        each_element(
            plan_, patch,
            ElementsAcross<Fields, T, Members>(plan_, corners, w_.weights(), nullptr, unused),
            Written<Element, decltype(write)>{element, write});
      });
    }
  }

  // Passes the numbers of an element field on.
  template <class Element, class Write>
  struct Written {
    static constexpr int strip = 1;
    const Element& element;
    const Write& write;

    template <int N, class Elements>
    PD_HD void run(const Elements& elements) const {
      element.template run<N>(elements, write);
    }
  };

  template <int Numbers>
  void write_lanes(std::int64_t environment, const BlockPart<T>& part,
                   const Pack<T, native_width<T>> (&number)[Numbers]) {
    for (int lane = 0; lane < native_width<T>; ++lane) {
      const std::int64_t e = part.element() + lane;
      // padding repeats an element of the patch with zero volume: it must not write
      if (plan_.tet_volume[e] == T(0)) continue;
      T* to = call_.out + (environment * plan_.tets + plan_.tet_order[e]) * Numbers;
      for (int n = 0; n < Numbers; ++n) to[n] = number[n].v[lane];
      if constexpr (Numbers == 2) to_parameters(environment, e, to);
    }
  }

  // By E and nu, from slopes by V 2 mu and V lambda.
  void to_parameters(std::int64_t environment, std::int64_t e, T* slope) const {
    const int32 t = plan_.tet_order[e];
    const LameSlopes<T> by(call_.stiffness.of(environment)[t],
                           call_.effects.poisson.of(environment)[t]);
    if (plan_.tet_bound[e] < 0) slope[1] = 0;  // without lambda
    by.chain(plan_.tet_volume[e], slope);
  }

  const FieldCall<T>& call_;
  const Plan<T>& plan_;
  Workspace<Lanes>& w_;
  Scratch<Lanes>& scratch_;
  const Team& team_;
  Sweep<Lanes> sweep_;
};

}  // namespace pd::inline PD_TARGET
