// With colliders that have a mass.
#include "cuda/contact/kernels.cuh"

namespace pd {
template void run_contact_task<float, true>(ContactTask, const ContactWork<float>&, int, int,
                                            Stream);
}  // namespace pd
