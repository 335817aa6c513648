#include "cuda/contact/kernels.cuh"

namespace pd {
template std::int64_t contact_bytes(const ContactWork<double>&);
template void prepare_contact(const ContactWork<double>&, Stream);
template ContactFlags contact_flags(const ContactWork<double>&);
template void keep_displacements(const ContactWork<double>&, Stream);
template void run_contact_task<double, false>(ContactTask, const ContactWork<double>&, int, int,
                                              Stream);
}  // namespace pd
