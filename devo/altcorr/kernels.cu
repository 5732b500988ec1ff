// CUDA kernels of devo.altcorr: correlation of patch features with map windows, patch extraction, and their gradients.
//
// The interface is plain C (pointers to device memory, sizes, a stream), so one built library serves every version of
// Python and torch; devo/altcorr/extension.py calls it. The torch twins in correlation.py and patches.py are the
// specification. Maps arrive channels-last (F,H,W,C): a window pixel is then one run of memory that neighbouring
// threads read together, and the tracker stores its maps this way anyway.
//
// Coordinates that are not finite belong to no pixel; their fraction is NaN, and so is what is blended with it.

#include "../kernel_tools.cuh"

namespace {

constexpr int FAR = 1 << 20;           // pixel that stands for 'outside of every map'
constexpr int WARPS = 8;               // per block of the correlation kernels
constexpr int GROUP = 8;               // lanes that share one dot product
constexpr int CHANNELS_PER_LANE = 4;   // of the backward pass, at a time
constexpr int64_t SHARED_BYTES = 48 << 10;
constexpr unsigned ALL = 0xffffffffu;

// --- numbers --------------------------------------------------------------------------------------------------------

template <typename T> struct Sum { using type = float; };  // what sums of T are accumulated in
template <> struct Sum<double> { using type = double; };

template <typename A, typename B> struct Promoted { using type = float; };  // as torch promotes them, at least float
template <typename B> struct Promoted<double, B> { using type = double; };
template <typename A> struct Promoted<A, double> { using type = double; };
template <> struct Promoted<double, double> { using type = double; };

__device__ inline float widen(float x) { return x; }
__device__ inline double widen(double x) { return x; }
__device__ inline float widen(__half x) { return __half2float(x); }
__device__ inline float widen(__nv_bfloat16 x) { return __bfloat162float(x); }

template <typename T> struct Narrow;
template <> struct Narrow<float> { __device__ static float from(float x) { return x; } };
template <> struct Narrow<double> { __device__ static double from(double x) { return x; } };
template <> struct Narrow<__half> { __device__ static __half from(float x) { return __float2half(x); } };
template <> struct Narrow<__nv_bfloat16> {
    __device__ static __nv_bfloat16 from(float x) { return __float2bfloat16(x); }
};

template <typename A> __device__ inline A lerp(A a, A b, A w) {  // the formula of torch
    return w < A(0.5) ? a + w * (b - a) : b - (b - a) * (A(1) - w);
}

// Integer pixel of a position, safe for any number, and the fraction beyond it.
template <typename A, typename X> __device__ inline int split(X position, A& fraction) {
    const X low = floor(position);
    fraction = static_cast<A>(position - low);
    if (low >= X(FAR)) return FAR;
    return low >= X(-FAR) ? static_cast<int>(low) : -FAR;  // NaN compares false
}

// N values of T that are read at once where they are aligned (N * sizeof(T) is 16 or sizeof(T)).
template <typename T, int N> struct alignas(N * sizeof(T)) Pack { T value[N]; };

// --- correlation ----------------------------------------------------------------------------------------------------

// One warp for each (edge, patch pixel). Row by row of the window, four pixels at a time, eight lanes multiply the
// channels of one pixel; two rows of dot products are kept in shared memory and blended. The warps of a block belong to
// neighbouring patch pixels, whose windows overlap: most of what they read is in the L1 cache already.
template <typename T, typename X, int N>
__global__ void corr_forward(const T* patches, const T* maps, const X* coords, const int64_t* ii, const int64_t* jj,
                             int64_t edges, int64_t rows, int64_t frames, int channels, int height, int width,
                             int pixels, int radius, T* out) {
    using A = typename Sum<T>::type;
    DEVO_SHARED(A, shared);
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, warps = blockDim.x / 32;
    const int side = 2 * radius + 2, group = lane / GROUP, member = lane % GROUP;
    A* products = shared + warp * 2 * side;
    for (int64_t item = blockIdx.x * int64_t(warps) + warp; item < edges * pixels; item += int64_t(gridDim.x) * warps) {
        const int64_t edge = item / pixels;
        const int pixel = static_cast<int>(item % pixels);
        A dx, dy;
        int x0 = split(coords[(edge * 2) * pixels + pixel], dx) - radius;
        const int y0 = split(coords[(edge * 2 + 1) * pixels + pixel], dy) - radius;
        const int64_t row = ii[edge], frame = jj[edge];
        if (row < 0 || row >= rows || frame < 0 || frame >= frames) {  // no such patch or frame: NaN, and nothing is read
            x0 = -2 * FAR;
            dx = A(nanf(""));
        }
        const T* feature = patches + (row * pixels + pixel) * channels;
        T* target = out + edge * (side - 1) * (side - 1) * pixels + pixel;
        for (int wy = 0; wy < side; ++wy) {
            const int y = y0 + wy;
            A* current = products + (wy % 2) * side;
            for (int first = 0; first < side; first += 32 / GROUP) {
                const int wx = first + group, x = x0 + wx;
                A sum = A(0);
                if (wx < side && y >= 0 && y < height && x >= 0 && x < width) {
                    const T* place = maps + ((frame * height + y) * width + x) * channels;
                    for (int c = member * N; c < channels; c += GROUP * N) {
                        const Pack<T, N> a = *reinterpret_cast<const Pack<T, N>*>(feature + c);
                        const Pack<T, N> b = *reinterpret_cast<const Pack<T, N>*>(place + c);
#pragma unroll
                        for (int n = 0; n < N; ++n) sum += widen(a.value[n]) * widen(b.value[n]);
                    }
                }
#pragma unroll
                for (int step = GROUP / 2; step > 0; step /= 2) sum += __shfl_xor_sync(ALL, sum, step);
                if (member == 0 && wx < side) current[wx] = sum;
            }
            __syncwarp();
            if (wy > 0) {
                const A* above = products + ((wy - 1) % 2) * side;
                for (int b = lane; b < side - 1; b += 32) {
                    const A value = lerp(lerp(above[b], above[b + 1], dx), lerp(current[b], current[b + 1], dx), dy);
                    target[(int64_t(b) * (side - 1) + wy - 1) * pixels] = Narrow<T>::from(value);
                }
            }
            __syncwarp();  // the row above is overwritten next
        }
    }
}

// One warp for each (kept edge, patch pixel), lanes over the channels. `edge_list` holds the kept edges, or is null for
// all. `grad_patches` (K,P*P,C) and `grad_maps` (F,H,W,C) are added to atomically; one that is null is not wanted.
template <typename T, typename X>
__global__ void corr_backward(const T* patches, const T* maps, const X* coords, const int64_t* ii, const int64_t* jj,
                              const int64_t* edge_list, const T* grad, int64_t edges, int64_t rows, int64_t frames,
                              int channels, int height, int width, int pixels, int radius,
                              typename Sum<T>::type* grad_patches, typename Sum<T>::type* grad_maps) {
    using A = typename Sum<T>::type;
    DEVO_SHARED(A, shared);
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, warps = blockDim.x / 32;
    const int side = 2 * radius + 2;
    A* weights = shared + warp * side;
    for (int64_t item = blockIdx.x * int64_t(warps) + warp; item < edges * pixels; item += int64_t(gridDim.x) * warps) {
        const int64_t edge = edge_list == nullptr ? item / pixels : edge_list[item / pixels];
        const int pixel = static_cast<int>(item % pixels);
        A dx, dy;
        const int x0 = split(coords[(edge * 2) * pixels + pixel], dx) - radius;
        const int y0 = split(coords[(edge * 2 + 1) * pixels + pixel], dy) - radius;
        const int64_t row = ii[edge], frame = jj[edge];
        if (row < 0 || row >= rows || frame < 0 || frame >= frames) continue;
        // positions that are not finite are FAR outside: nothing flows back from them
        if (x0 >= width || x0 + side <= 0 || y0 >= height || y0 + side <= 0) continue;
        const int64_t own = (row * pixels + pixel) * channels;
        const T* incoming = grad + edge * (side - 1) * (side - 1) * pixels + pixel;
        for (int start = 0; start < channels; start += 32 * CHANNELS_PER_LANE) {
            A feature[CHANNELS_PER_LANE], sum[CHANNELS_PER_LANE];
#pragma unroll
            for (int n = 0; n < CHANNELS_PER_LANE; ++n) {
                const int c = start + n * 32 + lane;
                feature[n] = c < channels ? A(widen(patches[own + c])) : A(0);
                sum[n] = A(0);
            }
            for (int wy = 0; wy < side; ++wy) {
                const int y = y0 + wy;
                if (y < 0 || y >= height) continue;  // the same for all lanes
                for (int wx = lane; wx < side; wx += 32) {  // the transpose of the blending
                    A weight = A(0);
                    for (int a = wy - 1; a <= wy; ++a) {
                        for (int b = wx - 1; b <= wx; ++b) {
                            if (a < 0 || b < 0 || a >= side - 1 || b >= side - 1) continue;
                            const A share = (a == wy ? A(1) - dy : dy) * (b == wx ? A(1) - dx : dx);
                            weight += share * A(widen(incoming[(int64_t(b) * (side - 1) + a) * pixels]));
                        }
                    }
                    weights[wx] = weight;
                }
                __syncwarp();
                for (int wx = 0; wx < side; ++wx) {
                    const int x = x0 + wx;
                    if (x < 0 || x >= width) continue;
                    const int64_t place = ((frame * height + y) * width + x) * channels;
                    const A weight = weights[wx];
#pragma unroll
                    for (int n = 0; n < CHANNELS_PER_LANE; ++n) {
                        const int c = start + n * 32 + lane;
                        if (c >= channels) continue;
                        if (grad_maps != nullptr) atomicAdd(grad_maps + place + c, weight * feature[n]);
                        if (grad_patches != nullptr) sum[n] += weight * A(widen(maps[place + c]));
                    }
                }
                __syncwarp();
            }
            if (grad_patches == nullptr) continue;
#pragma unroll
            for (int n = 0; n < CHANNELS_PER_LANE; ++n) {
                const int c = start + n * 32 + lane;
                if (c < channels) atomicAdd(grad_patches + own + c, sum[n]);
            }
        }
    }
}

// --- patches --------------------------------------------------------------------------------------------------------

struct Strides { int64_t batch, channel, row, column; };  // in elements, so that maps of any memory layout are read

// One thread for each value of the (B,M,C,S,S) result: S = 2R+1 blended values or S = 2R+2 raw pixels.
template <typename T, typename X, bool BLEND, typename O>
__global__ void patchify_forward(const T* maps, Strides strides, const X* coords, int64_t total, int64_t points,
                                 int channels, int height, int width, int radius, O* out) {
    using A = typename Promoted<T, X>::type;
    const int side = 2 * radius + (BLEND ? 1 : 2);
    const int64_t first = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
    for (int64_t index = first; index < total; index += int64_t(gridDim.x) * blockDim.x) {
        const int wx = static_cast<int>(index % side), wy = static_cast<int>(index / side % side);
        const int64_t rest = index / (int64_t(side) * side), point = rest / channels, batch = point / points;
        const T* map = maps + batch * strides.batch + (rest % channels) * strides.channel;
        A dx, dy;
        const int x = split(coords[point * 2], dx) - radius + wx, y = split(coords[point * 2 + 1], dy) - radius + wy;
        auto inside = [&](int v, int u) { return v >= 0 && v < height && u >= 0 && u < width; };
        if constexpr (BLEND) {
            auto read = [&](int v, int u) {
                return inside(v, u) ? A(widen(map[v * strides.row + u * strides.column])) : A(0);
            };
            const A upper = lerp(read(y, x), read(y, x + 1), dx), lower = lerp(read(y + 1, x), read(y + 1, x + 1), dx);
            out[index] = lerp(upper, lower, dy);
        } else {
            out[index] = inside(y, x) ? map[y * strides.row + x * strides.column] : Narrow<T>::from(0);
        }
    }
}

// One thread for each pixel of the (B,M,C,D,D) windows; adds to `sums` atomically.
template <typename T, typename X, bool BLEND, typename O>
__global__ void patchify_backward(const O* grad, const X* coords, int64_t total, int64_t points, int channels,
                                  int height, int width, int radius, Strides strides, typename Sum<T>::type* sums) {
    using A = typename Promoted<T, X>::type;
    const int side = 2 * radius + 2;
    const int64_t first = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
    for (int64_t index = first; index < total; index += int64_t(gridDim.x) * blockDim.x) {
        const int wx = static_cast<int>(index % side), wy = static_cast<int>(index / side % side);
        const int64_t rest = index / (int64_t(side) * side), point = rest / channels, batch = point / points;
        A dx, dy;
        const int x = split(coords[point * 2], dx) - radius + wx, y = split(coords[point * 2 + 1], dy) - radius + wy;
        if (x < 0 || x >= width || y < 0 || y >= height) continue;
        A weight = A(0);
        if constexpr (BLEND) {
            for (int a = wy - 1; a <= wy; ++a) {
                for (int b = wx - 1; b <= wx; ++b) {
                    if (a < 0 || b < 0 || a >= side - 1 || b >= side - 1) continue;
                    const A share = (a == wy ? A(1) - dy : dy) * (b == wx ? A(1) - dx : dx);
                    weight += share * A(widen(grad[(rest * (side - 1) + a) * (side - 1) + b]));
                }
            }
        } else {
            weight = A(widen(grad[index]));
        }
        if (weight == A(0)) continue;  // most, where positions are whole pixels
        const int64_t place = batch * strides.batch + (rest % channels) * strides.channel + y * strides.row;
        atomicAdd(sums + place + x * strides.column, static_cast<typename Sum<T>::type>(weight));
    }
}

// --- launches -------------------------------------------------------------------------------------------------------

// Blocks of warps that need `bytes` of shared memory each.
Launch warp_launch(int64_t items, int64_t bytes) {
    int64_t warps = WARPS;
    while (warps > 1 && warps * bytes > SHARED_BYTES) warps /= 2;
    const int64_t blocks = (items + warps - 1) / warps;
    return {blocks < MAX_BLOCKS ? blocks : MAX_BLOCKS, 32 * warps, static_cast<size_t>(warps * bytes)};
}

struct CorrArguments {
    const void *patches, *maps, *coords;
    const int64_t *ii, *jj;
    int64_t edges, rows, frames;
    int channels, height, width, pixels, radius;
};

template <typename T, typename X, int N> void run_corr(const CorrArguments& a, void* out, void* stream) {
    const Launch l = warp_launch(a.edges * a.pixels, 2 * (2 * a.radius + 2) * sizeof(typename Sum<T>::type));
    DEVO_LAUNCH(l, stream, corr_forward<T, X, N>)(
        (const T*)a.patches, (const T*)a.maps, (const X*)a.coords, a.ii, a.jj, a.edges, a.rows, a.frames, a.channels,
        a.height, a.width, a.pixels, a.radius, (T*)out);
}

template <typename T, typename X> void corr_of(const CorrArguments& a, void* out, void* stream) {
    constexpr int N = 16 / sizeof(T);
    const bool aligned = (uintptr_t)a.patches % 16 == 0 && (uintptr_t)a.maps % 16 == 0 && a.channels % N == 0;
    if (aligned) run_corr<T, X, N>(a, out, stream);
    else run_corr<T, X, 1>(a, out, stream);
}

template <typename T, typename X>
void corr_backward_of(const CorrArguments& a, const int64_t* edge_list, const void* grad, void* grad_patches,
                      void* grad_maps, void* stream) {
    using A = typename Sum<T>::type;
    const Launch l = warp_launch(a.edges * a.pixels, (2 * a.radius + 2) * sizeof(A));
    DEVO_LAUNCH(l, stream, corr_backward<T, X>)(
        (const T*)a.patches, (const T*)a.maps, (const X*)a.coords, a.ii, a.jj, edge_list, (const T*)grad, a.edges,
        a.rows, a.frames, a.channels, a.height, a.width, a.pixels, a.radius, (A*)grad_patches, (A*)grad_maps);
}

struct PatchArguments {
    Strides strides;
    const void* coords;
    int64_t batch, points;
    int channels, height, width, radius;
};

template <typename T, typename X>
void patchify_of(const PatchArguments& a, const void* maps, bool blend, void* out, void* stream) {
    using O = typename Promoted<T, X>::type;
    const int64_t side = 2 * a.radius + (blend ? 1 : 2), total = a.batch * a.points * a.channels * side * side;
    const Launch l = thread_launch(total);
    if (blend) {
        DEVO_LAUNCH(l, stream, patchify_forward<T, X, true, O>)(
            (const T*)maps, a.strides, (const X*)a.coords, total, a.points, a.channels, a.height, a.width, a.radius,
            (O*)out);
    } else {
        DEVO_LAUNCH(l, stream, patchify_forward<T, X, false, T>)(
            (const T*)maps, a.strides, (const X*)a.coords, total, a.points, a.channels, a.height, a.width, a.radius,
            (T*)out);
    }
}

template <typename T, typename X>
void patchify_backward_of(const PatchArguments& a, const void* grad, bool blend, void* sums, void* stream) {
    using O = typename Promoted<T, X>::type;
    using A = typename Sum<T>::type;
    const int64_t side = 2 * a.radius + 2, total = a.batch * a.points * a.channels * side * side;
    const Launch l = thread_launch(total);
    if (blend) {
        DEVO_LAUNCH(l, stream, patchify_backward<T, X, true, O>)(
            (const O*)grad, (const X*)a.coords, total, a.points, a.channels, a.height, a.width, a.radius, a.strides,
            (A*)sums);
    } else {
        DEVO_LAUNCH(l, stream, patchify_backward<T, X, false, T>)(
            (const T*)grad, (const X*)a.coords, total, a.points, a.channels, a.height, a.width, a.radius, a.strides,
            (A*)sums);
    }
}

}  // namespace

