#!/usr/bin/env bash
# Everything that must hold before a change lands: environment, lint, types, tests. Arguments go to pytest, which runs in
# two processes (JOBS); most operations of the tests are too small to share one among threads.
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup_env.sh
bin="${VENV:-.venv}/bin"
"$bin/ruff" check .
"$bin/mypy"
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
exec "$bin/python" -m pytest -n "${JOBS:-2}" --dist worksteal "$@"
