# A slim image that serves packages: docker build -t gsvis . && docker run -v "$PWD:/data:ro" gsvis
# It holds the bare install: read, inspect, verify, serve, simulate. Preparing a scene needs `gsvis[all]`.
FROM python:3.11-slim AS build
WORKDIR /src
COPY requirements.txt ./
RUN python -m venv /opt/gsvis && /opt/gsvis/bin/pip install --no-cache-dir --require-hashes --only-binary :all: -r requirements.txt
COPY pyproject.toml README.md LICENSE ./
COPY gsvis gsvis
RUN python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheel . && /opt/gsvis/bin/pip install --no-cache-dir --no-deps /wheel/*.whl

FROM python:3.11-slim
COPY --from=build /opt/gsvis /opt/gsvis
RUN useradd --system --create-home gsvis && mkdir -p /var/cache/gsvis && chown gsvis /var/cache/gsvis
# Compiled kernels and tables of packages. Mount a volume here, so that only the first start makes them.
ENV GSVIS_CACHE=/var/cache/gsvis NUMBA_CACHE_DIR=/var/cache/gsvis/kernels PATH=/opt/gsvis/bin:$PATH PYTHONUNBUFFERED=1
VOLUME /var/cache/gsvis
USER gsvis
WORKDIR /data
EXPOSE 8765
HEALTHCHECK --start-period=90s --interval=30s --timeout=5s \
    CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8765/healthz', timeout=4)"]
# SIGTERM tells viewers to come back, then stops within three seconds.
STOPSIGNAL SIGTERM
ENTRYPOINT ["gsvis"]
CMD ["serve", "scene.gsvis", "--host", "0.0.0.0", "--hosts", "localhost", "--log-format", "json"]
