# A worker: renderer, network, packager. No database driver. Build from the repository's root:
#   docker build -f docker/worker.Dockerfile -t lightkiln-worker .
FROM python:3.11-slim-bookworm AS build
ENV PIP_NO_CACHE_DIR=1
WORKDIR /src
COPY deploy/install deploy/install
COPY pyproject.toml constraints.txt README.md ./
COPY schemas schemas
COPY service service
COPY workers workers
RUN deploy/install/venv.sh /opt/lightkiln worker --copy

FROM python:3.11-slim-bookworm
COPY deploy/install /tmp/install
COPY --from=build /opt/lightkiln /opt/lightkiln
RUN /tmp/install/libllvm.sh /opt/lightkiln \
 && rm -rf /tmp/install /var/lib/apt/lists/* \
 && useradd --system --uid 8322 --create-home --home-dir /var/lib/lightkiln lightkiln
ENV PATH=/opt/lightkiln/bin:$PATH
USER 8322
# LIGHTKILN_URL and LIGHTKILN_TOKEN name the coordinator.
ENTRYPOINT ["python", "-m", "kiln_workers", "worker"]
