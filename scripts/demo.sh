#!/usr/bin/env bash
# The first five minutes: set up, simulate a recording with perfect ground truth, track it, compare, show where it all is.
# DEMO_SECONDS chooses the length of the recording (default 8), DEMO_DIR where datasets/ and results/ go (default: this
# checkout), VENV the environment; arguments go to the pipeline. Safe to call again: what is unchanged is kept.
set -euo pipefail
[ -z "${DEMO_DIR:-}" ] || { mkdir -p "$DEMO_DIR"; DEMO_DIR="$(cd "$DEMO_DIR" && pwd)"; }
cd "$(dirname "$0")/.."
bash scripts/setup_env.sh
python="${VENV:-.venv}/bin/python"
seconds="${DEMO_SECONDS:-8}"
name="demo_board_${seconds}s"
root="${DEMO_DIR:-$PWD}"
recording="$root/datasets/$name"
results="$root/results/$name"

echo "1. simulate an event camera in front of a board ($seconds s)" >&2
[ -f "$recording/scene.json" ] || "$python" scripts/simulate.py --scene board --out "$recording" --seconds "$seconds" --seed 1
echo "2. track it and clean the cloud, with the small network that ships" >&2
"$python" scripts/start_pipline.py "$recording" --outdir "$results" --resume "$@"
echo "3. compare with the ground truth" >&2
"$python" evals/compare_run.py "$results/pointcloud.npy" --datapath "$recording"

echo
echo "cloud      $results/pointcloud_cleaned.ply"
echo "picture    $results/pointcloud_cleaned.png"
echo "HTML view  $results/pointcloud_view.html   (open it in a browser)"
