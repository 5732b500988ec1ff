# CPU image: docker build -t devo . && docker run --rm -v "$PWD/data:/data" devo \
#     python scripts/export_pointcloud.py --dataset generic --datapath /data/my_recording --out /data/cloud.npy
FROM python:3.11-slim

# Open3D and OpenCV load these at import time
RUN apt-get update \
    && apt-get install -y --no-install-recommends libgomp1 libgl1 libegl1 libx11-6 libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/devo
COPY . .
# an index with CPU builds of torch saves gigabytes: --build-arg PIP_EXTRA_INDEX_URL=...
ARG PIP_EXTRA_INDEX_URL=
RUN PIP_EXTRA_INDEX_URL="$PIP_EXTRA_INDEX_URL" bash scripts/setup_env.sh
ENV PATH="/opt/devo/.venv/bin:$PATH"
CMD ["python", "-m", "devo.info"]
