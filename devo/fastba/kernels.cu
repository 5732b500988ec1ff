// CUDA kernels of devo.fastba: reprojection, the normal equations of bundle adjustment, and the update of its state.
//
// The interface is plain C (pointers to device memory, sizes, a stream), so one built library serves every version of
// Python and torch; devo/fastba/extension.py calls it. The torch twins are the specification. All arithmetic is float64
// whatever the dtype S of the state: a monocular problem is nearly singular along its free scale.

#include "../kernel_tools.cuh"

namespace {

constexpr double MIN_DEPTH = 0.2;  // nearer points are not valid

struct Vector { double x, y, z; };
struct Motion { double r[3][3]; double t[3]; };  // [R|t]

__device__ inline Vector cross(Vector a, Vector b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

__device__ inline bool finite(double x) { return x - x == 0.0; }

// Rotation matrix of a quaternion xyzw of any length; NaN for a zero one.
__device__ inline void rotation(double x, double y, double z, double w, double (&r)[3][3]) {
    const double size = x * x + y * y + z * z + w * w;
    r[0][0] = (w * w + x * x - y * y - z * z) / size;
    r[0][1] = 2 * (x * y - z * w) / size;
    r[0][2] = 2 * (x * z + y * w) / size;
    r[1][0] = 2 * (x * y + z * w) / size;
    r[1][1] = (w * w + y * y - x * x - z * z) / size;
    r[1][2] = 2 * (y * z - x * w) / size;
    r[2][0] = 2 * (x * z - y * w) / size;
    r[2][1] = 2 * (y * z + x * w) / size;
    r[2][2] = (w * w + z * z - x * x - y * y) / size;
}

// Motion from the source to the target camera, T_target T_source^-1.
template <typename S> __device__ inline Motion relative(const S* source, const S* target) {
    double first[3][3], second[3][3];
    rotation(source[3], source[4], source[5], source[6], first);
    rotation(target[3], target[4], target[5], target[6], second);
    Motion g;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            g.r[i][j] = second[i][0] * first[j][0] + second[i][1] * first[j][1] + second[i][2] * first[j][2];
        }
        const double moved = g.r[i][0] * double(source[0]) + g.r[i][1] * double(source[1]) +
                             g.r[i][2] * double(source[2]);
        g.t[i] = double(target[i]) - moved;
    }
    return g;
}

__device__ inline Vector rotate_back(const Motion& g, Vector v) {
    return {g.r[0][0] * v.x + g.r[1][0] * v.y + g.r[2][0] * v.z, g.r[0][1] * v.x + g.r[1][1] * v.y + g.r[2][1] * v.z,
            g.r[0][2] * v.x + g.r[1][2] * v.y + g.r[2][2] * v.z};
}

struct Edges {
    const int64_t *ii, *jj, *kk;
    int64_t count, frames, patches;  // frames and patches that exist
};

// Whether all indices of an edge exist.
__device__ inline bool exists(const Edges& e, int64_t edge) {
    const int64_t i = e.ii[edge], j = e.jj[edge], k = e.kk[edge];
    return i >= 0 && i < e.frames && j >= 0 && j < e.frames && k >= 0 && k < e.patches;
}

// One thread for each (edge, patch pixel); camera row 0.
template <typename S>
__global__ void reproject(const S* poses, const S* patches, const double* camera, Edges e, int pixels, S* out) {
    const int64_t first = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
    for (int64_t index = first; index < e.count * pixels; index += int64_t(gridDim.x) * blockDim.x) {
        const int64_t edge = index / pixels, pixel = index % pixels;
        S* target = out + edge * 2 * pixels + pixel;
        if (!exists(e, edge)) {
            target[0] = target[pixels] = S(nanf(""));
            continue;
        }
        const Motion g = relative(poses + 7 * e.ii[edge], poses + 7 * e.jj[edge]);
        const S* patch = patches + e.kk[edge] * 3 * pixels + pixel;
        const double x = (double(patch[0]) - camera[2]) / camera[0];
        const double y = (double(patch[pixels]) - camera[3]) / camera[1];
        const double d = double(patch[2 * pixels]);
        double point[3];
        for (int r = 0; r < 3; ++r) point[r] = g.r[r][0] * x + g.r[r][1] * y + g.r[r][2] + g.t[r] * d;
        target[0] = S(camera[0] * point[0] / point[2] + camera[2]);
        target[pixels] = S(camera[1] * point[1] / point[2] + camera[3]);
    }
}

