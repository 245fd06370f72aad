# recon for the CPU; with `--build-arg TORCH=cuda` for an NVIDIA GPU. docs/install.md says how to run.
ARG BASE=python:3.12-slim-bookworm

# hadolint ignore=DL3006  # the tag is in BASE
FROM ${BASE} AS build
ARG TORCH=cpu
WORKDIR /src
COPY . .
RUN case "$TORCH" in \
        cpu) export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu ;; \
        cuda) ;; \
        *) echo "TORCH is cpu or cuda, not $TORCH" >&2; exit 2 ;; \
    esac \
    && python3 -m venv /opt/recon \
    && /opt/recon/bin/pip install --no-cache-dir --no-compile -c constraints.txt . \
    # torch's own tests and headers: 180 MB
    && torch=$(/opt/recon/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/torch \
    && rm -rf "$torch/test" "$torch/include" \
    && find "$torch/bin" -type f ! -name torch_shm_manager -delete

# hadolint ignore=DL3006
FROM ${BASE}
ARG TORCH=cpu
# triton compiles its launcher with a C compiler
# hadolint ignore=DL3008
RUN if [ "$TORCH" = cuda ]; then \
        apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev \
        && rm -rf /var/lib/apt/lists/*; \
    fi \
    && useradd --uid 1000 --create-home recon \
    && install -d -o recon -g recon /data /cache
COPY --from=build /opt/recon /opt/recon
# `docker run -v recon-cache:/cache recon setup bridge` keeps its weights in that volume.
ENV PATH=/opt/recon/bin:$PATH \
    RECON_CACHE_DIR=/cache \
    PYTHONDONTWRITEBYTECODE=1 \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility
USER 1000
WORKDIR /data
VOLUME ["/data", "/cache"]
EXPOSE 8080
# Only `recon view` serves anything; what else runs is healthy as long as it runs.
HEALTHCHECK --interval=30s --timeout=10s --start-period=60s \
    CMD ["python3", "-c", "import urllib.request as r; b'view' not in open('/proc/1/cmdline', 'rb').read().split(b'\\0') or r.urlopen('http://127.0.0.1:8080', timeout=8)"]
ENTRYPOINT ["recon"]
CMD ["--help"]
