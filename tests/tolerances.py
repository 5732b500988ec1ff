"""The one table of numeric tolerances, each with the worst case observed when it was set (2 cores, torch 2.13 CPU)."""

import torch

# --- lie groups ---------------------------------------------------------------------------------------------
LIE_PARITY = 1e-9  # reference arrays, float64; observed 1.4e-14
LIE_LAWS_FLOAT64 = 1e-13  # group laws at angles 0 .. pi - 1e-6, absolute + relative; observed 1.5e-15
LIE_LAWS_FLOAT32 = 5e-6  # the same in float32; observed 9.4e-7
LIE_FLOAT32_SMALL = 1e-6  # float32 against float64 at angles 0 .. 1, values and gradients; observed 4.1e-7
LIE_GRADIENT = 1e-10  # gradients against fourth-order differences, float64; observed 6.0e-12
LIE_SLOPE = 1e-8  # second-order differences with steps of 1e-5, float64

# --- geometry and bundle adjustment -------------------------------------------------------------------------
TRANSFORM = 1e-4  # of the largest value; pixels 2.2e-7, Jacobians 3.5e-7
REPROJECTION = 1e-5  # pixels relative to 1 + |pixel|; 3.0e-6
REPROJECT_EDGES = 1e-5  # of the largest pixel, against transform; 2.2e-7
BA_ONE_STEP = 1e-4  # absolute, published order; poses 4.9e-6, inverse depths 2.3e-5
BA_TWO_STEPS = 1e-3  # absolute, published order, inverse depths at the best scale; poses 1.9e-4, depths 5.0e-4 (AVX2)
BA_FREE_SCALE = 1e-3  # that scale minus 1: 3.5e-4 with AVX2; the reference is uncertain along it, see BA_ACCURATE
# The accurate solver against the float32 reference, relative norms: poses 5.5e-5, depths 2.2e-4. The free scale has an
# eigenvalue of 6 beside 3.5e5, so the reference itself is uncertain by that much.
BA_ACCURATE = 5e-4
BA_TRAINING = 1e-3  # relative and absolute; poses 1.2e-4, depths 5.0e-4
BA_TRAINING_GRADIENT = 1e-3  # of the largest entry; target 1.7e-4, weight 9.0e-5
BA_CLIPS = 1e-4  # float32, joined against separate clips
BA_DENSE_STEP = 1e-7  # float64, against a dense system with numeric Jacobian

# --- correlation --------------------------------------------------------------------------------------------
CORRELATION_PARITY = 1e-5  # altcorr.npz, values up to 20; observed 2.4e-6
CORRELATION_GRADIENT = 1e-5  # altcorr.npz, of the largest entry; observed 3.5e-7
PATCHIFY_PARITY = 1e-5  # altcorr.npz, values and gradient; observed 2.4e-7
CORRELATION_CLOSED_FORM = 1e-12  # float64, against the bilinear sampler of torch; observed 2.0e-14
CORRELATION_FEATURES = 1e-5  # shared windows against corr, float32, values up to 30; observed 2.9e-6
CORRELATION_BLOCK = 2e-6  # volumes against corr, values and gradients, of the largest value; observed 2.6e-7
CORRELATION_HALF = 0.02  # float16 and bfloat16 against float32, of the largest value; observed 5.4e-3

# --- CUDA kernels -------------------------------------------------------------------------------------------
# Against the torch twins, of the largest value; correlation and patches by dtype of the maps. In the CPU emulation:
# 5.5e-7, 3.7e-16, 9.5e-4 and 5.1e-3; all held on an H100 as well.
CUDA_CORRELATION = {torch.float32: 1e-5, torch.float64: 1e-12, torch.float16: 0.01, torch.bfloat16: 0.05}
CUDA_REPROJECT = {torch.float32: 1e-6, torch.float64: 1e-12}
CUDA_BA = 1e-8  # float64; 3.3e-12
CUDA_BA_FLOAT32 = 1e-5  # float32 state, both solve in float64; below 5.5e-7