struct Rules {
    double margin, max_residual;
    double width, height;  // largest valid pixel before the margin; negative: twice the principal point
    int64_t per_frame;     // whether every frame has its own camera
};

struct System {
    double *B, *E, *v, *C, *u;  // (6N,6N), (6N,M), (6N), (M), (M), zero at first
    int64_t first, free, depths;  // first free pose, N, M
};

// One thread for each edge: project the patch centre, judge it, and add its part to the equations.
template <typename S>
__global__ void linearize(const S* poses, const S* patches, const double* cameras, const double* measured,
                          const double* confidence, Edges e, const int64_t* slot_of_edge, int side, Rules rules,
                          System s, unsigned char* valid, double* residual) {
    const int64_t start = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
    for (int64_t edge = start; edge < e.count; edge += int64_t(gridDim.x) * blockDim.x) {
        valid[edge] = 0;
        residual[2 * edge] = residual[2 * edge + 1] = 0.0;
        if (!exists(e, edge)) continue;
        const int64_t i = e.ii[edge], j = e.jj[edge], pixels = int64_t(side) * side;
        const S* centre = patches + e.kk[edge] * 3 * pixels + (side / 2) * side + side / 2;
        const double* from = cameras + (rules.per_frame ? 4 * i : 0);
        const double* to = cameras + (rules.per_frame ? 4 * j : 0);
        const double ray_x = (double(centre[0]) - from[2]) / from[0];
        const double ray_y = (double(centre[pixels]) - from[3]) / from[1];
        const double depth = double(centre[2 * pixels]);
        const double target[2] = {measured[2 * edge], measured[2 * edge + 1]};
        const double weight[2] = {confidence[2 * edge], confidence[2 * edge + 1]};
        const Motion g = relative(poses + 7 * i, poses + 7 * j);
        bool usable = finite(ray_x) && finite(ray_y) && finite(depth) && finite(target[0]) && finite(target[1]) &&
                      finite(weight[0]) && finite(weight[1]);
        double point[3];
        for (int r = 0; r < 3; ++r) {
            point[r] = g.r[r][0] * ray_x + g.r[r][1] * ray_y + g.r[r][2] + g.t[r] * depth;
            usable = usable && finite(g.r[r][0]) && finite(g.r[r][1]) && finite(g.r[r][2]) && finite(g.t[r]);
        }
        if (!usable || !(point[2] > MIN_DEPTH)) continue;

        const double rho = 1.0 / point[2], a = point[0] * rho, b = point[1] * rho;
        const double fx = to[0], fy = to[1], pixel_x = fx * a + to[2], pixel_y = fy * b + to[3];
        const double rx = target[0] - pixel_x, ry = target[1] - pixel_y;
        const double right = (rules.width < 0 ? 2 * to[2] : rules.width) + rules.margin;
        const double bottom = (rules.height < 0 ? 2 * to[3] : rules.height) + rules.margin;
        if (!(rx * rx + ry * ry < rules.max_residual * rules.max_residual)) continue;
        if (!(pixel_x > -rules.margin && pixel_y > -rules.margin && pixel_x < right && pixel_y < bottom)) continue;
        valid[edge] = 1;
        residual[2 * edge] = rx;
        residual[2 * edge + 1] = ry;
        if (i == j) continue;  // self edges say nothing

        // Engel et al. 2018 (appendix): left perturbations (translation, rotation) of the target pose, then of the
        // source pose, whose Jacobian is -J Ad(G)
        const double near_x = fx * rho * depth, near_y = fy * rho * depth, r[2] = {rx, ry};
        const double at_target[2][6] = {{near_x, 0, -near_x * a, -fx * a * b, fx * (1 + a * a), -fx * b},
                                        {0, near_y, -near_y * b, -fy * (1 + b * b), fy * a * b, fy * a}};
        const double jz[2] = {fx * rho * (g.t[0] - g.t[2] * a), fy * rho * (g.t[1] - g.t[2] * b)};
        double J[2][2][6];  // [source or target][x or y]
        for (int row = 0; row < 2; ++row) {
            const double* f = at_target[row];
            const Vector force{f[0], f[1], f[2]}, moment = cross(force, {g.t[0], g.t[1], g.t[2]});
            const Vector moved = rotate_back(g, force);
            const Vector turned = rotate_back(g, {f[3] + moment.x, f[4] + moment.y, f[5] + moment.z});
            const double back[6] = {-moved.x, -moved.y, -moved.z, -turned.x, -turned.y, -turned.z};
            for (int n = 0; n < 6; ++n) {
                J[0][row][n] = back[n];
                J[1][row][n] = f[n];
            }
        }
        const int64_t depth_row = slot_of_edge[edge];
        atomicAdd(s.C + depth_row, weight[0] * jz[0] * jz[0] + weight[1] * jz[1] * jz[1]);
        atomicAdd(s.u + depth_row, weight[0] * jz[0] * r[0] + weight[1] * jz[1] * r[1]);
        const int64_t slots[2] = {i - s.first, j - s.first};
#pragma unroll
        for (int p = 0; p < 2; ++p) {
            if (slots[p] < 0 || slots[p] >= s.free) continue;
#pragma unroll
            for (int n = 0; n < 6; ++n) {
                const double wx = weight[0] * J[p][0][n], wy = weight[1] * J[p][1][n];
                const int64_t row = 6 * slots[p] + n;
                atomicAdd(s.v + row, wx * r[0] + wy * r[1]);
                atomicAdd(s.E + row * s.depths + depth_row, wx * jz[0] + wy * jz[1]);
#pragma unroll
                for (int q = 0; q < 2; ++q) {
                    if (slots[q] < 0 || slots[q] >= s.free) continue;
                    double* block = s.B + row * 6 * s.free + 6 * slots[q];
#pragma unroll
                    for (int m = 0; m < 6; ++m) atomicAdd(block + m, wx * J[q][0][m] + wy * J[q][1][m]);
                }
            }
        }
    }
}

