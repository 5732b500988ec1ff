"""Published figures for the sequence BOARD SLOW of VECtor, shown beside our own; nothing is computed from them.

Lengths of the paper are called metres but are units of the odometry, 1.4184 to the metre (its scale factor); the
metric values are those divided by that.
"""

from __future__ import annotations

SOURCE = "Ashraf, Safdari: Extending Deep Event Visual Odometry with Sparse Point-Cloud Export (BOARD SLOW, VECtor)"
UNITS_PER_M = 1.4184

COUNTS: dict[str, float] = {
    "DEVO poses": 985, "ground-truth poses": 4171, "DEVO cloud points": 7717, "EMVS points, DEVO poses": 2993,
    "EMVS points, ground-truth poses": 4444, "DEVO / ground-truth scale": UNITS_PER_M,
}
CHAMFER_UNITS = {"before ICP": 0.0091, "after ICP": 0.0094}
"""EMVS with DEVO poses to DEVO cloud."""
F_AT_5_CM = {"before ICP": 0.479, "after ICP": 0.491}
PRECISION_AT_5_CM, RECALL_AT_5_CM = 0.984, 0.317
PLANE_RMSE_UNITS = {"EMVS, DEVO poses": 0.0135, "DEVO cloud": 0.0932}
AGREEMENT_GROUND_TRUTH: dict[float, tuple[float, float, float]] = {
    0.01: (0.307, 0.092, 0.142), 0.02: (0.666, 0.185, 0.289), 0.05: (0.913, 0.312, 0.465), 0.10: (0.969, 0.361, 0.526),
}
"""Threshold in units of the odometry -> precision, recall, F-score of EMVS with ground-truth poses and DEVO cloud."""
