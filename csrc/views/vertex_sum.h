// Sums over the vertices of every environment, in an order that does not depend on the batch.
#pragma once
#include <cstdint>

namespace pd {

template <class T>
struct VertexSumCall {
  std::int64_t batch = 0, vertices = 0, numbers = 0;
  const T* values = nullptr;  // [batch, vertices, numbers]
  T* out = nullptr;           // [batch, numbers], added up in float64
};

}  // namespace pd
