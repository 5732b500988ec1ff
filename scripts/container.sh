#!/usr/bin/env bash
# Entry point of the container: the first word is a command, the rest goes to it.
set -euo pipefail
home="$(cd "$(dirname "$0")/.." && pwd)"
names="$(cd "$home/scripts" && grep -l "__main__" -- *.py | sed 's/\.py$//' | sort | tr '\n' ' ')"
command="${1:-help}"
[ $# -eq 0 ] || shift
case "$command" in
    pipeline) command=start_pipline ;;
    export) command=export_pointcloud ;;
    info) exec python -m devo.info "$@" ;;
    selftest)
        export DEMO_DIR="${DEMO_DIR:-$(mktemp -d)}" DEMO_SECONDS="${DEMO_SECONDS:-3}"
        exec bash "$home/scripts/demo.sh" --run-emvs "$@" ;;
    python | bash) exec "$command" "$@" ;;
    help | -h | --help)
        echo "commands: pipeline (= start_pipline), export (= export_pointcloud), selftest, info, python, bash, and"
        echo "  $names"
        echo "each with --help; recordings belong to /data, results to /results"
        exit 0 ;;
esac
if [ ! -f "$home/scripts/$command.py" ]; then
    echo "container: unknown command '$command'; choose from pipeline, export, selftest, info, $names" >&2
    exit 2
fi
exec python "$home/scripts/$command.py" "$@"