// Calls `function<T, X>(...)` for the dtypes `maps` (0 float32, 1 float64, 2 float16, 3 bfloat16) and `coords` (0, 1).
#define DEVO_DISPATCH(maps, coords, function, ...)                                  \
    switch ((maps) * 2 + (coords)) {                                                \
        case 0: function<float, float>(__VA_ARGS__); break;                         \
        case 1: function<float, double>(__VA_ARGS__); break;                        \
        case 2: function<double, float>(__VA_ARGS__); break;                        \
        case 3: function<double, double>(__VA_ARGS__); break;                       \
        case 4: function<__half, float>(__VA_ARGS__); break;                        \
        case 5: function<__half, double>(__VA_ARGS__); break;                       \
        case 6: function<__nv_bfloat16, float>(__VA_ARGS__); break;                 \
        case 7: function<__nv_bfloat16, double>(__VA_ARGS__); break;                \
        default: return static_cast<int>(cudaErrorInvalidValue);                    \
    }                                                                               \
    return static_cast<int>(cudaGetLastError())

// All functions return a CUDA error number, 0 for success; sizes must not be zero.

extern "C" int devo_corr_forward(int64_t device, void* stream, int64_t map_type, int64_t coord_type,
                                 const void* patches, const void* maps, const void* coords, const void* ii,
                                 const void* jj, int64_t edges, int64_t rows, int64_t frames, int64_t channels,
                                 int64_t height, int64_t width, int64_t pixels, int64_t radius, void* out) {
    cudaSetDevice((int)device);
    const CorrArguments a{patches, maps, coords, (const int64_t*)ii, (const int64_t*)jj, edges, rows, frames,
                          (int)channels, (int)height, (int)width, (int)pixels, (int)radius};
    DEVO_DISPATCH(map_type, coord_type, corr_of, a, out, stream);
}