// One thread for each free pose: exp(step) from the left, unless `apply` is false or the result is not finite.
template <typename S>
__global__ void move_poses(const double* steps, const unsigned char* apply, int64_t count, S* poses) {
    const int64_t index = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
    if (index >= count || !*apply) return;
    const double* step = steps + 6 * index;
    S* pose = poses + 7 * index;
    const Vector tau{step[0], step[1], step[2]}, phi{step[3], step[4], step[5]};
    const double theta2 = phi.x * phi.x + phi.y * phi.y + phi.z * phi.z, half = 0.5 * sqrt(theta2);
    const double imag = half > 0 ? 0.5 * sin(half) / half : 0.5, w = cos(half);  // imag: sin(theta / 2) / theta
    const double sinc = 2 * imag * w, half_versine = 2 * imag * imag;
    // this quotient loses digits at small angles, but is multiplied by theta^2
    const double along = (1 - sinc) / (theta2 > 1e-36 ? theta2 : 1e-36) *
                         (phi.x * tau.x + phi.y * tau.y + phi.z * tau.z);
    const double x = imag * phi.x, y = imag * phi.y, z = imag * phi.z;
    const Vector turned = cross(phi, tau);
    double r[3][3], next[7];
    rotation(x, y, z, w, r);
    const double shift[3] = {sinc * tau.x + half_versine * turned.x + along * phi.x,
                             sinc * tau.y + half_versine * turned.y + along * phi.y,
                             sinc * tau.z + half_versine * turned.z + along * phi.z};
    for (int n = 0; n < 3; ++n) {
        next[n] = r[n][0] * double(pose[0]) + r[n][1] * double(pose[1]) + r[n][2] * double(pose[2]) + shift[n];
    }
    const double X = pose[3], Y = pose[4], Z = pose[5], W = pose[6];
    next[3] = w * X + x * W + y * Z - z * Y;
    next[4] = w * Y + y * W + z * X - x * Z;
    next[5] = w * Z + z * W + x * Y - y * X;
    next[6] = w * W - x * X - y * Y - z * Z;
    const double length = sqrt(next[3] * next[3] + next[4] * next[4] + next[5] * next[5] + next[6] * next[6]);
    bool whole = true;
    for (int n = 0; n < 7; ++n) {
        if (n >= 3) next[n] /= length;
        whole = whole && finite(next[n]);
    }
    if (!whole) return;
    for (int n = 0; n < 7; ++n) pose[n] = S(next[n]);
}

