#!/usr/bin/env bash
# Everything that must hold before a change lands: environment, lint, types, tests. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
bash scripts/setup_env.sh
bin="${VENV:-.venv}/bin"
"$bin/ruff" check .
"$bin/mypy"
exec "$bin/python" -m pytest "$@"