extern "C" int devo_corr_backward(int64_t device, void* stream, int64_t map_type, int64_t coord_type,
                                  const void* patches, const void* maps, const void* coords, const void* ii,
                                  const void* jj, const void* edge_list, const void* grad, int64_t edges, int64_t rows,
                                  int64_t frames, int64_t channels, int64_t height, int64_t width, int64_t pixels,
                                  int64_t radius, void* grad_patches, void* grad_maps) {
    cudaSetDevice((int)device);
    const CorrArguments a{patches, maps, coords, (const int64_t*)ii, (const int64_t*)jj, edges, rows, frames,
                          (int)channels, (int)height, (int)width, (int)pixels, (int)radius};
    DEVO_DISPATCH(map_type, coord_type, corr_backward_of, a, (const int64_t*)edge_list, grad, grad_patches, grad_maps,
                  stream);
}

extern "C" int devo_patchify_forward(int64_t device, void* stream, int64_t map_type, int64_t coord_type,
                                     const void* maps, const void* coords, int64_t batch, int64_t points,
                                     int64_t channels, int64_t height, int64_t width, int64_t radius, int64_t blend,
                                     int64_t stride_batch, int64_t stride_channel, int64_t stride_row,
                                     int64_t stride_column, void* out) {
    cudaSetDevice((int)device);
    const PatchArguments a{{stride_batch, stride_channel, stride_row, stride_column}, coords, batch, points,
                           (int)channels, (int)height, (int)width, (int)radius};
    DEVO_DISPATCH(map_type, coord_type, patchify_of, a, maps, blend != 0, out, stream);
}

extern "C" int devo_patchify_backward(int64_t device, void* stream, int64_t map_type, int64_t coord_type,
                                      const void* grad, const void* coords, int64_t batch, int64_t points,
                                      int64_t channels, int64_t height, int64_t width, int64_t radius, int64_t blend,
                                      int64_t stride_batch, int64_t stride_channel, int64_t stride_row,
                                      int64_t stride_column, void* sums) {
    cudaSetDevice((int)device);
    const PatchArguments a{{stride_batch, stride_channel, stride_row, stride_column}, coords, batch, points,
                           (int)channels, (int)height, (int)width, (int)radius};
    DEVO_DISPATCH(map_type, coord_type, patchify_backward_of, a, grad, blend != 0, sums, stream);
}
