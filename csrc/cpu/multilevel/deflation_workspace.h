// What the threads of a team share of the small problem of solver/multilevel/deflation.h.
#pragma once
#include "cpu/step/workspace.h"
#include "solver/multilevel/deflation.h"

#include <algorithm>
#include <array>

namespace pd::inline PD_TARGET {

// Zeroed items, aligned for vectors.
template <class Item>
class Row {
 public:
  explicit Row(std::size_t count)
      : count_(count),
        storage_(allocate_zeroed(count * sizeof(Item))),
        items_(reinterpret_cast<Item*>(storage_.get())) {}

  Item& operator[](std::size_t i) const { return items_[i]; }
  Item* begin() const { return items_; }
  Item* end() const { return items_ + count_; }
  std::size_t size() const { return count_; }

 private:
  std::size_t count_;
  Storage storage_;
  Item* items_;
};

// Memory of it, for all threads of a team; none where it is not `wanted`.
template <class Lanes>
struct CorotationWork {
  using T = typename Lanes::Scalar;
  using Real = typename Lanes::Real;
  static constexpr int width = Lanes::environments, chunk = 256;

  struct Numbers {
    Real of[turning_numbers];
  };
  struct Products {
    double inertia[turning_numbers][turning_numbers], matrix[turning_numbers][turning_numbers];
  };
  struct Inverses {
    TurningMatrix energy, matrix;  // Hc^-1, Ac^-1
  };
  // Hc before contacts hold it.
  struct Unheld {
    TurningMatrix energy;
    double scale[turning_modes];  // of the diagonal of Ac
    bool sound, held;             // whether it could be made; whether Hc^-1 has contacts
  };

  int chunks;
  Row<Numbers> numbers, images;                    // [vertices] (w, w r), and A times them
  Row<typename Lanes::Value> sums;                 // [chunks, turning_numbers]
  Row<Products> products;                          // [chunks]
  Row<std::array<double, turning_pairs>> strains;  // [patches]
  Row<Inverses> inverse;                           // [environments]
  Row<Unheld> unheld;                              // [environments]; none without contacts
  Row<std::array<double, turning_pairs>> springs;  // [chunks]; none without contacts
  Row<Quad<T>> slots;                              // [threads, 3, most slots of a patch]
  Row<T> weights;  // [elements] of one environment, where they differ; twice with Poisson's ratio

  CorotationWork(const Plan<T>& plan, bool wanted, bool touching, bool poisson, int threads)
      : chunks(wanted ? (plan.vertices + chunk - 1) / chunk : 0),
        numbers(wanted ? plan.vertices : 0),
        images(wanted ? plan.vertices : 0),
        sums(std::size_t(chunks) * turning_numbers),
        products(chunks),
        strains(wanted ? plan.patches : 0),
        inverse(wanted ? width : 0),
        unheld(wanted && touching ? width : 0),
        springs(touching ? chunks : 0),
        slots(wanted ? std::size_t(threads) * 3 * plan.most_slots : 0),
        weights(wanted && width > 1 ? std::size_t(plan.blocks) * block_lanes * (poisson ? 2 : 1)
                                    : 0) {}

  static double number(const Real& of, int lane) { return Lanes::lane(Lanes::widen(of), lane); }

  // visit(vertex) of a chunk
  template <class Visit>
  static void each_of_chunk(int vertices, std::int64_t which, Visit visit) {
    const std::int64_t end = std::min<std::int64_t>(vertices, (which + 1) * chunk);
    for (std::int64_t i = which * chunk; i < end; ++i) visit(i);
  }
};

}  // namespace pd::inline PD_TARGET