# --- networks -----------------------------------------------------------------------------------------------
NETWORK_PARITY = 1e-4  # network_small.npz, values up to 5; observed 2.4e-6 (maps), 2.0e-6 (update)
UPDATE_CHUNKS = 1e-5  # chunk sizes and edge orders against each other, float32, values up to 5; observed 1.2e-6
UPDATE_BFLOAT16 = 0.03  # bfloat16 against float32 linear layers, values of deviation 1; observed 0.0141
ENCODER_BFLOAT16 = 0.05  # bfloat16 against float32 feature maps, of their largest value; observed 0.0167
WIDENED = 1e-5  # outputs of a widened network, of the largest value; observed 7.5e-7
NORMALIZE = 2e-6  # against float64; observed 2.6e-7

# --- tracker ------------------------------------------------------------------------------------------------
TRACKER_ORACLE_POSES = 5e-3  # 1.9e-4; a change of 1e-6 in the initial depths moves the reference by 1.2e-3
TRACKER_ORACLE_POINTS = 1e-2  # of the depth; 2.0e-4
ORACLE_PATH = 2e-3  # rms position error over path length with true flow, all frames; 8.9e-4

# --- events and voxel grids ---------------------------------------------------------------------------------
VOXEL = 1e-6  # absolute, per cell; worst 2.3e-7, one rounding to float32 of cells up to 4
VOXEL_RECTIFIED = 1e-6  # absolute, per cell; worst 1.2e-7 (order of float64 sums before one rounding)
RECTIFIED_INTRINSICS = 1e-6  # pixels; worst 8.5e-9 (published with 8 decimals), OpenCV 4.8.1 and 5.0.0
RECTIFY_MAP_SAMPLES = 1e-4  # pixels; worst 5.5e-5 (published with 4 decimals)
RECTIFY_ROUND_TRIP_RADTAN = 2e-3  # pixels; worst 1.03e-3, the recipe iterates until 1e-3
RECTIFY_ROUND_TRIP_FISHEYE = 5e-5  # pixels; worst 1.45e-5, float32 map of +-700 px

# --- clouds and trajectories --------------------------------------------------------------------------------
UMEYAMA_AGAINST_EVO = 1e-9  # 100 random pairs, rotation, translation and scale: worst 2.2e-14

# --- simulator ----------------------------------------------------------------------------------------------
SIMULATOR_DEPTH = 2e-6  # inverse depth against float64 ray casting, relative to the largest; observed 2.2e-7
SIMULATOR_SURFACE = 3e-6  # back-projected depth, distance from the scene over that from the camera; observed 2.8e-7
SIMULATOR_CROSSING = 1e-5  # log intensity at the time of an event against a float64 pixel; observed 1.7e-6
SIMULATOR_VOXEL = 1e-5  # voxel cells against float64 binning of listed events; observed 1.4e-6

# --- COLMAP --------------------------------------------------------------------------------------------------
COLMAP_FRAMES = 1e-4  # camera centres tracked from frames as files against those from the recording; 1.9e-5 of 10

# --- EMVS ---------------------------------------------------------------------------------------------------
EMVS_VOTES = 3e-5  # per voxel, float32 positions against float64 rays; 7.4e-6 (24 draws)
EMVS_VOTES_NEAR_PLANES = 2e-4  # the same with cameras among the planes; 5.2e-5 (12 draws)
EMVS_PIXELS = 5e-5  # event -> plane -> event; 1.5e-5

# --- training -----------------------------------------------------------------------------------------------
JOINED_CLIPS = 1e-3  # joined against single clips after 4 updates, pixels and poses; observed below 1e-4

# --- CUDA against CPU, float32; all held on an H100 (torch 2.11, CUDA 13.0), the worst cases were not recorded ---
GPU_CORRELATION = 1e-5  # of the largest value or gradient
GPU_BA = 1e-3  # of the largest value
GPU_TRAINING_LOSS = 1e-3  # relative, each loss of a step
GPU_TRAINING_GRADIENT = 1e-2  # all gradients together, relative norm
GPU_TRACKER = 1e-2  # rotation [rad] and position over the largest position
