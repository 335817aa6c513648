// With colliders that have a mass.
#include "cuda/contact/kernels.cuh"

namespace pd {
template void run_contact_task<double, true>(ContactTask, const ContactWork<double>&, int, int,
                                             Stream);
}  // namespace pd
