// What the CUDA sources of this package share: launches, shared memory, grids.

#pragma once

#include <cstdint>

#ifndef DEVO_EMULATED  // tests/devo/emulated_cuda.h stands in for CUDA when the kernels are tested on a CPU
#include <cuda_bf16.h>
#include <cuda_fp16.h>
#include <cuda_runtime.h>
#define DEVO_SHARED(type, name)                                     \
    extern __shared__ __align__(16) unsigned char name##_bytes[];   \
    type* name = reinterpret_cast<type*>(name##_bytes)
// Followed by the arguments of the kernel in parentheses.
#define DEVO_LAUNCH(launch, stream, ...)                                                            \
    __VA_ARGS__<<<dim3((unsigned)(launch).blocks), dim3((unsigned)(launch).threads), (launch).shared, \
                  (cudaStream_t)(stream)>>>
#endif

namespace {

constexpr int THREADS = 256;             // per block, where threads work alone
constexpr int64_t MAX_BLOCKS = 1 << 20;  // larger problems loop

struct Launch {
    int64_t blocks, threads;
    size_t shared;  // bytes
};

inline Launch thread_launch(int64_t items) {
    const int64_t blocks = (items + THREADS - 1) / THREADS;
    return {blocks < MAX_BLOCKS ? blocks : MAX_BLOCKS, THREADS, 0};
}

}  // namespace
