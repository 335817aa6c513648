#include "cuda/contact/kernels.cuh"

namespace pd {
template std::int64_t contact_bytes(const ContactWork<double>&);
template void prepare_contact(const ContactWork<double>&, Stream);
template void keep_displacements(const ContactWork<double>&, Stream);
template void run_contact(ContactTask, const ContactWork<double>&, int, int, Stream);
}  // namespace pd