// One thread for each optimised patch: all pixels get the moved inverse depth, one that is not finite stays.
template <typename S>
__global__ void move_depths(const double* steps, const int64_t* patch_ids, const unsigned char* apply, int64_t count,
                            int64_t rows, int pixels, double largest, double reset, double smallest, S* patches) {
    const int64_t index = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
    if (index >= count || !*apply || patch_ids[index] < 0 || patch_ids[index] >= rows) return;
    S* depths = patches + (patch_ids[index] * 3 + 2) * pixels;
    S depth = depths[0];
    if (finite(double(depth))) {
        depth = depth + S(steps[index]);
        if (depth > S(largest)) depth = S(reset);
        if (depth < S(smallest)) depth = S(smallest);
    }
    for (int n = 0; n < pixels; ++n) depths[n] = depth;
}

}  // namespace

// All functions return a CUDA error number, 0 for success; sizes must not be zero. State dtype: 0 float32, 1 float64.

#define DEVO_DISPATCH(type, launch, stream, kernel, State, ...)                                     \
    do {                                                                                            \
        if ((type) == 0) {                                                                          \
            using State = float;                                                                    \
            DEVO_LAUNCH(launch, stream, kernel<State>)(__VA_ARGS__);                                \
        } else {                                                                                    \
            using State = double;                                                                   \
            DEVO_LAUNCH(launch, stream, kernel<State>)(__VA_ARGS__);                                \
        }                                                                                           \
        return static_cast<int>(cudaGetLastError());                                                \
    } while (0)

extern "C" int devo_reproject(int64_t device, void* stream, int64_t type, const void* poses, const void* patches,
                              const void* camera, const void* ii, const void* jj, const void* kk, int64_t edges,
                              int64_t frames, int64_t rows, int64_t pixels, void* out) {
    cudaSetDevice((int)device);
    const Edges e{(const int64_t*)ii, (const int64_t*)jj, (const int64_t*)kk, edges, frames, rows};
    DEVO_DISPATCH(type, thread_launch(edges * pixels), stream, reproject, S, (const S*)poses, (const S*)patches,
                  (const double*)camera, e, (int)pixels, (S*)out);
}

extern "C" int devo_linearize(int64_t device, void* stream, int64_t type, const void* poses, const void* patches,
                              const void* cameras, const void* target, const void* weight, const void* ii,
                              const void* jj, const void* kk, const void* slot_of_edge, int64_t edges, int64_t frames,
                              int64_t rows, int64_t side, double margin, double max_residual, double width,
                              double height, int64_t per_frame, void* B, void* E, void* v, void* C, void* u,
                              int64_t first, int64_t free, int64_t depths, void* valid, void* residual) {
    cudaSetDevice((int)device);
    const Edges e{(const int64_t*)ii, (const int64_t*)jj, (const int64_t*)kk, edges, frames, rows};
    const Rules rules{margin, max_residual, width, height, per_frame};
    const System s{(double*)B, (double*)E, (double*)v, (double*)C, (double*)u, first, free, depths};
    DEVO_DISPATCH(type, thread_launch(edges), stream, linearize, S, (const S*)poses, (const S*)patches,
                  (const double*)cameras, (const double*)target, (const double*)weight, e,
                  (const int64_t*)slot_of_edge, (int)side, rules, s, (unsigned char*)valid, (double*)residual);
}

extern "C" int devo_move_poses(int64_t device, void* stream, int64_t type, const void* steps, const void* apply,
                               int64_t count, void* poses) {
    cudaSetDevice((int)device);
    DEVO_DISPATCH(type, thread_launch(count), stream, move_poses, S, (const double*)steps,
                  (const unsigned char*)apply, count, (S*)poses);
}

extern "C" int devo_move_depths(int64_t device, void* stream, int64_t type, const void* steps, const void* patch_ids,
                                const void* apply, int64_t count, int64_t rows, int64_t pixels, double largest,
                                double reset, double smallest, void* patches) {
    cudaSetDevice((int)device);
    DEVO_DISPATCH(type, thread_launch(count), stream, move_depths, S, (const double*)steps,
                  (const int64_t*)patch_ids, (const unsigned char*)apply, count, rows, (int)pixels, largest, reset,
                  smallest, (S*)patches);
}
