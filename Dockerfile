# The EdgeGrasp server: gRPC on 50051, HTTP on 8000. docs/containers.md says how to run it.
#
#   docker build -t edgegrasp .
#   docker build -t edgegrasp:cuda --build-arg TORCH=torch .    # as the package index has it

# docs/security.md says how to renew the digest.
ARG BASE=python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${BASE} AS base
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libgomp1 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* \
    && useradd --system --uid 10001 --no-create-home edgegrasp


FROM base AS build
# Where packages come from, in the place of pip's default; and what pip is to install as torch: one
# without CUDA, and without what only its compiler requires.
ARG PIP_INDEX_URL
ARG TORCH="--no-deps --extra-index-url https://download.pytorch.org/whl/cpu torch"
ENV PIP_NO_CACHE_DIR=1 PIP_COMPILE=0 PIP_CONSTRAINT=/source/constraints.txt

# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends binutils
WORKDIR /source
COPY pyproject.toml constraints.txt docker/requirements.txt ./
RUN python3 -m venv /tools && /tools/bin/pip install cyclonedx-bom pip-licenses \
    && python3 -m venv --without-pip /venv
ENV PIP_PYTHON=/venv/bin/python
# hadolint ignore=SC2086
RUN /tools/bin/pip install ${TORCH}
RUN /tools/bin/pip install --require-hashes -r requirements.txt \
    && find /venv -regextype posix-extended -type d -regex ".*/(tests|numba/cuda|numpy/distutils|torchgen/packaged\
|scipy/(cluster|datasets|differentiate|fft|fftpack|integrate|interpolate|io|odr|optimize|signal|stats)\
|torch/(_dynamo|_inductor|include|onnx|share|test|testing/_internal/[a-z]+))" -prune -exec rm -r {} + \
    && find /venv -regextype posix-extended -type f -regex ".*(\.(a|c|cmake|cpp|h|hpp|pxd|pyi|pyx)\
|/torch/bin/.*([tT]est|protoc).*|/torch/lib/.*(test|custom_ops|with_compiler)\.so\
|/torch/testing/_internal/common_[^d]*\.py\
|/(_avif|libavif).*\.so.*)" -delete \
    && find /venv -path '*/pygments/lexers/[!_]*' -not -name python.py -delete \
    && find /venv -name '*.so' -not -path '*.libs/*' -exec strip --strip-unneeded {} +

COPY LICENSE README.md ./
COPY clients clients
COPY model model
COPY proto proto
COPY service service
RUN /tools/bin/pip install --no-deps .
# Loads as a server does: modules and loops are compiled that it needs, and no others. Loops of x86-64 are
# for what processors have had since 2013, and for AVX-512 where this one has it; of others for every one.
RUN kinds=generic \
    && if [ "$(uname -m)" = x86_64 ]; then \
        kinds="x86-64-v3 $(grep -q avx512vl /proc/cpuinfo && echo x86-64-v4)"; \
    fi \
    && for kind in $kinds; do \
        NUMBA_CACHE_DIR=/venv/loops/$kind NUMBA_CPU_NAME=$kind NUMBA_CPU_FEATURES='' \
            /venv/bin/python -c 'import edgegrasp_cli.serve, edgegrasp_service.server; \
            from edgegrasp_service.worker.answer import Settings, load_catalogue; \
            load_catalogue(Settings())' || exit 1; \
    done \
    && mkdir -p /venv/share/edgegrasp \
    && /tools/bin/cyclonedx-py environment /venv/bin/python -o /venv/share/edgegrasp/sbom.json \
    && /tools/bin/pip-licenses --python /venv/bin/python --format markdown \
        --output-file /venv/share/edgegrasp/licences.md


FROM base
COPY --from=build /venv /venv
COPY docker/start.sh /start.sh

ARG VERSION
LABEL org.opencontainers.image.title="EdgeGrasp" \
    org.opencontainers.image.description="Grasp detection as a service" \
    org.opencontainers.image.version="${VERSION}" \
    org.opencontainers.image.licenses="MIT"
ENV PATH=/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    EDGEGRASP_HOST=0.0.0.0
USER 10001
EXPOSE 8000 50051
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s \
    CMD ["python", "-m", "edgegrasp_service.probe"]
ENTRYPOINT ["/start.sh"]
