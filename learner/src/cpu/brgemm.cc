// oneDNN's batch-reduce matrix product as libtorch wraps it: C = A·B or C += A·B into float32, with kernels generated
// for the processor (AMX, AVX512-BF16, AVX-512, AVX2). tch exposes none of it. Returns 0, or 1 where libtorch refuses.

#include <ATen/native/CPUBlas.h>

namespace cpublas = at::native::cpublas;

extern "C" int getup_brgemm_bf16(int64_t m, int64_t n, int64_t k, int64_t lda, int64_t ldb, int64_t ldc,
                                 bool accumulate, const void* a, const void* b, float* c) {
    try {
        cpublas::brgemm(m, n, k, lda, ldb, ldc, accumulate, static_cast<const c10::BFloat16*>(a),
                        static_cast<const c10::BFloat16*>(b), c, true);
        return 0;
    } catch (...) {
        return 1;
    }
}

extern "C" int getup_brgemm_f32(int64_t m, int64_t n, int64_t k, int64_t lda, int64_t ldb, int64_t ldc,
                                bool accumulate, const float* a, const float* b, float* c) {
    try {
        cpublas::brgemm(m, n, k, lda, ldb, ldc, accumulate, a, b, c, false);
        return 0;
    } catch (...) {
        return 1;
    }
}
