// An op by its name, for calls that go through torch's dispatcher.
#pragma once
#include <ATen/core/dispatch/Dispatcher.h>

namespace pd {

template <class Signature>
c10::TypedOperatorHandle<Signature> find_op(const char* name) {
  return c10::Dispatcher::singleton().findSchemaOrThrow(name, "").typed<Signature>();
}

}  // namespace pd
