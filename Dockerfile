# Code, dependencies and the small network are in the image; running it needs no network.
#   docker build -t devo .                                         CPU; GPU: --target cuda, and --gpus all below
#   docker run --rm devo selftest                                  simulate, track, map, compare with the truth
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD/datasets:/data:ro" -v "$PWD/results:/results" \
#       devo pipeline /data/my_recording                           results in results/my_recording
# `docker run --rm devo` lists the commands. Published weights are mounted: -v "$PWD/DEVO.pth:/weights/DEVO.pth:ro",
# then --weights /weights/DEVO.pth. For builds that repeat exactly, give the base image with its digest:
# --build-arg PYTHON_IMAGE=python:3.11-slim-bookworm@sha256:...
ARG PYTHON_IMAGE=python:3.11-slim-bookworm

FROM ${PYTHON_IMAGE} AS system
# Open3D and OpenCV load these at import time
RUN apt-get update \
    && apt-get install -y --no-install-recommends libgomp1 libgl1 libegl1 libx11-6 libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/*

FROM system AS build-cpu
# an index with CPU builds of torch saves gigabytes
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /opt/devo
COPY . .
RUN PIP_EXTRA_INDEX_URL="$TORCH_INDEX" PIP_NO_CACHE_DIR=1 EXTRAS=ros,aedat bash scripts/setup_env.sh \
    && .venv/bin/python -m compileall -q devo utils evals scripts

FROM system AS build-cuda
# builds of torch from PyPI bring the CUDA libraries for all current architectures
WORKDIR /opt/devo
COPY . .
RUN PIP_NO_CACHE_DIR=1 EXTRAS=ros,aedat bash scripts/setup_env.sh \
    && .venv/bin/python -m compileall -q devo utils evals scripts

FROM system AS runtime
ARG REVISION=unknown
LABEL org.opencontainers.image.title="devo" \
      org.opencontainers.image.description="Event-camera odometry with sparse point clouds" \
      org.opencontainers.image.licenses="MIT" \
      org.opencontainers.image.revision="$REVISION"
# any user may run it (--user), and only /results and /tmp are written to
RUN useradd --create-home --uid 1000 devo && mkdir /data /results && chown devo /results
ENV VENV=/opt/devo/.venv PATH="/opt/devo/.venv/bin:$PATH" PYTHONDONTWRITEBYTECODE=1 HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib
USER devo
# results/NAME of the commands is /results/NAME from here
WORKDIR /
ENTRYPOINT ["/opt/devo/scripts/container.sh"]
CMD ["help"]
HEALTHCHECK --interval=1m --timeout=20s CMD ["/opt/devo/.venv/bin/python", "-c", "import devo.config"]

FROM runtime AS cuda
COPY --from=build-cuda /opt/devo /opt/devo

FROM runtime AS cpu
COPY --from=build-cpu /opt/devo /opt/devo
