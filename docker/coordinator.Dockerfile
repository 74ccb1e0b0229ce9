# The coordinator: API, queue and state. No renderer. Build from the repository's root:
#   docker build -f docker/coordinator.Dockerfile -t lightkiln-coordinator .
FROM python:3.11-slim-bookworm
WORKDIR /opt/lightkiln
COPY pyproject.toml constraints.txt README.md ./
COPY schemas schemas
COPY service service
COPY workers workers
RUN pip install --no-cache-dir -c constraints.txt '.[service]' \
 && useradd --system --create-home --home-dir /var/lib/lightkiln lightkiln
USER lightkiln
VOLUME /var/lib/lightkiln
EXPOSE 8321
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8321/readyz', timeout=4)"]
ENTRYPOINT ["python", "-m", "kiln_service", "--host", "0.0.0.0", "--port", "8321", "--data", "/var/lib/lightkiln"]
