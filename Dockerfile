# The EdgeGrasp server: gRPC on 50051, HTTP on 8000.
#
#   docker build -t edgegrasp .
#   docker run --rm -p 8000:8000 -p 50051:50051 edgegrasp

FROM python:3.11-slim AS build

WORKDIR /source
RUN python -m venv /venv

# Where pip looks besides its default, for example for a torch without CUDA: a third of the size.
ARG PIP_EXTRA_INDEX_URL

COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY clients clients
COPY model model
COPY proto proto
COPY service service
RUN /venv/bin/pip install --no-cache-dir --constraint constraints.txt '.[service]'


FROM python:3.11-slim

# What Open3D loads on import.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        libegl1 libgl1 libgomp1 libusb-1.0-0 libx11-6 \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --system --uid 10001 --no-create-home edgegrasp
COPY --from=build /venv /venv

ENV PATH=/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    EDGEGRASP_HOST=0.0.0.0

USER edgegrasp
EXPOSE 8000 50051

HEALTHCHECK --interval=10s --timeout=3s --start-period=60s \
    CMD ["python", "-m", "edgegrasp_service.probe"]

ENTRYPOINT ["edgegrasp", "serve"]
