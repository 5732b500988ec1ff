// Stands in for CUDA, so that the kernels run on a CPU: the threads of a warp are coroutines that take turns between
// barriers; warps and blocks follow each other. Enough for kernels that synchronise within warps only.

#pragma once

#define DEVO_EMULATED
#include <math.h>
#include <setjmp.h>
#include <ucontext.h>

#include <cstdint>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define DEVO_SHARED(type, name) type* name = reinterpret_cast<type*>(emulated::shared)
#define DEVO_LAUNCH(launch, stream, ...) emulated::prepare(launch, __VA_ARGS__)

struct __half { _Float16 value; };
struct __nv_bfloat16 { uint16_t bits; };
inline float __half2float(__half x) { return static_cast<float>(x.value); }
inline __half __float2half(float x) { return {static_cast<_Float16>(x)}; }
inline float __bfloat162float(__nv_bfloat16 x) {
    const uint32_t bits = static_cast<uint32_t>(x.bits) << 16;
    float value;
    std::memcpy(&value, &bits, 4);
    return value;
}
inline __nv_bfloat16 __float2bfloat16(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    if (x != x) return {0x7fc0};
    return {static_cast<uint16_t>((bits + 0x7fff + ((bits >> 16) & 1)) >> 16)};
}

constexpr int cudaErrorInvalidValue = 1;
inline int cudaSetDevice(int) { return 0; }
inline int cudaGetLastError() { return 0; }

struct Index { unsigned x; };
inline Index threadIdx, blockIdx, blockDim, gridDim;

namespace emulated {

struct Lane {
    ucontext_t context;  // only to begin with: these switches are system calls, jumps are not
    jmp_buf place;
    bool begun;
    std::vector<char> stack = std::vector<char>(1 << 16);
    bool done;
    double slot;
};
inline Lane lanes[32];
inline int current;
inline jmp_buf scheduler_place;
inline std::function<void()> body;
alignas(16) inline unsigned char shared[1 << 16];

inline void yield() {
    if (_setjmp(lanes[current].place) == 0) _longjmp(scheduler_place, 1);
}

inline void enter() {
    body();
    lanes[current].done = true;
    _longjmp(scheduler_place, 1);
}

inline void resume() {
    if (_setjmp(scheduler_place) != 0) return;
    if (lanes[current].begun) _longjmp(lanes[current].place, 1);
    lanes[current].begun = true;
    setcontext(&lanes[current].context);
}

inline void run_warp(unsigned first, unsigned threads) {
    for (Lane& lane : lanes) {
        lane.begun = false;
        lane.done = first + (&lane - lanes) >= threads;
        getcontext(&lane.context);
        lane.context.uc_stack.ss_sp = lane.stack.data();
        lane.context.uc_stack.ss_size = lane.stack.size();
        lane.context.uc_link = nullptr;
        makecontext(&lane.context, enter, 0);
    }
    for (bool working = true; working;) {
        working = false;
        for (current = 0; current < 32; ++current) {
            if (lanes[current].done) continue;
            threadIdx.x = first + current;
            resume();
            working = working || !lanes[current].done;
        }
    }
}

// A function of the kernel's arguments that runs the whole grid.
template <typename L, typename... P> auto prepare(const L& launch, void (*kernel)(P...)) {
    return [launch, kernel](P... arguments) {
        body = [&] { kernel(arguments...); };
        gridDim.x = static_cast<unsigned>(launch.blocks);
        blockDim.x = static_cast<unsigned>(launch.threads);
        for (blockIdx.x = 0; blockIdx.x < gridDim.x; ++blockIdx.x) {
            std::memset(shared, 0xff, sizeof(shared));  // NaN, so that reading before writing shows
            for (unsigned first = 0; first < blockDim.x; first += 32) run_warp(first, blockDim.x);
        }
    };
}

}  // namespace emulated

inline void __syncwarp() { emulated::yield(); }

template <typename T> T __shfl_xor_sync(unsigned, T value, int mask) {
    emulated::lanes[emulated::current].slot = value;
    emulated::yield();
    const T other = static_cast<T>(emulated::lanes[emulated::current ^ mask].slot);
    emulated::yield();
    return other;
}

template <typename T> T atomicAdd(T* place, T value) {
    const T before = *place;
    *place += value;
    return before;
}
