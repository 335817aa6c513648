#include "cuda/contact/kernels.cuh"

namespace pd {
template std::int64_t contact_bytes(const ContactWork<float>&);
template void prepare_contact(const ContactWork<float>&, Stream);
template ContactFlags contact_flags(const ContactWork<float>&);
template void keep_displacements(const ContactWork<float>&, Stream);
template void run_contact_task<float, false>(ContactTask, const ContactWork<float>&, int, int,
                                             Stream);
}  // namespace pd
