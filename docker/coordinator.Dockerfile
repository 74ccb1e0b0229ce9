# The coordinator: API, queue and state. No renderer, no network. Build from the repository's root:
#   docker build -f docker/coordinator.Dockerfile -t lightkiln-coordinator .
FROM python:3.11-slim-bookworm AS build
ENV PIP_NO_CACHE_DIR=1
WORKDIR /src
COPY deploy/install deploy/install
COPY pyproject.toml constraints.txt README.md ./
COPY schemas schemas
COPY service service
COPY workers workers
RUN deploy/install/venv.sh /opt/lightkiln service --copy

FROM python:3.11-slim-bookworm
RUN useradd --system --uid 8321 --create-home --home-dir /var/lib/lightkiln lightkiln
COPY --from=build /opt/lightkiln /opt/lightkiln
ENV PATH=/opt/lightkiln/bin:$PATH
USER 8321
VOLUME /var/lib/lightkiln
EXPOSE 8321
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8321/readyz', timeout=4)"]
ENTRYPOINT ["lightkiln", "serve", "--host", "0.0.0.0", "--port", "8321", "--data", "/var/lib/lightkiln"]
