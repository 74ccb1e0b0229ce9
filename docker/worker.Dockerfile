# A worker: renderer, network, packager. No database driver. Build from the repository's root:
#   docker build -f docker/worker.Dockerfile -t lightkiln-worker .
FROM python:3.11-slim-bookworm
RUN apt-get update -qq \
 && apt-get install -y -qq --no-install-recommends libllvm19 \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/lightkiln
COPY pyproject.toml constraints.txt README.md ./
COPY schemas schemas
COPY service service
COPY workers workers
RUN pip install --no-cache-dir -c constraints.txt '.[worker]' \
 && useradd --system --create-home --home-dir /var/lib/lightkiln lightkiln
USER lightkiln
# LIGHTKILN_URL and LIGHTKILN_TOKEN name the coordinator.
ENTRYPOINT ["python", "-m", "kiln_workers", "worker"]
